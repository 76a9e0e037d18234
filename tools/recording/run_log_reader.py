"""Run logs read back, what they say about themselves, and their records in the formats of other programs."""

from __future__ import annotations

import csv
import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from jointctl.drivers.can.frames import ERROR_FLAG
from jointctl.drivers.errors import DataError
from jointctl.firmware_py.input_file import LARGEST_LOG_BYTES, open_input
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.ros_messages import (
    CAN_FRAME,
    CAN_TOPIC,
    CDR_HEADER,
    EVENT_TOPIC,
    OLDER_RECORD_DEFINITION,
    RECORD_TOPIC,
    SECOND_NS,
    TEMPERATURE,
    TEMPERATURE_TOPIC,
    event_from_body,
    older_event_from_body,
    stamp,
    stamps_ns,
)
from jointctl.tools.recording.run_log import (
    BEFORE_BODY,
    ERROR,
    MESSAGE_HEAD,
    THINNING,
    WARNING,
    Event,
    calendar_offset_ns,
    cdr_rows,
)


@dataclass(frozen=True)
class RunLog:
    records: Any  # record array of LogRecord, shape (N,), read-only
    events: tuple[Event, ...]
    metadata: dict[str, dict[str, str]]
    complete: bool  # False: the file was cut off, its tail is lost
    frames: Any = field(default_factory=lambda: np.zeros(0, CAN_FRAME))  # array of CAN_FRAME, shape (N,)
    temperatures: Any = field(default_factory=lambda: np.zeros(0, TEMPERATURE))  # array of TEMPERATURE, shape (N,)

    def to_pandas(self) -> Any:
        """The records as a DataFrame with one column for each field, `weights_0` and so on for the network's weights.

        `DataError` where pandas is not installed; jointctl itself does not need it.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise DataError("pandas is not installed", "python -m pip install pandas") from None
        return pandas.DataFrame(columns(self.records))


def read_run_log(path: str | Path) -> RunLog:
    """Everything in a run log; `DataError` if it is not one. A cut-off tail is left out (`complete` is False)."""
    path = Path(path)
    try:
        with open_input(path, LARGEST_LOG_BYTES) as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise DataError(f"{path}: is not an MCAP file")
            file.seek(0)
            return _read(file, path)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def _read(file: IO[bytes], path: Path) -> RunLog:
    log = _Collector(path)
    file_bytes = path.stat().st_size
    complete = False
    try:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=file_bytes).records:
            if isinstance(record, Chunk):
                log.take_chunk(record)
            elif isinstance(record, Metadata):
                log.metadata[record.name] = dict(record.metadata)
        complete = True
    except DataError:
        raise
    except Exception:
        # the library meets a cut-off record in many ways (EndOfFile, struct.error, ValueError, ...); what was
        # whole has been taken, and a file without anything whole is reported below
        complete = False
    if not log.metadata and not log.record_parts:
        raise DataError(f"{path}: holds no run log")
    records = np.concatenate([np.zeros(0, dtype_of(LogRecord)), *log.record_parts])
    if log.older:
        records["notices"] = 0  # there was padding
    records.flags.writeable = False
    frames = np.concatenate([np.zeros(0, CAN_FRAME), *log.frame_parts])
    temperatures = np.concatenate([np.zeros(0, TEMPERATURE), *log.temperature_parts])
    events = log.events
    if not log.older:
        offset_ns = calendar_offset_ns(log.metadata.get("clock", {}))
        stamp(frames, stamps_ns(frames) - offset_ns)
        events = [replace(event, time_ns=event.time_ns - offset_ns) for event in events]
    return RunLog(records.view(np.recarray), tuple(events), log.metadata, complete, frames, temperatures)


class _Collector:
    """Takes chunks apart: runs of log records or frames by one `np.frombuffer`, else message by message.

    Of a log of an `older` version, the times of frames and events are CLOCK_MONOTONIC, else calendar times.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.record_parts: list[np.ndarray] = []
        self.frame_parts: list[np.ndarray] = []
        self.temperature_parts: list[np.ndarray] = []
        self.events: list[Event] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.older = False
        self._topics: dict[int, str] = {}
        bodies = {
            RECORD_TOPIC.name: (dtype_of(LogRecord), self.record_parts),
            CAN_TOPIC.name: (CAN_FRAME, self.frame_parts),
            TEMPERATURE_TOPIC.name: (TEMPERATURE, self.temperature_parts),
        }
        # topics whose messages all have the same size, so that a run of them is an array
        self._runs = {topic: (cdr_rows(body), parts) for topic, (body, parts) in bodies.items()}

    def take_chunk(self, chunk: Chunk) -> None:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        at = 0
        while at + 9 <= size:
            opcode, length = struct.unpack_from("<BQ", data, at)
            if opcode == Opcode.MESSAGE:
                (channel,) = struct.unpack_from("<H", data, at + 9)
                topic = self._topics.get(channel, "")
                message, parts = self._runs.get(topic, (None, None))
                if message is not None and parts is not None and length == message.itemsize - BEFORE_BODY:
                    at += _take_run(data, at, channel, message, parts)
                    continue
                if topic == EVENT_TOPIC.name:
                    body = data[at + MESSAGE_HEAD.itemsize + len(CDR_HEADER) : at + 9 + length]
                    self.events.append(Event(*(older_event_from_body if self.older else event_from_body)(body)))
            elif opcode == Opcode.CHANNEL:
                declared = Channel.read(_stream(data, at, length))
                self._topics[declared.id] = declared.topic
            elif opcode == Opcode.SCHEMA:
                self._take_schema(Schema.read(_stream(data, at, length)))
            at += 9 + length

    def _take_schema(self, schema: Schema) -> None:
        if schema.name == RECORD_TOPIC.schema and schema.data == OLDER_RECORD_DEFINITION.encode():
            self.older = True
        elif schema.name == RECORD_TOPIC.schema and schema.data != RECORD_TOPIC.definition.encode():
            raise DataError(f"{self.path}: was written by another version of jointctl, with other log fields")


