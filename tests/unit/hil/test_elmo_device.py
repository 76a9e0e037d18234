"""The virtual Elmo drive: its interpreter, its limits, its line, and a dialogue that others wrote."""

from __future__ import annotations

import itertools
import math
import os
import time
from collections.abc import Iterator
from typing import Any

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.elmo.dialogue import (
    REPLY_MAX,
    Interpreter,
    Reply,
    ReplyKind,
    encode,
    error_text,
    motor_fault_names,
    motor_fault_text,
    motor_off_cause,
    parse_reply,
    status_text,
    unit_mode,
)
from jointctl.hil.elmo_drive import (
    MF_OVERSPEED,
    MF_POSITION_LIMIT,
    MF_SPEED_ERROR,
    ElmoDeviceSettings,
    ElmoInterpreter,
)
from jointctl.hil.elmo_line import ElmoDevice
from jointctl.hil.plant import plant


# --- The ASCII interpreter without a port: commands, replies, garbage, time-outs; and codes in words ---
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("PX",), b"PX\r"), (("MO", None, 1), b"MO=1\r"), (("CL", 1, 2.5), b"CL[1]=2.500000\r"),
        (("HL", 2, -100000.0), b"HL[2]=-100000\r"), (("TC", None, -0.125), b"TC=-0.125000\r"),
        (("XQ", None, "##HOME"), b"XQ=##HOME\r"),
    ],
)  # fmt: skip
def test_commands_are_encoded(arguments: tuple[str], line: bytes) -> None:
    assert encode(*arguments) == line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        *(((name,), "two capital letters") for name in ("px", "P", "PXX", "", "P;", "PX\r")),
        *((("TC", None, value), "finite") for value in (math.nan, math.inf, -math.inf)),
        *((("XQ", None, text), "characters") for text in ("1;MO=1", "1\rMO=1", "x" * 70)),  # a second command
    ],
)
def test_what_is_no_command_is_refused(arguments: tuple[Any, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        encode(*arguments)


@pytest.mark.parametrize(
    ("command", "frame", "echo", "kind", "text", "code"),
    [
        (b"PX\r", b"PX\r12345", True, ReplyKind.VALUE, "12345", 0),
        (b"PX\r", b"PX\r12345", None, ReplyKind.VALUE, "12345", 0),
        (b"PX\r", b"12345", False, ReplyKind.VALUE, "12345", 0),
        (b"PX\r", b"12345", None, ReplyKind.VALUE, "12345", 0),
        (b"PX\r", b"12345", True, ReplyKind.GARBLED, "", 0),
        (b"MO=1\r", b"MO=1\r", True, ReplyKind.VALUE, "", 0),
        (b"MO=1\r", b"", False, ReplyKind.VALUE, "", 0),
        (b"UM=9\r", b"UM=9\r\x15?", True, ReplyKind.ERROR, "", 21),
        (b"UM=9\r", b"\x15?", False, ReplyKind.ERROR, "", 21),
        (b"UM=9\r", b"\r?", False, ReplyKind.ERROR, "", 13),  # an error byte that looks like the end of a command
        (b"UM=9\r", b"\xff?", False, ReplyKind.ERROR, "", 255),
        (b"UM=9\r", b"?", False, ReplyKind.ERROR, "", 0),
        (b"PX\r", b"PX\r12\xfe45", True, ReplyKind.GARBLED, "", 0),
        (b"PX\r", b"12PX\r345", None, ReplyKind.GARBLED, "", 0),
        (b"PX\r", b"VX\r12345", True, ReplyKind.GARBLED, "", 0),
    ],
)
def test_replies_are_told_apart(
    command: bytes, frame: bytes, echo: bool | None, kind: ReplyKind, text: str, code: int
) -> None:
    reply = parse_reply(command, frame, echo)
    assert (reply.kind, reply.text, reply.error_code) == (kind, text, code)


class TestInterpreter:
    @pytest.mark.parametrize(("now_s", "over"), [(0.0999, False), (0.1, True), (0.2, True)])
    def test_the_time_is_over_at_its_end_and_not_before(self, now_s: float, over: bool) -> None:
        machine = Interpreter()
        machine.begin(b"PX\r", 0.0, 0.1)
        machine.feed(b"PX\r123", 0.01)
        reply = machine.poll(now_s)
        assert (reply is not None) == over
        if reply is not None:
            assert reply == Reply(ReplyKind.TIMEOUT, raw=b"PX\r123")
            assert machine.garbage_bytes == 6

    def test_what_came_before_the_command_is_no_part_of_its_reply(self) -> None:
        machine = Interpreter()
        assert machine.feed(b"99999", 0.0) is None
        machine.begin(b"PX\r", 0.0, 0.1)
        reply = machine.feed(b"12345;", 0.0)
        assert reply is not None
        assert reply.text == "12345"
        assert machine.garbage_bytes == 5

    def test_a_second_command_has_to_wait(self) -> None:
        machine = Interpreter()
        machine.begin(b"PX\r", 0.0, 0.1)
        with pytest.raises(RuntimeError, match="not ended"):
            machine.begin(b"PX\r", 0.0, 0.1)

    @pytest.mark.parametrize(("size", "kind"), [(REPLY_MAX, ReplyKind.VALUE), (REPLY_MAX + 1, ReplyKind.GARBLED)])
    def test_memory_is_bounded(self, size: int, kind: ReplyKind) -> None:
        machine = Interpreter()
        machine.begin(b"VR\r", 0.0, 1.0)
        assert machine.feed(b"x" * size, 0.0) is None
        reply = machine.feed(b";", 0.0)
        assert reply is not None
        assert reply.kind is kind

    @settings(max_examples=200)
    @given(st.lists(st.binary(max_size=40), max_size=12), st.sampled_from([None, True, False]))
    def test_any_bytes_end_in_a_reply_or_a_time_out_and_the_next_command_works(
        self, chunks: list[bytes], echo: bool | None
    ) -> None:
        machine = Interpreter(echo)
        machine.begin(b"PX\r", 0.0, 1.0)
        for chunk in chunks:
            reply = machine.feed(chunk, 0.5)
            if reply is not None:
                break
        assert machine.feed(b"", 1.0) is not None or not machine.busy
        machine.begin(b"PX\r", 2.0, 1.0)
        good = machine.feed(b"7;" if echo is False else b"PX\r7;", 2.0)
        assert good is not None
        assert (good.kind, good.text) == (ReplyKind.VALUE, "7")

    @given(st.integers(-(2**31), 2**31 - 1), st.lists(st.integers(1, 14), max_size=14), st.booleans())
    def test_a_good_reply_is_the_same_however_it_is_cut(self, value: int, cuts: list[int], echo: bool) -> None:
        data = (b"PX\r" if echo else b"") + str(value).encode() + b";"
        machine = Interpreter(echo)
        assert machine.begin(b"PX\r", 0.0, 1.0) == b"PX\r"
        places = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
        replies = [machine.feed(data[start:end], 0.0) for start, end in itertools.pairwise(places)]
        assert replies.pop() == Reply(ReplyKind.VALUE, str(value), echoed=echo, raw=data[:-1])
        assert not any(replies)
        assert not machine.busy


class TestCodes:
    def test_error_codes(self) -> None:
        assert error_text(57) == "EC 57 (motor must be off)"
        assert error_text(250) == "EC 250 (not in the list)"

    @pytest.mark.parametrize(
        ("fault", "names"),
        [
            (0, []), (0x1, ["feedback"]), (0x20000, ["overspeed (HL[2], LL[2])"]),
            (0x7000, ["safe torque off (STO)"]), (0xB008, ["peak current exceeded", "short circuit"]),
            (0x1000, ["amplifier code 1h"]), (0x80000000, ["unknown bits 80000000h"]),
        ],
    )  # fmt: skip
    def test_motor_faults_by_name(self, fault: int, names: list[str]) -> None:
        assert motor_fault_names(fault) == names

    def test_texts(self) -> None:
        assert motor_fault_text(0) == "no motor fault"
        assert motor_fault_text(0x3000) == "MF 3000h (undervoltage)"
        status = 0x10 | 0x40 | 2 << 7 | 1 << 13 | 0xB
        assert status_text(status) == "servo on, UM 2, short circuit, fault latched, current limited"
        assert unit_mode(status) == 2
        assert motor_off_cause(3, 0) == "undervoltage"
        assert motor_off_cause(3, 1) == "MF 1h (feedback)"


# --- The virtual Elmo drive: what its commands do, its limits, and its line ---
COUNTS = 2**19
PER_RAD = COUNTS / 6.283185307179586


def interpreter(**settings: Any) -> ElmoInterpreter:
    constants, state = plant(encoder_counts_per_turn=COUNTS, **settings)
    return ElmoInterpreter(ElmoDeviceSettings(), constants, state)


@pytest.fixture
def drive() -> ElmoInterpreter:
    """A frictionless joint at rest."""
    return interpreter()


def say(drive: ElmoInterpreter, *lines: str) -> bytes:
    reply = b""
    for line in lines:
        reply = drive.execute(line.encode())
    return reply


@pytest.fixture
def device() -> Iterator[ElmoDevice]:
    with ElmoDevice(interpreter(initial_position_rad=0.1), 19_200) as running:
        yield running


def refused(drive: ElmoInterpreter, line: str) -> int:
    reply = drive.execute(line.encode())
    assert reply[1:] == b"?;", (line, reply)
    assert drive.execute(b"EC") == b"%d;" % reply[0]
    return reply[0]


class TestCommands:
    @pytest.mark.parametrize(
        ("line", "code"),
        [
            ("XX", 2), ("px", 19), ("PX[1]", 3), ("CL", 3), ("CL[7]", 3), ("CL[1]=", 19), ("CL[1]=abc", 19),
            ("VR=1", 23), ("SR=1", 23), ("UM=9", 21), ("UM=3", 60), ("MO=2", 21), ("TC=1", 58), ("BG", 58),
            ("CL[1]=0", 21), ("CL[1]=21", 21), ("CL[1]=11", 28), ("PL[1]=4.9", 28), ("AC=0", 21), ("RM=2", 21),
            ("MC=5", 23), ("CA[18]=4", 23), ("EO=2", 21),
        ],
    )  # fmt: skip
    def test_what_is_refused_and_why(self, drive: ElmoInterpreter, line: str, code: int) -> None:
        assert refused(drive, line) == code

    @pytest.mark.parametrize(("line", "code"), [("UM=2", 57), ("RM=1", 57), ("PX=0", 57)])
    def test_some_need_the_motor_off(self, drive: ElmoInterpreter, line: str, code: int) -> None:
        say(drive, "UM=1", "MO=1")
        assert refused(drive, line) == code
        say(drive, "MO=0")
        assert drive.execute(line.encode()) == b";"

    def test_torque_only_in_its_unit_mode_and_up_to_the_peak(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=2", "MO=1")
        assert refused(drive, "TC=1") == 12
        say(drive, "MO=0", "UM=1", "MO=1", "PL[1]=6")
        assert refused(drive, "TC=6.001") == 28
        assert say(drive, "TC=6") == b";"
        assert say(drive, "TC") == b"6.000;"
        assert say(drive, "ST", "TC") == b"0.000;"

    def test_an_amplifier_that_is_not_ready_does_not_switch_on(self, drive: ElmoInterpreter) -> None:
        drive.amplifier = 3
        assert refused(drive, "MO=1") == 66
        assert int(say(drive, "SR")[:-1]) & 0xF == 3
        drive.amplifier = 0
        assert say(drive, "MO=1", "MO") == b"1;"

    def test_the_status_word(self, drive: ElmoInterpreter) -> None:
        assert say(drive, "UM=1", "SR") == b"%d;" % (1 << 7)
        assert say(drive, "MO=1", "SR") == b"%d;" % (1 << 7 | 1 << 4)

    def test_a_restart_forgets_what_was_set(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=1", "EO=0", "CL[1]=1", "MO=1")
        drive.restart()
        assert (say(drive, "UM"), say(drive, "MO"), say(drive, "EO"), say(drive, "CL[1]")) == (
            b"5;", b"0;", b"1;", b"5.0000;",
        )  # fmt: skip


class TestMotion:
    def test_torque_accelerates_the_joint(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=1", "MO=1", "TC=1")
        drive.advance_to(0.1)
        acceleration = float(drive.constants[0].torque_per_current_NmpA * drive.constants[0].inverse_driven_inertia)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(0.1 * acceleration * PER_RAD, rel=0.01)
        assert say(drive, "IQ") == b"1.0000;"

    @pytest.mark.parametrize("torque_direction", [1, -1])
    @pytest.mark.parametrize("encoder_direction", [1, -1])
    def test_each_direction_is_that_of_the_configuration(self, torque_direction: int, encoder_direction: int) -> None:
        """With torque_direction -1 the virtual joint turned the wrong way, and `doctor --motion` said so."""
        constants, state = plant(encoder_counts_per_turn=COUNTS, encoder_direction=encoder_direction)
        settings = ElmoDeviceSettings(current_sign=torque_direction * encoder_direction)
        for words, joint_side in (
            (("UM=1", "MO=1", "TC=1"), torque_direction),
            (("MO=0", "UM=2", "MO=1", f"JV={round(0.5 * PER_RAD)}", "BG"), encoder_direction),
        ):
            drive = ElmoInterpreter(settings, constants.copy(), state.copy())
            say(drive, *words)
            drive.advance_to(0.1)
            assert joint_side * float(drive.state[0].joint_position_rad) > 0.0
            assert encoder_direction * joint_side * int(say(drive, "PX")[:-1]) > 0
            if words[0] == "UM=1":
                assert say(drive, "IQ") == b"1.0000;"

    def test_speed_mode_follows_jog_along_the_ramp(self) -> None:
        drive = interpreter(friction_kind=2)
        say(drive, "UM=2", "AC=100000", "DC=100000", "MO=1", "JV=20000")
        drive.advance_to(0.2)
        assert abs(int(say(drive, "VX")[:-1])) < 10  # not before BG
        say(drive, "BG")
        drive.advance_to(0.3)
        assert 1000 < int(say(drive, "VX")[:-1]) < 12000
        drive.advance_to(1.2)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20000, abs=300)
        say(drive, "ST")
        drive.advance_to(2.0)
        assert abs(int(say(drive, "VX")[:-1])) < 300

    @pytest.mark.parametrize(("command", "ramp"), [("ST", "SD"), ("JV=0", "DC")])
    def test_st_brakes_along_sd_and_jog_zero_along_dc(self, drive: ElmoInterpreter, command: str, ramp: str) -> None:
        say(drive, "UM=2", "AC=400000", "DC=400000", "SD=400000", f"{ramp}=20000", "MO=1", "JV=20000", "BG")
        drive.advance_to(1.0)
        say(drive, command, "BG" if command == "JV=0" else "SR")
        drive.advance_to(1.5)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(10_000, rel=0.1)
        drive.advance_to(3.0)
        assert abs(int(say(drive, "VX")[:-1])) < 300

    def test_after_st_the_jog_is_kept_and_another_bg_goes_on(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=2", "MO=1", "JV=20000", "BG")
        drive.advance_to(0.5)
        say(drive, "ST")
        drive.advance_to(1.5)
        assert say(drive, "JV") == b"20000;"
        say(drive, "BG")
        drive.advance_to(2.5)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20_000, rel=0.05)

    def test_a_jog_goes_on_without_commands_until_the_drives_position_limit(self) -> None:
        drive = interpreter(friction_kind=2)
        say(drive, "HL[3]=40000", "UM=2", "MO=1", "JV=20000", "BG")
        drive.advance_to(1.5)
        assert say(drive, "MO") == b"1;"  # its twin: inside the limit nothing ends it
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20_000, rel=0.05)
        drive.advance_to(4.0)
        assert (say(drive, "MO"), say(drive, "MF")) == (b"0;", b"%d;" % MF_POSITION_LIMIT)
        assert int(say(drive, "PX")[:-1]) == pytest.approx(40_000, rel=0.05)

    def test_position_mode_arrives(self, drive: ElmoInterpreter) -> None:
        say(drive, "MO=1", "SP=50000", "AC=200000", "DC=200000", "PA=20000", "BG")
        drive.advance_to(0.1)
        assert say(drive, "MS") == b"2;"
        drive.advance_to(3.0)
        assert int(say(drive, "PX")[:-1]) == pytest.approx(20000, abs=3)
        assert say(drive, "MS") == b"0;"

    @pytest.mark.parametrize(("time_s", "limited"), [(0.99, False), (1.01, True)])
    def test_above_the_continuous_current_only_for_the_peak_time(self, time_s: float, limited: bool) -> None:
        drive = interpreter(load_torque_Nm=36.3)
        say(drive, "CL[1]=2", "PL[1]=4", "PL[2]=1", "UM=1", "MO=1", "TC=3")
        drive.advance_to(time_s)
        assert float(say(drive, "IQ")[:-1]) == pytest.approx(2.0 if limited else 3.0)
        assert bool(int(say(drive, "SR")[:-1]) & 1 << 13) == limited

    @pytest.mark.parametrize(("speed", "fault"), [(39_000, MF_OVERSPEED), (41_000, 0)])
    def test_overspeed_switches_off(self, drive: ElmoInterpreter, speed: int, fault: int) -> None:
        say(drive, f"HL[2]={speed}", "UM=1", "MO=1", "TC=1")
        drive.state[0].joint_velocity_radps = 40_000 / PER_RAD
        drive.advance_to(2 * 50e-6 + 1e-9)
        assert say(drive, "MF") == b"%d;" % fault
        assert say(drive, "MO") == (b"0;" if fault else b"1;")

    @pytest.mark.trips("serial drive: current, speed, position", "(9_999, MF_POSITION_LIMIT)")
    @pytest.mark.stays("serial drive: current, speed, position", "(10_001, 0)")
    @pytest.mark.parametrize(("end", "fault"), [(9_999, MF_POSITION_LIMIT), (10_001, 0)])
    def test_leaving_the_position_limits_switches_off(self, drive: ElmoInterpreter, end: int, fault: int) -> None:
        say(drive, f"HL[3]={end}", "UM=1", "MO=1")
        drive.state[0].joint_position_rad = 10_000 / PER_RAD
        drive.advance_to(2 * 50e-6 + 1e-9)
        assert say(drive, "MF") == b"%d;" % fault

    def test_a_blocked_joint_trips_the_speed_error_and_mo_clears_it(self) -> None:
        drive = interpreter(load_torque_Nm=400.0, end_stops=True, end_stop_min_rad=-0.001, end_stop_max_rad=0.001)
        say(drive, "ER[2]=5000", "UM=2", "AC=1000000", "DC=1000000", "MO=1", "JV=20000", "BG")
        drive.advance_to(0.3)
        assert say(drive, "MF") == b"%d;" % MF_SPEED_ERROR
        assert int(say(drive, "SR")[:-1]) & 1 << 6
        assert say(drive, "MO=1", "MF") == b"0;"


class TestLine:
    def test_a_character_takes_its_time(self, device: ElmoDevice) -> None:
        driver = OtherDriver(device.path)
        with driver.port:
            started = time.monotonic()
            for _ in range(5):
                driver.ask("VR")
            # VR, CR out, 29 characters and ; back: a lower bound, which a busy computer cannot break
            assert time.monotonic() - started >= 5 * (3 + 29) * 10 / 19_200

    def test_semicolon_ends_a_command_as_well_and_echo_can_be_off(self, device: ElmoDevice) -> None:
        with serial.Serial(device.path, 19_200, timeout=60.0) as port:
            port.write(b"EO=0\r")
            assert port.read_until(b";") == b"EO=0\r;"
            port.write(b"UM;MO;")
            assert port.read_until(b";") + port.read_until(b";") == b"5;0;"

    def test_another_baud_rate_is_garbage_both_ways(self, device: ElmoDevice) -> None:
        with serial.Serial(device.path, 9600, timeout=0.2) as port:
            port.write(b"MO=1\r")
            assert b"MO=1" not in port.read(20)
            assert device.interpreter.m.motor_on == 0

    def test_a_vanished_port_leaves_the_drive_going(self, device: ElmoDevice) -> None:
        fd = os.open(device.path, os.O_RDWR | os.O_NOCTTY)
        device.vanish()
        give_up = time.monotonic() + 60.0
        gone = False
        while not gone and time.monotonic() < give_up:  # the thread may still wait on its end for a moment
            try:
                os.write(fd, b"PX\r")
                time.sleep(0.001)
            except OSError:
                gone = True
        os.close(fd)
        assert gone
        before = float(device.interpreter.state[0].time_s)
        give_up = time.monotonic() + 60.0
        while device.interpreter.state[0].time_s <= before and time.monotonic() < give_up:
            time.sleep(0.005)
        assert device.interpreter.state[0].time_s > before


# --- The dialogue of an independent driver with the virtual serial drive, command by command ---
# Recorded in November 2026 with the Elmo Whistle controller of `bliss` 2.4.0 (PyPI; the motor control of the ESRF) and
# its own serial line code at 19200 baud: it switched the virtual drive on, moved it, stopped it in motion, jogged it,
# set its position and switched it off, without an error of its own.  It is too heavy to be installed for a test, so
# what it says, and what it takes for an answer, is kept here.  Its configuration service and its process database were
# replaced by stubs; the controller class and the serial line were its own.
SERVO_ON, MOVING = 1 << 4, 0x3 << 14
TIMEOUT_S = 60.0


class OtherDriver:
    """Its rules: a reply ends with `;` and begins with the command and CR; `?` at its end asks for EC."""

    def __init__(self, path: str) -> None:
        self.port = serial.Serial(path, 19_200, timeout=60.0)

    def ask(self, command: str) -> str:
        sent = command + "\r"
        self.port.write(sent.encode())
        reply = self.port.read_until(b";").decode()
        assert reply.startswith(sent), reply
        value = reply[len(sent) : -1]
        if value.endswith("?"):
            raise RuntimeError(f"error {self.ask('EC')}")
        return value

    def says(self, *commands: str) -> None:
        """Each is answered by nothing but its echo."""
        for command in commands:
            assert self.ask(command) == "", command

    def state(self) -> int:
        """SR and, as it always does, IP after it."""
        status = int(self.ask("SR"))
        assert int(self.ask("IP")) & 0x1C00 == 0  # no limit switch, no inhibit
        assert status & 1 == 0  # its test for a drive in trouble
        return status

    def position(self) -> float:
        """The encoder while the drive moves, else the target."""
        return float(self.ask("PX" if self.ask("MS") == "2" else "PA"))

    def start(self, target: int) -> None:
        status = int(self.ask("SR"))
        assert status & SERVO_ON
        assert status >> 7 & 7 == 5
        assert self.ask("IP") == "0"
        self.says(f"PA={target}", "BG")


def test_it_switches_the_drive_on_and_moves_it(device: ElmoDevice) -> None:
    driver = OtherDriver(device.path)
    with driver.port:
        assert driver.ask("VR").startswith("Whistle")
        assert (driver.ask("UM"), driver.ask("MO")) == ("5", "0")
        with pytest.raises(RuntimeError, match="error 58"):
            driver.ask("BG")
        driver.says("MO=1")
        assert driver.ask("UM") == "5"
        assert driver.state() & (SERVO_ON | MOVING) == SERVO_ON
        start = int(driver.position())
        assert start == round(0.1 * PER_RAD)
        driver.says("SP=80000", "AC=400000", "DC=400000")
        assert (driver.ask("SP"), driver.ask("AC")) == ("80000", "400000")

        driver.start(start + 20_000)
        seen, give_up_s = [], time.monotonic() + TIMEOUT_S
        while driver.state() & MOVING and time.monotonic() < give_up_s:
            seen.append(driver.position())
        assert seen == sorted(seen)
        assert len(seen) > 3
        assert int(driver.ask("PX")) == pytest.approx(start + 20_000, abs=3)

        driver.start(start)
        while int(driver.ask("PX")) > start + 15_000 and time.monotonic() < give_up_s:
            pass
        driver.says("ST")
        while driver.ask("MS") != "0" and time.monotonic() < give_up_s:
            pass
        stopped = int(driver.ask("PX"))
        driver.says(f"PA={stopped}")  # its way around a target that stays behind after ST
        assert start < stopped < start + 20_000
        assert driver.position() == stopped


def test_it_jogs_sets_the_position_and_switches_off(device: ElmoDevice) -> None:
    driver = OtherDriver(device.path)
    with driver.port:
        driver.says("MO=1", "AC=400000", "DC=400000", "MO=0", "UM=2", "PM=1", "MO=1")
        assert driver.ask("UM") == "2"
        assert float(driver.ask("VL[2]")) < -30_000 < 30_000 < float(driver.ask("VH[2]"))
        driver.says("JV=30000", "BG")
        give_up_s = time.monotonic() + TIMEOUT_S
        while int(driver.ask("VX")) < 25_000 and time.monotonic() < give_up_s:
            pass
        status = driver.state()
        assert (status >> 7 & 7, status & MOVING != 0) == (2, True)
        driver.says("JV=0", "BG")
        while driver.ask("MS") == "2" and time.monotonic() < give_up_s:
            pass
        driver.says("MO=0", "UM=5", "MO=1")
        driver.says(f"PA={int(driver.ask('PX'))}")
        assert (driver.ask("UM"), driver.ask("MO")) == ("5", "1")

        driver.says("MO=0", "PX=1000", "MO=1", "PA=1000")
        assert driver.position() == 1000.0
        with pytest.raises(RuntimeError, match="error 57"):
            driver.ask("UM=9")
        driver.says("MO=0")
        assert driver.ask("MO") == "0"
        assert driver.state() & SERVO_ON == 0
