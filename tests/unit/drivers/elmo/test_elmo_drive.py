"""The serial drive on a port in memory: commissioned, changed before the start, cleared, switched off."""

from __future__ import annotations

import itertools
import math
import os
import pty
import re
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import pytest

from jointctl.drivers.elmo.dialogue import SerialPort
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import cycle_characters, highest_rate_Hz, measured_exchange
from jointctl.drivers.errors import BusError, ConfigurationError, DeviceError, JointctlError, NoDeviceError
from jointctl.hil.elmo_drive import switch_off
from jointctl.tools.verbs.elmo_bench import SHARED_ATTEMPTS, PortTarget
from tests.python_process import forked
from tests.unit.drivers.elmo.virtual_line import COUNTS, SETTINGS, MemoryPort

Answer = Callable[[bytes, bytes], bytes]


def saying(reply: bytes, to: bytes | None = None) -> Answer:
    """A drive that says this to one command, or to all."""
    return lambda line, good: reply if to in (None, line) else good


def lacks(*names: bytes, code: bytes = b"\x02") -> Answer:
    """A drive that knows none of these commands."""
    return lambda line, reply: line + b"\r" + code + b"?;" if line.startswith(names) else reply


@pytest.fixture
def commissioned(port: MemoryPort) -> ElmoDrive:
    return port.commissioned()


