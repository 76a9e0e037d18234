"""The drives of an arm on one bus: off before any is commissioned, each with its watchdog, switched off at once."""

from __future__ import annotations

import dataclasses
import functools
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.drive import UNTOUCHED, DriveGroup, at_once, common_state, is_safe
from jointctl.drivers.errors import BusError, DeviceError, NoDeviceError, UsageError
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.canopen.records import NmtState, PowerState
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config
from jointctl.tools.verbs import bench_drive
from jointctl.tools.virtual_joint import new_devices
from tests.device_on_bus import DeviceOnBus
from tests.places import CONFIGS
from tests.python_process import run_python

NODES = (1, 2, 3)
HEARTBEAT = 0x700 + 126


class Drives:
    """Several virtual drives as one for `DeviceOnBus`."""

    def __init__(self, devices: list[Cia402Device]) -> None:
        self.devices, self.settings = devices, devices[0].settings

    def handle(self, frame: bytes, now_ns: int) -> list[bytes]:
        return [answer for device in self.devices for answer in device.handle(frame, now_ns)]

    def advance(self, now_ns: int) -> list[bytes]:
        return [answer for device in self.devices for answer in device.advance(now_ns)]


@dataclasses.dataclass
class Arm:
    bus: DeviceOnBus
    drives: Drives
    group: DriveGroup

    def device(self, axis: int) -> Any:
        return self.drives.devices[axis].device[0]

    def objects(self, axis: int, index: int, sub: int = 0) -> int:
        return int(self.drives.devices[axis].objects.value(index, sub))

    def power_up(self, axis: int) -> None:
        """As another program has left it: enabled, at rest."""
        for word in (0x06, 0x07, 0x0F):
            data = struct.pack("<BHBI", 0x2B, 0x6040, 0, word)
            for frame in (struct.pack("<IB3x8s", 0x600 + NODES[axis], 8, data),):
                self.drives.handle(frame, self.bus.now_ns)
        assert self.device(axis).state == PowerState.OPERATION_ENABLED

    def written(self, node: int) -> list[int]:
        """Objects of a node that have been written over SDO."""
        return [
            struct.unpack_from("<H", data, 1)[0]
            for identifier, data in self.bus.requests
            if identifier == 0x600 + node and data[0] >> 5 == 1
        ]


def settings_of(settings: CanopenSettings, node: int) -> CanopenSettings:
    return dataclasses.replace(settings, node=node)


@pytest.fixture
def arm(settings_of_virtual_joint: CanopenSettings) -> Iterator[Arm]:
    config = load_config(CONFIGS / "virtual.toml")
    settings_of_virtual_joint = dataclasses.replace(settings_of_virtual_joint, sdo_timeout_s=1.0)
    configs = [config.changed(drive__node=node) for node in NODES]
    drives = Drives(new_devices(configs))
    with DeviceOnBus(drives, settings_of_virtual_joint) as bus:  # type: ignore[arg-type]
        first = bus.drive(settings_of_virtual_joint)
        others = [CanopenDrive(first, settings_of(settings_of_virtual_joint, n), sleep=first._sleep) for n in NODES[1:]]
        group = DriveGroup([first, *others])
        yield Arm(bus, drives, group)
        group.close()


@pytest.mark.parametrize("names", [["a.toml", "b.toml"], []])
def test_a_refusal_names_the_joint_whose_drive_it_is(
    arm: Arm, monkeypatch: pytest.MonkeyPatch, names: list[str]
) -> None:
    first, second = arm.group.drives[:2]
    refusal = Mock(side_effect=DeviceError("drive.rated_torque_Nm (=0.9) does not agree", "correct it"))
    monkeypatch.setattr(second, "commission", refusal)
    with pytest.raises(DeviceError) as refused:
        DriveGroup([first, second], names=names).commission()
    assert refused.value.message == f"{'b.toml: ' if names else ''}drive.rated_torque_Nm (=0.9) does not agree"
    assert refused.value.hint == "correct it"


