"""The supervisor's end of the scope: log records and events out; stops, requests and the number of open pages back."""

from __future__ import annotations

import contextlib
import json
import secrets
import select
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from jointctl.drivers.errors import DataError, UsageError, printable
from jointctl.drivers.stop_note import now_ns
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.drive_section import DEFAULT_KIND
from jointctl.tools.recording.ros_messages import JOINT_NAMES, StateCycles
from jointctl.tools.recording.run_log import Event
from jointctl.tools.session.display import LONGEST_BYTES, Display, Snapshot, ViewerRequest, decoded

if TYPE_CHECKING:
    from jointctl.tools.scoping.remote import RemoteOrder

RECORDS, EVENT, SETTINGS = b"R", b"E", b"S"  # first byte of a message; of records the second is the joint's number
REQUESTS = 16  # of viewers, at most between two looks
AT_ONCE = 64  # messages of a server that are read in one look: it must not hold the supervisor up
PIECE = 64  # records a message; less than the buffer of the socket
COUNT_AGAIN_S = 2.0  # how often the server tells the number of open pages, changed or not
SILENT_S = 3.0 * COUNT_AGAIN_S  # without that word nobody is there: the server hangs, and STOP with it
LATE_S = 4.0  # of what makes a joint move; such a word comes once a second, and waits for a second in the page's server
SERVER_SILENT = (
    f"no word from the scope's server for {SILENT_S:g} s: it counts as no page open; Ctrl-C or `jointctl stop` brakes"
)
SCOPE = "the scope"
OVER = "over"  # the last stage: the program ends as it should, and nothing moves any more
LAST_WORD_S = 1.0  # without it the pages fear that the joint may move
SHOW_END_S = 20.0  # at most, for pages on a busy computer to show the end; one that is cut off tries every 5 s
SERVER_ENDED = "{}'s server has ended: no {} shows or stops the joint"


