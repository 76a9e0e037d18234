"""Every limit and supervision of the loop, in the order in which a cycle checks them.

A fault is latched once and never reset; a later one can only make the reaction stronger.  Every limit is inclusive: a
value equal to the limit is allowed.  A NaN is never allowed.  The phases that the reactions lead to: `sequence`.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import load_acquire
from jointctl.firmware_py.motion_records import SetPoint, StreamConstants
from jointctl.firmware_py.observers import REST_STEPS, allow_reversal, note_rest, step_hunting, step_swing, torque_noise
from jointctl.firmware_py.records import (
    AxisConstants,
    AxisState,
    LimitConstants,
    Sample,
    SwingState,
)
from jointctl.firmware_py.states import (
    AxisPhase,
    CommandKind,
    DriveState,
    Fault,
    LimitSource,
    Notice,
    Reaction,
    SetPointProblem,
)
from jointctl.firmware_py.trajectory import cubic, extremes_s

# Half swings in a row that are a limit cycle; on 480 runs of healthy joints 2 at most of either kind, and 6 that grew.
TORQUE_SWINGS = 4
ERROR_SWINGS = 6
GROWING_SWINGS = 8
ROUNDING_radps = 1e-9  # of a desired velocity that is the limit
ROUNDING_rad = 1e-12  # of a desired position: a motion that ends at a limit is not beyond it
LOOK_AHEAD_rad = 1e-5  # at most so much is allowed for the jerk of a desired motion that comes to rest at a limit
REACTION_CYCLES = 2  # between seeing that the reference leaves its limits and the first braked cycle
PUSHED_CYCLES = 20  # at a torque that a healthy joint gives way to: it moves by a milliradian in that time
SHAKEN_CYCLES = 100  # the same, if another joint of the arm was astray when it began, and may be what pushes back
ASTRAY_SHARE = 0.5  # of following_error_max_rad: what such a joint does to the others is not what the model knows
SINKS_SHARE = 0.25  # of following_error_max_rad: a joint without torque that has moved farther is not held by friction
SINKS_TOLERANCES = 4.0  # of a reading that stands still: so far it has moved at least

# one bit for the code of each fault with that reaction
POWER_OFF_FAULTS = sum(1 << fault for fault in Fault if fault.reaction is Reaction.OFF)
RAMP_FAULTS = sum(1 << fault for fault in Fault if fault.reaction is Reaction.RAMP)


# --- What is done about a fault ---


@kernel
def powered(phase: int) -> bool:
    """Whether the loop itself commands torque in this phase."""
    return phase >= AxisPhase.APPROACH and phase <= AxisPhase.RELEASING


@kernel
def reaction_to(fault: int, phase: int) -> Reaction:
    """What to do about a fault, as its row of `Fault` says; off in every phase in which the loop commands no torque."""
    if fault == Fault.NONE:
        return Reaction.NONE
    if not powered(phase) or 1 << fault & POWER_OFF_FAULTS:
        return Reaction.OFF
    if 1 << fault & RAMP_FAULTS:
        return Reaction.RAMP
    return Reaction.QUICK_STOP


@kernel
def enter(state: AxisState, phase: int) -> None:
    """Begin a phase."""
    state.phase = phase
    state.phase_cycle = 0
    state.held_up_cycles = 0
    state.good_samples = 0
    state.missing_samples, state.missed_slots, state.unsent_cycles = 0, 0, 0
    state.ready = 0


@kernel
def react(state: AxisState, reaction: int) -> None:
    """Go forward to the phase of the reaction; never weakens the one in force."""
    if reaction <= state.reaction or state.phase >= AxisPhase.FINISHED:
        return
    state.reaction = reaction
    if reaction == Reaction.OFF:
        if state.phase < AxisPhase.DISABLING:
            enter(state, AxisPhase.DISABLING)
    elif reaction == Reaction.QUICK_STOP:
        if state.phase < AxisPhase.QUICK_STOPPING:
            enter(state, AxisPhase.QUICK_STOPPING)
    elif state.phase < AxisPhase.RAMPING:
        enter(state, AxisPhase.RAMPING)


@kernel
def latch_fault(state: AxisState, fault: int, value: float, drive_error: int) -> None:
    """Keep the first fault and the value that showed it."""
    if state.fault == Fault.NONE:
        state.fault = fault
        state.fault_value = value
        state.fault_drive_error = drive_error
        state.fault_slot_ns = state.slot_ns


@kernel
def trip(state: AxisState, fault: int, value: float, drive_error: int) -> None:
    """Latch the first fault and the value that showed it, and take the stronger reaction."""
    if fault == Fault.NONE:
        return
    latch_fault(state, fault, value, drive_error)
    react(state, reaction_to(fault, state.phase))


@kernel
def within(value: float, low: float, high: float) -> bool:
    """low <= value <= high; False for NaN (every comparison with NaN is false)."""
    return low <= value and value <= high


# --- 1. A new sample: a jump, and two encoders that disagree ---


@kernel
def check_jump(constants: AxisConstants, state: AxisState, sample: Sample, gap_cycles: int) -> None:
    """A new sample farther from the last one than the joint can move in `gap_cycles` periods."""
    if state.velocity.primed != 0:
        moved_rad = abs(sample.position_rad - state.velocity.last_position_rad)
        if not moved_rad <= constants.limits.position_jump_max_rad * gap_cycles:
            trip(state, Fault.POSITION_JUMP, moved_rad, 0)


@kernel
def encoders_disagree(limits: LimitConstants, law_rad: float, other_rad: float, torque_Nm: float) -> bool:
    """Whether two encoders of one joint differ by more than allowed; a flexible reducer twists under `torque_Nm`."""
    if limits.disagreement_max_rad <= 0.0:
        return False
    allowed_rad = limits.disagreement_max_rad + limits.twist_radpNm * abs(torque_Nm)
    return not abs(law_rad - other_rad) <= allowed_rad


@kernel
def check_encoders(limits: LimitConstants, state: AxisState, sample: Sample) -> None:
    """A new sample of a joint with two encoders.  Not while the drive brakes: one reaction is enough."""
    if state.phase <= AxisPhase.RELEASING and encoders_disagree(
        limits, sample.position_rad, sample.second_position_rad, state.command_torque_Nm
    ):
        trip(state, Fault.POSITION_DISAGREEMENT, sample.second_position_rad - sample.position_rad, sample.drive_error)


# --- 2. Drive, bus, schedule and supervisor; a computer that slept ---


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
def _check_drive(state: AxisState, sample: Sample) -> None:
    """Restart, fault, or not enabled any more.

    A drive that brakes by itself (Quick Stop Active, on its watchdog say) is left braking: power off would make it
    coast, and drop a load.
    """
    fault = drive_fault(sample.drive_state, powered(state.phase), sample.restarts)
    if fault == Fault.DRIVE_NOT_ENABLED and sample.drive_state == DriveState.STOPPING:
        latch_fault(state, fault, float(sample.status_word), sample.drive_error)
        react(state, Reaction.QUICK_STOP)
    else:
        trip(state, fault, float(sample.status_word), sample.drive_error)


@kernel
def client_silent_s(constants: StreamConstants, now_ns: int) -> float:
    """How long the program that commands the joint has been silent, if that is too long; else 0."""
    silent_ns = now_ns - load_acquire(constants.alive_ns, 0)
    return silent_ns * 1e-9 if 0 < constants.client_timeout_ns < silent_ns else 0.0


@kernel
def tallied(lost: int, more_lost: int) -> int:
    """Cycles that were lost, less those that were not: where most are lost it grows, and the delay with it."""
    return lost + more_lost if more_lost > 0 else max(lost - 1, 0)


@kernel
def check_supervision(
    constants: AxisConstants, state: AxisState, sample: Sample, skipped_cycles: int, supervisor_age_cycles: int
) -> None:
    """Faults of the drive, the bus, the schedule and the supervisor; the drive's first, it tells most of the cause."""
    if state.phase >= AxisPhase.DISABLING:
        return
    _check_drive(state, sample)
    limits, sequence = constants.limits, constants.sequence
    if state.phase >= AxisPhase.ENABLING and state.phase <= AxisPhase.RELEASING:
        lost_cycles = 0 if state.sample_age_cycles == 0 else 1 + skipped_cycles
        state.missing_samples = tallied(state.missing_samples, lost_cycles)
        missing = max(state.sample_age_cycles, state.missing_samples)
        if missing > limits.sample_age_max_cycles:
            trip(state, Fault.STALE_SAMPLE, float(missing), sample.drive_error)
        state.unsent_cycles = tallied(state.unsent_cycles, int(sample.bus_errors > 0))
        unsent = max(sample.bus_errors, state.unsent_cycles)
        if unsent > limits.sample_age_max_cycles:
            trip(state, Fault.BUS_ERROR, float(unsent), 0)
        if 0 < sequence.supervisor_max_cycles < supervisor_age_cycles:
            trip(state, Fault.SUPERVISOR_LOST, float(supervisor_age_cycles), 0)
        client_s = client_silent_s(constants.stream, state.slot_ns)
        if state.phase <= AxisPhase.TRACKING and client_s > 0.0:  # a joint that is being stopped needs no client
            trip(state, Fault.CLIENT_SILENT, client_s, 0)
        # last: samples that stay away as well tell more, and sooner
        if 0 < limits.heartbeat_age_max_cycles < sample.heartbeat_age_cycles:
            trip(state, Fault.DRIVE_SILENT, float(sample.heartbeat_age_cycles), sample.drive_error)
    # in WAITING the power is off, and without the supervisor's word it stays off: its silence may be longer
    if state.phase == AxisPhase.WAITING and sequence.supervisor_max_cycles > 0:
        if supervisor_age_cycles > sequence.wait_max_cycles:
            trip(state, Fault.SUPERVISOR_LOST, float(supervisor_age_cycles), 0)
    state.missed_slots = tallied(state.missed_slots, 0) + skipped_cycles
    if powered(state.phase) and state.missed_slots > limits.skipped_max_cycles:
        trip(state, Fault.OVERRUN, float(state.missed_slots), 0)


