"""Run logs: records kept whole, MCAP as the library writes it, read by others, and what a killed writer loses."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.recording import run_log as mcap_file
from jointctl.tools.recording.ros_messages import RECORD_TOPIC, event_body, event_from_body, message_definition
from jointctl.tools.recording.run_log import CHUNK_BYTES, INFO, McapFile, RunLogWriter, ThinnedRecords, message_rows
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.recording.run_summary import KeptRecords
from tests.python_process import largest_file
from tests.run_records import sample_records


# --- Records of a run stay whole and in order, in memory or in a file ---
def numbered(first: int, count: int) -> Any:
    records = new(LogRecord, count)
    records.cycle = np.arange(first, first + count)
    records.error_rad = records.cycle * 1e-3
    return records


def is_in_file(records: np.ndarray) -> bool:
    return isinstance(records.base, np.memmap)


@pytest.mark.parametrize(("last", "in_file"), [(60, False), (61, True), (500, True)])
def test_all_records_come_back_in_order(tmp_path, last, in_file):
    with KeptRecords(tmp_path, in_memory=100) as kept:
        kept.append(numbered(0, 40))
        kept.append(numbered(40, last))
        assert is_in_file(kept.records()) is in_file
        kept.append(numbered(40 + last, 0))
        records = kept.records()
        assert is_in_file(records) is in_file
        assert len(records) == len(kept)
        assert np.array_equal(records.cycle, np.arange(len(kept)))
    assert records.error_rad[-1] == records.cycle[-1] * 1e-3  # still readable
    assert list(tmp_path.iterdir()) == []  # the file never had a name, or has lost it


def test_what_was_kept_may_be_asked_for_before_the_end(tmp_path):
    with KeptRecords(tmp_path, in_memory=10) as kept:
        kept.append(numbered(0, 20))
        assert len(kept.records()) == 20
        kept.append(numbered(20, 5))
        assert list(kept.records().cycle[-2:]) == [23, 24]


def test_a_run_without_records_has_none(tmp_path):
    with KeptRecords(tmp_path) as kept:
        assert len(kept) == len(kept.records()) == 0


def test_every_second_record_of_a_chunk_is_kept_as_it_is(tmp_path):
    with KeptRecords(tmp_path, in_memory=3) as kept:
        kept.append(numbered(0, 20)[::2])
        assert list(kept.records().cycle) == list(range(0, 20, 2))


# --- A thinned stream of records: every n-th one of the old, all of the last ---
@pytest.mark.parametrize("portions", [(100,), (1,) * 100, (7, 0, 33, 60), (99, 1)])
def test_however_they_come_the_old_ones_are_thinned_and_the_last_ones_whole(portions: tuple[int, ...]) -> None:
    records, thinned = numbered(0, 100), ThinnedRecords(20, 30)
    ends = list(itertools.accumulate(portions))
    written = [thinned.take(records[end - count : end]).cycle for count, end in zip(portions, ends, strict=True)]
    assert list(np.concatenate(written)) == [0, 20, 40, 60]
    assert list(thinned.last().cycle) == list(range(70, 100))
    assert len(thinned.last()) == 0


def test_a_short_run_is_kept_whole() -> None:
    thinned = ThinnedRecords(20, 30)
    assert len(thinned.take(numbered(0, 30))) == 0
    assert len(thinned.last()) == 30


# --- Our MCAP file is the library's byte for byte; its index is whole and in order, on a full disk, too ---
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


@example(steps=[
    (0, 0, b"\0"), "flush", "channel", "channel", "channel", (0, 0, b"\0"), (0, 254, 1000), "channel",
])  # whose schema ends the chunk  # fmt: skip
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
    with pytest.raises(DataError, match=r"log\.mcap: .* index of its chunks cannot be read back"):
        log.close()
    log.close()
    read = read_run_log(tmp_path / "log.mcap")
    assert (len(read.records), read.complete) == (200, False)  # nothing but the index is lost


# --- Run logs: every field survives, a killed writer loses only the last instants ---
def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "run.mcap"
    records = sample_records(2500)
    with RunLogWriter(path, {"configuration": {"text": "[bus]\n"}, "versions": {"numpy": "2"}}) as log:
        log.write_records(records[:1000])
        log.write_event(INFO, "drive", "Operation Enabled, 25 °C", 77)
        log.write_records(records[1000:1000])
        log.write_records(records[1000:])
    read = read_run_log(path)
    assert read.complete
    np.testing.assert_array_equal(read.records, records)
    assert read.records.error_rad[3] == records.error_rad[3]
    assert [(e.time_ns, e.level, e.source, e.text) for e in read.events] == [
        (77, INFO, "drive", "Operation Enabled, 25 °C")
    ]
    assert read.metadata["configuration"] == {"text": "[bus]\n"}
    assert read.metadata["versions"] == {"numpy": "2"}
    assert int(read.metadata["clock"]["monotonic_ns"]) > 0


def test_the_definition_refuses_what_cdr_would_lay_out_differently() -> None:
    assert "float64[15] weights\n" in RECORD_TOPIC.definition
    packed = np.dtype([("a", "<i4"), ("b", "<f8")])
    with pytest.raises(TypeError, match="b is at byte 4 and must be at 8"):
        message_definition(packed)
    assert message_definition(np.dtype(packed.descr, align=True)) == "int32 a\nfloat64 b\n"
    with pytest.raises(TypeError, match="no plain ROS 2 type"):
        message_definition(np.dtype([("a", ">f8")]))
    with pytest.raises(TypeError, match="4 bytes follow the last field"):
        message_definition(np.dtype([("a", "<f8"), ("b", "<i4")], align=True))


@pytest.mark.parametrize("source", ["", "a", "ab", "abc", "abcd", "°"])
def test_events_survive_any_alignment(source: str) -> None:
    assert event_from_body(event_body(10**18 + 7, 10, source, "text")) == (10**18 + 7, 10, source, "text")


def test_a_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(DataError, match="exists already"):
        RunLogWriter(path, {})
    assert path.read_text() == "precious"


def test_records_reach_the_file_when_the_flush_time_is_over(tmp_path: Path) -> None:
    now = [0.0]
    log = RunLogWriter(tmp_path / "run.mcap", {}, flush_s=0.5, clock=lambda: now[0])
    now[0] = 0.49
    log.write_records(sample_records(5))
    assert len(read_run_log(log.path).records) == 0
    now[0] = 0.5
    log.write_records(sample_records(5, 5))
    read = read_run_log(log.path)
    assert not read.complete
    np.testing.assert_array_equal(read.records, sample_records(10))
    log.close()
    log.close()
    assert read_run_log(log.path).complete


def test_a_killed_writer_leaves_what_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = (
        "import sys, time\n"
        "from jointctl.firmware_py.records import LogRecord\n"
        "from jointctl.firmware_py.schema import new\n"
        "from jointctl.tools.recording.run_log import RunLogWriter\n"
        "log = RunLogWriter(sys.argv[1], {'versions': {'a': '1'}}, flush_s=0.0)\n"
        "records = new(LogRecord, 1000)\n"
        "records['cycle'] = range(1000)\n"
        "log.write_records(records)\n"
        "print('written', flush=True)\n"
        "time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "written\n"
    process.kill()
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    read = read_run_log(path)
    assert not read.complete
    assert read.metadata["versions"] == {"a": "1"}
    np.testing.assert_array_equal(read.records["cycle"], np.arange(1000))


def test_a_file_cut_anywhere_gives_a_prefix(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    records = sample_records(300)
    with RunLogWriter(path, {"a": {"b": "c"}}, flush_s=0.0) as log:
        for i in range(0, 300, 100):
            log.write_records(records[i : i + 100])
    whole = path.read_bytes()
    seen = set()
    for size in range(600, len(whole), 997):
        path.write_bytes(whole[:size])
        read = read_run_log(path)
        assert not read.complete
        np.testing.assert_array_equal(read.records, records[: len(read.records)])
        seen.add(len(read.records))
    assert seen == {0, 100, 200, 300}


def test_a_damaged_chunk_is_not_taken(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RunLogWriter(path, {}) as log:
        log.write_records(sample_records(100))
    data = bytearray(path.read_bytes())
    data[20_000] ^= 1
    path.write_bytes(data)
    assert len(read_run_log(path).records) == 0


def test_an_exception_is_logged_and_the_file_finished(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def run_that_fails() -> None:
        with RunLogWriter(path, {}) as log:
            log.write_records(sample_records(2))
            raise RuntimeError("bus off")

    with pytest.raises(RuntimeError, match="bus off"):
        run_that_fails()
    read = read_run_log(path)
    assert read.complete
    assert len(read.records) == 2
    assert read.events[-1].text == "RuntimeError: bus off"


def test_a_log_without_room_is_named_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with largest_file(16), pytest.raises(DataError, match=r"run\.mcap: cannot be written: File too large"):
        RunLogWriter(tmp_path / "run.mcap", {"a": {"b": "c" * 10_000}})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", ["write_records", "flush", "write_event", "close"])
def test_each_way_of_writing_names_the_log(tmp_path: Path, write: str) -> None:
    log = RunLogWriter(tmp_path / "run.mcap", {})
    log.write_records(sample_records(5000 if write == "write_records" else 100)[:-1])
    values = {"write_records": (sample_records(5000),), "write_event": (30, "test", "full")}.get(write, ())
    with largest_file(4096), pytest.raises(DataError, match=r"run\.mcap: cannot be written: File too large"):
        getattr(log, write)(*values)
    with suppress(DataError):
        log.close()


def test_what_has_ended_a_run_goes_before_a_log_without_room(tmp_path: Path) -> None:
    def run_that_fails() -> None:
        with largest_file(4096), RunLogWriter(tmp_path / "a.mcap", {}) as log:
            log.write_records(sample_records(100))
            raise RuntimeError("bus off")

    with pytest.raises(RuntimeError, match="bus off"):
        run_that_fails()


def test_a_log_in_whose_place_is_another_file_is_not_there(tmp_path: Path) -> None:
    folder, path = tmp_path / "runs", tmp_path / "runs" / "run.mcap"
    with RunLogWriter(path, {}) as log:
        assert log.is_in_place()
        folder.rename(tmp_path / "moved")
        assert not log.is_in_place()
        (tmp_path / "other").mkdir()
        folder.symlink_to("other")
        path.write_text("no log")
        assert not log.is_in_place()


def test_kept_records_need_no_folder_any_more(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    with KeptRecords(folder, in_memory=3) as kept:
        folder.rmdir()
        kept.append(sample_records(10))
        assert len(kept.records()) == 10


def test_kept_records_without_room_name_their_folder(tmp_path: Path) -> None:
    with largest_file(16), KeptRecords(tmp_path, in_memory=3) as kept, pytest.raises(DataError, match="File too large"):
        kept.append(sample_records(5000))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"), (b"\x89MCAP0\r\n", "holds no run log"),
        *((content, "is not an MCAP file") for content in (b"", b"time_s,position_rad\n", bytes(100))),
    ],
)  # fmt: skip
def test_other_files_are_refused_in_one_line(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=rf"run\.mcap: {words}"):
        read_run_log(path)


def test_records_of_another_type_are_refused(tmp_path: Path) -> None:
    with RunLogWriter(tmp_path / "run.mcap", {}) as log, pytest.raises(TypeError, match="array of LogRecord"):
        log.write_records(np.zeros(3))
