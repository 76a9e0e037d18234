"""One tick of one joint: sample in, command out."""

from __future__ import annotations

import math

import numpy as np

from jointctl.firmware_py.flexible_joint import Reading
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import follow_temperature, step_flexible_law, step_law
from jointctl.firmware_py.libc import load_acquire
from jointctl.firmware_py.live_change import (
    following_set_points,
    step_change,
    step_new_motion,
    step_other_motion,
    step_stream,
)
from jointctl.firmware_py.motion_records import MotionChange, Reference
from jointctl.firmware_py.observers import BRIDGED_CYCLES, coast_velocity, step_velocity
from jointctl.firmware_py.records import (
    AxisConstants,
    AxisState,
    Command,
    LimitConstants,
    Sample,
    VelocityCommandConstants,
)
from jointctl.firmware_py.safety import (
    check_encoders,
    check_finite,
    check_jump,
    check_motion,
    check_reading,
    check_reference,
    check_release,
    check_saturation,
    check_stop_time,
    check_supervision,
    check_swing,
    enter,
    limited_torque_Nm,
    limited_velocity_radps,
    powered,
    react,
    take_notice,
    watch_rest,
)
from jointctl.firmware_py.sequence import (
    released_torque_Nm,
    request_stop,
    step_enabling,
    step_stopping,
    step_waiting,
    write_command,
)
from jointctl.firmware_py.states import (
    AxisPhase,
    CommandKind,
    ControllerKind,
    DriveState,
    Encoders,
    Fault,
    Reaction,
    TrajectoryKind,
)
from jointctl.firmware_py.trajectory import NO_REPETITION, Repetition, approach_at, brake_step, reference_at, repetition

# position -> phase and reference -> velocity -> safety -> law -> finite check, torque limit, rate limit
#
# With CommandKind.VELOCITY and POSITION the last part is velocity or target -> finite, limits, acceleration limit.
#
# The phases themselves are in `sequence`, the limits in `safety`.

MOVES_AGAIN = 3.0  # times `standstill_radps`: a joint that has stood does so no more


@kernel
def _take_position(constants: AxisConstants, state: AxisState, sample: Sample, elapsed_cycles: int) -> int:
    """Position of this cycle; periods since the last sample, 0 if there is no new one.

    Between samples the joint is assumed to move on: at its own velocity, and soon at that of the reference.
    """
    if sample.count == state.sample_count:
        state.sample_age_cycles += elapsed_cycles
        state.good_samples = 0
        if state.sample_age_cycles > BRIDGED_CYCLES:
            radps, flexible, own = state.reference.velocity_radps, constants.law.flexible, state.law.flexible
            coast_velocity(constants.velocity, state.velocity, radps, elapsed_cycles)
            coast_velocity(flexible.motor_velocity, own.motor_velocity, radps, elapsed_cycles)
            coast_velocity(flexible.link_velocity, own.link_velocity, radps, elapsed_cycles)
            seen, adapting = constants.law.adaptation.seen, state.law.adaptation
            coast_velocity(seen, adapting.seen_motor, radps, elapsed_cycles)
            coast_velocity(seen, adapting.seen_link, radps, elapsed_cycles)
        moved_rad = state.velocity.velocity_radps * elapsed_cycles * constants.velocity.period_s
        state.measured_position_rad += moved_rad
        state.second_position_rad += moved_rad
        return 0
    gap_cycles = state.sample_age_cycles + elapsed_cycles
    check_jump(constants, state, sample, gap_cycles)
    changed = not abs(sample.position_rad - state.frozen_at_rad) <= constants.limits.frozen_tolerance_rad
    if changed:
        state.frozen_at_rad = sample.position_rad
        state.frozen_samples = 0
    else:
        state.frozen_samples += 1
    state.sample_count = sample.count
    state.sample_age_cycles = 0
    state.good_samples += 1
    state.measured_position_rad = sample.position_rad
    state.second_position_rad = sample.second_position_rad
    state.measured_torque_Nm = sample.torque_Nm
    check_encoders(constants.limits, state, sample)
    return gap_cycles


