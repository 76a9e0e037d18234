"""The phases of a run and the latch of its first fault.

    WAITING -> ENABLING -> APPROACH -> TRACKING -> RAMPING -> RELEASING -> DISABLING -> FINISHED
                                          any fault: RAMPING, QUICK_STOPPING or DISABLING, never back

Nothing here enables a drive again, and nothing resets a fault.  A later fault can only make the reaction stronger.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import reset_law
from jointctl.firmware_py.live_change import reset_change, reset_stream
from jointctl.firmware_py.observers import reset_swing
from jointctl.firmware_py.records import LINE_GONE, AxisConstants, AxisState, Command, Sample
from jointctl.firmware_py.safety import enter, limit_position_rad, motion_fault, react, sinks, trip
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, Reaction, StopRequest
from jointctl.firmware_py.trajectory import plan_approach, reference_at

# The drive answers a request one cycle later at the earliest; a state older than this is not its answer.
ANSWER_CYCLES = 2


@kernel
def reset_axis(constants: AxisConstants, state: AxisState) -> None:
    """Begin a run: power off, nothing heard, nothing learned."""
    state.phase = AxisPhase.WAITING
    state.fault = Fault.NONE
    state.reaction = Reaction.NONE
    state.fault_drive_error = 0
    state.fault_encoder_error = 0
    state.fault_value = 0.0
    state.fault_slot_ns = 0
    state.cycle = 0
    state.slot_ns = 0
    state.asked_ns = 0
    state.phase_cycle = 0
    state.held_up_cycles = 0
    state.good_samples = 0
    state.ready = 0
    state.began = 0
    state.held_back = 0
    state.shaken = 0
    state.stood_rad = 0.0
    state.sample_count = 0
    state.sample_age_cycles = 0
    state.missing_samples, state.missed_slots, state.unsent_cycles = 0, 0, 0
    state.gap_cycles = 0
    state.saturated_cycles = 0
    state.still_cycles = 0
    state.frozen_samples = 0
    state.pushed_cycles = 0
    state.pushed_max_cycles = 0
    state.second_position_rad = 0.0
    state.table_row = 0
    state.trajectory_s = 0.0
    state.command_torque_Nm = 0.0
    state.unlimited_torque_Nm = 0.0
    state.command_velocity_radps = 0.0
    state.command_position_rad = 0.0
    state.has_target = 0
    state.velocity.primed = 0
    reset_law(constants.law, state.law)
    reset_change(state.change)
    reset_stream(state.stream)
    state.notices = 0
    reset_swing(state.swing)


@kernel
def waited_too_long(state: AxisState, longest_cycles: int) -> bool:
    """Whether the phase's time is over.

    Over only because the loop itself was held up: no one has looked for an answer then, so that is the cause, and what
    is missing is not.
    """
    if state.phase_cycle <= longest_cycles:
        return False
    if state.phase_cycle - state.held_up_cycles <= longest_cycles:
        trip(state, Fault.OVERRUN, float(state.held_up_cycles), 0)
    return True


@kernel
def request_stop(state: AxisState, stop_request: int) -> None:
    """A stop asked for by the user is no fault; before torque is applied it just switches off."""
    if stop_request == StopRequest.NONE:
        return
    if state.phase <= AxisPhase.ENABLING or stop_request == StopRequest.OFF:
        react(state, Reaction.OFF)
    elif stop_request == StopRequest.QUICK_STOP:
        react(state, Reaction.QUICK_STOP)
    else:
        react(state, Reaction.RAMP)


@kernel
def moved_before_start(constants: AxisConstants, state: AxisState) -> bool:
    """End a run whose joint is not where it was when the motion was shown: a longer way in the same time is faster."""
    sequence = constants.sequence
    moved_rad = state.measured_position_rad - sequence.start_rad
    if sequence.moved_max_rad <= 0.0 or abs(moved_rad) <= sequence.moved_max_rad:
        return False
    trip(state, Fault.MOVED_BEFORE_START, moved_rad, 0)
    return True


@kernel
def step_waiting(constants: AxisConstants, state: AxisState, sample: Sample) -> None:
    """WAITING: some good samples at standstill inside the limits, then ask the drive to enable."""
    limits = constants.limits
    moving = not abs(state.velocity.velocity_radps) <= limits.standstill_radps
    noise = moving and state.ready != 0  # it waited for another one, who is the cause if that never comes
    state.ready = 0
    if state.good_samples >= constants.sequence.settle_cycles:
        position_rad = limit_position_rad(limits, state.measured_position_rad, state.second_position_rad)
        fault = motion_fault(limits, position_rad, 0.0, 0.0)
        if fault != Fault.NONE:
            trip(state, fault, position_rad, 0)
            return
        if moved_before_start(constants, state):
            return
        enabled = sample.drive_state == DriveState.ENABLED  # it should be off: nobody has asked for more
        if not moving and not enabled:
            if constants.sequence.may_enable != 0:
                state.ready = 1
                if state.held_back == 0:
                    enter(state, AxisPhase.ENABLING)
            else:  # good samples are waited for no longer; how long the supervisor may take is for `check_supervision`
                state.phase_cycle = 0
                state.held_up_cycles = 0
            return
    if waited_too_long(state, constants.sequence.wait_max_cycles) and not noise:
        if state.sample_count == 0:
            trip(state, Fault.NO_SAMPLES, 0.0, sample.drive_error)
        elif sample.drive_state == DriveState.ENABLED:
            trip(state, Fault.DRIVE_STAYS_ENABLED, float(sample.status_word), sample.drive_error)
        elif moving:
            trip(state, Fault.NOT_AT_STANDSTILL, state.velocity.velocity_radps, 0)
        elif state.sample_age_cycles > limits.sample_age_max_cycles:
            trip(state, Fault.STALE_SAMPLE, float(state.sample_age_cycles), sample.drive_error)
        else:
            trip(state, Fault.SAMPLES_MISSING, float(constants.sequence.settle_cycles), sample.drive_error)


@kernel
def is_enabled(state: AxisState, sample: Sample) -> bool:
    """Whether the drive is on, or was when the joint began to move."""
    if state.phase == AxisPhase.ENABLING:
        return sample.drive_state == DriveState.ENABLED and state.sample_age_cycles == 0
    return state.phase > AxisPhase.ENABLING


@kernel
def step_enabling(
    constants: AxisConstants, state: AxisState, sample: Sample, table: np.ndarray, all_prepared: bool, all_enabled: bool
) -> None:
    """ENABLING: once the drive is on, plan the way from where the joint stands to the trajectory's start.

    A joint of an arm waits until `all_prepared`, then until `all_enabled`; one that never is ends the run of all.  So
    does a drive that falls back to off, or stays there: an STO that is closed then must not begin a motion.
    """
    drive = sample.drive_state
    if drive == DriveState.STARTING or drive == DriveState.PREPARED or drive == DriveState.ENABLED:
        state.began = 1
    elif drive == DriveState.OFF and state.began != 0:
        trip(state, Fault.DRIVE_NOT_ENABLED, float(sample.status_word), sample.drive_error)
        return
    if state.began == 0 and waited_too_long(state, constants.sequence.begin_max_cycles):
        trip(state, Fault.ENABLE_TIMEOUT, float(sample.status_word), sample.drive_error)
        return
    if sample.drive_state != DriveState.ENABLED:
        state.stood_rad = state.measured_position_rad
    if moved_before_start(constants, state):  # a brake that has opened, say, whatever state the drive reports
        return
    if is_enabled(state, sample):
        if not all_enabled:
            return
        approach_s = constants.sequence.approach_s
        state.table_row = reference_at(constants.trajectory, table, 0, 0.0, state.reference)
        plan_approach(state.measured_position_rad, state.reference, approach_s, state.approach)
        state.trajectory_s = -approach_s
        if approach_s > 0.0:
            state.reference.position_rad = state.measured_position_rad
            enter(state, AxisPhase.APPROACH)
        else:
            enter(state, AxisPhase.TRACKING)
        # the error has no history yet: without this its first difference would be the distance to the trajectory
        state.velocity.last_error_rad = state.velocity.last_position_rad - state.reference.position_rad
        state.velocity.error_rate_radps = 0.0
        reset_law(constants.law, state.law)
        state.frozen_way_rad = 0.0
        state.frozen_reference_rad = state.reference.position_rad
    elif sample.drive_state == DriveState.PREPARED and not all_prepared:
        return  # it waits for another one
    elif waited_too_long(state, constants.sequence.enable_max_cycles):
        trip(state, Fault.ENABLE_TIMEOUT, float(sample.status_word), sample.drive_error)


@kernel
def end_sinking(constants: np.ndarray, states: np.ndarray, samples: np.ndarray) -> None:
    """An enabled joint that sinks before its torque comes ends the start; the fault is that of the drive it waits for.

    That is its samples where they stay away: a state that is older than an answer says nothing.
    """
    sinking = False
    for axis in range(len(states)):
        waits = states[axis].phase == AxisPhase.ENABLING and samples[axis].drive_state == DriveState.ENABLED
        sinking = sinking or (waits and sinks(constants[axis].limits, states[axis]))
    if not sinking:
        return
    for axis in range(len(states)):
        state, sample = states[axis], samples[axis]
        if state.phase != AxisPhase.ENABLING or is_enabled(state, sample):
            continue
        if state.sample_age_cycles > ANSWER_CYCLES:
            trip(state, Fault.STALE_SAMPLE, float(state.sample_age_cycles), sample.drive_error)
        elif sample.drive_state != DriveState.ENABLED:
            trip(state, Fault.ENABLE_TIMEOUT, float(sample.status_word), sample.drive_error)


@kernel
def released_torque_Nm(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> float:
    """RELEASING: the last torque along a straight line to zero."""
    left_cycles = constants.sequence.release_s / constants.law.period_s - state.phase_cycle
    if left_cycles <= 0.0:
        enter(state, AxisPhase.DISABLING)
        return 0.0
    return state.command_torque_Nm * left_cycles / (left_cycles + elapsed_cycles)


@kernel
def step_stopping(constants: AxisConstants, state: AxisState, sample: Sample) -> None:
    """QUICK_STOPPING and DISABLING end when the drive says that its power stage is off, or when it never does.

    Without a line there is nothing to wait for: the supervisor shall tell the user at once.  The same holds of
    a drive that has announced that it sends no samples: whether it is off, the supervisor reads.
    """
    if sample.bus_errors >= LINE_GONE and state.phase >= AxisPhase.QUICK_STOPPING:
        enter(state, AxisPhase.FINISHED)
        return
    reads_off = sample.drive_state == DriveState.OFF or sample.drive_state == DriveState.FAULT
    answers = state.sample_age_cycles == 0 or sample.restarts != 0  # after its boot-up a drive sends no samples
    off = reads_off and answers and state.phase_cycle > ANSWER_CYCLES
    unheard = sample.sends_none != 0 and state.sample_age_cycles > ANSWER_CYCLES and state.phase_cycle > ANSWER_CYCLES
    if state.phase == AxisPhase.QUICK_STOPPING:
        if off:
            enter(state, AxisPhase.DISABLING)
            state.ready = 1  # it has answered: `jointctl stop` may take the node out of operational now
        elif unheard:
            trip(state, Fault.OFF_TIMEOUT, float(sample.status_word), sample.drive_error)
            enter(state, AxisPhase.FINISHED)
        elif state.phase_cycle > constants.sequence.stop_max_cycles:
            react(state, Reaction.OFF)
    elif state.phase == AxisPhase.DISABLING:
        if off or (reads_off and state.ready != 0):
            enter(state, AxisPhase.FINISHED)
        elif unheard or waited_too_long(state, constants.sequence.off_max_cycles):
            trip(state, Fault.OFF_TIMEOUT, float(sample.status_word), sample.drive_error)
            enter(state, AxisPhase.FINISHED)


@kernel
def write_command(state: AxisState, command: Command) -> None:
    """What the drive is asked for in this phase."""
    command.torque_Nm = state.command_torque_Nm
    command.velocity_radps = state.command_velocity_radps
    command.position_rad = state.command_position_rad
    if state.phase == AxisPhase.QUICK_STOPPING:
        command.request = DriveRequest.QUICK_STOP
    elif state.phase >= AxisPhase.ENABLING and state.phase <= AxisPhase.RELEASING:
        command.request = DriveRequest.ENABLE
    else:
        command.request = DriveRequest.OFF
