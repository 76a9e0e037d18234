"""Run logs: MCAP files that Foxglove, PlotJuggler and rosbag2 open.

Each cycle is one message on `/joint`: a 4-byte CDR header and the bytes of the `LogRecord`.  An aligned little-endian
record IS the CDR body: CDR aligns each number to its size counted from the end of the header, as C does, and sends
fixed arrays without a length.  (Padding at the end of a record, if any, is ignored by readers.)  So writing costs no
encoding and reading is `np.frombuffer`.

Events are on `/events`, the drive's temperature, if it reports one, on `/temperature`, raw CAN frames, if they are
recorded, on `/can`; what was run (configuration, versions, identity of the drive) is in metadata records at the
beginning of the file.  Times are nanoseconds of CLOCK_MONOTONIC; `metadata["clock"]` relates them to the calendar.
A file that was cut off, because the writer was killed or the disk is full, reads up to the last whole chunk.
"""

from __future__ import annotations

import hashlib
import json
import platform
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.mcap_file import McapFile, message_rows

if TYPE_CHECKING:
    from jointctl.drivers.drive import CommissioningReport
    from jointctl.tools.configuration.config import Config

RECORD_TOPIC, RECORD_SCHEMA = "/joint", "jointctl_msgs/msg/LogRecord"
EVENT_TOPIC, EVENT_SCHEMA = "/events", "jointctl_msgs/msg/Event"
EVENT_DEFINITION = "int64 time_ns\nint32 level\nstring source\nstring text\n"
TEMPERATURE_TOPIC, TEMPERATURE_SCHEMA = "/temperature", "jointctl_msgs/msg/Temperature"
TEMPERATURE = np.dtype([("time_ns", "<i8"), ("temperature_degC", "<f8")])
INFO, WARNING, ERROR = 20, 30, 40  # levels, those of Python's logging
# A frame is one `can_msgs/msg/Frame` of ROS, which bag tools know.  Its `frame_id` is always empty, so that the message
# has a fixed size and its CDR body is an aligned record, as the loop's records are.
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
# metadata of a log from which records are left out on purpose: "every" so many one is kept, the last "whole_s" all
THINNING = "thinning"
CDR_HEADER = bytes((0, 1, 0, 0))  # representation: little-endian plain CDR; no options
_ROS_TYPES = {
    "<f8": "float64", "<f4": "float32", "<i8": "int64", "<i4": "int32", "<i2": "int16", "|i1": "int8",
    "<u8": "uint64", "<u4": "uint32", "<u2": "uint16", "|u1": "uint8",
}  # fmt: skip
_PACKAGES = ("jointctl", "numpy", "numba", "python-can", "canopen", "mcap")


@dataclass(frozen=True)
class Event:
    time_ns: int  # CLOCK_MONOTONIC
    level: int  # 10 debug, 20 information, 30 warning, 40 error
    source: str
    text: str


# --- message bodies: the little of CDR (version 1, little-endian) and of ROS 2 message definitions that is needed ---


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


