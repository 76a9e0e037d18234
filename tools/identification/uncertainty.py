"""What the data determine and what not: 95 % intervals of the parameters and a band around the curve.

Profile likelihood (Bates and Watts 1988): an interval holds every value for which the best fit with that value is not
significantly worse (F test).  Given the Stribeck speed ws the model is linear, so that the set is an ellipsoid there;
the interval of a linear parameter or of the curve at a speed is what these ellipsoids reach over all ws.  Limits of
parameters cut the intervals.  Independent errors are assumed, whose standard deviation is the same everywhere or goes
with a power of the friction (the weights of the problem).  Not covered: errors of the model itself, and the choice
of the knee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from jointctl.tools.identification.fit import Fit, solve_linear
from jointctl.tools.identification.models import Branch, basis, branch

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
    problem = fit.problem

    def excess(log_ws: float) -> float:
        return solve_linear(problem, float(np.exp(log_ws)), fit.knee)[1] - worst

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
    own = [Noise(fit.rss / free, free) for fit in fits for free in (_freedom(fit),)]
    most, least = (pick(own, key=lambda noise: noise.variance_Nm2) for pick in (max, min))
    if most.variance_Nm2 > least.variance_Nm2 * stats.f.ppf(_ALIKE, most.freedom, least.freedom):
        return own
    freedom = sum(noise.freedom for noise in own)
    return [Noise(sum(fit.rss for fit in fits) / freedom, freedom)] * len(own)


def _freedom(fit: Fit) -> int:
    return max(len(fit.problem.x) - fit.problem.form.parameters, 1)


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
