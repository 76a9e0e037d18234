"""The limits of the loop, as pure functions: which fault a value means, what is done about a fault.

Every limit is inclusive: a value equal to the limit is allowed.  A NaN is never allowed.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import LimitConstants, Swing, SwingConstants, SwingState
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, LimitSource, Reaction

# Half swings in a row that are a limit cycle.  On 480 runs of joints that are well there were 2 at most of either kind,
# and 6 that grew.
TORQUE_SWINGS = 4
ERROR_SWINGS = 6
GROWING_SWINGS = 8
GROWTH = 1.05  # from one half swing to the next
REVERSAL_SWINGS = 3  # that friction alone makes of one reversal of the reference: they do not count
REST_STEPS = 8.0  # times the steps of the reading at rest: a smaller swing is the encoder's


@kernel
def within(value: float, low: float, high: float) -> bool:
    """low <= value <= high; False for NaN (every comparison with NaN is false)."""
    return low <= value and value <= high


@kernel
def motion_fault(limits: LimitConstants, position_rad: float, velocity_radps: float, error_rad: float) -> Fault:
    """Fault of the measured motion, in the order position, velocity, following error."""
    if not within(position_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.POSITION_LIMIT
    if not within(velocity_radps, -limits.velocity_max_radps, limits.velocity_max_radps):
        return Fault.VELOCITY_LIMIT
    if not within(error_rad, -limits.following_error_max_rad, limits.following_error_max_rad):
        return Fault.FOLLOWING_ERROR
    return Fault.NONE


@kernel
def limit_position_rad(limits: LimitConstants, law_rad: float, other_rad: float) -> float:
    """The position that the position limits are checked with; of both, the one farther from the middle, or NaN."""
    if limits.limit_source == LimitSource.OTHER:
        return other_rad
    if limits.limit_source == LimitSource.BOTH:
        middle_rad = 0.5 * (limits.position_min_rad + limits.position_max_rad)
        if not abs(other_rad - middle_rad) <= abs(law_rad - middle_rad):
            return other_rad
    return law_rad


@kernel
def encoders_disagree(limits: LimitConstants, law_rad: float, other_rad: float, torque_Nm: float) -> bool:
    """Whether two encoders of one joint differ by more than allowed; a flexible reducer twists under `torque_Nm`."""
    if limits.disagreement_max_rad <= 0.0:
        return False
    allowed_rad = limits.disagreement_max_rad + limits.twist_radpNm * abs(torque_Nm)
    return not abs(law_rad - other_rad) <= allowed_rad


@kernel
def _reset_one(swing: Swing) -> None:
    swing.direction = 0
    swing.low = 0.0
    swing.high = 0.0
    swing.amplitude = 0.0
    swing.count = 0
    swing.growing = 0
    swing.last_cycle = 0
    swing.half_cycles = 0


@kernel
def reset_swing(state: SwingState) -> None:
    """Begin a run: nothing swings, nothing is known of the reading at rest."""
    _reset_one(state.torque)
    _reset_one(state.error)
    _reset_one(state.faint_error)
    state.reference_direction = 0
    state.rest_rad = 0.0
    state.rest_position_rad = 0.0
    state.noise_Nm = 0.0
    state.noise_told_Nm = 0.0


@kernel
def step_swing(swing: Swing, value: float, least: float, slowest_cycles: int, cycle: int) -> None:
    """Follow a quantity and count how often in a row it turns, each time by more than `least` from peak to peak.

    It has turned when it has come back by more than `least` from where it was farthest; `amplitude` is the way between
    the two turns before.  Where half a swing takes more than `slowest_cycles`, the count begins anew.
    """
    if swing.direction >= 0:
        swing.high = max(swing.high, value)
    if swing.direction <= 0:
        swing.low = min(swing.low, value)
    fell = swing.direction >= 0 and swing.high - value > least
    rose = swing.direction <= 0 and value - swing.low > least
    if not fell and not rose:
        return
    amplitude = swing.high - swing.low
    swing.half_cycles = cycle - swing.last_cycle
    if swing.half_cycles > slowest_cycles:
        swing.count = 0
        swing.growing = 0
    elif not amplitude >= GROWTH * swing.amplitude:
        swing.growing = 0
    swing.count += 1
    swing.growing += 1
    swing.amplitude = amplitude
    swing.last_cycle = cycle
    if fell:
        swing.direction = -1
        swing.low = value
    else:
        swing.direction = 1
        swing.high = value


@kernel
def _allow_reversal(swing: Swing) -> None:
    """The reference has turned: friction does, and the torque with it."""
    swing.count = max(swing.count - REVERSAL_SWINGS, 0)
    swing.growing = max(swing.growing - REVERSAL_SWINGS, 0)


@kernel
def note_rest(state: SwingState, position_rad: float, moving: bool) -> None:
    """A new sample with the power off: by how much the reading of a joint that stands changes."""
    if moving:
        state.rest_rad = 0.0
    else:
        state.rest_rad = max(state.rest_rad, abs(position_rad - state.rest_position_rad))
    state.rest_position_rad = position_rad


@kernel
def swing_fault(
    limits: LimitConstants,
    state: SwingState,
    torque_Nm: float,
    error_rad: float,
    reference_velocity_radps: float,
    cycle: int,
) -> Fault:
    """LIMIT_CYCLE if the torque reverses between shares of its limits, or an oscillation of the error stays or grows.

    `torque_Nm` is the command without what the desired acceleration asks for.  The error is compared with its limit, or
    with what the reading showed at rest, whichever is more.
    """
    constants = limits.swing
    direction = 0
    if reference_velocity_radps > limits.standstill_radps:
        direction = 1
    elif reference_velocity_radps < -limits.standstill_radps:
        direction = -1
    if direction != 0 and direction != state.reference_direction:
        _allow_reversal(state.torque)
        _allow_reversal(state.error)
        _allow_reversal(state.faint_error)
        state.reference_direction = direction
    if constants.torque_Nm > 0.0:
        step_swing(state.torque, torque_Nm, constants.torque_Nm, constants.slowest_cycles, cycle)
        if state.torque.count >= TORQUE_SWINGS:
            return Fault.LIMIT_CYCLE
    if constants.error_rad > 0.0:
        least_rad = max(constants.error_rad, REST_STEPS * state.rest_rad)
        step_swing(state.error, error_rad, least_rad, constants.slowest_cycles, cycle)
        step_swing(state.faint_error, error_rad, 0.5 * least_rad, constants.slowest_cycles, cycle)
        if state.error.count >= ERROR_SWINGS or state.faint_error.growing >= GROWING_SWINGS:
            return Fault.LIMIT_CYCLE
    return Fault.NONE


@kernel
def swing_Hz(state: SwingState, period_s: float) -> float:
    """Frequency of the swing that has been noticed [Hz]."""
    half_cycles = state.faint_error.half_cycles
    if state.torque.count >= TORQUE_SWINGS:
        half_cycles = state.torque.half_cycles
    elif state.error.count >= ERROR_SWINGS:
        half_cycles = state.error.half_cycles
    return 0.5 / (half_cycles * period_s)


@kernel
def torque_noise(constants: SwingConstants, state: SwingState, change_Nm: float) -> bool:
    """Take the change of the command in this cycle; whether their mean is more than is worth a warning."""
    state.noise_Nm += constants.noise_gain * (abs(change_Nm) - state.noise_Nm)
    return 0.0 < constants.noise_Nm < state.noise_Nm


@kernel
def reference_fault(
    limits: LimitConstants, position_rad: float, velocity_radps: float, brake_radps2: float, ahead_s: float
) -> Fault:
    """Fault of the desired motion: braked `ahead_s` from now, it must come to rest inside the position limits."""
    stop_rad = position_rad + velocity_radps * (ahead_s + 0.5 * abs(velocity_radps) / brake_radps2)
    if not within(position_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.REFERENCE_LIMIT
    if not within(stop_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.REFERENCE_LIMIT
    if not within(velocity_radps, -limits.velocity_max_radps, limits.velocity_max_radps):
        return Fault.REFERENCE_LIMIT
    return Fault.NONE


@kernel
def drive_fault(drive_state: int, enabled_expected: bool, restarts: int) -> Fault:
    """Fault of the drive's own state; a restart first: the drive has lost its configuration."""
    if restarts != 0:
        return Fault.DRIVE_RESTARTED
    if drive_state == DriveState.FAULT or drive_state == DriveState.FAULT_BRAKING:
        return Fault.DRIVE_FAULT
    if enabled_expected and drive_state != DriveState.ENABLED:
        return Fault.DRIVE_NOT_ENABLED
    return Fault.NONE


