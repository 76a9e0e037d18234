"""The supervisor's end: log records and events out, the word of the STOP button back."""

from __future__ import annotations

import contextlib
import json
import secrets
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import Any, Self

from drivers.errors import DataError
from firmware_py.states import StopRequest
from tools.recording.run_log import Event
from tools.running.live_panel import Display, Snapshot
from tools.running.viewer_request import LONGEST_BYTES, ViewerRequest, decoded

RECORDS, EVENT, SETTINGS = b"R", b"E", b"S"  # first byte of a message
REQUESTS = 16  # of viewers, at most between two looks
PIECE = 64  # records a message; less than the buffer of the socket
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class ScopeOrder:
    """What the server is told."""

    title: str
    host: str
    port: int
    token: str  # "" = none is asked for
    cia402: bool = True
    feed_fd: int = -1  # -1: show `log` instead
    log: str = ""

    @property
    def url(self) -> str:
        """What to open."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")


def scope_order(title: str, host: str, port: int, **more: Any) -> ScopeOrder:
    """A checked order; beyond this computer a token is made.  `DataError` if the scope cannot be served."""
    if find_spec("nicegui") is None:
        raise DataError("the scope needs the package nicegui, which is not installed", "install the extra `scope`")
    if not 1 <= port <= 65535:
        raise DataError(f"--port (={port}) must be in [1..65535]")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise DataError(
            f"the scope cannot be served at {host}:{port}: {error.strerror or error}", "choose another --port"
        ) from None
    token = "" if host in LOOPBACK else secrets.token_urlsafe(16)
    return ScopeOrder(title, host, port, token, **more)


class ScopeFeed:
    """A `Display` that passes everything on to the server; nothing in it raises or waits."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        end.setblocking(False)
        self.dropped = 0  # messages
        self._asked = StopRequest.NONE
        self._requests: deque[ViewerRequest] = deque(maxlen=REQUESTS)

    def _send(self, kind: bytes, body: bytes) -> None:
        try:
            self._end.send(kind + body)
        except OSError:  # full, or the server has gone
            self.dropped += 1

    def note(self, text: str) -> None:
        """Remarks are events as well."""

    def phase(self, text: str) -> None:
        """So are phases."""

    def show(self, snapshot: Snapshot) -> None:
        """Pass on the records of the snapshot."""
        for at in range(0, len(snapshot.records), PIECE):
            self._send(RECORDS, snapshot.records[at : at + PIECE].tobytes())

    def event(self, event: Event) -> None:
        """Pass on an event."""
        self._send(EVENT, json.dumps(asdict(event)).encode())

    def settings(self, values: Mapping[str, Any]) -> None:
        """Tell the pages what can be changed, or in which stage things are."""
        self._send(SETTINGS, json.dumps(dict(values)).encode())

    def _receive(self) -> None:
        with contextlib.suppress(OSError):
            while word := self._end.recv(LONGEST_BYTES):
                if word in (b"1", b"2"):
                    self._asked = max(self._asked, StopRequest(int(word)))
                elif (request := decoded(word)) is not None:
                    self._requests.append(request)

    def stop_request(self) -> StopRequest:
        """The strongest stop that a viewer has asked for."""
        self._receive()
        return self._asked

    def requests(self) -> Sequence[ViewerRequest]:
        """What viewers have asked for since the last call."""
        self._receive()
        found = list(self._requests)
        self._requests.clear()
        return found

    def forget(self) -> None:
        """A new run is being prepared: what was asked for before was for another one."""
        self._receive()
        self._requests.clear()
        self._asked = StopRequest.NONE

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The server sees the end of the socket when the process that owns it is done with it."""


class Displays:
    """Several displays as one."""

    def __init__(self, displays: Sequence[Display]) -> None:
        self._displays = displays
        self._stack = contextlib.ExitStack()

    def note(self, text: str) -> None:
        """See `Display`."""
        for display in self._displays:
            display.note(text)

    def phase(self, text: str) -> None:
        """See `Display`."""
        for display in self._displays:
            display.phase(text)

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`."""
        for display in self._displays:
            display.show(snapshot)

    def event(self, event: Event) -> None:
        """See `Display`."""
        for display in self._displays:
            display.event(event)

    def stop_request(self) -> StopRequest:
        """See `Display`."""
        return max(display.stop_request() for display in self._displays)

    def requests(self) -> Sequence[ViewerRequest]:
        """See `Display`."""
        return [request for display in self._displays for request in display.requests()]

    def settings(self, values: Mapping[str, Any]) -> None:
        """See `Display`."""
        for display in self._displays:
            display.settings(values)

    def __enter__(self) -> Self:
        for display in self._displays:
            self._stack.enter_context(display)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave all of them."""
        self._stack.close()


@contextmanager
def scope_server(order: ScopeOrder) -> Iterator[ScopeFeed]:
    """The server process for one run; it ends by itself a moment after this does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fed = ScopeOrder(**{**asdict(order), "feed_fd": theirs.fileno()})
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "tools.scoping.server", json.dumps(asdict(fed))],
        pass_fds=(theirs.fileno(),),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # keys that a terminal turns into signals are for the supervisor
    )
    theirs.close()
    try:
        yield ScopeFeed(ours)
    finally:
        ours.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
