"""The virtual drive's current loop and motor: target torque in, delivered joint torque out.

Delay, then limit, then a first-order lag with the exact discrete step (the target is held over a substep), then
``n K_m i`` (2) plus torque ripple.  The ripple does not depend on the current: it is the cogging of the motor and
the error of the reducer, and it is there with the power off.

Not modelled: voltage limit, back-EMF, the current loop's own dynamics beyond one pole, i^2 t limits.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import inlined
from jointctl.hil.plant.records import DELAY_SLOTS, PlantConstants, PlantState


@inlined
def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns), absolute error below 2e-11; range reduction in turns is exact, without branch or library call.

    Half a turn either way is r (1/4 - r^2) P(r^2), P of degree 6 fitted for the least maximum error.  Several times as
    fast as libm, which matters for three ripples in each of two million substeps; the plant needs no more than 1e-6.
    """
    r = turns - np.rint(turns)
    y = r * r
    y2 = y * y
    low = (25.1327412271771 - y * 64.8358437584691) + y2 * (67.0776056610595 - y * 38.5126054685551)
    high = (14.1788906187473 - y * 3.62170359416296) + y2 * 0.614277835548814
    return r * (0.25 - y) * (low + y2 * y2 * high)


@inlined
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


@inlined
def torque_ripple_Nm(c: PlantConstants, motor_position_rad: float) -> float:
    """Ripple torque at the joint; `motor_position_rad` is the motor angle / n, the orders are per joint turn."""
    ripple = 0.0
    for i in range(c.torque_ripples):
        turns = motor_position_rad * c.torque_ripple_turns_prad[i] + c.torque_ripple_phase_turns[i]
        ripple += c.torque_ripple_Nm[i] * sine_of_turns(turns)
    return ripple
