"""What Foxglove and ROS 2 may do with a run, at the supervisor's end: consent, set-points, options, floods."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers.errors import JointctlError, UsageError
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.safety import set_point_problem
from jointctl.firmware_py.states import AxisPhase, StopRequest, TrajectoryKind
from jointctl.program import observers
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.records import free_constants
from jointctl.tools.recording.run_log import INFO, WARNING
from jointctl.tools.scoping import feed, remote
from jointctl.tools.scoping.feed import LATE_S, ScopeFeed, now_s
from jointctl.tools.scoping.foxglove_server import FoxgloveView, set_point_of
from jointctl.tools.scoping.remote import EnabledFromElsewhere, joint_name
from jointctl.tools.scoping.remote_options import RemoteOptions, check_remote, foxglove_place, with_values
from jointctl.tools.scoping.supervisor_link import ASKS_BURST, BURST, NICE, SetPointLink, WayBack, stand_aside
from jointctl.tools.session.display import ViewerRequest
from jointctl.tools.session.loop_memory import SharedBlock
from jointctl.tools.session.loops import loop_of
from jointctl.tools.session.plan import Placed
from jointctl.tools.session.set_points import RemoteSetPoint, SetPointSources
from tests.sessions import output

CONFIG = load_config(shipped_config("virtual"))


# --- options ---


@pytest.mark.parametrize(
    ("words", "full"),
    [
        (["run", "x", "--foxglove"], ["run", "x", "--foxglove", "127.0.0.1:8765"]),
        (["run", "--foxglove", "x.toml", "-y"], ["run", "--foxglove", "127.0.0.1:8765", "x.toml", "-y"]),
        (["run", "--foxglove", "localhost:9"], ["run", "--foxglove", "localhost:9"]),
        (["run", "--foxglove", "[::1]:9", "--ros2"], ["run", "--foxglove", "[::1]:9", "--ros2", "3"]),
        (["run", "--ros2", "x", "--hold"], ["run", "--ros2", "3", "x", "--hold"]),
        (["run", "--ros2", "12"], ["run", "--ros2", "12"]),
        (["run", "--ros2=12"], ["run", "--ros2=12"]),
        ([], []),
    ],
)
def test_values_that_are_left_out(words: list[str], full: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    assert with_values(words) == full


def test_the_domain_of_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    assert observers(True, True, allow_remote=False) == RemoteOptions("127.0.0.1:8765", 3)
    assert observers("[::1]:9", 0, allow_remote=True) == RemoteOptions("[::1]:9", 0, allow_remote=True)
    assert observers(False, False, allow_remote=False) == RemoteOptions()
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    with pytest.raises(UsageError, match=r"ROS_DOMAIN_ID \(=x\) must be in \[0..232\]"):
        observers(False, True, allow_remote=False)


@pytest.mark.parametrize("text", ["127.0.0.1:1", "localhost:8765", "[::1]:65535", ":8765"])
def test_foxglove_is_served_to_this_computer(text: str) -> None:
    assert foxglove_place(text)[1] == int(text.rpartition(":")[2])


@pytest.mark.parametrize(
    "text", ["0.0.0.0:1", "192.168.1.2:8765", "[::]:1", "robot:8765", "127.0.0.1", "localhost:0", "x:y"]
)
def test_and_to_no_other(text: str) -> None:
    with pytest.raises(UsageError, match=r"--foxglove \(="):
        check_remote(RemoteOptions(foxglove=text))


@pytest.mark.parametrize(
    ("stem", "name"), [("my joint", "my_joint"), ("3rd-axis", "joint_3rd_axis"), ("__a__b", "a_b"), ("ü", "joint")]
)
def test_the_name_of_a_node(stem: str, name: str) -> None:
    assert joint_name(Path(f"{stem}.toml")) == name


# --- consent: the terminal, then one enable ---


class Terminal:
    """`Consent` that says yes."""

    dry_run, brake = False, None

    def show(self, lines: Any) -> None:
        pass

    def agreed(self, lines: Any) -> bool:
        return True


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """The supervisor's and the server's."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


