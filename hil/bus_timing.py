"""Bit times and arbitration of the virtual CAN bus: the exact length of a frame, and who is next on the wire.

Sources: ISO 11898-1 (frame format, bit stuffing, CRC-15 with generator 0x4599, arbitration).  All functions are
kernels without sockets and without a clock: the time is an argument.

Modelled: frames wait per node in a bounded queue; when the bus is free, the oldest frames of all nodes contend and
the lowest identifier wins (bit by bit as on the wire, so that a data frame beats the remote frame of the same
identifier, and a standard frame the extended one of the same first 11 bits); a frame is there when its last bit is
over; the next starts 3 bit times later.
Not modelled: two nodes that send the same identifier at once (here the lower slot goes first; on a wire they
destroy each other's frame), bit errors, error and overload frames, acknowledge, propagation delay, clock tolerance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.schema import i8, record

EXTENDED = 0x80000000
REMOTE = 0x40000000
INTERFRAME_BITS = 3
_AFTER_CRC_BITS = 13  # CRC delimiter, acknowledge slot and delimiter, 7 end of frame, 3 interframe
NO_NODE = -1


@record
class Wire:
    """The state of the bus: which node sends, when its frame is there, when the bus is free again."""

    bitrate_bitps: i8
    sender: i8  # slot of the node whose frame is on the wire, or NO_NODE
    delivered_ns: i8
    free_ns: i8
    bits: i8  # of the frame on the wire


class Waiting(NamedTuple):
    """The frames that wait for the bus, a ring of the same depth for each node."""

    frames: np.ndarray  # WireFrame[nodes * depth]
    arrival_ns: np.ndarray  # int64[nodes * depth]
    heads: np.ndarray  # int64[nodes]
    counts: np.ndarray  # int64[nodes]


@kernel
def crc15_step(crc: int, bit: int) -> int:
    """Shift one bit into the CRC-15 of CAN (starts at 0)."""
    feedback = bit ^ (crc >> 14)
    shifted = (crc << 1) & 0x7FFF
    return shifted ^ 0x4599 if feedback else shifted


@kernel
def _append(value: int, count: int, crc: int, last: int, run: int, bits: int) -> tuple[int, int, int, int]:
    """Put `count` bits of `value`, highest first, on the wire; a stuff bit follows 5 equal bits and starts a run."""
    for shift in range(count - 1, -1, -1):
        bit = (value >> shift) & 1
        crc = crc15_step(crc, bit)
        run = run + 1 if bit == last else 1
        last = bit
        bits += 1
        if run == 5:
            last = 1 - bit
            run = 1
            bits += 1
    return crc, last, run, bits


@kernel
def frame_bits(frames: np.ndarray, index: int) -> int:
    """Exact length [bit] on the wire of `frames[index]` (WireFrame), with stuff bits and 3 interframe bits."""
    identifier = int(np.int64(frames[index]["identifier"]))
    size = int(np.int64(frames[index]["length"]))
    payload = frames[index]["payload"]
    remote = 1 if identifier & REMOTE else 0
    if identifier & EXTENDED:
        first, second = (identifier >> 18) & 0x7FF, identifier & 0x3FFFF
        # start, 11 bits, SRR = 1, IDE = 1, 18 bits, RTR, two reserved 0, length
        header = (first << 27) | (3 << 25) | (second << 7) | (remote << 6) | size
        count = 39
    else:
        # start, 11 bits, RTR, IDE = 0, reserved 0, length
        header = ((identifier & 0x7FF) << 7) | (remote << 6) | size
        count = 19
    crc, last, run, bits = _append(header, count, 0, 1, 0, 0)
    if not remote:
        for k in range(size):
            crc, last, run, bits = _append(int(np.int64(payload[k])), 8, crc, last, run, bits)
    _, last, run, bits = _append(crc, 15, 0, last, run, bits)
    return bits + _AFTER_CRC_BITS


@kernel
def arbitration_key(identifier: int) -> int:
    """The 32 bits that decide the arbitration, as a number: the lower one wins."""
    remote = 1 if identifier & REMOTE else 0
    if identifier & EXTENDED:
        first, second = (identifier >> 18) & 0x7FF, identifier & 0x3FFFF
        return int((first << 21) | (3 << 19) | (second << 1) | remote)
    return int(((identifier & 0x7FF) << 21) | (remote << 20))


@kernel
def pend_frame(frame: np.ndarray, node: int, now_ns: int, waiting: Waiting) -> bool:
    """Queue `frame[0]` at `node`; False if its queue is full."""
    pending, arrival_ns, heads, counts = waiting
    depth = len(arrival_ns) // len(heads)
    if counts[node] >= depth:
        return False
    slot = node * depth + (heads[node] + counts[node]) % depth
    pending[slot] = frame[0]
    arrival_ns[slot] = now_ns
    counts[node] += 1
    return True


@kernel
def _start_next(wire: np.ndarray, waiting: Waiting, on_wire: np.ndarray) -> None:
    """Arbitrate among the oldest frames of all nodes, at the first moment when the bus is free and one waits."""
    pending, arrival_ns, heads, counts = waiting
    depth = len(arrival_ns) // len(heads)
    earliest_ns = -1
    for node in range(len(heads)):
        if counts[node] > 0:
            arrived = arrival_ns[node * depth + heads[node]]
            if earliest_ns < 0 or arrived < earliest_ns:
                earliest_ns = arrived
    if earliest_ns < 0:
        return
    start_ns = max(earliest_ns, wire[0].free_ns)
    winner, lowest = -1, 1 << 32
    for node in range(len(heads)):
        if counts[node] > 0:
            slot = node * depth + heads[node]
            key = arbitration_key(int(np.int64(pending[slot]["identifier"])))
            if arrival_ns[slot] <= start_ns and key < lowest:
                winner, lowest = node, key
    on_wire[0] = pending[winner * depth + heads[winner]]
    heads[winner] = (heads[winner] + 1) % depth
    counts[winner] -= 1
    bits = frame_bits(on_wire, 0)
    wire[0].sender = winner
    wire[0].bits = bits
    wire[0].delivered_ns = start_ns + (bits - INTERFRAME_BITS) * NANOSECONDS // wire[0].bitrate_bitps
    wire[0].free_ns = start_ns + bits * NANOSECONDS // wire[0].bitrate_bitps


@kernel
def finish_frame(wire: np.ndarray, now_ns: int, waiting: Waiting, on_wire: np.ndarray, finished: np.ndarray) -> int:
    """The sender of the next frame whose last bit is over at `now_ns`, the frame in `finished[0]`; else NO_NODE.

    Called until it returns NO_NODE, it catches up after a late wake-up with the times as they should have been.
    All frames that arrived up to `now_ns` must have been queued before.
    """
    if wire[0].sender == NO_NODE:
        _start_next(wire, waiting, on_wire)
    if wire[0].sender == NO_NODE or now_ns < wire[0].delivered_ns:
        return NO_NODE
    sender = int(wire[0].sender)
    finished[0] = on_wire[0]
    wire[0].sender = NO_NODE
    return sender
