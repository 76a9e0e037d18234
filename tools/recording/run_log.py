"""Run logs: MCAP files that Foxglove, PlotJuggler and rosbag2 open.

Each cycle is one message on `/joint`, the bytes of the `LogRecord`.  A hundred times a second there is one on
`/joint_states` as well, which the tools of ROS draw without a package of ours.  Events are on `/events`, the drive's
temperature, if it reports one, on `/temperature`, raw CAN frames, if they are recorded, on `/can`; what was run
(configuration, versions, identity of the drive) is in metadata records at the beginning of the file.

The program's times are nanoseconds of CLOCK_MONOTONIC.  In the file, the times of messages and the stamps in them are
calendar times: the same with an offset that is taken once, when the log is begun, and stands in `metadata["clock"]`.
So a calendar clock that is set in the meantime does not tear the log.
A file that was cut off, because the writer was killed or the disk is full, reads up to the last whole chunk.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import re
import shutil
import struct
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.ros_messages import (
    CAN_FRAME,
    CAN_TOPIC,
    CDR_HEADER,
    EVENT_TOPIC,
    JOINT_NAMES,
    JOINT_STATE_TOPIC,
    RECORD_TOPIC,
    TEMPERATURE,
    TEMPERATURE_TOPIC,
    StateCycles,
    Topic,
    event_body,
    joint_states,
    stamp,
    stamps_ns,
)
from jointctl.tools.written_file import writing

if TYPE_CHECKING:
    from jointctl.drivers.drive import CommissioningReport


# --- An MCAP file that grows chunk by chunk, from the library's records, in memory that does not grow with it ---
# MCAP's index stands at the end of the file.  The library's own writer keeps it as objects until then, half a kilobyte
# a chunk, and a log that is flushed twice a second has 7200 chunks an hour.  Here the index waits as the bytes that it
# will be, in a file without a name.  What is written is what the library would write, byte for byte.


CHUNK_BYTES = 256 * 1024
# records that a run keeps besides, 20 MB; an hour at 1 kHz is 1.2 GB, and the supervisor's memory must not grow with it
IN_MEMORY = 60_000
INDEX_IN_MEMORY = 8 * 1024  # bytes, half a minute of a run; a longer index waits in a file
MESSAGE_HEAD = np.dtype([
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_ns", "<u8"), ("sent_ns", "<u8"),
])  # fmt: skip
BEFORE_BODY = 9  # bytes of opcode and length
_INDEX_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])


def message_rows(*body: tuple[str, Any]) -> np.dtype[Any]:
    """Messages of one size as the rows of an array: their head, then the fields of `body`."""
    return np.dtype([*MESSAGE_HEAD.descr, *body])


class McapFile:
    """Writes to `file`, which is at its beginning; the index waits in `folder`.

    A disk that takes no file for the index costs memory, no error: the log on it is about to raise one.
    """

    def __init__(self, file: IO[bytes], folder: Path, *, profile: str, library: str) -> None:
        self._file = file
        self._folder = folder
        self._index = bytearray()  # chunk index records that are not put away yet
        self._put_away: IO[bytes] | None = None  # a file without a name
        self._put_away_bytes = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata: list[MetadataIndex] = []
        self._messages: dict[int, int] = {}  # channel -> how many
        self._chunks, self._begin_ns, self._end_ns = 0, 0, 0
        self._chunk: Any = RecordBuilder()  # some of the library's methods carry no types
        self._entries: dict[int, list[np.ndarray]] = {}  # of the chunk in progress: channel -> _INDEX_ENTRY
        file.write(MCAP0_MAGIC)
        self._put(Header(profile, library))

    def _put(self, *records: Any) -> int:
        builder: Any = RecordBuilder()
        for record in records:
            record.write(builder)
        return self._file.write(builder.end())

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Name and values, all of them texts, outside the chunks."""
        offset = self._file.tell()
        length = self._put(Metadata(name=name, metadata=dict(values)))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_channel(self, topic: str, schema: str, definition: str) -> int:
        """A channel of CDR messages of a schema of its own; its number."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(id=number, data=definition.encode(), encoding="ros2msg", name=schema))
        self._channels.append(Channel(id=number, topic=topic, message_encoding="cdr", schema_id=number, metadata={}))
        for record in (self._schemas[-1], self._channels[-1]):
            record.write(self._chunk)
            self._end_full_chunk()
        return number

    def add_messages(self, channel: int, times_ns: np.ndarray, rows: np.ndarray) -> None:
        """`rows` (N,) of a dtype of `message_rows`, of which only the body is filled, at `times_ns` int64[N]."""
        size = rows.dtype.itemsize
        rows["opcode"], rows["length"], rows["channel"] = Opcode.MESSAGE, size - BEFORE_BODY, channel
        rows["log_ns"] = rows["sent_ns"] = times_ns
        at = 0
        while at < len(rows):
            fit = (CHUNK_BYTES - self._chunk.count) // size + 1  # the last of them ends the chunk
            part = rows[at : at + fit]
            entries = np.empty(len(part), _INDEX_ENTRY)
            entries["time_ns"] = part["log_ns"]
            entries["offset"] = self._chunk.count + size * np.arange(len(part))
            self._entries.setdefault(channel, []).append(entries)
            self._chunk.write(part.tobytes())
            at += len(part)
            self._end_full_chunk()

    def add_message(self, channel: int, time_ns: int, body: bytes) -> None:
        row = np.zeros(1, message_rows(("body", f"V{len(body)}")))
        row["body"] = np.void(body)
        self.add_messages(channel, np.array([time_ns]), row)

    def _end_full_chunk(self) -> None:
        if self._chunk.count > CHUNK_BYTES:
            self._end_chunk()

    def _end_chunk(self) -> None:
        if not self._entries:
            return
        data, entries = self._chunk.end(), {channel: np.concatenate(p) for channel, p in self._entries.items()}
        self._entries = {}
        begin_ns = min(int(found["time_ns"].min()) for found in entries.values())
        end_ns = max(int(found["time_ns"].max()) for found in entries.values())
        self._begin_ns = min(self._begin_ns, begin_ns) if self._messages else begin_ns
        self._end_ns = max(self._end_ns, end_ns)
        for channel, found in entries.items():
            self._messages[channel] = self._messages.get(channel, 0) + len(found)
        self._chunks += 1
        start = self._file.tell()
        times: Any = {"message_start_time": begin_ns, "message_end_time": end_ns, "uncompressed_size": len(data)}
        length = self._put(Chunk(compression="", data=data, uncompressed_crc=zlib.crc32(data), **times))
        builder: Any = RecordBuilder()
        offsets: dict[int, int] = {}
        for channel, found in entries.items():
            offsets[channel] = start + length + builder.count
            builder.start_record(Opcode.MESSAGE_INDEX)
            builder.write2(channel)
            builder.write4(found.nbytes)
            builder.write(found.tobytes())
            builder.finish_record()
        index_length = self._file.write(builder.end())
        ChunkIndex(
            chunk_start_offset=start, chunk_length=length, compression="", compressed_size=len(data),
            message_index_offsets=offsets, message_index_length=index_length, **times,
        ).write(builder)  # fmt: skip
        self._index += builder.end()
        if len(self._index) >= INDEX_IN_MEMORY:
            with suppress(OSError):
                self._put_index_away()

    def _put_index_away(self) -> None:
        if self._put_away is None:
            self._put_away = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115 closed in close()
        written = os.pwrite(self._put_away.fileno(), self._index, self._put_away_bytes)
        self._put_away_bytes += written
        del self._index[:written]

    def flush(self) -> None:
        """End the chunk in progress and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write index and summary; `OSError` if the index cannot be read back."""
        self._end_chunk()
        self._put(DataEnd(0))
        start = self._file.tell()
        summary: Any = RecordBuilder()
        offsets = []
        statistics = Statistics(
            attachment_count=0, channel_count=len(self._channels), channel_message_counts=self._messages,
            chunk_count=self._chunks, message_count=sum(self._messages.values()), message_end_time=self._end_ns,
            message_start_time=self._begin_ns, metadata_count=len(self._metadata), schema_count=len(self._schemas),
        )  # fmt: skip
        groups: dict[Opcode, list[Any]] = {
            Opcode.SCHEMA: self._schemas, Opcode.CHANNEL: self._channels, Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [], Opcode.ATTACHMENT_INDEX: [], Opcode.METADATA_INDEX: self._metadata,
        }  # fmt: skip
        for opcode, records in groups.items():
            at = summary.count
            if opcode == Opcode.CHUNK_INDEX:
                summary.write(self._chunk_indexes())
            for record in records:
                record.write(summary)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + at, group_length=summary.count - at))
        offsets_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        self._file.write(data)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 8 + 8 + 4, start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(data))
        self._put(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc))
        self._file.write(MCAP0_MAGIC)

    def _chunk_indexes(self) -> bytes:
        if self._put_away is None:
            return bytes(self._index)
        data = os.pread(self._put_away.fileno(), self._put_away_bytes, 0)
        if len(data) != self._put_away_bytes:
            text = f"{len(data)} of {self._put_away_bytes} bytes"
            raise OSError(errno.EIO, f"the index of its chunks cannot be read back ({text})")
        return data + bytes(self._index)

    def close(self) -> None:
        """Let go of both files; the index is of no use any more, so nothing that goes wrong with it matters."""
        if self._put_away is not None:
            with suppress(OSError):
                self._put_away.close()
        self._file.close()


# --- The log of a run ---


INFO, WARNING, ERROR = 20, 30, 40  # levels, those of Python's logging and of rcl_interfaces/msg/Log
# metadata of a log from which records are left out on purpose: "every" so many one is kept, the last "whole_s" all
THINNING = "thinning"
_PACKAGES = ("jointctl", "numpy", "numba", "python-can", "canopen", "mcap")


@dataclass(frozen=True)
class Event:
    time_ns: int  # CLOCK_MONOTONIC
    level: int  # 10 debug, 20 information, 30 warning, 40 error
    source: str
    text: str


@cache
def cdr_rows(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Messages of records of `dtype` as the rows of an array; the records are in the field `record`."""
    return message_rows(("cdr", "S4"), ("record", dtype))