@kernel
def _move_reference(constants: AxisConstants, state: AxisState, table: np.ndarray, elapsed_cycles: int) -> None:
    """The desired motion of this cycle: approach, trajectory, or braking.  Time goes on through an overrun."""
    if state.phase <= AxisPhase.TRACKING and state.phase_cycle > 0:  # 0: planned in this very cycle
        # before the reference is taken: after an overrun it must be that of now, not of the cycle that was missed
        state.trajectory_s += elapsed_cycles * constants.law.period_s
    if state.phase == AxisPhase.APPROACH and state.trajectory_s >= 0.0:
        enter(state, AxisPhase.TRACKING)
    duration_s = constants.trajectory.duration_s
    if state.phase == AxisPhase.TRACKING and 0.0 < duration_s <= state.trajectory_s:
        react(state, Reaction.RAMP)
    if state.phase == AxisPhase.APPROACH:
        approach_at(state.approach, state.trajectory_s + constants.sequence.approach_s, state.reference)
    elif state.phase == AxisPhase.TRACKING and state.change.motion != MotionChange.NONE:
        step_new_motion(constants, state, table, elapsed_cycles)
    elif state.phase == AxisPhase.TRACKING and constants.trajectory.kind == TrajectoryKind.STREAM:
        step_stream(constants, state, elapsed_cycles)
    elif state.phase == AxisPhase.TRACKING:
        state.table_row = reference_at(
            constants.trajectory, table, state.table_row, state.trajectory_s, state.reference
        )
    else:
        _brake(constants, state, elapsed_cycles)
        return
    check_reference(constants, state)


