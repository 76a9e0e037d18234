"""The folder of run logs and `jointctl log`: what is kept, told and exported, and that others read it back."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from jointctl.drivers.errors import ConfigurationError, DataError, MotionFault, UsageError
from jointctl.firmware_py.records import LogRecord
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.ros_messages import frame_array, stamps_ns
from jointctl.tools.recording.run_log import (
    MESSAGE_BYTES,
    THINNING,
    RunLogWriter,
    log_path,
    remove_oldest,
    require_room,
)
from jointctl.tools.recording.run_log_reader import FORMATS, columns, missing_records, parquet_bytes, read_run_log
from jointctl.tools.session.display import EventFinder
from jointctl.tools.session.plan import prepare_log, require_ready
from jointctl.tools.session.run_watch import FrameRecorder, recording
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.verbs.log import log_export, log_info, log_plot
from tests.run_records import START_NS, eventful_records
from tests.sessions import output


# --- Name, room and age of run logs, and what is refused before the user is asked ---
@pytest.fixture
def in_folder(virtual_config: Config, tmp_path: Path) -> Callable[..., Config]:
    """configs/virtual.toml with its logs in the test's folder."""

    def build(**log: Any) -> Config:
        config = virtual_config.changed(log={"folder": str(tmp_path), **log})
        config._path = virtual_config.path
        return config

    return build


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def aged(folder: Path, count: int) -> None:
    for i in range(count):
        for end in (".mcap", ".png", ".tail.mcap"):
            file = folder / f"virtual-2026010{i}-120000{end}"
            file.write_text("a log")
            os.utime(file, (1000.0 + i, 1000.0 + i))


def test_a_name_that_is_taken_is_not_given_again(in_folder: Callable[..., Config]) -> None:
    config = in_folder()
    paths = []
    for _ in range(3):
        paths.append(log_path(config))
        paths[-1].write_text("")
    assert len(set(paths)) == 3


@pytest.mark.parametrize(
    ("files", "words"), [(0, ""), (1, ": 1 file of older runs removed"), (3, ": 3 files of older")]
)
def test_what_is_removed_is_told(in_folder: Callable[..., Config], tmp_path: Path, files: int, words: str) -> None:
    for end in (".mcap", ".png", ".tail.mcap")[:files]:
        (tmp_path / f"virtual-20260101-120000{end}").write_text("a log")
    config, said = in_folder(keep=1), StringIO()
    prepare_log(config, log_path(config), Output(stdout=StringIO(), stderr=said))
    assert words in said.getvalue()
    assert bool(said.getvalue()) == bool(files)


@pytest.mark.parametrize(("keep", "left"), [(1, 0), (2, 1), (4, 3), (5, 4), (6, 4), (0, 4)])
def test_only_the_newest_runs_are_kept_with_the_new_one(
    in_folder: Callable[..., Config], tmp_path: Path, keep: int, left: int
) -> None:
    aged(tmp_path, 4)
    config = in_folder(keep=keep)
    removed = remove_oldest(config, log_path(config))
    assert len(removed) == 3 * (4 - left)
    expected = [
        f"virtual-2026010{i}-120000{end}" for i in range(4 - left, 4) for end in (".mcap", ".png", ".tail.mcap")
    ]
    assert names(tmp_path) == sorted(expected)


@pytest.mark.parametrize(("ahead_s", "left"), [(5.0, 3), (60.0, 15)])
def test_none_is_removed_after_the_clock_was_set_back(
    in_folder: Callable[..., Config], tmp_path: Path, ahead_s: float, left: int
) -> None:
    """The runs since then looked older than those before, and the newest were removed."""
    aged(tmp_path, 5)
    os.utime(tmp_path / "virtual-20260100-120000.mcap", (time.time() + ahead_s, time.time() + ahead_s))
    config = in_folder(keep=2)
    remove_oldest(config, log_path(config))
    assert len(names(tmp_path)) == left


def test_a_run_that_goes_on_keeps_its_log(in_folder: Callable[..., Config], tmp_path: Path) -> None:
    """A second run of the same file, on another bus, removed the log of the first, which then was lost."""
    aged(tmp_path, 2)
    config = in_folder(keep=1)
    first = log_path(config)
    with RunLogWriter(first, {}):
        os.utime(first, (0, 0))  # the oldest of all
        assert len(remove_oldest(config, tmp_path / "virtual-20991231-120000.mcap")) == 6
        assert names(tmp_path) == [first.name]
    assert remove_oldest(config, tmp_path / "virtual-20991231-120000.mcap") == [first]  # its twin: it is over