def test_each_drive_is_commissioned_and_its_watchdog_proven(arm: Arm) -> None:
    reports = arm.group.commission()
    assert len(reports) == len(NODES)
    for axis in range(len(NODES)):
        assert reports[axis].settings["watchdog detects"] == "EMCY 8130h"
        assert arm.objects(axis, 0x1016, 1) == 126 << 16 | 200
        assert arm.objects(axis, 0x6007) == 3
        assert arm.objects(axis, 0x1400, 5) == 100
        assert arm.device(axis).nmt == NmtState.PRE_OPERATIONAL  # the proofs of the others have put none to sleep
        assert arm.device(axis).state == PowerState.SWITCH_ON_DISABLED
    arm.group.start_cyclic()
    arm.bus.settle()
    assert [int(arm.device(axis).nmt) for axis in range(3)] == [NmtState.OPERATIONAL] * 3
    ports = arm.group.port()
    assert list(ports.rpdo_id) == [0x201, 0x202, 0x203]
    assert list(ports.tpdo_id) == [0x181, 0x182, 0x183]
    assert len(np.unique(ports.own_heartbeat_id)) == 1


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_nothing_is_written_to_any_drive_before_all_have_been_found(arm: Arm, lost: int) -> None:
    del arm.drives.devices[lost]
    with pytest.raises(NoDeviceError, match=f"node {NODES[lost]} does not answer"):
        arm.group.commission()
    assert [arm.written(node) for node in NODES] == [[], [], []]


@pytest.mark.parametrize("enabled", [0, 1, 2])
def test_a_drive_that_is_found_enabled_is_left_as_it_is_without_the_users_word(arm: Arm, enabled: int) -> None:
    """No proof of another one's watchdog stops it either: its load would not have been asked about."""
    arm.power_up(enabled)
    with pytest.raises(DeviceError, match=f"node {NODES[enabled]} is operation enabled"):
        arm.group.commission()
    assert arm.device(enabled).state == PowerState.OPERATION_ENABLED
    assert not [identifier for identifier, _ in arm.bus.requests if identifier == HEARTBEAT]


@pytest.mark.parametrize("enabled", [0, 1, 2])
def test_its_twin_is_braked_first_with_the_users_word(arm: Arm, enabled: int) -> None:
    arm.power_up(enabled)
    asked: list[str] = []

    def yes(question: str) -> bool:
        assert not [identifier for identifier, _ in arm.bus.requests if identifier == HEARTBEAT]
        asked.append(question)
        return True

    reports = arm.group.commission(yes)
    assert len(asked) == 1
    assert ["braked" in " ".join(report.remarks) for report in reports] == [axis == enabled for axis in range(3)]


@pytest.mark.parametrize(
    ("identifier", "data", "words"),
    [
        (0x202, bytes(4), "RPDO to node 2"), (0x603, bytes.fromhex("4000100000000000"), "SDO request"),
        (0, bytes([1, 2]), "NMT 'start' to node 2"), (0x80, b"", "SYNC"),
    ],
)  # fmt: skip
def test_another_controller_of_any_joint_refuses_the_arm(arm: Arm, identifier: int, data: bytes, words: str) -> None:
    arm.bus.send(identifier, data)
    with pytest.raises(BusError, match=words):
        arm.group.commission()
    assert [arm.written(node) for node in NODES] == [[], [], []]


def test_and_a_stranger_on_the_bus_is_a_remark_but_no_drive_of_the_arm_is_one(arm: Arm) -> None:
    arm.bus.send(0x709, b"\x05")
    assert all("heartbeats of 9" in " ".join(report.remarks) for report in arm.group.commission())


@pytest.mark.parametrize("changed", [0, 1, 2])
def test_no_drive_is_started_if_one_has_lost_what_stops_it(arm: Arm, changed: int) -> None:
    arm.group.commission()
    arm.drives.devices[changed].objects.store(0x6007, 0, struct.pack("<h", 0))
    with pytest.raises(DeviceError, match="6007"):
        arm.group.start_cyclic()
    arm.bus.settle()
    assert [int(arm.device(axis).nmt) for axis in range(3)] == [NmtState.PRE_OPERATIONAL] * 3


@pytest.mark.parametrize("deaf", [0, 1, 2])
def test_a_drive_that_does_not_answer_keeps_no_other_one_from_being_switched_off(
    arm: Arm, deaf: int, short_timeout: None
) -> None:
    arm.group.commission()
    for axis in range(3):
        arm.power_up(axis)
    devices = list(arm.drives.devices)
    lost = arm.drives.devices.pop(deaf)
    states = arm.group.make_safe()
    assert [is_safe(state) for state in states] == [axis != deaf for axis in range(3)]
    assert [int(each.device[0].state) == PowerState.OPERATION_ENABLED for each in devices] == [
        each is lost for each in devices
    ]  # fmt: skip
    said = common_state(("a", "b", "c"), states)
    assert said.startswith(f"{'abc'[deaf]}: unknown")
    assert not is_safe(said)


