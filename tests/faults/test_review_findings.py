"""Ways in which torque could have been applied with nobody watching, each closed; every one with its twin."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.can.frames import Frame
from drivers.canopen import exchange, switch_off
from drivers.canopen.cia402 import ControlWord, State
from drivers.canopen.cyclic import UNHEEDED_MAX_CYCLES, accept_frame, end_cycle, get_i16, get_u16
from drivers.canopen.port import FRAME_SLOTS, SCRATCH_WORDS, SLOT_RPDO, CanopenPort
from drivers.drive import is_safe
from drivers.errors import DeviceError
from firmware_py.realtime import Histogram
from firmware_py.records import Command, Sample
from firmware_py.schema import new
from firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, StopRequest
from hil.canopen.device_core import power_on
from hil.canopen.device_records import NmtState
from tests.unit.drivers.elmo.talk import Talk
from tests.unit.firmware_py.test_realtime import ANSWER_ns, Loop
from tools.running.supervisor import Supervisor

ENABLED, DISABLED = 0x0637, 0x0650
WATCHDOG = 126 << 16 | 200  # 1016:1 as configs/virtual.toml arms it


def consumer_heartbeat(bus: Any) -> int:
    return int(bus.device.device[0].communication.consumer_heartbeat[0])


def nmt_state(bus: Any) -> NmtState:
    return NmtState(int(bus.device.device[0].nmt))


# --- a drive that does not switch off keeps its watchdog -----------------------------------------------------------


@pytest.mark.parametrize(("status", "watchdog"), [(ENABLED, WATCHDOG), (DISABLED, 0)])
def test_the_watchdog_is_only_disarmed_in_a_drive_that_is_off(
    device_on_bus: Any, settings_of_virtual_joint: Any, status: int, watchdog: int
) -> None:
    drive = device_on_bus.drive(settings_of_virtual_joint)
    try:
        drive.commission()
        assert consumer_heartbeat(device_on_bus) == WATCHDOG
        device_on_bus.answers[0x6041, 0] = status
        drive.make_safe()
        assert consumer_heartbeat(device_on_bus) == watchdog
    finally:
        drive.close()


def test_make_safe_reaches_a_drive_that_its_watchdog_stops_meanwhile(
    device_on_bus: Any, settings_of_virtual_joint: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = device_on_bus.drive(settings_of_virtual_joint)
    try:
        drive.commission()
        brake = switch_off.brake

        def stopped_meanwhile(objects: Any, sleep: Any) -> bool:
            monkeypatch.setattr(switch_off, "brake", brake)
            drive._node.nmt.send_command(2)
            return brake(objects, sleep)

        monkeypatch.setattr(switch_off, "brake", stopped_meanwhile)
        assert drive.make_safe() == "switch on disabled"  # "stopped" answers no SDO: pre-operational once more
    finally:
        drive.close()


# --- between commissioning and the user's "yes" --------------------------------------------------------------------


def another_program_stops_it(bus: Any, settings: Any) -> None:
    other = bus.drive(settings)
    try:
        assert other.stop_now() == "switch on disabled"
    finally:
        other.close()


def its_supply_is_switched_off_and_on(bus: Any, settings: Any) -> None:
    power_on(bus.device.device[0])
    bus.device.advance(bus.now_ns)


def another_mode_is_chosen(bus: Any, settings: Any) -> None:
    bus.answers[0x6061, 0] = 9


@pytest.mark.parametrize(
    ("meanwhile", "words"),
    [
        (another_program_stops_it, r"1016:1 \(consumer heartbeat time\) is 0, 8257736 was set"),
        (its_supply_is_switched_off_and_on, "has changed since it was commissioned"),
        (another_mode_is_chosen, "6061 shows mode 9, it was 10"),
    ],
)
def test_a_drive_that_has_changed_since_it_was_commissioned_is_not_started(
    device_on_bus: Any, settings_of_virtual_joint: Any, meanwhile: Callable[[Any, Any], None], words: str
) -> None:
    drive = device_on_bus.drive(settings_of_virtual_joint)
    try:
        drive.commission()
        meanwhile(device_on_bus, settings_of_virtual_joint)
        with pytest.raises(DeviceError, match=words):
            drive.start_cyclic()
        assert nmt_state(device_on_bus) != NmtState.OPERATIONAL
    finally:
        drive.close()


def test_a_drive_that_is_as_it_was_is_started(device_on_bus: Any, settings_of_virtual_joint: Any) -> None:
    drive = device_on_bus.drive(settings_of_virtual_joint)
    try:
        drive.commission()
        drive.start_cyclic()
        assert drive._objects.read(0x1016, 1, what="watchdog") == WATCHDOG
        assert nmt_state(device_on_bus) == NmtState.OPERATIONAL
    finally:
        drive.close()


# --- no enabling once the heartbeat is withheld ---------------------------------------------------------------------


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
    [(UNHEEDED_MAX_CYCLES - 1, True), (UNHEEDED_MAX_CYCLES, True), (UNHEEDED_MAX_CYCLES + 1, False), (100, False)],
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


# --- SYNC gets through, the RPDO never: the drive keeps its last torque ---------------------------------------------


@pytest.mark.parametrize("lost", [True, False])
def test_an_rpdo_that_is_never_sent_counts_although_sync_is(lost: bool) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        wire, scratch = Wire(), np.zeros(SCRATCH_WORDS, np.int64)
        for cycle in range(1, 8):
            wire.port.fd = ours.fileno()
            exchange.receive(wire.ports, wire.frames, scratch, wire.samples, np.int64(0), np.int64(0))
            if lost:
                wire.port.fd = -1
            exchange.send(wire.ports, wire.frames, wire.samples, wire.commands)
            assert wire.samples[0].bus_errors == (cycle if lost else 0)


# --- `jointctl stop` says what is true ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "safe"),
    [
        ("switch on disabled", True),
        ("fault", True),
        ("off", True),
        ("off, fault: overspeed", True),
        ("fault reaction active", False),
        ("quick stop active", False),
        ("operation enabled", False),
        ("unknown: no answer", False),
    ],
)
def test_states_in_which_the_power_stage_is_off(state: str, safe: bool) -> None:
    assert is_safe(state) is safe


# --- serial drive: a status that is old ----------------------------------------------------------------------------


@pytest.mark.parametrize("echo", [True, False])
def test_a_stop_right_after_motor_on_is_said_although_the_status_is_still_off(echo: bool) -> None:
    talk = Talk(echo)
    talk.cycle(DriveRequest.OFF, count=4)
    assert b"MO=0" not in talk.said  # twin: off and never asked for more
    talk.command.request = DriveRequest.ENABLE
    while b"MO=1" not in talk.cycle(DriveRequest.ENABLE):
        pass
    talk.sample.drive_state, talk.port.status = DriveState.OFF, 0  # what was read before the motor was on
    assert b"MO=0" in talk.cycle(DriveRequest.OFF)
    talk.cycle(DriveRequest.OFF)
    assert talk.device.m.motor_on == 0


@pytest.mark.parametrize("answers", [True, False])
def test_a_drive_that_tells_positions_but_no_status_is_not_taken_for_enabled(answers: bool) -> None:
    talk = Talk().enabled()
    talk.spoil = lambda reply: reply if answers or not reply.startswith(b"SR") else b""
    count = int(talk.sample.count)
    talk.cycle(torque_Nm=12.1, count=40)
    assert talk.sample.count > count + 20  # positions keep coming
    assert talk.sample.drive_state == (DriveState.ENABLED if answers else DriveState.UNKNOWN)


# --- the measured delay, where every sample answers the SYNC before -------------------------------------------------


@pytest.mark.parametrize(("after_wake_ns", "bin_us"), [(-1, 1001), (1, 1)])
def test_a_sample_that_came_between_the_cycles_is_a_period_old(
    axis_constants: Any, after_wake_ns: int, bin_us: int
) -> None:
    loop = Loop(axis_constants)
    loop.stub[ANSWER_ns] = after_wake_ns
    loop.run(20)
    row = loop.histograms[Histogram.ROUND_TRIP]
    assert row.sum() == 20
    assert row[:bin_us].sum() == 0
    assert bin_us > 1000 or row[bin_us] == 20


# --- the supervisor brakes, the user asks for more ------------------------------------------------------------------


class _BrakingLoop:
    def __init__(self) -> None:
        self.asked: list[StopRequest] = []
        self.polls = 3

    def request_stop(self, request: StopRequest) -> None:
        self.asked.append(request)

    def beat(self) -> None:
        pass

    def running(self) -> bool:
        self.polls -= 1
        return self.polls > 0


@pytest.mark.parametrize("request_", [StopRequest.NONE, StopRequest.OFF])
def test_a_stop_signal_is_heard_while_a_failed_supervisor_brakes(virtual_config: Any, request_: StopRequest) -> None:
    class Signals:
        request = request_

    supervisor = Supervisor.__new__(Supervisor)
    supervisor._config = virtual_config
    loop: Any = _BrakingLoop()
    signals: Any = Signals()
    supervisor._brake(loop, signals)
    assert max(loop.asked) == max(StopRequest.RAMP, request_)


# --- the loop stood still (SIGSTOP, a suspended machine) and goes on -------------------------------------------------


@pytest.mark.parametrize("elapsed_cycles", [9, 150, 1_500])
def test_a_loop_that_stood_still_gives_no_torque_to_a_drive_that_was_stopped_meanwhile(
    rig: Any, elapsed_cycles: int
) -> None:
    run = rig(0.1).until(AxisPhase.TRACKING).run(20)
    run.command.request = DriveRequest.OFF  # the watchdog in the drive: power off, whatever the last command was
    run.joint.drive_state, run.joint.velocity_radps = DriveState.OFF, 0.0
    before = len(run.requests)
    run.tick(elapsed_cycles)
    for _ in range(40):
        if run.phase == AxisPhase.FINISHED:
            break
        run.joint.drive_state = DriveState.ENABLED  # somebody switches it on again
        run.tick()
    assert run.phase == AxisPhase.FINISHED
    assert run.state.fault == Fault.DRIVE_NOT_ENABLED
    assert set(run.requests[before:]) == {DriveRequest.OFF}
    assert set(run.torques_Nm[before:]) == {0.0}


def test_a_loop_that_missed_a_few_cycles_goes_on(rig: Any) -> None:
    run = rig(0.1).until(AxisPhase.TRACKING).run(20)
    run.tick(int(run.axis.limits.skipped_max_cycles) + 1)
    run.run(50)
    assert (run.phase, run.state.fault) == (AxisPhase.TRACKING, Fault.NONE)