# --- Commissioning of the serial drive on a port in memory: what it writes, what it refuses and in which words ---
class TestCommissioning:
    def test_the_report_and_what_the_drive_has_afterwards(self, port: MemoryPort) -> None:
        report = port.drive().commission()
        assert report.identity.product == "Whistle"
        assert report.start_position_rad == pytest.approx(0.1, abs=2e-5)
        assert report.torque_resolution_Nm == pytest.approx(0.0121)
        assert report.loop_delay_s is not None
        assert 0.001 < report.loop_delay_s < 0.004
        m = port.device.m
        assert (m.unit_mode, m.motor_on, m.continuous_A, m.peak_A, m.peak_s) == (1, 0, 5.0, 6.0, 2.0)
        assert m.speed_high_cps == -m.speed_low_cps == round(1.2 * COUNTS / math.tau)
        assert m.position_high_counts == pytest.approx((0.7 + 0.28) * COUNTS / math.tau, abs=1.0)

    @pytest.mark.parametrize("echo", [True, False])
    def test_the_echo_is_set_as_configured(self, port: MemoryPort, echo: bool) -> None:
        drive = port.commissioned(echo=echo)
        assert port.device.echo == echo
        assert drive.port()[0].echo == int(echo)

    @pytest.mark.parametrize("step", [100, -100, 0])
    def test_a_motor_that_is_on_and_turns_is_left_alone(self, port: MemoryPort, step: int) -> None:
        port.device.execute(b"MO=1")
        counts = iter(range(0, 1_000_000 * (step or 1), step)) if step else None
        port.answer = lambda line, reply: b"PX\r%d;" % next(counts) if counts is not None and line == b"PX" else reply
        asked: list[str] = []
        approve = lambda question: bool(asked.append(question)) or True  # noqa: E731
        if step == 0:
            port.drive().commission(approve)
            assert (port.device.m.motor_on, len(asked)) == (0, 1)
            return
        with pytest.raises(DeviceError, match=r"turns .* left as it is"):
            port.drive().commission(approve)
        assert (port.device.m.motor_on, asked) == (1, [])

    def test_a_real_drive_without_position_limits_is_a_remark(self, port: MemoryPort) -> None:
        port.answer = lacks(b"HL[3]", b"LL[3]", code=b"\x03")
        report = port.drive().commission()
        assert sum("bad index" in remark for remark in report.remarks) == 2

    def test_one_bad_reply_is_asked_again(self, port: MemoryPort) -> None:
        spoilt = iter([True])
        port.answer = lambda line, reply: b"\xff\xff;" if line == b"PL[1]" and next(spoilt, False) else reply
        port.drive().commission()

    @pytest.mark.parametrize(
        ("changes", "kind", "words"),
        [
            ({"product": "Gold"}, DeviceError, "must contain 'Gold'"),
            ({"peak_current_A": 25.0}, DeviceError, "drive.peak_current_A (=25) must be at most 20, the drive's MC"),
            ({"rate_Hz": 203.0}, ConfigurationError, "loop.rate_Hz (=203) must be at most 202"),
            ({"counts_per_turn": 4096, "counts_parameter": "CA[18]"}, DeviceError, "differs from the drive's CA[18]"),
        ],
    )
    def test_what_does_not_fit_is_refused(
        self, port: MemoryPort, changes: dict[str, Any], kind: type[JointctlError], words: str
    ) -> None:
        with pytest.raises(kind, match=re.escape(words)):
            port.drive(**changes).commission()
        assert port.device.m.motor_on == 0

    @pytest.mark.parametrize(
        ("answer", "kind", "words"),
        [
            (saying(b""), NoDeviceError, "no drive answers on memory at 115200 baud"),
            (saying(b"\xf8\x80\xfe"), NoDeviceError, "baud rate"),
            (saying(b"\xf8;\x80;"), NoDeviceError, "baud rate"),
            (saying(b"MO\r1;", b"MO"), DeviceError, "left as it is"),
            (saying(b"CL[1]\r4.9;", b"CL[1]"), DeviceError, "does not read back"),
            (saying(b"HL[2]\r1;", b"HL[2]"), DeviceError, "HL[2]"),
            (saying(b"UM=1\r\x02?;", b"UM=1"), DeviceError, "bad command"),
            (saying(b"TC\r1.5;", b"TC"), DeviceError, "TC (=1.5) of the drive must be 0"),
            (saying(b"RM\r1;", b"RM"), DeviceError, "RM (=0) does not read back"),
            (saying(b"PX\rtwo;", b"PX"), DeviceError, "is not a number"),
            (saying(b"PX\rnan;", b"PX"), DeviceError, "PX (='nan') of the drive is not a number"),
            (saying(b"MO\r1e999;", b"MO"), DeviceError, "is not a number"),
        ],
    )
    def test_drives_that_answer_wrongly(
        self, port: MemoryPort, answer: Answer, kind: type[JointctlError], words: str
    ) -> None:
        port.answer = answer
        with pytest.raises(kind) as caught:
            port.drive().commission()
        assert words in str(caught.value)
        assert "\n" not in caught.value.message

    def test_a_drive_in_fault_is_refused_with_its_cause(self, port: MemoryPort) -> None:
        port.device.execute(b"MO=1")
        switch_off(port.device.m, 0x200000)
        with pytest.raises(DeviceError, match="motor stuck") as caught:
            port.drive().commission()
        assert "nothing is reset by itself" in caught.value.hint

    @pytest.mark.parametrize(("slower", "refused"), [(1.1, False), (2.5, True)])
    def test_the_measured_exchange_decides_as_well(self, port: MemoryPort, slower: float, refused: bool) -> None:
        port.character_s *= slower
        with pytest.raises(DeviceError, match="one exchange takes") if refused else nullcontext():
            port.drive(rate_Hz=150.0).commission()

    @pytest.mark.parametrize("noise", [b"nan", b"inf", b"1e999"])
    def test_noise_in_the_confirmation_is_not_raised_at_the_end(self, port: MemoryPort, noise: bytes) -> None:
        """`make_safe` never raises: what is closed and reported after it would be left out."""
        drive = port.commissioned()
        port.answer = saying(b"MO\r" + noise + b";", b"MO")
        state = drive.make_safe()
        assert state.startswith("unknown: MO (=")
        assert "use the emergency stop" in state


class TestBudget:
    def test_echo_costs_the_characters_of_the_commands_again(self) -> None:
        assert (cycle_characters(False), cycle_characters(True)) == (40, 57)
        assert highest_rate_Hz(115_200, True) == pytest.approx(202.1, abs=0.1)
        assert highest_rate_Hz(19_200, False) == pytest.approx(48.0)

    def test_speed_mode_costs_jog_and_begin(self) -> None:
        # JV=-83443 with its CR is one character less than TC; BG, its CR and its reply come on top
        assert (cycle_characters(False, 5), cycle_characters(True, 5)) == (43, 62)
        assert measured_exchange([0.001] * 9, [0.002] * 9, 115_200, True, 5).cycle_s == pytest.approx(
            0.003 + (2 * (7 + 3) + 1) * 10 / 115_200
        )

    def test_the_measurement_adds_the_value_that_was_not_sent(self) -> None:
        measured = measured_exchange([0.001] * 9 + [0.002], [0.002] * 10, 115_200, False)
        assert measured.cycle_s == pytest.approx(0.003 + 80 / 115_200)
        assert measured.worst_cycle_s == pytest.approx(0.004 + 80 / 115_200)
        assert measured.loop_delay_s == pytest.approx(0.002 + 110 / 115_200)


