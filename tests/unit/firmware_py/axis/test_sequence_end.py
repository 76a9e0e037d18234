"""How a run ends: the torque is released along a line, the drive is asked to be off, and each wait has its end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LINE_GONE, AxisState
from jointctl.firmware_py.safety import SINKS_SHARE, check_release, enter
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import ANSWER_CYCLES, end_sinking, released_torque_Nm, reset_axis, step_stopping
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, Notice, Reaction
from tests.unit.firmware_py.axis.sequence_records import sample_of


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


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize(("share", "sinks"), [(0.999, False), (-0.999, False), (1.001, True), (-1.001, True)])
def test_a_joint_that_sinks_while_its_torque_is_released_is_braked_by_its_drive(
    axis: Any, state: Any, phase: AxisPhase, share: float, sinks: bool
) -> None:
    """From where it stood when the release began, whatever the error was then."""
    sinks = sinks and phase is AxisPhase.RELEASING
    state.phase, state.measured_position_rad = phase, 0.3
    check_release(axis, state)
    state.phase_cycle = 1
    state.measured_position_rad += share * SINKS_SHARE * axis.limits.following_error_max_rad
    check_release(axis, state)
    assert state.phase == (AxisPhase.QUICK_STOPPING if sinks else phase)
    assert (state.notices, state.fault) == (Notice.SANK if sinks else 0, Fault.NONE)


@pytest.mark.parametrize("share", [0.999, 1.001])
@pytest.mark.parametrize(
    ("late", "age_cycles", "fault"),
    [
        (DriveState.PREPARED, ANSWER_CYCLES, Fault.ENABLE_TIMEOUT),
        (DriveState.PREPARED, ANSWER_CYCLES + 1, Fault.STALE_SAMPLE),
        (DriveState.ENABLED, ANSWER_CYCLES, Fault.NONE),
        (DriveState.ENABLED, ANSWER_CYCLES + 1, Fault.STALE_SAMPLE),
        (DriveState.ENABLED, 0, Fault.NONE),
    ],
)
def test_a_joint_that_sinks_before_its_start_is_laid_to_the_drive_that_it_waits_for(
    axis_constants: Any, share: float, late: DriveState, age_cycles: int, fault: Fault
) -> None:
    constants, states = np.repeat(axis_constants, 2).view(np.recarray), new(AxisState, 2)
    for axis, state in zip(constants, states, strict=True):
        reset_axis(axis, state)
        state.phase, state.ready = AxisPhase.ENABLING, 1
    states[0].measured_position_rad = share * SINKS_SHARE * constants[0].limits.following_error_max_rad
    states[1].sample_age_cycles = age_cycles
    samples = np.stack([sample_of(DriveState.ENABLED), sample_of(late)]).view(np.recarray)
    end_sinking(constants, states, samples)
    assert list(states.fault) == [Fault.NONE, fault if share > 1.0 else Fault.NONE]


@pytest.mark.parametrize("drive_state", DriveState)
@pytest.mark.parametrize("age_cycles", [0, 1])
@pytest.mark.parametrize("phase_cycle", [ANSWER_CYCLES, ANSWER_CYCLES + 1])
@pytest.mark.parametrize(
    ("phase", "following"), [(AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING), (AxisPhase.DISABLING, AxisPhase.FINISHED)]
)
def test_only_a_fresh_answer_of_the_drive_ends_the_stop(
    axis: Any, state: Any, drive_state: DriveState, age_cycles: int, phase_cycle: int, phase: int, following: int
) -> None:
    state.phase, state.phase_cycle, state.sample_age_cycles = phase, phase_cycle, age_cycles
    step_stopping(axis, state, sample_of(drive_state))
    confirmed = drive_state in (DriveState.OFF, DriveState.FAULT) and age_cycles == 0 and phase_cycle > ANSWER_CYCLES
    assert state.phase == (following if confirmed else phase)
    assert state.fault == Fault.NONE


@pytest.mark.parametrize(
    ("then", "age_cycles", "phase"),
    [
        (DriveState.OFF, 1, AxisPhase.FINISHED),  # silent: `jointctl stop` has taken the node out of operational
        (DriveState.OFF, 0, AxisPhase.FINISHED),
        (DriveState.ENABLED, 0, AxisPhase.DISABLING),  # another one has enabled it
    ],
)
def test_a_drive_that_was_off_after_its_quick_stop_need_not_say_so_again(
    axis: Any, state: Any, then: DriveState, age_cycles: int, phase: AxisPhase
) -> None:
    state.phase, state.phase_cycle = AxisPhase.QUICK_STOPPING, ANSWER_CYCLES + 1
    step_stopping(axis, state, sample_of(DriveState.OFF))
    state.phase_cycle, state.sample_age_cycles = 1, age_cycles
    step_stopping(axis, state, sample_of(then))
    assert (state.phase, state.fault) == (phase, Fault.NONE)


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


@pytest.mark.parametrize("phase", [AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING])
@pytest.mark.parametrize("drive_state", [DriveState.ENABLED, DriveState.STOPPING, DriveState.OFF])
@pytest.mark.parametrize(
    ("sends_none", "age_cycles", "phase_cycle", "ends"),
    [
        (1, ANSWER_CYCLES + 1, ANSWER_CYCLES + 1, True),
        (0, ANSWER_CYCLES + 1, ANSWER_CYCLES + 1, False),
        (1, ANSWER_CYCLES, ANSWER_CYCLES + 1, False),
        (1, ANSWER_CYCLES + 1, ANSWER_CYCLES, False),
    ],
)
@pytest.mark.parametrize("first", [Fault.STALE_SAMPLE, Fault.NONE])
def test_behind_a_drive_that_sends_none_there_is_nothing_to_wait_for(
    axis: Any, state: Any, phase: AxisPhase, drive_state: DriveState, sends_none: int, age_cycles: int,
    phase_cycle: int, ends: bool, first: Fault,
) -> None:  # fmt: skip
    """That it is off was not heard, whatever its last sample says; the first cause stays."""
    state.phase, state.fault, state.phase_cycle, state.sample_age_cycles = phase, first, phase_cycle, age_cycles
    sample = sample_of(drive_state)
    sample.sends_none = sends_none
    step_stopping(axis, state, sample)
    assert state.phase == (AxisPhase.FINISHED if ends else phase)
    assert state.fault == (first or (Fault.OFF_TIMEOUT if ends else Fault.NONE))


@pytest.mark.parametrize("phase", [p for p in AxisPhase if p not in (AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING)])
def test_the_stop_concerns_no_other_phase(axis: Any, state: Any, phase: AxisPhase) -> None:
    state.phase, state.phase_cycle, state.sample_age_cycles = phase, 1000, 1000
    sample = sample_of(DriveState.OFF)
    sample.sends_none = 1
    step_stopping(axis, state, sample)
    assert state.phase == phase


@pytest.mark.parametrize(("phase_cycle", "phase"), [(100, AxisPhase.QUICK_STOPPING), (101, AxisPhase.DISABLING)])
def test_a_quick_stop_that_does_not_end_is_cut_off(axis: Any, state: Any, phase_cycle: int, phase: AxisPhase) -> None:
    state.phase, state.phase_cycle, state.reaction = AxisPhase.QUICK_STOPPING, phase_cycle, Reaction.QUICK_STOP
    step_stopping(axis, state, sample_of(DriveState.STOPPING))
    assert state.phase == phase


@pytest.mark.trips(Fault.OFF_TIMEOUT, "(21, AxisPhase.FINISHED, Fault.OFF_TIMEOUT)")
@pytest.mark.stays(Fault.OFF_TIMEOUT, "(20, AxisPhase.DISABLING, Fault.NONE)")
@pytest.mark.parametrize(
    ("phase_cycle", "phase", "fault"),
    [(20, AxisPhase.DISABLING, Fault.NONE), (21, AxisPhase.FINISHED, Fault.OFF_TIMEOUT)],
)
def test_off_timeout(axis: Any, state: Any, phase_cycle: int, phase: AxisPhase, fault: Fault) -> None:
    state.phase, state.phase_cycle = AxisPhase.DISABLING, phase_cycle
    step_stopping(axis, state, sample_of(DriveState.ENABLED))
    assert (state.phase, state.fault) == (phase, fault)
    assert (state.fault_value, state.fault_drive_error) == ((0x1237, 0x3310) if fault else (0.0, 0))
