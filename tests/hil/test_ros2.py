"""A run as a ROS 2 node, by another node on zenoh that knows nothing of ours."""

from __future__ import annotations

import json
import math
import time
from typing import Any

import numpy as np
import pytest
import zenoh

from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.scoping import ros2_server
from tests.browser import free_port
from tests.hil.test_foxglove import WatchedRun, texts
from tests.python_process import eventually
from tests.ros2_client import DIAGNOSTICS, HASHES, JOINT_STATE, TRIGGER, Ros2Client, key

DOMAIN = 7


class Run(WatchedRun):
    """As a node."""

    def __init__(self, bench: Any, *options: str, **changes: Any) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        super().__init__(bench, "--ros2", str(DOMAIN), "--ros2-listen", self.endpoint, *options, **changes)

    def client(self, name: str = "teleop") -> Ros2Client:
        return Ros2Client(self.endpoint, name, DOMAIN)


def test_the_graph_the_states_and_the_diagnostics(bench: Any) -> None:
    run = Run(bench)
    states: list[tuple[Any, tuple[int, int, bytes]]] = []
    reports: list[Any] = []
    with run.client() as client, run.client("other") as other:
        client.collect("/joint_states", JOINT_STATE, lambda state, about: states.append((state, about)))
        other.collect("/diagnostics", DIAGNOSTICS, lambda report, _: reports.append(report))
        run.program.saw("tracking")
        eventually(lambda: len(states) > 100 and reports and reports[-1].status[0].message == "tracking", 20.0)
        parts = [token.split("/") for token in client.tokens()]
        assert client.call("/joint/stop") == (True, "STOP taken; again: quick stop")
    log = run.ended()
    assert "Foxglove" not in texts(log)
    assert "ROS 2's STOP" in texts(log)
    # the graph: one node, its endpoints with key and hash, one session
    assert {tuple(part[:2] + part[3:4] + part[6:9]) for part in parts} == {
        ("@ros2_lv", str(DOMAIN), "0", "%", "%", "joint")
    }
    assert len({part[2] for part in parts}) == 1
    found = {(part[5], *part[9:]) for part in parts}
    dds = {name: key(DOMAIN, "x", name).split("/")[2] for name in (JOINT_STATE, DIAGNOSTICS, TRIGGER)}
    assert found == {
        ("NN",),
        ("MP", "%joint_states", dds[JOINT_STATE], HASHES[JOINT_STATE], "::,10:,:,:,,"),
        ("MP", "%diagnostics", dds[DIAGNOSTICS], HASHES[DIAGNOSTICS], "::,10:,:,:,,"),
        ("SS", "%joint%stop", dds[TRIGGER], HASHES[TRIGGER], "::,10:,:,:,,"),
    }
    # the messages: in order, from one endpoint, a hundred a second, as in the log
    numbers = [about[0] for _, about in states]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len({about[2] for _, about in states}) == 1
    stamps_ns = np.array([s.header.stamp.sec * 1_000_000_000 + s.header.stamp.nanosec for s, _ in states])
    assert np.median(np.diff(stamps_ns)) == 10_000_000
    assert len(states) > 100
    by_position = {float(record.position_rad) for record in log.records}
    assert all(state.name == ["joint"] and state.position[0] in by_position for state, _ in states)
    status = reports[-1].status[0]
    values = {pair.key: pair.value for pair in status.values}
    newest = values.get("newest event")  # a warning of this computer, such as a late wake-up
    assert (status.name, status.level, status.message) == ("joint: joint", 0 if newest is None else 1, "tracking")
    assert newest is None or newest.split(": ", 1)[1] in texts(log)
    assert (values["phase"], values["drive"], values["fault"]) == ("tracking", "operation enabled", "none")


def test_without_allow_remote_nothing_but_stop_is_there(bench: Any) -> None:
    run = Run(bench, "--hold")
    run.program.saw("tracking")
    with run.client() as client:
        kinds = [token.split("/")[5] for token in client.tokens()]
        assert sorted(kinds) == ["MP", "MP", "NN", "SS"]
        for _ in range(20):
            client.command(positions=[0.1])
        assert not list(client.session.get(key(DOMAIN, "/joint/enable", TRIGGER), timeout=1.0))
        assert client.call("/joint/stop")[0]
    log = run.ended()
    assert np.ptp(log.records.desired_position_rad[log.records.phase == AxisPhase.TRACKING]) == 0.0