def cdr_rows(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Messages of records of `dtype` as the rows of an array; the records are in the field `record`."""
    return message_rows(("cdr", "S4"), ("record", dtype))


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


# --- metadata ---


def run_metadata(config: Config, report: CommissioningReport) -> dict[str, dict[str, str]]:
    """Metadata records by name; all values are text."""
    return {
        "run": {"configuration": config.text, "path": str(config.path)},
        "drive": {**vars(report.identity), "mode": report.mode, **report.settings},
        "friction": {"sha256": friction_sha256(config)},
        "versions": versions(),
    }


def friction_sha256(config: Config) -> str:
    """Of the values of [friction] in force, whatever the file looks like; "" without one."""
    if config.friction is None:
        return ""
    values = json.dumps(config.friction.model_dump(), sort_keys=True)
    return hashlib.sha256(values.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Python, system, and the packages that decide what was computed and written."""
    found = {"python": platform.python_version(), "system": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def _clock_metadata() -> dict[str, str]:
    """One instant in both clocks, so that a log can be placed in the calendar."""
    return {"utc": datetime.now(UTC).isoformat(), "monotonic_ns": str(time.monotonic_ns())}


class RunLogWriter:
    """Writes one log; use it as a context manager, so that an exception still finishes the file.

    What was written is in the hands of the operating system at the latest `flush_s` later (checked at each write, so
    write at least that often) and at once after an event.  `clock` [s] is for tests.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Mapping[str, str]],
        *,
        flush_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path = Path(path)
        self._clock, self._flush_s, self._flushed_at_s = clock, flush_s, clock()
        self._written = 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = self.path.open("xb")
        except FileExistsError:
            raise DataError(f"{self.path}: exists already, a log is never overwritten") from None
        except OSError as error:
            raise DataError(f"{self.path}: cannot be created: {error.strerror or error}") from None
        self._mcap = McapFile(self._file, self.path.parent, profile="ros2", library="jointctl")
        for name, values in {"clock": _clock_metadata(), **metadata}.items():
            self._mcap.add_metadata(name, {key: str(value) for key, value in values.items()})
        definition = message_definition(dtype_of(LogRecord))
        self._record_channel = self._mcap.add_channel(RECORD_TOPIC, RECORD_SCHEMA, definition)
        self._event_channel = self._mcap.add_channel(EVENT_TOPIC, EVENT_SCHEMA, EVENT_DEFINITION)
        self._can_channel: int | None = None  # only in logs with frames
        self._temperature_channel: int | None = None  # only where the drive reports one
        self._file.flush()

    def _add(self, channel: int, times_ns: np.ndarray, records: np.ndarray, numbers: np.ndarray | int = 0) -> None:
        """Messages of `records`, their bytes as they are."""
        rows = np.zeros(len(records), cdr_rows(np.dtype(f"V{records.dtype.itemsize}")))
        rows["sequence"] = numbers
        rows["cdr"] = CDR_HEADER
        rows["record"] = records.view(np.ndarray).view(rows.dtype["record"])
        self._mcap.add_messages(channel, times_ns, rows)

    def write_records(self, records: np.ndarray) -> None:
        """Append log records, an array of shape (N,) of LogRecord in order of time."""
        records = np.ascontiguousarray(records)
        if records.dtype != dtype_of(LogRecord):
            raise TypeError(f"records (of {records.dtype}) must be an array of LogRecord")
        numbers = (self._written + np.arange(len(records))) & 0xFFFFFFFF
        self._add(self._record_channel, records["time_ns"], records, numbers)
        self._written += len(records)
        if self._clock() - self._flushed_at_s >= self._flush_s:
            self.flush()

    def write_frames(self, frames: np.ndarray) -> None:
        """Append raw CAN frames, an array of shape (N,) of CAN_FRAME in order of time."""
        if self._can_channel is None:
            self._can_channel = self._mcap.add_channel(CAN_TOPIC, CAN_SCHEMA, CAN_DEFINITION)
        self._add(self._can_channel, frame_times_ns(frames), np.ascontiguousarray(frames))

    def write_event(self, level: int, source: str, text: str, time_ns: int | None = None) -> None:
        """Append an event and flush: it may be the last thing that this process does."""
        time_ns = time.monotonic_ns() if time_ns is None else time_ns
        self._mcap.add_message(self._event_channel, time_ns, CDR_HEADER + event_body(time_ns, level, source, text))
        self.flush()

    def write_temperature(self, time_ns: int, temperature_degC: float) -> None:
        """Append a reading of the drive's temperature."""
        if self._temperature_channel is None:
            definition = message_definition(TEMPERATURE)
            self._temperature_channel = self._mcap.add_channel(TEMPERATURE_TOPIC, TEMPERATURE_SCHEMA, definition)
        reading = np.array([(time_ns, temperature_degC)], TEMPERATURE)
        self._add(self._temperature_channel, reading["time_ns"], reading)

    def flush(self) -> None:
        """Close the chunk in progress and hand everything to the operating system."""
        self._mcap.flush()
        self._flushed_at_s = self._clock()

    def close(self) -> None:
        """Finish the file (index and summary); may be called twice."""
        if not self._file.closed:
            try:
                self._mcap.flush()
                self._mcap.finish()
            finally:
                self._mcap.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None) -> None:
        if value is not None:
            self.write_event(ERROR, "log", f"{type(value).__name__}: {value}")
        self.close()
