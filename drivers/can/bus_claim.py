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
import struct
import sys
from typing import Self

from drivers.can.serial_adapter import port_path
from drivers.can.virtual_bus import socket_path
from drivers.errors import BusError
from drivers.port_users import program_name

_IN_PROCESS = "virtual"  # python-can's bus of this name ends with the process: nobody else can be on it


class BusClaim:
    """Held until `close`; `BusError` names the program that has it.  No claim where the system has no such sockets."""

    def __init__(self, interface: str, channel: str) -> None:
        self._socket: socket.socket | None = None
        if sys.platform != "linux" or interface == _IN_PROCESS:
            return
        address = bus_address(interface, channel)
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            claim.bind(address)
            claim.listen()
        except OSError as error:
            claim.close()
            if error.errno != errno.EADDRINUSE:
                return
            raise BusError(
                f"another program controls {interface}:{channel}{_holder_text(address)}",
                "only one controller may use a bus: end it first; `jointctl stop` switches its drive off",
            ) from None
        self._socket = claim

    def close(self) -> None:
        """Leave the bus to others; may be called twice."""
        if self._socket is not None:
            self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def bus_address(interface: str, channel: str) -> bytes:
    """Of the bus itself, whatever links lead to it."""
    if interface == "jointctl":
        channel = os.path.realpath(socket_path(channel))
    elif interface == "slcan":
        channel = os.path.realpath(port_path(channel))
    return b"\0jointctl-bus-" + hashlib.sha256(f"{interface}:{channel}".encode()).hexdigest()[:32].encode()


def _holder_text(address: bytes) -> str:
    """` (jointctl, pid 1234)`; empty where it has just gone."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as peer:
        peer.settimeout(1.0)
        peer.connect(address)
        pid, _, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return f" ({program_name(pid)}, pid {pid})"
    return ""
