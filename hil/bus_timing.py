"""Time on the virtual CAN bus: the exact length of a frame, who is next on the wire, and when a frame was sent.

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

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.schema import i8, record

if TYPE_CHECKING:
    from jointctl.hil.virtual_bus import FrameQueue

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
def frame_bits(frames: np.ndarray) -> int:
    """Exact length [bit] on the wire of the first of `frames` (WireFrame), with stuff bits and 3 interframe bits."""
    identifier = int(np.int64(frames[0]["identifier"]))
    size = int(np.int64(frames[0]["length"]))
    payload = frames[0]["payload"]
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
    bits = frame_bits(on_wire)
    wire[0].sender = winner
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


# --- When a frame was sent: three spare bytes, microseconds modulo 2^24, lowest first; 0 = unknown ---
# A busy computer holds the processes of a virtual joint up by milliseconds, as nothing on a real bus is.  Bus and
# drive make up for it among themselves; the controller's programs send and receive plain frames, as on a real bus:
#
# * The hub reads from the system when a frame was sent (SO_TIMESTAMPNS) and writes it into the spare bytes.  Drive and
#   plant follow the bus a little behind, so that a frame that comes late still finds the plant at its time.
# * An answer cannot be brought back in the same way: between the cycles, or in front of the next answer, it would pass
#   for a younger sample, and a joint at speed would seem to leap.  The drive marks its TPDOs with the stamp of their
#   SYNC, and the hub leaves one out whose SYNC is over, also where it was held up itself while the frame was on the
#   wire.  What a busy computer holds up is a lost sample.


OLDEST_STAMP_NS = 100_000_000  # an older one is not believed
STAMPED_LAG_NS = 3_000_000  # how far drive and plant stay behind while frames are stamped
SYNC_ID = 0x80
FIRST_TPDO, LAST_PDO = 0x181, 0x57F  # predefined connection set (CiA 301)
_FIRST_HEARTBEAT, _LAST_HEARTBEAT = 0x701, 0x77F
_OLDEST_STAMP_US = OLDEST_STAMP_NS // 1000
_STAMP_MASK = 0xFFFFFF
SHORTEST_WINDOW_US = 200  # a SYNC is not over sooner, however fast they come


@record
class SyncWatch:
    """The newest SYNC, as the hub saw it pass."""

    sync_us: i8  # its stamp; 0 = none yet
    sender: i8  # slot of the client that sent it
    open: i8  # 1 until its sender's next PDO: the controller has closed the cycle
    period_us: i8  # between two of them: the shortest one lately


@kernel
def stamp_of(frame: np.ndarray) -> int:
    """The stamp of a frame (uint8[16]); 0 = none."""
    return int(np.int64(frame[5]) | np.int64(frame[6]) << 8 | np.int64(frame[7]) << 16)


@kernel
def stamp_frame(frame: np.ndarray, sent_ns: int) -> None:
    """Write the time of sending into a frame (uint8[16]); never 0."""
    stamp_us = max((sent_ns // 1000) & _STAMP_MASK, 1)
    frame[5] = stamp_us & 0xFF
    frame[6] = (stamp_us >> 8) & 0xFF
    frame[7] = stamp_us >> 16


@kernel
def sent_ns_of(frame: np.ndarray, now_ns: int) -> int:
    """Time of sending of a frame (uint8[16]) on the clock of `now_ns`; `now_ns` where it is not known."""
    stamp_us = stamp_of(frame)
    if stamp_us == 0:
        return now_ns
    age_us = (now_ns // 1000 - stamp_us) & _STAMP_MASK
    return now_ns - 1000 * age_us if age_us < _OLDEST_STAMP_US else now_ns


@kernel
def stamp_answers(queue: FrameQueue, sync: np.ndarray) -> None:
    """The stamp of `sync` (uint8[16]) into the TPDOs of `queue`, which answer it."""
    for i in range(queue.count):
        identifier = np.int64(queue.frames[i][0]) | np.int64(queue.frames[i][1]) << 8
        if FIRST_TPDO <= identifier <= LAST_PDO:
            for byte in range(5, 8):
                queue.frames[i][byte] = sync[byte]


@kernel
def over(watch: SyncWatch, stamp_us: int, now_ns: int) -> bool:
    """Whether the SYNC with this stamp is over: another one came, its cycle was closed, or half a period has gone."""
    if stamp_us != watch.sync_us or watch.open == 0:
        return True
    age_us = (now_ns // 1000 - stamp_us) & _STAMP_MASK
    return bool(age_us > max(watch.period_us // 2, SHORTEST_WINDOW_US))


@kernel
def outlived(watch: SyncWatch, frame: np.ndarray, sender: int, now_ns: int) -> bool:
    """Whether this is an answer that comes out of the wire a whole period after its SYNC: the hub was held up."""
    stamp_us = stamp_of(frame)
    identifier = np.int64(frame[0]) | np.int64(frame[1]) << 8 | np.int64(frame[2]) << 16 | np.int64(frame[3]) << 24
    if stamp_us == 0 or sender == watch.sender or not FIRST_TPDO <= identifier <= LAST_PDO:
        return False
    age_us = (now_ns // 1000 - stamp_us) & _STAMP_MASK
    return bool(age_us > max(watch.period_us, SHORTEST_WINDOW_US))


@kernel
def note_sent(watch: SyncWatch, frame: np.ndarray, sender: int, sent_ns: int) -> None:
    """A frame (uint8[16]) without a stamp has been read, which was sent then: stamp what a cycle consists of."""
    identifier = np.int64(frame[0]) | np.int64(frame[1]) << 8 | np.int64(frame[2]) << 16 | np.int64(frame[3]) << 24
    pdo = FIRST_TPDO <= identifier <= LAST_PDO
    if identifier == SYNC_ID:
        stamp_frame(frame, sent_ns)
        before_us = watch.sync_us
        watch.sync_us, watch.sender, watch.open = stamp_of(frame), sender, 1
        since_us = (watch.sync_us - before_us) & _STAMP_MASK if before_us != 0 else _OLDEST_STAMP_US
        slower_us = watch.period_us + watch.period_us // 8 + 1 if before_us != 0 else _OLDEST_STAMP_US
        watch.period_us = min(since_us, slower_us)
    elif pdo or _FIRST_HEARTBEAT <= identifier <= _LAST_HEARTBEAT:
        stamp_frame(frame, sent_ns)
        if pdo and sender == watch.sender:
            watch.open = 0
