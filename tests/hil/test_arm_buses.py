"""The shipped arm on two buses in real time: the wrist has the shoulder's node on a bus of its own."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.canopen.cia import State
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.realtime_device import RealtimeDevice
from jointctl.hil.virtual_bus import VirtualBusHub, default_socket_path
from jointctl.tools.configuration.arm import load_arm
from jointctl.tools.experiments.judge import POWERED
from jointctl.tools.virtual_joint import arm_plant_of, new_devices
from tests.hil.test_arm_run import NAMES, OFF, ArmBench, powered_together
from tests.python_process import eventually
from tests.real_time_joint import schedule_compiled


def on_two_buses(path: Path, channel: str) -> None:
    wrist = path.parent / "wrist.toml"
    text = wrist.read_text().replace(f'channel = "{channel}"', f'channel = "{channel}.2"')
    wrist.write_text(text.replace("node = 3", "node = 1"))


class TwoBuses(ArmBench):
    """The arm's files on two buses of the test's own, and its virtual drives in a process of their own."""

    def __init__(self, bench: Any) -> None:
        self.bench, path = bench, bench.arm()
        on_two_buses(path, bench.channel)
        self.path, self.folder = str(path), path.parent
        self.channels = bench.channel, f"{bench.channel}.2"

    def serve(self) -> Any:
        started = self.bench.start("hil", self.path).saw("Ctrl-C ends it")
        assert "virtual arm: nodes 1, 2 on jointctl:" in started.err
        assert f"; node 1 on jointctl:{self.channels[1]}" in started.err
        return started

    def states(self) -> list[State]:
        """Of each drive, over SDO, in the order of the joints."""
        found = []
        for channel, nodes in zip(self.channels, ((1, 2), (1,)), strict=True):
            with can.Bus(interface="jointctl", channel=channel) as bus:
                bus.send(can.Message(arbitration_id=0, data=[0x80, 0], is_extended_id=False))
                found += [self._state(bus, node) for node in nodes]
        return found


@pytest.fixture
def arm(bench: Any) -> Iterator[TwoBuses]:
    made = TwoBuses(bench)
    drives = made.serve()
    yield made
    drives.signal(signal.SIGTERM)
    drives.finished(30.0)


def test_three_joints_on_two_buses_move_together(arm: TwoBuses) -> None:
    path = arm.folder / "arm.toml"
    path.write_text(path.read_text().replace("duration_s = 20.0", "duration_s = 2.0"))
    done = arm.bench.run("run", arm.path, "-y", "--json")
    assert done.code == 0, done.err
    joints = json.loads(done.out)["joints"]
    assert [joint["fault"] for joint in joints] == [None] * 3
    assert joints[0]["bus_load"] > 1.5 * joints[2]["bus_load"] > 0.0  # two drives against one
    spread = joints[0]["sync_spread"]
    assert spread["count"] > 1000
    logs = arm.logs()
    assert any("SYNC of all buses within" in event.text for event in logs[0].events)
    assert powered_together(logs)


@pytest.mark.parametrize("file", ["arm", "elbow", "wrist"])
def test_stop_on_a_file_of_either_bus_stops_the_arm(arm: TwoBuses, file: str) -> None:
    run = arm.tracking()
    stopped = arm.bench.run("stop", str(arm.folder / f"{file}.toml"))
    assert stopped.code == 0, stopped.err
    assert run.finished(30.0).code == 130
    assert all(state in OFF for state in arm.states())


def test_each_bus_is_locked(arm: TwoBuses) -> None:
    run = arm.tracking()
    arm.bench.run("run", str(arm.folder / "wrist.toml"), "-y").refused(4, "another program controls")
    run.signal(signal.SIGINT)
    assert run.finished(30.0).code == 130


@pytest.mark.parametrize("lost", [0, 1])
def test_a_bus_that_is_lost_stops_all_joints(bench: Any, lost: int) -> None:
    """Drives and buses in this process, so that one bus can go alone."""
    made = TwoBuses(bench)
    config = load_arm(made.path)
    with ExitStack() as stack:
        hubs = [VirtualBusHub(default_socket_path(channel), 1_000_000, False) for channel in made.channels]
        for hub in hubs:
            stack.enter_context(hub)
        devices = new_devices(config.joints)
        ends = [stack.enter_context(can.Bus(interface="jointctl", channel=channel)) for channel in made.channels]
        fds = [ends[0].fileno(), ends[0].fileno(), ends[1].fileno()]
        stack.enter_context(RealtimeDevice(devices, fds, arm_plant_of(config)))
        schedule_compiled()
        run = made.tracking()
        hubs[lost].stop()
        done = run.finished(30.0)
        assert done.code == 7, done.err
        assert any(f"{name}: BUS_ERROR" in done.err for name in (NAMES[:2], NAMES[2:])[lost])
        eventually(lambda: not any(int(device.device[0].state) in POWERED for device in devices), 3.0)
    logs = made.logs()
    faults = [int(log.records.fault[-1]) for log in logs]
    blamed = {NAMES[axis] for axis in range(3) if faults[axis] == Fault.BUS_ERROR}
    assert blamed <= set((NAMES[:2], NAMES[2:])[lost])
    began = [int(log.records.cycle[np.argmax(log.records.phase >= AxisPhase.RAMPING)]) for log in logs]
    assert max(began) - min(began) <= 1