class TestSpeedMode:
    @pytest.mark.parametrize("mode", ["auto", "speed"])
    def test_the_report_and_what_the_drive_has_afterwards(self, port: MemoryPort, mode: str) -> None:
        drive = port.drive(mode=mode)
        report = drive.commission()
        m, ramp = port.device.m, round(8.0 * COUNTS / math.tau)
        assert report.mode == "speed (UM=2)"
        assert (m.unit_mode, m.motor_on, port.device.jog_cps) == (2, 0, 0.0)
        assert (m.acceleration_cps2, m.deceleration_cps2, m.stop_deceleration_cps2) == (ramp, ramp, ramp)
        cyclic = drive.port()[0]
        assert cyclic.period_ns == round(1e9 / SETTINGS.rate_Hz)  # by it late positions are known
        assert (cyclic.target_is_velocity, cyclic.max_velocity_cps) == (1, round(COUNTS / math.tau))
        assert cyclic.max_velocity_cps < m.speed_high_cps

    def test_torque_mode_is_what_a_run_gets(self, port: MemoryPort) -> None:
        drive = port.drive()
        assert drive.commission().mode == "torque (UM=1)"
        assert drive.port()[0].target_is_velocity == 0
        assert b"UM=2" not in port.commands

    @pytest.mark.parametrize(("torque_max_Nm", "peak_A"), [(60.0, 1.02 * 60.0 / 12.1), (72.0, 6.0)])
    def test_the_peak_current_stands_for_the_torque_limit(
        self, port: MemoryPort, torque_max_Nm: float, peak_A: float
    ) -> None:
        port.drive(mode="speed", torque_max_Nm=torque_max_Nm).commission()
        assert port.device.m.peak_A == pytest.approx(peak_A, abs=1e-3)
        port.drive(torque_max_Nm=torque_max_Nm).commission()
        assert port.device.m.peak_A == 6.0  # the loop itself limits the torque

    @pytest.mark.parametrize("name", [b"UM=2", b"AC", b"SD", b"JV", b"HL[3]", b"LL[3]", b"ER[2]"])
    def test_without_speed_mode_or_one_of_its_limits_auto_is_torque_mode_and_says_so(
        self, port: MemoryPort, name: bytes
    ) -> None:
        port.answer = lacks(name)
        report = port.drive(mode="auto").commission()
        assert (report.mode, port.device.m.unit_mode, port.device.m.peak_A) == ("torque (UM=1)", 1, 6.0)
        assert any("torque mode, because speed mode cannot be had" in remark for remark in report.remarks)
        with pytest.raises(DeviceError, match="EC 2"):
            port.drive(mode="speed").commission()

    def test_a_jog_that_is_not_zero_is_refused(self, port: MemoryPort) -> None:
        port.answer = saying(b"JV\r1000;", b"JV")
        with pytest.raises(DeviceError, match=r"JV \(=0\) does not read back"):
            port.drive(mode="speed").commission()

    @pytest.mark.parametrize(("rate_Hz", "mode"), [(178.0, "speed (UM=2)"), (187.0, "torque (UM=1)")])
    def test_the_rate_of_the_line_decides(self, rate_Hz: float, mode: str) -> None:
        port = MemoryPort()
        port.character_s *= 0.5  # the measurement is not what decides here
        assert port.drive(mode="auto", rate_Hz=rate_Hz).commission().mode == mode
        if mode.startswith("torque"):
            with pytest.raises(ConfigurationError, match=r"at most 186 .* for JV and BG"):
                port.drive(mode="speed", rate_Hz=rate_Hz).commission()

    def test_make_safe_ends_a_jog(self, port: MemoryPort) -> None:
        drive = port.commissioned(mode="speed")
        for line in (b"MO=1", b"JV=20000", b"BG"):
            port.device.execute(line)
        port.device.advance_to(1.0)
        assert drive.motion()[1] == pytest.approx(20_000 * math.tau / COUNTS, rel=0.05)
        port.commands.clear()
        assert drive.make_safe() == "off"
        assert port.commands[1:5] == [b"TC=0", b"JV=0", b"ST", b"MO=0"]
        assert (port.device.m.motor_on, port.device.jog_cps) == (0, 0.0)


