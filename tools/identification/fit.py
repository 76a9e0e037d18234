"""The best fit of one direction: exact minimum, polish of a swarm's end, outliers, and the choice of a model.

For a given Stribeck speed ws and knee the rest is linear least squares with 0 <= tc <= ts <= static_max, solved exactly
by going along the limits that it violates.  What remains is one dimension: a scan over log ws, refined around its best
places (variable projection, Golub and Pereyra 1973).  Takes milliseconds; it is the cross-check of the particle swarm,
and serves selection and intervals.  The knee of the discontinuous model matters only through which points lie beyond
it, so it is searched among the midpoints between neighbouring speeds; the continuous model uses the same candidates.

The polish is least squares over all parameters together, from the place where the swarm ended.  Outliers are found by
a robust test, a model is chosen by its error on points held out of the fit (k-fold).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.optimize import brentq, least_squares, minimize_scalar

from jointctl.tools.identification.models import FORMS, MIN_PER_STAGE, Branch, Form, Regression, basis, branch, legendre

SCAN = 48  # values of ws


@dataclass(frozen=True)
class Problem:
    """One direction to be fitted, sorted and normalised: x = u / top_radps."""

    form: Form
    x: np.ndarray
    y_Nm: np.ndarray
    weight: np.ndarray  # of the squared errors, 1 on average: by the noise's dependence on torque
    top_radps: float
    knee: float
    ws_low: float
    ws_high: float
    static_max_Nm: float

    def part(self, keep: np.ndarray) -> Problem:
        """The same problem with some of its points."""
        return replace(self, x=self.x[keep], y_Nm=self.y_Nm[keep], weight=self.weight[keep])


@dataclass(frozen=True)
class Fit:
    """Parameters of one direction (normalised) and the weighted squared error on the fitted points."""

    problem: Problem
    beta: np.ndarray
    ws: float
    knee: float
    rss: float

    @property
    def residual_Nm(self) -> np.ndarray:
        """Measured minus model (N,)."""
        return self.problem.y_Nm - self.torque_Nm(self.problem.x)

    @property
    def rmse_Nm(self) -> float:
        """Without weights."""
        return float(np.sqrt(np.mean(self.residual_Nm**2)))

    @property
    def weighted_rmse_Nm(self) -> float:
        """Root of what was minimised, over the number of points."""
        return float(np.sqrt(self.rss / len(self.problem.x)))

    def torque_Nm(self, x: np.ndarray) -> np.ndarray:
        return basis(self.problem.form, x, self.ws, self.knee) @ self.beta

    def branch(self) -> Branch:
        return branch(self.problem.form, self.beta, self.ws, self.knee, self.problem.top_radps)


def make_problem(
    form: Form,
    speed_radps: np.ndarray,
    friction_Nm: np.ndarray,
    knee_radps: float,
    ws_limits_radps: tuple[float | None, float],
    static_max_Nm: float | None = None,
) -> Problem:
    """Normalise one direction (mirrored: speed > 0) and choose the limits that were not given.

    The data say nothing below the lowest speed: a Stribeck speed under a third of it, or a static friction of more
    than 1.25 times the greatest friction measured near it, would be invented, not measured, and too much friction
    compensation at low speed makes a joint creep.
    """
    order = np.argsort(speed_radps, kind="stable")
    top = float(speed_radps[order[-1]])
    x, y = speed_radps[order] / top, friction_Nm[order]
    knee = knee_radps / top if form.cubic else 1.0
    ws_high = ws_limits_radps[1] / top
    ws_low = float(x[0]) / 3.0 if ws_limits_radps[0] is None else ws_limits_radps[0] / top
    limit = static_limit_Nm(form, x, y, knee) if static_max_Nm is None else static_max_Nm
    return Problem(form, x, y, np.ones(len(x)), top, knee, min(ws_low, 0.5 * ws_high), ws_high, limit)


def static_limit_Nm(form: Form, x: np.ndarray, y_Nm: np.ndarray, knee: float) -> float:
    """Greatest static friction that a fit may claim; without a cubic stage tc carries the whole curve, so all count."""
    near_zero = x <= max(4.0 * x[0], knee / 8.0) if form.cubic else np.ones(len(x), bool)
    return 1.25 * float(np.max(np.abs(y_Nm[near_zero])))


def _least_squares(columns: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    beta = np.linalg.lstsq(columns, y, rcond=None)[0]
    residual = y - columns @ beta
    return beta, float(residual @ residual)


def solve_linear(problem: Problem, ws: float, regression: Regression) -> tuple[np.ndarray, float]:
    """Best linear parameters with 0 <= tc <= ts <= static_max; returns (beta, squared error)."""
    root, limit = np.sqrt(problem.weight), problem.static_max_Nm
    columns, y = root[:, None] * regression.columns(ws), root * problem.y_Nm
    beta, rss = _least_squares(columns, y)
    if not problem.form.stribeck:
        if beta[0] >= 0.0:
            return beta, rss
        rest, rss = _least_squares(columns[:, 1:], y) if columns.shape[1] > 1 else (beta[1:], float(y @ y))
        return np.concatenate([[0.0], rest]), rss
    tc, ts = beta[0], beta[1]
    slack = 1e-12 * limit
    # the optimum of a convex problem lies on one of the limits that the free optimum violates; each is an edge of the
    # triangle of allowed (tc, ts), from one corner to the other
    corners = (0.0, 0.0), (0.0, limit), (limit, limit)
    edges = []
    if tc < -slack:
        edges.append((corners[0], corners[1]))
    if ts > limit + slack:
        edges.append((corners[1], corners[2]))
    if tc > ts + slack:
        edges.append((corners[0], corners[2]))
    if not edges:
        return beta, rss
    return min((_on_edge(columns, y, *edge) for edge in edges), key=lambda found: found[1])


def _on_edge(
    columns: np.ndarray, y: np.ndarray, start: tuple[float, float], end: tuple[float, float]
) -> tuple[np.ndarray, float]:
    """Best parameters with (tc, ts) between two corners."""
    begin, way = np.array(start), np.array(end) - np.array(start)
    known = y - columns[:, :2] @ begin
    part, rss = _least_squares(np.column_stack([columns[:, :2] @ way, columns[:, 2:]]), known)
    share = min(max(float(part[0]), 0.0), 1.0)
    rest = part[1:]
    if share != part[0]:
        rest, rss = _least_squares(columns[:, 2:], known - columns[:, :2] @ way * share)
    return np.concatenate([begin + share * way, rest]), rss


def knee_candidates(problem: Problem) -> np.ndarray:
    """Midpoints between neighbouring speeds that leave enough points on both sides."""
    inner = np.unique(problem.x)
    middle = 0.5 * (inner[1:] + inner[:-1])
    below = np.searchsorted(problem.x, middle, side="right")
    return middle[(below >= MIN_PER_STAGE) & (len(problem.x) - below >= MIN_PER_STAGE)]


def _best_ws(problem: Problem, knee: float, scan: int) -> Fit:
    regression = Regression(problem.form, problem.x, knee)
    if not problem.form.stribeck:
        ws = problem.ws_high
        beta, rss = solve_linear(problem, ws, regression)
        return Fit(problem, beta, ws, knee, rss)

    def cost(log_ws: float) -> float:
        return solve_linear(problem, float(np.exp(log_ws)), regression)[1]

    grid = np.linspace(np.log(problem.ws_low), np.log(problem.ws_high), scan)
    costs = np.array([cost(g) for g in grid])
    found = [(float(costs[k]), float(grid[k])) for k in (0, scan - 1)]
    minima = [k for k in range(scan) if costs[k] <= costs[max(k - 1, 0)] and costs[k] <= costs[min(k + 1, scan - 1)]]
    for k in sorted(minima, key=lambda k: costs[k])[:3]:
        limits = (float(grid[max(k - 1, 0)]), float(grid[min(k + 1, scan - 1)]))
        refined = minimize_scalar(cost, bounds=limits, method="bounded", options={"xatol": 1e-9})
        found.append((float(refined.fun), float(refined.x)))
    ws = float(np.exp(min(found)[1]))
    beta, rss = solve_linear(problem, ws, regression)
    return Fit(problem, beta, ws, knee, rss)


def project(problem: Problem, *, search_knee: bool = False) -> Fit:
    """The best fit there is, within the limits of the problem."""
    if not (search_knee and problem.form.cubic):
        return _best_ws(problem, problem.knee, SCAN)
    candidates = knee_candidates(problem)
    if not len(candidates):
        return _best_ws(problem, problem.knee, SCAN)
    step = max(1, len(candidates) // 25)
    coarse = {k: _best_ws(problem, float(candidates[k]), 12) for k in range(0, len(candidates), step)}
    for k in sorted(coarse, key=lambda k: coarse[k].rss)[:3]:
        for near in range(max(0, k - step + 1), min(len(candidates), k + step)):
            if near not in coarse:
                coarse[near] = _best_ws(problem, float(candidates[near]), 12)
    best = sorted(coarse.values(), key=lambda fit: fit.rss)[:4]
    return min((_best_ws(problem, fit.knee, SCAN) for fit in best), key=lambda fit: fit.rss)


# --- polish; its vector is the particle of `swarm`: [ts, tc / ts, log ws, tv], then the coefficients of the cubic ---


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
        return root * (unpack(vector).torque_Nm(problem.x) - problem.y_Nm)

    root = np.sqrt(problem.weight)
    found = least_squares(
        residual, np.clip(start, lower + margin, upper - margin), bounds=(lower, upper), x_scale=upper - lower,
        xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=400,
    )  # fmt: skip
    polished = unpack(found.x)
    rss = float(2.0 * found.cost)
    return Fit(problem, polished.beta, polished.ws, knee, rss) if rss < fit.rss else fit


# --- which points and which model to believe ---

NOISE_EXPONENT_MAX = 2.0
_SIGNIFICANT = 3.84  # twice the gain of log-likelihood that one parameter without effect seldom reaches
_LEAST_FRICTION = 0.05  # of the greatest: below, the noise is not taken to vanish with the friction

MAX_OUTLIERS = 0.2  # of a direction's points: beyond, it is the model that does not fit
_TIE = 1.01  # held-out errors within 1 % count as equal, then fewer parameters win


def _noise_scale(fit: Fit, exponent: float) -> np.ndarray:
    size = np.abs(fit.torque_Nm(fit.problem.x))
    return np.asarray(np.maximum(size / np.max(size), _LEAST_FRICTION) ** exponent)


def noise_exponent(fits: Sequence[Fit]) -> float:
    """g of the noise's standard deviation ~ |friction|^g, of all directions together: 0 = the same everywhere.

    Maximum likelihood over the residuals, each divided by what its leverage leaves of it and counted for as many as
    there are degrees of freedom; 0 unless that is significantly better.
    """
    residual, size = [], []
    for fit in fits:
        root = np.sqrt(fit.problem.weight)
        columns = root[:, None] * basis(fit.problem.form, fit.problem.x, fit.ws, fit.knee)
        leverage = np.sum(np.linalg.qr(columns)[0] ** 2, axis=1)
        residual.append(fit.residual_Nm / np.sqrt(1.0 - np.minimum(leverage, 0.9)))
        size.append(_noise_scale(fit, 1.0) * np.max(np.abs(fit.torque_Nm(fit.problem.x))))
    free = 1.0 - sum(fit.problem.form.parameters for fit in fits) / sum(len(each) for each in residual)
    r, log_size = np.concatenate(residual), np.log(np.concatenate(size))
    if not np.any(r):
        return 0.0

    def surprise(exponent: float) -> float:  # minus twice the log-likelihood, but for a constant
        each = np.log(np.mean((r * np.exp(-exponent * log_size)) ** 2)) + 2.0 * exponent * np.mean(log_size)
        return float(max(free, 0.0) * len(r) * each)

    found = minimize_scalar(surprise, bounds=(0.0, NOISE_EXPONENT_MAX), method="bounded")
    return float(found.x) if surprise(0.0) - found.fun > _SIGNIFICANT else 0.0


def with_noise(fit: Fit, exponent: float) -> Problem:
    """The problem of a fit with weights for noise that goes with a power of the friction."""
    weight = _noise_scale(fit, exponent) ** -2.0
    return replace(fit.problem, weight=weight / np.mean(weight))


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
        root = np.sqrt(problem.weight)
        residual = root * (problem.y_Nm - columns @ fit.beta)
        orthonormal = np.linalg.qr((root[:, None] * columns)[~out])[0]
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


def points_beyond(problem: Problem, beyond: np.ndarray, threshold: float) -> np.ndarray:
    """By how many standard deviations each of `beyond` (bool (N,)) misses the curve of the others; empty: by chance.

    Chow's test of a few points that were not in the fit, at 1 %: too few for a stage of their own, they would bend
    the whole curve, or be taken for single outliers.  The others' own outliers (`threshold` of `find_outliers`) do not
    count.
    """
    low = problem.part(~beyond)
    low = low.part(~find_outliers(low, threshold)[0])
    free, count = len(low.x) - low.form.parameters, int(np.count_nonzero(beyond))
    if free < low.form.parameters:
        return np.zeros(0)
    alone, rest = project(low), problem.part(beyond)
    both = replace(
        low, x=np.append(low.x, rest.x), y_Nm=np.append(low.y_Nm, rest.y_Nm), weight=np.append(low.weight, rest.weight)
    )
    variance = max(alone.rss / free, (1e-6 * float(np.max(np.abs(problem.y_Nm)))) ** 2)
    if (project(both).rss - alone.rss) / count <= variance * float(stats.f.ppf(0.99, count, free)):
        return np.zeros(0)
    return np.asarray((rest.y_Nm - alone.torque_Nm(rest.x)) / np.sqrt(variance))


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


def with_form(problem: Problem, form: Form, static_max_Nm: float | None = None) -> Problem:
    """The same points with another model; `static_max_Nm` as of `make_problem`."""
    knee = problem.knee if form.cubic else 1.0
    limit = problem.static_max_Nm
    if form.cubic != problem.form.cubic and static_max_Nm is None:
        limit = static_limit_Nm(form, problem.x, problem.y_Nm, knee)
    return replace(problem, form=form, knee=knee, static_max_Nm=limit)


def choose(held_out_rmse_Nm: dict[str, float]) -> str:
    """The model of least held-out error; among equals (1 %) the one with the fewest parameters."""
    best = min(held_out_rmse_Nm.values())
    good = [name for name, value in held_out_rmse_Nm.items() if value <= _TIE * best]
    return min(good, key=lambda name: (FORMS[name].parameters, held_out_rmse_Nm[name]))


# --- What the data determine and what not: 95 % intervals of the parameters and a band around the curve ---
# Profile likelihood (Bates and Watts 1988): an interval holds every value for which the best fit with that value is
# not significantly worse (F test).  Given the Stribeck speed ws the model is linear, so that the set is an ellipsoid
# there; the interval of a linear parameter or of the curve at a speed is what these ellipsoids reach over all ws.
# Limits of parameters cut the intervals.  Independent errors are assumed, whose standard deviation is the same
# everywhere or goes with a power of the friction (the weights of the problem).  Not covered: errors of the model
# itself, and the choice of the knee.


LEVEL = 0.95
PROFILE_POINTS = 120  # of the search for the ends of ws
ELLIPSOIDS = 41  # values of ws between them, over which the other intervals are taken
# the F test of a searched ws errs by a share that falls with the points (Bartlett); counted, tests/bench
_SEARCHED = 4.0
_ALIKE = 0.99  # of the F distribution: variances of the two directions up to it count as equal
_WEAK = 0.5  # half-width of the interval relative to the value, from which on a parameter counts as not determined
NAMES = ("tc", "ts", "ws", "tv", "a0", "a1", "a2", "a3")


@dataclass(frozen=True)
class Interval:
    """One parameter in physical units (mirrored, rad/s and motor Nm); `weak` says why, or is empty."""

    name: str
    value: float
    low: float
    high: float
    weak: str = ""


@dataclass(frozen=True)
class _Ellipsoid:
    """The linear parameters that fit well enough for one ws: |root^-1 (beta - middle)| <= 1."""

    ws: float
    middle: np.ndarray
    root: np.ndarray

    def reach(self, functional: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest value of `functional` (M, p) times the parameters."""
        value = functional @ self.middle
        half = np.linalg.norm(functional @ self.root, axis=1)
        return value - half, value + half


