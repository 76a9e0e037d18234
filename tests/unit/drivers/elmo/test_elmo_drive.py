"""The serial drive after its commissioning: changed before the start, cleared of a fault, made safe, unplugged."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from jointctl.drivers.elmo.serial_port import SerialPort
from jointctl.drivers.errors import BusError, DeviceError, NoDeviceError
from jointctl.hil.elmo.motor import switch_off
from jointctl.tools.verbs.stop_serial import SHARED_ATTEMPTS
from tests.unit.drivers.elmo.memory_port import MemoryPort


def its_supply_is_switched_off_and_on(port: MemoryPort) -> None:
    port.device.restart()


def somebody_sends(line: bytes) -> Callable[[MemoryPort], None]:
    return lambda port: port.device.execute(line) and None


def it_says_another_torque(port: MemoryPort) -> None:
    port.answer = lambda line, reply: reply[:-5] + b"500;" if line == b"TC" else reply


class TestWhileTheQuestionIsOpen:
    """The user may take minutes to confirm what commissioning has found."""

    @pytest.mark.parametrize("echo", [True, False])
    @pytest.mark.parametrize(
        "happens",
        [
            its_supply_is_switched_off_and_on, it_says_another_torque,
            *[somebody_sends(b) for b in (b"UM=5", b"RM=1", b"PL[1]=6.1", b"CL[1]=4.9", b"HL[2]=200000", b"MO=1")],
        ],
    )  # fmt: skip
    def test_a_drive_that_has_changed_is_not_started(
        self, port: MemoryPort, happens: Callable[[MemoryPort], None], echo: bool
    ) -> None:
        drive = port.drive(echo=echo)
        drive.commission()
        happens(port)
        port.commands.clear()
        with pytest.raises(DeviceError, match="has changed since it was commissioned") as caught:
            drive.start_cyclic()
        assert "start the run again" in caught.value.hint
        assert not any(b"=" in line for line in port.commands)

    @pytest.mark.parametrize("line", [b"UM=1", b"JV=5", b"AC=1000000", b"PM=0", b"PL[1]=9"])
    def test_nor_one_in_speed_mode(self, port: MemoryPort, line: bytes) -> None:
        drive = port.drive(mode="speed", rate_Hz=100.0)
        drive.commission()
        drive.start_cyclic()
        port.device.execute(line)
        with pytest.raises(DeviceError, match="has changed since it was commissioned"):
            drive.start_cyclic()

    def test_its_twin_torque_mode_because_speed_mode_was_refused(self, port: MemoryPort) -> None:
        port.answer = lambda line, reply: b"SD\r1;" if line == b"SD" else reply
        drive = port.drive(mode="auto", rate_Hz=100.0)
        drive.commission()
        port.device.execute(b"PM=0")  # of no importance in torque mode
        drive.start_cyclic()
        assert drive.port()[0].target_is_velocity == 0

    @pytest.mark.parametrize("echo", [True, False])
    def test_its_twin_nothing_has_changed(self, port: MemoryPort, echo: bool) -> None:
        drive = port.drive(echo=echo)
        drive.commission()
        for line in (b"PL[1]=6.01", b"UM=1"):
            port.device.execute(line)
        drive.start_cyclic()
        assert {b"UM", b"RM", b"TC", b"MO", b"CL[1]", b"PL[1]", b"HL[2]", b"LL[3]"} <= set(port.commands[-20:])

    def test_a_drive_that_has_gone_is_not_started(self, port: MemoryPort) -> None:
        drive = port.drive()
        drive.commission()
        port.answer = lambda line, reply: b""
        with pytest.raises(NoDeviceError):
            drive.start_cyclic()


class TestClearFault:
    def test_a_latched_fault_is_cleared_and_the_motor_is_off(self, port: MemoryPort) -> None:
        port.device.execute(b"MO=1")
        switch_off(port.device.m, 0x200000)
        drive = port.drive()
        assert "motor stuck" in drive.clear_fault()
        assert (port.device.m.motor_fault, port.device.m.motor_on, port.device.m.torque_A) == (0, 0, 0.0)
        drive.commission()

    def test_without_a_fault_nothing_is_switched_on(self, port: MemoryPort) -> None:
        assert port.drive().clear_fault() == "no fault"
        assert b"MO=1" not in port.commands

    def test_a_cause_that_remains_is_told_and_nothing_is_switched_on(self, port: MemoryPort) -> None:
        port.device.amplifier = 3
        with pytest.raises(DeviceError, match="undervoltage"):
            port.drive().clear_fault()
        assert b"MO=1" not in port.commands

    def test_the_motor_goes_on_only_after_torque_zero_was_read_back(self, port: MemoryPort) -> None:
        port.device.m.motor_fault = 0x200000
        port.device.execute(b"RM=1")
        port.drive().clear_fault()
        before = port.commands[: port.commands.index(b"MO=1")]
        assert before[-5:] == [b"UM=1", b"UM", b"RM=0", b"RM", b"TC"]
        after = port.commands[len(before) + 1 :]
        assert after[:4] == [b"", b"TC=0", b"MO=0", b""]

    @pytest.mark.parametrize(
        ("spoilt", "reply", "words"),
        [
            (b"TC", b"TC\r0.500;", r"TC \(=0.5\) of the drive must be 0 with the motor off"),
            (b"TC", b"TC\r:?;", "refused TC: EC 58"),
            (b"RM", b"RM\r1;", r"RM \(=0\) does not read back"),
            (b"UM", b"UM\r2;", r"UM \(=1\) does not read back"),
            (b"MO", b"MO\r1;", "cannot be switched off"),
        ],
    )
    def test_without_that_confirmation_it_stays_off(
        self, port: MemoryPort, spoilt: bytes, reply: bytes, words: str
    ) -> None:
        port.device.m.motor_fault = 0x200000
        port.answer = lambda line, good: reply if line == spoilt else good
        with pytest.raises(DeviceError, match=words):
            port.drive().clear_fault()
        assert b"MO=1" not in port.commands

    def test_a_torque_command_that_can_be_set_to_zero_is(self, port: MemoryPort) -> None:
        port.device.m.motor_fault = 0x200000
        kept = [b"0.500", b"0.000"]
        port.answer = lambda line, good: b"TC\r" + kept.pop(0) + b";" if line == b"TC" else good
        assert "motor stuck" in port.drive().clear_fault()

    def test_a_fault_that_comes_back_is_told(self, port: MemoryPort) -> None:
        def answer(line: bytes, reply: bytes) -> bytes:
            if line == b"MO=1":
                switch_off(port.device.m, 0x20000)
            return reply

        port.device.m.motor_fault = 0x200000
        port.answer = answer
        with pytest.raises(DeviceError, match=r"came back: .*overspeed"):
            port.drive().clear_fault()


class TestMakeSafe:
    def test_a_drive_that_was_never_found_is_left_alone(self, port: MemoryPort) -> None:
        drive = port.drive()
        assert drive.make_safe() == "untouched"
        assert port.commands == []

    def test_torque_zero_and_motor_off_are_said_first(self, port: MemoryPort) -> None:
        drive = port.drive()
        drive.commission()
        for line in (b"MO=1", b"TC=1"):
            port.device.execute(line)
        port.commands.clear()
        assert drive.make_safe() == "off"
        assert port.commands[1:5] == [b"TC=0", b"JV=0", b"ST", b"MO=0"]
        assert port.device.m.motor_on == 0
        drive.close()
        assert port.closed

    def test_after_a_restart_with_the_echo_back(self, port: MemoryPort) -> None:
        drive = port.drive(echo=False)
        drive.commission()
        port.device.restart()
        assert drive.make_safe() == "off"

    def test_a_fault_is_told(self, port: MemoryPort) -> None:
        drive = port.drive()
        drive.commission()
        port.device.execute(b"MO=1")
        switch_off(port.device.m, 0x20000)
        assert "overspeed" in drive.make_safe()

    @pytest.mark.parametrize("silent", [True, False])
    def test_it_never_raises_and_says_what_it_does_not_know(self, port: MemoryPort, silent: bool) -> None:
        drive = port.drive()
        drive.commission()
        if silent:
            port.answer = lambda line, reply: b""
        else:
            port.failure = BusError("serial port memory failed: Input/output error")
        state = drive.make_safe()
        assert state.startswith("unknown: ")
        assert "emergency stop" in state

    @pytest.mark.parametrize("asked", [True, False])
    def test_a_stop_that_takes_replies_on_the_same_line_is_outlasted(self, port: MemoryPort, asked: bool) -> None:
        """As long as `jointctl stop` tries; its twin without that word gives up before."""
        drive = port.drive()
        drive.commission()
        port.device.execute(b"MO=1")
        lines = itertools.count()  # two of each attempt
        port.answer = lambda line, reply: b"" if next(lines) < 4 * SHARED_ATTEMPTS else reply
        state = drive.make_safe(asked=asked)
        assert state == "off" if asked else state.startswith("unknown: ")
        assert port.device.m.motor_on == 0


class TestSerialPort:
    def test_what_cannot_be_opened_is_named(self, tmp_path: Any) -> None:
        with pytest.raises(BusError, match="no such serial port"):
            SerialPort(str(tmp_path / "none"), 115_200)
        file = tmp_path / "file"
        file.write_text("")
        with pytest.raises(BusError, match="not a serial port"):
            SerialPort(str(file), 115_200)
