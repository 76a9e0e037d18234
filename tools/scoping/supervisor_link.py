"""The server's end of the way to the supervisor: what it sends, and what viewers ask for.

Each server has a process of its own (the page, Foxglove, ROS 2); what it is to serve comes as JSON on its standard
input.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Protocol

import numpy as np

from jointctl.drivers.errors import DataError, one_line, printable
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.child_process import keep_off
from jointctl.tools.output import Output
from jointctl.tools.recording.ros_messages import CDR_HEADER, JOINT_NAMES, StateCycles, event_body, joint_states
from jointctl.tools.recording.run_log import Event
from jointctl.tools.scoping.feed import EVENT, RECORDS, SETTINGS
from jointctl.tools.scoping.history import printable_values
from jointctl.tools.scoping.remote import READY, RemoteOrder
from jointctl.tools.session.display import ViewerRequest
from jointctl.tools.session.set_points import RemoteSetPoint

LONGEST_BYTES = 1 << 20  # of a message
NICE = 5  # a viewer comes after the supervisor, but STOP has to arrive on a busy computer
AFTER_END_S = 1.5  # for clients to get the last messages
SET_POINTS_HZ = 1000.0  # of one server, at most
BURST = 100  # that may come at once
ASKS_HZ, ASKS_BURST = 20.0, 20  # of other requests: STOP has to find room behind them


class Watcher(Protocol):
    """What becomes of the messages; called in the thread of the feed."""

    settings: dict[str, Any]
    ended: bool
    heard_s: float  # when the last message came, time.monotonic

    def take_bytes(self, body: bytes, axis: int = 0) -> None:
        """Log records of a joint, as they stand in the log."""

    def take_event(self, event: Event) -> None:
        """One more event."""

    def take_settings(self, found: Mapping[str, Any]) -> None:
        """What else there is to know: stage, gains, motion."""

    def begin(self) -> None:
        """A new run."""


class Feed(threading.Thread):
    """Receives what the supervisor sends, until it closes the socket; then ends the server, `after_end_s` later or when
    the end is `shown`."""

    def __init__(self, end: socket.socket, watcher: Watcher, after_end_s: float = AFTER_END_S) -> None:
        super().__init__(name="feed", daemon=True)
        self._end, self._watcher, self._after_end_s = end, watcher, after_end_s
        self.shown = threading.Event()  # nobody needs the server any more
        self._stops = 0  # since the stage has changed

    def run(self) -> None:
        while True:
            try:
                message = self._end.recv(LONGEST_BYTES)
            except OSError:
                message = b""
            if not message:
                break
            if message[:1] == RECORDS:
                self._watcher.take_bytes(message[2:], message[1])
            elif message[:1] == EVENT:
                self._watcher.take_event(Event(**json.loads(message[1:])))
            elif message[:1] == SETTINGS:
                found = json.loads(message[1:])
                if found.get("stage") == "running" != self._watcher.settings.get("stage"):
                    self._watcher.begin()
                if found.get("stage", self._watcher.settings.get("stage")) != self._watcher.settings.get("stage"):
                    self._stops = 0
                self._watcher.take_settings(found)
            self._watcher.heard_s = time.monotonic()
        self._watcher.ended = True
        self.shown.wait(self._after_end_s)
        os._exit(0)  # the server itself would wait for every open page

    def stop(self, who: str) -> int:
        """A press of STOP: 1 brake, 2 quick stop if it was pressed before, 0 if the supervisor does not take it."""
        strength = 2 if self._stops else 1
        if not self.ask(ViewerRequest("stop", who, {"strength": strength})):
            return 0
        self._stops += 1
        return strength

    def ask(self, request: ViewerRequest) -> bool:
        """Pass on what a viewer asks for, without waiting; False if it is not taken."""
        try:
            self._end.send(request.encoded(), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True


class Allowance:
    """So many a second, of whatever clients send, and `burst` at once; from any thread."""

    def __init__(self, rate_Hz: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate_Hz, self._burst, self._clock = rate_Hz, burst, clock
        self._left, self._counted_s = float(burst), clock()
        self._lock = threading.Lock()

    def take(self) -> bool:
        """Whether one more may pass."""
        with self._lock:
            now_s = self._clock()
            self._left = min(self._burst, self._left + (now_s - self._counted_s) * self._rate_Hz)
            self._counted_s = now_s
            passes = self._left >= 1.0
            self._left -= 1.0 if passes else 0.0
            return passes


class SetPointLink:
    """Set-points to the supervisor; what it refuses comes back to `refused(who, words)`, in a thread.

    No more than SET_POINTS_HZ a second are passed on: a client that floods reaches neither supervisor nor loop.
    """

    def __init__(
        self, end: socket.socket, refused: Callable[[str, str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._end, self._refused = end, refused
        self._allowance = Allowance(SET_POINTS_HZ, BURST, clock)
        threading.Thread(target=self._listen, name="refusals", daemon=True).start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while message := self._end.recv(LONGEST_BYTES):
                who, words = json.loads(message)
                self._refused(who, words)

    def send(self, point: RemoteSetPoint) -> None:
        """Pass it on, or refuse it here."""
        if not self._allowance.take():
            self._refused(point.who, f"more than {SET_POINTS_HZ:g} set-points a second")
            return
        try:
            self._end.send(json.dumps(asdict(point)).encode(), socket.MSG_DONTWAIT)
        except OSError:
            self._refused(point.who, "not taken: jointctl does not listen, or cannot keep up")


# --- What the servers of Foxglove and ROS 2 have in common: log records at 100 Hz, wall-clock times, the way back ---
# A `LiveView` is the `Watcher` of its feed; its `Publisher` puts what it is given onto the wire.


NOT_TAKEN = "not taken: jointctl does not listen"


class Publisher(Protocol):
    """One kind of server; called in the thread of the feed.  Bodies are CDR, as they stand in the log."""

    def states(self, records: np.ndarray, body: bytes, wall_ns: int) -> None:
        """Log records of all joints, shape (joints,), and the sensor_msgs/msg/JointState of them, 100 times a second.

        `wall_ns`: their time since 1970.
        """

    def event(self, event: Event, body: bytes, wall_ns: int) -> None:
        """What has happened, and the rcl_interfaces/msg/Log of it."""

    def settings(self) -> None:
        """`LiveView.settings` have changed: stage, gains, motion."""


class LiveView:
    """Passes on what comes from the supervisor."""

    def __init__(self, publisher: Publisher, names: Sequence[str] = JOINT_NAMES) -> None:
        self._publisher, self._names = publisher, tuple(names)
        self._cycles = StateCycles(len(names))
        self.settings: dict[str, Any] = {}
        self.ended, self.heard_s = False, time.monotonic()
        self._wall_ns = time.time_ns() - time.monotonic_ns()

    def take_bytes(self, body: bytes, axis: int = 0) -> None:
        """Of each hundredth of a second the first cycle."""
        if axis >= len(self._names):
            return
        cycles = self._cycles.take(np.frombuffer(body, dtype_of(LogRecord)), axis)
        for records, state in zip(cycles, joint_states(cycles, self._wall_ns, self._names), strict=True):
            body = CDR_HEADER + state.tobytes()
            self._publisher.states(records, body, int(records[0]["time_ns"]) + self._wall_ns)

    def take_event(self, event: Event) -> None:
        shown = replace(event, source=printable(event.source), text=printable(event.text))
        wall_ns = event.time_ns + self._wall_ns
        body = CDR_HEADER + event_body(wall_ns, shown.level, shown.source, shown.text)
        self._publisher.event(shown, body, wall_ns)

    def take_settings(self, found: Mapping[str, Any]) -> None:
        self.settings.update(printable_values(found))
        self._publisher.settings()

    def begin(self) -> None:
        """See `Watcher`: a new run goes on where the last one was."""


class WayBack:
    """To the supervisor: STOP, requests, set-points."""

    def __init__(self, order: RemoteOrder, view: LiveView, refused: Callable[[str, str], None]) -> None:
        self._feed = Feed(socket.socket(fileno=order.feed_fd), view)
        self._link = SetPointLink(socket.socket(fileno=order.set_points_fd), refused)
        self._asks = Allowance(ASKS_HZ, ASKS_BURST)
        self.set_point = self._link.send

    def ready(self) -> None:
        """Clients can come from now on."""
        self.ask(READY, "server")

    def run(self) -> None:
        """Until the run ends: then the process ends."""
        self._feed.run()

    def stop(self, who: str) -> tuple[bool, str]:
        """A press of STOP: whether it was taken, and what it does."""
        strength = self._feed.stop(who)
        return strength > 0, ("", "STOP taken; again: quick stop", "STOP taken: quick stop")[strength] or NOT_TAKEN

    def ask(self, kind: str, who: str, values: Mapping[str, object] | None = None) -> bool:
        """A request; whether it was taken: of a flood only some are, so that a STOP still gets through."""
        return self._asks.take() and self._feed.ask(ViewerRequest(kind, who, values or {}))


def stand_aside(loop_cpu: int | None) -> None:
    """Niced, and off the loop's processor where that is fixed and there is another."""
    os.nice(NICE)
    keep_off(loop_cpu)


def serve_order(serve: Callable[[RemoteOrder], None]) -> int:
    """Entry point of a server's process."""
    order = RemoteOrder(**json.loads(sys.stdin.buffer.read()))
    stand_aside(order.loop_cpu)
    try:
        serve(order)
    except Exception as error:  # of the libraries: anything
        Output().error(one_line(f"{order.place}: {error}"))
        return DataError.exit_code
    return 0