# --- Metadata ---


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


def calendar_offset_ns(clock: Mapping[str, str]) -> int:
    """What to add to CLOCK_MONOTONIC for nanoseconds since 1970, by `metadata["clock"]`; 0 if it does not say.

    Older versions wrote the calendar time as a text only.
    """
    try:
        if "unix_ns" in clock:
            calendar_ns = int(clock["unix_ns"])
        else:
            calendar_ns = int(np.datetime64(clock["utc"].removesuffix("+00:00"), "ns").astype(np.int64))
        offset_ns = calendar_ns - int(clock["monotonic_ns"])
    except (KeyError, ValueError):
        return 0
    return offset_ns if abs(offset_ns) < 1 << 62 else 0  # a damaged text; times have 64 bits


def _clock_metadata() -> dict[str, str]:
    """One instant in both clocks, so that a log can be placed in the calendar."""
    monotonic_ns, unix_ns = time.monotonic_ns(), time.time_ns()
    utc = datetime.fromtimestamp(unix_ns * 1e-9, UTC).isoformat()
    return {"utc": utc, "unix_ns": str(unix_ns), "monotonic_ns": str(monotonic_ns)}


class RunLogWriter(AbstractContextManager["RunLogWriter"]):
    """Writes one log; use it as a context manager, so that an exception still finishes the file.

    What was written is in the hands of the operating system at the latest `flush_s` later (checked at each write, so
    write at least that often) and at once after an event.  `clock` [s] is for tests.  `joints`: the names in its joint
    states, those of an arm in the log of its first joint.  `DataError` where it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Mapping[str, str]],
        joints: tuple[str, ...] = JOINT_NAMES,
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
        _lock(self._file)
        try:
            with writing(self.path):
                self._begin(metadata, joints)
        except DataError:  # nothing is in it
            with suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)
            raise

    def _begin(self, metadata: Mapping[str, Mapping[str, str]], joints: tuple[str, ...]) -> None:
        self._mcap = McapFile(self._file, self.path.parent, profile="ros2", library="jointctl")
        clocks = _clock_metadata()
        self._offset_ns = calendar_offset_ns(clocks)
        for name, values in {"clock": clocks, **metadata}.items():
            self._mcap.add_metadata(name, {key: str(value) for key, value in values.items()})
        self._channels: dict[str, int] = {}
        for topic in (RECORD_TOPIC, JOINT_STATE_TOPIC, EVENT_TOPIC):  # the others only in logs that have them
            self._channel(topic)
        self._joints, self._states = joints, StateCycles(len(joints))
        self._unflushed: list[np.ndarray] = []  # states that are still to be written
        self._file.flush()

    def _channel(self, topic: Topic) -> int:
        if topic.name not in self._channels:
            with writing(self.path):
                self._channels[topic.name] = self._mcap.add_channel(topic.name, topic.schema, topic.definition)
        return self._channels[topic.name]

    def _add(self, topic: Topic, times_ns: np.ndarray, messages: np.ndarray, numbers: np.ndarray | int = 0) -> None:
        """Messages at `times_ns` (CLOCK_MONOTONIC), their bytes as they are."""
        rows = np.zeros(len(messages), cdr_rows(np.dtype(f"V{messages.dtype.itemsize}")))
        rows["sequence"] = numbers
        rows["cdr"] = CDR_HEADER
        rows["record"] = messages.view(np.ndarray).view(rows.dtype["record"])
        channel = self._channel(topic)
        with writing(self.path):
            self._mcap.add_messages(channel, times_ns + self._offset_ns, rows)

    def write_records(self, records: np.ndarray) -> None:
        """Append log records, an array of shape (N,) of LogRecord in order of time."""
        records = np.ascontiguousarray(records)
        if records.dtype != dtype_of(LogRecord):
            raise TypeError(f"records (of {records.dtype}) must be an array of LogRecord")
        numbers = (self._written + np.arange(len(records))) & 0xFFFFFFFF
        self._add(RECORD_TOPIC, records["time_ns"], records, numbers)
        self._written += len(records)
        self.take_states(records)
        if self._clock() - self._flushed_at_s >= self._flush_s:
            self.flush()

    def take_states(self, records: np.ndarray, joint: int = 0) -> None:
        """New records of any joint, for the joint states."""
        if len(found := self._states.take(records, joint)):
            self._unflushed.append(found)

    def write_frames(self, frames: np.ndarray) -> None:
        """Append raw CAN frames, an array of shape (N,) of CAN_FRAME in order of time."""
        messages = np.zeros(len(frames), CAN_FRAME)
        for name in CAN_FRAME.names or ():  # one by one: a copy of whole frames may have anything between the fields
            messages[name] = frames[name]
        times_ns = stamps_ns(frames)
        stamp(messages, times_ns + self._offset_ns)
        self._add(CAN_TOPIC, times_ns, messages)

    def write_event(self, level: int, source: str, text: str, time_ns: int | None = None) -> None:
        """Append an event and flush: it may be the last thing that this process does."""
        time_ns = time.monotonic_ns() if time_ns is None else time_ns
        calendar_ns = time_ns + self._offset_ns
        body = event_body(calendar_ns, level, source, text)
        channel = self._channel(EVENT_TOPIC)
        with writing(self.path):
            self._mcap.add_message(channel, calendar_ns, CDR_HEADER + body)
        self.flush()

    def write_temperature(self, time_ns: int, temperature_degC: float) -> None:
        reading = np.array([(time_ns, temperature_degC)], TEMPERATURE)
        self._add(TEMPERATURE_TOPIC, reading["time_ns"], reading)

    def _write_joint_states(self) -> None:
        if self._unflushed:
            cycles, self._unflushed = np.concatenate(self._unflushed), []
            states = joint_states(cycles, self._offset_ns, self._joints)
            self._add(JOINT_STATE_TOPIC, cycles["time_ns"][:, 0], states)

    def flush(self) -> None:
        self._write_joint_states()
        with writing(self.path):
            self._mcap.flush()
        self._flushed_at_s = self._clock()

    def is_in_place(self) -> bool:
        """Whether the file that is being written is still the one at its path."""
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), os.stat(self.path))
        except OSError:
            return False

    def close(self) -> None:
        """Finish the file (index and summary); may be called twice."""
        if not self._file.closed:
            with writing(self.path):
                try:
                    self.flush()
                    self._mcap.finish()
                finally:
                    self._mcap.close()

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None) -> None:
        with suppress(DataError) if value is not None else nullcontext():  # what has ended the run goes before
            try:
                if value is not None:
                    self.write_event(ERROR, "log", f"{type(value).__name__}: {value}")
            finally:
                self.close()


# --- The folder of the run logs: a name for a new one, room for it, the oldest ones removed (`[log] keep`) ---


MESSAGE_BYTES = dtype_of(LogRecord).itemsize + 65  # of the log file for a record, its share of the joint states in it
CLOCKS_APART_S = 10.0  # of a file server and this computer
UNKNOWN_S = 60.0  # room for a run until it is stopped


def log_path(config: Config) -> Path:
    """A new name in the log folder: configuration and local time."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = Path(config.log.folder)
    path = folder / f"{config.path.stem}-{stamp}.mcap"
    number = 1
    while path.exists():
        number += 1
        path = folder / f"{config.path.stem}-{stamp}-{number}.mcap"
    return path


