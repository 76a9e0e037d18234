"""Speaking with the guard of a serial line from another terminal.

The guard listens on an abstract Unix socket named after the device: nothing is left behind, and the kernel tells each
side whose process the other is.  Asked by the same user or root only.  Messages are single lines of JSON:

    {"ask": "stop"}  ->  {"supervisor_pid": 123}   at once
                     ->  {"state": "off"}          once the run has ended
    {"ask": "who"}   ->  {"supervisor_pid": 123}
"""

from __future__ import annotations

import os
import socket

from jointctl.drivers.local_socket import ANSWER_S, may_ask, received_line, send_line

ENDED_S = 25.0  # for a run to end, and a drive that is silent to be tried again


def guard_address(port: str) -> bytes:
    """Of the device itself, whatever links lead to it.  Raises OSError where there is none."""
    found = os.stat(port)
    return b"\0jointctl-line-%x-%x" % (found.st_dev, found.st_rdev)


class GuardCall:
    """A call to the guard of a port; `supervisor_pid` is None where no run of ours has it, or its guard is mute."""

    def __init__(self, port: str, ask: str) -> None:
        self.supervisor_pid: int | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(ANSWER_S)
            self._socket.connect(guard_address(port))
            if not may_ask(self._socket):
                return
            send_line(self._socket, {"ask": ask})
        except OSError:
            return
        message = received_line(self._socket)
        if message is not None and isinstance(message.get("supervisor_pid"), int):
            self.supervisor_pid = message["supervisor_pid"]

    def __enter__(self) -> GuardCall:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def outcome(self) -> str | None:
        """The drive's state once the run has ended; None where nothing was heard of it."""
        message = received_line(self._socket, ENDED_S)
        return None if message is None else str(message.get("state"))


def running_supervisor(port: str) -> int | None:
    """Process id of the run that has the port."""
    with GuardCall(port, "who") as call:
        return call.supervisor_pid