def consent_of(ends: Any, answer: Callable[[Any], ViewerRequest | None], monkeypatch: pytest.MonkeyPatch) -> Any:
    """At the terminal they say yes; then the server answers what it has been told, for a short while."""
    told: dict[str, Any] = {}

    def sleep(_: float) -> None:
        with contextlib.suppress(BlockingIOError):
            while message := ends[1].recv(4096, socket.MSG_DONTWAIT):
                told.update(json.loads(message[1:]))
        if (request := answer(told)) is not None:
            ends[1].send(request.encoded())

    monkeypatch.setattr(remote, "APPROVED_S", 0.2)
    monkeypatch.setattr(remote.time, "sleep", sleep)
    out, _, _ = output(quiet=True)
    return EnabledFromElsewhere(Terminal(), ScopeFeed(ends[0], server="ROS 2", takes=frozenset({"enable"})), out)


def enable(told: Any) -> ViewerRequest:
    return ViewerRequest("enable", "a node", {name: told.get(name) for name in ("number", "told_s")})


STOP = ViewerRequest("stop", "a node", {"strength": 1})


def test_an_enable_after_the_approval_counts_for_this_one(ends: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    consent = consent_of(ends, enable, monkeypatch)
    assert consent.agreed([]) is True
    first = json.loads(ends[1].recv(4096)[1:])
    assert first["stage"] == "enabled"
    assert consent.agreed([]) is True  # another approval, another number


def test_an_enable_that_was_held_up_is_not_taken(ends: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows the number, but its server had no word of this program for long when it came."""

    def late(told: Any) -> ViewerRequest:
        return ViewerRequest("enable", "a node", {**told, "told_s": now_s() - LATE_S - 0.1})

    assert consent_of(ends, late, monkeypatch).agreed([]) is False


@pytest.mark.parametrize(("slept_s", "taken"), [(299.0, True), (301.0, False)])
def test_an_approval_does_not_outlive_a_standby(
    ends: Any, slept_s: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other clock stands still in the meantime, and a program may ask for the enable again and again."""
    clock = SimpleNamespace(s=1000.0)

    def wakes(told: Any) -> ViewerRequest | None:
        if clock.s < 1001.0:
            clock.s += slept_s
            return None
        return enable(told)

    consent = consent_of(ends, wakes, monkeypatch)
    monkeypatch.setattr(remote, "APPROVED_S", 300.0)
    for module in (remote, feed):
        monkeypatch.setattr(module, "now_s", lambda: clock.s)
    assert consent.agreed([]) is taken


@pytest.mark.parametrize("values", [{}, {"number": None}, {"number": 1}, {"number": "x"}])
def test_an_enable_before_the_approval_is_for_nothing(
    ends: Any, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(100):
        ends[1].send(ViewerRequest("enable", "a node", values).encoded())
    assert consent_of(ends, lambda _: None, monkeypatch).agreed([]) is False


def test_a_stop_before_the_approval_still_counts(ends: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ends[1].send(STOP.encoded())
    assert consent_of(ends, enable, monkeypatch).agreed([]) is False


def test_a_stop_instead_of_an_enable(ends: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert consent_of(ends, lambda _: STOP, monkeypatch).agreed([]) is False


def test_a_server_that_has_gone_enables_nothing(ends: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    consent = consent_of(ends, lambda _: None, monkeypatch)
    ends[1].close()
    with pytest.raises(JointctlError, match="nothing can enable the joint"):
        consent.agreed([])


@pytest.mark.parametrize("kind", ["enable", "gains", "trajectory", "set_point", "start"])
def test_without_allow_remote_nothing_but_stop_comes_through(ends: Any, kind: str) -> None:
    feed = ScopeFeed(ends[0], server="ROS 2", takes=frozenset())
    for request in (ViewerRequest(kind, "x"), ViewerRequest("stop", "x", {"strength": 2})):
        ends[1].send(request.encoded())
    assert feed.stop_request() is StopRequest.QUICK_STOP
    assert feed.requests() == []
    assert feed.stop_reason() == "ROS 2's STOP, x"


# --- set-points ---


def tracking(owner: str = "") -> tuple[SetPointSources, Any]:
    """Sources, and the memory of a loop that holds its place at 0 rad."""
    block: Any = SharedBlock.create(1, loop_of(CONFIG.drive.kind)[0])
    block.constants[:] = free_constants(CONFIG, 0.0)
    block.state[0].phase, block.words[Word.GO] = AxisPhase.TRACKING, 1
    sources = SetPointSources(owner)
    sources.begin(block)
    return sources, block


def alive_ns(block: Any) -> int:
    return int(block.constants["stream"]["alive_ns"][0][0])


def test_the_second_source_is_refused_by_name() -> None:
    sources, block = tracking()
    assert sources.take(RemoteSetPoint("Foxglove client 1", 0.001)) == ""
    written = int(block.constants["stream"]["written"][0][0])
    words = sources.take(RemoteSetPoint("ROS 2 node /b", 0.001))
    assert words == "the set-points of this run come from Foxglove client 1, not from ROS 2 node /b"
    assert int(block.constants["stream"]["written"][0][0]) == written == 1
    assert [(level, text.partition(" refused")[0]) for level, text in sources.poll()] == [
        (INFO, "set-points come from Foxglove client 1"), (WARNING, "set-point of ROS 2 node /b")
    ]  # fmt: skip


def test_nothing_is_compiled_or_loaded_when_the_first_set_point_comes() -> None:
    sources, _ = tracking()
    placed = sources.announced(Placed(free_constants(CONFIG, 0.0), np.zeros((1, 5)), ("motion",)), CONFIG)
    assert placed.lines[1].startswith("remote     set-points from Foxglove or ROS 2")
    assert int(placed.constants[0].stream.client_timeout_ns) == 1_000_000_000
    known = list(getattr(set_point_problem, "signatures", ()))
    assert sources.take(RemoteSetPoint("x", 0.001)) == ""
    assert list(getattr(set_point_problem, "signatures", ())) == known


def test_beside_a_program_every_source_is_the_second() -> None:
    sources, block = tracking("the program")
    assert "come from the program, not from x" in sources.take(RemoteSetPoint("x", 0.0))
    sources.poll()
    assert alive_ns(block) == 0


def test_the_sign_of_life_is_the_supervisors_until_a_source_has_the_joint() -> None:
    sources, block = tracking()
    sources.poll()
    first_ns = alive_ns(block)
    assert abs(time.monotonic_ns() - first_ns) < 5_000_000_000
    assert "must be in" in sources.take(RemoteSetPoint("x", 9.0))
    assert sources.owner == ""
    sources.poll()
    assert alive_ns(block) > first_ns
    assert sources.take(RemoteSetPoint("x", 0.001, time_s=1.0)) == ""
    taken_ns = alive_ns(block)
    assert "must be in" in sources.take(RemoteSetPoint("x", 9.0, time_s=1.01))
    sources.poll()
    assert alive_ns(block) == taken_ns


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda block: block.state[0].__setattr__("phase", AxisPhase.RAMPING), "follows no set-points now (ramping)"),
        (
            lambda block: block.constants[0].trajectory.__setattr__("kind", TrajectoryKind.SINE),
            "a motion is under way (sine)",
        ),
        (lambda block: block.words.__setitem__(Word.GO, 0), "the joint is not enabled"),
    ],
    ids=["stopping", "sine", "not yet"],
)
def test_when_no_set_point_is_followed(change: Any, words: str) -> None:
    sources, block = tracking()
    change(block)
    assert words in sources.take(RemoteSetPoint("x", 0.0))
    assert sources.owner == ""


def test_a_flood_of_refusals_is_a_few_events() -> None:
    sources, _ = tracking()
    for _ in range(1000):
        sources.take(RemoteSetPoint("x", 9.0))
    assert len(sources.poll()) == 1


def test_nothing_is_taken_after_the_run() -> None:
    sources, _ = tracking()
    sources.end()
    assert sources.take(RemoteSetPoint("x", 0.0)) == "the joint is not enabled"


def test_a_flood_does_not_reach_the_supervisor(ends: Any) -> None:
    (ours, theirs), clock, refused = ends, SimpleNamespace(s=0.0), []
    link = SetPointLink(theirs, lambda who, words: refused.append(words), lambda: clock.s)
    for _ in range(BURST + 50):
        link.send(RemoteSetPoint("x", 0.0))
    assert refused == ["more than 1000 set-points a second"] * 50
    clock.s = 0.01
    for _ in range(15):
        link.send(RemoteSetPoint("x", 0.0))
    assert len(refused) == 55
    for _ in range(BURST + 10):
        assert json.loads(ours.recv(4096))["who"] == "x"
    ours.close()
    clock.s = 1.0
    link.send(RemoteSetPoint("x", 0.0))
    assert "jointctl does not listen" in refused[-1]


@pytest.fixture
def way(ends: Any) -> Iterator[WayBack]:
    """To a supervisor that reads nothing."""
    ours, theirs = socket.socketpair()
    order: Any = SimpleNamespace(feed_fd=ends[1].detach(), set_points_fd=theirs.detach())
    way = WayBack(order, Mock(), lambda who, words: None)
    yield way
    with ours, way._feed._end, way._link._end:
        ours.shutdown(socket.SHUT_RDWR)


def test_behind_a_flood_of_requests_there_is_room_for_stop(way: WayBack) -> None:
    taken = [way.ask("gains", "a client", {"kp": 700.0}) for _ in range(5000)]
    assert not all(taken)
    assert way.stop("another client") == (True, "STOP taken; again: quick stop")


def test_its_twin_a_few_requests_are_all_taken(way: WayBack) -> None:
    assert all(way.ask("gains", "a client", {"kp": 700.0}) for _ in range(ASKS_BURST))


def test_what_a_client_is_refused_does_not_flood_the_others() -> None:
    """A client that cannot keep up is cut off, and its STOP with it."""
    view: Any = FoxgloveView.__new__(FoxgloveView)
    view._order, view._server = SimpleNamespace(allow_remote=False, joint="arm"), Mock()
    view._refusals, view._told_s, view._lock, view._topics, view._shown = {}, -1.0, threading.Lock(), {}, {}
    view.view = SimpleNamespace(settings={})
    client: Any = SimpleNamespace(id=1)
    for number in range(1000):
        view.on_set_parameters(client, [])
        view.on_client_advertise(client, SimpleNamespace(id=number, topic="/x", encoding="json"))
    told = [call.args[0] for call in view._server.publish_status.call_args_list]
    assert told[0] == "gains can be changed only where --allow-remote was given at the bench"
    assert len(told) < 100


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"[]", "must be an object with position_rad"),
        (b"{}", "must be an object with position_rad"),
        (b'{"position_rad": null}', "position_rad must be a number"),
        (b'{"position_rad": "x"}', r"position_rad \(=x\) must be a number"),
        (b'{"position_rad": true}', "must be a number"),
        (b'{"position_rad": 0, "speed": 1}', "'speed' is none of position_rad, velocity_radps"),
        (b"\xff", "decode"),
        (b"{", "Expecting"),
    ],
)
def test_garbage_of_a_foxglove_client(data: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        set_point_of("x", data)


def test_a_set_point_of_a_foxglove_client() -> None:
    data = b'{"position_rad": 0.1, "velocity_radps": null, "torque_Nm": 2, "time_s": 3.5}'
    assert set_point_of("x", data) == RemoteSetPoint("x", 0.1, None, None, 2.0, 3.5)


# --- where a server runs ---


@pytest.mark.parametrize(
    ("allowed", "loop_cpu", "kept"),
    [({0, 1, 5}, None, []), ({0, 1, 5}, 0, [{1, 5}]), ({2, 3}, 0, [{2, 3}]), ({1}, 1, [])],
)
def test_a_server_keeps_off_the_loops_processor(
    allowed: set[int], loop_cpu: int | None, kept: list[set[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    nice: list[int] = []
    chosen: list[set[int]] = []
    monkeypatch.setattr("os.nice", nice.append)
    monkeypatch.setattr("jointctl.tools.child_process.own_threads", lambda: {7})
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: allowed)
    monkeypatch.setattr("os.sched_setaffinity", lambda pid, processors: chosen.append(processors))
    stand_aside(loop_cpu)
    assert (nice, chosen) == ([NICE], kept)