def require_room(config: Config, path: Path) -> None:
    """`DataError` if the log of a run of this configuration could not be written to `path`; leaves nothing behind."""
    records = (config.trajectory.duration_s or UNKNOWN_S) * config.loop.rate_Hz
    needed = records * (MESSAGE_BYTES + (dtype_of(LogRecord).itemsize if records > IN_MEMORY else 0))
    with writing(path):
        new = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path.parent).free
        path.touch(exist_ok=False)
        path.unlink()
        for folder in new:
            folder.rmdir()
    if free < needed:
        raise DataError(
            f"{path.parent}: {free / 1e6:.0f} MB are free, the log of this run takes about {needed / 1e6:.0f} MB",
            "make room, or name another log.folder",
        )


def remove_oldest(config: Config, path: Path) -> list[Path]:
    """Keep the newest `log.keep` runs of this configuration, `path` counted as one; returns what was removed.

    A run is its log with the pictures and pages beside it, by name; nothing else in the folder is touched.  Of an arm
    the logs of each joint count by themselves.  A run that goes on, as on another bus, keeps its log.  None is removed
    while one is of a time that is still to come: the calendar clock was set back, and what looks oldest may be the
    newest.
    """
    if not config.log.keep or not path.parent.is_dir():
        return []
    of_arm = re.fullmatch(r"(.*)-\d{8}-\d{6}(?:-\d+)?(\..+)", path.stem)
    first, joint = (of_arm[1], of_arm[2]) if of_arm is not None else (config.path.stem, "")
    name = re.compile(
        rf"({re.escape(first)}-\d{{8}}-\d{{6}}(?:-\d+)?{re.escape(joint)})(?:\.tail|\.recording-\d+)?\.(?:mcap|png|html)"
    )
    runs: dict[str, list[Path]] = {}
    for file in path.parent.iterdir():
        if (found := name.fullmatch(file.name)) and found[1] != path.stem:
            runs.setdefault(found[1], []).append(file)
    ended_s = {run: max(file.stat().st_mtime for file in files) for run, files in runs.items()}
    if max(ended_s.values(), default=0.0) > time.time() + CLOCKS_APART_S:
        return []
    oldest_first = sorted(runs, key=ended_s.__getitem__)
    outdated = [runs[run] for run in oldest_first[: max(0, len(runs) + 1 - config.log.keep)]]
    removed = [file for files in outdated if not any(map(_is_being_written, files)) for file in files]
    for file in removed:
        file.unlink()
    return removed


