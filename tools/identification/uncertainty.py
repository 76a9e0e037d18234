"""What the data determine and what not: 95 % intervals of the parameters and a band around the curve.

Linearised (Wald): from the Jacobian at the minimum, with the residual variance and Student's t.  Parameters that lie
on a limit are held there.  For the Stribeck speed also the profile likelihood: all ws for which the best fit with
that ws is not significantly worse (F test), which is right also where the problem is far from linear (Bates and Watts
1988).  Independent errors of equal variance are assumed; errors of the model itself are not covered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from jointctl.tools.identification.fit import Fit, solve_linear
from jointctl.tools.identification.models import Branch, basis, branch

LEVEL = 0.95
PROFILE_POINTS = 120
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
class Uncertainty:
    intervals: dict[str, Interval]
    covariance: np.ndarray  # of (linear parameters, log ws); zero where held
    t_value: float

    def band_Nm(self, fit: Fit, x: np.ndarray) -> np.ndarray:
        """Half-width of the pointwise 95 % band of the curve [Nm] at normalised speeds."""
        gradient = _gradient(fit, x)
        variance = np.einsum("ij,jk,ik->i", gradient, self.covariance, gradient)
        return self.t_value * np.sqrt(np.maximum(variance, 0.0))


def _gradient(fit: Fit, x: np.ndarray) -> np.ndarray:
    """d curve / d (linear parameters, log ws), shape (N, p + 1)."""
    form = fit.problem.form
    columns = basis(form, x, fit.ws, fit.knee)
    if not form.stribeck:
        return np.column_stack([columns, np.zeros(len(x))])
    step = 1e-5
    upper, lower = fit.ws * np.exp(step), fit.ws * np.exp(-step)
    by_ws = (basis(form, x, upper, fit.knee) - basis(form, x, lower, fit.knee)) @ fit.beta / (2.0 * step)
    return np.column_stack([columns, by_ws])


def _values(found: Branch) -> np.ndarray:
    return np.array([found.coulomb_Nm, found.static_Nm, found.stribeck_radps, found.viscous_Nmspr, *found.cubic])


def _physical_jacobian(fit: Fit) -> np.ndarray:
    """d (tc, ts, ws, tv, a0..a3) / d (linear parameters, log ws); differences, exact for the linear ones."""

    def at(beta: np.ndarray, log_ws: float) -> np.ndarray:
        found = branch(fit.problem.form, beta, float(np.exp(log_ws)), fit.knee, fit.problem.top_radps)
        return _values(found)

    base, columns = np.log(fit.ws), []
    for k in range(len(fit.beta)):
        step = np.zeros_like(fit.beta)
        step[k] = 1e-3
        columns.append((at(fit.beta + step, base) - at(fit.beta - step, base)) / 2e-3)
    columns.append((at(fit.beta, base + 1e-5) - at(fit.beta, base - 1e-5)) / 2e-5)
    return np.column_stack(columns)


def _limits(fit: Fit) -> tuple[np.ndarray, dict[str, str]]:
    """Directions in which the parameters are free, shape (p + 1, f), and why the others are not."""
    problem, form = fit.problem, fit.problem.form
    size = len(fit.beta) + 1
    directions, why = np.eye(size), {}
    tolerance = 1e-6 * problem.static_max_Nm
    held = []
    if not form.stribeck:
        held.append(size - 1)
        if fit.beta[0] <= tolerance:
            held, why = [*held, 0], {"tc": "at its limit 0"}
        return np.delete(directions, held, axis=1), why
    tc, ts = fit.beta[0], fit.beta[1]
    if ts - tc <= tolerance:
        why["ts"], why["ws"] = "no Stribeck effect found (ts = tc)", "without effect (ts = tc)"
        directions[1, 0] = 1.0
        held += [1, size - 1]
    if tc <= tolerance:
        why["tc"] = "at its limit 0"
        held.append(0)
    if problem.static_max_Nm - ts <= tolerance:
        why["ts"] = f"at its limit {problem.static_max_Nm:.3g} Nm"
        held.append(1)
    for limit in (problem.ws_low, problem.ws_high):
        if abs(np.log(fit.ws / limit)) < 1e-3:
            why["ws"] = f"at its limit {limit * problem.top_radps:.3g} rad/s"
            held.append(size - 1)
    return np.delete(directions, sorted(set(held)), axis=1), why


def uncertainty(fit: Fit) -> Uncertainty:
    """Intervals of every parameter of one direction."""
    problem, form = fit.problem, fit.problem.form
    free, why = _limits(fit)
    freedom = max(len(problem.x) - free.shape[1], 1)
    variance = fit.rss / freedom
    t_value = float(stats.t.ppf(0.5 + 0.5 * LEVEL, freedom))
    jacobian = _gradient(fit, problem.x) @ free
    # pinv: directions that the data do not see at all get no variance here, but the profile shows them
    covariance = free @ np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-13, hermitian=True) @ free.T * variance
    transform = _physical_jacobian(fit)
    half = t_value * np.sqrt(np.maximum(np.diag(transform @ covariance @ transform.T), 0.0))
    values = _values(fit.branch())
    profile_ws, profile_rss = _profile(fit)
    used = {"tc", *(("ts", "ws") if form.stribeck else ()), *(("tv",) if form.viscous else ())}
    used |= {"a0", "a1", "a2", "a3"} if form.cubic else set()
    intervals = {}
    for name, value, width in zip(NAMES, values, half, strict=True):
        if name not in used:
            continue
        low, high, weak = value - width, value + width, why.get(name, "")
        if name == "ws":
            inside = profile_rss <= fit.rss * (1.0 + float(stats.f.ppf(LEVEL, 1, freedom)) / freedom)
            chosen = np.concatenate([profile_ws[inside], [value]])
            low, high = float(chosen.min()), float(chosen.max())
            open_ends = [e for e, at in (("below", 0), ("above", -1)) if inside[at]]
            if not weak and open_ends:
                weak = f"not bounded {' and '.join(open_ends)} by the data"
            if not weak and high / low > 3.0:
                weak = f"uncertain by a factor of {high / low:.1f}"
        elif not weak and width > _WEAK * abs(value):
            zero = width > abs(value) and name not in ("tc", "ts")
            weak = "not distinguishable from 0" if zero else f"uncertain by {width / abs(value):.0%}"
        if name in ("tc", "ts"):  # friction is not negative
            low = max(low, 0.0)
        intervals[name] = Interval(name, float(value), float(low), float(high), weak)
    return Uncertainty(intervals, covariance, t_value)


def _profile(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Squared error of the best fit for each given ws, from limit to limit; joint rad/s."""
    problem = fit.problem
    if not problem.form.stribeck:
        return np.empty(0), np.empty(0)
    scan = np.geomspace(problem.ws_low, problem.ws_high, PROFILE_POINTS)
    errors = np.array([solve_linear(problem, float(ws), fit.knee)[1] for ws in scan])
    return scan * problem.top_radps, errors
