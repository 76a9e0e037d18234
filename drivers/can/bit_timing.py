"""How many bits a classic CAN frame takes on the wire, and what rate a bus can carry.

Source: ISO 11898-1 frame format; the worst case of bit stuffing after Davis, Burns, Bril and Lukkien (2007),
"Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised".  All figures include the
3 bits between frames.  Not modelled: error frames and repeated frames, overload frames, remote frames
(which carry no data: pass length 0), CAN FD.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

_STANDARD_STUFFED_BITS = 34  # start, 11 bit identifier, control, CRC sequence: the part that is bit-stuffed
_EXTENDED_STUFFED_BITS = 54
_TAIL_BITS = 13  # CRC delimiter, acknowledge slot and delimiter, end of frame (7), interframe space (3)
_LONGEST_DATA = 8


def _stuffed_bits(length: int, extended: bool) -> int:
    if not 0 <= length <= _LONGEST_DATA:
        raise ValueError(f"data length (={length}) must be in [0..{_LONGEST_DATA}] bytes")
    return (_EXTENDED_STUFFED_BITS if extended else _STANDARD_STUFFED_BITS) + 8 * length


def worst_frame_bits(length: int, extended: bool = False) -> int:
    """Bits of a frame of `length` data bytes at worst: one stuff bit after the first 5 bits, then after every 4."""
    stuffed = _stuffed_bits(length, extended)
    return stuffed + (stuffed - 1) // 4 + _TAIL_BITS


def worst_cycle_bits(lengths: Iterable[int], extended: bool = False) -> int:
    """Worst-case bits of one cycle: the sum over its frames, each given by its number of data bytes."""
    return sum(worst_frame_bits(length, extended) for length in lengths)


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