def test_files_that_are_not_runs_of_this_configuration_stay(in_folder: Callable[..., Config], tmp_path: Path) -> None:
    others = ["virtual-notes.mcap", "other-20260101-120000.mcap", "virtual-20260101-120000.csv",
              "my-virtual-20260101-120000.png"]  # fmt: skip
    for name in others:
        (tmp_path / name).write_text("mine")
    config = in_folder(keep=1)
    assert remove_oldest(config, log_path(config)) == []
    assert names(tmp_path) == sorted(others)


@pytest.mark.parametrize(("factor", "refused"), [(0.99, True), (1.01, False)])
def test_a_disk_without_room_for_the_run_is_told(
    in_folder: Callable[..., Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float, refused: bool
) -> None:
    config = in_folder()
    needed = 10.0 * 1000.0 * MESSAGE_BYTES
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=int(needed * factor)))
    told = "MB are free, the log of this run takes about 4 MB"
    with pytest.raises(DataError, match=told) if refused else nullcontext():
        require_room(config, log_path(config))
    assert names(tmp_path) == []


def test_the_room_for_a_run_is_what_its_log_takes(tmp_path: Path) -> None:
    def size(count: int) -> int:
        path = tmp_path / f"{count}.mcap"
        with RunLogWriter(path, {}) as log:
            log.write_records(eventful_records(count))
        return path.stat().st_size

    assert (size(12_000) - size(2000)) / 10_000 == pytest.approx(MESSAGE_BYTES, rel=5e-3)


def test_a_folder_that_cannot_be_made_is_told(in_folder: Callable[..., Config], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    config = in_folder(folder=str(tmp_path / "file" / "runs"))
    with pytest.raises(DataError, match=r"file/runs/.*cannot be written"):
        require_room(config, log_path(config))


@pytest.mark.parametrize("start_rad", [-0.7001, -0.7, 0.0, 0.7, 0.7001])
def test_a_joint_outside_its_limits_is_told_before_anybody_is_asked(
    in_folder: Callable[..., Config], start_rad: float
) -> None:
    config, report = in_folder(), SimpleNamespace(start_position_rad=start_rad)
    told = r"POSITION_LIMIT \(1\): the joint stands at .0?.7001 rad, .*\[-0.7..0.7\]"
    with pytest.raises(MotionFault, match=told) if abs(start_rad) > 0.7 else nullcontext():
        require_ready(config, report, log_path(config))  # type: ignore[arg-type]


# --- `jointctl log`: what is told, what is exported, and that foreign readers read it back; raw frames ---
def some_frames() -> np.ndarray:
    """A SYNC, an extended frame, a remote frame, an error frame, a full one; 1 ms apart."""
    messages = [
        can.Message(arbitration_id=0x80, is_extended_id=False),
        can.Message(arbitration_id=0x80, is_extended_id=True, data=b"\x01"),
        can.Message(arbitration_id=0x701, is_extended_id=False, is_remote_frame=True, dlc=1),
        can.Message(arbitration_id=0x84, is_error_frame=True, dlc=8, data=bytes(8)),
        can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(range(0xF8, 0x100))),
    ]
    return frame_array([(START_NS + i * 1_000_000, message) for i, message in enumerate(messages)])


