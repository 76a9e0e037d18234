"""Drive, bus, schedule, supervisor and a reading that stands still: each limit at its edge, as pure functions."""

from __future__ import annotations

from typing import Any

import pytest

from jointctl.firmware_py.records import AxisState, Sample
from jointctl.firmware_py.safety import (
    ASTRAY_SHARE,
    PUSHED_CYCLES,
    SHAKEN_CYCLES,
    check_reading,
    check_supervision,
    check_suspension,
    is_astray,
    reaction_to,
)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, CommandKind, DriveState, Fault, Reaction


def after(fault: Fault, phase: AxisPhase) -> AxisPhase:
    """The phase that follows the fault."""
    goal = {
        Reaction.RAMP: AxisPhase.RAMPING,
        Reaction.QUICK_STOP: AxisPhase.QUICK_STOPPING,
        Reaction.OFF: AxisPhase.DISABLING,
    }
    return max(phase, goal[Reaction(reaction_to(fault, phase))])


@pytest.mark.trips(
    Fault.DRIVE_NOT_ENABLED, '("drive_state", DriveState.ENABLED, DriveState.STOPPING, Fault.DRIVE_NOT_ENABLED)'
)
@pytest.mark.stays(Fault.DRIVE_NOT_ENABLED, "((within, False), (beyond, counts))")
@pytest.mark.parametrize(
    ("what", "within", "beyond", "fault"),
    [
        ("restarts", 0, 1, Fault.DRIVE_RESTARTED),
        ("drive_state", DriveState.ENABLED, DriveState.FAULT, Fault.DRIVE_FAULT),
        ("drive_state", DriveState.ENABLED, DriveState.STOPPING, Fault.DRIVE_NOT_ENABLED),
        ("sample_age_cycles", 7, 8, Fault.STALE_SAMPLE),
        ("bus_errors", 7, 8, Fault.BUS_ERROR),
        ("heartbeat_age_cycles", 9, 10, Fault.DRIVE_SILENT),
        ("skipped", 5, 6, Fault.OVERRUN),
        ("supervisor", 11, 12, Fault.SUPERVISOR_LOST),
        ("client", 50, 51, Fault.CLIENT_SILENT),
    ],
)
@pytest.mark.parametrize("phase", list(AxisPhase))
def test_each_limit_at_its_edge_in_each_phase(
    axis: Any, what: str, within: int, beyond: int, fault: Fault, phase: AxisPhase
) -> None:
    """With the value that is latched; the drive's error code is kept for faults that the drive has a part in."""
    axis.limits.sample_age_max_cycles, axis.limits.heartbeat_age_max_cycles = 7, 9
    axis.limits.skipped_max_cycles, axis.sequence.supervisor_max_cycles = 5, 11
    axis.stream.client_timeout_ns = 50
    torque = AxisPhase.APPROACH <= phase <= AxisPhase.RELEASING
    of_the_drive = fault in (Fault.DRIVE_RESTARTED, Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED)
    if phase >= AxisPhase.DISABLING:
        counts = False
    elif fault in (Fault.DRIVE_RESTARTED, Fault.DRIVE_FAULT):
        counts = True
    elif fault in (Fault.DRIVE_NOT_ENABLED, Fault.OVERRUN):
        counts = torque
    elif fault is Fault.CLIENT_SILENT:
        counts = AxisPhase.ENABLING <= phase <= AxisPhase.TRACKING
    else:
        counts = torque or phase == AxisPhase.ENABLING
    for value, trips in ((within, False), (beyond, counts)):
        state, sample = new(AxisState)[0], new(Sample)[0]
        reset_axis(axis, state)
        state.phase, sample.drive_state = phase, DriveState.ENABLED
        sample.status_word, sample.drive_error = 0x1237, 0x2310
        if what == "sample_age_cycles":
            state.sample_age_cycles = value
        elif what == "client":
            state.slot_ns = value
        elif what not in ("skipped", "supervisor"):
            setattr(sample, what, value)
        check_supervision(axis, state, sample, value if what == "skipped" else 0, value if what == "supervisor" else 0)
        assert state.fault == (fault if trips else Fault.NONE)
        if not trips:
            assert (state.phase, state.reaction) == (phase, Reaction.NONE)
            continue
        expected = 0x1237 if of_the_drive else value * 1e-9 if what == "client" else value
        assert state.fault_value == pytest.approx(expected)
        told = of_the_drive or fault in (Fault.STALE_SAMPLE, Fault.DRIVE_SILENT)
        assert state.fault_drive_error == (0x2310 if told else 0)
        if what == "drive_state" and beyond == DriveState.STOPPING:
            assert (state.phase, state.reaction) == (AxisPhase.QUICK_STOPPING, Reaction.QUICK_STOP)
        else:
            assert state.phase == after(fault, phase)