@pytest.mark.parametrize("room", [0, 1, 2])
def test_each_drive_is_switched_off_where_no_more_threads_can_be_started(
    arm: Arm, room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.group.commission()
    for axis in range(3):
        arm.power_up(axis)
    start, left = threading.Thread.start, iter(range(room))

    def start_if_allowed(thread: threading.Thread) -> None:
        if next(left, None) is None:
            raise RuntimeError("can't start new thread")
        start(thread)

    with monkeypatch.context() as scarce:
        scarce.setattr(threading.Thread, "start", start_if_allowed)
        states = arm.group.make_safe()
    assert [is_safe(state) for state in states] == [True] * 3
    assert not any(int(arm.device(axis).state) == PowerState.OPERATION_ENABLED for axis in range(3))


@pytest.mark.parametrize("threads", [True, False])
def test_an_error_of_one_is_raised_when_all_have_been_tried(monkeypatch: pytest.MonkeyPatch, threads: bool) -> None:
    tried = []

    def call(number: int) -> int:
        tried.append(number)
        if number != 1:
            raise BusError(f"no answer of {number}")
        return number

    def exhausted(_: object) -> None:
        raise RuntimeError("can't start new thread")

    if not threads:
        monkeypatch.setattr(threading.Thread, "start", exhausted)
    with pytest.raises(BusError, match="no answer of 0"):
        at_once([functools.partial(call, number) for number in range(3)])
    assert sorted(tried) == [0, 1, 2]


GROUP = """
import threading
from jointctl.drivers.drive import DriveGroup

all_of_them = threading.Barrier(3)

class Waiting:
    def make_safe(self, asked):
        all_of_them.wait(60.0)
        return "off"

def session():
    threading.main_thread().join({wait_s})
    print(DriveGroup([Waiting()] * 3).make_safe())

thread = threading.Thread(target=session)
thread.start()
thread.join({ends_s})
"""


@pytest.mark.parametrize(("wait_s", "ends_s"), [(0.0, None), (None, 0.0)])
def test_drives_are_switched_off_at_the_same_time_also_when_the_main_thread_has_ended(
    wait_s: float | None, ends_s: float | None
) -> None:
    """A program may have its arm in a thread of its own, which ends when it likes."""
    assert run_python(GROUP.format(wait_s=wait_s, ends_s=ends_s)) == "['off', 'off', 'off']\n"


@pytest.mark.parametrize(
    ("states", "common", "safe"),
    [
        (("off", "off"), "off", True), (("off", "fault"), "off, b: fault", True),
        (("off", UNTOUCHED), f"off, b: {UNTOUCHED}", True), ((UNTOUCHED, UNTOUCHED), UNTOUCHED, False),
        (("off", "operation enabled"), "b: operation enabled", False),
        (("unknown: x", UNTOUCHED), "a: unknown: x", False), (("unknown: x",), "unknown: x", False),
    ],
)  # fmt: skip
def test_an_arm_is_off_only_if_every_drive_is(states: tuple[str, ...], common: str, safe: bool) -> None:
    assert common_state(("a", "b")[: len(states)], states) == common
    assert is_safe(common) is safe


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    """An arm of three joints, whose files are named after their nodes."""
    text = (CONFIGS / "virtual.toml").read_text()
    for node in NODES:
        (tmp_path / f"{node}.toml").write_text(text.replace("node = 1", f"node = {node}", 1))
    path = tmp_path / "arm.toml"
    path.write_text('[arm]\njoints = ["1.toml", "2.toml", "3.toml"]\n')
    return path


def nodes_of(targets: dict[str, Any]) -> dict[str, int]:
    return {name: target.node for name, target in targets.items()}


def test_stop_finds_every_joint_of_an_arm_whatever_else_its_files_say(arm_file: Path) -> None:
    with arm_file.open("a") as file:
        file.write("this is no TOML\n")
    targets, unread = bench_drive.stop_targets(arm_file)
    assert (nodes_of(targets), unread) == ({"1.toml": 1, "2.toml": 2, "3.toml": 3}, [])
    arm_file.with_name("2.toml").unlink()
    targets, unread = bench_drive.stop_targets(arm_file)
    assert nodes_of(targets) == {"1.toml": 1, "3.toml": 3}
    assert len(unread) == 1


def test_a_node_that_is_given_is_not_that_of_every_joint_of_an_arm(arm_file: Path) -> None:
    """One drive asked three times was said to be three that are off."""
    targets, (problem,) = bench_drive.stop_targets(arm_file, GivenPlace(node=2))
    assert list(nodes_of(targets).values()) == [1, 2, 3]
    assert isinstance(problem, UsageError)
    assert problem.message.startswith(f"--target (=2) is one joint's, and {arm_file} is an arm")
    targets, unread = bench_drive.stop_targets(arm_file.with_name("1.toml"), GivenPlace(node=2))
    assert (nodes_of(targets), unread) == ({"1.toml": 2}, [])