@pytest.fixture
def made_log(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    with RunLogWriter(path, {"run": {"configuration": "", "path": "joint.toml"}, "drive": {"serial": "7"}}) as log:
        records = eventful_records()
        log.write_frames(some_frames()[:2])
        log.write_records(records[:300])
        for event in EventFinder(session_drive("canopen")).take(records):
            log.write_event(event.level, event.source, event.text, event.time_ns)
        log.write_frames(some_frames()[2:])
        log.write_records(records[300:])
    return path


def spoken(verb: Any, *arguments: Any, **options: Any) -> Any:
    """What the verb says with --json."""
    told, out, _ = output(json=True)
    assert verb(arguments[0], told, *arguments[1:], **options) == 0
    return json.loads(out.getvalue())


def test_info_tells_what_the_log_holds(made_log: Path) -> None:
    data = spoken(log_info, made_log)
    assert (data["records"], data["missing_records"], data["can_frames"], data["complete"]) == (400, 0, 5, True)
    assert data["configuration"] == "joint.toml"
    assert data["drive"]["serial"] == "7"
    assert data["summary"]["cycles"] == 400
    assert [e["text"] for e in data["event_list"] if e["source"] == "loop"] == [
        "waiting", "enabling", "tracking", "finished",
    ]  # fmt: skip
    told, out, _ = output()
    assert log_info(made_log, told) == 0
    for text in ("missing records", "operation enabled", "joint.toml", "RMSE"):
        assert text in out.getvalue()


def test_a_log_that_is_thinned_on_purpose_misses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "sweep.mcap"
    with RunLogWriter(path, {THINNING: {"every": "20", "whole_s": "2"}}) as log:
        log.write_records(eventful_records()[::20])
    data = spoken(log_info, path)
    assert (data["records_kept"], data["missing_records"]) == ("every 20th, the last 2 s whole", None)
    told, out, _ = output()
    log_info(path, told)
    assert "every 20th" in out.getvalue()
    assert "missing" not in out.getvalue()


def test_info_of_a_log_that_was_cut_off_says_so(made_log: Path) -> None:
    made_log.write_bytes(made_log.read_bytes()[:-400])
    told, _, err = output(json=True)
    assert log_info(made_log, told) == 0
    assert "cut off" in err.getvalue()


def test_missing_records_are_jumps_of_the_cycle_that_were_not_skipped() -> None:
    records = eventful_records()
    assert missing_records(records) == 0
    records.cycle[200:] += 3
    assert missing_records(records) == 3
    records.skipped[200] = 2
    assert missing_records(records) == 1
    records.skipped[200] = 3
    assert missing_records(records) == 0
    assert missing_records(records[:1]) == 0


def test_csv_has_every_digit_of_every_field(made_log: Path) -> None:
    target = Path(spoken(log_export, made_log, "csv")["file"])
    with target.open(newline="") as file:
        rows = list(csv.DictReader(file))
    records = eventful_records()
    assert len(rows) == 400
    for name in ("position_rad", "error_rad", "trajectory_s"):
        np.testing.assert_array_equal([float(row[name]) for row in rows], records[name])
    np.testing.assert_array_equal([int(row["time_ns"]) for row in rows], records.time_ns)
    np.testing.assert_array_equal([float(row["weights_14"]) for row in rows], records.weights[:, 14])


def test_npz_holds_the_records_and_the_events(made_log: Path) -> None:
    target = Path(spoken(log_export, made_log, "npz")["file"])
    with np.load(target) as arrays:
        for name in LogRecord.__annotations__:
            np.testing.assert_array_equal(arrays[name], eventful_records()[name], err_msg=name)
        assert "loop: tracking" in arrays["event_text"].tolist()


def test_candump_is_read_by_python_can(made_log: Path) -> None:
    answer = spoken(log_export, made_log, "candump")
    assert answer["rows"] == 5
    with can.CanutilsLogReader(answer["file"]) as reader:
        read = list(reader)
    assert [m.arbitration_id for m in read if not m.is_error_frame] == [0x80, 0x80, 0x701, 0x181]
    assert " 20000084#0000000000000000\n" in Path(answer["file"]).read_text()  # python-can drops the class of an error
    assert [m.is_extended_id for m in read[:3]] == [False, True, False]
    assert [m.is_remote_frame for m in read] == [False, False, True, False, False]
    assert [m.is_error_frame for m in read] == [False, False, False, True, False]
    assert bytes(read[4].data) == bytes(range(0xF8, 0x100))
    steps_s = np.diff([m.timestamp for m in read])
    np.testing.assert_allclose(steps_s, 1e-3, atol=2e-6)


def test_a_ros_2_decoder_reads_the_frames(made_log: Path) -> None:
    with made_log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [m for _, channel, _, m in reader.iter_decoded_messages() if channel.topic == "/can"]
    assert [(m.id, m.is_extended, m.is_rtr, m.is_error, m.dlc) for m in messages] == [
        (0x80, False, False, False, 0), (0x80, True, False, False, 1), (0x701, False, True, False, 1),
        (0x84, True, False, True, 8), (0x181, False, False, False, 8),
    ]  # fmt: skip
    assert bytes(messages[4].data) == bytes(range(0xF8, 0x100))
    log = read_run_log(made_log)
    np.testing.assert_array_equal(log.frames, some_frames())
    found_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]
    offset_ns = int(log.metadata["clock"]["unix_ns"]) - int(log.metadata["clock"]["monotonic_ns"])
    assert found_ns == [START_NS + i * 1_000_000 + offset_ns for i in range(5)]


