"""The ASCII interpreter without a port: commands, replies, garbage, time-outs; and codes in words."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.elmo.codes import (
    error_text,
    motor_fault_names,
    motor_fault_text,
    motor_off_cause,
    status_text,
    unit_mode,
)
from jointctl.drivers.elmo.dialogue import REPLY_MAX, Interpreter, Reply, ReplyKind, encode, parse_reply


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("PX",), b"PX\r"),
        (("MO", None, 1), b"MO=1\r"),
        (("CL", 1, 2.5), b"CL[1]=2.500000\r"),
        (("HL", 2, -100000.0), b"HL[2]=-100000\r"),
        (("TC", None, -0.125), b"TC=-0.125000\r"),
        (("XQ", None, "##HOME"), b"XQ=##HOME\r"),
    ],
)
def test_commands_are_encoded(arguments: tuple[str], line: bytes) -> None:
    assert encode(*arguments) == line


@pytest.mark.parametrize("name", ["px", "P", "PXX", "", "P;", "PX\r"])
def test_only_two_capital_letters_are_a_command(name: str) -> None:
    with pytest.raises(ValueError, match="two capital letters"):
        encode(name)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_must_be_finite(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        encode("TC", None, value)


@pytest.mark.parametrize("value", ["1;MO=1", "1\rMO=1", "x" * 70])
def test_a_text_value_cannot_smuggle_a_second_command(value: str) -> None:
    with pytest.raises(ValueError, match="characters"):
        encode("XQ", None, value)


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
    def test_a_reply_in_single_characters(self) -> None:
        machine = Interpreter()
        assert machine.begin(b"PX\r", 0.0, 0.1) == b"PX\r"
        replies = [machine.feed(bytes((byte,)), 0.01) for byte in b"PX\r12345;"]
        assert replies[:-1] == [None] * 8
        assert replies[-1] is not None
        assert (replies[-1].text, replies[-1].echoed) == ("12345", True)
        assert not machine.busy

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

    @settings(max_examples=200, deadline=None)
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

    @given(st.integers(-(2**31), 2**31 - 1), st.lists(st.integers(1, 12), max_size=4), st.booleans())
    def test_a_good_reply_is_the_same_however_it_is_cut(self, value: int, cuts: list[int], echo: bool) -> None:
        data = (b"PX\r" if echo else b"") + str(value).encode() + b";"
        machine = Interpreter(echo)
        machine.begin(b"PX\r", 0.0, 1.0)
        last = None
        places = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
        for start, end in itertools.pairwise(places):
            last = machine.feed(data[start:end], 0.0)
        assert last is not None
        assert int(last.text) == value


class TestCodes:
    def test_error_codes(self) -> None:
        assert error_text(57) == "EC 57 (motor must be off)"
        assert error_text(250) == "EC 250 (not in the list)"

    @pytest.mark.parametrize(
        ("fault", "names"),
        [
            (0, []),
            (0x1, ["feedback"]),
            (0x20000, ["overspeed (HL[2], LL[2])"]),
            (0x7000, ["safe torque off (STO)"]),
            (0xB008, ["peak current exceeded", "short circuit"]),
            (0x1000, ["amplifier code 1h"]),
            (0x80000000, ["unknown bits 80000000h"]),
        ],
    )
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
