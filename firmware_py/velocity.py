"""Velocity from position differences with a first-order low-pass.

The filter lags, and a velocity error e' = filter(q') - q_d' then carries the lag of q' but not of q_d', which an
integrating law absorbs as a bias.  `error_rate_radps` is the matched version: the difference quotient of e = q - q_d
sent as a whole through the same filter."""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import VelocityConstants, VelocityState


@kernel
def low_pass_gain(cutoff_Hz: float, interval_s: float) -> float:
    """Weight of the new value in one step of the exactly discretised first-order low-pass; 1 = no filter."""
    if cutoff_Hz <= 0.0:
        return 1.0
    return 1.0 - math.exp(-2.0 * math.pi * cutoff_Hz * interval_s)


@kernel
def step_velocity(
    constants: VelocityConstants, state: VelocityState, position_rad: float, error_rad: float, elapsed_cycles: int
) -> None:
    """Take a sample that came `elapsed_cycles` (>= 1) periods after the last one; the first one only primes."""
    if state.primed == 0:
        state.primed = 1
        state.velocity_radps = 0.0
        state.error_rate_radps = 0.0
    else:
        interval_s = elapsed_cycles * constants.period_s
        if elapsed_cycles == 1:
            gain = constants.period_gain
        else:
            gain = low_pass_gain(constants.cutoff_Hz, interval_s)
        state.velocity_radps += gain * ((position_rad - state.last_position_rad) / interval_s - state.velocity_radps)
        state.error_rate_radps += gain * ((error_rad - state.last_error_rad) / interval_s - state.error_rate_radps)
    state.last_position_rad = position_rad
    state.last_error_rad = error_rad