def _take_run(data: bytes, at: int, channel: int, message: np.dtype[Any], parts: list[np.ndarray]) -> int:
    """Append the run of like messages that begins at `at` to `parts`; how many bytes it is long."""
    rows = np.frombuffer(data, message, (len(data) - at) // message.itemsize, at)
    length = message.itemsize - BEFORE_BODY
    same = (rows["opcode"] == Opcode.MESSAGE) & (rows["length"] == length) & (rows["channel"] == channel)
    count = len(rows) if same.all() else int(np.argmin(same))
    parts.append(rows["record"][:count].astype(message["record"]))
    return count * message.itemsize


def _stream(data: bytes, at: int, length: int) -> ReadDataStream:
    return ReadDataStream(BytesIO(data[at + 9 : at + 9 + length]))


# --- what a log says about itself ---

_LEVELS = ((ERROR, "error"), (WARNING, "warning"), (20, "information"), (0, "debug"))


def missing_records(records: np.ndarray) -> int:
    """Cycles that the loop executed but the log does not hold: the cycle counter jumps by more than was skipped."""
    if len(records) < 2:
        return 0
    jumps = np.diff(np.asarray(records["cycle"], np.int64)) - 1 - np.asarray(records["skipped"][1:], np.int64)
    return int(np.sum(np.maximum(jumps, 0)))


def missing_in(log: RunLog) -> int | None:
    """`missing_records` of a log; None where records were left out on purpose, so that nobody can tell."""
    return None if THINNING in log.metadata else missing_records(log.records)


def kept_share(log: RunLog) -> str:
    """Which records a decimated log holds, in words; "" for one that holds all."""
    thinning = log.metadata.get(THINNING)
    return f"every {thinning['every']}th, the last {thinning['whole_s']} s whole" if thinning else ""


def began_at(log: RunLog) -> str:
    """Local time of the first record; "" if the log does not tell."""
    offset_ns = calendar_offset_ns(log.metadata.get("clock", {}))
    if not offset_ns or not len(log.records):
        return ""
    at = datetime.fromtimestamp((int(log.records["time_ns"][0]) + offset_ns) * 1e-9, UTC)
    return at.astimezone().isoformat(sep=" ", timespec="seconds")


def event_rows(log: RunLog) -> list[tuple[str, str, str, str]]:
    """(seconds since the first record, level, source, text) of every event."""
    start_ns = int(log.records["time_ns"][0]) if len(log.records) else log.events[0].time_ns if log.events else 0
    return [
        (f"{(event.time_ns - start_ns) * 1e-9:.3f}", level_name(event), event.source, event.text)
        for event in sorted(log.events, key=lambda event: event.time_ns)
    ]


def level_name(event: Event) -> str:
    return next(name for level, name in _LEVELS if event.level >= level)


# --- A run log in the formats of other programs: CSV, NPZ, Parquet for the records, candump's for the raw frames ---
#
# Columns have the names and units of `LogRecord`; an array field becomes one column an element (`weights_0` ...).  The
# drive's temperature, if the log has it, is a column as well: in each line the newest reading, nan before the first
# one.

_ROWS = 10_000  # turned into Python numbers at once


def columns(records: np.ndarray) -> dict[str, np.ndarray]:
    """Name -> values, shape (N,), of every field of a record array."""
    found: dict[str, np.ndarray] = {}
    for name in records.dtype.names or ():
        values = np.asarray(records[name])
        if values.ndim == 1:
            found[name] = values
        else:
            found |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return found


def table_columns(log: RunLog) -> dict[str, np.ndarray]:
    """`columns` of the records, and the temperature where there is one."""
    found = columns(log.records)
    if len(log.temperatures):
        newest = np.searchsorted(log.temperatures["time_ns"], found["time_ns"], side="right") - 1
        read = log.temperatures["temperature_degC"][np.maximum(newest, 0)]
        found["temperature_degC"] = np.where(newest >= 0, read, np.nan)
    return found


def csv_bytes(log: RunLog, path: Path) -> bytes:
    """Comma, point, one header line; floats with all their digits."""
    found = table_columns(log)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found)
    for begin in range(0, len(log.records), _ROWS):
        writer.writerows(zip(*(values[begin : begin + _ROWS].tolist() for values in found.values()), strict=True))
    return text.getvalue().encode()