@kernel
def reaction_to(fault: int, phase: int) -> Reaction:
    """What to do about a fault.

    Off only where the drive does not follow anyway or no torque is applied yet: it drops a gravity load.  A ramp
    only where the measurement and the law can still be trusted.  Everything else is the drive's quick stop.
    """
    if fault == Fault.NONE:
        return Reaction.NONE
    if phase <= AxisPhase.ENABLING or phase >= AxisPhase.QUICK_STOPPING:
        return Reaction.OFF
    if fault == Fault.DRIVE_FAULT or fault == Fault.DRIVE_NOT_ENABLED or fault == Fault.DRIVE_RESTARTED:
        return Reaction.OFF
    if fault == Fault.REFERENCE_LIMIT or fault == Fault.SUPERVISOR_LOST or fault == Fault.OVERRUN:
        return Reaction.RAMP
    return Reaction.QUICK_STOP


@kernel
def limited_torque_Nm(
    limits: LimitConstants, torque_Nm: float, last_torque_Nm: float, period_s: float
) -> tuple[float, bool]:
    """(torque to send [Nm], finite): finite check, torque limit, rate limit, in that order.

    Not finite: zero torque is returned at once, without the rate limit, and the caller must stop the joint.
    """
    if not math.isfinite(torque_Nm):
        return 0.0, False
    limited = min(max(torque_Nm, -limits.torque_max_Nm), limits.torque_max_Nm)
    step = limits.torque_rate_max_Nmps * period_s
    limited = min(max(limited, last_torque_Nm - step), last_torque_Nm + step)
    return limited, True
