"""Real processes that are killed right after a chosen frame of a run: every drive is off in time, and off for good.

The same after every frame, at simulated time: tests/bench/every_frame.py.
"""

from __future__ import annotations

import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import can
import pytest

from jointctl.drivers.bus_lock import lock_name, marked_processes
from jointctl.drivers.canopen.cia import NMT_ID, RPDO1_ID, SDO_REQUEST_ID, SYNC_ID, NmtCommand
from jointctl.hil.canopen.records import PowerState
from jointctl.tools.configuration.arm import load_arm
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from tests.hil.moving_run import ENABLED, QUICK_STOP_ACTIVE, alive
from tests.real_time_joint import real_time_joint

NODE = 1  # of the joint, and of an arm's first one
FAULT_REACTION_ACTIVE = 0x0F  # of the statusword
POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
ENABLE = 0x0F  # controlword, from which on the loop counts
SHUTDOWN, SWITCH_ON, DISABLE = 0x06, 0x07, 0x00
FASTEST_RADPS, FASTEST_OF_ARM_RADPS = 0.25, 2.0  # of the motion
LONGEST_S = 180.0  # until the frame; the first start may have to compile
NOISE_S = 0.3  # by which a busy computer may see or do something later
IN_FLIGHT_S = 0.05  # a command that the dead have sent before
QUIET_S = 1.0  # for so long it must stay off
ENDED_S = 180.0  # for the processes that were not killed, which may have to compile first; it must stay off meanwhile
CHANGES: dict[str, Any] = {
    "sequence__approach_s": 0.3, "trajectory__duration_s": 0.5, "sequence__stop_timeout_s": 1.0,
    "sequence__off_timeout_s": 0.7, "sequence__supervisor_timeout_s": 0.8,
}  # fmt: skip


class Counts:
    """What the bus has carried so far."""

    def __init__(self) -> None:
        self.frames = self.requests = self.syncs = self.syncs_enabled = 0
        self.started = False  # NMT
        self.controlwords: list[int] = []  # each change

    def take(self, message: can.Message) -> None:
        self.frames += 1
        identifier, data = message.arbitration_id, bytes(message.data)
        if SDO_REQUEST_ID < identifier <= SDO_REQUEST_ID + 127:
            self.requests += 1
        elif identifier == SYNC_ID:
            self.syncs += 1
            self.syncs_enabled += ENABLE in self.controlwords
        elif identifier == NMT_ID and data[0] == NmtCommand.START:
            self.started = True
        elif identifier == RPDO1_ID + NODE:
            word = int.from_bytes(data[:2], "little")
            if self.controlwords[-1:] != [word]:
                self.controlwords.append(word)


Moment = Callable[[Counts], bool]


def sdo_request(number: int) -> Moment:
    return lambda seen: seen.requests >= number


def sync(number: int) -> Moment:
    """Of the loop, which waits with the drive off at first."""
    return lambda seen: seen.syncs >= number


def controlword(word: int) -> Moment:
    return lambda seen: word in seen.controlwords


def sync_after_enabling(number: int) -> Moment:
    return lambda seen: seen.syncs_enabled >= number


def disabling(seen: Counts) -> bool:
    return ENABLE in seen.controlwords and seen.controlwords[-1] == DISABLE


@dataclass
class Death:
    """A run, and what an onlooker saw of it: frames, and the truth about the power stages."""

    bench: Any
    config: Config
    path: str  # of its file
    fastest_radps: float
    devices: Any
    bus: can.BusABC
    counts: Counts = field(default_factory=Counts)
    changes: list[tuple[float, bool]] = field(default_factory=list)  # (time [s], whether there is power)
    killed_s: float = 0.0
    powered_then: bool = False

    @property
    def powered(self) -> bool:
        """Whether any drive is."""
        return any(device.device[0].state in POWERED for device in self.devices)

    def note_power(self) -> None:
        if self.powered != (self.changes[-1][1] if self.changes else False):
            self.changes.append((time.monotonic(), self.powered))

    def look(self, until_s: float, moment: Moment = lambda _: False) -> bool:
        """Take all that is sent until then; True right after the frame that makes it the moment."""
        while time.monotonic() < until_s:
            message = self.bus.recv(0.001)
            self.note_power()
            if message is not None:
                self.counts.take(message)
                if moment(self.counts):
                    return True
        return False

    def start(self, moment: Moment, names: tuple[str, ...]) -> None:
        """A run until the moment; then these die, the supervisor first, so that it cannot act on the loop's death."""
        self.run = self.bench.start("run", self.path, "-y")
        give_up_s = time.monotonic() + LONGEST_S
        while not (children := self.run.children()):
            assert self.run.process.poll() is None, self.run.err
            assert time.monotonic() < give_up_s
            time.sleep(0.02)
        (self.loop,) = children  # before anything is sent
        assert self.look(time.monotonic() + LONGEST_S, moment), self.run.err
        assert self.run.process.poll() is None, self.run.err
        for name, pid in (("supervisor", self.run.process.pid), ("loop", self.loop)):
            if name in names:
                os.kill(pid, signal.SIGKILL)
        self.note_power()  # before the time of death: what it sees had come by then
        self.killed_s, self.powered_then = time.monotonic(), bool(self.changes) and self.changes[-1][1]

    def has_ended(self) -> bool:
        return not (alive(self.run.process.pid) or alive(self.loop))

    def off_after_s(self) -> float:
        """From the death until the power went off for the last time; 0 where there was none."""
        return max((at_s - self.killed_s for at_s, on in self.changes if not on), default=0.0)

    def enabled_after_s(self) -> list[float]:
        return [at_s - self.killed_s for at_s, on in self.changes if on and at_s > self.killed_s]

    def judge(self, names: tuple[str, ...]) -> None:
        """Off in time, for a second and until the last process of the run has ended; and that none is left."""
        allowed_s = time_allowed_s(self.config, names, self.fastest_radps) + NOISE_S
        while time.monotonic() < self.killed_s + allowed_s and (self.powered or not self.has_ended()):
            self.look(time.monotonic() + 0.05)
        assert not self.powered, f"with power {allowed_s:.2f} s after the death"
        self.look(time.monotonic() + QUIET_S)
        while not self.has_ended():
            assert time.monotonic() < self.killed_s + ENDED_S, "a process of the run is left"
            self.look(time.monotonic() + 0.05)
        assert not marked_processes(lock_name("jointctl", self.bench.channel))
        assert not self.powered
        assert self.off_after_s() <= allowed_s
        enabled = self.enabled_after_s()
        assert len(enabled) <= (0 if self.powered_then else 1), enabled
        if "loop" in names:
            assert all(after_s <= IN_FLIGHT_S for after_s in enabled), enabled


