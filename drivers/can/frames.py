"""A classic CAN frame: its 16 bytes in memory, its bits on the wire, and what rate a bus can carry.

In memory it is Linux' `struct can_frame`, the same on AF_CAN and on the virtual bus.

Source of the bits: ISO 11898-1 frame format; the worst case of bit stuffing after Davis, Burns, Bril and Lukkien
(2007), "Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised".  All figures include
the 3 bits between frames.  Not modelled: error frames and repeated frames, overload frames, remote frames (which carry
no data: pass length 0), CAN FD.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, record, u1, u4

EXTENDED_FLAG = 0x80000000
REMOTE_FLAG = 0x40000000
ERROR_FLAG = 0x20000000
FRAME_BYTES = 16
FRAME_STRUCT = struct.Struct("<IB3x8s")  # identifier with its flags, length, data
_STUFFED_BITS = 34  # start, 11 bit identifier, control, CRC sequence: the part that is bit-stuffed
_TAIL_BITS = 13  # CRC delimiter, acknowledge slot and delimiter, end of frame (7), interframe space (3)
_LONGEST_DATA = 8


@record
class Frame:
    can_id: u4  # 11 bit identifier, flags in the upper bits
    length: u1
    padding: u1
    reserved: u1
    length8: u1
    payload: Annotated[np.ndarray, array_of(u1, 8)]


def worst_frame_bits(length: int) -> int:
    """Bits of a frame of `length` data bytes at worst: one stuff bit after the first 5 bits, then after every 4."""
    if not 0 <= length <= _LONGEST_DATA:
        raise ValueError(f"data length (={length}) must be in [0..{_LONGEST_DATA}] bytes")
    stuffed = _STUFFED_BITS + 8 * length
    return stuffed + (stuffed - 1) // 4 + _TAIL_BITS


def worst_cycle_bits(lengths: Iterable[int]) -> int:
    """Worst-case bits of one cycle: the sum over its frames, each given by its number of data bytes."""
    return sum(map(worst_frame_bits, lengths))


def bus_load(frames_per_cycle: Sequence[int], rate_Hz: float, bitrate_bitps: int) -> float:
    """Worst-case share of the bus time that is used, 0.285 for 28.5 %; above 1 the frames do not fit.

    `frames_per_cycle` lists the data length in bytes of every frame of a cycle: SYNC, TPDO(8), RPDO(4) is [0, 8, 4].
    """
    if not rate_Hz > 0.0:
        raise ValueError(f"rate_Hz (={rate_Hz:g}) must be above 0")
    return worst_cycle_bits(frames_per_cycle) * rate_Hz / _checked_bitrate(bitrate_bitps)


def highest_rate_Hz(frames_per_cycle: Sequence[int], bitrate_bitps: int, highest_load: float = 1.0) -> float:
    """Cycle rate [Hz] at which the worst-case load reaches `highest_load` (1.0: no time left for anything else)."""
    if not frames_per_cycle:
        raise ValueError("frames_per_cycle (=empty) must name at least one frame")
    if not 0.0 < highest_load <= 1.0:
        raise ValueError(f"highest_load (={highest_load:g}) must be above 0 and at most 1")
    return _checked_bitrate(bitrate_bitps) * highest_load / worst_cycle_bits(frames_per_cycle)


def _checked_bitrate(bitrate_bitps: int) -> int:
    if not 0 < bitrate_bitps <= 1_000_000:
        raise ValueError(f"bitrate_bitps (={bitrate_bitps}) must be in [1..1000000] for classic CAN")
    return bitrate_bitps
