"""Run logs as other programs read them (mcap, mcap-ros2-support, rosbags), and logs of older versions as we do."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.recording.ros_messages import (
    CAN_TOPIC,
    CDR_HEADER,
    EVENT_TOPIC,
    JOINT_STATE_TOPIC,
    RECORD_TOPIC,
    TEMPERATURE_TOPIC,
    StateCycles,
    frame_array,
    joint_states,
)
from jointctl.tools.recording.run_log import ERROR, INFO, THINNING, WARNING, Event, RunLogWriter, ThinnedRecords
from jointctl.tools.recording.run_log_reader import RunLog, began_at, candump_bytes, read_run_log
from jointctl.tools.verbs.log import log_info
from tests.run_records import sample_records
from tests.sessions import output

OLDER = Path(__file__).with_name("older_version.mcap")
MS = 1_000_000
EVENTS = [(INFO, "loop", "tracking, 25 °C"), (WARNING, "", "a"), (ERROR, "drive", "FAULT")]


class Written(NamedTuple):
    path: Path
    records: np.recarray
    start_ns: int  # CLOCK_MONOTONIC of the first record
    calendar_ns: int  # the same on the calendar, as far as the test knows


@pytest.fixture(params=[1, 20], ids=["full rate", "decimated, as of a sweep"])
def written(tmp_path: Path, request: pytest.FixtureRequest) -> Written:
    """A log with every kind of message, 200 ms at 1 kHz."""
    start_ns, calendar_ns = time.monotonic_ns(), time.time_ns()
    records = sample_records(200)
    records.time_ns = start_ns + np.arange(200) * MS
    every, path = request.param, tmp_path / "run.mcap"
    thinned = ThinnedRecords(every, 30 if every > 1 else 0)
    metadata = {THINNING: {"every": str(every), "whole_s": "0.03"}} if every > 1 else {}
    frame = can.Message(arbitration_id=0x181, data=range(8), is_extended_id=False)
    kept = []
    with RunLogWriter(path, metadata) as log:
        for at in range(0, 200, 20):
            kept.append(thinned.take(records[at : at + 20]))
            log.write_records(kept[-1])
            if at < 60:
                log.write_event(*EVENTS[at // 20], start_ns + at * MS)
                log.write_temperature(start_ns + at * MS, 20.0 + at)
                frames = frame_array([(start_ns + at * MS, frame)])
                leave_traces(frames.nbytes)
                log.write_frames(frames)
        kept.append(thinned.last())
        log.write_records(kept[-1])
    return Written(path, np.concatenate(kept).view(np.recarray), start_ns, calendar_ns)


def leave_traces(size: int) -> None:
    """Memory of `size` bytes that the next array of this size gets is not zero; numpy keeps what is freed for it."""
    arrays = [np.full(size, 0xA5, np.uint8) for _ in range(20)]
    del arrays


def compare(written: Written, found: dict[str, list[tuple[int, Any]]]) -> None:
    """Every value of every message (log time, decoded message) by topic."""
    records, near_ns = written.records, 5_000 * MS
    offset_ns = found["/joint"][0][0] - written.start_ns
    assert abs(offset_ns - (written.calendar_ns - written.start_ns)) < near_ns  # calendar time, not that since 1970
    assert [at_ns for at_ns, _ in found["/joint"]] == (records.time_ns + offset_ns).tolist()
    for (_, message), record in zip(found["/joint"], records, strict=True):
        for name in records.dtype.names:
            np.testing.assert_array_equal(np.asarray(getattr(message, name.lower())), record[name], err_msg=name)
    states = records[np.diff(records.time_ns // (10 * MS), prepend=0) != 0]
    for (at_ns, message), record in zip(found["/joint_states"], states, strict=True):
        assert at_ns == record.time_ns + offset_ns == stamp_ns(message.header.stamp)
        assert (list(message.name), message.header.frame_id) == (["joint"], "")
        values = [*message.position, *message.velocity, *message.effort]
        assert values == [record.position_rad, record.velocity_radps, record.measured_torque_Nm]
    times_ns = [written.start_ns + k * 20 * MS for k in range(3)]
    for topic in ("/events", "/temperature", "/can"):
        assert [at_ns - offset_ns for at_ns, _ in found[topic]] == times_ns
    assert [(m.level, m.name, m.msg) for _, m in found["/events"]] == EVENTS
    assert [(m.file, m.function, m.line) for _, m in found["/events"]] == [("", "", 0)] * 3
    assert [stamp_ns(m.stamp) - offset_ns for _, m in found["/events"]] == times_ns
    assert [(m.time_ns, m.temperature_degc) for _, m in found["/temperature"]] == [
        (at_ns, 20.0 * (k + 1)) for k, at_ns in enumerate(times_ns)
    ]
    assert [stamp_ns(m.header.stamp) - offset_ns for _, m in found["/can"]] == times_ns
    assert [(m.id, m.is_rtr, m.is_extended, m.is_error, m.dlc, bytes(m.data)) for _, m in found["/can"]] == [
        (0x181, False, False, False, 8, bytes(range(8)))
    ] * 3


def stamp_ns(stamp: Any) -> int:
    return int(stamp.sec * 10**9 + stamp.nanosec)


def test_mcap_finds_every_message_by_its_index_and_without(written: Written) -> None:
    with written.path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        counts = {summary.channels[k].topic: n for k, n in summary.statistics.channel_message_counts.items()}
        indexed = [(channel.topic, m.log_time, m.data) for _, channel, m in reader.iter_messages()]
    with written.path.open("rb") as file:
        streamed = [(channel.topic, m.log_time, m.data) for _, channel, m in NonSeekingReader(file).iter_messages()]
    assert sorted(indexed) == sorted(streamed)
    assert [time_ns for _, time_ns, _ in indexed] == sorted(time_ns for _, time_ns, _ in indexed)
    assert counts["/joint"] == len(written.records)
    assert (counts["/events"], counts["/temperature"], counts["/can"]) == (3, 3, 3)
    assert len(indexed) == sum(counts.values())


def test_mcap_ros2_support_decodes_every_message(written: Written) -> None:
    found: dict[str, list[tuple[int, Any]]] = {}
    with written.path.open("rb") as file:
        for decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(decoded.channel.topic, []).append((decoded.message.log_time, decoded.decoded_message))
    compare(written, found)


def test_rosbags_decodes_every_message_and_would_write_the_same_bytes(written: Written) -> None:
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([written.path]) as reader:
        for connection, at_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((at_ns, message))
            assert bytes(reader.typestore.serialize_cdr(message, connection.msgtype)) == bytes(data), connection.topic
    compare(written, found)


@pytest.mark.parametrize("topic", [JOINT_STATE_TOPIC, EVENT_TOPIC], ids=lambda topic: topic.name)
@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.LATEST])
def test_the_messages_that_ros_plays_are_those_of_ros(topic: Any, release: Stores) -> None:
    ours, ros = get_typestore(Stores.EMPTY), get_typestore(release)
    ours.register(get_types_from_msg(topic.definition, topic.schema))
    assert ours.hash_rihs01(topic.schema) == ros.hash_rihs01(topic.schema)
    constants = [
        [(name, value) for name, _, value in types.fielddefs[topic.schema][0]] for types in (ours, ros)
    ]  # which the hash leaves out; older releases call their type byte
    assert constants[0] == constants[1]


def test_every_topic_has_a_definition_of_its_own() -> None:
    topics = [RECORD_TOPIC, JOINT_STATE_TOPIC, EVENT_TOPIC, TEMPERATURE_TOPIC, CAN_TOPIC]
    assert len({topic.name for topic in topics}) == len({topic.schema for topic in topics}) == len(topics)


@pytest.mark.parametrize("names", [("joint",), ("shoulder", "el", "wrist_1"), ("ä", "b")])
def test_joint_states_are_read_by_ros_whatever_the_names(names: tuple[str, ...]) -> None:
    records = new(LogRecord, 2 * len(names)).reshape(2, -1)
    records["time_ns"] = [[10**9 + 5], [2 * 10**9]]
    for number, field in enumerate(("position_rad", "velocity_radps", "measured_torque_Nm")):
        records[field] = number + np.arange(records.size).reshape(records.shape)
    store = get_typestore(Stores.ROS2_JAZZY)
    for row, message in zip(records, joint_states(np.asarray(records), 7, names), strict=True):
        found: Any = store.deserialize_cdr(CDR_HEADER + message.tobytes(), JOINT_STATE_TOPIC.schema)
        assert tuple(found.name) == names
        assert stamp_ns(found.header.stamp) == row["time_ns"][0] + 7
        for values, field in zip(
            (found.position, found.velocity, found.effort),
            ("position_rad", "velocity_radps", "measured_torque_Nm"),
            strict=True,
        ):
            assert values.tolist() == row[field].tolist()


def test_of_several_joints_a_state_waits_for_the_records_of_all() -> None:
    records = new(LogRecord, 40)
    records.time_ns = 10**9 + np.arange(40) * MS
    cycles = StateCycles(2)
    assert cycles.take(records[:25], 0).shape == (0, 2)
    found = cycles.take(records[:15], 1)
    assert (found["time_ns"] - 10**9).tolist() == [[0, 0], [10 * MS, 10 * MS]]
    assert (cycles.take(records[15:], 1)["time_ns"][:, 1] - 10**9).tolist() == [20 * MS]
    for second in range(1000):  # one whose records never come: what waits does not grow
        records.time_ns += 40 * MS
        assert not len(cycles.take(records, 0)), second
    assert len(cycles._waiting) <= 101


# --- Times ---
def test_a_calendar_clock_that_is_set_does_not_tear_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, records = tmp_path / "run.mcap", sample_records(40)
    records.time_ns = time.monotonic_ns() + np.arange(40) * MS
    with RunLogWriter(path, {}) as log:
        log.write_records(records[:20])
        monkeypatch.setattr(time, "time_ns", lambda: 0)
        log.write_event(INFO, "loop", "after the step", int(records.time_ns[20]))
        log.write_records(records[20:])
    with path.open("rb") as file:
        times_ns = [m.log_time for _, channel, m in make_reader(file).iter_messages(["/joint"])]
    assert set(np.diff(times_ns)) == {MS}
    assert read_run_log(path).events[0].time_ns == records.time_ns[20]


@pytest.mark.parametrize("clock", [{}, {"unix_ns": "9" * 30, "monotonic_ns": "1"}, {"unix_ns": "x"}])
def test_a_log_without_usable_clocks_is_read_in_calendar_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: dict[str, str]
) -> None:
    monkeypatch.setattr("jointctl.tools.recording.run_log._clock_metadata", lambda: clock)
    with RunLogWriter(tmp_path / "run.mcap", {}) as log:
        log.write_event(INFO, "loop", "text", 7)
    read = read_run_log(tmp_path / "run.mcap")
    assert (read.events[0].time_ns, began_at(read)) == (7, "")


# --- A log of the version before calendar times, joint states and `notices`, as that version wrote it ---
@pytest.fixture
def older() -> RunLog:
    return read_run_log(OLDER)


def test_an_older_log_gives_the_same_records_events_and_frames(older: RunLog) -> None:
    records = sample_records(20)
    records.time_ns = 10**15 + np.arange(20) * MS
    records.notices = 0  # that version wrote padding there, of any value
    np.testing.assert_array_equal(older.records, records)
    assert b"\xa5" * 4 in OLDER.read_bytes()
    assert older.complete
    assert older.events == (Event(10**15 + 5 * MS, INFO, "loop", "tracking, 25 °C"),)
    assert older.temperatures.tolist() == [(10**15 + 7 * MS, 36.5)]
    frame = can.Message(arbitration_id=0x181, data=[1, 2, 3], is_extended_id=False)
    np.testing.assert_array_equal(older.frames, frame_array([(10**15 + MS // 4, frame)]))


def test_an_older_log_lies_in_the_calendar_as_before(older: RunLog) -> None:
    assert began_at(older) != ""
    assert candump_bytes(older, OLDER).decode() == "(1795435200.500250) can0 181#010203\n"


def test_the_verbs_read_an_older_log() -> None:
    told, out, _ = output(json=True)
    assert log_info(OLDER, told) == 0
    data = json.loads(out.getvalue())
    assert (data["records"], data["complete"], data["configuration"]) == (20, True, "joint.toml")


def test_an_older_log_becomes_a_data_frame(older: RunLog) -> None:
    pandas = pytest.importorskip("pandas")
    frame = older.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame["weights_14"].tolist() == older.records.weights[:, 14].tolist()
