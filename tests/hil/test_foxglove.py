"""A run and Foxglove, by a client of its protocol that knows nothing of ours."""

from __future__ import annotations

import math
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.firmware_py.states import AxisPhase, Fault
from tests.browser import free_port
from tests.foxglove_client import FoxgloveClient

ENDLESS = {"trajectory__duration_s": 0.0}
# a busy computer must not be the fault that is seen
PATIENT = {"stream__delay_s": 0.3, "stream__timeout_s": 1.0, "stream__client_timeout_s": 3.0}


def decoded(client: FoxgloveClient, topic: str, body: bytes) -> Any:
    """By the definition that the server announced."""
    name, text = client.definition(topic)
    decoder = DecoderFactory().decoder_for("cdr", Schema(1, name=name, encoding="ros2msg", data=text.encode()))
    assert decoder is not None
    return decoder(body)


class WatchedRun:
    """`jointctl run` with others beside it."""

    def __init__(self, bench: Any, *options: str, **changes: Any) -> None:
        self.bench = bench
        config = bench.with_joint(**{**ENDLESS, **PATIENT, **changes})
        self.program = bench.start("run", config, "-y", *options)

    def ended(self, code: int = 130) -> Any:
        """The log, after a run that ended by itself; the drive is off."""
        ended = self.program.finished(60.0)
        assert ended.code == code, ended.err
        assert self.bench.disabled()
        return self.bench.log()


class Run(WatchedRun):
    """With Foxglove."""

    def __init__(self, bench: Any, *options: str, **changes: Any) -> None:
        self.port = free_port()
        super().__init__(bench, "--foxglove", f"127.0.0.1:{self.port}", *options, **changes)

    def client(self) -> FoxgloveClient:
        return FoxgloveClient(self.port)


def texts(log: Any) -> str:
    return "\n".join(event.text for event in log.events)


def test_states_records_and_events_as_they_stand_in_the_log(bench: Any) -> None:
    run = Run(bench)
    with run.client() as client:
        client.subscribe("/joint_states", "/joint", "/events")
        client.until(lambda: sum(name == "/joint" for name, _, _ in client.messages) > 200, 60.0)
        found = list(client.messages)
        assert client.call("/joint/stop") == {"success": True, "message": "STOP taken; again: quick stop"}
        client.until(lambda: any("asked for by" in str(body) for _, _, body in client.messages))
        events = [decoded(client, "/events", body) for name, _, body in client.messages if name == "/events"]
        states = {at: decoded(client, "/joint_states", body) for name, at, body in found if name == "/joint_states"}
        records = {at: decoded(client, "/joint", body) for name, at, body in found if name == "/joint"}
    log = run.ended()
    assert "Foxglove's STOP, Foxglove client" in "".join(event.msg for event in events)
    times_ns = np.array([record.time_ns for record in records.values()])
    assert np.median(np.diff(times_ns)) == 10_000_000
    by_time = {int(record.time_ns): record for record in log.records}
    now_ns = time.time_ns()
    for at, shown in records.items():
        record = by_time[shown.time_ns]
        for name in dtype_of(LogRecord).names or ():
            np.testing.assert_array_equal(getattr(shown, name.lower()), record[name], name)
        state = states[at]
        assert (state.position, state.effort) == ([record.position_rad], [record.measured_torque_Nm])
        assert state.header.stamp.sec * 1_000_000_000 + state.header.stamp.nanosec == at
        assert abs(now_ns - at) < 600e9
    assert log.records.phase[-1] == AxisPhase.FINISHED


def test_stop_twice_is_a_quick_stop(bench: Any) -> None:
    run = Run(bench)
    with run.client() as client:
        client.until(lambda: "/joint/stop" in client.services)
        run.program.saw("tracking")
        assert client.call("/joint/stop")["success"]
        assert client.call("/joint/stop")["message"] == "STOP taken: quick stop"
    log = run.ended()
    assert "quick stop asked for by Foxglove's STOP" in texts(log)


def test_gains_go_through_the_gate(bench: Any) -> None:
    run = Run(bench, "--allow-remote")
    run.program.saw("tracking")
    with run.client() as client:
        client.until(lambda: client.get_parameters(), 10.0)
        before = client.parameters["control.kp"]
        for name, value in (("control.kp", before * 1.1), ("control.kp", before * 100.0), ("control.nothing", 1.0)):
            client.set_parameter(name, value)
            time.sleep(2.0)  # one change at a time
        client.until(lambda: client.parameters["control.kp"] == pytest.approx(before * 1.1))
        client.call("/joint/stop")
    said = texts(run.ended())
    assert f"parameter change: control.kp {before:g} -> {before * 1.1:g} (phase margin" in said
    assert f"refused: control.kp (={before * 100.0:g}) must be in [" in said
    assert "refused: 'nothing' is no gain that can be changed" in said
    assert "by Foxglove client" in said


def test_without_allow_remote_nothing_but_stop_is_taken(bench: Any) -> None:
    run = Run(bench, "--hold")
    run.program.saw("tracking")
    with run.client() as client:
        assert "clientPublish" not in client.info["capabilities"]
        client.until(lambda: client.get_parameters())
        client.set_parameter("control.kp", 1.0)
        client.until(lambda: any("--allow-remote" in text for text in client.statuses))
        client.advertise("/joint/command")
        client.publish({"position_rad": 0.1})
        time.sleep(1.0)
        client.call("/joint/stop")
    log = run.ended()
    assert "parameter change" not in texts(log)
    assert np.ptp(log.records.desired_position_rad[log.records.phase == AxisPhase.TRACKING]) == 0.0