def test_a_limit_of_one_cycle_is_no_limit_of_zero_which_means_none(axis: Any, state: Any) -> None:
    axis.limits.heartbeat_age_max_cycles = axis.sequence.supervisor_max_cycles = 1
    for age_cycles, supervisor_cycles, fault in ((2, 0, Fault.DRIVE_SILENT), (0, 2, Fault.SUPERVISOR_LOST)):
        reset_axis(axis, state)
        sample = new(Sample)[0]
        state.phase, sample.drive_state, sample.heartbeat_age_cycles = (
            AxisPhase.TRACKING,
            DriveState.ENABLED,
            age_cycles,
        )
        check_supervision(axis, state, sample, 0, supervisor_cycles)
        assert state.fault == fault


@pytest.mark.parametrize(
    ("age_cycles", "supervised", "fault"),
    [(40, 10, Fault.NONE), (41, 10, Fault.SUPERVISOR_LOST), (41, 1, Fault.SUPERVISOR_LOST), (1000, 0, Fault.NONE)],
)
def test_before_enabling_the_supervisor_may_be_silent_for_the_time_of_the_wait(
    axis: Any, state: Any, age_cycles: int, supervised: int, fault: Fault
) -> None:
    axis.sequence.wait_max_cycles, axis.sequence.supervisor_max_cycles = 40, supervised
    sample = new(Sample)[0]
    sample.drive_state, sample.drive_error = DriveState.OFF, 0x2310
    check_supervision(axis, state, sample, 0, age_cycles)
    assert (state.phase, state.fault) == (AxisPhase.DISABLING if fault else AxisPhase.WAITING, fault)
    assert (state.fault_value, state.fault_drive_error) == (age_cycles if fault else 0, 0)


@pytest.mark.parametrize("limit", ["heartbeat_age_max_cycles", "supervisor_max_cycles"])
def test_what_is_not_watched_does_not_trip(axis: Any, state: Any, limit: str) -> None:
    sample = new(Sample)[0]
    axis.limits.heartbeat_age_max_cycles = axis.sequence.supervisor_max_cycles = 10
    setattr(axis.limits if limit.startswith("heart") else axis.sequence, limit, 0)
    state.phase, sample.drive_state = AxisPhase.TRACKING, DriveState.ENABLED
    sample.heartbeat_age_cycles = 0 if limit.startswith("super") else 1_000_000
    check_supervision(axis, state, sample, 0, 1_000_000 if limit.startswith("super") else 0)
    assert state.fault == Fault.NONE


@pytest.mark.parametrize("phase", list(AxisPhase))
def test_suspension_in_each_phase(state: Any, phase: AxisPhase) -> None:
    state.phase = phase
    check_suspension(state, 5.0)
    if phase < AxisPhase.QUICK_STOPPING:
        assert (state.phase, state.fault, state.fault_value) == (after(Fault.SUSPENDED, phase), Fault.SUSPENDED, 5.0)
        assert state.fault_drive_error == 0
    else:
        assert (state.phase, state.fault) == (phase, Fault.NONE)


@pytest.fixture
def stuck(axis: Any, state: Any) -> tuple[Any, Any]:
    """Constants and state of a joint that tracks and whose reading has stood still for a cycle."""
    axis.limits.frozen_max_rad, axis.limits.frozen_torque_Nm = 0.5, 3.0
    state.phase, state.frozen_samples = AxisPhase.TRACKING, 1
    return axis, state


