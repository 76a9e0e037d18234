"""When a frame on the virtual bus was sent: three spare bytes, microseconds modulo 2^24, lowest first; 0 = unknown.

A busy computer holds the processes of a virtual joint up by milliseconds, as nothing on a real bus is.  Bus and drive
make up for it among themselves; the controller's programs send and receive plain frames, as on a real bus:

* The hub reads from the system when a frame was sent (SO_TIMESTAMPNS) and writes it into the spare bytes.  Drive and
  plant follow the bus a little behind, so that a frame that comes late still finds the plant at its time.
* An answer cannot be brought back in the same way: between the cycles, or in front of the next answer, it would pass
  for a younger sample, and a joint at speed would seem to leap.  The drive marks its TPDOs with the stamp of their
  SYNC, and the hub leaves one out whose SYNC is over, also where it was held up itself while the frame was on the wire.
  What a busy computer holds up is a lost sample.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import i8, record

if TYPE_CHECKING:
    from jointctl.hil.virtual_bus import FrameQueue

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
