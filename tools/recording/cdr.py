"""The little of CDR (plain CDR version 1, little-endian) and of ROS 2 message definitions that run logs need."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

CDR_HEADER = bytes((0, 1, 0, 0))  # representation: little-endian plain CDR; no options
_ROS_TYPES = {
    "<f8": "float64", "<f4": "float32", "<i8": "int64", "<i4": "int32", "<i2": "int16", "|i1": "int8",
    "<u8": "uint64", "<u4": "uint32", "<u2": "uint16", "|u1": "uint8",
}  # fmt: skip


def message_definition(dtype: np.dtype[Any]) -> str:
    """The ros2msg text of a flat record; field names in lower case, which ROS 2 demands (`torque_Nm` -> `torque_nm`).

    Raises TypeError for a field that the definition cannot name or whose offset CDR would not give it.
    """
    lines, end = [], 0
    for name in dtype.names or ():
        field = dtype.fields[name]  # type: ignore[index]
        base, shape = field[0].subdtype or (field[0], ())
        if base.str not in _ROS_TYPES or len(shape) > 1:
            raise TypeError(f"{name} (of {field[0]}) has no plain ROS 2 type")
        start = -(-end // base.itemsize) * base.itemsize
        if field[1] != start:
            raise TypeError(f"{name} is at byte {field[1]} and must be at {start}: the record is not aligned as CDR")
        end = start + field[0].itemsize
        lines.append(f"{_ROS_TYPES[base.str]}{f'[{shape[0]}]' if shape else ''} {name.lower()}\n")
    return "".join(lines)


def _text(value: str) -> bytes:
    data = value.encode("utf-8", "replace").replace(b"\0", b" ") + b"\0"
    return struct.pack("<I", len(data)) + data


def event_body(time_ns: int, level: int, source: str, text: str) -> bytes:
    """int64, int32, string, string; a string is a length with its end zero, on a multiple of 4 bytes."""
    body = struct.pack("<qi", time_ns, level) + _text(source)
    return body + bytes(-len(body) % 4) + _text(text)


def event_from_body(body: bytes) -> tuple[int, int, str, str]:
    """The inverse of `event_body`."""
    time_ns, level = struct.unpack_from("<qi", body)
    at, texts = 12, []
    for _ in range(2):
        at += -at % 4
        (size,) = struct.unpack_from("<I", body, at)
        texts.append(body[at + 4 : at + 4 + size - 1].decode("utf-8", "replace"))
        at += 4 + size
    return time_ns, level, texts[0], texts[1]
