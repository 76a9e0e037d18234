"""The scope: its memory, its feed, its door, and what a page may ask for."""

from __future__ import annotations

import asyncio
import io
import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import MagicMock

import numpy as np
import pytest

from jointctl.drivers import stop_note
from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED, INTERRUPTED, ConfigurationError, DataError, MotionFault, UsageError
from jointctl.drivers.stop_note import now_ns
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram, Word
from jointctl.firmware_py.records import AxisState, LogRecord
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.states import AxisPhase, StopRequest
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import INFO, Event
from jointctl.tools.scoping import feed as feed_module
from jointctl.tools.scoping import server as server_module
from jointctl.tools.scoping.feed import EVENT, PIECE, RECORDS, SETTINGS, ScopeFeed, ScopeOrder, scope_order
from jointctl.tools.scoping.history import EVENTS, POINTS, SIGNALS, History, Seen, crossing_s, percentiles_us
from jointctl.tools.scoping.server import COOKIE, allowed, cookie_name
from jointctl.tools.session import session as session_module
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import Displays, PhaseLines, Snapshot, ViewerRequest, time_left
from jointctl.tools.session.live_changes import UNWATCHED, LiveChanges, ViewerOrders, checked_gains, new_motion
from jointctl.tools.session.plan import resolve
from jointctl.tools.session.run_watch import Around, BusWatch, RunParts, RunWatch
from jointctl.tools.session.session import Session
from jointctl.tools.verbs import scope as scope_module
from tests.sessions import constants_of


# --- Records of a run for the scope ---
def records(count: int, first: int = 0) -> Any:
    found = new(LogRecord, count)
    found.cycle = np.arange(first, first + count)
    found.time_ns = 10**12 + found.cycle * 1_000_000
    found.error_rad = np.sin(found.cycle / 100.0) * 1e-3
    found.phase = AxisPhase.TRACKING
    return found


# --- The scope's memory: a ring, the picture of a stretch, peaks, gaps, trigger, deadlines ---
def test_the_memory_is_a_ring() -> None:
    history = History(1000)
    assert len(history.newest(1.0)) == 0
    for first in range(0, 10_000, 30):
        history.take(records(30, first))
    history.take(records(2500, 10_020))
    kept = history.newest(1e9)
    np.testing.assert_array_equal(kept.cycle, np.arange(11_520, 12_520))
    for number in range(3 * EVENTS):
        history.events.append(Event(number, INFO, "a", "b"))
    assert len(history.events) == EVENTS
    assert history.events[-1].time_ns == 3 * EVENTS - 1


def test_of_an_arm_each_joint_has_its_own_records_and_the_events_are_of_all() -> None:
    history, rows = History(1000, ("shoulder", "elbow")), records(30)
    history.take_bytes(rows[:20].tobytes(), 0)
    history.take_bytes(rows[20:].tobytes(), 1)
    history.take_bytes(rows.tobytes(), 2)  # there is no such joint
    assert [len(history.of(joint).newest(1000.0)) for joint in (0, 1)] == [20, 10]
    history.begin()
    assert not any(len(history.of(joint).newest(1000.0)) for joint in (0, 1))


@pytest.mark.parametrize(("span_s", "before_s", "first", "last"), [(0.1, None, 900, 999), (0.1, 0.5, 401, 500)])
def test_the_picture_is_the_last_stretch_or_the_held_one(
    span_s: float, before_s: float | None, first: int, last: int
) -> None:
    history = History()
    history.take(records(1000))
    rows = history.newest(span_s, before_s)
    assert abs(int(rows.cycle[0]) - first) <= 1
    assert int(rows.cycle[-1]) == last


def test_a_series_keeps_its_peaks_and_leaves_out_what_is_no_number() -> None:
    history, rows = History(), records(20_000)
    rows.error_rad[7777] = 0.5
    rows.error_rad[100] = np.nan
    history.take(rows)
    points = np.array(history.series(history.newest(1e9), "error [mrad]"))
    assert len(points) <= POINTS + 2
    assert points[:, 1].max() == 500.0
    assert points[np.argmax(points[:, 1]), 0] == pytest.approx(7.777)
    assert np.all(np.isfinite(points))
    assert np.all(np.diff(points[:, 0]) > 0)
    for signal in SIGNALS:
        assert history.series(history.newest(0.1), signal)


@pytest.mark.parametrize(("missing", "gap"), [(99, False), (100, True)])
def test_records_that_did_not_come_are_a_gap_in_the_line(missing: int, gap: bool) -> None:
    history = History()
    history.take(records(200))
    history.take(records(200, 200 + missing))
    found = history.series(history.newest(1e9), "angle [rad]")
    empty = [i for i, (_, value) in enumerate(found) if value is None]
    assert len(empty) == gap
    if gap:
        assert found[empty[0]][0] == pytest.approx(0.199)
        assert found[empty[0] + 1][0] == pytest.approx(0.3)
    times = [time_s for time_s, _ in found if time_s is not None]
    assert times == sorted(times)