def _lock(file: IO[bytes]) -> bool:
    """Until it is closed; False where someone has it already.  A system, or a file system, may have no such locks."""
    try:
        from fcntl import LOCK_EX, LOCK_NB, flock

        flock(file, LOCK_EX | LOCK_NB)
    except (ImportError, OSError) as error:
        return not isinstance(error, BlockingIOError)
    return True


def _is_being_written(file: Path) -> bool:
    """Whether a `RunLogWriter`, of another program as well, has it open."""
    with suppress(OSError), file.open("rb") as found:
        return not _lock(found)
    return False


class ThinnedRecords:
    """Holds the last `whole` records back; of what is older it gives every `every`-th one."""

    def __init__(self, every: int, whole: int) -> None:
        self._every, self._whole = every, whole
        self._held: Any = np.zeros(0, dtype_of(LogRecord)).view(np.recarray)
        self._seen = 0  # records that are no longer held

    def take(self, records: np.ndarray) -> Any:
        """New `records` (array of LogRecord, shape (N,)) in order of time; returns those to be written now."""
        held = np.concatenate((self._held, records)).view(np.recarray)
        old = held[: max(0, len(held) - self._whole)]
        self._held = held[len(old) :]
        chosen = old[-self._seen % self._every :: self._every]
        self._seen += len(old)
        return chosen

    def last(self) -> Any:
        """Those held back, all of them; nothing is held afterwards."""
        held, self._held = self._held, self._held[:0]
        self._seen += len(held)
        return held
