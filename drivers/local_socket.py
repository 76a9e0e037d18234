"""Unix sockets between the programs of one computer: a name, the process at the other end, lines of JSON."""

from __future__ import annotations

import json
import os
import socket
import struct
from typing import Any

ANSWER_S = 1.0  # a program that lives answers at once
_LONGEST = 4096


def listener(address: bytes, waiting: int = 128) -> socket.socket:
    """A stream socket that holds `address` until it is closed; `OSError` where that cannot be, EADDRINUSE if taken."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        server.bind(address)
        server.listen(waiting)
    except OSError:
        server.close()
        raise
    return server


def process_behind(peer: socket.socket) -> tuple[int, int]:
    """(process, user) at the other end, as the kernel knows it."""
    pid, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, user


def may_ask(peer: socket.socket) -> bool:
    """Whether the process at the other end is of this user or root."""
    _, user = process_behind(peer)
    return user in (os.geteuid(), 0)


def send_line(peer: socket.socket, message: dict[str, Any]) -> None:
    """One message."""
    peer.sendall(json.dumps(message).encode() + b"\n")


def parsed_line(data: bytes) -> dict[str, Any] | None:
    """The message in a line; None where it is none."""
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def received_line(peer: socket.socket, timeout_s: float = ANSWER_S) -> dict[str, Any] | None:
    """One message; None where none comes in time or it is none."""
    peer.settimeout(timeout_s)
    data = b""
    try:
        while not data.endswith(b"\n") and len(data) < _LONGEST:
            part = peer.recv(1)
            if not part:
                break
            data += part
    except OSError:
        return None
    return parsed_line(data)
