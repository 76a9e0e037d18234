"""The scope's feed: nothing waits for a page, and the run knows who watches."""

from __future__ import annotations

import asyncio
import io
import math
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from jointctl.firmware_py.realtime import HISTOGRAM_BINS
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import INFO, Event
from jointctl.tools.running.changes.viewer_orders import UNWATCHED, ViewerOrders
from jointctl.tools.running.display.display import Snapshot
from jointctl.tools.running.display.phase_lines import PhaseLines
from jointctl.tools.running.display.viewer_request import ViewerRequest
from jointctl.tools.scoping import feed as feed_module
from jointctl.tools.scoping import server as server_module
from jointctl.tools.scoping.feed import EVENT, PIECE, RECORDS, SETTINGS, Displays, ScopeFeed
from jointctl.tools.scoping.history import History
from tests.unit.scoping.scope_records import records


def snapshot(rows: Any) -> Snapshot:
    return Snapshot(rows[-1], 0, np.zeros((3, HISTOGRAM_BINS), np.int64), 1.0, True, rows)


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
            history.take_bytes(message[1:])
    assert kinds == [RECORDS] * -(-count // PIECE) + [EVENT]
    np.testing.assert_array_equal(history.newest(1e9), records(count))
    assert feed.dropped == 0


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
    with feed:  # nobody there when the run begins: told as well
        assert [request.values["count"] for request in feed.requests()] == [0]
    assert feed.stop_request() is StopRequest.NONE


@pytest.mark.parametrize(("limit_s", "expected"), [(None, StopRequest.NONE), (0.3, StopRequest.RAMP)])
def test_a_run_that_nobody_watches_brakes_if_that_is_wanted(
    ends: tuple[socket.socket, socket.socket], limit_s: float | None, expected: StopRequest
) -> None:
    feed = ScopeFeed(ends[0], unwatched_s=limit_s)
    ends[1].send(asked("viewers", count=0))
    time.sleep(0.4)
    assert feed.stop_request() is StopRequest.NONE  # nobody has been there yet
    for count in (1, 0, 1):
        ends[1].send(asked("viewers", count=count))
        assert feed.stop_request() is StopRequest.NONE
    time.sleep(0.4)
    assert feed.stop_request() is StopRequest.NONE  # somebody is there
    ends[1].send(asked("viewers", count=0))
    assert feed.stop_request() is StopRequest.NONE
    time.sleep(0.4)
    assert feed.stop_request() is expected
    assert feed.stop_reason() == ("the scope: no page open for 0.3 s" if limit_s else "")


@pytest.mark.parametrize(("limit_s", "expected"), [(None, StopRequest.NONE), (0.1, StopRequest.RAMP)])
def test_a_server_that_hangs_counts_as_nobody(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch, limit_s: float | None,
    expected: StopRequest,
) -> None:  # fmt: skip
    monkeypatch.setattr(feed_module, "SILENT_S", 0.5)
    feed = ScopeFeed(ends[0], unwatched_s=limit_s)
    for _ in range(6):  # longer than that, but the server repeats its word
        ends[1].send(asked("viewers", count=1))
        time.sleep(0.15)
        assert feed.stop_request() is StopRequest.NONE
    assert feed.requests() == []
    time.sleep(0.5)
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


@pytest.mark.parametrize("in_charge", [True, False])
def test_the_end_of_the_server_brakes_what_is_led_from_the_page(
    ends: tuple[socket.socket, socket.socket], in_charge: bool
) -> None:
    feed = ScopeFeed(ends[0], in_charge=in_charge)
    assert feed.stop_request() is StopRequest.NONE
    ends[1].close()
    assert feed.stop_request() is (StopRequest.RAMP if in_charge else StopRequest.NONE)
    (told,) = feed.requests()
    assert "server has ended" in told.values["text"]
    assert feed.requests() == []


def test_nobody_watching_is_an_event_and_a_line_in_the_terminal(tmp_path: Path) -> None:
    events: list[str] = []
    config = load_config(shipped_config("virtual"))
    orders = ViewerOrders(config, None, tmp_path / "a.mcap", {}, lambda level, text: events.append(text), lambda: None)
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