def test_the_error_is_only_drawn_while_the_law_is_at_work() -> None:
    history, rows = History(), records(300)
    rows.phase[:100], rows.phase[200:] = AxisPhase.WAITING, AxisPhase.DISABLING
    history.take(rows)
    found = history.newest(1e9)
    assert len(history.series(found, "error [mrad]")) == 100
    assert len(history.series(found, "angle [rad]")) == 300


def test_the_trigger_is_the_last_crossing_in_its_direction() -> None:
    time_s = np.arange(6) * 1.0
    values = np.array([0.0, 2.0, 0.0, 2.0, 2.0, 0.0])
    assert crossing_s(time_s, values, 1.0, rising=True) == 3.0
    assert crossing_s(time_s, values, 1.0, rising=False) == 5.0
    assert crossing_s(time_s, values, 2.0, rising=True) is None
    assert crossing_s(time_s[:1], values[:1], 1.0, rising=True) is None


def test_deadline_statistics_leave_out_cycles_without_a_sample() -> None:
    rows = records(100)
    rows.wake_late_ns, rows.work_ns = 20_000, 10_000
    rows.round_trip_ns[:50] = 90_000
    assert percentiles_us(rows) == {
        "wake-up late": "20 / 20 / 20 us", "round trip": "90 / 90 / 90 us", "work": "10 / 10 / 10 us",
    }  # fmt: skip
    rows.round_trip_ns = 0
    assert "round trip" not in percentiles_us(rows)


# --- The scope's feed: nothing waits for a page, and the run knows who watches ---
def snapshot(rows: Any) -> Snapshot:
    return Snapshot(rows[-1], 0, np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64), 1.0, True, rows)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    yield pair
    for end in pair:
        end.close()


