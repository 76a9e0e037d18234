"""The index of a log's chunks: whole and in order from a file, and none of it lost on a full disk."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import Writer

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.recording import chunk_indexes, run_log
from jointctl.tools.recording.chunk_indexes import ChunkIndexes
from jointctl.tools.recording.run_log import INFO, RunLogWriter
from jointctl.tools.recording.run_log_reader import read_run_log

FIRST = ChunkIndex(
    chunk_length=170_000,
    chunk_start_offset=9_000,
    compression="",
    compressed_size=169_000,
    message_end_time=5_000_000_000,
    message_index_length=8_031,
    message_index_offsets={1: 180_000, 2: 188_000},
    message_start_time=4_500_000_000,
    uncompressed_size=169_000,
)


def numbered(count: int) -> list[ChunkIndex]:
    return [replace(FIRST, chunk_start_offset=9_000 + 178_000 * i) for i in range(count)]


@pytest.mark.parametrize("count", [0, 3, 4, 5, 40])
def test_they_come_back_in_order_and_few_are_in_memory(tmp_path: Path, count: int) -> None:
    indexes = ChunkIndexes(tmp_path, in_memory=4)
    for index in numbered(count):
        indexes.append(index)
        assert indexes.in_memory() < 4
    assert len(indexes) == count
    assert list(indexes) == numbered(count)
    assert list(indexes) == numbered(count)  # as a list is, it may be read twice
    indexes.close()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_loses_none_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    indexes = ChunkIndexes(tmp_path, in_memory=4)
    room = {"left": 700}

    def pwrite(handle: int, data: bytes, at: int) -> int:
        if room["left"] == 0:
            raise OSError(28, "No space left on device")
        taken, room["left"] = data[: room["left"]], max(room["left"] - len(data), 0)
        return write(handle, taken, at)

    write = os.pwrite
    monkeypatch.setattr(os, "pwrite", pwrite)
    for index in numbered(30):
        indexes.append(index)
    assert 20 < indexes.in_memory() < 30
    assert list(indexes) == numbered(30)
    room["left"] = 1_000_000
    indexes.append(FIRST)
    assert indexes.in_memory() == 0
    assert list(indexes) == [*numbered(30), FIRST]
    indexes.close()


def test_a_folder_that_takes_no_file_costs_memory_only(tmp_path: Path) -> None:
    indexes = ChunkIndexes(tmp_path / "gone", in_memory=4)
    for index in numbered(10):
        indexes.append(index)
    assert list(indexes) == numbered(10)
    indexes.close()


def test_an_index_that_cannot_be_read_back_is_an_error_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "pread", lambda _handle, count, _at: bytes(count))
    log = RunLogWriter(tmp_path / "log.mcap", {}, flush_s=0.0, clock=lambda: 0.0)
    for cycle in range(200):
        records = new(LogRecord, 1)
        records.time_ns = cycle
        log.write_records(records)
    with pytest.raises(OSError, match="index of its chunks cannot be read back"):
        log.close()
    log.close()
    read = read_run_log(tmp_path / "log.mcap")
    assert (len(read.records), read.complete) == (200, False)  # nothing but the index is lost


def a_log(path: Path, chunks: int) -> bytes:
    """Bytes of a log of `chunks` chunks, ten records each, without the clock of its metadata."""
    with RunLogWriter(path, {}, flush_s=0.0, clock=lambda: 0.0) as log:
        log.write_event(INFO, "test", "begin", 1)
        for chunk in range(1, chunks):
            records = new(LogRecord, 10)
            records.time_ns = np.arange(10) * 1_000_000 + chunk * 10_000_000
            log.write_records(records)
    return path.read_bytes()


def test_a_log_is_the_same_with_and_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_log, "_clock_metadata", lambda: {"monotonic_ns": "0"})
    ours = a_log(tmp_path / "ours.mcap", 700)
    monkeypatch.setattr(chunk_indexes, "_LIBRARY_S_LIST", "no_such_list")  # as in another version of the library
    assert ours == a_log(tmp_path / "library.mcap", 700)
    with (tmp_path / "ours.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 700


def test_the_library_keeps_its_index_where_we_put_ours(tmp_path: Path) -> None:
    """Else a long run's memory grows by 4 MB an hour."""
    with (tmp_path / "log.mcap").open("wb") as file:
        indexes = ChunkIndexes(tmp_path)
        writer = Writer(file)
        writer.start()
        assert indexes.take_the_place_in(writer)
        schema = writer.register_schema("s", "ros2msg", b"")
        channel = writer.register_channel("/t", "cdr", schema)
        for i in range(600):
            writer.add_message(channel, i, b"", i)
            writer.flush()
        assert len(indexes) == 600
        assert indexes.in_memory() < chunk_indexes.IN_MEMORY
        indexes.give_back_to(writer)
        writer.finish()
        indexes.close()
    with (tmp_path / "log.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert [index.message_start_time for index in summary.chunk_indexes] == list(range(600))
