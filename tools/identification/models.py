"""The friction models that can be identified, as linear regressions once Stribeck speed and knee are given.

Per direction, mirrored, with x = u / top in (0..1] (top = highest speed measured) so that all columns are of order 1:

    multi-stage              x <= knee: tc (1 - e) + ts e + tv x,  e = exp(-x / ws);  beyond: c0 P0 + .. + c3 P3   (11)
    multi-stage-continuous   the same with c0 such that both stages meet at the knee (C0)
    stribeck                 the first stage over the whole range
    coulomb-viscous          tc + tv x
    coulomb                  tc

P0..P3 are Legendre polynomials on [knee..1].  In plain powers of the speed the columns of the cubic are nearly
parallel and a particle swarm does not find the minimum; in Legendre polynomials it does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.firmware_py.friction import PrintedBranch, branch_constants, branch_torque_Nm

MIN_PER_STAGE = 5  # points; a stage has four parameters


@dataclass(frozen=True)
class Form:
    """What a model consists of."""

    name: str
    viscous: bool
    stribeck: bool
    cubic: bool
    continuous: bool = False

    @property
    def linear_names(self) -> tuple[str, ...]:
        """The linear parameters, in the order of the columns of `basis`."""
        low = ("tc", *(("ts",) if self.stribeck else ()), *(("tv",) if self.viscous else ()))
        high = ("c1", "c2", "c3") if self.continuous else ("c0", "c1", "c2", "c3")
        return low + (high if self.cubic else ())

    @property
    def parameters(self) -> int:
        """Number of parameters of one direction, a given knee not counted."""
        return len(self.linear_names) + int(self.stribeck)


FORMS = {
    form.name: form
    for form in (
        Form("multi-stage", viscous=True, stribeck=True, cubic=True),
        Form("multi-stage-continuous", viscous=True, stribeck=True, cubic=True, continuous=True),
        Form("stribeck", viscous=True, stribeck=True, cubic=False),
        Form("coulomb-viscous", viscous=True, stribeck=False, cubic=False),
        Form("coulomb", viscous=False, stribeck=False, cubic=False),
    )
}


def legendre(x: np.ndarray, knee: float) -> np.ndarray:
    """P0..P3 on [knee..1] at x, shape (N, 4); also defined outside of the interval."""
    z = (2.0 * x - knee - 1.0) / (1.0 - knee)
    return np.column_stack([np.ones_like(z), z, 1.5 * z**2 - 0.5, 2.5 * z**3 - 1.5 * z])


def legendre_to_powers(knee: float) -> np.ndarray:
    """Matrix (4, 4) that turns Legendre coefficients on [knee..1] into a0..a3 of powers of x."""
    s = 2.0 / (1.0 - knee)
    t = -(1.0 + knee) / (1.0 - knee)  # z = t + s x
    z1 = np.array([t, s, 0.0, 0.0])
    z2 = np.array([t * t, 2.0 * t * s, s * s, 0.0])
    z3 = np.array([t**3, 3.0 * t * t * s, 3.0 * t * s * s, s**3])
    one = np.array([1.0, 0.0, 0.0, 0.0])
    return np.column_stack([one, z1, 1.5 * z2 - 0.5 * one, 2.5 * z3 - 1.5 * z1])


def basis(form: Form, x: np.ndarray, ws: float, knee: float) -> np.ndarray:
    """Columns (N, p) of the regression, in the order of `form.linear_names`; ws and knee in units of x."""

    def low(at: np.ndarray) -> np.ndarray:
        decay = np.exp(-at / ws) if form.stribeck else np.zeros_like(at)
        columns = [1.0 - decay]
        if form.stribeck:
            columns.append(decay)
        if form.viscous:
            columns.append(at)
        return np.column_stack(columns)

    if not form.cubic:
        return low(x)
    beyond = x > knee
    first = low(np.where(beyond, knee, x) if form.continuous else x)
    polynomials = legendre(x, knee)
    if form.continuous:
        high = np.where(beyond[:, None], polynomials[:, 1:] - legendre(np.array([knee]), knee)[:, 1:], 0.0)
    else:
        first = np.where(beyond[:, None], 0.0, first)
        high = np.where(beyond[:, None], polynomials, 0.0)
    return np.column_stack([first, high])


@dataclass(frozen=True)
class Branch:
    """One identified direction in physical units, mirrored: joint rad/s, motor Nm.

    Every model is brought into the shape of (11), so that the controller needs one expression: without a cubic
    stage the knee is the highest speed, and beyond it the last slope is held.
    """

    coulomb_Nm: float
    static_Nm: float
    stribeck_radps: float
    viscous_Nmspr: float
    cubic: tuple[float, float, float, float]  # a0..a3 [Nm s^k / rad^k]
    knee_radps: float
    max_radps: float

    def record(self) -> Any:
        """The `FrictionBranch` record."""
        printed = PrintedBranch(
            self.coulomb_Nm, self.static_Nm, self.stribeck_radps, self.viscous_Nmspr, self.cubic, self.knee_radps,
            self.max_radps,
        )  # fmt: skip
        return branch_constants(printed, negative=False, radps_per_unit=1.0)

    def torque_Nm(self, speed_radps: np.ndarray) -> np.ndarray:
        """Friction at the motor [Nm] at speeds >= 0, by the controller's own expression."""
        record = self.record()
        return np.array([branch_torque_Nm(record, float(u)) for u in speed_radps])


def branch(form: Form, beta: np.ndarray, ws: float, knee: float, top_radps: float) -> Branch:
    """Physical parameters from the normalised ones."""
    value = dict(zip(form.linear_names, beta, strict=True))
    tc = value["tc"]
    ts = value.get("ts", tc)
    tv = value.get("tv", 0.0)
    if form.cubic:
        coefficients = np.array([value.get("c0", 0.0), value["c1"], value["c2"], value["c3"]])
        if form.continuous:
            meeting = float((basis(form, np.array([knee]), ws, knee) @ beta)[0])
            coefficients[0] = meeting - float(legendre(np.array([knee]), knee)[0, 1:] @ coefficients[1:])
        powers = legendre_to_powers(knee) @ coefficients
    else:
        knee = 1.0
        decay = np.exp(-1.0 / ws) if form.stribeck else 0.0
        slope = tv - (ts - tc) / ws * decay
        powers = np.array([tc + (ts - tc) * decay + tv - slope, slope, 0.0, 0.0])
    a = tuple(float(c) / top_radps**k for k, c in enumerate(powers))
    # without a Stribeck term its speed has no effect, but the configuration wants a positive one
    return Branch(
        float(tc), float(ts), float(ws) * top_radps, float(tv) / top_radps, (a[0], a[1], a[2], a[3]),
        knee * top_radps, top_radps,
    )  # fmt: skip