def time_allowed_s(config: Config, names: tuple[str, ...], fastest_radps: float) -> float:
    """docs/safety.md: until the reaction begins, and what it takes."""
    sequence = config.sequence
    braking_s = fastest_radps / sequence.brake_radps2
    if "loop" in names:
        return 20.0 / config.loop.rate_Hz + canopen_section(config).heartbeat_s + braking_s
    return sequence.supervisor_timeout_s + braking_s + sequence.release_s


@pytest.fixture
def death(bench: Any) -> Iterator[Death]:
    config = load_config(bench.folder / bench.config(**CHANGES))
    with real_time_joint(config) as joint, can.Bus(interface="jointctl", channel=bench.channel) as bus:
        yield Death(bench, config, "joint.toml", FASTEST_RADPS, joint._devices, bus)
        bench.end()


@pytest.fixture
def death_of_arm(bench: Any) -> Iterator[Death]:
    short = {name.partition("__")[2]: value for name, value in CHANGES.items()}
    path = bench.arm(**{**short, "approach_s": 1.0})
    arm = load_arm(path)
    with real_time_joint(arm) as joints, can.Bus(interface="jointctl", channel=bench.channel) as bus:
        yield Death(bench, arm.joints[0], str(path), FASTEST_OF_ARM_RADPS, joints._devices, bus)
        bench.end()


LOOP, SUPERVISOR, BOTH = ("loop",), ("supervisor",), ("supervisor", "loop")
DEATHS: dict[str, tuple[Moment, tuple[str, ...]]] = {
    "commissioning, 10th SDO request, loop": (sdo_request(10), LOOP),
    "commissioning, 50th SDO request, both": (sdo_request(50), BOTH),
    "commissioning, 100th SDO request, supervisor": (sdo_request(100), SUPERVISOR),
    "NMT start, both": (lambda seen: seen.started, BOTH), "waiting, supervisor": (sync(150), SUPERVISOR),
    "enabling, switch on, both": (controlword(SWITCH_ON), BOTH), "enabling, loop": (controlword(ENABLE), LOOP),
    "approach, 5 ms, supervisor": (sync_after_enabling(5), SUPERVISOR),
    "approach, 60 ms, both": (sync_after_enabling(60), BOTH), "tracking, both": (sync_after_enabling(600), BOTH),
    "stopping, loop": (sync_after_enabling(850), LOOP), "disabling, supervisor": (disabling, SUPERVISOR),
}  # fmt: skip


@pytest.mark.parametrize(("moment", "names"), DEATHS.values(), ids=DEATHS)
def test_after_the_death_the_drive_is_off_in_time_and_stays_off(
    death: Death, moment: Moment, names: tuple[str, ...]
) -> None:
    death.start(moment, names)
    death.judge(names)
    if names == LOOP:
        death.run.finished(ENDED_S).refused(death.run.process.returncode, "the loop process")
        assert death.run.process.returncode > 0
    state = death.bench.status_word() & 0x6F  # as the drive tells an independent client
    assert state not in (ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE)


DEATHS_OF_ARM: dict[str, tuple[Moment, tuple[str, ...]]] = {
    "commissioning, 90th SDO request, both": (sdo_request(90), BOTH),
    "commissioning, 250th SDO request, supervisor": (sdo_request(250), SUPERVISOR),
    "NMT start, loop": (lambda seen: seen.started, LOOP), "enabling, both": (controlword(ENABLE), BOTH),
    "approach, 5 ms, loop": (sync_after_enabling(5), LOOP),
    "approach, 300 ms, both": (sync_after_enabling(300), BOTH),
    "tracking, supervisor": (sync_after_enabling(1200), SUPERVISOR),
    "tracking, both": (sync_after_enabling(1300), BOTH), "stopping, loop": (sync_after_enabling(1550), LOOP),
}  # fmt: skip


@pytest.mark.parametrize(("moment", "names"), DEATHS_OF_ARM.values(), ids=DEATHS_OF_ARM)
def test_after_the_death_every_drive_of_an_arm_is_off_in_time_and_stays_off(
    death_of_arm: Death, moment: Moment, names: tuple[str, ...]
) -> None:
    death_of_arm.start(moment, names)
    death_of_arm.judge(names)


def test_a_drive_without_its_watchdog_is_seen_to_keep_its_power(death: Death) -> None:
    """The checks above can fail: both are dead, and abort connection (6007) says that nothing is to be done."""
    death.start(sync_after_enabling(60), BOTH)
    no_action = struct.pack("<BHBI", 0x2B, 0x6007, 0, 0)
    death.bus.send(can.Message(arbitration_id=SDO_REQUEST_ID + NODE, data=no_action, is_extended_id=False))
    with pytest.raises(AssertionError, match="with power"):
        death.judge(BOTH)
