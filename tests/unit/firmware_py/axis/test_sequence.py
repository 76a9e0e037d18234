"""The phases of a run as pure functions: forward only, and the stronger reaction wins."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from firmware_py.records import LINE_GONE, AxisState, Command, Sample
from firmware_py.schema import new
from firmware_py.sequence import (
    ANSWER_CYCLES,
    compare_encoders,
    enter,
    powered,
    react,
    released_torque_Nm,
    request_stop,
    reset_axis,
    step_enabling,
    step_stopping,
    step_waiting,
    trip,
    write_command,
)
from firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, Reaction, StopRequest
from firmware_py.trajectory import approach_at

GOAL = {
    Reaction.RAMP: AxisPhase.RAMPING,
    Reaction.QUICK_STOP: AxisPhase.QUICK_STOPPING,
    Reaction.OFF: AxisPhase.DISABLING,
}


@pytest.fixture
def axis(axis_constants: Any) -> Any:
    return axis_constants[0]


@pytest.fixture
def state(axis: Any) -> Any:
    state = new(AxisState)[0]
    reset_axis(axis, state)
    return state


def sample_of(drive_state: DriveState) -> Any:
    sample = new(Sample)[0]
    sample.drive_state, sample.status_word, sample.drive_error = drive_state, 0x1237, 0x3310
    return sample


def test_reset_forgets_the_run_before(axis: Any, state: Any) -> None:
    state.phase, state.fault, state.reaction, state.cycle = AxisPhase.FINISHED, Fault.OVERRUN, Reaction.OFF, 99
    state.command_torque_Nm, state.saturated_cycles = 7.0, 8
    state.velocity.primed, state.law.lugre_deflection_rad = 1, 0.1
    state.law.network.weights[:] = 5.0
    reset_axis(axis, state)
    assert (state.phase, state.fault, state.reaction, state.cycle) == (AxisPhase.WAITING, 0, 0, 0)
    assert (state.command_torque_Nm, state.saturated_cycles) == (0.0, 0)
    assert (state.velocity.primed, state.law.lugre_deflection_rad) == (0, 0.0)
    assert list(state.law.network.weights) == [0.01] * 15


# written in a cycle before they are read in it
WRITTEN_FIRST = {
    "frozen_way_rad",
    "frozen_reference_rad",
    "frozen_at_rad",
    "sample_late_s",
    "measured_position_rad",
    "measured_torque_Nm",
}


def test_reset_leaves_nothing_of_the_run_before_behind(axis: Any, state: Any) -> None:
    used = new(AxisState)[0]
    plain = [name for name in used.dtype.names if used.dtype[name].kind in "if"]
    for name in plain:
        used[name] = 3
    changed = ("answered", "answer", "ramping", "ramp_s", "motion")
    for name in changed:
        used.change[name] = 3
    reset_axis(axis, used)
    assert [name for name in plain if name not in WRITTEN_FIRST and used[name] != 0] == []
    assert [name for name in changed if used.change[name] != 0] == []


@pytest.mark.parametrize("phase", AxisPhase)
def test_torque_is_only_commanded_between_enabled_and_released(phase: AxisPhase) -> None:
    assert powered(int(phase)) is (phase.name in ("APPROACH", "TRACKING", "RAMPING", "RELEASING"))


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize("in_force", Reaction)
@pytest.mark.parametrize("reaction", Reaction)
def test_react_goes_forward_or_stays(state: Any, phase: AxisPhase, in_force: Reaction, reaction: Reaction) -> None:
    state.phase, state.reaction, state.phase_cycle = phase, in_force, 7
    react(state, int(reaction))
    if reaction <= in_force or phase is AxisPhase.FINISHED:
        assert (state.phase, state.reaction, state.phase_cycle) == (phase, in_force, 7)
    else:
        assert state.reaction == reaction
        assert state.phase == max(phase, GOAL[reaction])
        assert state.phase_cycle == (7 if state.phase == phase else 0)


@pytest.mark.parametrize("phase", [AxisPhase.ENABLING, AxisPhase.TRACKING, AxisPhase.RELEASING])
def test_the_first_fault_is_latched_and_the_reaction_never_weakens(axis: Any, state: Any, phase: AxisPhase) -> None:
    for first, second in itertools.product(Fault, Fault):
        reset_axis(axis, state)
        state.phase = phase
        trip(state, int(first), 1.0, 11)
        reaction, after_first = int(state.reaction), int(state.phase)
        trip(state, int(second), 2.0, 22)
        latched = first if first is not Fault.NONE else second
        expected = (0.0, 0) if latched is Fault.NONE else (1.0, 11) if first is not Fault.NONE else (2.0, 22)
        assert (state.fault, state.fault_value, state.fault_drive_error) == (latched, *expected)
        assert state.reaction >= reaction
        assert state.phase >= after_first


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize("stop", StopRequest)
def test_stop_request_in_every_phase(state: Any, phase: AxisPhase, stop: StopRequest) -> None:
    state.phase = phase
    request_stop(state, int(stop))
    assert state.fault == Fault.NONE
    if stop is StopRequest.NONE:
        goal = phase
    elif phase <= AxisPhase.ENABLING or stop is StopRequest.OFF:
        goal = AxisPhase.DISABLING
    else:
        goal = GOAL[Reaction(int(stop))]
    assert state.phase == max(phase, goal)


def idle_sample(drive_state: DriveState = DriveState.OFF) -> Any:
    sample = new(Sample)[0]
    sample.drive_state = drive_state
    return sample


def settled(state: Any, position_rad: float = 0.0, velocity_radps: float = 0.0, good_samples: int = 4) -> None:
    state.measured_position_rad, state.good_samples, state.sample_count = position_rad, good_samples, good_samples
    state.velocity.velocity_radps = velocity_radps


@pytest.mark.parametrize(
    ("position_rad", "velocity_radps", "good_samples", "phase", "fault"),
    [
        (0.0, 0.0, 3, AxisPhase.WAITING, Fault.NONE),
        (0.0, 0.0, 4, AxisPhase.ENABLING, Fault.NONE),
        (1.0, 0.02, 4, AxisPhase.ENABLING, Fault.NONE),
        (-1.0, -0.02, 4, AxisPhase.ENABLING, Fault.NONE),
        (1.0 + 1e-12, 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (-1.0 - 1e-12, 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (float("nan"), 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (0.0, 0.02 + 1e-12, 4, AxisPhase.WAITING, Fault.NONE),
        (0.0, float("nan"), 4, AxisPhase.WAITING, Fault.NONE),
    ],
)
def test_enabling_is_only_asked_at_standstill_inside_the_limits(
    axis: Any, state: Any, position_rad: float, velocity_radps: float, good_samples: int, phase: int, fault: int
) -> None:
    settled(state, position_rad, velocity_radps, good_samples)
    axis.limits.velocity_max_radps = axis.limits.following_error_max_rad = 0.02
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault, state.fault_drive_error) == (phase, fault, 0)
    assert state.fault_value == pytest.approx(position_rad if fault else 0.0, nan_ok=True)


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING])
@pytest.mark.parametrize(
    ("start_rad", "max_rad", "position_rad", "moved"),
    [
        (0.25, 0.125, 0.375, False), (0.25, 0.125, 0.125, False), (0.25, 0.125, 0.375 + 1e-12, True),
        (0.25, 0.125, 0.125 - 1e-12, True), (-0.5, 0.125, 0.5, True), (0.25, 0.0, 0.9, False),
        (float("nan"), 0.0, 0.9, False), (float("nan"), 0.125, 0.9, True),
    ],
)  # fmt: skip
def test_a_joint_that_was_moved_since_the_motion_was_shown_is_not_driven(
    axis: Any, state: Any, phase: AxisPhase, start_rad: float, max_rad: float, position_rad: float, moved: bool
) -> None:
    axis.sequence.start_rad, axis.sequence.moved_max_rad = start_rad, max_rad
    settled(state, position_rad)
    state.phase = phase
    if phase is AxisPhase.WAITING:
        step_waiting(axis, state, idle_sample())
    else:
        step_enabling(axis, state, idle_sample(DriveState.ENABLED), axis_table())
    if moved:
        assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.MOVED_BEFORE_START)
        assert state.fault_value == pytest.approx(position_rad - start_rad, nan_ok=True)
        assert state.fault_drive_error == 0
    else:
        assert (state.phase, state.fault) == (phase + 1, Fault.NONE)


@pytest.mark.parametrize("drive_state", [DriveState.OFF, DriveState.STARTING, DriveState.ENABLED])
def test_a_drive_that_is_enabled_already_is_not_taken_over(axis: Any, state: Any, drive_state: DriveState) -> None:
    settled(state)
    step_waiting(axis, state, idle_sample(drive_state))
    enabled = drive_state is DriveState.ENABLED
    assert state.phase == (AxisPhase.WAITING if enabled else AxisPhase.ENABLING)
    if enabled:
        state.phase_cycle = axis.sequence.wait_max_cycles
        step_waiting(axis, state, sample_of(drive_state))
        assert (state.phase, state.fault) == (AxisPhase.WAITING, Fault.NONE)  # the twin: the last cycle of the wait
        state.phase_cycle += 1
        step_waiting(axis, state, sample_of(drive_state))
        assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.DRIVE_STAYS_ENABLED)
        assert (state.fault_value, state.fault_drive_error) == (0x1237, 0x3310)


def test_the_run_waits_until_it_may_enable(axis: Any, state: Any) -> None:
    axis.sequence.may_enable = 0
    settled(state)
    step_waiting(axis, state, idle_sample())
    assert (state.phase, state.fault) == (AxisPhase.WAITING, Fault.NONE)
    axis.sequence.may_enable = 1
    step_waiting(axis, state, idle_sample())
    assert state.phase == AxisPhase.ENABLING


@pytest.mark.parametrize(("settle_cycles", "fault"), [(4, Fault.SUPERVISOR_LOST), (5, Fault.SAMPLES_MISSING)])
def test_the_wait_for_the_supervisors_word_ends(axis: Any, state: Any, settle_cycles: int, fault: Fault) -> None:
    axis.sequence.may_enable, axis.sequence.settle_cycles = 0, settle_cycles
    settled(state)
    state.phase_cycle = 40
    step_waiting(axis, state, idle_sample())
    assert (state.phase, state.fault) == (AxisPhase.WAITING, Fault.NONE)
    state.phase_cycle = 41
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault) == (AxisPhase.DISABLING, fault)
    assert state.fault_value == (41.0 if fault is Fault.SUPERVISOR_LOST else settle_cycles)
    assert state.fault_drive_error == (0 if fault is Fault.SUPERVISOR_LOST else 0x3310)


@pytest.mark.parametrize(
    ("samples", "velocity_radps", "too_old_cycles", "fault", "value"),
    [
        (0, 0.0, 1, Fault.NO_SAMPLES, 0.0), (3, 0.0, 1, Fault.STALE_SAMPLE, 6.0),
        (3, 0.0, 0, Fault.SAMPLES_MISSING, 4.0), (4, 0.5, 0, Fault.NOT_AT_STANDSTILL, 0.5),
    ],
)  # fmt: skip
def test_waiting_ends(
    axis: Any, state: Any, samples: int, velocity_radps: float, too_old_cycles: int, fault: Fault, value: float
) -> None:
    settled(state, 0.0, velocity_radps, samples)
    state.phase_cycle, state.sample_age_cycles = 40, axis.limits.sample_age_max_cycles + too_old_cycles
    step_waiting(axis, state, idle_sample())
    assert (state.phase, state.fault) == (AxisPhase.WAITING, Fault.NONE)
    state.phase_cycle = 41
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault) == (AxisPhase.DISABLING, fault)
    assert state.fault_value == value
    assert state.fault_drive_error == (0 if fault is Fault.NOT_AT_STANDSTILL else 0x3310)


@pytest.mark.parametrize("drive_state", DriveState)
@pytest.mark.parametrize("age_cycles", [0, 1])
def test_torque_begins_only_with_a_fresh_sample_of_an_enabled_drive(
    axis: Any, state: Any, drive_state: DriveState, age_cycles: int
) -> None:
    state.phase, state.sample_age_cycles, state.measured_position_rad = AxisPhase.ENABLING, age_cycles, 0.3
    state.law.network.weights[:] = 5.0
    step_enabling(axis, state, sample_of(drive_state), axis_table())
    if drive_state is DriveState.ENABLED and age_cycles == 0:
        assert state.phase == AxisPhase.APPROACH
        assert state.reference.position_rad == 0.3
        assert state.trajectory_s == pytest.approx(-0.2, abs=1.1e-3)
        assert list(state.law.network.weights) == [0.01] * 15
    else:
        assert state.phase == AxisPhase.ENABLING


def axis_table() -> Any:
    return np.zeros((1, 5))


def test_the_approach_leads_from_where_the_joint_stands_into_the_trajectory(axis: Any, state: Any) -> None:
    state.phase, state.measured_position_rad, state.velocity.last_position_rad = AxisPhase.ENABLING, 0.3, 0.30001
    state.velocity.last_error_rad, state.velocity.error_rate_radps = 5.0, 5.0
    state.table_row, state.frozen_way_rad, state.frozen_reference_rad = 3, 9.0, 9.0
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table())
    assert (state.trajectory_s, state.table_row) == (-0.2, 0)
    assert (state.frozen_way_rad, state.frozen_reference_rad) == (0.0, 0.3)
    # the error has no history yet
    assert state.velocity.last_error_rad == pytest.approx(1e-5, rel=1e-6)
    assert state.velocity.error_rate_radps == 0.0
    for at_s, position_rad, velocity_radps in ((0.0, 0.3, 0.0), (0.2, 0.0, 0.35 * 0.2 * math.pi)):
        approach_at(state.approach, at_s, state.reference)
        assert state.reference.position_rad == pytest.approx(position_rad, abs=1e-12)
        assert state.reference.velocity_radps == pytest.approx(velocity_radps, abs=1e-12)


@pytest.mark.parametrize("elapsed_cycles", [1, 3])
@pytest.mark.parametrize(
    ("release_cycles", "phase_cycle"), [(10.0, 1), (10.0, 5), (10.0, 9), (9.5, 9), (10.0, 10), (10.0, 11)]
)
def test_the_torque_is_released_along_a_straight_line(
    axis: Any, state: Any, release_cycles: float, phase_cycle: int, elapsed_cycles: int
) -> None:
    """In proportion to the time that is left, from what it was `elapsed_cycles` before."""
    axis.sequence.release_s = release_cycles * axis.law.period_s
    state.phase, state.phase_cycle, state.command_torque_Nm = AxisPhase.RELEASING, phase_cycle, 12.0
    torque_Nm = released_torque_Nm(axis, state, elapsed_cycles)
    left = max(release_cycles - phase_cycle, 0.0)
    assert torque_Nm == pytest.approx(12.0 * left / (left + elapsed_cycles), abs=1e-9)
    assert state.phase == (AxisPhase.RELEASING if left else AxisPhase.DISABLING)


def test_without_an_approach_the_trajectory_begins_at_once(axis: Any, state: Any) -> None:
    axis.sequence.approach_s = 0.0
    state.phase = AxisPhase.ENABLING
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table())
    assert state.phase == AxisPhase.TRACKING
    assert state.reference.velocity_radps == pytest.approx(0.35 * 0.2 * 3.14159265, rel=1e-6)


@pytest.mark.parametrize(("phase_cycle", "fault"), [(30, Fault.NONE), (31, Fault.ENABLE_TIMEOUT)])
def test_enable_timeout(axis: Any, state: Any, phase_cycle: int, fault: Fault) -> None:
    state.phase, state.phase_cycle = AxisPhase.ENABLING, phase_cycle
    step_enabling(axis, state, sample_of(DriveState.STARTING), axis_table())
    assert state.fault == fault
    assert state.phase == (AxisPhase.DISABLING if fault else AxisPhase.ENABLING)
    assert (state.fault_value, state.fault_drive_error) == ((0x1237, 0x3310) if fault else (0.0, 0))


@pytest.mark.parametrize("drive_state", DriveState)
@pytest.mark.parametrize("age_cycles", [0, 1])
@pytest.mark.parametrize("phase_cycle", [ANSWER_CYCLES, ANSWER_CYCLES + 1])
@pytest.mark.parametrize(
    ("phase", "following"),
    [(AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING), (AxisPhase.DISABLING, AxisPhase.FINISHED)],
)
def test_only_a_fresh_answer_of_the_drive_ends_the_stop(
    axis: Any, state: Any, drive_state: DriveState, age_cycles: int, phase_cycle: int, phase: int, following: int
) -> None:
    state.phase, state.phase_cycle, state.sample_age_cycles = phase, phase_cycle, age_cycles
    step_stopping(axis, state, sample_of(drive_state))
    confirmed = drive_state in (DriveState.OFF, DriveState.FAULT) and age_cycles == 0 and phase_cycle > ANSWER_CYCLES
    assert state.phase == (following if confirmed else phase)
    assert state.fault == Fault.NONE


@pytest.mark.parametrize("bus_errors", [LINE_GONE - 1, LINE_GONE])
@pytest.mark.parametrize("phase", [AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING])
def test_on_a_line_that_is_gone_there_is_nothing_to_wait_for(
    axis: Any, state: Any, phase: AxisPhase, bus_errors: int
) -> None:
    enter(state, int(phase))
    sample = sample_of(DriveState.ENABLED)
    sample.bus_errors = bus_errors
    step_stopping(axis, state, sample)
    assert state.phase == (AxisPhase.FINISHED if bus_errors == LINE_GONE else phase)


@pytest.mark.parametrize("phase", [p for p in AxisPhase if p not in (AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING)])
def test_the_stop_concerns_no_other_phase(axis: Any, state: Any, phase: AxisPhase) -> None:
    state.phase, state.phase_cycle = phase, 1000
    step_stopping(axis, state, sample_of(DriveState.OFF))
    assert state.phase == phase


@pytest.mark.parametrize(("phase_cycle", "phase"), [(100, AxisPhase.QUICK_STOPPING), (101, AxisPhase.DISABLING)])
def test_a_quick_stop_that_does_not_end_is_cut_off(axis: Any, state: Any, phase_cycle: int, phase: AxisPhase) -> None:
    state.phase, state.phase_cycle, state.reaction = AxisPhase.QUICK_STOPPING, phase_cycle, Reaction.QUICK_STOP
    step_stopping(axis, state, sample_of(DriveState.STOPPING))
    assert state.phase == phase


@pytest.mark.parametrize(
    ("phase_cycle", "phase", "fault"),
    [(20, AxisPhase.DISABLING, Fault.NONE), (21, AxisPhase.FINISHED, Fault.OFF_TIMEOUT)],
)
def test_off_timeout(axis: Any, state: Any, phase_cycle: int, phase: AxisPhase, fault: Fault) -> None:
    state.phase, state.phase_cycle = AxisPhase.DISABLING, phase_cycle
    step_stopping(axis, state, sample_of(DriveState.ENABLED))
    assert (state.phase, state.fault) == (phase, fault)
    assert (state.fault_value, state.fault_drive_error) == ((0x1237, 0x3310) if fault else (0.0, 0))


@pytest.mark.parametrize("phase", AxisPhase)
def test_request_of_every_phase(state: Any, phase: AxisPhase) -> None:
    state.phase_cycle = state.good_samples = 7
    enter(state, int(phase))
    assert (state.phase, state.phase_cycle, state.good_samples) == (phase, 0, 0)
    command = new(Command)[0]
    command.request = -1  # each phase says what it wants
    state.command_torque_Nm, state.command_velocity_radps = 1.5, 0.25
    write_command(state, command)
    assert (command.torque_Nm, command.velocity_radps) == (1.5, 0.25)
    if phase is AxisPhase.QUICK_STOPPING:
        assert command.request == DriveRequest.QUICK_STOP
    elif AxisPhase.ENABLING <= phase <= AxisPhase.RELEASING:
        assert command.request == DriveRequest.ENABLE
    else:
        assert command.request == DriveRequest.OFF


def test_phases_follow_each_other_in_a_whole_run(rig: Callable[..., Any]) -> None:
    run = rig(0.1)
    run.until(AxisPhase.TRACKING).run(20)
    run.stop = StopRequest.RAMP
    run.until(AxisPhase.FINISHED)
    order = [phase for phase, _ in itertools.groupby(run.phases)]
    assert order == [p for p in AxisPhase if p is not AxisPhase.QUICK_STOPPING]


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize("apart_rad", [-0.0101, -0.0099, 0.0099, 0.0101])
def test_two_encoders_are_compared_until_the_drive_brakes(
    axis: Any, state: Any, phase: AxisPhase, apart_rad: float
) -> None:
    axis.limits.disagreement_max_rad = 0.01
    state.phase = phase
    sample = sample_of(DriveState.ENABLED)
    sample.position_rad, sample.second_position_rad = 0.5, 0.5 + apart_rad
    compare_encoders(axis.limits, state, sample)
    if abs(apart_rad) < 0.01 or phase > AxisPhase.RELEASING:
        assert (state.fault, state.phase) == (Fault.NONE, phase)
        return
    assert state.fault == Fault.POSITION_DISAGREEMENT
    assert state.fault_value == pytest.approx(apart_rad)
    assert state.fault_drive_error == 0x3310
    assert state.phase == (AxisPhase.QUICK_STOPPING if phase >= AxisPhase.APPROACH else AxisPhase.DISABLING)


@pytest.mark.parametrize("torque_Nm", [-20.0, 20.0])
def test_a_flexible_reducer_between_two_encoders_may_twist(axis: Any, state: Any, torque_Nm: float) -> None:
    axis.limits.disagreement_max_rad, axis.limits.twist_radpNm = 0.01, 1e-3
    state.phase, state.command_torque_Nm = AxisPhase.TRACKING, torque_Nm
    sample = sample_of(DriveState.ENABLED)
    for apart_rad, fault in ((0.0299, Fault.NONE), (0.0301, Fault.POSITION_DISAGREEMENT)):
        sample.second_position_rad = apart_rad
        compare_encoders(axis.limits, state, sample)
        assert state.fault == fault