@pytest.mark.parametrize("count", [1, PIECE - 1, PIECE, PIECE + 1, 200])
def test_records_and_events_arrive_as_they_were(ends: tuple[socket.socket, socket.socket], count: int) -> None:
    feed, history = ScopeFeed(ends[0]), History()
    feed.show(snapshot(records(count)))
    feed.event(Event(7, INFO, "drive", "operation enabled"))
    kinds = []
    for _ in range(-(-count // PIECE) + 1):
        message = ends[1].recv(1 << 20)
        kinds.append(message[:1])
        if message[:1] == RECORDS:
            history.take_bytes(message[2:], message[1])
    assert kinds == [RECORDS] * -(-count // PIECE) + [EVENT]
    np.testing.assert_array_equal(history.newest(1e9), records(count))
    assert feed.dropped == 0


def test_a_feed_of_states_passes_on_few_records_in_few_messages_and_all_in_the_end(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, feed = Clock(monkeypatch), ScopeFeed(ends[0], states_s=0.1)
    looks = 25
    with feed:
        for look in range(looks):
            clock.now_s = look * 0.02
            for axis in (0, 1):
                feed.show(replace(snapshot(records(20, 20 * look)), skipped=3, temperature_degC=25.0, axis=axis))
    ends[0].close()
    messages = list(iter(lambda: ends[1].recv(1 << 20), b""))
    assert [json.loads(found[1:]) for found in messages if found[:1] == SETTINGS] == [
        {"stage": "running"}, {"temperature_degC": 25.0, "skipped": 3}
    ]  # fmt: skip
    for axis in (0, 1):
        bodies = [found[2:] for found in messages if found[:1] == RECORDS and found[1] == axis]
        cycles = np.frombuffer(b"".join(bodies), dtype_of(LogRecord))["cycle"]
        np.testing.assert_array_equal(cycles, np.arange(0, 20 * looks, 10))
        assert len(bodies) <= looks * 0.02 / 0.1 + 2


def test_the_last_stage_arrives_also_where_the_server_is_slow(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise its pages would go on to say that the joint may move."""
    feed = ScopeFeed(ends[0])
    while not feed.dropped:
        feed.show(snapshot(records(20)))
    found: list[bytes] = []

    def read() -> None:
        time.sleep(0.05)
        while b"over" not in (found or [b""])[-1]:
            found.append(ends[1].recv(1 << 20))

    monkeypatch.setattr(feed_module, "LAST_WORD_S", 60.0)  # however long this computer stands still
    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    feed.over()
    reader.join(60.0)
    assert found[-1] == SETTINGS + b'{"stage": "over"}'


def test_a_server_that_reads_nothing_or_is_gone_costs_the_run_nothing(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    feed = ScopeFeed(ends[0])
    for _ in range(2000):
        feed.show(snapshot(records(20)))
    assert 0 < feed.dropped < 2000
    assert feed.stop_request() is StopRequest.NONE
    ends[1].close()
    before = feed.dropped
    feed.show(snapshot(records(20)))
    feed.event(Event(0, INFO, "a", "b"))
    assert feed.dropped == before + 2
    assert feed.stop_request() is StopRequest.NONE


def asked(kind: str, **values: Any) -> bytes:
    return ViewerRequest(kind, "a viewer", values).encoded()


def test_stop_is_the_strongest_word_that_came(ends: tuple[socket.socket, socket.socket]) -> None:
    feed = ScopeFeed(ends[0])
    none = [b"0", b"1", b"x", b"11", b"{}", *(asked("stop", strength=bad) for bad in (0, 3, -1, "1", None, [1]))]
    for words, expected in (
        ([], StopRequest.NONE), (none, StopRequest.NONE), ([asked("stop", strength=1)], StopRequest.RAMP),
        ([asked("stop", strength=2), asked("stop", strength=1)], StopRequest.QUICK_STOP),
        ([asked("stop", strength=1)], StopRequest.QUICK_STOP),
    ):  # fmt: skip
        for word in words:
            ends[1].send(word)
        assert feed.stop_request() is expected
    assert feed.stop_reason() == "the scope's STOP, a viewer"
    feed.forget()
    assert (feed.stop_request(), feed.stop_reason()) == (StopRequest.NONE, "")


def test_the_run_is_told_when_the_last_page_closes_and_when_one_opens_again(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    feed = ScopeFeed(ends[0], in_charge=True)
    for count, told in ((0, []), (1, []), (2, []), (1, []), (0, [0]), (0, []), (1, [1]), (0, [0]), ("x", [])):
        ends[1].send(asked("viewers", count=count))
        assert [request.values["count"] for request in feed.requests()] == told
    feed.forget()
    with feed:  # nobody there when the run begins: reported as well
        assert [request.values["count"] for request in feed.requests()] == [0]
    assert feed.stop_request() is StopRequest.NONE


class Clock:
    """What the feed takes for the time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(feed_module, "time", SimpleNamespace(monotonic=lambda: self.now_s))


@pytest.mark.parametrize(("limit_s", "expected"), [(None, StopRequest.NONE), (0.3, StopRequest.RAMP)])
def test_a_run_that_nobody_watches_brakes_if_that_is_wanted(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch, limit_s: float | None,
    expected: StopRequest,
) -> None:  # fmt: skip
    clock, feed = Clock(monkeypatch), ScopeFeed(ends[0], unwatched_s=limit_s)
    # nobody has been there yet; somebody is there; nobody any more
    for counts, then in (((0,), StopRequest.NONE), ((1, 0, 1), StopRequest.NONE), ((0,), expected)):
        for count in counts:
            ends[1].send(asked("viewers", count=count))
            assert feed.stop_request() is StopRequest.NONE
        clock.now_s += 0.299
        assert feed.stop_request() is StopRequest.NONE
        clock.now_s += 0.002
        assert feed.stop_request() is then
    assert feed.stop_reason() == ("the scope: no page open for 0.3 s" if limit_s else "")


@pytest.mark.parametrize(("limit_s", "expected"), [(None, StopRequest.NONE), (0.1, StopRequest.RAMP)])
def test_a_server_that_hangs_counts_as_nobody(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch, limit_s: float | None,
    expected: StopRequest,
) -> None:  # fmt: skip
    clock, feed = Clock(monkeypatch), ScopeFeed(ends[0], unwatched_s=limit_s)
    for _ in range(6):  # longer than that, but the server repeats its word
        ends[1].send(asked("viewers", count=1))
        assert feed.stop_request() is StopRequest.NONE
        clock.now_s += 0.3 * feed_module.SILENT_S
    assert feed.requests() == []
    clock.now_s += feed_module.SILENT_S
    assert feed.stop_request() is expected
    (told,) = feed.requests()
    assert "no word from the scope's server" in told.values["text"]
    ends[1].send(asked("viewers", count=1))
    assert [request.values["count"] for request in feed.requests()] == [1]


@pytest.mark.parametrize(("present", "word"), [(True, 2), (False, 2), (None, 0)])
def test_the_server_repeats_its_count_also_during_a_reload(
    monkeypatch: pytest.MonkeyPatch, present: bool | None, word: int
) -> None:
    """present: two pages; False: they are being reloaded, which is no absence; None: nobody for longer."""
    nicegui = pytest.importorskip("nicegui")
    pages = [SimpleNamespace(has_socket_connection=True) for _ in range(2)]
    monkeypatch.setattr(nicegui.Client, "instances", dict(enumerate(pages)))
    monkeypatch.setattr(server_module, "COUNT_S", 0.02)
    monkeypatch.setattr(server_module, "COUNT_AGAIN_S", 0.1)
    monkeypatch.setattr(server_module, "RELOAD_S", 0.2 if present is None else 10.0)
    told: list[int] = []
    feed: Any = SimpleNamespace(ask=lambda request: told.append(request.values["count"]))

    async def count() -> None:
        task = asyncio.create_task(server_module.count_viewers(feed))
        await asyncio.sleep(0.05)
        for page in pages:
            page.has_socket_connection = bool(present)
        await asyncio.sleep(0.5)
        task.cancel()

    asyncio.run(count())
    assert told[0] == 2
    assert told[-1] == word
    assert len(told) >= 3


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"in_charge": True}, "server has ended: no page shows"),
        ({"in_charge": False}, "server has ended: no page shows"),
        ({"server": "Foxglove", "takes": frozenset()}, "Foxglove's server has ended: no client there shows"),
    ],
)
def test_the_end_of_the_server_brakes_what_is_led_from_the_page(
    ends: tuple[socket.socket, socket.socket], how: dict[str, Any], words: str
) -> None:
    feed = ScopeFeed(ends[0], **how)
    assert feed.stop_request() is StopRequest.NONE
    ends[1].close()
    assert feed.stop_request() is (StopRequest.RAMP if how.get("in_charge") else StopRequest.NONE)
    (told,) = feed.requests()
    assert words in told.values["text"]
    assert feed.requests() == []


def test_nobody_watching_is_an_event_and_a_line_in_the_terminal(tmp_path: Path) -> None:
    events: list[str] = []
    config = load_config(shipped_config("virtual"))
    changes = LiveChanges(config, None, lambda level, text: events.append(text), lambda: None)
    orders = ViewerOrders(changes, tmp_path / "a.mcap", {})
    orders._told_s = math.inf  # how things stand is not told
    err = io.StringIO()

    class Asking(PhaseLines):
        left: ClassVar[list[ViewerRequest]] = [ViewerRequest("viewers", "", {"count": count}) for count in (0, 1)]

        def requests(self) -> list[ViewerRequest]:
            return [self.left.pop(0)] if self.left else []

    display = Asking(Output(stderr=err))
    for _ in range(3):
        orders.serve(display)
    assert events == [UNWATCHED, "a page is open again"]
    assert err.getvalue() == f"  {UNWATCHED}\n  a page is open again\n"


def test_several_displays_are_one(ends: tuple[socket.socket, socket.socket]) -> None:
    err = io.StringIO()
    both = Displays([PhaseLines(Output(stderr=err)), ScopeFeed(ends[0])])
    with both as display:
        display.phase("tracking")
        display.note("delay")
        display.show(snapshot(records(3)))
        display.event(Event(0, INFO, "a", "b"))
        ends[1].send(asked("stop", strength=1))
        assert display.stop_request() is StopRequest.RAMP
        assert display.stop_reason() == "the scope's STOP, a viewer"
    assert err.getvalue() == "  tracking\n  delay\n"
    assert [ends[1].recv(1 << 20)[:1] for _ in range(3)] == [SETTINGS, RECORDS, EVENT]


# --- The scope's door: nobody else comes in, and orders are checked ---
def request(host: str, query: str = "", **headers: str) -> dict[str, Any]:
    listed = [(b"host", host.encode())] + [(name.encode(), value.encode()) for name, value in headers.items()]
    return {"type": "http", "headers": listed, "query_string": query.encode()}


@pytest.mark.parametrize(
    ("host", "origin", "passes"),
    [
        ("127.0.0.1:8642", "", True), ("localhost:8642", "http://localhost:8642", True), ("[::1]:8642", "", True),
        ("127.0.0.1:8642", "http://evil.example", False), ("127.0.0.1:8642", "null", False),
        ("127.0.0.1:8642", "http://[::1", False),
    ],
)  # fmt: skip
def test_a_page_of_another_site_does_not_come_in_even_with_the_token(host: str, origin: str, passes: bool) -> None:
    assert allowed(request(host, "token=secret", **({"origin": origin} if origin else {})), "secret") is passes


@pytest.mark.parametrize("host", ["127.0.0.1:8642", "localhost:8642", "[::1]:8642", "192.168.0.5:8642", ""])
@pytest.mark.parametrize(
    ("query", "cookie", "passes"),
    [
        ("", "", False), ("token=secret", "", True), ("token=secreT", "", False), ("token=", "", False),
        ("token=%", "", False), ("token=\xff", "", False), ("", f"{COOKIE}=secret", True),
        ("", f"{COOKIE}_1234=other; {COOKIE}_5678=secret", True), ("", f"{{]bad; =; {COOKIE}=secret", True),
        ("", f"{COOKIE}=other", False), ("", "other=secret", False), ("token=wrong", f"{COOKIE}=secret", True),
    ],
)  # fmt: skip
def test_the_token_is_asked_for_on_this_computer_too(host: str, query: str, cookie: str, passes: bool) -> None:
    headers = {"cookie": cookie} if cookie else {}
    found = {**request(host, **headers), "query_string": query.encode("latin-1")}
    assert allowed(found, "secret") is passes
    assert not allowed(found, "")  # a server without a token serves no one


def test_orders_are_checked_and_each_has_a_token_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "find_spec", lambda name: None)
    with pytest.raises(DataError, match="needs the package nicegui"):
        scope_order("t", "127.0.0.1", 8642)
    monkeypatch.setattr(feed_module, "find_spec", lambda name: object())
    with pytest.raises(UsageError, match=r"--port \(=0\) must be in \[1..65535\]"):
        scope_order("t", "127.0.0.1", 0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DataError, match=f"cannot be served at 127.0.0.1:{port}"):
            scope_order("t", "127.0.0.1", port)
    for host, shown in (("127.0.0.1", "127.0.0.1"), ("localhost", "localhost"), ("0.0.0.0", "0.0.0.0")):
        order, other = scope_order("t", host, port), scope_order("t", host, port)
        assert len(order.token) >= 20
        assert order.url == f"http://{shown}:{port}/?token={order.token}"
        assert order.token != other.token
        assert cookie_name(order.token) != cookie_name(other.token)
    assert ScopeOrder("t", "::1", 1, "secret").url == "http://[::1]:1/?token=secret"
    assert scope_order("a\x1b[2Jb", "127.0.0.1", port).title == "a\\u001b[2Jb"


