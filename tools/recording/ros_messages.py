"""The ROS 2 messages of a run log: their definitions, and their bodies in CDR (version 1, little-endian).

An aligned little-endian record without padding at its end IS a CDR body: CDR aligns each number to its size counted
from the end of the 4-byte header, as C does, and sends fixed arrays without a length.  Strings and sequences have a
length in front; where it never changes, they are fields of such a record, too.  So writing costs no encoding and
reading is `np.frombuffer`.  Bytes behind the last field are no CDR: strict readers refuse the message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of

SECOND_NS = 1_000_000_000
CDR_HEADER = bytes((0, 1, 0, 0))  # representation: little-endian plain CDR; no options
_ROS_TYPES = {
    "<f8": "float64", "<f4": "float32", "<i8": "int64", "<i4": "int32", "<i2": "int16", "|i1": "int8",
    "<u8": "uint64", "<u4": "uint32", "<u2": "uint16", "|u1": "uint8",
}  # fmt: skip


def message_definition(dtype: np.dtype[Any]) -> str:
    """The ros2msg text of a flat record; field names in lower case, which ROS 2 demands (`torque_Nm` -> `torque_nm`).

    Raises TypeError for a field that the definition cannot name, and for bytes where CDR would not have them.
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
    if end != dtype.itemsize:
        raise TypeError(f"{dtype.itemsize - end} bytes follow the last field: CDR has no padding there")
    return "".join(lines)


@dataclass(frozen=True)
class Topic:
    name: str
    schema: str
    definition: str


_NEXT = "=" * 80 + "\nMSG: "
_TIME = f"{_NEXT}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{_NEXT}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
# std_msgs/msg/Header with an empty `frame_id`; the stamp is calendar time, as everything in messages of ROS
_HEADER_FIELDS = [("sec", "<i4"), ("nanosec", "<u4"), ("frame_id_length", "<u4"), ("frame_id_end", "u1")]

RECORD_TOPIC = Topic("/joint", "jointctl_msgs/msg/LogRecord", message_definition(dtype_of(LogRecord)))

TEMPERATURE = np.dtype([("time_ns", "<i8"), ("temperature_degC", "<f8")])
TEMPERATURE_TOPIC = Topic("/temperature", "jointctl_msgs/msg/Temperature", message_definition(TEMPERATURE))


def stamp(messages: np.ndarray, times_ns: np.ndarray) -> None:
    """Set the stamps of messages with a header, shape (N,), to `times_ns` int64[N]."""
    messages["sec"], messages["nanosec"] = np.divmod(times_ns, SECOND_NS)


def stamps_ns(messages: np.ndarray) -> np.ndarray:
    """int64[N], the inverse of `stamp`."""
    times: np.ndarray = messages["sec"].astype(np.int64) * SECOND_NS + messages["nanosec"]
    return times


# --- The state of the joint, as every tool of ROS draws it ---

JOINT_STATE_TOPIC = Topic(
    "/joint_states",
    "sensor_msgs/msg/JointState",
    f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{_HEADER}",
)
JOINT_NAMES = ("joint",)  # of one that is alone
STATES_NS = SECOND_NS // 100  # between two; a tenth of the records costs 3 % of the file, all 33 %
_SLOTS_KEPT = 100  # that wait for the records of other joints


@cache
def joint_state_type(names: tuple[str, ...]) -> np.dtype[Any]:
    """A message with the states of these joints; the names are in it."""
    texts = [field for i, name in enumerate(names) for field in ((f"length_{i}", "<u4"), (f"name_{i}", _text(name)))]
    values = (("positions", "position_rad"), ("velocities", "velocity_radps"), ("efforts", "effort_Nm"))
    arrays = [field for count, name in values for field in ((count, "<u4"), (name, "<f8", (len(names),)))]
    return np.dtype([*_HEADER_FIELDS, ("names", "<u4"), *texts, *arrays], align=True)


def _text(name: str) -> str:
    return f"S{len(name.encode()) + 1}"


def joint_states(records: np.ndarray, offset_ns: int, names: tuple[str, ...] = JOINT_NAMES) -> np.ndarray:
    """One message a cycle of these joints (array of LogRecord, shape (n, joints)); `offset_ns` to calendar time."""
    messages = np.zeros(len(records), joint_state_type(names))
    messages["frame_id_length"] = 1
    for count in ("names", "positions", "velocities", "efforts"):
        messages[count] = len(names)
    for i, name in enumerate(names):
        messages[f"name_{i}"], messages[f"length_{i}"] = name.encode(), len(name.encode()) + 1
    stamp(messages, records["time_ns"][:, 0] + offset_ns)
    messages["position_rad"], messages["velocity_radps"] = records["position_rad"], records["velocity_radps"]
    messages["effort_Nm"] = records["measured_torque_Nm"]
    return messages