@kernel
def check_suspension(state: AxisState, suspended_s: float) -> None:
    """The computer slept for so long: nobody watched, whatever the clock of the loop says."""
    if state.phase < AxisPhase.QUICK_STOPPING:
        trip(state, Fault.SUSPENDED, suspended_s, 0)


# --- 3. The desired motion; a stop that takes too long ---


@kernel
def reference_fault(
    limits: LimitConstants,
    position_rad: float,
    velocity_radps: float,
    acceleration_radps2: float,
    jerk_radps3: float,
    brake_radps2: float,
    ahead_s: float,
) -> Fault:
    """Fault of the desired motion: braked `ahead_s` from now, it must come to rest inside the position limits.

    Until then it goes on as it is: at its velocity, or slowing down as it does already, so that a motion may end at a
    limit; how far its jerk takes it from that is allowed for, as far as `LOOK_AHEAD_rad`.
    """
    speed_radps = abs(velocity_radps)
    slowing_radps2 = max(-math.copysign(1.0, velocity_radps) * acceleration_radps2, 0.0)
    slowing_s = speed_radps / slowing_radps2 if slowing_radps2 * ahead_s > speed_radps else ahead_s
    later_radps = speed_radps - slowing_radps2 * slowing_s
    way_rad = 0.5 * (speed_radps + later_radps) * slowing_s + 0.5 * later_radps * later_radps / brake_radps2
    stop_rad = position_rad + math.copysign(way_rad, velocity_radps)
    low_rad, high_rad = limits.position_min_rad - ROUNDING_rad, limits.position_max_rad + ROUNDING_rad
    if not within(position_rad, low_rad, high_rad):
        return Fault.REFERENCE_LIMIT
    turning_rad = min(abs(jerk_radps3) * ahead_s * ahead_s * ahead_s, LOOK_AHEAD_rad)
    if not within(stop_rad, low_rad - turning_rad, high_rad + turning_rad):
        return Fault.REFERENCE_LIMIT
    if not abs(velocity_radps) <= limits.velocity_max_radps + ROUNDING_radps:
        return Fault.REFERENCE_LIMIT
    return Fault.NONE