@pytest.mark.trips(Fault.POSITION_FROZEN, "(0.501, True)")
@pytest.mark.stays(Fault.POSITION_FROZEN, "(0.5, False)")
@pytest.mark.parametrize(("way_rad", "trips"), [(0.5, False), (0.501, True), (-0.5, False), (-0.501, True)])
@pytest.mark.parametrize("how", ["stands", "moves", "no sample", "not watched"])
def test_the_way_behind_a_reading_that_stands_still(
    stuck: tuple[Any, Any], way_rad: float, trips: bool, how: str
) -> None:
    axis, state = stuck
    state.frozen_way_rad, state.frozen_reference_rad = way_rad - 0.25, 1.0
    state.reference.position_rad, state.measured_position_rad = 1.25, 1.25 - way_rad
    if how == "moves":
        state.frozen_samples = 0
    elif how == "no sample":
        state.sample_age_cycles = 1
    elif how == "not watched":
        axis.limits.frozen_max_rad = 0.0
    check_reading(axis, state, 1)
    trips = trips and how == "stands"
    assert state.fault == (Fault.POSITION_FROZEN if trips else Fault.NONE)
    assert state.fault_value == pytest.approx(way_rad if trips else 0.0)
    assert state.fault_drive_error == 0
    assert state.frozen_way_rad == (0.0 if how == "moves" else way_rad)
    assert state.frozen_reference_rad == 1.25


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(("way_rad", "behind_rad", "trips"), [
    (0.8, 0.5, False), (0.8, 0.501, True), (0.501, 9.0, True), (0.5, 9.0, False),
    (1.0, -9.0, False), (1.001, -9.0, True),
])  # fmt: skip
def test_a_joint_that_slid_ahead_of_its_reference_may_stand_until_it_is_behind(
    stuck: tuple[Any, Any], way_rad: float, behind_rad: float, trips: bool, direction: float
) -> None:
    """Not for ever: an encoder may die just then."""
    axis, state = stuck
    axis.limits.frozen_ahead_rad = 0.5
    state.frozen_way_rad = direction * way_rad
    state.measured_position_rad = -direction * behind_rad
    check_reading(axis, state, 1)
    assert state.fault == (Fault.POSITION_FROZEN if trips else Fault.NONE)
    assert state.fault_value == pytest.approx(direction * way_rad if trips else 0.0)


@pytest.mark.parametrize(("last_rad", "trips"), [(50.0, False), (50.1, True)])
def test_what_the_reference_does_in_skipped_slots_is_not_held_against_the_reading(
    stuck: tuple[Any, Any], last_rad: float, trips: bool
) -> None:
    """The drive was not told of it: a joint that stood when the loop was held up stands still."""
    axis, state = stuck
    axis.limits.frozen_max_rad = 1.0
    state.reference.position_rad = 40.0
    check_reading(axis, state, 80)
    assert (state.fault, state.frozen_way_rad) == (Fault.NONE, 0.5)
    state.reference.position_rad = last_rad
    check_reading(axis, state, 20)
    assert state.frozen_way_rad == pytest.approx(1.0 if not trips else 1.005)
    assert state.fault == (Fault.POSITION_FROZEN if trips else Fault.NONE)


@pytest.mark.parametrize(("torque_Nm", "pushed"), [(3.0, False), (3.001, True), (-3.0, False), (-3.001, True)])
@pytest.mark.parametrize("kind", [CommandKind.TORQUE, CommandKind.VELOCITY])
@pytest.mark.parametrize("watched", [True, False])
def test_the_push_at_a_reading_that_stands_still(
    stuck: tuple[Any, Any], torque_Nm: float, pushed: bool, kind: CommandKind, watched: bool
) -> None:
    axis, state = stuck
    axis.command_kind = kind
    if not watched:
        axis.limits.frozen_torque_Nm = 0.0
    pushed = pushed and watched
    for cycle in range(PUSHED_CYCLES + 1):
        assert state.fault == Fault.NONE
        assert state.pushed_cycles == (cycle if pushed else 0)
        if kind is CommandKind.VELOCITY:
            state.measured_torque_Nm, state.command_torque_Nm = torque_Nm, 0.0
        else:
            state.measured_torque_Nm, state.command_torque_Nm = 0.0, torque_Nm
        check_reading(axis, state, 1)
    assert state.fault == (Fault.POSITION_FROZEN if pushed else Fault.NONE)
    assert state.fault_drive_error == 0