# --- What a page asks for: only what its viewer has typed, from where the joint is, and how long a motion goes on ---
TABLE = np.zeros((1, 5))


class Panels:
    """The change panels' fields without a browser."""

    def __init__(self, **shown: float) -> None:
        panels = pytest.importorskip("jointctl.tools.scoping.scope_page")
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.panels = panels.ChangePanels.__new__(panels.ChangePanels)
        self.panels._ask = lambda kind, values: self.asked.append((kind, values))
        self.fields = {name: SimpleNamespace(value=value) for name, value in shown.items()}
        self.panels._gains = {name: panels.Followed(field, ".5g") for name, field in self.fields.items()}

    def in_force(self, **now: float) -> None:
        for name, value in now.items():
            self.panels._gains[name].follow(value)

    def apply(self) -> list[tuple[str, dict[str, Any]]]:
        self.asked.clear()
        self.panels._apply()
        return self.asked


def test_apply_sends_what_was_typed_and_puts_nothing_back() -> None:
    page = Panels(kp=784.0, kv=56.0)
    page.fields["kv"].value = 60.0
    page.in_force(kp=700.0, kv=56.0)  # another viewer has changed kp
    assert page.fields["kp"].value == 700.0
    assert page.apply() == [("gains", {"kv": 60.0})]
    page.in_force(kp=700.0, kv=60.0)
    assert page.apply() == []  # it is in force: nothing is the viewer's own any more
    page.in_force(kp=700.0, kv=50.0)
    assert page.fields["kv"].value == 50.0