def npz_bytes(log: RunLog, path: Path) -> bytes:
    """One array a field, `weights` of shape (N, 15); events and temperatures as arrays of their own."""
    data = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(log.records[name]) for name in log.records.dtype.names}
    arrays["temperature_time_ns"] = log.temperatures["time_ns"]
    arrays["temperature_degC"] = log.temperatures["temperature_degC"]
    arrays["event_time_ns"] = np.array([event.time_ns for event in log.events], np.int64)
    arrays["event_level"] = np.array([event.level for event in log.events], np.int32)
    arrays["event_text"] = np.array([f"{event.source}: {event.text}" for event in log.events], np.str_)
    np.savez_compressed(data, allow_pickle=False, **arrays)
    return data.getvalue()


def parquet_bytes(log: RunLog, path: Path) -> bytes:
    """A table of all columns, the metadata of the log as the table's."""
    try:
        pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        raise DataError(
            f"{path}: Parquet needs the package pyarrow, which is not installed",
            "install the extra `parquet`, or export to npz or csv",
        ) from None
    table = pyarrow.table({name: pyarrow.array(values) for name, values in table_columns(log).items()})
    metadata = {f"{name}.{key}": value for name, values in log.metadata.items() for key, value in values.items()}
    data = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata(metadata), data)
    return data.getvalue()


def candump_lines(frames: np.ndarray, offset_ns: int, channel: str) -> Iterator[str]:
    """`(1436509053.249713) can0 181#2F0100`, as `candump -L` writes; `offset_ns` from the log's clock to the calendar.

    Eight hexadecimal digits mark an extended identifier; an error frame has the error flag in its identifier.
    """
    for time_ns, row in zip((stamps_ns(frames) + offset_ns).tolist(), frames, strict=True):
        seconds, rest_ns = divmod(time_ns, SECOND_NS)
        identifier = int(row["id"])
        if row["is_error"]:
            name = f"{identifier | ERROR_FLAG:08X}"
        else:
            name = f"{identifier:08X}" if row["is_extended"] else f"{identifier:03X}"
        size = int(row["dlc"])
        data = f"R{size}" if row["is_rtr"] else bytes(row["data"][:size]).hex().upper()
        yield f"({seconds}.{rest_ns // 1000:06d}) {channel} {name}#{data}\n"


def candump_bytes(log: RunLog, path: Path) -> bytes:
    """The raw frames in calendar time, for canplayer, cantools, Wireshark and the like."""
    if not len(log.frames):
        raise DataError(f"{path}: holds no CAN frames", "set log.frames = true in the configuration and run again")
    offset_ns = calendar_offset_ns(log.metadata.get("clock", {}))
    return "".join(candump_lines(log.frames, offset_ns, "can0")).encode()


# format -> (ending of the file, its maker)
FORMATS: dict[str, tuple[str, Callable[[RunLog, Path], bytes]]] = {
    "csv": (".csv", csv_bytes),
    "npz": (".npz", npz_bytes),
    "parquet": (".parquet", parquet_bytes),
    "candump": (".candump.log", candump_bytes),
}