def stream(client: FoxgloveClient, seconds: float, start_rad: float, step_s: float = 0.02, number: int = 1) -> None:
    begun_s, sent = time.monotonic(), 0
    while (now_s := time.monotonic() - begun_s) < seconds:
        share = min(now_s, 1.0) ** 2
        at_rad = start_rad + 0.05 * share * math.sin(now_s)
        client.publish({"position_rad": at_rad, "time_s": 1.0 + now_s}, number)
        sent += 1
        time.sleep(max(0.0, begun_s + sent * step_s - time.monotonic()))


def test_set_points_a_second_source_garbage_and_silence(bench: Any) -> None:
    run = Run(bench, "--hold", "--allow-remote")
    run.program.saw("tracking")
    with run.client() as client, run.client() as second:
        for one in (client, second):
            one.advertise("/joint/command")
        client.publish({"position_rad": 5.0})
        client.until(lambda: any("position_rad (=5) must be in [-0.7..0.7]" in text for text in client.statuses))
        stream(client, 2.0, 0.0)
        second.publish({"position_rad": 0.0})
        second.until(lambda: any("come from Foxglove client" in text for text in second.statuses))
        for garbage in (b"", b"\xff\x00", b"[]", b'{"position_rad": "x"}', b"{" * 5000, b'{"position_rad": NaN}'):
            client.publish(garbage)
        client.until(lambda: any("position_rad (=nan) must be in" in text for text in client.statuses))
        client.socket.send("no JSON")
        client.socket.send(b"\x63garbage")
    log = run.ended(7)
    said = texts(log)
    assert "set-points come from Foxglove client" in said
    assert "refused: position_rad (=5) must be in [-0.7..0.7] (limits.position_*)" in said
    assert log.records.fault[-1] == Fault.CLIENT_SILENT
    tracking = log.records[log.records.phase == AxisPhase.TRACKING]
    assert np.ptp(tracking.desired_position_rad) > 0.03
    assert abs(tracking.error_rad).max() < 0.02


def test_a_flood_and_a_client_that_does_not_read_change_nothing(bench: Any) -> None:
    run = Run(bench, "--hold", "--allow-remote")
    run.program.saw("tracking")
    stalled = run.client().subscribe("/joint", "/joint_states", "/events")
    with run.client() as flood:
        flood.advertise("/joint/command")
        for k in range(20_000):
            flood.publish({"position_rad": 9.0, "time_s": k * 1e-4})
        flood.until(lambda: any("more than 1000 set-points a second" in text for text in flood.statuses))
    with run.client() as client:
        assert client.call("/joint/stop")["success"]
    log = run.ended()
    stalled.close()
    assert log.records.fault[-1] == Fault.NONE
    refusals = [event for event in log.events if "refused" in event.text]
    assert 1 <= len(refusals) < 60
    assert np.ptp(log.records.desired_position_rad[log.records.phase == AxisPhase.TRACKING]) == 0.0


def test_the_virtual_joint_alone_shows_its_states(bench: Any) -> None:
    port = free_port()
    joint = bench.start("hil", bench.config(), "--foxglove", f"127.0.0.1:{port}").saw("Ctrl-C ends it")
    with FoxgloveClient(port) as client:
        client.subscribe("/joint_states")
        state = decoded(client, "/joint_states", client.newest("/joint_states"))
        assert state.position == pytest.approx([0.0], abs=1e-6)
        assert set(client.channels) == {"/joint_states", "/events"}
        assert client.info["name"] == "jointctl joint: plant"
        assert not client.services
    joint.signal(2)
    assert joint.finished(30.0).code == 0


PROGRAM = """
import sys, time
import jointctl

with jointctl.Joint("joint.toml", foxglove="127.0.0.1:{port}", allow_remote=True) as joint:
    joint.enable()
    print("enabled", file=sys.stderr, flush=True)
    joint.wait(60.0)
"""


def test_beside_a_program_set_points_are_the_programs(bench: Any) -> None:
    port = free_port()
    bench.with_joint(**PATIENT)
    program = bench.program(PROGRAM.format(port=port)).saw("enabled")
    with FoxgloveClient(port) as client:
        client.subscribe("/joint_states").newest("/joint_states")
        client.advertise("/joint/command")
        client.publish({"position_rad": 0.01})
        client.until(lambda: any("set-points of this run come from the program" in text for text in client.statuses))
        assert client.call("/joint/stop")["success"]
    ended = program.finished(30.0)
    assert ended.code == 1
    assert "the run has ended, by Foxglove's STOP, Foxglove client" in ended.err
    assert bench.disabled()
    tracking = bench.log().records
    assert np.ptp(tracking.desired_position_rad[tracking.phase == AxisPhase.TRACKING]) == 0.0


def test_a_sweep_shows_its_states_and_stops(bench: Any) -> None:
    port = free_port()
    config = bench.with_joint(base="sweep_virtual")
    sweep = bench.start("sweep", config, "-y", "-o", "data.csv", "--foxglove", f"127.0.0.1:{port}")
    with FoxgloveClient(port) as client:
        client.subscribe("/joint")
        assert client.info["name"] == "jointctl joint: sweep"
        client.until(lambda: client.messages, 60.0)
        sweep.saw("tracking")
        assert client.call("/joint/stop")["success"]
    ended = sweep.finished(60.0)
    assert ended.code == 130, ended.err
    assert "stopped by Foxglove's STOP" in ended.err
    assert ("data.csv" in ended.out) is (bench.folder / "data.csv").exists()
    assert bench.disabled()


def test_a_port_that_is_taken_is_named(bench: Any, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        bench.run("run", bench.config(), "-y", "--foxglove", place).refused(8, f"Foxglove cannot be served at {place}")
