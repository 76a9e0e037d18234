"""Processes that die or hang while the joint moves: somebody always stops it, and an onlooker on the bus sees it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TPDO_ID, EMCY_ID = 0x181, 0x81
ENABLED, QUICK_STOP_ACTIVE, SWITCH_ON_DISABLED, FAULT = 0x27, 0x07, 0x40, 0x08
COUNTS_PER_RAD = 524288 / 6.283185307179586
HEARTBEAT_LOST = 0x8130
WINDOW_s = 0.05


class Witness:
    """What an independent client saw: (time [s], statusword, position [rad]) of each TPDO, and emergency codes."""

    def __init__(self, bench: Any) -> None:
        self.samples: list[tuple[float, int, float]] = []
        self.emergencies: list[int] = []
        self.network = bench.network()
        self.network.subscribe(TPDO_ID, self._on_tpdo)
        self.network.subscribe(EMCY_ID, self._on_emergency)

    def _on_tpdo(self, _: int, data: bytearray, timestamp_s: float) -> None:
        status = int.from_bytes(data[:2], "little")
        position = int.from_bytes(data[2:6], "little", signed=True) / COUNTS_PER_RAD
        self.samples.append((timestamp_s, status, position))

    def _on_emergency(self, _: int, data: bytearray, timestamp_s: float) -> None:
        self.emergencies.append(int.from_bytes(data[:2], "little"))

    def saw(self, state: int, mask: int = 0x6F, timeout_s: float = 10.0) -> bool:
        """Wait for a statusword from now on."""
        seen, give_up = len(self.samples), time.monotonic() + timeout_s
        while time.monotonic() < give_up:
            if any(status & mask == state for _, status, _ in self.samples[seen:]):
                return True
            time.sleep(0.01)
        return False

    def states_since(self, time_s: float) -> set[int]:
        return {status & 0x6F for at, status, _ in self.samples if at >= time_s}

    def largest_speed_radps(self, time_s: float) -> float:
        """Over `WINDOW_s` each: from one sample to the next, the loop may have been held up for a while."""
        kept = np.array([(at, position) for at, _, position in self.samples if at >= time_s])
        ends = np.searchsorted(kept[:, 0], kept[:, 0] + WINDOW_s)
        starts = np.flatnonzero(ends < len(kept))
        assert len(starts) > 100
        way_s, way_rad = (kept[ends[starts]] - kept[starts]).T
        return float(np.abs(way_rad / way_s).max())


def gone(pid: int, timeout_s: float = 10.0) -> bool:
    """Wait until the process has ended (a zombie has)."""
    give_up = time.monotonic() + timeout_s
    while time.monotonic() < give_up:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.01)
    return False


class Moving:
    """A joint in motion under `jointctl run`, with an onlooker; `loop` is the process id of the compiled loop."""

    def __init__(self, bench: Any, **changes: Any) -> None:
        self.bench = bench
        self.config = bench.config(
            trajectory__duration_s=60.0, sequence__supervisor_timeout_s=0.8, **changes
        )  # fmt: skip
        self.hil = bench.joint_process(self.config)
        self.witness = Witness(bench)
        try:
            self.run = bench.start("run", self.config, "-y").saw("  tracking")
            (self.loop,) = self.run.children()
            assert self.witness.saw(ENABLED)
        except BaseException:
            self.close()  # or its thread tells the next test that the bus has gone
            raise
        self.since_s = time.time()

    def close(self) -> None:
        self.witness.network.disconnect()


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
    give_up = time.monotonic() + 5.0
    while HEARTBEAT_LOST not in moving.witness.emergencies:
        assert time.monotonic() < give_up, moving.witness.emergencies
        time.sleep(0.01)
    time.sleep(0.5)  # the quick stop ramp
    assert moving.bench.disabled()


def test_the_next_run_takes_over_a_drive_that_its_watchdog_stopped(bench: Any) -> None:
    moving = Moving(bench)
    os.kill(moving.run.process.pid, signal.SIGSTOP)
    os.kill(moving.loop, signal.SIGKILL)
    moving.run.signal(signal.SIGKILL)
    time.sleep(1.0)
    moving.close()
    done = bench.run("run", bench.config(), "-y")
    assert done.code == 0, done.err
    assert bench.disabled()


def test_loop_that_hangs_is_ended_and_the_drive_has_stopped(moving: Any) -> None:
    os.kill(moving.loop, signal.SIGSTOP)
    done = moving.run.finished(20.0)
    done.refused(7, "the loop process did nothing")
    assert HEARTBEAT_LOST in moving.witness.emergencies
    assert gone(moving.loop)
    assert moving.bench.disabled()


def test_joint_gone_the_run_ends_with_one_line(bench: Any) -> None:
    moving = Moving(bench)
    moving.close()  # its client would fail with the bus
    moving.hil.signal(signal.SIGKILL)
    started = time.monotonic()
    done = moving.run.finished(30.0)
    assert time.monotonic() - started < 25.0
    assert done.code == 7, done.err
    done.refused(7)
    assert "STALE_SAMPLE" in done.err or "BUS_ERROR" in done.err
    assert gone(moving.loop)