class StateCycles:
    """Of the records of all joints those that become states: of each hundredth of a second the first cycle."""

    def __init__(self, joints: int = 1) -> None:
        self._slots = [-1] * joints  # of the newest record of each
        self._waiting: dict[int, dict[int, np.void]] = {}  # by slot, then by joint

    def take(self, records: np.ndarray, joint: int = 0) -> np.ndarray:
        """Array of LogRecord (n, joints): what is complete with these new records of one joint, in order of time."""
        if not len(records):
            return np.zeros((0, len(self._slots)), dtype_of(LogRecord))
        slots = records["time_ns"] // STATES_NS
        first = np.diff(slots, prepend=self._slots[joint]) != 0
        self._slots[joint] = int(slots[-1])
        if len(self._slots) == 1:
            return np.asarray(records[first])[:, np.newaxis]
        for slot, record in zip(slots[first].tolist(), np.asarray(records[first]), strict=True):
            self._waiting.setdefault(slot, {})[joint] = record
        whole = sorted(slot for slot, found in self._waiting.items() if len(found) == len(self._slots))
        cycles = [[record for _, record in sorted(self._waiting.pop(slot).items())] for slot in whole]
        for slot in sorted(self._waiting)[:-_SLOTS_KEPT]:
            del self._waiting[slot]
        return np.array(cycles, dtype_of(LogRecord)).reshape(-1, len(self._slots))


# --- Events ---

EVENT_TOPIC = Topic(
    "/events",
    "rcl_interfaces/msg/Log",
    "uint8 DEBUG=10\nuint8 INFO=20\nuint8 WARN=30\nuint8 ERROR=40\nuint8 FATAL=50\nbuiltin_interfaces/Time stamp\n"
    f"uint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n{_TIME}",
)


def event_body(time_ns: int, level: int, source: str, text: str) -> bytes:
    """One rcl_interfaces/msg/Log at a calendar time, without a place in a source file."""
    body = struct.pack("<iIB", *divmod(time_ns, SECOND_NS), level)
    for each in (source, text, "", ""):
        data = each.encode("utf-8", "replace").replace(b"\0", b" ") + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    return body + bytes(-len(body) % 4) + struct.pack("<I", 0)


def event_from_body(body: bytes) -> tuple[int, int, str, str]:
    """The inverse of `event_body`."""
    sec, nanosec, level = struct.unpack_from("<iIB", body)
    return sec * SECOND_NS + nanosec, level, *_two_texts(body, 9)


def _two_texts(body: bytes, at: int) -> tuple[str, str]:
    """The strings that begin at `at`: on a multiple of 4 bytes the length with the end zero, then the text."""
    texts = []
    for _ in range(2):
        at += -at % 4
        (size,) = struct.unpack_from("<I", body, at)
        texts.append(body[at + 4 : at + 4 + size - 1].decode("utf-8", "replace"))
        at += 4 + size
    return texts[0], texts[1]


# --- Raw CAN frames ---

CAN_TOPIC = Topic(
    "/can",
    "can_msgs/msg/Frame",
    "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data\n"
    + _HEADER,
)
_CAN_FIELDS = [
    ("id", "<u4"), ("is_rtr", "u1"), ("is_extended", "u1"), ("is_error", "u1"), ("dlc", "u1"), ("data", "u1", (8,)),
]  # fmt: skip
CAN_FRAME = np.dtype([*_HEADER_FIELDS, *_CAN_FIELDS], align=True)


def frame_array(frames: list[tuple[int, Any]]) -> np.ndarray:
    """Records of (time in nanoseconds of CLOCK_MONOTONIC, python-can message), shape (N,) of CAN_FRAME."""
    array = np.zeros(len(frames), CAN_FRAME)
    array["frame_id_length"] = 1
    stamp(array, np.array([time_ns for time_ns, _ in frames], np.int64))
    for row, (_, message) in zip(array, frames, strict=True):
        data = bytes(message.data or b"")[:8]
        row["id"], row["dlc"] = message.arbitration_id, min(message.dlc, 8)
        row["is_rtr"], row["is_extended"] = message.is_remote_frame, message.is_extended_id
        row["is_error"] = message.is_error_frame
        row["data"][: len(data)] = list(data)
    return array


# --- Logs of older versions: times of messages are CLOCK_MONOTONIC, and there are no joint states ---

# without the last field; the message is as long, with padding in the field's place
OLDER_RECORD_DEFINITION = RECORD_TOPIC.definition.removesuffix("int32 notices\n")


def older_event_from_body(body: bytes) -> tuple[int, int, str, str]:
    """Of int64, int32, and two strings."""
    time_ns, level = struct.unpack_from("<qi", body)
    return time_ns, level, *_two_texts(body, 12)
