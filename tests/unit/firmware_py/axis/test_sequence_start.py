"""When a run enables the drive and when torque begins: at standstill, inside the limits, where it was shown."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.safety import check_encoders, enter
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import is_enabled, step_enabling, step_waiting
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, Reaction
from jointctl.firmware_py.trajectory import approach_at
from tests.unit.firmware_py.axis.sequence_records import sample_of


def idle_sample(drive_state: DriveState = DriveState.OFF) -> Any:
    sample = new(Sample)[0]
    sample.drive_state = drive_state
    return sample


def settled(state: Any, position_rad: float = 0.0, velocity_radps: float = 0.0, good_samples: int = 4) -> None:
    state.measured_position_rad, state.good_samples, state.sample_count = position_rad, good_samples, good_samples
    state.velocity.velocity_radps = velocity_radps


@pytest.mark.stays(Fault.NOT_AT_STANDSTILL, "(1.0, 0.02, 4, AxisPhase.ENABLING")
@pytest.mark.parametrize(
    ("position_rad", "velocity_radps", "good_samples", "phase", "fault"),
    [
        (0.0, 0.0, 3, AxisPhase.WAITING, Fault.NONE), (0.0, 0.0, 4, AxisPhase.ENABLING, Fault.NONE),
        (1.0, 0.02, 4, AxisPhase.ENABLING, Fault.NONE), (-1.0, -0.02, 4, AxisPhase.ENABLING, Fault.NONE),
        (1.0 + 1e-12, 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (-1.0 - 1e-12, 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (float("nan"), 0.0, 4, AxisPhase.DISABLING, Fault.POSITION_LIMIT),
        (0.0, 0.02 + 1e-12, 4, AxisPhase.WAITING, Fault.NONE), (0.0, float("nan"), 4, AxisPhase.WAITING, Fault.NONE),
    ],
)  # fmt: skip
def test_enabling_is_only_asked_at_standstill_inside_the_limits(
    axis: Any, state: Any, position_rad: float, velocity_radps: float, good_samples: int, phase: int, fault: int
) -> None:
    settled(state, position_rad, velocity_radps, good_samples)
    axis.limits.velocity_max_radps = axis.limits.following_error_max_rad = 0.02
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault, state.fault_drive_error) == (phase, fault, 0)
    assert state.fault_value == pytest.approx(position_rad if fault else 0.0, nan_ok=True)


def test_a_joint_of_an_arm_that_could_be_enabled_waits_for_the_others(axis: Any, state: Any) -> None:
    settled(state)
    state.held_back = 1
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.ready) == (AxisPhase.WAITING, 1)
    state.held_back = 0
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.ready) == (AxisPhase.ENABLING, 0)


@pytest.mark.parametrize(
    ("phase", "drive_state", "age_cycles", "enabled"),
    [
        (AxisPhase.WAITING, DriveState.ENABLED, 0, False), (AxisPhase.ENABLING, DriveState.OFF, 0, False),
        (AxisPhase.ENABLING, DriveState.ENABLED, 1, False), (AxisPhase.ENABLING, DriveState.ENABLED, 0, True),
        (AxisPhase.APPROACH, DriveState.ENABLED, 1, True),
    ],
)  # fmt: skip
def test_a_drive_counts_as_enabled_from_its_own_fresh_word_on(
    state: Any, phase: int, drive_state: DriveState, age_cycles: int, enabled: bool
) -> None:
    state.phase, state.sample_age_cycles = phase, age_cycles
    assert is_enabled(state, sample_of(drive_state)) == enabled


@pytest.mark.trips(Fault.MOVED_BEFORE_START, "0.375 + 1e-12, True")
@pytest.mark.stays(Fault.MOVED_BEFORE_START, "0.375, False")
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
        step_enabling(axis, state, idle_sample(DriveState.ENABLED), axis_table(), True, True)
    if moved:
        assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.MOVED_BEFORE_START)
        assert state.fault_value == pytest.approx(position_rad - start_rad, nan_ok=True)
        assert state.fault_drive_error == 0
    else:
        assert (state.phase, state.fault) == (phase + 1, Fault.NONE)


@pytest.mark.parametrize("drive_state", [DriveState.OFF, DriveState.STARTING, DriveState.PREPARED])
@pytest.mark.parametrize(("moved_rad", "moved"), [(0.125, False), (0.125 + 1e-12, True), (-0.25, True)])
def test_nor_one_that_moves_while_its_drive_reports_that_it_is_not_enabled_yet(
    axis: Any, state: Any, drive_state: DriveState, moved_rad: float, moved: bool
) -> None:
    axis.sequence.start_rad, axis.sequence.moved_max_rad = 0.25, 0.125
    settled(state, 0.25 + moved_rad)
    state.phase = AxisPhase.ENABLING
    step_enabling(axis, state, idle_sample(drive_state), axis_table(), True, False)
    assert (state.phase, state.fault) == (
        (AxisPhase.DISABLING, Fault.MOVED_BEFORE_START) if moved else (AxisPhase.ENABLING, Fault.NONE)
    )


@pytest.mark.parametrize("before", [DriveState.STARTING, DriveState.PREPARED, DriveState.ENABLED])
def test_a_drive_that_falls_back_to_off_is_not_asked_again(axis: Any, state: Any, before: DriveState) -> None:
    settled(state)
    state.phase = AxisPhase.ENABLING
    step_enabling(axis, state, sample_of(before), axis_table(), False, False)
    step_enabling(axis, state, sample_of(DriveState.OFF), axis_table(), False, False)
    assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.DRIVE_NOT_ENABLED)
    assert (state.fault_value, state.fault_drive_error) == (0x1237, 0x3310)


@pytest.mark.parametrize("before", [DriveState.UNKNOWN, DriveState.OFF])
def test_its_twin_that_has_not_begun_yet_is_waited_for(axis: Any, state: Any, before: DriveState) -> None:
    settled(state)
    state.phase = AxisPhase.ENABLING
    for drive_state in (before, DriveState.OFF, DriveState.STARTING, DriveState.PREPARED, DriveState.STARTING):
        step_enabling(axis, state, sample_of(drive_state), axis_table(), False, False)
    assert (state.phase, state.fault) == (AxisPhase.ENABLING, Fault.NONE)


@pytest.mark.trips(Fault.DRIVE_STAYS_ENABLED, "Fault.DRIVE_STAYS_ENABLED")
@pytest.mark.stays(Fault.DRIVE_STAYS_ENABLED, "(AxisPhase.WAITING, Fault.NONE)")
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


@pytest.mark.trips(Fault.SAMPLES_MISSING, "(5, Fault.SAMPLES_MISSING)")
@pytest.mark.stays(Fault.SAMPLES_MISSING, "(4, Fault.NONE)")
@pytest.mark.parametrize(("settle_cycles", "fault"), [(4, Fault.NONE), (5, Fault.SAMPLES_MISSING)])
def test_the_wait_for_the_supervisors_word_does_not_count(
    axis: Any, state: Any, settle_cycles: int, fault: Fault
) -> None:
    """How long it may be silent then: test_supervision_edges.py."""
    axis.sequence.may_enable, axis.sequence.settle_cycles = 0, settle_cycles
    settled(state)
    state.phase_cycle = 41
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault) == (AxisPhase.DISABLING if fault else AxisPhase.WAITING, fault)
    assert state.fault_value == (settle_cycles if fault else 0.0)
    assert state.fault_drive_error == (0x3310 if fault else 0)


def test_samples_that_stay_away_while_the_supervisors_word_is_awaited_have_all_their_time(
    axis: Any, state: Any
) -> None:
    axis.sequence.may_enable = 0
    settled(state)
    state.phase_cycle, state.held_up_cycles = 1000, 7
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase_cycle, state.held_up_cycles) == (0, 0)
    state.good_samples = 0
    state.phase_cycle = 40
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault) == (AxisPhase.WAITING, Fault.NONE)
    state.phase_cycle = 41
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.SAMPLES_MISSING)


@pytest.mark.trips(Fault.NO_SAMPLES, "(0, 0.0, 1, Fault.NO_SAMPLES, 0.0)")
@pytest.mark.stays(Fault.NO_SAMPLES, "(AxisPhase.WAITING, Fault.NONE)")
@pytest.mark.trips(Fault.NOT_AT_STANDSTILL, "(4, 0.5, 0, Fault.NOT_AT_STANDSTILL, 0.5)")
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


@pytest.mark.parametrize(("ready", "velocity_radps", "fault"), [
    (0, 0.5, Fault.NOT_AT_STANDSTILL), (1, 0.5, Fault.NONE), (1, 0.0, Fault.NONE), (0, 0.0, Fault.NONE),
])  # fmt: skip
def test_a_noisy_reading_of_a_joint_that_waits_for_another_is_not_the_cause(
    axis: Any, state: Any, ready: int, velocity_radps: float, fault: Fault
) -> None:
    settled(state, 0.0, velocity_radps)
    state.phase_cycle, state.held_back, state.ready = 41, 1, ready
    step_waiting(axis, state, sample_of(DriveState.OFF))
    assert state.fault == fault
    assert state.ready == (velocity_radps == 0.0)


@pytest.mark.parametrize(("phase", "wait_cycles"), [(AxisPhase.WAITING, 40), (AxisPhase.ENABLING, 30)])
@pytest.mark.parametrize("samples", [0, 3])
def test_a_wait_that_is_over_only_because_the_loop_was_held_up_says_so(
    axis: Any, state: Any, phase: AxisPhase, wait_cycles: int, samples: int
) -> None:
    """Campaign 915311, scenarios 1269 and 4927: reported as SAMPLES_MISSING, for which the bus was then searched."""
    axis.sequence.wait_max_cycles, axis.sequence.enable_max_cycles = 40, 30
    for held_up_cycles, fault in ((wait_cycles, Fault.OVERRUN), (1, Fault.OVERRUN), (0, None)):
        settled(state, good_samples=samples)
        state.phase, state.fault, state.reaction = phase, Fault.NONE, Reaction.NONE
        state.phase_cycle, state.held_up_cycles = wait_cycles + 1, held_up_cycles
        if phase is AxisPhase.WAITING:
            step_waiting(axis, state, sample_of(DriveState.OFF))
        else:
            step_enabling(axis, state, sample_of(DriveState.OFF), axis_table(), True, True)
        assert state.phase == AxisPhase.DISABLING
        assert bool(state.fault == Fault.OVERRUN) is (fault is Fault.OVERRUN)
        assert fault is None or state.fault_value == held_up_cycles


def test_what_held_up_the_phase_before_is_not_the_cause_of_this_ones_end(axis: Any, state: Any) -> None:
    axis.sequence.enable_max_cycles = 30
    settled(state)
    state.held_up_cycles = 5
    enter(state, AxisPhase.ENABLING)
    state.phase_cycle = 31
    step_enabling(axis, state, sample_of(DriveState.OFF), axis_table(), True, True)
    assert (state.phase, state.fault) == (AxisPhase.DISABLING, Fault.ENABLE_TIMEOUT)


@pytest.mark.parametrize("drive_state", DriveState)
@pytest.mark.parametrize("age_cycles", [0, 1])
def test_torque_begins_only_with_a_fresh_sample_of_an_enabled_drive(
    axis: Any, state: Any, drive_state: DriveState, age_cycles: int
) -> None:
    state.phase, state.sample_age_cycles, state.measured_position_rad = AxisPhase.ENABLING, age_cycles, 0.3
    state.law.network.weights[:] = 5.0
    step_enabling(axis, state, sample_of(drive_state), axis_table(), True, True)
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
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table(), True, True)
    assert (state.trajectory_s, state.table_row) == (-0.2, 0)
    assert (state.frozen_way_rad, state.frozen_reference_rad) == (0.0, 0.3)
    # the error has no history yet
    assert state.velocity.last_error_rad == pytest.approx(1e-5, rel=1e-6)
    assert state.velocity.error_rate_radps == 0.0
    for at_s, position_rad, velocity_radps in ((0.0, 0.3, 0.0), (0.2, 0.0, 0.35 * 0.2 * math.pi)):
        approach_at(state.approach, at_s, state.reference)
        assert state.reference.position_rad == pytest.approx(position_rad, abs=1e-12)
        assert state.reference.velocity_radps == pytest.approx(velocity_radps, abs=1e-12)


def test_without_an_approach_the_trajectory_begins_at_once(axis: Any, state: Any) -> None:
    axis.sequence.approach_s = 0.0
    state.phase = AxisPhase.ENABLING
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table(), True, True)
    assert state.phase == AxisPhase.TRACKING
    assert state.reference.velocity_radps == pytest.approx(0.35 * 0.2 * 3.14159265, rel=1e-6)


@pytest.mark.trips(Fault.ENABLE_TIMEOUT, "(31, Fault.ENABLE_TIMEOUT)")
@pytest.mark.stays(Fault.ENABLE_TIMEOUT, "(30, Fault.NONE)")
@pytest.mark.parametrize(("phase_cycle", "fault"), [(30, Fault.NONE), (31, Fault.ENABLE_TIMEOUT)])
def test_enable_timeout(axis: Any, state: Any, phase_cycle: int, fault: Fault) -> None:
    state.phase, state.phase_cycle = AxisPhase.ENABLING, phase_cycle
    step_enabling(axis, state, sample_of(DriveState.STARTING), axis_table(), True, True)
    assert state.fault == fault
    assert state.phase == (AxisPhase.DISABLING if fault else AxisPhase.ENABLING)
    assert (state.fault_value, state.fault_drive_error) == ((0x1237, 0x3310) if fault else (0.0, 0))


@pytest.mark.parametrize("late_cycles", [0, 1])
@pytest.mark.parametrize("before", [DriveState.OFF, DriveState.UNKNOWN])
def test_a_drive_that_does_not_even_begin_is_asked_for_a_short_time_only(
    axis: Any, state: Any, before: DriveState, late_cycles: int
) -> None:
    """Its STO is open, say: a motion would begin by itself when somebody closes the guard."""
    axis.sequence.begin_max_cycles = 5
    settled(state)
    state.phase, state.phase_cycle = AxisPhase.ENABLING, 5 + late_cycles
    for drive_state in (before, DriveState.STARTING, DriveState.PREPARED, DriveState.ENABLED):
        if state.phase == AxisPhase.ENABLING:
            step_enabling(axis, state, sample_of(drive_state), axis_table(), True, True)
            state.phase_cycle += 10  # one that has begun has `enable_max_cycles`
    assert (state.phase, state.fault) == (
        (AxisPhase.DISABLING, Fault.ENABLE_TIMEOUT) if late_cycles else (AxisPhase.APPROACH, Fault.NONE)
    )


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize("apart_rad", [-0.0101, -0.0099, 0.0099, 0.0101])
def test_two_encoders_are_compared_until_the_drive_brakes(
    axis: Any, state: Any, phase: AxisPhase, apart_rad: float
) -> None:
    axis.limits.disagreement_max_rad = 0.01
    state.phase = phase
    sample = sample_of(DriveState.ENABLED)
    sample.position_rad, sample.second_position_rad = 0.5, 0.5 + apart_rad
    check_encoders(axis.limits, state, sample)
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
        check_encoders(axis.limits, state, sample)
        assert state.fault == fault


def test_a_joint_of_an_arm_waits_until_all_are_enabled(axis: Any, state: Any) -> None:
    state.phase = AxisPhase.ENABLING
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table(), True, False)
    assert state.phase == AxisPhase.ENABLING
    state.phase_cycle = axis.sequence.enable_max_cycles + 1  # the one that is not enabled is the cause
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table(), True, False)
    assert (state.phase, state.fault) == (AxisPhase.ENABLING, Fault.NONE)
    step_enabling(axis, state, sample_of(DriveState.ENABLED), axis_table(), True, True)
    assert state.phase == AxisPhase.APPROACH


@pytest.mark.parametrize(("all_prepared", "fault"), [(False, Fault.NONE), (True, Fault.ENABLE_TIMEOUT)])
def test_a_drive_that_is_prepared_is_not_late_while_it_waits_for_another_one(
    axis: Any, state: Any, all_prepared: bool, fault: Fault
) -> None:
    state.phase, state.phase_cycle = AxisPhase.ENABLING, axis.sequence.enable_max_cycles + 1
    step_enabling(axis, state, sample_of(DriveState.PREPARED), axis_table(), all_prepared, False)
    assert state.fault == fault
