"""Our MCAP file is the library's byte for byte; its index is whole and in order, on a full disk, too."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.recording import mcap_file
from jointctl.tools.recording.mcap_file import CHUNK_BYTES, McapFile, message_rows
from jointctl.tools.recording.run_log import RunLogWriter
from jointctl.tools.recording.run_log_reader import read_run_log

STEPS = st.lists(
    st.one_of(
        st.just("flush"),
        st.just("channel"),
        st.tuples(st.integers(0, 3), st.integers(0, 2**63), st.binary(min_size=1, max_size=40)),
        st.tuples(st.integers(0, 3), st.integers(1, 400), st.sampled_from([1000, CHUNK_BYTES // 7, CHUNK_BYTES])),
    ),
    max_size=12,
)


class BothFiles:
    """The same steps through our file and through the library's writer."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self.paths = folder / "ours.mcap", folder / "library.mcap"
        self.files = [path.open("wb") for path in self.paths]
        self.ours = McapFile(self.files[0], folder, profile="ros2", library="jointctl")
        self.library: Any = Writer(self.files[1], chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self.library.start(profile="ros2", library="jointctl")
        self.channels = 0

    def metadata(self, name: str, values: dict[str, str]) -> None:
        self.ours.add_metadata(name, values)
        self.library.add_metadata(name, values)

    def channel(self) -> None:
        topic, schema, definition = f"/{self.channels}", f"s{self.channels}", "int64 a\n"
        number = self.library.register_channel(
            topic, "cdr", self.library.register_schema(schema, "ros2msg", definition.encode())
        )
        assert self.ours.add_channel(topic, schema, definition) == number
        self.channels += 1

    def message(self, channel: int, time_ns: int, body: bytes) -> None:
        self.ours.add_message(channel, time_ns, body)
        self.library.add_message(channel, time_ns, body, time_ns)

    def messages(self, channel: int, count: int, size: int) -> None:
        rows = np.zeros(count, message_rows(("body", "u1", (size,))))
        rows["body"] = np.arange(count)[:, None]
        rows["sequence"] = np.arange(count)
        times_ns = np.arange(count) * 1000
        self.ours.add_messages(channel, times_ns, rows)
        for i in range(count):
            self.library.add_message(channel, 1000 * i, bytes([i % 256]) * size, 1000 * i, i)

    def flush(self) -> None:
        self.ours.flush()
        self.library.flush()

    def same(self) -> bool:
        self.ours.finish()
        self.ours.close()
        self.library.finish()
        self.files[1].close()
        return self.paths[0].read_bytes() == self.paths[1].read_bytes()

    def summary(self) -> Any:
        with self.paths[0].open("rb") as file:
            return make_reader(file).get_summary()


@given(steps=STEPS)
def test_a_file_is_the_library_s_byte_for_byte(tmp_path_factory: pytest.TempPathFactory, steps: list[Any]) -> None:
    both = BothFiles(tmp_path_factory.mktemp("both"))
    both.metadata("clock", {"monotonic_ns": "0"})
    both.channel()
    for step in steps:
        if step in ("flush", "channel"):
            getattr(both, step)()
        else:
            number, size_or_time, what = step
            channel = 1 + number % both.channels
            if isinstance(what, bytes):
                both.message(channel, size_or_time, what)
            else:
                both.messages(channel, min(size_or_time, 4 * CHUNK_BYTES // what), what)
    assert both.same()


def many_chunks(both: BothFiles, count: int) -> None:
    both.channel()
    for i in range(count):
        both.message(1, i, b"body")
        both.flush()


@pytest.mark.parametrize("count", [0, 1, 95, 700])
def test_the_index_is_whole_and_in_order(tmp_path: Path, count: int) -> None:
    both = BothFiles(tmp_path / "logs")
    many_chunks(both, count)
    assert both.same()
    assert [index.message_start_time for index in both.summary().chunk_indexes] == list(range(count))
    assert sorted((tmp_path / "logs").iterdir()) == sorted(both.paths)


def test_memory_does_not_grow_with_the_number_of_chunks(tmp_path: Path) -> None:
    """The library's writer keeps 0.6 kB a chunk: 4 MB for an hour of a log that is flushed twice a second."""
    with (tmp_path / "log.mcap").open("wb") as file:
        log = McapFile(file, tmp_path, profile="", library="")
        channel = log.add_channel("/t", "s", "")

        def write(chunks: int) -> int:
            for i in range(chunks):
                log.add_message(channel, i, b"body")
                log.flush()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            before = write(200)
            assert abs(write(2000) - before) < 2 * mcap_file.INDEX_IN_MEMORY
        finally:
            tracemalloc.stop()
        log.close()


def test_a_full_disk_loses_none_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "INDEX_IN_MEMORY", 300)
    room = {"left": 700}

    def pwrite(handle: int, data: bytes, at: int) -> int:
        if room["left"] == 0:
            raise OSError(28, "No space left on device")
        taken, room["left"] = bytes(data[: room["left"]]), max(room["left"] - len(data), 0)
        return write(handle, taken, at)

    write = os.pwrite
    monkeypatch.setattr(os, "pwrite", pwrite)
    both = BothFiles(tmp_path)
    many_chunks(both, 30)
    assert room["left"] == 0
    room["left"] = 1_000_000
    many_chunks(both, 1)
    assert room["left"] < 1_000_000
    assert both.same()


def test_a_folder_that_takes_no_file_costs_memory_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "INDEX_IN_MEMORY", 300)
    both = BothFiles(tmp_path)
    monkeypatch.setattr(both.ours, "_folder", tmp_path / "gone")
    many_chunks(both, 30)
    assert both.same()


def test_an_index_that_cannot_be_read_back_is_an_error_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "pread", lambda _handle, count, _at: bytes(count - 1))
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