# --- The serial drive after its commissioning: changed before the start, cleared of a fault, made safe, unplugged ---
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
        drive = port.commissioned(echo=echo)
        happens(port)
        port.commands.clear()
        with pytest.raises(DeviceError, match="has changed since it was commissioned") as caught:
            drive.start_cyclic()
        assert "start the run again" in caught.value.hint
        assert not any(b"=" in line for line in port.commands)

    @pytest.mark.parametrize("line", [b"UM=1", b"JV=5", b"AC=1000000", b"PM=0", b"PL[1]=9"])
    def test_nor_one_in_speed_mode(self, port: MemoryPort, line: bytes) -> None:
        drive = port.commissioned(mode="speed", rate_Hz=100.0)
        drive.start_cyclic()
        port.device.execute(line)
        with pytest.raises(DeviceError, match="has changed since it was commissioned"):
            drive.start_cyclic()

    def test_its_twin_torque_mode_because_speed_mode_was_refused(self, port: MemoryPort) -> None:
        port.answer = saying(b"SD\r1;", b"SD")
        drive = port.commissioned(mode="auto", rate_Hz=100.0)
        port.device.execute(b"PM=0")  # of no importance in torque mode
        drive.start_cyclic()
        assert drive.port()[0].target_is_velocity == 0

    @pytest.mark.parametrize("echo", [True, False])
    def test_its_twin_nothing_has_changed(self, port: MemoryPort, echo: bool) -> None:
        drive = port.commissioned(echo=echo)
        for line in (b"PL[1]=6.01", b"UM=1"):
            port.device.execute(line)
        drive.start_cyclic()
        assert {b"UM", b"RM", b"TC", b"MO", b"CL[1]", b"PL[1]", b"HL[2]", b"LL[3]"} <= set(port.commands[-20:])

    def test_a_drive_that_has_gone_is_not_started(self, port: MemoryPort, commissioned: ElmoDrive) -> None:
        port.answer = saying(b"")
        with pytest.raises(NoDeviceError):
            commissioned.start_cyclic()


