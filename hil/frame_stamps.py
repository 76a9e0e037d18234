"""When a frame on the virtual bus was sent: three spare bytes, microseconds modulo 2^24, lowest byte first; 0 = untold.

Without it the virtual drive would sample and act as late as its process gets the processor, which no drive does.  With
it, drive and plant follow the bus a little behind, so that a frame that comes late still finds the plant at its time.

An answer cannot be brought back in the same way.  A drive answers SYNC within a fraction of a millisecond; one that
comes while the controller already waits for the next would pass for that one's, and a joint at speed would seem to
leap.  So a SYNC is not answered at all once half of its period is over: the controller sees a lost sample.
"""

from __future__ import annotations

import numpy as np

from firmware_py.kernel import kernel
from hil.device_records import int64
from hil.frames import FrameQueue

OLDEST_STAMP_NS = 100_000_000  # an older one is not believed
STAMPED_LAG_NS = 3_000_000  # how far drive and plant stay behind while frames are stamped
FIRST_TPDO, LAST_PDO = 0x181, 0x57F  # predefined connection set (CiA 301)
_OLDEST_STAMP_US = OLDEST_STAMP_NS // 1000


@kernel
def sent_ns_of(frame: np.ndarray, now_ns: int) -> int:
    """Time of sending of a frame (uint8[16]) on the clock of `now_ns`; `now_ns` where it is not told."""
    stamp_us = int64(frame[5]) | int64(frame[6]) << 8 | int64(frame[7]) << 16
    if stamp_us == 0:
        return now_ns
    age_us = (now_ns // 1000 - stamp_us) & 0xFFFFFF
    return now_ns - 1000 * age_us if age_us < _OLDEST_STAMP_US else now_ns


@kernel
def leave_out_late(queue: FrameQueue, age_ns: int, period_ns: int) -> int:
    """Remove the answers to a SYNC sent `age_ns` ago from `queue` if that is too long; how many they were.

    `period_ns`: between this SYNC and the one before.
    """
    if 2 * age_ns <= period_ns:
        return 0
    kept = 0
    for i in range(queue.count):
        identifier = int64(queue.frames[i][0]) | int64(queue.frames[i][1]) << 8
        if not FIRST_TPDO <= identifier <= LAST_PDO:
            queue.frames[kept] = queue.frames[i]
            kept += 1
    removed = queue.count - kept
    queue.count = kept
    return removed
