"""Does iterative learning converge?  The factor by which one repetition multiplies what is still to be learned.

Linearised like `linear_loop`, a torque u that is fed forward moves the joint by G u, G = P / (1 + L), and takes T u,
T = L / (1 + L), off feedback and observer.  The next repetition feeds forward (see `firmware_py.iterative_learning`)

    u_next = S (u + gain z^lead (correction - J error_gain e))   =>   u_next - u* = M (u - u*)
    M(omega) = S (1 - gain z^lead (T + J error_gain G)),   S = the smoothing, a mean over 2 half_width + 1 cycles

|M| < 1 at every frequency is enough for convergence; where |M| > 1 a ripple of that frequency grows from one
repetition to the next.  The share of the disturbance that remains for ever is |1 - S| / |1 - M|.

Neglected: the observer compares the learned torque with a command that is some cycles older, and the friction, which
damps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jointctl.tools.analysis.linear_loop import Array, LoopSettings, linear_loop
from jointctl.tools.analysis.margins import frequencies_radps
from jointctl.tools.configuration.sections import Learning


@dataclass(frozen=True)
class Convergence:
    """`worst_factor` < 1: every repetition is better than the one before, by this factor at the worst frequency."""

    worst_factor: float
    worst_Hz: float
    remaining_1_Hz: float  # share of a disturbance at 1 Hz that stays in the end


def repetition_factor(settings: LoopSettings, learning: Learning, omega_radps: Array) -> tuple[Array, Array]:
    """(|M|, |1 - S| / |1 - M|) at these frequencies [rad/s], arrays (N,)."""
    loop = linear_loop(settings)
    z = np.exp(1j * omega_radps * settings.period_s)
    open_loop = loop.open_loop(omega_radps)
    moved = loop.joint.response(z) / (1.0 + open_loop)
    taken = open_loop / (1.0 + open_loop)
    width = learning.half_width_cycles
    smoothing = np.ones_like(omega_radps)
    for k in range(1, width + 1):
        smoothing = smoothing + 2.0 * np.cos(k * omega_radps * settings.period_s)
    smoothing = smoothing / (2 * width + 1)
    seen = taken + settings.inertia_kgm2 * learning.error_gain_ps2 * moved
    factor = smoothing * (1.0 - learning.gain * z**learning.lead_cycles * seen)
    return np.abs(factor), np.abs(1.0 - smoothing) / np.abs(1.0 - factor)


def learning_convergence(settings: LoopSettings, learning: Learning) -> Convergence:
    """Convergence of this learning on this loop."""
    omega = frequencies_radps(settings.period_s)
    factor, _ = repetition_factor(settings, learning, omega)
    worst = int(np.argmax(factor))
    _, remaining = repetition_factor(settings, learning, np.array([math.tau]))
    return Convergence(float(factor[worst]), float(omega[worst]) / math.tau, float(remaining[0]))