def test_what_was_typed_stays_until_it_is_in_force() -> None:
    page = Panels(kp=784.0)
    page.fields["kp"].value = 900.0
    for now in (784.0, 800.0, 850.0):
        page.in_force(kp=now)
        assert page.fields["kp"].value == 900.0
    assert page.apply() == [("gains", {"kp": 900.0})]
    page.fields["kp"].value = None
    assert page.apply() == [("gains", {"kp": None})]  # refused by the supervisor, in words


def test_a_field_with_the_focus_follows_nothing() -> None:
    page = Panels(kp=784.0)
    followed = page.panels._gains["kp"]
    followed.has_focus = True
    page.in_force(kp=700.0)
    assert page.fields["kp"].value == 784.0
    page.fields["kp"].value = 78.0  # typed, key by key
    page.in_force(kp=701.0)
    assert page.apply() == [("gains", {"kp": 78.0})]
    page.fields["kp"].value = 784.0  # taken back, and left
    followed.has_focus = False
    page.in_force(kp=702.0)
    assert page.fields["kp"].value == 702.0


class Asking:
    """The change panels of one viewer, with a set-point, one gain and one field of a trajectory."""

    def __init__(self) -> None:
        page = pytest.importorskip("jointctl.tools.scoping.scope_page")
        self.panels = page.ChangePanels.__new__(page.ChangePanels)
        self.panels._pass_on, self.panels._who = lambda kind, values: None, "a viewer at 10.0.0.5"
        self.panels._asked, self.panels._refusals = "", None
        self.set_point, self.gain, self.other, self.move = (SimpleNamespace(value=1.0, error=None) for _ in range(4))
        self.panels._set_point = self.set_point
        self.panels._gains = {name: page.Followed(f, ".5g") for name, f in (("kp", self.gain), ("kv", self.other))}
        self.panels._given, self.panels._kind = {"amplitude_rad": self.move}, SimpleNamespace(error=None)

    def refused(self, kind: str, count: int, text: str = "no", who: str = "a viewer at 10.0.0.5") -> None:
        self.panels._show_refusal({"count": count, "who": who, "kind": kind, "text": text})

    def errors(self) -> tuple[Any, ...]:
        return self.set_point.error, self.gain.error, self.other.error, self.move.error