@dataclass(frozen=True)
class ScopeOrder:
    """Launch arguments of the server: where to serve, to whom, and what."""

    title: str
    host: str
    port: int
    token: str  # without it nothing is shown or taken
    drive: str = DEFAULT_KIND  # drive.kind
    loop_cpu: int | None = None  # loop.cpu
    joints: tuple[str, ...] = JOINT_NAMES
    feed_fd: int = -1  # -1: show `log` instead
    log: str = ""

    @property
    def url(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/?token={self.token}"


def scope_order(title: str, host: str, port: int, **more: Any) -> ScopeOrder:
    """A checked order with a new token: other users of this computer, too, would reach a page without one.

    Raises `UsageError` for a wrong port, `DataError` if the scope cannot be served.
    """
    if find_spec("nicegui") is None:
        raise DataError("the scope needs the package nicegui, which is not installed", "install the extra `scope`")
    if not 1 <= port <= 65535:
        raise UsageError(f"--port (={port}) must be in [1..65535]")
    require_free("the scope", host, port, "choose another --port")
    return ScopeOrder(printable(title), host, port, secrets.token_urlsafe(16), **more)


def now_s() -> float:
    """By the clock that no standby stops: what was said before one is old afterwards."""
    return now_ns() * 1e-9


def in_time(request: ViewerRequest) -> bool:
    """Whether who asks had a word of this program no longer than LATE_S ago: its `told_s`, which comes back with it.

    What was held up on its way, or by a server, a program or a computer that stood still, comes when nobody expects it.
    """
    told_s = request.values.get("told_s")
    return isinstance(told_s, float) and 0.0 <= now_s() - told_s <= LATE_S


def require_free(what: str, host: str, port: int, hint: str) -> None:
    """`DataError` if it cannot be served there."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise DataError(f"{what} cannot be served at {host}:{port}: {error.strerror or error}", hint) from None


class ScopeFeed(Display):
    """Passes everything on to the server; nothing in it raises or waits.  Remarks and phases are events as well.

    `in_charge`: the run is led from the page, so it brakes when the server has ended.  `unwatched_s`: it brakes when no
    page has been open for so long; None = it goes on.  In any case it is reported in the terminal and the log.
    `takes`: the kinds of requests that are passed on besides STOP; None = all.  `states_s`: of each hundredth of a
    second only the first record is passed on, those of so long together: each message wakes server and clients, beside
    the loop.
    """

    def __init__(
        self,
        end: socket.socket,
        *,
        in_charge: bool = False,
        unwatched_s: float | None = None,
        server: str = SCOPE,
        takes: frozenset[str] | None = None,
        states_s: float | None = None,
    ) -> None:
        self._end, self._server, self._takes, self._states_s = end, server, takes, states_s
        self._held: dict[int, tuple[StateCycles, list[Any]]] = {}  # of each joint what goes with the next message
        self._next_s = 0.0
        end.setblocking(False)
        self._in_charge, self._unwatched_limit_s = in_charge, unwatched_s
        self.dropped = 0  # messages
        self.gone = False  # the server has ended
        self._asked = StopRequest.NONE
        self._reason = ""
        self._requests: deque[ViewerRequest] = deque(maxlen=REQUESTS)
        self._viewers = 0
        self._counted_s: float | None = None  # when the server reported their number last
        self._told: dict[str, Any] = {"temperature_degC": None}  # of the newest cycle, besides its records
        self._unwatched_since_s: float | None = None  # None: somebody watches, or nobody ever has

    def send(self, kind: bytes, body: bytes) -> None:
        """Pass one message on, or drop it."""
        try:
            self._end.send(kind + body)
        except OSError:  # full, or the server has gone
            self.dropped += 1

    def show(self, snapshot: Snapshot) -> None:
        shown: dict[str, Any] = {"temperature_degC": snapshot.temperature_degC}
        if self._states_s is not None:
            shown["skipped"] = snapshot.skipped  # a server of all records counts them
        if snapshot.axis == 0 and shown != self._told:
            self._told = shown
            self.settings(shown)
        if self._states_s is not None:
            self._hold(snapshot, self._states_s)
        else:
            self._send_records(snapshot.axis, snapshot.records)

    def _send_records(self, axis: int, records: np.ndarray) -> None:
        for at in range(0, len(records), PIECE):
            self.send(RECORDS, bytes([axis]) + records[at : at + PIECE].tobytes())

    def _hold(self, snapshot: Snapshot, states_s: float) -> None:
        cycles, held = self._held.setdefault(snapshot.axis, (StateCycles(), []))
        held.append(cycles.take(snapshot.records)[:, 0])
        if snapshot.axis == 0 and (now_s := time.monotonic()) >= self._next_s:
            self._next_s = max(self._next_s + states_s, now_s)
            self._let_go()

    def _let_go(self) -> None:
        for axis, (_, held) in self._held.items():
            if held:
                self._send_records(axis, np.concatenate(held))
                held.clear()

    def event(self, event: Event) -> None:
        self.send(EVENT, json.dumps(asdict(event)).encode())

    def settings(self, values: Mapping[str, Any]) -> None:
        """Tell the pages what can be changed, or in which stage things are."""
        self.send(SETTINGS, json.dumps(dict(values)).encode())

    def over(self) -> None:
        """The last stage; it waits for room, where other messages are dropped."""
        select.select([], [self._end], [], LAST_WORD_S)
        self.settings({"stage": OVER})

    def _receive(self) -> None:
        with contextlib.suppress(OSError):
            for _ in range(AT_ONCE):
                word = self._end.recv(LONGEST_BYTES)
                if not word:
                    self._server_ended()
                    break
                if (request := decoded(word)) is None:
                    continue
                if request.kind == "stop":
                    self._ask_stop(request.values.get("strength"), f"{self._server}'s STOP, {request.who}")
                elif request.kind == "viewers":
                    self._count_viewers(request.values.get("count"))
                elif self._takes is None or request.kind in self._takes:
                    self._requests.append(request)

    def _ask_stop(self, strength: object, reason: str) -> None:
        if strength not in (1, 2):
            return
        if self._asked is StopRequest.NONE:
            self._reason = reason
        self._asked = max(self._asked, StopRequest(strength))

    def _count_viewers(self, count: object, text: str = "") -> None:
        """A change between nobody and somebody is passed on as a request."""
        if not isinstance(count, int):
            return
        self._counted_s = time.monotonic()
        if count == self._viewers:
            return
        changed = (count > 0) is not (self._viewers > 0) and (count == 0 or self._unwatched_since_s is not None)
        self._viewers = count
        self._unwatched_since_s = None if count else time.monotonic()
        if changed:
            self._requests.append(ViewerRequest("viewers", "", {"count": count, "text": text}))

    def _check_silence(self) -> None:
        """Silence is no presence: from the last word on nobody is known to watch."""
        if self._viewers and self._counted_s is not None and time.monotonic() - self._counted_s > SILENT_S:
            last_s = self._counted_s
            self._count_viewers(0, SERVER_SILENT)
            self._counted_s = self._unwatched_since_s = last_s

    def _server_ended(self) -> None:
        if self.gone:
            return
        self.gone = True
        self._viewers = max(self._viewers, 1)  # reported whether or not a page was open
        ended = SERVER_ENDED.format(self._server, "page" if self._server == SCOPE else "client there")
        self._count_viewers(0, ended + (", braking" if self._in_charge else "; Ctrl-C or `jointctl stop` brakes"))
        if self._in_charge:
            self._ask_stop(1, f"the end of {self._server}'s server")

    def stop_request(self) -> StopRequest:
        """The strongest stop that a viewer, or the absence of viewers, has asked for."""
        self._receive()
        self._check_silence()
        limit_s, since_s = self._unwatched_limit_s, self._unwatched_since_s
        if limit_s is not None and since_s is not None and time.monotonic() - since_s >= limit_s:
            self._ask_stop(1, f"the scope: no page open for {limit_s:g} s")
        return self._asked

    def stop_reason(self) -> str:
        """Who asked first."""
        return self._reason

    def requests(self) -> Sequence[ViewerRequest]:
        self._receive()
        found = list(self._requests)
        self._requests.clear()
        return found

    def forget(self) -> None:
        """A new run is being prepared: what was asked for before was for another one."""
        self._receive()
        self._requests.clear()
        self._asked, self._reason = StopRequest.NONE, ""
        if self._unwatched_since_s is not None:
            self._unwatched_since_s = time.monotonic()

    def __enter__(self) -> Self:
        self.settings({"stage": "running"})
        if self._unwatched_since_s is not None and not any(found.kind == "viewers" for found in self._requests):
            self._requests.append(ViewerRequest("viewers", "", {"count": 0}))
        return self

    def __exit__(self, *_: object) -> None:
        """What is held back goes; the server sees the end of the socket when its owner is done with it."""
        self._let_go()


@contextmanager
def scope_server(
    order: ScopeOrder, *, in_charge: bool = False, unwatched_s: float | None = None
) -> Iterator[ScopeFeed]:
    """The server process; it ends by itself a moment after this does.  For the rest see `ScopeFeed`."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with server_process("jointctl.tools.scoping.server", replace(order, feed_fd=theirs.fileno()), [theirs], [ours]):
        feed = ScopeFeed(ours, in_charge=in_charge, unwatched_s=unwatched_s)
        try:
            yield feed
        finally:
            feed.over()


@contextmanager
def server_process(
    module: str, order: ScopeOrder | RemoteOrder, theirs: Sequence[socket.socket], ours: Sequence[socket.socket]
) -> Iterator[None]:
    """A process that serves a run: it gets `order`, a dataclass, on its standard input, and one end of each pair.

    It ends by itself when our ends are closed, which is done here.
    """
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", module],
        pass_fds=[end.fileno() for end in theirs],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # keys that a terminal turns into signals are for the supervisor
    )
    for end in theirs:
        end.close()
    assert process.stdin is not None
    with contextlib.suppress(OSError), process.stdin:  # a server that ends at once is noticed as any that has ended
        process.stdin.write(json.dumps(asdict(order)).encode())  # far less than a pipe holds
    try:
        yield
    finally:
        for end in ours:
            with contextlib.suppress(OSError):  # wakes a thread that reads it
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        try:
            process.wait(SHOW_END_S + 3.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
