"""The forwarding loop of the virtual CAN bus: one compiled function that does all the work of `hil/bus/virtual_bus.py`.

Nothing here allocates or holds the interpreter's lock.  Every frame that reaches the clients goes through
`_deliver`: a filter (loss, delay, duplication) belongs there.
"""

from __future__ import annotations

import errno as errno_codes
import socket
from typing import Any

import numpy as np
from numba.core import types

from jointctl.firmware_py import libc
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import errno, load_acquire, monotonic_ns, store_release
from jointctl.firmware_py.schema import i4, i8, record
from jointctl.hil.bus.frames import FRAME_SIZE
from jointctl.hil.bus.timing import NO_NODE, finish_frame, frame_bits, pend_frame

MAX_CLIENTS = 32
QUEUE_DEPTH = 64  # frames per client that wait for the bus (with timing)
POLL_COUNT = MAX_CLIENTS + 2
NO_FD = -1
FREE, CONNECTED, DRAINING = 0, 1, 2
_WAKE, _LISTENER = MAX_CLIENTS, MAX_CLIENTS + 1
_POLLRDHUP = 0x2000
_GONE = libc.POLLERR_POLLHUP | _POLLRDHUP
_ECONNABORTED = int(errno_codes.ECONNABORTED)
_ERROR_FRAME = 0x20000000
_MSG_TRUNC = 0x20
_SOL_SOCKET, _SO_SNDBUF = int(socket.SOL_SOCKET), int(socket.SO_SNDBUF)
_CLIENT_BUFFER_BYTES = 1 << 20  # the kernel limits it to net.core.wmem_max
_setsockopt = libc.external("setsockopt", types.int32, types.int32, types.int32, types.int32, types.uintp, types.uintp)


@record
class BusCounters:
    """What the bus did since its start.  `dropped` counts per receiver: one frame lost by two clients counts 2."""

    frames: i8
    bits: i8  # on the wire, exact, with stuff bits and interframe space
    dropped: i8
    malformed: i8  # datagrams of a wrong size, data length above 8, error frames
    clients: i8  # now
    accepted: i8
    refused: i8
    busy_ns: i8  # wire time of the frames at the bit rate
    work_ns: i8  # time that the hub itself worked


@record
class ClientCounters:
    """One slot of the hub: a client's descriptor (or -1) and what it sent and got since it connected."""

    fd: i4
    state: i4
    sent: i8
    delivered: i8
    dropped: i8
    malformed: i8


@kernel
def _poll_word(fd: int, wanted: bool) -> int:
    """`struct pollfd` as one little-endian word; descriptor -1 makes the system ignore the entry."""
    watched = np.int64(fd) if wanted else np.int64(NO_FD)
    return int((np.int64(libc.POLLIN | _POLLRDHUP) << 32) | (watched & 0xFFFFFFFF))


@kernel
def _accept(listener: int, clients: Any, bus: Any, scratch: Any) -> int:
    """Take one new client: 1 done, 0 none waits, -1 no descriptor left (do not ask again before one is closed)."""
    fd = libc.accept4(np.int32(listener), np.uintp(0), np.uintp(0), np.int32(libc.SOCK_NONBLOCK_CLOEXEC))
    if fd < 0:
        code = errno()
        return 0 if code == libc.EAGAIN or code == libc.EINTR or code == _ECONNABORTED else -1
    for node in range(MAX_CLIENTS):
        if clients[node].state == FREE:
            scratch[0] = _CLIENT_BUFFER_BYTES
            _setsockopt(
                np.int32(fd), np.int32(_SOL_SOCKET), np.int32(_SO_SNDBUF), np.uintp(scratch.ctypes.data), np.uintp(4)
            )
            clients[node].fd = fd
            clients[node].state = CONNECTED
            clients[node].sent = 0
            clients[node].delivered = 0
            clients[node].dropped = 0
            clients[node].malformed = 0
            bus[0].clients += 1
            bus[0].accepted += 1
            return 1
    bus[0].refused += 1
    libc.close(np.int32(fd))
    return 1


@kernel
def _read(node: int, hung_up: bool, clients: Any, bus: Any, frame: Any) -> bool:
    """Read one frame of a client into `frame[0]`; False if there is none.  A client that has left is closed."""
    got = libc.recv(
        np.int32(clients[node].fd),
        np.uintp(frame.ctypes.data),
        np.uintp(FRAME_SIZE),
        np.int32(libc.MSG_DONTWAIT | _MSG_TRUNC),
    )
    # 0 is either the end or an empty datagram: only the hang-up tells them apart.  An error (a reset because the
    # client died with unread frames) is told once, and frames that it sent before may still follow: read on.
    if got < 0 or (got == 0 and hung_up):
        if got == 0:
            libc.close(np.int32(clients[node].fd))
            clients[node].fd = NO_FD
            clients[node].state = DRAINING
            bus[0].clients -= 1
        return False
    if got != FRAME_SIZE or frame[0]["length"] > 8 or frame[0]["identifier"] & _ERROR_FRAME:
        clients[node].malformed += 1
        bus[0].malformed += 1
        return False
    clients[node].sent += 1
    return True


