"""Raw CAN frames in a run log and in candump's text format.

A frame is one `can_msgs/msg/Frame` of ROS, which bag tools know.  Its `frame_id` is always empty, so that the message
has a fixed size and its CDR body is an aligned record, as the loop's records are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jointctl.drivers.can.frames import ERROR_FLAG

CAN_TOPIC, CAN_SCHEMA = "/can", "can_msgs/msg/Frame"
CAN_DEFINITION = (
    "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data\n"
    "================================================================================\n"
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    "================================================================================\n"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
SECOND_NS = 1_000_000_000
CAN_FRAME = np.dtype(
    [
        ("sec", "<i4"),  # CLOCK_MONOTONIC, as everything in the log
        ("nanosec", "<u4"),
        ("frame_id_length", "<u4"),  # of the empty string: its end zero
        ("frame_id_end", "u1"),
        ("id", "<u4"),
        ("is_rtr", "u1"),
        ("is_extended", "u1"),
        ("is_error", "u1"),
        ("dlc", "u1"),
        ("data", "u1", (8,)),
    ],
    align=True,
)


def frame_array(frames: list[tuple[int, Any]]) -> np.ndarray:
    """Records of (time in nanoseconds of CLOCK_MONOTONIC, python-can message), shape (N,) of CAN_FRAME."""
    array = np.zeros(len(frames), CAN_FRAME)
    array["frame_id_length"] = 1
    for i, (time_ns, message) in enumerate(frames):
        data = bytes(message.data or b"")[:8]
        row = array[i]
        row["sec"], row["nanosec"] = divmod(time_ns, SECOND_NS)
        row["id"], row["dlc"] = message.arbitration_id, min(message.dlc, 8)
        row["is_rtr"], row["is_extended"] = message.is_remote_frame, message.is_extended_id
        row["is_error"] = message.is_error_frame
        row["data"][: len(data)] = list(data)
    return array


def frame_times_ns(frames: np.ndarray) -> np.ndarray:
    """int64[N], nanoseconds of CLOCK_MONOTONIC."""
    times: np.ndarray = frames["sec"].astype(np.int64) * SECOND_NS + frames["nanosec"]
    return times


def candump_lines(frames: np.ndarray, offset_ns: int, channel: str) -> Iterator[str]:
    """`(1436509053.249713) can0 181#2F0100`, as `candump -L` writes; `offset_ns` from the log's clock to the calendar.

    Eight hexadecimal digits mark an extended identifier; an error frame has the error flag in its identifier.
    """
    for time_ns, row in zip((frame_times_ns(frames) + offset_ns).tolist(), frames, strict=True):
        seconds, rest_ns = divmod(time_ns, SECOND_NS)
        identifier = int(row["id"])
        if row["is_error"]:
            name = f"{identifier | ERROR_FLAG:08X}"
        else:
            name = f"{identifier:08X}" if row["is_extended"] else f"{identifier:03X}"
        size = int(row["dlc"])
        data = f"R{size}" if row["is_rtr"] else bytes(row["data"][:size]).hex().upper()
        yield f"({seconds}.{rest_ns // 1000:06d}) {channel} {name}#{data}\n"
