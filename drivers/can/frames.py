"""One CAN frame in memory: the 16 bytes of Linux' `struct can_frame`, the same on AF_CAN and on the virtual bus."""

from __future__ import annotations

import struct
from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, record, u1, u4

EXTENDED_FLAG = 0x80000000
REMOTE_FLAG = 0x40000000
ERROR_FLAG = 0x20000000
FRAME_BYTES = 16
FRAME_STRUCT = struct.Struct("<IB3x8s")  # identifier with its flags, length, data


@record
class Frame:
    can_id: u4  # 11 bit identifier, flags in the upper bits
    length: u1
    padding: u1
    reserved: u1
    length8: u1
    payload: Annotated[np.ndarray, array_of(u1, 8)]
