"""The virtual side's own statement of `struct can_frame` (16 bytes): identifier, length, three spare bytes, data.

Deliberately not shared with the drivers: a wrong constant on one side must not cancel out on the other.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, i4, record, u1, u4

FRAME_SIZE = 16
QUEUE_LENGTH = 32


@record
class WireFrame:
    identifier: u4
    length: u1
    spare: Annotated[np.ndarray, array_of(u1, 3)]
    payload: Annotated[np.ndarray, array_of(u1, 8)]


@record
class FrameQueue:
    """Frames waiting to be sent, in order; `count` of them are valid."""

    count: i4
    overflowed: i4
    frames: Annotated[np.ndarray, array_of(u1, QUEUE_LENGTH, FRAME_SIZE)]