@kernel
def _deliver(sender: int, bits: int, bitrate_bitps: int, clients: Any, bus: Any, frame: Any) -> None:
    """Hand `frame[0]` to every client but its sender, without waiting for any of them."""
    for node in range(MAX_CLIENTS):
        if node != sender and clients[node].fd >= 0:
            done = libc.send(
                np.int32(clients[node].fd),
                np.uintp(frame.ctypes.data),
                np.uintp(FRAME_SIZE),
                np.int32(libc.MSG_DONTWAIT | libc.MSG_NOSIGNAL),
            )
            if done == FRAME_SIZE:
                clients[node].delivered += 1
            else:
                clients[node].dropped += 1
                bus[0].dropped += 1
    # Last, so that who sees the frame counted sees all its deliveries counted, too.
    bus[0].bits += bits
    bus[0].busy_ns = bus[0].bits * libc.NANOSECONDS // bitrate_bitps
    bus[0].frames += 1


@kernel
def run_hub(
    listener: int,
    wake: int,
    timing: bool,
    stop_word: Any,
    poll_words: Any,
    scratch: Any,
    clients: Any,
    bus: Any,
    wire: Any,
    frames: Any,
    on_wire: Any,
    pending: Any,
    arrival_ns: Any,
    heads: Any,
    counts: Any,
) -> None:
    """Forward frames until the stop word is set (and `wake` is readable).  Allocation-free; see VirtualBusHub."""
    accepting = True
    bitrate = wire[0].bitrate_bitps
    began_ns = monotonic_ns(scratch)
    while load_acquire(stop_word, 0) == 0:
        for node in range(MAX_CLIENTS):
            poll_words[node] = _poll_word(clients[node].fd, counts[node] < QUEUE_DEPTH)
        poll_words[_WAKE] = _poll_word(wake, True)
        # The listener is looked at last and served first: a client that connected before a frame was sent is
        # then always there when that frame is read (one frame of each client a round).
        poll_words[_LISTENER] = _poll_word(listener, accepting)
        now_ns = monotonic_ns(scratch)
        bus[0].work_ns += now_ns - began_ns
        timeout = np.uintp(0)
        if timing and wire[0].sender != NO_NODE:
            rest_ns = max(wire[0].delivered_ns - now_ns, 0)
            scratch[0] = rest_ns // libc.NANOSECONDS
            scratch[1] = rest_ns % libc.NANOSECONDS
            timeout = np.uintp(scratch.ctypes.data)
        ready = libc.ppoll(np.uintp(poll_words.ctypes.data), np.uintp(POLL_COUNT), timeout, np.uintp(0))
        began_ns = monotonic_ns(scratch)
        if ready > 0:
            if poll_words[_LISTENER] >> 48:
                # All that wait, as a frame that is read now may be younger than any of them.
                taken, limit = 1, 2 * MAX_CLIENTS
                while taken == 1 and limit > 0:
                    taken = _accept(listener, clients, bus, scratch)
                    limit -= 1
                accepting = taken >= 0
            for node in range(MAX_CLIENTS):
                happened = poll_words[node] >> 48
                if happened and _read(node, (happened & _GONE) != 0, clients, bus, frames):
                    if timing:
                        pend_frame(frames, node, began_ns, pending, arrival_ns, heads, counts)
                    else:
                        _deliver(node, frame_bits(frames, 0), bitrate, clients, bus, frames)
        while timing:
            sender = finish_frame(wire, began_ns, pending, arrival_ns, heads, counts, on_wire, frames)
            if sender == NO_NODE:
                break
            _deliver(sender, wire[0].bits, bitrate, clients, bus, frames)
        for node in range(MAX_CLIENTS):
            # A slot is used again only when the last frame of the client that left has been on the wire.
            if clients[node].state == DRAINING and counts[node] == 0 and wire[0].sender != node:
                clients[node].state = FREE
                accepting = True
    for node in range(MAX_CLIENTS):
        if clients[node].fd >= 0:
            libc.close(np.int32(clients[node].fd))
            clients[node].fd = NO_FD
            clients[node].state = FREE
    bus[0].clients = 0


@kernel
def store_stop(stop_word: Any) -> None:
    """Ask `run_hub` to end."""
    store_release(stop_word, 0, 1)