def test_a_refusal_is_shown_at_its_field() -> None:
    page = Asking()
    page.panels._show_refusal(None)
    page.panels._ask("set_point", {"position_rad": 9.0})
    page.refused("set_point", 1, "position_rad (=9) must be in [-0.7..0.7]")
    assert page.errors() == ("position_rad (=9) must be in [-0.7..0.7]", None, None, None)
    page.panels._ask("trajectory", {})
    page.refused("trajectory", 2, "trajectory: highest position is too high")
    assert page.move.error == "trajectory: highest position is too high"
    page.panels._ask("gains", {})
    page.refused("gains", 3, "control.kv (=1e9) is too high")
    assert (page.gain.error, page.other.error) == (None, "control.kv (=1e9) is too high")


def test_refusals_of_others_and_of_before_are_not_shown() -> None:
    page = Asking()
    page.panels._asked = "set_point"
    page.refused("set_point", 4)  # there when the page was opened
    page.refused("set_point", 5, who="a viewer at 10.0.0.6")
    page.refused("gains", 6)
    page.refused("set_point", 6)  # seen already
    assert page.errors() == (None, None, None, None)
    page.refused("set_point", 7)
    assert page.errors() == ("no", None, None, None)


def test_what_was_refused_in_a_run_that_has_ended_is_forgotten() -> None:
    page = Asking()
    page.panels._refusals = 0
    for count, kind in enumerate(("set_point", "trajectory", "gains"), 1):
        page.panels._ask(kind, {})
        page.refused(kind, count)
    assert page.errors() == ("no",) * 4
    page.panels._column = SimpleNamespace(visible=True)
    for name in ("_gain_rows", "_gains_card", "_record", "_recorded"):
        setattr(page.panels, name, MagicMock())
    page.panels.show({"stage": "ended"})
    assert page.errors() == (None,) * 4


# --- The axis of a joint at rest ---
@pytest.mark.parametrize(
    ("low", "high", "unit", "fits_itself"),
    [(0.1, 0.10001, "[rad]", False), (0.1, 0.1019, "[rad]", False), (0.1, 0.1021, "[rad]", True),
     (-0.01, 0.01, "[mrad]", False), (-0.2, 0.2, "[mrad]", True), (1.0, 1.0, "[unknown]", True)],
)  # fmt: skip
def test_noise_is_not_magnified(low: float, high: float, unit: str, fits_itself: bool) -> None:
    chart = pytest.importorskip("jointctl.tools.scoping.chart")
    found = chart.axis_range(low, high, unit)
    assert (found is None) is fits_itself
    if found is not None:
        assert found[0] < low <= high < found[1]
        assert found[1] - found[0] == pytest.approx(1.5 * chart.LEAST_SPAN[unit])
        assert chart.axis_range(low + 1e-9, high + 1e-9, unit) == found


def test_an_axis_follows_its_signals_again_once_they_move() -> None:
    chart = pytest.importorskip("jointctl.tools.scoping.chart")
    rest, motion = [[0.0, 0.1], [1.0, 0.10001]], [[0.0, 0.1], [1.0, None], [2.0, 0.35]]
    resting = chart.axis_ends("[rad]", {"angle [rad]": rest})
    assert resting["min"] < 0.1 < 0.10001 < resting["max"]
    # named, though there are none: a chart keeps what it is not given
    assert chart.axis_ends("[rad]", {"angle [rad]": motion}) == {"min": None, "max": None}
    assert chart.axis_ends("[Nm]", {"angle [rad]": rest}) == {"min": None, "max": None}


