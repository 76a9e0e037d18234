"""Least-squares polish: all parameters of one direction together, from the place where the swarm ended.

The vector is the particle of `pso`: [ts, tc / ts, log ws, tv] and then the Legendre coefficients of the cubic.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from jointctl.tools.identification.models import legendre
from jointctl.tools.identification.variable_projection import Fit, Problem


def vector_limits(problem: Problem) -> np.ndarray:
    """Lower and upper limit of each element, shape (2, D): wide enough for any friction of the size measured."""
    size = float(np.max(np.abs(problem.y_Nm)))
    steep = 2.0 * size / min(problem.knee, 1.0)
    limits = [
        (0.0, problem.static_max_Nm),
        (0.0, 1.0),
        (float(np.log(problem.ws_low)), float(np.log(problem.ws_high))),
        (-steep, steep),
    ]
    if problem.form.cubic:
        limits += [] if problem.form.continuous else [(-size, 2.0 * size)]
        limits += [(-size, size)] * 3
    return np.array(limits).T


def beta_from_vector(problem: Problem, vector: np.ndarray, knee: float) -> tuple[np.ndarray, float]:
    """(linear parameters of the form, ws); the polynomials move from [problem.knee..1] to [knee..1]."""
    low = [vector[0] * vector[1], vector[0], vector[3]]
    high = vector[4:]
    if problem.form.cubic and knee != problem.knee:
        # the same cubic through four places, in the other polynomials
        at = np.linspace(knee, 1.0, 4)
        full = np.concatenate([[0.0], high]) if problem.form.continuous else high
        full = np.linalg.solve(legendre(at, knee), legendre(at, problem.knee) @ full)
        high = full[1:] if problem.form.continuous else full
    return np.concatenate([low, high]), float(np.exp(vector[2]))


def _vector(fit: Fit) -> np.ndarray:
    tc, ts, tv = fit.beta[:3]
    share = tc / ts if ts > 0.0 else 1.0
    return np.concatenate([[ts, share, np.log(fit.ws), tv], fit.beta[3:]])


def polish(fit: Fit) -> Fit:
    """The local minimum next to `fit`, at its knee; never worse than `fit`. A linear model is already there."""
    problem, knee = fit.problem, fit.knee
    if not problem.form.stribeck:
        return fit
    lower, upper = vector_limits(problem)
    margin = 1e-9 * (upper - lower)
    # a cubic on another knee may leave the box, which only serves to scale
    start = _vector(fit)
    lower[3:], upper[3:] = np.minimum(lower[3:], start[3:]), np.maximum(upper[3:], start[3:])

    def unpack(vector: np.ndarray) -> Fit:
        return Fit(problem, np.concatenate([[vector[0] * vector[1], vector[0]], vector[3:]]),
                   float(np.exp(vector[2])), knee, 0.0)  # fmt: skip

    def residual(vector: np.ndarray) -> np.ndarray:
        return unpack(vector).torque_Nm(problem.x) - problem.y_Nm

    found = least_squares(
        residual, np.clip(start, lower + margin, upper - margin), bounds=(lower, upper), x_scale=upper - lower,
        xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=400,
    )  # fmt: skip
    polished = unpack(found.x)
    rss = float(2.0 * found.cost)
    return Fit(problem, polished.beta, polished.ws, knee, rss) if rss < fit.rss else fit
