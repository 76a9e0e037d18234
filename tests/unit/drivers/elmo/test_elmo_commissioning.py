"""Commissioning of the serial drive on a port in memory: what it writes, what it refuses and in which words."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from jointctl.drivers.elmo.line_budget import cycle_characters, highest_rate_Hz, measured_exchange
from jointctl.drivers.errors import ConfigurationError, DeviceError, JointctlError, NoDeviceError
from jointctl.hil.elmo.motor import switch_off
from tests.unit.drivers.elmo.memory_port import COUNTS, SETTINGS, MemoryPort


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
        drive = port.drive(echo=echo)
        drive.commission()
        assert port.device.echo == echo
        assert drive.port()[0].echo == int(echo)

    def test_a_motor_that_was_on_is_switched_off_and_told(self, port: MemoryPort) -> None:
        port.device.execute(b"MO=1")
        report = port.drive().commission(lambda _: True)
        assert port.device.m.motor_on == 0
        assert any("was on" in remark for remark in report.remarks)

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
        port.answer = lambda line, reply: line + b"\r\x03?;" if line.startswith((b"HL[3]", b"LL[3]")) else reply
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
        drive = port.drive(**changes)
        with pytest.raises(kind) as caught:
            drive.commission()
        assert words in str(caught.value)
        assert port.device.m.motor_on == 0

    @pytest.mark.parametrize(
        ("answer", "kind", "words"),
        [
            (lambda line, reply: b"", NoDeviceError, "no drive answers on memory at 115200 baud"),
            (lambda line, reply: b"\xf8\x80\xfe", NoDeviceError, "baud rate"),
            (lambda line, reply: b"\xf8;\x80;", NoDeviceError, "baud rate"),
            (lambda line, reply: b"MO\r1;" if line == b"MO" else reply, DeviceError, "left as it is"),
            (lambda line, reply: b"CL[1]\r4.9;" if line == b"CL[1]" else reply, DeviceError, "does not read back"),
            (lambda line, reply: b"HL[2]\r1;" if line == b"HL[2]" else reply, DeviceError, "HL[2]"),
            (lambda line, reply: b"UM=1\r\x02?;" if line == b"UM=1" else reply, DeviceError, "bad command"),
            (
                lambda line, reply: b"TC\r1.5;" if line == b"TC" else reply,
                DeviceError,
                "TC (=1.5) of the drive must be 0",
            ),
            (lambda line, reply: b"RM\r1;" if line == b"RM" else reply, DeviceError, "RM (=0) does not read back"),
            (lambda line, reply: b"PX\rtwo;" if line == b"PX" else reply, DeviceError, "is not a number"),
        ],
    )
    def test_drives_that_answer_wrongly(
        self, port: MemoryPort, answer: Callable[[bytes, bytes], bytes], kind: type[JointctlError], words: str
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
        drive = port.drive(rate_Hz=150.0)
        if refused:
            with pytest.raises(DeviceError, match="one exchange takes"):
                drive.commission()
        else:
            drive.commission()


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


def lacks(*names: bytes) -> Callable[[bytes, bytes], bytes]:
    """A drive that knows none of these commands."""
    return lambda line, reply: line + b"\r\x02?;" if line.startswith(names) else reply


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
        port.answer = lambda line, reply: b"JV\r1000;" if line == b"JV" else reply
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
        drive = port.drive(mode="speed")
        drive.commission()
        for line in (b"MO=1", b"JV=20000", b"BG"):
            port.device.execute(line)
        port.device.advance_to(1.0)
        assert drive.motion()[1] == pytest.approx(20_000 * math.tau / COUNTS, rel=0.05)
        port.commands.clear()
        assert drive.make_safe() == "off"
        assert port.commands[1:5] == [b"TC=0", b"JV=0", b"ST", b"MO=0"]
        assert (port.device.m.motor_on, port.device.jog_cps) == (0, 0.0)
