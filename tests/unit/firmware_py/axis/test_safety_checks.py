"""The checks of a cycle, each with the value that it latches and a twin just inside."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.safety import check_jump, check_motion, check_stop_time
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault, LimitSource


@pytest.fixture
def tracking(state: Any) -> Iterator[Any]:
    """None of these checks gives an error code of the drive."""
    state.phase = AxisPhase.TRACKING
    yield state
    assert state.fault_drive_error == 0


@pytest.mark.trips(Fault.POSITION_JUMP, "(1.001, Fault.POSITION_JUMP)")
@pytest.mark.stays(Fault.POSITION_JUMP, "(0.999, Fault.NONE)")
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("gap_cycles", [1, 3])
@pytest.mark.parametrize(("share", "fault"), [(0.999, Fault.NONE), (1.001, Fault.POSITION_JUMP)])
def test_a_sample_may_be_as_far_as_the_joint_can_move(
    axis: Any, tracking: Any, sign: float, gap_cycles: int, share: float, fault: Fault
) -> None:
    sample = new(Sample)[0]
    moved_rad = share * gap_cycles * axis.limits.position_jump_max_rad
    sample.position_rad, tracking.velocity.last_position_rad = 0.1 - sign * moved_rad, 0.1
    check_jump(axis, tracking, sample, gap_cycles)
    assert tracking.fault == Fault.NONE, "the first sample has nothing before it"
    tracking.velocity.primed = 1
    check_jump(axis, tracking, sample, gap_cycles)
    assert tracking.fault == fault
    assert tracking.fault_value == pytest.approx(moved_rad if fault else 0.0)


def test_a_sample_exactly_as_far_as_the_joint_can_move_is_good(axis: Any, tracking: Any) -> None:
    axis.limits.position_jump_max_rad, tracking.velocity.primed = 0.25, 1
    sample = new(Sample)[0]
    sample.position_rad, tracking.velocity.last_position_rad = 0.5, 0.0
    check_jump(axis, tracking, sample, 2)
    assert tracking.fault == Fault.NONE


@pytest.mark.parametrize(("late_cycles", "fault"), [(0, Fault.NONE), (1, Fault.STOP_TIMEOUT)])
def test_a_stop_has_its_time(axis: Any, tracking: Any, late_cycles: int, fault: Fault) -> None:
    tracking.phase, tracking.velocity.velocity_radps = AxisPhase.RAMPING, 0.3
    tracking.phase_cycle = axis.sequence.stop_max_cycles + late_cycles
    check_stop_time(axis, tracking)
    assert (tracking.fault, tracking.fault_value) == (fault, 0.3 if fault else 0.0)


@pytest.mark.parametrize("fault", [Fault.POSITION_LIMIT, Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.NONE])
def test_the_value_that_is_latched_is_the_one_beyond_its_limit(axis: Any, tracking: Any, fault: Fault) -> None:
    limits = axis.limits
    limits.limit_source = LimitSource.OTHER
    tracking.second_position_rad = limits.position_max_rad + 0.1 * (fault == Fault.POSITION_LIMIT)
    tracking.velocity.velocity_radps = limits.velocity_max_radps * (1.1 if fault == Fault.VELOCITY_LIMIT else 1.0)
    error_rad = limits.following_error_max_rad * (1.1 if fault == Fault.FOLLOWING_ERROR else 0.99)
    tracking.reference.position_rad = 0.05
    tracking.measured_position_rad = 0.05 + error_rad
    check_motion(axis, tracking)
    latched = {
        Fault.POSITION_LIMIT: tracking.second_position_rad,
        Fault.VELOCITY_LIMIT: tracking.velocity.velocity_radps,
        Fault.FOLLOWING_ERROR: error_rad,
        Fault.NONE: 0.0,
    }
    assert tracking.fault == fault
    assert tracking.fault_value == pytest.approx(latched[fault])