class TestClearFault:
    def test_a_latched_fault_is_cleared_and_the_motor_is_off(self, port: MemoryPort) -> None:
        port.device.execute(b"MO=1")
        switch_off(port.device.m, 0x200000)
        drive = port.drive()
        assert "motor stuck" in drive.clear_fault()
        assert (port.device.m.motor_fault, port.device.m.motor_on, port.device.m.torque_A) == (0, 0, 0.0)
        drive.commission()

    @pytest.mark.parametrize("amplifier", [0, 3])
    def test_without_a_fault_or_with_a_cause_that_remains_nothing_is_switched_on(
        self, port: MemoryPort, amplifier: int
    ) -> None:
        port.device.amplifier = amplifier
        if amplifier:
            with pytest.raises(DeviceError, match="undervoltage"):
                port.drive().clear_fault()
        else:
            assert port.drive().clear_fault() == "no fault"
        assert b"MO=1" not in port.commands

    def test_the_motor_goes_on_only_after_torque_zero_was_read_back(self, port: MemoryPort) -> None:
        port.device.m.motor_fault = 0x200000
        port.device.execute(b"RM=1")
        port.drive().clear_fault()
        before = port.commands[: port.commands.index(b"MO=1")]
        assert before[-5:] == [b"UM=1", b"UM", b"RM=0", b"RM", b"TC"]
        after = port.commands[len(before) + 1 :]
        assert after[:5] == [b"TC=0", b"MO=0", b"", b"TC=0", b"MO=0"]

    def test_a_program_that_dies_behind_that_command_leaves_the_motor_off(self, port: MemoryPort) -> None:
        """Nothing else would switch it off: a serial drive does not notice, and its brake would stay open."""

        def dies(line: bytes, reply: bytes) -> bytes:
            if line == b"MO=1":
                port.failure = BusError("killed")  # nothing more is said
            return reply

        port.device.m.motor_fault, port.answer = 0x200000, dies
        with pytest.raises(BusError, match="killed"):
            port.drive().clear_fault()
        assert b"MO=1" in port.commands
        assert port.device.m.motor_on == 0

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
        port.answer = saying(reply, spoilt)
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
    def test_torque_zero_and_motor_off_are_said_first(self, port: MemoryPort, commissioned: ElmoDrive) -> None:
        for line in (b"MO=1", b"TC=1"):
            port.device.execute(line)
        port.commands.clear()
        assert commissioned.make_safe() == "off"
        assert port.commands[1:5] == [b"TC=0", b"JV=0", b"ST", b"MO=0"]
        assert port.device.m.motor_on == 0
        commissioned.close()
        assert port.closed

    def test_after_a_restart_with_the_echo_back(self, port: MemoryPort) -> None:
        drive = port.commissioned(echo=False)
        port.device.restart()
        assert drive.make_safe() == "off"

    def test_a_fault_is_told(self, port: MemoryPort, commissioned: ElmoDrive) -> None:
        port.device.execute(b"MO=1")
        switch_off(port.device.m, 0x20000)
        assert "overspeed" in commissioned.make_safe()

    def test_on_a_port_that_fails_it_says_what_it_does_not_know(
        self, port: MemoryPort, commissioned: ElmoDrive
    ) -> None:
        port.failure = BusError("serial port memory failed: Input/output error")
        state = commissioned.make_safe()
        assert state.startswith("unknown: ")
        assert "emergency stop" in state

    @pytest.mark.parametrize("asked", [True, False])
    def test_a_stop_that_takes_replies_on_the_same_line_is_outlasted(
        self, port: MemoryPort, commissioned: ElmoDrive, asked: bool
    ) -> None:
        """As long as `jointctl stop` tries; its twin without that word gives up before."""
        port.device.execute(b"MO=1")
        lines = itertools.count()  # two of each attempt
        port.answer = lambda line, reply: b"" if next(lines) < 4 * SHARED_ATTEMPTS else reply
        state = commissioned.make_safe(asked=asked)
        assert state == "off" if asked else state.startswith("unknown: ")
        assert port.device.m.motor_on == 0

    @pytest.mark.parametrize(("disorder", "for_lines", "outlasted"), [(b"C\r?;", 20, True), (b"", 1000, False)])
    def test_of_two_stops_on_one_line_the_first_tries_on_as_well(
        self, port: MemoryPort, disorder: bytes, for_lines: int, outlasted: bool
    ) -> None:
        """It had the port for itself when it came; its twin on a line that is only silent gives up."""
        port.device.execute(b"MO=1")
        lines = itertools.count()
        port.answer = lambda line, reply: disorder if next(lines) < for_lines else reply
        target: Any = PortTarget("memory", 115_200, SETTINGS.reply_timeout_s)
        if outlasted:
            assert target._told(port, False) == "off"
        else:
            with pytest.raises(JointctlError):
                target._told(port, False)
        assert port.device.m.motor_on == 0


class TestSerialPort:
    def test_what_cannot_be_opened_is_named(self, tmp_path: Any) -> None:
        with pytest.raises(BusError, match="no such serial port"):
            SerialPort(str(tmp_path / "none"), 115_200)
        file = tmp_path / "file"
        file.write_text("")
        with pytest.raises(BusError, match="not a serial port"):
            SerialPort(str(file), 115_200)

    def test_a_forked_process_does_not_keep_it(self) -> None:
        master, slave = pty.openpty()
        first = SerialPort(os.ttyname(slave), 115_200)
        with pytest.raises(BusError):
            SerialPort(os.ttyname(slave), 115_200)
        with forked():
            first.close()
            SerialPort(os.ttyname(slave), 115_200).close()
        os.close(master)
        os.close(slave)
