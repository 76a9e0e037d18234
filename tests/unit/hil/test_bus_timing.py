"""Exact frame lengths and the arbitration of the virtual bus, with the time as an argument."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.can.frames import worst_frame_bits
from jointctl.firmware_py.schema import new
from jointctl.hil.bus.timing import (
    EXTENDED,
    NO_NODE,
    REMOTE,
    Wire,
    arbitration_key,
    crc15_step,
    finish_frame,
    frame_bits,
    pend_frame,
)
from jointctl.hil.bus.virtual_bus import WireFrame

STANDARD_BITS, EXTENDED_BITS = 47, 67  # of a frame without data and stuff bits, interframe space included


def wire_frame(identifier: int, payload: bytes = b"") -> Any:
    frame = new(WireFrame)
    frame["identifier"][0] = identifier
    frame["length"][0] = len(payload)
    frame["payload"][0, : len(payload)] = list(payload)
    return frame


def bits_by_text(identifier: int, payload: bytes) -> int:
    """The same length by another way: the frame as a text of bits, the CRC by polynomial division."""
    length = f"{len(payload):04b}"
    remote = "1" if identifier & REMOTE else "0"
    if identifier & EXTENDED:
        number = f"{identifier & 0x1FFFFFFF:029b}"
        text = "0" + number[:11] + "11" + number[11:] + remote + "00" + length
    else:
        text = "0" + f"{identifier & 0x7FF:011b}" + remote + "00" + length
    if remote == "0":
        text += "".join(f"{byte:08b}" for byte in payload)
    remainder = int(text, 2) << 15
    for position in range(len(text) - 1, -1, -1):
        if remainder >> (position + 15) & 1:
            remainder ^= 0xC599 << position
    text += f"{remainder:015b}"
    stuffed = ""
    for bit in text:
        stuffed += bit
        if stuffed.endswith(("00000", "11111")):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + 13


def test_crc_has_the_published_check_value() -> None:
    crc = 0
    for byte in b"123456789":
        for shift in range(7, -1, -1):
            crc = crc15_step(crc, (byte >> shift) & 1)
    assert crc == 0x059E  # CRC-15/CAN in the catalogue of parametrised CRC algorithms


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 0x7FF), st.booleans(), st.binary(max_size=8))
def test_standard_frames_have_the_exact_length(identifier: int, remote: bool, payload: bytes) -> None:
    word = identifier | (REMOTE if remote else 0)
    bits = frame_bits(wire_frame(word, payload), 0)
    assert bits == bits_by_text(word, payload)
    carried = 0 if remote else len(payload)
    assert STANDARD_BITS + 8 * carried <= bits <= worst_frame_bits(carried)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 0x1FFFFFFF), st.booleans(), st.binary(max_size=8))
def test_extended_frames_have_the_exact_length(identifier: int, remote: bool, payload: bytes) -> None:
    word = identifier | EXTENDED | (REMOTE if remote else 0)
    bits = frame_bits(wire_frame(word, payload), 0)
    assert bits == bits_by_text(word, payload)
    carried = 0 if remote else len(payload)
    assert EXTENDED_BITS + 8 * carried <= bits <= worst_frame_bits(carried, extended=True)


def test_arbitration_order() -> None:
    base = 0x123
    ordered = [
        0,
        base - 1,
        base,
        base | REMOTE,
        EXTENDED | base << 18,
        EXTENDED | REMOTE | base << 18,
        EXTENDED | base << 18 | 1,
        base + 1,
        0x7FF,
        EXTENDED | 0x1FFFFFFF,
    ]
    keys = [arbitration_key(identifier) for identifier in ordered]
    assert keys == sorted(keys)
    assert len(set(keys)) == len(keys)


class Timeline:
    """Three nodes with queues of two frames at 1 Mbit/s: 1 bit is 1000 ns."""

    def __init__(self) -> None:
        self.wire = new(Wire)
        self.wire["bitrate_bitps"] = 1_000_000
        self.wire["sender"] = NO_NODE
        self.queues = (new(WireFrame, 6), np.zeros(6, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64))
        self.on_wire, self.finished = new(WireFrame), new(WireFrame)

    def pend(self, node: int, identifier: int, now_ns: int) -> bool:
        return bool(pend_frame(wire_frame(identifier), node, now_ns, *self.queues))

    def finish(self, now_ns: int) -> tuple[int, int] | None:
        sender = finish_frame(self.wire, now_ns, *self.queues, self.on_wire, self.finished)
        return None if sender == NO_NODE else (sender, int(self.finished["identifier"][0]))


def test_a_frame_is_there_when_its_last_bit_is_over() -> None:
    bus = Timeline()
    bus.pend(0, 0x155, 5000)
    over_ns = 5000 + (frame_bits(wire_frame(0x155), 0) - 3) * 1000
    assert bus.finish(5000) is None
    assert bus.finish(over_ns - 1) is None
    assert bus.finish(over_ns) == (0, 0x155)
    assert bus.finish(over_ns + 10**9) is None


def test_the_lowest_waiting_identifier_wins_and_none_is_interrupted() -> None:
    bus = Timeline()
    bus.pend(0, 0x700, 0)
    assert bus.finish(0) is None  # 0x700 is on the wire
    bus.pend(1, 0x600, 10_000)
    bus.pend(2, 0x100, 20_000)
    seen = [bus.finish(10**9) for _ in range(4)]
    assert seen == [(0, 0x700), (2, 0x100), (1, 0x600), None]


def test_back_to_back_frames_are_three_bits_apart_even_after_a_late_wake_up() -> None:
    bus = Timeline()
    bus.pend(0, 0x155, 0)
    bus.pend(0, 0x2AA, 0)
    first = frame_bits(wire_frame(0x155), 0) * 1000
    second = frame_bits(wire_frame(0x2AA), 0) * 1000
    assert bus.finish(first + second - 3001) == (0, 0x155)
    assert bus.finish(first + second - 3001) is None
    assert bus.finish(first + second - 3000) == (0, 0x2AA)


def test_a_frame_that_came_later_does_not_take_part_in_an_earlier_arbitration() -> None:
    bus = Timeline()
    bus.pend(0, 0x700, 0)
    bus.pend(1, 0x001, 1)
    assert [bus.finish(10**9), bus.finish(10**9)] == [(0, 0x700), (1, 0x001)]
    twin = Timeline()
    twin.pend(0, 0x700, 1)
    twin.pend(1, 0x001, 1)
    assert [twin.finish(10**9), twin.finish(10**9)] == [(1, 0x001), (0, 0x700)]


def test_queues_are_first_in_first_out_and_bounded() -> None:
    bus = Timeline()
    assert [bus.pend(0, identifier, 0) for identifier in (0x300, 0x200, 0x100)] == [True, True, False]
    assert [bus.finish(10**9) for _ in range(3)] == [(0, 0x300), (0, 0x200), None]
    assert bus.pend(0, 0x100, 0)


@pytest.mark.parametrize("bitrate", [125_000, 500_000])
def test_lower_bit_rates_take_longer(bitrate: int) -> None:
    bus = Timeline()
    bus.wire["bitrate_bitps"] = bitrate
    bus.pend(0, 0x155, 0)
    over_ns = (frame_bits(wire_frame(0x155), 0) - 3) * (10**9 // bitrate)
    assert bus.finish(over_ns - 1) is None
    assert bus.finish(over_ns) == (0, 0x155)
