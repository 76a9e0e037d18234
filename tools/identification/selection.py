"""Which points and which model to believe: robust outlier test, and error on points held out (k-fold)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jointctl.tools.identification.models import FORMS, Form, basis
from jointctl.tools.identification.variable_projection import Problem, project, static_limit_Nm

MAX_OUTLIERS = 0.2  # of a direction's points: beyond, it is the model that does not fit
_TIE = 1.01  # held-out errors within 1 % count as equal, then fewer parameters win


def find_outliers(problem: Problem, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Points that do not belong to the curve: (bool (N,), residual in standard deviations (N,)).

    The residual is that from a fit without the point (r / (1 - h) with the leverage h for a point in the fit), the
    standard deviation s comes from the median of the kept points, which a few wrong points cannot move.  Repeated
    until nothing changes, so that one outlier does not hide another.  threshold 0 switches the test off.
    """
    out = np.zeros(len(problem.x), bool)
    score = np.zeros(len(problem.x))
    if threshold <= 0.0:
        return out, score
    for _ in range(20):
        fit = project(problem.part(~out))
        columns = basis(problem.form, problem.x, fit.ws, fit.knee)
        residual = problem.y_Nm - columns @ fit.beta
        orthonormal = np.linalg.qr(columns[~out])[0]
        # capped: the lowest speed alone decides on ts, and would otherwise always look innocent or guilty
        leverage = np.minimum(np.sum(orthonormal**2, axis=1), 0.5)
        kept = residual[~out]
        spread = 1.4826 * float(np.median(np.abs(kept))) * np.sqrt(len(kept) / max(len(kept) - columns.shape[1], 1))
        floor = 1e-6 * float(np.max(np.abs(problem.y_Nm)))  # noiseless data have no outliers from rounding
        score = residual.copy()
        score[~out] = kept / (1.0 - leverage)
        score /= max(spread, floor)
        found = np.abs(score) > threshold
        if np.array_equal(found, out) or np.count_nonzero(found) > MAX_OUTLIERS * len(out):
            return found, score
        out = found
    return out, score


def fold_numbers(problem: Problem, folds: int, seed: int) -> np.ndarray:
    """Fold of each point (N,): speeds are dealt at random; repeats of a speed stay together, as they are no news."""
    speeds, which = np.unique(problem.x, return_inverse=True)
    dealt = np.arange(len(speeds)) % folds
    np.random.default_rng(seed).shuffle(dealt)
    return dealt[which]


def held_out_rss(problem: Problem, folds: int, seed: int) -> float:
    """Squared error over all points, each predicted by a fit that did not see it; the knee stays where it is."""
    number = fold_numbers(problem, folds, seed)
    total = 0.0
    for fold in range(folds):
        out = number == fold
        if out.any():
            fit = project(problem.part(~out))
            error = problem.y_Nm[out] - fit.torque_Nm(problem.x[out])
            total += float(error @ error)
    return total


def with_form(problem: Problem, form: Form) -> Problem:
    """The same points with another model."""
    knee = problem.knee if form.cubic else 1.0
    limit = problem.static_max_Nm
    if form.cubic != problem.form.cubic:
        limit = static_limit_Nm(form, problem.x, problem.y_Nm, knee)
    return replace(problem, form=form, knee=knee, static_max_Nm=limit)


def choose(held_out_rmse_Nm: dict[str, float]) -> str:
    """The model of least held-out error; among equals (1 %) the one with the fewest parameters."""
    best = min(held_out_rmse_Nm.values())
    good = [name for name, value in held_out_rmse_Nm.items() if value <= _TIE * best]
    return min(good, key=lambda name: (FORMS[name].parameters, held_out_rmse_Nm[name]))
