"""The plant of the linear loop between two samples: delay, zero-order hold, current lag, rigid joint.

    command -> delay d >= 0 -> hold -> 1/(lag s + 1) -> 1/(J s^2) -> sampled joint angle

Discretised exactly: the command of sample k acts from kT + d on, and the part of d inside a period splits that period
in two (Astrom and Wittenmark, Computer-Controlled Systems, section 2.6).

Not modelled: friction, gravity, flexibility, limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class StateSpace:
    """x <- a x + b input, output = c x + d input; a (n, n), b (n,), c (n,), one input, one output."""

    a: Array
    b: Array
    c: Array
    d: float

    def response(self, z: ComplexArray) -> ComplexArray:
        """Transfer function at the points z, shape (N,)."""
        count = len(self.b)
        if count == 0:
            return np.full(z.shape, self.d, dtype=np.complex128)
        matrices = z[:, None, None] * np.eye(count) - self.a
        solved = np.linalg.solve(matrices, np.broadcast_to(self.b[:, None], (len(z), count, 1)))
        response: ComplexArray = solved[:, :, 0] @ self.c + self.d
        return response


def _hold_step(step_s: float, lag_s: float, inertia_kgm2: float) -> tuple[Array, Array]:
    """(phi, gamma) of x = (q [rad], q' [rad/s], torque [Nm]) over `step_s` under a constant command, in closed form."""
    if step_s == 0.0:
        return np.eye(3), np.zeros(3)
    rest = math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
    impulse = lag_s * (1.0 - rest)  # integral of what is left of the old torque
    travel = lag_s * (step_s - impulse)  # integral of that
    phi = np.array(
        [[1.0, step_s, travel / inertia_kgm2], [0.0, 1.0, impulse / inertia_kgm2], [0.0, 0.0, rest]], dtype=np.float64
    )
    gamma = np.array(
        [(0.5 * step_s**2 - travel) / inertia_kgm2, (step_s - impulse) / inertia_kgm2, 1.0 - rest], dtype=np.float64
    )
    return phi, gamma


@dataclass(frozen=True)
class SampledJoint:
    """x(k+1) = phi x(k) + late u(k - whole) + early u(k - whole - 1); q is the first state."""

    phi: Array
    late: Array
    early: Array
    whole: int  # whole periods of delay

    def response(self, z: ComplexArray) -> ComplexArray:
        """q over u [rad/Nm] at the points z; the delay line is a power of z, so that it costs nothing."""
        first = np.array([1.0, 0.0, 0.0])
        late = StateSpace(self.phi, self.late, first, 0.0).response(z)
        early = StateSpace(self.phi, self.early, first, 0.0).response(z)
        response: ComplexArray = (late + early / z) / z**self.whole
        return response

    def state_space(self) -> StateSpace:
        """The same with the delay line as states: x, u(k-1), u(k-2), ..."""
        line = self.whole + (1 if np.any(self.early) else 0)
        size = 3 + line
        a, b = np.zeros((size, size)), np.zeros(size)
        a[:3, :3] = self.phi
        for taps, back in ((self.late, self.whole), (self.early, self.whole + 1)):
            if back == 0:
                b[:3] += taps
            elif back <= line:
                a[:3, 2 + back] += taps
        if line:
            b[3] = 1.0
            for i in range(1, line):
                a[3 + i, 2 + i] = 1.0
        return StateSpace(a, b, np.eye(size)[0], 0.0)


def sampled_joint(period_s: float, delay_s: float, lag_s: float, inertia_kgm2: float) -> SampledJoint:
    """Delay, hold, lag and joint over one period, exactly."""
    whole = math.floor(delay_s / period_s + 1e-9)  # 0.003 / 0.001 is a little below 3
    fraction_s = max(delay_s - whole * period_s, 0.0)
    if fraction_s < 1e-9 * period_s:
        fraction_s = 0.0
    phi_old, gamma_old = _hold_step(fraction_s, lag_s, inertia_kgm2)
    phi_new, gamma_new = _hold_step(period_s - fraction_s, lag_s, inertia_kgm2)
    return SampledJoint(phi_new @ phi_old, gamma_new, phi_new @ gamma_old, whole)