@kernel
def _brake(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    """RAMPING: brake the reference, then wait until the joint itself has stood for a while.

    One slow reading is not enough: an oscillating joint has one at every reversal.  One that flickers by a few counts
    stands, however fast a count reads.  One that has stood stays `ready` for the others of its arm until it clearly
    moves: with a noisy encoder they would never be so in the same cycle.
    """
    if state.ready != 0 and state.held_back == 0:
        enter(state, AxisPhase.RELEASING)  # as all others do, whatever the readings of this cycle
        return
    for _ in range(elapsed_cycles):
        brake_step(state.reference, constants.sequence.brake_radps2, constants.law.period_s)
    speed_radps = abs(state.velocity.velocity_radps)
    limits = constants.limits
    settling_s = constants.sequence.settle_cycles * constants.law.period_s
    flicker_rad = min(limits.frozen_tolerance_rad, limits.standstill_radps * settling_s)  # motion leaves it then
    flickers = abs(state.measured_position_rad - state.stood_rad) <= flicker_rad
    flickers = flickers and speed_radps <= limits.velocity_max_radps
    if not (flickers or speed_radps <= MOVES_AGAIN * limits.standstill_radps):
        state.ready = 0
    if not (flickers or speed_radps <= limits.standstill_radps) or state.reference.velocity_radps != 0.0:
        state.still_cycles = 0
        state.stood_rad = state.measured_position_rad
    elif state.sample_age_cycles == 0:  # a lost sample proves nothing either way
        state.still_cycles += elapsed_cycles
        if state.still_cycles >= constants.sequence.settle_cycles:
            state.ready = 1
            if state.held_back == 0:
                enter(state, AxisPhase.RELEASING)
    check_stop_time(constants, state)


@kernel
def law_torque_Nm(constants: AxisConstants, state: AxisState, reference: Reference, where: Repetition) -> float:
    """What the law asks for, unlimited."""
    if constants.law.kind == ControllerKind.FLEXIBLE_JOINT:
        reading = Reading(state.measured_position_rad, state.second_position_rad, state.gap_cycles)
        return step_flexible_law(constants.law, state.law, reading, reference, state.command_torque_Nm, where)
    return step_law(
        constants.law, state.law, state.measured_position_rad, state.velocity, reference, state.command_torque_Nm, where
    )


@kernel
def _command_torque(constants: AxisConstants, state: AxisState, table: np.ndarray, elapsed_cycles: int) -> None:
    """The torque of this cycle; a torque that is not finite is never sent."""
    if state.phase == AxisPhase.RELEASING:
        state.unlimited_torque_Nm = released_torque_Nm(constants, state, elapsed_cycles)
    elif powered(state.phase):
        where = NO_REPETITION
        if state.phase == AxisPhase.TRACKING:
            where = repetition(constants.trajectory, table, state.trajectory_s)
        follow_temperature(constants.law, state.law, False)
        state.unlimited_torque_Nm = law_torque_Nm(constants, state, state.reference, where)
        if state.stream.torque_Nm != 0.0:
            state.unlimited_torque_Nm += state.stream.torque_Nm
    else:
        follow_temperature(constants.law, state.law, True)
        state.unlimited_torque_Nm = 0.0
    limits = constants.limits
    torque_Nm, finite = limited_torque_Nm(
        limits, state.unlimited_torque_Nm, state.command_torque_Nm, constants.law.period_s
    )
    check_finite(state, finite, state.unlimited_torque_Nm)
    check_swing(constants, state, torque_Nm)
    check_saturation(limits, state, torque_Nm, elapsed_cycles)
    take_notice(constants, state, torque_Nm)
    state.command_torque_Nm = torque_Nm if powered(state.phase) else 0.0


@kernel
def _feed_forward_Nm(constants: AxisConstants, state: AxisState) -> float:
    """The law without its feedback, for `state.ahead`; the drive's own loop is the feedback."""
    law = state.law
    if constants.velocity_command.feeds_torque == 0 and constants.law.kind != ControllerKind.FLEXIBLE_JOINT:
        return 0.0
    follow_temperature(constants.law, law, False)
    law.adaptation.resting = 0  # the observer's torque is not sent: there is nothing to hand over
    law_torque_Nm(constants, state, state.ahead, NO_REPETITION)
    law.feedback_torque_Nm = 0.0
    law.observer_torque_Nm = 0.0
    if constants.velocity_command.feeds_torque == 0:
        return 0.0
    return law.inertia_torque_Nm + law.gravity_torque_Nm + law.friction_torque_Nm + state.stream.torque_Nm


@kernel
def _target_rad(constants: AxisConstants, state: AxisState) -> float:
    """Where the encoder that the drive closes its loop on is to be: the motor's is ahead of the link by the twist."""
    if constants.law.kind == ControllerKind.FLEXIBLE_JOINT and constants.law.flexible.encoders != Encoders.LINK:
        return state.law.flexible.target_rad - state.law.flexible.twist_error_rad
    return state.ahead.position_rad


@kernel
def _unpowered_target(constants: AxisConstants, state: AxisState, sample: Sample) -> None:
    """No command; the target position is where the joint is, and stays there from enabling on."""
    follow_temperature(constants.law, state.law, True)
    state.command_velocity_radps = 0.0
    state.command_torque_Nm = 0.0
    state.unlimited_torque_Nm = 0.0
    state.saturated_cycles = 0
    state.has_target = 0
    if state.phase != AxisPhase.ENABLING or sample.drive_state != DriveState.ENABLED:
        second = constants.velocity_command.from_second != 0
        state.command_position_rad = state.second_position_rad if second else state.measured_position_rad


@kernel
def _command_motion(constants: AxisConstants, state: AxisState, sample: Sample, elapsed_cycles: int) -> None:
    """Target position or velocity, and torque offset, of this cycle for a drive that closes that loop itself.

    While the torque is released the joint stands under the drive's loop, and the offset ends.  The limit of the whole
    torque is the drive's; at the limit for too long is a fault here as well, by the measured torque.
    """
    limits, own, period_s = constants.limits, constants.velocity_command, constants.law.period_s
    if not powered(state.phase):
        _unpowered_target(constants, state, sample)
        return
    if state.phase == AxisPhase.RELEASING:
        state.unlimited_torque_Nm = released_torque_Nm(constants, state, elapsed_cycles)
        state.ahead.position_rad = state.command_position_rad
        state.ahead.velocity_radps = 0.0
    elif own.lead_s > 0.0 or own.feeds_torque != 0 or constants.command_kind == CommandKind.POSITION:
        look_ahead(state.reference, own.lead_s, state.ahead)
        state.unlimited_torque_Nm = _feed_forward_Nm(constants, state)
        state.ahead.position_rad = _target_rad(constants, state)
    if constants.command_kind == CommandKind.POSITION:
        # through an overrun the drive's set-point stood still; 60C2 makes up for one period, not for all of them
        before_radps = state.command_velocity_radps if elapsed_cycles == 1 else 0.0
        velocity_radps, finite = limited_target_radps(
            limits, own.acceleration_max_radps2, period_s, state.ahead, state.command_position_rad, before_radps
        )
        state.command_position_rad += velocity_radps * period_s
        unlimited = state.ahead.position_rad
    else:
        unlimited = _velocity_radps(constants, state, elapsed_cycles)
        velocity_radps, finite = limited_velocity_radps(
            limits, own.acceleration_max_radps2, unlimited, state.command_velocity_radps, elapsed_cycles * period_s
        )
    check_finite(state, finite, unlimited)
    torque_Nm, finite = limited_torque_Nm(limits, state.unlimited_torque_Nm, state.command_torque_Nm, period_s)
    check_finite(state, finite, state.unlimited_torque_Nm)
    check_swing(constants, state, state.measured_torque_Nm)
    check_saturation(limits, state, state.measured_torque_Nm, elapsed_cycles)
    state.command_velocity_radps = velocity_radps if powered(state.phase) else 0.0
    state.command_torque_Nm = torque_Nm if powered(state.phase) else 0.0


@kernel
def _velocity_radps(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> float:
    """CommandKind.VELOCITY: the velocity of this cycle, unlimited; zero while the torque is released."""
    own = constants.velocity_command
    if state.phase == AxisPhase.RELEASING:
        return 0.0
    position_rad = state.measured_position_rad
    if own.lead_s <= 0.0:
        return velocity_command_radps(own, state.reference, position_rad)
    target_rad, feed_radps = state.ahead.position_rad, state.ahead.velocity_radps
    if state.has_target != 0 and elapsed_cycles == 1:  # with the speed of the twist, where there is one
        feed_radps = (target_rad - state.command_position_rad) / constants.law.period_s
    state.has_target = 1
    state.command_position_rad = target_rad
    return feed_radps - own.position_gain_ps * (position_rad - state.reference.position_rad)


@kernel
def sense_axis(
    constants: AxisConstants,
    state: AxisState,
    sample: Sample,
    elapsed_cycles: int,
    stop_request: int,
    supervisor_age_cycles: int,
) -> None:
    """The first part of a cycle: set-points and requests that have come, the sample, a stop, all that is supervised."""
    state.stream.written = load_acquire(constants.stream.written, 0)
    state.change.order = load_acquire(constants.change.order, 0)
    state.cycle += elapsed_cycles
    state.phase_cycle += elapsed_cycles
    if elapsed_cycles - 1 > constants.limits.skipped_max_cycles:
        state.held_up_cycles += elapsed_cycles - 1
    if state.fault == Fault.NONE:
        state.fault_encoder_error = sample.encoder_error
    state.gap_cycles = _take_position(constants, state, sample, elapsed_cycles)
    request_stop(state, stop_request)
    check_supervision(constants, state, sample, elapsed_cycles - 1, supervisor_age_cycles)


@kernel
def move_axis(
    constants: AxisConstants,
    state: AxisState,
    table: np.ndarray,
    sample: Sample,
    elapsed_cycles: int,
    all_prepared: bool,
    all_enabled: bool,
) -> None:
    """The second part: phase, desired motion, velocity, and whether reading and motion may be.

    No joint of an arm gets torque before `all_enabled`.
    """
    if state.phase == AxisPhase.WAITING:
        step_waiting(constants, state, sample)
    elif state.phase == AxisPhase.ENABLING:
        step_enabling(constants, state, sample, table, all_prepared, all_enabled)
    step_change(constants, state, table, elapsed_cycles)
    if not following_set_points(constants, state):
        step_other_motion(constants, state, elapsed_cycles)
    if state.phase >= AxisPhase.APPROACH and state.phase <= AxisPhase.RAMPING:
        _move_reference(constants, state, table, elapsed_cycles)
    if state.gap_cycles > 0:
        watch_rest(constants, state, sample)
        # The drive samples when SYNC comes, and SYNC goes out when the loop wakes up.  Until then the joint moved on
        # with about the desired velocity: without this, 0.1 ms at 0.2 rad/s would look like 20 urad of error.
        moved_rad = state.reference.velocity_radps * state.sample_late_s
        state.measured_position_rad -= moved_rad
        state.second_position_rad -= moved_rad
        error_rad = state.measured_position_rad - state.reference.position_rad
        step_velocity(constants.velocity, state.velocity, state.measured_position_rad, error_rad, state.gap_cycles)
    if powered(state.phase):
        check_reading(constants, state, elapsed_cycles)
        check_motion(constants, state)
        check_release(constants, state)


@kernel
def command_axis(
    constants: AxisConstants, state: AxisState, table: np.ndarray, sample: Sample, command: Command, elapsed_cycles: int
) -> None:
    """The last part: the command."""
    if constants.command_kind != CommandKind.TORQUE:
        _command_motion(constants, state, sample, elapsed_cycles)
    else:
        _command_torque(constants, state, table, elapsed_cycles)
    step_stopping(constants, state, sample)
    write_command(state, command)


# --- The velocity command: the reference's velocity plus a small position correction ---
# For a drive that closes the velocity loop itself:
# v = v_d - k (q - q_d)          at the joint, rad/s, k = position_gain_ps [1/s]
#
# The correction keeps the joint on the planned motion (a drive's velocity loop alone drifts); it is small on purpose,
# so that at constant speed the torque is what friction asks for.  Sent only if it is finite, then limited by the
# velocity limit and by the acceleration limit, in that order.  Not modelled: the drive's own ramps and limits.
#
# A run in CSP or CSV (docs/law.md) sends the motion that is desired `lead_s` later, when it takes effect, and the law's
# feed-forward for it as torque offset.  In CSP the target position is limited like a joint that moves.


@kernel
def velocity_command_radps(constants: VelocityCommandConstants, reference: Reference, position_rad: float) -> float:
    """The unlimited velocity command [rad/s] for the motion that is desired now."""
    return reference.velocity_radps - constants.position_gain_ps * (position_rad - reference.position_rad)


@kernel
def look_ahead(reference: Reference, lead_s: float, ahead: Reference) -> None:
    """The desired motion `lead_s` later, as far as its derivatives of now say."""
    ahead.position_rad = reference.position_rad + lead_s * (
        reference.velocity_radps + 0.5 * lead_s * reference.acceleration_radps2
    )
    ahead.velocity_radps = reference.velocity_radps + lead_s * reference.acceleration_radps2
    ahead.acceleration_radps2 = reference.acceleration_radps2
    ahead.jerk_radps3 = reference.jerk_radps3
    ahead.snap_radps4 = reference.snap_radps4


@kernel
def limited_target_radps(
    limits: LimitConstants, acceleration_max_radps2: float, period_s: float, target: Reference, position_rad: float,
    velocity_radps: float,
) -> tuple[float, bool]:  # fmt: skip
    """(velocity of the target position [rad/s], finite): finite, position, velocity, acceleration limit, in that order.

    `position_rad` and `velocity_radps` are those of the last target.  A target that is out of reach is caught up with
    as a joint would, without a jump and without going beyond it; half of the acceleration is left for braking.
    Not finite: the last target stays, and the caller must stop the joint.
    """
    if not (math.isfinite(target.position_rad) and math.isfinite(target.velocity_radps)):
        return 0.0, False
    aim_rad = min(max(target.position_rad, limits.position_min_rad), limits.position_max_rad)
    step = acceleration_max_radps2 * period_s
    wanted = (aim_rad - position_rad) / period_s
    if abs(wanted - velocity_radps) > step:
        left_rad = aim_rad - position_rad - target.velocity_radps * period_s
        speed = min(math.sqrt(acceleration_max_radps2 * abs(left_rad)), abs(left_rad) / period_s)
        wanted = target.velocity_radps + math.copysign(speed, left_rad)
    wanted = min(max(wanted, -limits.velocity_max_radps), limits.velocity_max_radps)
    return min(max(wanted, velocity_radps - step), velocity_radps + step), True