def test_neither_does_the_axis_across_magnify_a_joint_at_rest() -> None:
    chart = pytest.importorskip("jointctl.tools.scoping.chart")

    def across(view: str, *angles_rad: float) -> dict[str, Any]:
        return dict(chart.x_ends(view, Seen("angle [rad]", np.array([np.nan, *angles_rad]), {})))

    resting = across("x-y", 0.1, 0.10001)
    assert resting["min"] < 0.1 < 0.10001 < resting["max"]
    assert resting["max"] - resting["min"] == pytest.approx(1.5 * chart.LEAST_SPAN["[rad]"])
    fits = {"min": "dataMin", "max": "dataMax"}
    assert across("x-y", 0.1, 0.35) == across("x-y") == across("time", 0.1, 0.10001) == fits


def test_every_signal_has_a_least_span() -> None:
    chart = pytest.importorskip("jointctl.tools.scoping.chart")
    assert {name[name.index("[") :] for name in SIGNALS} <= set(chart.LEAST_SPAN)


def test_what_a_browser_rounds_was_not_typed() -> None:
    page = Panels(kp=784.12345)
    page.fields["kp"].value = 784.12
    assert page.apply() == []
    page.fields["kp"].value = 784.13
    assert page.apply() == [("gains", {"kp": 784.13})]


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ({"kind": "hold", "duration_s": 0.0, "position_rad": 0.1}, False),
        ({"kind": "sine", "duration_s": 0.0, "amplitude_rad": 0.1, "frequency_Hz": 0.2}, False),
        ({"kind": "sine", "duration_s": 5.0, "amplitude_rad": 0.1, "frequency_Hz": 0.2}, True),
        ({"kind": "configured"}, True),
    ],
)
def test_a_motion_without_an_end_says_so(
    virtual_config: Any, tmp_path: Path, values: dict[str, Any], ends: bool
) -> None:
    constants, words = new_motion(virtual_config, TABLE, values)
    assert words.endswith(", until stopped") is not ends
    assert virtual_config.trajectory.duration_s > 0.0
    shown: list[Any] = []
    axis = constants_of(virtual_config, start_position_rad=0.0)
    axis[0].trajectory = constants[0]  # as the loop has taken it
    block = SimpleNamespace(
        constants=axis,
        state=new(AxisState),
        words=np.zeros(max(Word) + 1),
        histograms=np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64),
    )
    sink: Any = SimpleNamespace(path=tmp_path, append=lambda records: None, write_records=lambda records: None)
    display: Any = SimpleNamespace(show=shown.append, event=lambda event: None)
    sink.write_event = lambda *_: None
    loop: Any = SimpleNamespace(block=block, new_records=lambda: new(LogRecord, 1).view(np.recarray))
    around = Around(StopSignals(), BusWatch(virtual_config, None))
    RunWatch(resolve(virtual_config), axis[0], RunParts(loop, around, sink, sink, display, {})).take_records()
    assert (time_left(1e4, shown[0].duration_s, AxisPhase.TRACKING) == "until stopped") is not ends


