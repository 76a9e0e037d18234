"""Unix sockets between the programs of one computer: a name that one of them holds, and who is at the other end."""

from __future__ import annotations

import socket
import struct


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
    """(process, user) at the other end, as the kernel tells it."""
    pid, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, user