@dataclass(frozen=True)
class Uncertainty:
    intervals: dict[str, Interval]
    ellipsoids: tuple[_Ellipsoid, ...]

    def band_Nm(self, fit: Fit, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end of the pointwise 95 % band of the curve [Nm] at normalised speeds."""
        form = fit.problem.form
        parts = [each.reach(basis(form, x, each.ws, fit.knee)) for each in self.ellipsoids]
        curve = fit.torque_Nm(x)
        return np.min([curve, *(low for low, _ in parts)], axis=0), np.max([curve, *(up for _, up in parts)], axis=0)


def _values(found: Branch) -> np.ndarray:
    return np.array([found.coulomb_Nm, found.static_Nm, found.stribeck_radps, found.viscous_Nmspr, *found.cubic])


def _functionals(fit: Fit, ws: float) -> np.ndarray:
    """What the physical parameters are of the linear ones at a ws, shape (8, p); that of ws itself is zero."""
    form, top, none = fit.problem.form, fit.problem.top_radps, np.zeros_like(fit.beta)
    offset = _values(branch(form, none, ws, fit.knee, top))
    columns = [_values(branch(form, unit, ws, fit.knee, top)) - offset for unit in np.eye(len(none))]
    return np.column_stack(columns)


def _at_limits(fit: Fit) -> dict[str, str]:
    """Parameters that lie on a limit, with a word on it."""
    problem, form, why = fit.problem, fit.problem.form, {}
    tolerance = 1e-6 * problem.static_max_Nm
    tc = fit.beta[0]
    if form.stribeck:
        ts = fit.beta[1]
        if ts - tc <= tolerance:
            why["ts"], why["ws"] = "no Stribeck effect found (ts = tc)", "without effect (ts = tc)"
        if problem.static_max_Nm - ts <= tolerance:
            why["ts"] = f"at its limit {problem.static_max_Nm:.3g} Nm"
        for limit in (problem.ws_low, problem.ws_high):
            if abs(np.log(fit.ws / limit)) < 1e-3:
                why["ws"] = f"at its limit {limit * problem.top_radps:.3g} rad/s"
    if tc <= tolerance:
        why["tc"] = "at its limit 0"
    return why


def _ws_ends(fit: Fit, worst: float) -> tuple[float, float, tuple[bool, bool]]:
    """Least and greatest ws whose best fit has at most the error `worst`, and whether the data bound them."""
    problem, regression = fit.problem, Regression(fit.problem.form, fit.problem.x, fit.knee)

    def excess(log_ws: float) -> float:
        return solve_linear(problem, float(np.exp(log_ws)), regression)[1] - worst

    scan = np.append(np.linspace(np.log(problem.ws_low), np.log(problem.ws_high), PROFILE_POINTS), np.log(fit.ws))
    scan.sort()
    inside = np.array([excess(at) <= 0.0 for at in scan])
    inside[np.searchsorted(scan, np.log(fit.ws))] = True
    first, last = np.flatnonzero(inside)[[0, -1]]

    def between(outside: int, within: int) -> float:
        if not 0 <= outside < len(scan) or excess(scan[within]) > 0.0:  # the latter: no error left to compare
            return float(scan[within])
        return float(brentq(excess, scan[outside], scan[within], xtol=1e-6))

    low, high = between(first - 1, first), between(last + 1, last)
    return float(np.exp(low)), float(np.exp(high)), (first > 0, bool(last < len(scan) - 1))


def _ellipsoid(fit: Fit, ws: float, worst: float) -> _Ellipsoid | None:
    """None where no linear parameters are good enough; those of the fit itself always are."""
    root = np.sqrt(fit.problem.weight)
    columns = root[:, None] * basis(fit.problem.form, fit.problem.x, ws, fit.knee)
    u, s, v = np.linalg.svd(columns, full_matrices=False)
    seen = s > 1e-10 * s[0]
    share = u[:, seen].T @ (root * fit.problem.y_Nm)
    middle = v[seen].T @ (share / s[seen])
    rest = worst - float(np.sum((root * fit.problem.y_Nm - columns @ middle) ** 2))
    if rest < 0.0 and ws != fit.ws:
        return None
    return _Ellipsoid(ws, middle, v[seen].T / s[seen] * np.sqrt(max(rest, 0.0)))


@dataclass(frozen=True)
class Noise:
    """Variance of one point [Nm2], but for the weights, and from how many degrees of freedom it is known."""

    variance_Nm2: float
    freedom: int


def noise_of(fits: Sequence[Fit]) -> list[Noise]:
    """The noise of each direction: of both together, unless they differ significantly."""
    free = [max(len(fit.problem.x) - fit.problem.form.parameters, 1) for fit in fits]
    own = [Noise(fit.rss / count, count) for fit, count in zip(fits, free, strict=True)]
    most, least = (pick(own, key=lambda noise: noise.variance_Nm2) for pick in (max, min))
    if most.variance_Nm2 > least.variance_Nm2 * stats.f.ppf(_ALIKE, most.freedom, least.freedom):
        return own
    freedom = sum(noise.freedom for noise in own)
    return [Noise(sum(fit.rss for fit in fits) / freedom, freedom)] * len(own)


def uncertainty(fit: Fit, noise: Noise) -> Uncertainty:
    """Intervals of every parameter of one direction."""
    problem, form = fit.problem, fit.problem.form
    correction = 1.0 + (_SEARCHED / len(problem.x) if form.stribeck else 0.0)
    worst = fit.rss + correction * noise.variance_Nm2 * float(stats.f.ppf(LEVEL, 1, noise.freedom))
    ends, bounded = (fit.ws, fit.ws), (True, True)
    if form.stribeck:
        least, most, bounded = _ws_ends(fit, worst)
        ends = (least, most)
    scan = np.unique(np.append(np.geomspace(*ends, ELLIPSOIDS), fit.ws)) if ends[1] > ends[0] else [fit.ws]
    found = [_ellipsoid(fit, float(ws), worst) for ws in scan]
    ellipsoids = tuple(each for each in found if each is not None)
    values = _values(fit.branch())
    reached = np.array([each.reach(_functionals(fit, each.ws)) for each in ellipsoids])
    low = np.min([values, *reached[:, 0]], axis=0)
    high = np.max([values, *reached[:, 1]], axis=0)
    at_ws = NAMES.index("ws")
    low[at_ws], high[at_ws] = (end * problem.top_radps for end in ends)
    low[:2] = np.maximum(low[:2], 0.0)  # friction is not negative
    if form.stribeck:
        high[:2] = np.minimum(high[:2], np.maximum(problem.static_max_Nm, values[:2]))
    why = _at_limits(fit)
    used = {"tc", *(("ts", "ws") if form.stribeck else ()), *(("tv",) if form.viscous else ())}
    used |= {"a0", "a1", "a2", "a3"} if form.cubic else set()
    intervals = {}
    for k, name in enumerate(NAMES):
        if name in used:
            ends_of = (float(values[k]), float(low[k]), float(high[k]))
            weak = why.get(name) or (_weak_ws(ends, bounded) if name == "ws" else _weak(name, *ends_of))
            intervals[name] = Interval(name, *ends_of, weak)
    return Uncertainty(intervals, ellipsoids)


def _weak_ws(ends: tuple[float, float], bounded: tuple[bool, bool]) -> str:
    open_ends = [word for word, known in zip(("below", "above"), bounded, strict=True) if not known]
    if open_ends:
        return f"not bounded {' and '.join(open_ends)} by the data"
    return f"uncertain by a factor of {ends[1] / ends[0]:.1f}" if ends[1] / ends[0] > 3.0 else ""


def _weak(name: str, value: float, low: float, high: float) -> str:
    width = max(high - value, value - low)
    if width <= _WEAK * abs(value):
        return ""
    if low <= 0.0 <= high and name not in ("tc", "ts"):
        return "not distinguishable from 0"
    return f"uncertain by {width / abs(value):.0%}" if value else "uncertain"
