"""Processes that die or hang while the joint moves: somebody always stops it, and an onlooker on the bus sees it."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.hil.moving_run import ENABLED, QUICK_STOP_ACTIVE, SWITCH_ON_DISABLED, Moving, gone
from tests.python_process import eventually

HEARTBEAT_LOST = 0x8130


@pytest.fixture
def moving(bench: Any) -> Any:
    moving = Moving(bench)
    yield moving
    moving.close()


def test_supervisor_killed_the_loop_ramps_down_by_itself(moving: Any) -> None:
    moving.run.signal(signal.SIGKILL, group=True)
    assert moving.witness.saw(SWITCH_ON_DISABLED, 0x4F)
    assert gone(moving.loop)
    states = moving.witness.states_since(moving.since_s)
    assert ENABLED in states  # it braked under control
    assert QUICK_STOP_ACTIVE not in states
    assert moving.witness.largest_speed_radps(moving.since_s) < 0.5  # the trajectory has 0.22
    assert moving.bench.disabled()


def test_the_death_of_the_supervisor_is_not_waited_for_as_its_silence_is(bench: Any) -> None:
    """The joint went on for `supervisor_timeout_s`, and one that was about to be enabled still was."""
    config = bench.with_joint(trajectory__duration_s=60.0, sequence__supervisor_timeout_s=60.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    (loop,) = run.children()
    run.signal(signal.SIGKILL)
    assert gone(loop, 30.0)
    (tail,) = bench.folder.glob("runs/*.tail.mcap")
    records = read_run_log(tail).records
    assert (records.fault[-1], records.phase[-1]) == (Fault.SUPERVISOR_LOST, AxisPhase.FINISHED)
    assert AxisPhase.RELEASING in records.phase  # it braked under control
    assert bench.disabled()


def test_supervisor_stopped_the_loop_ramps_down_and_it_is_told_afterwards(moving: Any) -> None:
    moving.run.signal(signal.SIGSTOP)
    assert moving.witness.saw(SWITCH_ON_DISABLED, 0x4F)
    assert QUICK_STOP_ACTIVE not in moving.witness.states_since(moving.since_s)
    moving.run.signal(signal.SIGCONT)
    done = moving.run.finished(20.0)
    done.refused(7, "SUPERVISOR_LOST", "silent")
    assert moving.bench.disabled()


def test_supervisor_held_up_for_less_than_its_time_goes_on(moving: Any) -> None:
    """The twin: a supervisor that is late but not lost is no reason to stop."""
    moving.run.signal(signal.SIGSTOP)
    time.sleep(0.1)
    moving.run.signal(signal.SIGCONT)
    assert not moving.witness.saw(SWITCH_ON_DISABLED, 0x4F, 1.0)
    moving.run.signal(signal.SIGINT)
    assert moving.run.finished(20.0).code == 130


def test_loop_killed_the_drive_stops_and_the_supervisor_tells_it(moving: Any) -> None:
    os.kill(moving.loop, signal.SIGKILL)
    done = moving.run.finished(20.0)
    done.refused(7, "the loop process was killed by signal 9", "switch on disabled")
    assert moving.bench.disabled()
    assert moving.bench.log().complete


def test_loop_and_supervisor_killed_the_drive_stops_by_its_own_watchdog(moving: Any) -> None:
    os.kill(moving.run.process.pid, signal.SIGSTOP)  # it must not make the drive safe before the watchdog does
    os.kill(moving.loop, signal.SIGKILL)
    moving.run.signal(signal.SIGKILL)
    emergencies = moving.witness.emergencies
    eventually(lambda: HEARTBEAT_LOST in emergencies, 5.0, lambda: emergencies)
    time.sleep(0.5)  # the quick stop ramp
    assert moving.bench.disabled()
    done = moving.bench.run("run", moving.bench.config(), "-y")  # the next run takes over what the watchdog stopped
    assert done.code == 0, done.err
    assert moving.bench.disabled()


def test_loop_that_hangs_is_ended_and_the_drive_has_stopped(moving: Any) -> None:
    os.kill(moving.loop, signal.SIGSTOP)
    done = moving.run.finished(20.0)
    done.refused(7, "the loop process did nothing")
    assert HEARTBEAT_LOST in moving.witness.emergencies
    assert gone(moving.loop)
    assert moving.bench.disabled()


def test_joint_gone_the_run_ends_with_one_line(bench: Any) -> None:
    moving = Moving(bench, bench.joint_process)
    moving.close()  # its client would fail with the bus
    moving.joint.signal(signal.SIGKILL)
    started = time.monotonic()
    done = moving.run.finished(30.0)
    assert time.monotonic() - started < 25.0
    assert done.code == 7, done.err
    done.refused(7)
    assert "STALE_SAMPLE" in done.err or "BUS_ERROR" in done.err
    assert gone(moving.loop)
