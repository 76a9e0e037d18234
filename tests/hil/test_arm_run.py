"""The shipped arm of three joints in real time, from the command line: run, stop, and what dies on the way."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import time
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.canopen.cia import NmtState, State, state_of_word
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault
from jointctl.tools.recording.run_log_reader import read_run_log

NODES = (1, 2, 3)
NAMES = ("shoulder", "elbow", "wrist")
OFF = (State.SWITCH_ON_DISABLED, State.FAULT)


class ArmBench:
    """The shipped arm's files on a bus of the test's own, `more` at the end of each joint's, and its virtual drives."""

    def __init__(self, bench: Any, more: str = "") -> None:
        self.bench, path = bench, bench.arm()
        self.path, self.folder = str(path), path.parent
        for name in NAMES:
            with (self.folder / f"{name}.toml").open("a") as file:
                file.write(more)
        bench.arm_joints(path)

    def tracking(self) -> Any:
        """A run that tracks by now."""
        return self.bench.start("run", self.path, "-y").saw("  tracking")

    def states(self) -> list[State]:
        """Of each drive, over SDO; one whose watchdog has stopped its node answers in pre-operational."""
        with can.Bus(interface="jointctl", channel=self.bench.channel) as bus:
            bus.send(can.Message(arbitration_id=0, data=[0x80, 0], is_extended_id=False))
            return [self._state(bus, node) for node in NODES]

    @staticmethod
    def _state(bus: can.BusABC, node: int) -> State:
        request = struct.pack("<BHB4x", 0x40, 0x6041, 0)
        bus.send(can.Message(arbitration_id=0x600 + node, data=request, is_extended_id=False))
        give_up_s = time.monotonic() + 3.0
        while time.monotonic() < give_up_s:
            answer = bus.recv(0.1)
            if answer is not None and answer.arbitration_id == 0x580 + node:
                return state_of_word(int.from_bytes(answer.data[4:6], "little"))
        pytest.fail(f"node {node} does not answer")

    def all_off(self, within_s: float = 2.0) -> bool:
        give_up_s = time.monotonic() + within_s
        states = self.states()
        while not all(state in OFF for state in states):
            if time.monotonic() > give_up_s:
                pytest.fail(f"not off: {states}")
            states = self.states()
        return True

    def stopped_by_watchdog(self, within_s: float = 3.0) -> bool:
        """Whether each node says by its heartbeat that it has stopped (1029:1); nothing is sent to it."""
        stopped: set[int] = set()
        give_up_s = time.monotonic() + within_s
        with can.Bus(interface="jointctl", channel=self.bench.channel) as bus:
            while len(stopped) < len(NODES) and time.monotonic() < give_up_s:
                heard = bus.recv(0.1)
                if heard is not None and heard.arbitration_id - 0x700 in NODES and heard.data[0] == NmtState.STOPPED:
                    stopped.add(heard.arbitration_id - 0x700)
        return stopped == set(NODES)

    def logs(self) -> list[Any]:
        """Of the newest run, in the order of the joints."""
        return [read_run_log(max(self.bench.folder.glob(f"runs/*.{name}.mcap"))) for name in NAMES]


def powered_together(logs: list[Any]) -> bool:
    """Whether torque begins and ends in the same cycle."""
    together = np.stack([log.records.phase for log in logs])
    powered = (together >= AxisPhase.APPROACH) & (together <= AxisPhase.RAMPING)
    return bool(np.all(powered.all(axis=0) == powered.any(axis=0)))


@pytest.fixture
def arm(bench: Any) -> ArmBench:
    return ArmBench(bench)


def test_demo_moves_three_joints_and_leaves_a_log_of_each(bench: Any) -> None:
    done = bench.run("demo", "--arm", "--duration", "2.0", "--json")
    assert done.code == 0, done.err
    joints = json.loads(done.out)["joints"]
    assert [joint["name"] for joint in joints] == list(NAMES)
    assert [joint["fault"] for joint in joints] == [None] * 3
    assert {joint["drive_state"] for joint in joints} == {"switch on disabled"}
    assert 0.3 < joints[0]["bus_load"] < 0.8  # 74.5 % at 1 kHz with the longest frames, without skipped slots
    logs = [read_run_log(bench.folder / joint["log"]) for joint in joints]
    assert len({len(log.records) for log in logs}) == 1
    for log in logs:
        assert np.ptp(log.records.position_rad[log.records.phase == AxisPhase.TRACKING]) > 0.1
        assert log.records.drive_state[-1] == DriveState.OFF
    assert powered_together(logs)


@pytest.mark.parametrize("joint", ["arm", "elbow"])
def test_stop_on_the_arms_file_and_on_a_joints_file_stops_all(arm: ArmBench, joint: str) -> None:
    run = arm.tracking()
    stopped = arm.bench.run("stop", str(arm.folder / f"{joint}.toml"))
    assert stopped.code == 0, stopped.err
    assert run.finished(30.0).code == 130
    assert arm.all_off()


def test_ctrl_c_brakes_all_joints_along_their_ramps(arm: ArmBench) -> None:
    run = arm.tracking()
    run.signal(signal.SIGINT)
    assert run.finished(30.0).code == 130
    assert arm.all_off()
    for log in arm.logs():
        phases = [AxisPhase(int(p)) for p in np.unique(log.records.phase)]
        assert AxisPhase.RAMPING in phases
        assert AxisPhase.QUICK_STOPPING not in phases


@pytest.mark.parametrize("node", NODES)
def test_a_drive_that_restarts_stops_the_others_along_their_ramps(arm: ArmBench, node: int) -> None:
    run = arm.tracking()
    with can.Bus(interface="jointctl", channel=arm.bench.channel) as bus:
        bus.send(can.Message(arbitration_id=0, data=[0x81, node], is_extended_id=False))
    done = run.finished(30.0)
    assert done.code in (4, 7), done.err
    assert arm.all_off()


@pytest.mark.parametrize("dies", ["loop", "both"])
def test_loop_or_all_killed_every_drive_stops_by_its_own_watchdog(arm: ArmBench, dies: str) -> None:
    run = arm.tracking()
    loop = run.child("loop_process")
    if dies == "both":
        run.signal(signal.SIGKILL)
    os.kill(loop, signal.SIGKILL)
    if dies == "loop":
        assert run.finished(30.0).code == 7
    else:
        assert arm.stopped_by_watchdog()
    assert arm.all_off()


def test_one_drive_of_three_missing_moves_nothing(arm: ArmBench) -> None:
    path = arm.folder / "wrist.toml"
    path.write_text(path.read_text().replace("node = 3", "node = 9"))
    done = arm.bench.run("run", arm.path, "-y")
    done.refused(5, "node 9 does not answer")
    assert arm.all_off()


def test_the_fault_of_one_joint_is_named_with_it(arm: ArmBench) -> None:
    path = arm.folder / "elbow.toml"
    text = re.sub(r"(?m)^following_error_max_rad = \S+", "following_error_max_rad = 0.00002", path.read_text())
    path.write_text(text)
    done = arm.bench.run("run", arm.path, "-y")
    assert done.code == 7, done.err
    assert "elbow: FOLLOWING_ERROR" in done.err
    assert arm.all_off()
    faults = [int(log.records.fault[-1]) for log in arm.logs()]
    assert faults == [Fault.NONE, Fault.FOLLOWING_ERROR, Fault.NONE]