def test_parquet_holds_every_column_and_the_metadata(made_log: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = read_run_log(made_log)
    target = made_log.with_suffix(".parquet")
    target.write_bytes(parquet_bytes(log, made_log))
    table = parquet.read_table(target)
    found = columns(log.records)
    assert table.column_names == list(found)
    for name, values in found.items():
        np.testing.assert_array_equal(table[name].to_numpy(), values)
    expected = {f"{name}.{key}": value for name, values in log.metadata.items() for key, value in values.items()}
    assert {key.decode(): value.decode() for key, value in table.schema.metadata.items()} == expected


def test_parquet_without_pyarrow_says_what_to_install(made_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(DataError, match="needs the package pyarrow") as caught:
        log_export(made_log, Output(stdout=io.StringIO()), "parquet")
    assert "npz" in caught.value.hint
    assert not made_log.with_suffix(".parquet").exists()


@pytest.mark.parametrize("format", ["", "xlsx", "CSV"])
def test_a_format_that_is_none_is_refused(made_log: Path, format: str) -> None:
    with pytest.raises(UsageError, match=r"--format .* must be one of csv, npz, parquet, candump"):
        log_export(made_log, Output(), format)


@pytest.mark.parametrize("format", ["csv", "npz", "candump"])
def test_the_log_itself_is_never_overwritten(made_log: Path, format: str) -> None:
    before = made_log.read_bytes()
    with pytest.raises(DataError, match="is an input of this command"):
        log_export(made_log, Output(), format, made_log.parent / "." / "run.mcap")
    with pytest.raises(DataError, match="no folder"):
        log_export(made_log, Output(), format, made_log.parent / "none" / "x")
    with pytest.raises(DataError, match="is an input of this command"):
        log_plot(made_log, Output(), made_log)
    for name in {"other.mcap", "x.png", "x.csv", "x.npz"} - {f"x.{format}"}:
        with pytest.raises(UsageError, match=f"is the name of another kind of file, must end in .{format}"):
            log_export(made_log, Output(), format, made_log.parent / name)
    with pytest.raises(UsageError, match=r"must end in \.png"):
        log_plot(made_log, Output(), made_log.parent / "x.csv")
    assert made_log.read_bytes() == before
    assert format in FORMATS


def test_candump_of_a_log_without_frames_tells_how_to_get_them(tmp_path: Path) -> None:
    with RunLogWriter(tmp_path / "run.mcap", {}) as log:
        log.write_records(eventful_records())
    with pytest.raises(DataError, match="no CAN frames") as caught:
        log_export(tmp_path / "run.mcap", Output(), "candump")
    assert "log.frames" in caught.value.hint


def test_plot_writes_a_png(made_log: Path) -> None:
    assert Path(spoken(log_plot, made_log)["picture"]).read_bytes().startswith(b"\x89PNG")


def test_a_hundred_thousand_records_with_frames_between_them_all_come_back(tmp_path: Path) -> None:
    path, size = tmp_path / "long.mcap", 20
    with RunLogWriter(path, {}) as log:
        for first in range(0, 100_000, 5000):
            piece = eventful_records(5000, first + 1)
            for at in range(0, 5000, size):
                log.write_records(piece[at : at + size])
                log.write_frames(some_frames()[:1] if at % 1000 else some_frames())
    read = read_run_log(path)
    assert read.complete
    assert missing_records(read.records) == 0
    np.testing.assert_array_equal(read.records.cycle, np.arange(100_000) + 2)
    assert len(read.frames) == 5000 * 1 + 100 * 4


@pytest.mark.parametrize(("queue", "kept"), [(10, 10), (9, 9), (1000, 10)])
def test_a_recorder_that_nobody_fetches_from_drops_and_counts(queue: int, kept: int) -> None:
    with can.Bus(interface="virtual", channel=f"recorder {queue}") as sender:
        recorder = FrameRecorder(can.Bus(interface="virtual", channel=f"recorder {queue}"), queue)
        try:
            for number in range(10):
                sender.send(can.Message(arbitration_id=number, is_extended_id=False))
            recorder.end()  # what has arrived is received
            found = recorder.new_frames()
        finally:
            recorder.close()
    assert [message.arbitration_id for _, message in found] == list(range(kept))
    assert recorder.dropped == 10 - kept
    times = stamps_ns(frame_array(found))
    assert np.all(np.diff(times) >= 0)
    assert recorder.new_frames() == []


def test_frames_of_a_serial_line_are_refused(virtual_config: Any) -> None:
    serial = virtual_config.changed(bus__interface="serial", log__frames=True)
    with pytest.raises(ConfigurationError, match=r"log.frames \(=true\)"), recording(serial):
        pass
    with recording(virtual_config) as recorder:
        assert recorder is None
