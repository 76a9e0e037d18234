"""Run logs: every field survives, foreign readers decode them, a killed writer loses only the last instants."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.tools.recording.run_log import ERROR, INFO, RunLogWriter, event_body, event_from_body, message_definition
from jointctl.tools.recording.run_log_reader import read_run_log


def sample_records(count: int, first: int = 0) -> np.recarray:
    """Records whose every field and array element differs."""
    records = new(LogRecord, count)
    for i, name in enumerate(records.dtype.names):
        base = 1000 * (i + 1) + np.arange(first, first + count)
        if name == "weights":
            records[name] = base[:, None] + np.arange(15) / 16.0
        elif records.dtype[name].kind == "f":
            records[name] = -base / 8.0
        else:
            records[name] = base
    return records


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


def test_a_ros_2_decoder_reads_every_field(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    records = sample_records(3)
    with RunLogWriter(path, {}) as log:
        log.write_records(records)
        log.write_event(ERROR, "loop", "stop", 5)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    events = [m for topic, m in decoded if topic == "/events"]
    assert (events[0].time_ns, events[0].level, events[0].source, events[0].text) == (5, ERROR, "loop", "stop")
    rows = [m for topic, m in decoded if topic == "/joint"]
    assert len(rows) == 3
    for row, record in zip(rows, records, strict=True):
        for name in records.dtype.names:
            np.testing.assert_array_equal(np.asarray(getattr(row, name.lower())), record[name], err_msg=name)
        assert len(row.weights) == 15


def test_the_definition_refuses_what_cdr_would_lay_out_differently() -> None:
    assert "float64[15] weights\n" in message_definition(dtype_of(LogRecord))
    packed = np.dtype([("a", "<i4"), ("b", "<f8")])
    with pytest.raises(TypeError, match="b is at byte 4 and must be at 8"):
        message_definition(packed)
    assert message_definition(np.dtype(packed.descr, align=True)) == "int32 a\nfloat64 b\n"
    with pytest.raises(TypeError, match="no plain ROS 2 type"):
        message_definition(np.dtype([("a", ">f8")]))


@pytest.mark.parametrize("source", ["", "a", "ab", "abc", "abcd", "°"])
def test_events_survive_any_alignment(source: str) -> None:
    assert event_from_body(event_body(-1, 10, source, "text")) == (-1, 10, source, "text")


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
    assert process.stdout is not None
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


@pytest.mark.parametrize("content", [b"", b"time_s,position_rad\n", bytes(100)])
def test_other_files_are_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"run\.mcap: is not an MCAP file"):
        read_run_log(path)


def test_missing_files_and_foreign_logs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_run_log(tmp_path / "none.mcap")
    path = tmp_path / "empty.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(DataError, match="holds no run log"):
        read_run_log(path)


def test_records_of_another_type_are_refused(tmp_path: Path) -> None:
    with RunLogWriter(tmp_path / "run.mcap", {}) as log, pytest.raises(TypeError, match="array of LogRecord"):
        log.write_records(np.zeros(3))
