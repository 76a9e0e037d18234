"""When a frame on the virtual bus was sent: three spare bytes, microseconds modulo 2^24, lowest byte first; 0 = untold.

Without it the virtual drive would sample and act as late as its process gets the processor, which no drive does.  With
it, drive and plant follow the bus a little behind, so that a frame that comes late still finds the plant at its time.

An answer cannot be brought back in the same way: one that comes while the controller already waits for the next would
pass for that one's, and a joint at speed would seem to leap.  So it bears the stamp of its SYNC, and the controller
leaves an answer to another SYNC out: what a busy computer holds up is a lost sample.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.bus.virtual_bus import FrameQueue
from jointctl.hil.canopen.records import int64

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
def stamp_answers(queue: FrameQueue, sync: np.ndarray) -> None:
    """The stamp of `sync` (uint8[16]) into the TPDOs of `queue`, which answer it."""
    for i in range(queue.count):
        identifier = int64(queue.frames[i][0]) | int64(queue.frames[i][1]) << 8
        if FIRST_TPDO <= identifier <= LAST_PDO:
            for byte in range(5, 8):
                queue.frames[i][byte] = sync[byte]