def enabled(run: Run, client: Ros2Client) -> None:
    """By ~/enable, which is taken once."""
    run.program.saw("waiting up to")
    answers: list[tuple[bool, str]] = []
    eventually(lambda: answers.append(client.call("/joint/enable")) or answers[-1][0])
    assert answers[-1] == (True, "enabling")
    assert client.call("/joint/enable")[0] is False
    run.program.saw("tracking")


def test_enable_and_set_points_garbage_a_second_source_and_silence(bench: Any) -> None:
    run = Run(bench, "--hold", "--allow-remote")
    with run.client() as client, run.client("other") as other, run.client() as twin:
        client.announce()
        twin.announce()  # the same program, started twice
        other.anonymous(bytes(range(16, 32)))
        run.program.saw("waiting up to")
        client.command(positions=[0.0])  # before it is enabled: for nothing
        enabled(run, client)
        other.command(positions=[5.0])
        time.sleep(1.5)  # reported together once a second
        other.command(b"\0\1\0\0garbage")
        other.command(positions=[])
        other.command(positions=[math.nan])
        begun_s = time.monotonic()
        while (now_s := time.monotonic() - begun_s) < 2.0:
            share = min(now_s, 1.0) ** 2
            client.command(positions=[0.05 * share * math.sin(now_s)], time_s=1.0 + now_s)
            time.sleep(0.01)
        twin.command(positions=[0.05 * math.sin(now_s)], time_s=1.0 + now_s)
        other.command(positions=[0.0])
    log = run.ended(7)
    said = texts(log)
    assert "set-points come from ROS 2 node /teleop" in said
    assert "set-point of ROS 2 endpoint 10111213 refused: position_rad (=5) must be in [-0.7..0.7]" in said
    assert "the set-points of this run come from ROS 2 node /teleop, not from ROS 2 endpoint 10111213" in said
    assert "the set-points of this run come from ROS 2 node /teleop, not from ROS 2 node /teleop (" in said
    assert log.records.fault[-1] == Fault.CLIENT_SILENT
    tracking = log.records[log.records.phase == AxisPhase.TRACKING]
    assert np.ptp(tracking.desired_position_rad) > 0.03
    assert abs(tracking.error_rad).max() < 0.02


def test_an_approval_that_is_stopped_enables_nothing(bench: Any) -> None:
    run = Run(bench, "--allow-remote")
    reports: list[Any] = []
    with run.client() as client:
        client.collect("/diagnostics", DIAGNOSTICS, lambda report, _: reports.append(report))
        run.program.saw("waiting up to")
        eventually(lambda: reports, 20.0)  # who is to enable it sees that it waits
        assert [(found.name, found.message) for found in reports[0].status] == [("joint: joint", ros2_server.WAITING)]
        for place in (f"{DOMAIN}/joint/enable/**", key(DOMAIN, "/joint/enable", TRIGGER)):  # it only looks around
            (reply,) = client.session.get(place, timeout=5.0)
            assert reply.ok is not None
            assert ros2_server.NO_CALL.encode() in reply.ok.payload.to_bytes()
        time.sleep(1.0)
        assert client.call("/joint/stop")[0]
    ended = run.program.finished(60.0)
    assert ended.code == 12, ended.err
    assert "nothing moved" in ended.err
    assert bench.disabled()


def test_a_domain_of_its_own(bench: Any) -> None:
    run = Run(bench)
    run.program.saw("tracking")
    with Ros2Client(run.endpoint, "stranger", DOMAIN + 1) as stranger:
        assert stranger.tokens() == []
        with pytest.raises(AssertionError, match="/joint/stop"):
            stranger.call("/joint/stop")
    with run.client() as client:
        assert client.call("/joint/stop")[0]
    run.ended()


def test_a_router_that_starts_later_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    place = f"tcp/127.0.0.1:{free_port()}"
    monkeypatch.setattr(ros2_server, "ROUTER_AT", place)
    with zenoh.open(ros2_server.session_config("tcp/127.0.0.1:0")) as node:
        assert not node.info.routers_zid()
        config = zenoh.Config()
        for path, value in (("mode", "router"), ("listen/endpoints", [place]), ("scouting/multicast/enabled", False)):
            config.insert_json5(path, json.dumps(value))
        with zenoh.open(config):
            eventually(lambda: list(node.info.routers_zid()), 20.0)


def test_an_endpoint_that_cannot_be_ends_the_run_before_it_begins(bench: Any) -> None:
    ended = bench.run("run", bench.config(), "-y", "--ros2", "--ros2-listen", "tcp/no.such.host.invalid:1")
    assert ended.code == 8
    assert "error: ROS 2 cannot be served" in ended.err
    assert "Traceback" not in ended.err
