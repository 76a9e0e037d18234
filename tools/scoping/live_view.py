"""What the servers of Foxglove and ROS 2 have in common: log records at 100 Hz, wall-clock times, the way back.

A `LiveView` is the `Watcher` of its feed; its `Publisher` puts what it is given onto the wire.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.drivers.printable import one_line, printable
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.output import Output
from jointctl.tools.recording.ros_messages import CDR_HEADER, event_body, joint_states
from jointctl.tools.recording.run_log import Event
from jointctl.tools.scoping.history import printable_values
from jointctl.tools.scoping.remote import READY, RemoteOrder
from jointctl.tools.scoping.supervisor_link import NICE, Feed, SetPointLink
from jointctl.tools.session.display import ViewerRequest

RATE_HZ = 100
_PERIOD_NS = 1_000_000_000 // RATE_HZ
NOT_TAKEN = "not taken: jointctl does not listen"


class Publisher(Protocol):
    """One kind of server; called in the thread of the feed.  Bodies are CDR, as they stand in the log."""

    def states(self, record: np.void, body: bytes, wall_ns: int) -> None:
        """A log record and the sensor_msgs/msg/JointState of it, a hundred times a second; its time since 1970."""

    def event(self, event: Event, body: bytes, wall_ns: int) -> None:
        """What has happened, and the rcl_interfaces/msg/Log of it."""

    def settings(self) -> None:
        """`LiveView.settings` have changed: stage, gains, motion."""


class LiveView:
    """Passes on what comes from the supervisor."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self.settings: dict[str, Any] = {}
        self.ended, self.heard_s = False, time.monotonic()
        self._wall_ns = time.time_ns() - time.monotonic_ns()
        self._slot = 0

    def take_bytes(self, body: bytes) -> None:
        """Of each hundredth of a second the first record."""
        records = np.frombuffer(body, dtype_of(LogRecord))
        slots = records["time_ns"] // _PERIOD_NS
        records = records[np.diff(slots, prepend=self._slot) != 0]
        self._slot = int(slots[-1])
        for record, state in zip(records, joint_states(records, self._wall_ns), strict=True):
            body = CDR_HEADER + state.tobytes()
            self._publisher.states(record, body, int(record["time_ns"]) + self._wall_ns)

    def take_event(self, event: Event) -> None:
        """See `Watcher`."""
        shown = replace(event, source=printable(event.source), text=printable(event.text))
        wall_ns = event.time_ns + self._wall_ns
        body = CDR_HEADER + event_body(wall_ns, shown.level, shown.source, shown.text)
        self._publisher.event(shown, body, wall_ns)

    def take_settings(self, found: Mapping[str, Any]) -> None:
        """See `Watcher`."""
        self.settings.update(printable_values(found))
        self._publisher.settings()

    def begin(self) -> None:
        """See `Watcher`: a new run goes on where the last one was."""


class WayBack:
    """To the supervisor: STOP, requests, set-points."""

    def __init__(self, order: RemoteOrder, view: LiveView, refused: Callable[[str, str], None]) -> None:
        self._feed = Feed(socket.socket(fileno=order.feed_fd), view)
        self._set_points = SetPointLink(socket.socket(fileno=order.set_points_fd), refused)
        self.set_point = self._set_points.send

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
        """A request; whether it was taken."""
        return self._feed.ask(ViewerRequest(kind, who, values or {}))


def serve_order(serve: Callable[[RemoteOrder], None]) -> int:
    """Entry point of a server's process."""
    os.nice(NICE)
    order = RemoteOrder(**json.loads(sys.stdin.buffer.read()))
    try:
        serve(order)
    except Exception as error:  # of the libraries: anything
        Output().error(one_line(f"{order.place}: {error}"))
        return DataError.exit_code
    return 0