@pytest.mark.parametrize("pushed", [False, True])
def test_a_joint_that_gives_way_to_little_is_watched_as_well(stuck: tuple[Any, Any], pushed: bool) -> None:
    axis, state = stuck
    axis.limits.frozen_torque_Nm, state.command_torque_Nm = 0.5, 0.501 if pushed else 0.5
    check_reading(axis, state, 1)
    assert state.pushed_cycles == int(pushed)


@pytest.mark.parametrize(("asked_Nm", "pushed"), [(0.0, True), (3.5, False), (8.0, True)])
def test_of_an_arm_what_the_other_joints_ask_for_pushes_none(
    stuck: tuple[Any, Any], asked_Nm: float, pushed: bool
) -> None:
    axis, state = stuck
    axis.limits.frozen_torque_Nm, axis.law.of_arm = 3.0, 1
    state.command_torque_Nm, state.law.arm_torque_Nm = 4.0, asked_Nm
    check_reading(axis, state, 1)
    assert state.pushed_cycles == int(pushed)


@pytest.mark.parametrize(("heavy", "shaken"), [(0, 0), (0, 1), (60, 0), (60, 1), (160, 1)])
def test_beside_a_joint_that_is_astray_a_push_must_last_longer(stuck: tuple[Any, Any], heavy: int, shaken: int) -> None:
    """It counts what was when the push began: a joint that is pushed unseen drives others astray."""
    axis, state = stuck
    state.command_torque_Nm, state.shaken = 4.0, shaken
    axis.limits.frozen_cycles = heavy  # leaves its tolerance later
    longest = max(heavy, SHAKEN_CYCLES if shaken else PUSHED_CYCLES)
    for _ in range(longest):
        check_reading(axis, state, 1)
        state.shaken = 1 - shaken
    assert (state.pushed_cycles, state.fault) == (longest, Fault.NONE)
    check_reading(axis, state, 1)
    assert state.fault == Fault.POSITION_FROZEN


def test_beside_a_joint_that_is_astray_the_way_of_the_reference_counts_as_ever(stuck: tuple[Any, Any]) -> None:
    axis, state = stuck
    state.shaken, state.frozen_way_rad = 1, 0.501
    state.reference.position_rad = state.frozen_reference_rad = 0.501
    check_reading(axis, state, 1)
    assert state.fault == Fault.POSITION_FROZEN


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize(("share", "astray"), [(0.999, 0), (-0.999, 0), (1.001, 1), (-1.001, 1), (float("nan"), 1)])
def test_a_joint_under_torque_far_from_its_reference_is_astray(
    axis: Any, state: Any, phase: AxisPhase, share: float, astray: int
) -> None:
    state.phase, state.reference.position_rad = phase, 0.3
    state.measured_position_rad = 0.3 + share * ASTRAY_SHARE * axis.limits.following_error_max_rad
    under_torque = AxisPhase.APPROACH <= phase <= AxisPhase.RELEASING
    assert is_astray(axis.limits, state) == (astray if under_torque else 0)
    state.saturated_cycles = 1
    assert is_astray(axis.limits, state) == int(under_torque)


@pytest.mark.parametrize("by", ["less torque", "a reading that moves"])
def test_pushing_counts_from_the_beginning_again(stuck: tuple[Any, Any], by: str) -> None:
    axis, state = stuck
    state.command_torque_Nm, state.pushed_cycles = 4.0, PUSHED_CYCLES
    if by == "less torque":
        state.command_torque_Nm = 3.0
    else:
        state.frozen_samples = 0
    check_reading(axis, state, 1)
    assert (state.pushed_cycles, state.fault) == (0, Fault.NONE)
