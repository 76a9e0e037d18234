"""The virtual drive's current loop and motor: target torque in, delivered joint torque out.

Delay, then limit, then a first-order lag with the exact discrete step (the target is held over a substep), then
``n K_m i`` (2) plus torque ripple.  The ripple does not depend on the current: it is the cogging of the motor and
the error of the reducer, and it is there with the power off.

Not modelled: voltage limit, back-EMF, the current loop's own dynamics beyond one pole, i^2 t limits.
"""

from __future__ import annotations

import numpy as np

from firmware_py.kernel import kernel
from hil.plant.records import DELAY_SLOTS, PlantConstants, PlantState


@kernel
def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns), absolute error below 1e-11; range reduction in turns is exact and there is no library call.

    Taylor series to r^15 on a quarter turn.  Several times as fast as libm, which matters for three ripples in
    each of two million substeps; the plant needs no more than 1e-6.
    """
    r = turns - np.floor(turns + 0.5)
    if r > 0.25:
        r = 0.5 - r
    elif r < -0.25:
        r = -0.5 - r
    x = 6.283185307179586 * r
    y = x * x
    y2 = y * y
    low = (1.0 - y * (1.0 / 6.0)) + y2 * ((1.0 / 120.0) - y * (1.0 / 5040.0))
    high = ((1.0 / 362880.0) - y * (1.0 / 39916800.0)) + y2 * ((1.0 / 6227020800.0) - y * (1.0 / 1307674368000.0))
    return x * (low + y2 * y2 * high)


@kernel
def step_current(c: PlantConstants, s: PlantState, target_joint_torque_Nm: float) -> float:
    """Motor current [A] at the end of this substep, after delay, limit and lag; a NaN target counts as zero."""
    target = target_joint_torque_Nm * c.current_per_torque_ApNm
    limit = c.current_limit_A
    if s.current_capped != 0:
        limit = min(limit, s.current_cap_A)
    if target > limit:
        target = limit
    elif target < -limit:
        target = -limit
    elif target != target:
        target = 0.0
    delay = c.delay_substeps
    if delay > 0:
        slot = s.delay_slot
        oldest = s.delayed_current_A[slot]
        s.delayed_current_A[slot] = target
        target = oldest
        slot += 1
        s.delay_slot = 0 if slot >= delay or slot >= DELAY_SLOTS else slot
    current = target + (s.current_A - target) * c.current_decay
    s.current_A = current
    return current


@kernel
def torque_ripple_Nm(c: PlantConstants, motor_position_rad: float) -> float:
    """Ripple torque at the joint; `motor_position_rad` is the motor angle / n, the orders are per joint turn."""
    ripple = 0.0
    for i in range(c.torque_ripples):
        turns = motor_position_rad * c.torque_ripple_turns_prad[i] + c.torque_ripple_phase_turns[i]
        ripple += c.torque_ripple_Nm[i] * sine_of_turns(turns)
    return ripple
