"""Speaking with the guard of a serial line from another terminal.

The guard listens on an abstract Unix socket named after the device: nothing is left behind, and the kernel tells each
side whose process the other is.  Asked by the same user or root only.  Messages are single lines of JSON:

    {"ask": "stop"}  ->  {"supervisor_pid": 123}   at once
                     ->  {"state": "off"}          once the run has ended
    {"ask": "who"}   ->  {"supervisor_pid": 123}
"""

from __future__ import annotations

import json
import os
import socket
from typing import Any

from drivers.local_socket import process_behind

HEARD_S = 1.0  # a guard that lives answers at once
ENDED_S = 25.0  # for a run to end, and a drive that is silent to be tried again
_LONGEST = 4096


def guard_address(port: str) -> bytes:
    """Of the device itself, whatever links lead to it.  Raises OSError where there is none."""
    found = os.stat(port)
    return b"\0jointctl-line-%x-%x" % (found.st_dev, found.st_rdev)


def may_ask(peer: socket.socket) -> bool:
    """Whether the process at the other end is of this user or root."""
    _, user = process_behind(peer)
    return user in (os.geteuid(), 0)


def heard_line(peer: socket.socket, timeout_s: float = HEARD_S) -> dict[str, Any] | None:
    """One message; None where none comes in time or it is none."""
    peer.settimeout(timeout_s)
    data = b""
    try:
        while not data.endswith(b"\n") and len(data) < _LONGEST:
            part = peer.recv(1)
            if not part:
                break
            data += part
        message = json.loads(data)
    except (OSError, ValueError):
        return None
    return message if isinstance(message, dict) else None


class GuardCall:
    """A call to the guard of a port; `supervisor_pid` is None where no run of ours has it, or its guard is mute."""

    def __init__(self, port: str, ask: str) -> None:
        self.supervisor_pid: int | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(HEARD_S)
            self._socket.connect(guard_address(port))
            if not may_ask(self._socket):
                return
            self._socket.sendall(json.dumps({"ask": ask}).encode() + b"\n")
        except OSError:
            return
        message = heard_line(self._socket)
        if message is not None and isinstance(message.get("supervisor_pid"), int):
            self.supervisor_pid = message["supervisor_pid"]

    def __enter__(self) -> GuardCall:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def outcome(self) -> str | None:
        """The drive's state once the run has ended; None where nothing was heard of it."""
        message = heard_line(self._socket, ENDED_S)
        return None if message is None else str(message.get("state"))


def running_supervisor(port: str) -> int | None:
    """Process id of the run that has the port."""
    with GuardCall(port, "who") as call:
        return call.supervisor_pid