@pytest.mark.parametrize(
    ("value", "words"),
    [(None, "trajectory.position_rad is empty: must be a number"),
     ("x", "trajectory.position_rad (=x) must be a number")],
)  # fmt: skip
def test_an_empty_field_is_refused_as_such(virtual_config: Any, value: object, words: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        new_motion(virtual_config, TABLE, {"kind": "hold", "duration_s": 0.0, "position_rad": value})
    assert refused.value.message == words
    with pytest.raises(ConfigurationError, match=r"^control.kp (is empty:|\(=x\)) must be in \[392..1568\]"):
        checked_gains({"kp": value}, {"kp": 784.0}, {"kp": 392.0}, {"kp": 1568.0})


# --- before Start, and after the end ---
class Feed:
    """Presses Start as soon as it can, and asks for the next run when the end has been told three times."""

    gone = False

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []

    def settings(self, values: dict[str, Any]) -> None:
        self.told.append(values)

    def forget(self) -> None: ...

    def stop_request(self) -> StopRequest:
        return StopRequest.NONE

    def requests(self) -> list[ViewerRequest]:
        last = self.told[-1]
        if last["stage"] == "ready":
            return [
                ViewerRequest(
                    "start", "a viewer", {name: last[name] for name in ("number", "told_s")} | {"clear": True}
                )
            ]
        if self.told.count(last) < 3:
            return []
        self.pressed()
        return [ViewerRequest("prepare", "a viewer", {})]

    def pressed(self) -> None: ...


@pytest.mark.parametrize(
    ("late_s", "taken"), [(feed_module.LATE_S - 0.5, True), (feed_module.LATE_S + 0.5, False), (None, False)]
)
def test_a_start_that_was_held_up_is_not_taken_and_one_after_it_is(
    monkeypatch: pytest.MonkeyPatch, late_s: float | None, taken: bool
) -> None:
    """By the last word that the browser had; a page that says none has seen none."""
    clock = SimpleNamespace(now_s=100.0)
    pressed: list[float] = []

    def sleep(seconds: float) -> None:
        clock.now_s += seconds

    class Held(Feed):
        def requests(self) -> list[ViewerRequest]:
            last = self.told[-1] if self.told else {}
            if not last or clock.now_s < 101.0:
                return []
            pressed.append(clock.now_s)
            told_s = last["told_s"]  # the second press comes at once
            if len(pressed) == 1:
                told_s = clock.now_s - late_s if late_s is not None else None
            return [ViewerRequest("start", "a viewer", {"number": last["number"], "clear": True, "told_s": told_s})]

    monkeypatch.setattr(feed_module, "now_s", lambda: clock.now_s)
    monkeypatch.setattr(scope_module, "time", SimpleNamespace(sleep=sleep))
    feed: Any = Held()
    assert scope_module.confirmed(feed, ["moves"])
    assert len(pressed) == (1 if taken else 2)
    assert any("late" in found["late"] for found in feed.told) is not taken


@pytest.mark.parametrize("refused", [True, False])
def test_what_run_checks_is_checked_before_start(
    monkeypatch: pytest.MonkeyPatch, virtual_config: Any, refused: bool
) -> None:
    calls: list[str] = []

    def require_ready(*_: Any) -> None:
        calls.append("checked")
        if refused:
            raise MotionFault("outside", "move it")

    class Asking(Session):
        """Asks, and does not run."""

        def run(self) -> None:
            self.drive_state = "switch on disabled"
            placed = self._possible([CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)])
            assert placed is not None
            self._agreed(placed)

    monkeypatch.setattr("jointctl.tools.session.session.Session", Asking)
    monkeypatch.setattr(session_module, "require_ready", require_ready)
    monkeypatch.setattr(session_module, "prepare_log", lambda *_: calls.append("log prepared"))
    feed: Any = Feed()
    runs = scope_module._Runs(virtual_config, Output(), feed, "title", allow_low_margin=False)
    assert runs.one() is False
    assert calls == (["checked"] if refused else ["checked", "log prepared"])
    assert ("ready" in [told["stage"] for told in feed.told]) is not refused
    assert feed.told[-1]["stage"] == ("ended" if refused else "declined")
    assert runs.code == (7 if refused else DECLINED)
    assert runs.drive_state == "switch on disabled"


def test_the_end_of_a_run_is_told_until_the_next_is_prepared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scope_module, "TELL_AGAIN_S", 0.02)
    feed: Any = Feed()
    ended = {"stage": "ended", "lines": ["log"]}
    feed.settings(ended)
    before_ns, pressed_ns = now_ns(), []
    monkeypatch.setattr(feed, "pressed", lambda: pressed_ns.append(now_ns()))
    asked_ns = scope_module._wait_for_prepare(feed, ended)
    assert feed.told == [ended] * 3
    assert before_ns < asked_ns < pressed_ns[0]  # a stop that comes right after the press is later


@pytest.mark.parametrize("when", ["before it", "between two runs"])
def test_a_stop_before_the_page_has_the_bus_ends_it_and_one_before_prepare_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, virtual_config: Any, when: str
) -> None:
    for name, value in (("FOLDER", tmp_path), ("_anew_ns", 0), ("_settled_ns", {})):
        monkeypatch.setattr(stop_note, name, value)
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))  # the stops are another's
    lock, runs = lock_name(virtual_config.bus.interface, virtual_config.bus.channel), []

    class Runs(Session):
        def run(self) -> None:
            runs.append(when)
            if len(runs) == 2:
                raise KeyboardInterrupt

    @contextmanager
    def server(*_: Any, **__: Any) -> Iterator[Any]:
        yield Feed()

    monkeypatch.setattr("jointctl.tools.session.session.Session", Runs)
    monkeypatch.setattr("jointctl.tools.scoping.feed.scope_server", server)
    monkeypatch.setattr("jointctl.tools.scoping.feed.scope_order", lambda *_, **__: SimpleNamespace(url=""))
    monkeypatch.setattr(scope_module, "_wait_for_prepare", lambda *_: (stop_note.write_note(lock), now_ns())[1])
    if when == "before it":
        stop_note.write_note(lock)
    err = io.StringIO()
    code = scope_module.live_scope(virtual_config, Output(stderr=err))
    if when == "before it":
        assert (code, runs) == (INTERRUPTED, [])
        assert "scope ended by jointctl stop; nothing moved" in err.getvalue()
    else:
        assert len(runs) == 2
        assert "by jointctl stop" not in err.getvalue()
