"""A program's word that it controls a bus: a second one on this computer is told who, before it has said anything.

SYNC gives a controller away only while its loop runs.  Before that, at commissioning and at the question whether the
joint may move, two programs would spoil each other's settings of the drive.

The word is an abstract Unix socket: the kernel takes it back however the program ends, and it belongs to the network
namespace, as SocketCAN's interfaces do.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import socket
import sys
import time
from typing import Self

from drivers.can.serial_adapter import port_path
from drivers.can.virtual_bus import socket_path
from drivers.errors import BusError
from drivers.local_socket import listener, process_behind
from drivers.port_users import program_name

_RELEASE_S = 0.05  # a process that was just started holds a copy until it has become another program
_IN_PROCESS = "virtual"  # python-can's bus of this name ends with the process: nobody else can be on it


class BusClaim:
    """Held until `close`; `BusError` names the program that has it.  No claim where the system has no such sockets."""

    def __init__(self, interface: str, channel: str) -> None:
        self._socket: socket.socket | None = None
        if sys.platform != "linux" or interface == _IN_PROCESS:
            return
        address = bus_address(interface, channel)
        with contextlib.suppress(OSError):
            self._socket = listener(address)
            return
        time.sleep(_RELEASE_S)
        try:
            self._socket = listener(address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                return
            raise BusError(
                f"another program controls {interface}:{channel}{_holder_text(address)}",
                "only one controller may use a bus: end it first; `jointctl stop` switches its drive off",
            ) from None

    def close(self) -> None:
        """Leave the bus to others; may be called twice."""
        if self._socket is not None:
            self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def bus_address(interface: str, channel: str) -> bytes:
    """Of the bus itself, whatever links lead to it, and whatever else has its name in another mount namespace."""
    place = f"{interface}:{channel}"
    if interface == "jointctl":
        path = socket_path(channel)
        place = f"{interface}:{path}"
        with contextlib.suppress(OSError):
            found = os.stat(path)
            place = f"{interface}:{found.st_dev:x}:{found.st_ino:x}"
    elif port_path(channel).startswith("/"):
        place = f"{interface}:{os.path.realpath(port_path(channel))}"
    return b"\0jointctl-bus-" + hashlib.sha256(place.encode()).hexdigest()[:32].encode()


def _holder_text(address: bytes) -> str:
    """` (jointctl, pid 1234)`; empty where it has just gone."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as peer:
            peer.settimeout(1.0)
            peer.connect(address)
            pid, _ = process_behind(peer)
    except OSError:
        return ""
    try:
        return f" ({program_name(pid)}, pid {pid})"
    except OSError:
        return f" (pid {pid})"
