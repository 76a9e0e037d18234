"""Run logs: MCAP files that Foxglove, PlotJuggler and rosbag2 open.

Each cycle is one message on `/joint`: a 4-byte CDR header and the bytes of the `LogRecord`.  An aligned little-endian
record IS the CDR body: CDR aligns each number to its size counted from the end of the header, as C does, and sends
fixed arrays without a length.  (Padding at the end of a record, if any, is ignored by readers.)  So writing costs no
encoding and reading is `np.frombuffer`.

Events are on `/events`, the drive's temperature, if it tells one, on `/temperature`, raw CAN frames, if they are
recorded, on `/can`; what was run (configuration, versions, identity of the drive) is in metadata records at the
beginning of the file.  Times are nanoseconds of CLOCK_MONOTONIC; `metadata["clock"]` relates them to the calendar.
A file that was cut off, because the writer was killed or the disk is full, reads up to the last whole chunk.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.can_log import CAN_DEFINITION, CAN_SCHEMA, CAN_TOPIC, frame_times_ns
from jointctl.tools.recording.cdr import CDR_HEADER, event_body, message_definition
from jointctl.tools.recording.chunk_indexes import ChunkIndexes

RECORD_TOPIC, RECORD_SCHEMA = "/joint", "jointctl_msgs/msg/LogRecord"
EVENT_TOPIC, EVENT_SCHEMA = "/events", "jointctl_msgs/msg/Event"
EVENT_DEFINITION = "int64 time_ns\nint32 level\nstring source\nstring text\n"
TEMPERATURE_TOPIC, TEMPERATURE_SCHEMA = "/temperature", "jointctl_msgs/msg/Temperature"
TEMPERATURE = np.dtype([("time_ns", "<i8"), ("temperature_degC", "<f8")])
INFO, WARNING, ERROR = 20, 30, 40  # levels, those of Python's logging
_CHUNK_BYTES = 256 * 1024
# metadata of a log from which records are left out on purpose: "every" so many one is kept, the last "whole_s" all
THINNING = "thinning"


@dataclass(frozen=True)
class Event:
    time_ns: int  # CLOCK_MONOTONIC
    level: int  # 10 debug, 20 information, 30 warning, 40 error
    source: str
    text: str


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
        # Any: some of the library's methods carry no types
        self._writer: Any = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
        self._indexes = ChunkIndexes(self.path.parent)
        self._indexes.take_the_place_in(self._writer)
        self._writer.start(profile="ros2", library="jointctl")
        for name, values in {"clock": _clock_metadata(), **metadata}.items():
            self._writer.add_metadata(name, {key: str(value) for key, value in values.items()})
        definition = message_definition(dtype_of(LogRecord))
        self._record_channel = self._channel(RECORD_TOPIC, RECORD_SCHEMA, definition)
        self._event_channel = self._channel(EVENT_TOPIC, EVENT_SCHEMA, EVENT_DEFINITION)
        self._can_channel: int | None = None  # only in logs with frames
        self._temperature_channel: int | None = None  # only where the drive tells one
        self._file.flush()

    def _channel(self, topic: str, name: str, definition: str) -> int:
        schema = self._writer.register_schema(name, "ros2msg", definition.encode())
        return self._writer.register_channel(topic, "cdr", schema)

    def write_records(self, records: Any) -> None:
        """Append log records, an array of shape (N,) of LogRecord in order of time."""
        records = np.ascontiguousarray(records)
        if records.dtype != dtype_of(LogRecord):
            raise TypeError(f"records (of {records.dtype}) must be an array of LogRecord")
        size, body = records.dtype.itemsize, records.tobytes()
        for i, time_ns in enumerate(records["time_ns"].tolist()):
            data = CDR_HEADER + body[i * size : (i + 1) * size]
            self._writer.add_message(self._record_channel, time_ns, data, time_ns, self._written & 0xFFFFFFFF)
            self._written += 1
        if self._clock() - self._flushed_at_s >= self._flush_s:
            self.flush()

    def write_frames(self, frames: np.ndarray) -> None:
        """Append raw CAN frames, an array of shape (N,) of CAN_FRAME in order of time."""
        if self._can_channel is None:
            self._can_channel = self._channel(CAN_TOPIC, CAN_SCHEMA, CAN_DEFINITION)
        size, body = frames.dtype.itemsize, frames.tobytes()
        for i, time_ns in enumerate(frame_times_ns(frames).tolist()):
            data = CDR_HEADER + body[i * size : (i + 1) * size]
            self._writer.add_message(self._can_channel, time_ns, data, time_ns)

    def write_event(self, level: int, source: str, text: str, time_ns: int | None = None) -> None:
        """Append an event and flush: it may be the last thing that this process does."""
        time_ns = time.monotonic_ns() if time_ns is None else time_ns
        data = CDR_HEADER + event_body(time_ns, level, source, text)
        self._writer.add_message(self._event_channel, time_ns, data, time_ns)
        self.flush()

    def write_temperature(self, time_ns: int, temperature_degC: float) -> None:
        """Append a reading of the drive's temperature."""
        if self._temperature_channel is None:
            definition = message_definition(TEMPERATURE)
            self._temperature_channel = self._channel(TEMPERATURE_TOPIC, TEMPERATURE_SCHEMA, definition)
        data = CDR_HEADER + np.array((time_ns, temperature_degC), TEMPERATURE).tobytes()
        self._writer.add_message(self._temperature_channel, time_ns, data, time_ns)

    def flush(self) -> None:
        """Close the chunk in progress and hand everything to the operating system."""
        self._writer.flush()
        self._flushed_at_s = self._clock()

    def close(self) -> None:
        """Finish the file (index and summary); may be called twice."""
        if not self._file.closed:
            try:
                self._writer.flush()
                self._indexes.give_back_to(self._writer)
                self._writer.finish()
            finally:
                self._indexes.close()
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None) -> None:
        if value is not None:
            self.write_event(ERROR, "log", f"{type(value).__name__}: {value}")
        self.close()


def _clock_metadata() -> dict[str, str]:
    """One instant in both clocks, so that a log can be placed in the calendar."""
    return {"utc": datetime.now(UTC).isoformat(), "monotonic_ns": str(time.monotonic_ns())}
