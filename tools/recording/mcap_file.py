"""An MCAP file that grows chunk by chunk, from the library's records, in memory that does not grow with the file.

MCAP's index stands at the end of the file.  The library's own writer keeps it as objects until then, half a kilobyte a
chunk, and a log that is flushed twice a second has 7200 chunks an hour.  Here the index waits as the bytes that it
will be, in a file without a name.  What is written is what the library would write, byte for byte.
"""

from __future__ import annotations

import errno
import os
import struct
import tempfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

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

CHUNK_BYTES = 256 * 1024
INDEX_IN_MEMORY = 8 * 1024  # bytes, half a minute of a run; a longer index waits in a file
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("sent_ns", "<u8"),
    ]
)
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
        self._schemas[-1].write(self._chunk)
        self._channels[-1].write(self._chunk)
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
            if self._chunk.count > CHUNK_BYTES:
                self._end_chunk()

    def add_message(self, channel: int, time_ns: int, body: bytes) -> None:
        """One message of any size."""
        row = np.zeros(1, message_rows(("body", f"V{len(body)}")))
        row["body"] = np.void(body)
        self.add_messages(channel, np.array([time_ns]), row)

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
