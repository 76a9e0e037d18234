"""Run logs read back: everything in the file, or up to the last whole chunk of one that was cut off.  See `run_log`."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.input_file import LARGEST_LOG_BYTES, open_input
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.can_log import CAN_FRAME, CAN_TOPIC
from jointctl.tools.recording.cdr import CDR_HEADER, event_from_body, message_definition
from jointctl.tools.recording.run_log import (
    EVENT_TOPIC,
    RECORD_SCHEMA,
    RECORD_TOPIC,
    TEMPERATURE,
    TEMPERATURE_TOPIC,
    Event,
)

_MAGIC = b"\x89MCAP0\r\n"
_BEFORE_BODY = 9  # bytes of opcode and length
_MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("sent_ns", "<u8"),
    ]
)


@dataclass(frozen=True)
class RunLog:
    records: Any  # record array of LogRecord, shape (N,), read-only
    events: tuple[Event, ...]
    metadata: dict[str, dict[str, str]]
    complete: bool  # False: the file was cut off, its tail is lost
    frames: Any = field(default_factory=lambda: np.zeros(0, CAN_FRAME))  # array of CAN_FRAME, shape (N,)
    temperatures: Any = field(default_factory=lambda: np.zeros(0, TEMPERATURE))  # array of TEMPERATURE, shape (N,)


def read_run_log(path: str | Path) -> RunLog:
    """Everything in a run log; `DataError` if it is not one. A cut-off tail is left out (`complete` is False)."""
    path = Path(path)
    try:
        with open_input(path, LARGEST_LOG_BYTES) as file:
            if file.read(len(_MAGIC)) != _MAGIC:
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
    dtype = dtype_of(LogRecord)
    records = np.concatenate(log.record_parts) if log.record_parts else np.zeros(0, dtype)
    records.flags.writeable = False
    frames = np.concatenate(log.frame_parts) if log.frame_parts else np.zeros(0, CAN_FRAME)
    temperatures = np.concatenate([np.zeros(0, TEMPERATURE), *log.temperature_parts])
    return RunLog(records.view(np.recarray), tuple(log.events), log.metadata, complete, frames, temperatures)


class _Collector:
    """Takes chunks apart: runs of log records or frames by one `np.frombuffer`, else message by message."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.record_parts: list[np.ndarray] = []
        self.frame_parts: list[np.ndarray] = []
        self.temperature_parts: list[np.ndarray] = []
        self.events: list[Event] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._topics: dict[int, str] = {}
        self._definition = message_definition(dtype_of(LogRecord)).encode()
        bodies = {
            RECORD_TOPIC: (dtype_of(LogRecord), self.record_parts),
            CAN_TOPIC: (CAN_FRAME, self.frame_parts),
            TEMPERATURE_TOPIC: (TEMPERATURE, self.temperature_parts),
        }
        # topics whose messages all have the same size, so that a run of them is an array
        self._runs = {
            topic: (np.dtype([*_MESSAGE_HEAD.descr, ("cdr", "V4"), ("record", body)]), parts)
            for topic, (body, parts) in bodies.items()
        }

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
                if message is not None and parts is not None and length == message.itemsize - _BEFORE_BODY:
                    at += _take_run(data, at, channel, message, parts)
                    continue
                if topic == EVENT_TOPIC:
                    body = data[at + _MESSAGE_HEAD.itemsize + len(CDR_HEADER) : at + 9 + length]
                    self.events.append(Event(*event_from_body(body)))
            elif opcode == Opcode.CHANNEL:
                self._take_channel(Channel.read(_stream(data, at, length)))
            elif opcode == Opcode.SCHEMA:
                self._take_schema(Schema.read(_stream(data, at, length)))
            at += 9 + length

    def _take_channel(self, channel: Channel) -> None:
        self._topics[channel.id] = channel.topic

    def _take_schema(self, schema: Schema) -> None:
        if schema.name == RECORD_SCHEMA and schema.data != self._definition:
            raise DataError(f"{self.path}: was written by another version of jointctl, with other log fields")


def _take_run(data: bytes, at: int, channel: int, message: np.dtype[Any], parts: list[np.ndarray]) -> int:
    """Append the run of like messages that begins at `at` to `parts`; how many bytes it is long."""
    rows = np.frombuffer(data, message, (len(data) - at) // message.itemsize, at)
    length = message.itemsize - _BEFORE_BODY
    same = (rows["opcode"] == Opcode.MESSAGE) & (rows["length"] == length) & (rows["channel"] == channel)
    count = len(rows) if same.all() else int(np.argmin(same))
    parts.append(rows["record"][:count].astype(message["record"]))
    return count * message.itemsize


def _stream(data: bytes, at: int, length: int) -> ReadDataStream:
    return ReadDataStream(BytesIO(data[at + 9 : at + 9 + length]))
