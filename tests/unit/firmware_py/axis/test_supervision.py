"""Suspension, the drive's own heartbeat, a supervisor that never says yes, and readings that stand still."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.cycle import SUSPENDED_MIN_NS, WORDS, Word
from jointctl.firmware_py.realtime import slept_ns
from jointctl.firmware_py.records import AxisState
from jointctl.firmware_py.safety import PUSHED_CYCLES, check_suspension
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, CommandKind, DriveRequest, Fault, Reaction
from tests.unit.firmware_py.stub_loop import Loop

NewRig = Callable[..., Any]


# --- the computer slept ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "reaction", "after"),
    [
        (AxisPhase.WAITING, Reaction.OFF, AxisPhase.DISABLING),
        (AxisPhase.ENABLING, Reaction.OFF, AxisPhase.DISABLING),
        (AxisPhase.APPROACH, Reaction.QUICK_STOP, AxisPhase.QUICK_STOPPING),
        (AxisPhase.TRACKING, Reaction.QUICK_STOP, AxisPhase.QUICK_STOPPING),
    ],
)
def test_a_computer_that_slept_does_not_go_on(
    rig: NewRig, phase: AxisPhase, reaction: Reaction, after: AxisPhase
) -> None:
    run = rig(0.0).until(phase)
    check_suspension(run.state, 5.0)
    assert (run.state.fault, run.state.fault_value, run.state.reaction) == (Fault.SUSPENDED, 5.0, reaction)
    run.tick()
    assert run.phase == after
    assert run.torques_Nm[-1] == 0.0
    run.until(AxisPhase.FINISHED)


@pytest.mark.parametrize(("slept_ns", "trips"), [(0, False), (SUSPENDED_MIN_NS // 2, False), (200_000_000, True)])
@pytest.mark.parametrize("set_by", ["supervisor", "loop"])
def test_the_loop_compares_its_clock_with_one_that_does_not_stand_still(
    axis_constants: Any, slept_ns: int, trips: bool, set_by: str
) -> None:
    loop = Loop(axis_constants)
    if set_by == "supervisor":
        now_ns = time.monotonic_ns()
        loop.words[Word.ASLEEP_NS] = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - now_ns
    else:
        loop.run(1)  # the first cycle takes the difference as it is
    loop.run(30)
    assert loop.state[0].fault == Fault.NONE
    loop.words[Word.ASLEEP_NS] -= slept_ns  # as if the difference had grown
    loop.run(30)
    assert loop.state[0].fault == (Fault.SUSPENDED if trips else Fault.NONE)
    if trips:
        assert loop.state[0].fault_value == pytest.approx(slept_ns * 1e-9, rel=0.05)
        assert loop.command[0].request != DriveRequest.ENABLE


def asleep_so_far_ns() -> int:
    """CLOCK_BOOTTIME - CLOCK_MONOTONIC, from the two of a thousand readings that lie closest together."""
    tried = []
    for _ in range(1000):
        before_ns = time.monotonic_ns()
        boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        tried.append((after_ns - before_ns, boot_ns - (before_ns + after_ns) // 2))
    return min(tried)[1]


@pytest.mark.trips(Fault.SUSPENDED, "(100_000, True)")
@pytest.mark.stays(Fault.SUSPENDED, "(-100_000, False)")
@pytest.mark.parametrize(("past_ns", "trips"), [(-100_000, False), (100_000, True)])
def test_standby_just_shorter_and_just_longer_than_it_can_be_measured(
    axis_constants: Any, past_ns: int, trips: bool
) -> None:
    """A processor that is lost between the two readings makes the sleep look shorter: one good pair is enough."""
    state, words, timespec = new(AxisState)[0], np.zeros(WORDS, np.int64), np.zeros(2, np.int64)
    reset_axis(axis_constants[0], state)
    words[Word.ASLEEP_NS] = asleep_so_far_ns() - SUSPENDED_MIN_NS - past_ns
    for _ in range(200):
        if slept_ns(words, timespec) > SUSPENDED_MIN_NS:
            check_suspension(state, 1.0)
    assert state.fault == (Fault.SUSPENDED if trips else Fault.NONE)


# --- the drive's own heartbeat ---------------------------------------------------------------------------------


@pytest.mark.trips(Fault.DRIVE_SILENT, "(600, 601, True)")
@pytest.mark.stays(Fault.DRIVE_SILENT, "(600, 600, False)")
@pytest.mark.parametrize(("limit", "age", "trips"), [(600, 600, False), (600, 601, True), (0, 10**6, False)])
@pytest.mark.parametrize("phase", [AxisPhase.ENABLING, AxisPhase.TRACKING, AxisPhase.RAMPING])
def test_a_drive_whose_heartbeat_stays_away(rig: NewRig, limit: int, age: int, trips: bool, phase: AxisPhase) -> None:
    run = rig(0.0)
    run.axis.limits.heartbeat_age_max_cycles = limit
    run.reach(phase)
    run.sample.heartbeat_age_cycles = age
    run.tick()
    assert run.state.fault == (Fault.DRIVE_SILENT if trips else Fault.NONE)
    if trips:
        assert run.state.fault_value == age
        assert run.phase == (AxisPhase.DISABLING if phase is AxisPhase.ENABLING else AxisPhase.QUICK_STOPPING)


def test_samples_that_stay_away_as_well_are_the_cause_that_is_told(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.axis.limits.heartbeat_age_max_cycles = 3
    run.sample.heartbeat_age_cycles = 4
    run.state.sample_age_cycles = run.axis.limits.sample_age_max_cycles
    run.tick(fresh=False)
    assert run.state.fault == Fault.STALE_SAMPLE


# --- readings that stand still -----------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("stuck", [True, False])
def test_a_stuck_reading_with_holes_is_noticed_all_the_same(rig: NewRig, every: int, stuck: bool) -> None:
    """Each hole began the watch anew: a stuck encoder behind a bus with losses was not seen.  The twin moves."""
    run = rig(0.0)
    run.axis.limits.frozen_max_rad = 0.01
    run.axis.limits.saturation_max_cycles = 1 << 40
    run.until(AxisPhase.TRACKING).run(20)
    if stuck:
        run.joint.step = lambda *_: None
    for cycle in range(100):
        run.tick(fresh=cycle % every == 0)
        if run.state.fault:
            break
    assert run.state.fault == (Fault.POSITION_FROZEN if stuck else Fault.NONE)
    assert (run.phase is AxisPhase.TRACKING) is not stuck


@pytest.mark.parametrize("kind", [CommandKind.TORQUE, CommandKind.VELOCITY])
@pytest.mark.parametrize(("pushed", "trips"), [(PUSHED_CYCLES, False), (PUSHED_CYCLES + 1, True)])
@pytest.mark.parametrize("enough", [True, False])
def test_a_joint_that_is_pushed_and_reads_the_same(
    rig: NewRig, kind: CommandKind, pushed: int, trips: bool, enough: bool
) -> None:
    """In the velocity modes the drive pushes: what counts is the torque that it measures."""
    run = rig(0.0)
    run.axis.trajectory.amplitude_rad = 0.0
    run.axis.velocity_command.acceleration_max_radps2 = 10.0
    run.axis.command_kind = kind
    run.until(AxisPhase.TRACKING).run(20)
    run.axis.limits.frozen_torque_Nm = 30.0
    run.axis.limits.saturation_max_cycles = 1 << 40
    run.joint.step = lambda *_: None
    torque_Nm = 31.0 if enough else 29.0
    run.tick()
    for _ in range(pushed):
        run.sample.torque_Nm = torque_Nm
        run.state.command_torque_Nm = torque_Nm if kind is CommandKind.TORQUE else 0.0
        run.tick()
    assert run.state.fault == (Fault.POSITION_FROZEN if trips and enough else Fault.NONE)