@kernel
def check_reference(constants: AxisConstants, state: AxisState) -> None:
    """The desired motion, before it is followed."""
    reference = state.reference
    fault = reference_fault(
        constants.limits, reference.position_rad, reference.velocity_radps, reference.acceleration_radps2,
        reference.jerk_radps3, constants.sequence.brake_radps2, REACTION_CYCLES * constants.law.period_s,
    )  # fmt: skip
    trip(state, fault, state.reference.position_rad, 0)


@kernel
def set_point_problem(
    limits: LimitConstants, stream: StreamConstants, brake_radps2: float, before: SetPoint, after: SetPoint
) -> SetPointProblem:
    """What is wrong with going from one set-point to the next.  It is no fault: the joint never follows it."""
    if not 0 < after.time_ns - before.time_ns <= stream.timeout_ns + stream.delay_ns:
        return SetPointProblem.TIME
    if not within(after.position_rad, limits.position_min_rad, limits.position_max_rad):
        return SetPointProblem.POSITION
    if not within(after.velocity_radps, -limits.velocity_max_radps, limits.velocity_max_radps):
        return SetPointProblem.VELOCITY
    if not abs(after.position_rad - before.position_rad) <= stream.jump_max_rad:
        return SetPointProblem.JUMP
    if not within(after.torque_Nm, -stream.torque_max_Nm, stream.torque_max_Nm):
        return SetPointProblem.TORQUE
    duration_s, c2, c3 = cubic(before, after)
    if not abs(after.torque_Nm - before.torque_Nm) <= stream.torque_rate_max_Nmps * duration_s:
        return SetPointProblem.TORQUE_RATE
    # a program that runs slower than its own time has velocities that are a little greater than its positions say
    off_rad = after.position_rad - before.position_rad
    off_rad -= 0.5 * duration_s * (before.velocity_radps + after.velocity_radps)
    room_radps = stream.acceleration_max_radps2 * duration_s
    steep = abs(after.acceleration_radps2) > stream.acceleration_max_radps2  # not for NaN
    steep = steep or not abs(after.velocity_radps - before.velocity_radps) <= room_radps
    if steep or not abs(off_rad) <= 0.5 * room_radps * duration_s:
        return SetPointProblem.ACCELERATION
    quickest_s, turn_s, other_turn_s = extremes_s(before.velocity_radps, c2, c3, duration_s)
    for d in (0.25 * duration_s, 0.5 * duration_s, 0.75 * duration_s, duration_s, quickest_s, turn_s, other_turn_s):
        if not 0.0 < d <= duration_s:
            continue
        way_rad = before.position_rad + d * (before.velocity_radps + d * (c2 + d * c3))
        speed_radps = before.velocity_radps + d * (2.0 * c2 + 3.0 * d * c3)
        if not abs(speed_radps) <= limits.velocity_max_radps + ROUNDING_radps:
            return SetPointProblem.VELOCITY
        if reference_fault(limits, way_rad, speed_radps, 0.0, 0.0, brake_radps2, stream.delay_ns * 1e-9) != Fault.NONE:
            return SetPointProblem.STOPPING_WAY
    return SetPointProblem.NONE


