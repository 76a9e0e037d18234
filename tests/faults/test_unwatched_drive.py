"""Ways in which a drive could have had power with nobody watching, each closed; every one with its twin."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen import exchange, switch_off
from jointctl.drivers.canopen.cia import ControlWord, State
from jointctl.drivers.canopen.cyclic import (
    FRAME_SLOTS,
    IGNORED_MAX_CYCLES,
    SLOT_RPDO,
    CanopenPort,
    accept_frame,
    end_cycle,
    get_i16,
    get_u16,
)
from jointctl.drivers.drive import is_safe
from jointctl.drivers.errors import BusError, DeviceError
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest
from jointctl.hil.canopen.device_core import power_on
from jointctl.hil.canopen.records import NmtState

ENABLED, DISABLED = 0x0637, 0x0650
WATCHDOG = 126 << 16 | 200  # 1016:1 as configs/virtual.toml arms it


def consumer_heartbeat(bus: Any) -> int:
    return int(bus.device.device[0].communication.consumer_heartbeat[0])


def nmt_state(bus: Any) -> NmtState:
    return NmtState(int(bus.device.device[0].nmt))


# --- a drive that does not switch off keeps its watchdog ---
@pytest.mark.parametrize(("status", "watchdog"), [(ENABLED, WATCHDOG), (DISABLED, 0)])
def test_the_watchdog_is_only_disarmed_in_a_drive_that_is_off(joint: Any, status: int, watchdog: int) -> None:
    with joint.commissioned() as drive:
        assert consumer_heartbeat(joint) == WATCHDOG
        joint.answers[0x6041, 0] = status
        drive.make_safe()
        assert consumer_heartbeat(joint) == watchdog


def test_make_safe_reaches_a_drive_that_its_watchdog_stops_meanwhile(
    joint: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with joint.commissioned() as drive:
        brake = switch_off.brake

        def stopped_meanwhile(objects: Any, sleep: Any, longest_s: float) -> None:
            monkeypatch.setattr(switch_off, "brake", brake)
            drive._node.nmt.send_command(2)
            brake(objects, sleep)

        monkeypatch.setattr(switch_off, "brake", stopped_meanwhile)
        assert drive.make_safe() == "switch on disabled"  # "stopped" answers no SDO: pre-operational once more


# --- between commissioning and the user's "yes" ---
def another_program_stops_it(bus: Any) -> None:
    assert bus.stop_drive() == "switch on disabled"


def its_supply_is_switched_off_and_on(bus: Any) -> None:
    power_on(bus.device.device[0])
    bus.device.advance(bus.now_ns)


def another_mode_is_chosen(bus: Any) -> None:
    bus.answers[0x6061, 0] = 9


@pytest.mark.parametrize(
    ("meanwhile", "words"),
    [
        (another_program_stops_it, "another controller is active on this bus: .*NMT 'enter pre operational' to node 1"),
        (its_supply_is_switched_off_and_on, "has changed since it was commissioned"),
        (another_mode_is_chosen, "6061 shows mode 9, it was 10"),
    ],
)
def test_a_drive_that_has_changed_since_it_was_commissioned_is_not_started(
    joint: Any, meanwhile: Callable[[Any], None], words: str
) -> None:
    with joint.commissioned() as drive:
        meanwhile(joint)
        with pytest.raises((BusError, DeviceError), match=words):
            drive.start_cyclic()
        assert nmt_state(joint) != NmtState.OPERATIONAL


def test_a_drive_that_is_as_it_was_is_started(joint: Any) -> None:
    with joint.commissioned() as drive:
        drive.start_cyclic()
        assert drive._objects.read(0x1016, 1, what="watchdog") == WATCHDOG
        assert nmt_state(joint) == NmtState.OPERATIONAL


# --- no enabling once the heartbeat is withheld ---
class Wire:
    def __init__(self) -> None:
        self.ports = new(CanopenPort)
        port = self.port = self.ports[0]
        port.tpdo_id, port.rpdo_id, port.tpdo_length, port.rpdo_length = 0x185, 0x205, 8, 4
        port.status_at, port.position_at, port.torque_at, port.control_at, port.target_at = 0, 2, 6, 0, 2
        port.position_radpcount, port.torque_Nmppermille, port.max_permille = 1e-5, 0.06, 1000
        port.state = State.UNDEFINED
        self.frames = new(Frame, FRAME_SLOTS)
        self.samples, self.commands = new(Sample), new(Command)

    def tpdo(self, status: int) -> None:
        frame = new(Frame)[0]
        frame.can_id, frame.length = 0x185, 8
        frame.payload[0], frame.payload[1] = status & 0xFF, status >> 8
        assert accept_frame(self.port, frame, self.samples[0], 1)

    def rpdo(self, request: DriveRequest, torque_Nm: float = 6.0) -> tuple[int, int]:
        """(controlword, target)"""
        self.commands[0].request, self.commands[0].torque_Nm = request, torque_Nm
        end_cycle(self.port, self.frames, self.samples[0], self.commands[0])
        payload = self.frames[SLOT_RPDO].payload
        return get_u16(payload, 0), get_i16(payload, 2)


@pytest.mark.parametrize(
    ("cycles", "enables"),
    [(IGNORED_MAX_CYCLES - 1, True), (IGNORED_MAX_CYCLES, True), (IGNORED_MAX_CYCLES + 1, False), (100, False)],
)
def test_without_a_heartbeat_the_drive_is_never_enabled(cycles: int, enables: bool) -> None:
    wire = Wire()
    wire.tpdo(ENABLED)
    for _ in range(cycles):  # it was enabled before anybody asked, and does not hear us
        assert wire.rpdo(DriveRequest.OFF) == (ControlWord.DISABLE_VOLTAGE, 0)
    wire.tpdo(DISABLED)  # its watchdog has stopped it; nothing watches any more
    wire.rpdo(DriveRequest.OFF)
    expected = ControlWord.SHUTDOWN if enables else ControlWord.DISABLE_VOLTAGE
    assert wire.rpdo(DriveRequest.ENABLE) == (expected, 0)
    wire.tpdo(ENABLED)
    expected = ControlWord.ENABLE_OPERATION if enables else ControlWord.DISABLE_VOLTAGE
    assert wire.rpdo(DriveRequest.ENABLE) == (expected, 100 if enables else 0)


# --- SYNC gets through, the RPDO never: the drive keeps its last torque ---
@pytest.mark.parametrize("lost", [True, False])
def test_an_rpdo_that_is_never_sent_counts_although_sync_is(lost: bool) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        wire = Wire()
        link = exchange.link_of(wire.ports)._replace(frames=wire.frames)
        for cycle in range(1, 8):
            wire.port.fd = ours.fileno()
            exchange.receive(link, wire.samples, np.int64(0), np.int64(0))
            if lost:
                wire.port.fd = -1
            exchange.send(link, wire.samples, wire.commands)
            assert wire.samples[0].bus_errors == (cycle if lost else 0)


# --- `jointctl stop` says what is true ---
@pytest.mark.parametrize(
    ("state", "safe"),
    [
        ("switch on disabled", True), ("fault", True), ("off", True), ("off, fault: overspeed", True),
        ("fault reaction active", False), ("quick stop active", False), ("operation enabled", False),
        ("unknown: no answer", False),
    ],
)  # fmt: skip
def test_states_in_which_the_power_stage_is_off(state: str, safe: bool) -> None:
    assert is_safe(state) is safe