@kernel
def check_stop_time(constants: AxisConstants, state: AxisState) -> None:
    """RAMPING: the joint must come to rest in time; one that stands waits for the others of its arm, under control."""
    if state.phase_cycle > constants.sequence.stop_max_cycles and state.ready == 0:
        trip(state, Fault.STOP_TIMEOUT, state.velocity.velocity_radps, 0)


# --- 4. The measured motion: a reading that stands still, then position, velocity and following error ---


@kernel
def check_reading(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    """A reading that stands still although the reference moves on, or although the joint is pushed hard.

    It must be early: behind a stuck encoder the law pushes ever harder, and the joint moves unseen, long before the
    following error is too large.  A joint that has slid ahead of its reference stands until it is behind it again: of
    the way that the reference has gone, as much as it is behind is held against the reading, and what is beyond
    `frozen_ahead_rad` in any case.  Where the drive closes a loop itself, the torque is the one that it measures; in an
    arm it is what the command has beyond the arm's own.  A joint that is astray throws the others, which stand still
    against that: it is to be reported first, if it was so at the first push of a standstill.  Of an overrun's
    `elapsed_cycles`, the reference's way counts for one: the drive received no other.
    """
    limits = constants.limits
    torque_Nm = state.command_torque_Nm
    if constants.command_kind != CommandKind.TORQUE:
        torque_Nm = state.measured_torque_Nm
    elif constants.law.of_arm != 0:
        torque_Nm -= state.law.arm_torque_Nm  # what the other joints' motion asks for pushes no joint
    torque_Nm -= limits.frozen_bias_Nm
    state.frozen_way_rad += (state.reference.position_rad - state.frozen_reference_rad) / elapsed_cycles
    state.frozen_reference_rad = state.reference.position_rad
    way_rad = state.frozen_way_rad
    if state.frozen_samples == 0:
        state.frozen_way_rad = 0.0
        state.pushed_cycles = 0
        state.pushed_max_cycles = 0
    elif state.sample_age_cycles == 0:
        behind_rad = state.reference.position_rad - state.measured_position_rad
        if way_rad < 0.0:
            behind_rad = -behind_rad
        held_against_rad = min(abs(way_rad), max(behind_rad, abs(way_rad) - limits.frozen_ahead_rad))
        if 0.0 < limits.frozen_max_rad < held_against_rad:
            trip(state, Fault.POSITION_FROZEN, way_rad, 0)
        if 0.0 < limits.frozen_torque_Nm < abs(torque_Nm):
            if state.pushed_max_cycles == 0:
                longest = SHAKEN_CYCLES if state.shaken != 0 else PUSHED_CYCLES
                state.pushed_max_cycles = max(longest, limits.frozen_cycles)
            state.pushed_cycles += 1
            if state.pushed_cycles > state.pushed_max_cycles:
                trip(state, Fault.POSITION_FROZEN, way_rad, 0)
        else:
            state.pushed_cycles = 0


@kernel
def is_astray(limits: LimitConstants, state: AxisState) -> int:
    """1 for a joint under torque that was at its torque limit a moment ago, is far from its reference, or nowhere."""
    if not powered(state.phase):
        return 0
    error_rad = state.measured_position_rad - state.reference.position_rad
    near = abs(error_rad) <= ASTRAY_SHARE * limits.following_error_max_rad
    return 0 if near and state.saturated_cycles == 0 else 1


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
def check_motion(constants: AxisConstants, state: AxisState) -> None:
    """Measured position, velocity and following error against their limits."""
    error_rad = state.measured_position_rad - state.reference.position_rad
    value = limit_position_rad(constants.limits, state.measured_position_rad, state.second_position_rad)
    fault = motion_fault(constants.limits, value, state.velocity.velocity_radps, error_rad)
    if fault == Fault.VELOCITY_LIMIT:
        value = state.velocity.velocity_radps
    elif fault == Fault.FOLLOWING_ERROR:
        value = error_rad
    trip(state, fault, value, 0)


@kernel
def sinks(limits: LimitConstants, state: AxisState) -> bool:
    """Whether a joint that no torque holds has left the place where it stood when that began."""
    allowed_rad = max(SINKS_SHARE * limits.following_error_max_rad, SINKS_TOLERANCES * limits.frozen_tolerance_rad)
    return not abs(state.measured_position_rad - state.stood_rad) <= allowed_rad


@kernel
def check_release(constants: AxisConstants, state: AxisState) -> None:
    """RELEASING: a joint that friction does not hold is braked by its drive before the power goes off.

    It is no fault, since it was stopped on purpose and did stand; the limits of the motion hold as before.
    """
    if state.phase != AxisPhase.RELEASING:
        return
    if state.phase_cycle == 0:
        state.stood_rad = state.measured_position_rad
    elif sinks(constants.limits, state):
        state.notices |= Notice.SANK
        react(state, Reaction.QUICK_STOP)


# --- 5. The command: finite, limit, rate limit, in that order ---


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


@kernel
def limited_velocity_radps(
    limits: LimitConstants, acceleration_max_radps2: float, velocity_radps: float, last_radps: float, interval_s: float
) -> tuple[float, bool]:
    """(velocity to send [rad/s], finite): finite check, velocity limit, acceleration limit, in that order.

    `interval_s` is the time since the last command.  Not finite: zero at once, and the caller must stop the joint.
    """
    if not math.isfinite(velocity_radps):
        return 0.0, False
    limited = min(max(velocity_radps, -limits.velocity_max_radps), limits.velocity_max_radps)
    step = acceleration_max_radps2 * interval_s
    return min(max(limited, last_radps - step), last_radps + step), True


@kernel
def check_finite(state: AxisState, finite: bool, unlimited: float) -> None:
    """A command that is no number: it was not sent (`limited_*`, here and in `axis`)."""
    if not finite:
        trip(state, Fault.NOT_FINITE, unlimited, 0)


# --- 6. A joint that swings instead of settling ---


@kernel
def watch_rest(constants: AxisConstants, state: AxisState, sample: Sample) -> None:
    """A new sample, before its velocity is taken: while the power is off, what does the reading do by itself?"""
    if state.phase == AxisPhase.WAITING:
        moving = not abs(state.velocity.velocity_radps) <= constants.limits.standstill_radps
        note_rest(state.swing, sample.position_rad, state.velocity.primed == 0 or moving)


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
        allow_reversal(state.torque)
        allow_reversal(state.error)
        allow_reversal(state.faint_error)
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
def check_swing(constants: AxisConstants, state: AxisState, torque_Nm: float) -> None:
    """A torque or an error that swings while the law is active; `torque_Nm` is the command, or the measured torque.

    What the desired acceleration or a set-point asks for is no swing, however quick.  While the torque is released,
    nothing is looked at: the law is no longer active.
    """
    if state.phase < AxisPhase.APPROACH or state.phase > AxisPhase.RAMPING:
        return
    reference = state.reference
    error_rad = state.measured_position_rad - reference.position_rad
    beyond_Nm = torque_Nm - constants.law.inertia_kgm2 * reference.acceleration_radps2 - state.stream.torque_Nm
    speed_radps, cycle = reference.velocity_radps, state.cycle
    fault = swing_fault(constants.limits, state.swing, beyond_Nm, error_rad, speed_radps, cycle)
    if fault != Fault.NONE:
        trip(state, fault, swing_Hz(state.swing, constants.law.period_s), 0)


# --- 7. A command that stays at its limit; what is reported without a stop ---


@kernel
def check_saturation(limits: LimitConstants, state: AxisState, torque_Nm: float, elapsed_cycles: int) -> None:
    """A torque at its limit, or none that is a number, for too long.

    It is forgotten as slowly as it came: a torque that jumps from limit to limit is none the better for it.
    """
    if not abs(torque_Nm) < limits.torque_max_Nm:
        state.saturated_cycles += elapsed_cycles
        if state.saturated_cycles > limits.saturation_max_cycles:
            trip(state, Fault.TORQUE_SATURATED, torque_Nm, 0)
    else:
        state.saturated_cycles = max(state.saturated_cycles - elapsed_cycles, 0)


@kernel
def take_notice(constants: AxisConstants, state: AxisState, torque_Nm: float) -> None:
    """What is reported without ending the run; `torque_Nm` is the command that follows `state.command_torque_Nm`."""
    if not powered(state.phase):
        return
    if torque_noise(constants.limits.swing, state.swing, torque_Nm - state.command_torque_Nm):
        if state.notices & Notice.TORQUE_NOISE == 0:
            state.swing.noise_told_Nm = state.swing.noise_Nm
        state.notices |= Notice.TORQUE_NOISE
    rests = state.reference.velocity_radps == 0.0 and state.reference.acceleration_radps2 == 0.0
    error_rad = state.measured_position_rad - state.reference.position_rad
    if step_hunting(constants.limits.swing, state.swing, error_rad, rests, state.cycle):
        state.notices |= Notice.HUNTS
    if state.law.learning.stopped != 0:
        state.notices |= Notice.LEARNING_OFF
