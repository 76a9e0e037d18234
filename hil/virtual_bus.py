"""The virtual CAN bus: a hub to which many programs connect, and which hands every frame to all the others.

One AF_UNIX SEQPACKET datagram is one 16-byte `struct can_frame`.  The hub forwards in one thread, so that all
clients see all frames in the same order; a client does not get its own frames.  A client whose connect returned
before another client sent a frame gets that frame.  A client that does not read loses frames, which are counted,
and never holds up the others.

With `timing`, bit times and arbitration are modelled (`hil/bus_timing.py`) and a frame takes its time; a client that
sends faster than the bus finds its queue full.  Without it, frames are forwarded at once and only counted.
That a busy computer holds the hub itself up is made up for with the stamps of `hil/bus_timing.py`.

Not modelled: acknowledge (a lone node sends successfully), bit errors, error frames, error counters and bus-off,
overload frames, CAN FD, the delay and queueing inside an adapter."""

from __future__ import annotations

import ctypes
import errno as errno_codes
import os
import re
import signal
import socket
import stat
import threading
import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from jointctl.firmware_py import libc
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import errno, load_acquire, monotonic_ns, store_release
from jointctl.firmware_py.schema import array_of, i4, i8, new, record, u1, u4
from jointctl.hil.bus_timing import (
    NO_NODE,
    SyncWatch,
    Waiting,
    Wire,
    finish_frame,
    note_sent,
    outlived,
    over,
    pend_frame,
    stamp_of,
)

# --- The virtual side's own statement of `struct can_frame` (16 bytes): identifier, length, three spare bytes, data ---
# Deliberately not shared with the drivers: a wrong constant on one side must not cancel out on the other.


FRAME_SIZE = 16
QUEUE_LENGTH = 32


@record
class WireFrame:
    identifier: u4
    length: u1
    spare: Annotated[np.ndarray, array_of(u1, 3)]
    payload: Annotated[np.ndarray, array_of(u1, 8)]


@record
class FrameQueue:
    """Frames waiting to be sent, in order; `count` of them are valid."""

    count: i4
    frames: Annotated[np.ndarray, array_of(u1, QUEUE_LENGTH, FRAME_SIZE)]


# --- The forwarding loop: one compiled function that does all the work ---
# Nothing here allocates or holds the interpreter's lock.  Every frame that reaches the clients goes through
# `_deliver`: a filter (loss, delay, duplication) belongs there.


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
_SO_TIMESTAMPNS = 35  # the system notes when a frame was sent; it is read with the frame
_CLOCK_REALTIME = 0  # of that note
_setsockopt = libc.external("setsockopt", "int32", "int32", "int32", "int32", "uintp", "uintp")


_recvmsg = libc.external("recvmsg", "intp", "int32", "uintp", "int32")
# words of the scratch: the clock's two, `struct msghdr`, `struct iovec`, and a control message of header and timespec
_MESSAGE, _VECTOR, _CONTROL, SCRATCH_WORDS = 2, 9, 11, 19
_CONTROL_BYTES = 64
_SENT_NOTE = _SO_TIMESTAMPNS << 32 | _SOL_SOCKET  # type and level of the control message


@record
class BusCounters:
    """What the bus did since its start.  `dropped` counts per receiver: one frame lost by two clients counts 2."""

    frames: i8
    dropped: i8
    malformed: i8  # datagrams of a wrong size, data length above 8, error frames
    late: i8  # answers left out, as the computer held them up until their SYNC was over
    clients: i8  # now


@record
class Client:
    """One slot of the hub."""

    fd: i4  # or NO_FD
    state: i4


@kernel
def _poll_word(fd: int, wanted: bool) -> int:
    """`struct pollfd` as one little-endian word; descriptor -1 makes the system ignore the entry."""
    watched = np.int64(fd) if wanted else np.int64(NO_FD)
    return int((np.int64(libc.POLLIN | _POLLRDHUP) << 32) | (watched & 0xFFFFFFFF))


@kernel
def _set_option(fd: int, option: int, value: int, scratch: np.ndarray) -> None:
    scratch[0] = value
    _setsockopt(np.int32(fd), np.int32(_SOL_SOCKET), np.int32(option), np.uintp(scratch.ctypes.data), np.uintp(4))


@kernel
def _accept(listener: int, clients: np.ndarray, bus: np.ndarray, scratch: np.ndarray) -> int:
    """Take one new client: 1 done, 0 none waits, -1 no descriptor left (do not ask again before one is closed)."""
    fd = libc.accept4(np.int32(listener), np.uintp(0), np.uintp(0), np.int32(libc.SOCK_NONBLOCK_CLOEXEC))
    if fd < 0:
        code = errno()
        return 0 if code == libc.EAGAIN or code == libc.EINTR or code == _ECONNABORTED else -1
    for node in range(MAX_CLIENTS):
        if clients[node].state == FREE:
            _set_option(fd, _SO_SNDBUF, _CLIENT_BUFFER_BYTES, scratch)
            _set_option(fd, _SO_TIMESTAMPNS, 1, scratch)
            clients[node].fd = fd
            clients[node].state = CONNECTED
            bus[0].clients += 1
            return 1
    libc.close(np.int32(fd))
    return 1


@kernel
def _receive(fd: int, frame: np.ndarray, scratch: np.ndarray) -> int:
    """recvmsg(2) of one frame; the control message follows in `scratch`."""
    address = scratch.ctypes.data
    scratch[_MESSAGE] = 0
    scratch[_MESSAGE + 1] = 0
    scratch[_MESSAGE + 2] = address + 8 * _VECTOR
    scratch[_MESSAGE + 3] = 1
    scratch[_MESSAGE + 4] = address + 8 * _CONTROL
    scratch[_MESSAGE + 5] = _CONTROL_BYTES
    scratch[_MESSAGE + 6] = 0
    scratch[_VECTOR] = frame.ctypes.data
    scratch[_VECTOR + 1] = FRAME_SIZE
    scratch[_CONTROL + 1] = 0
    flags = np.int32(libc.MSG_DONTWAIT | _MSG_TRUNC)
    return int(_recvmsg(np.int32(fd), np.uintp(address + 8 * _MESSAGE), flags))


@kernel
def _sent_ns(scratch: np.ndarray) -> int:
    """When the frame that `_receive` has just read was sent, on the clock of `monotonic_ns`; unknown: now."""
    noted, seconds, rest_ns = scratch[_CONTROL + 1] == _SENT_NOTE, scratch[_CONTROL + 2], scratch[_CONTROL + 3]
    libc.clock_gettime(np.int32(_CLOCK_REALTIME), np.uintp(scratch.ctypes.data))
    age_ns = (scratch[0] - seconds) * libc.NANOSECONDS + scratch[1] - rest_ns
    now_ns = monotonic_ns(scratch)
    return now_ns - age_ns if noted and 0 < age_ns < libc.NANOSECONDS else now_ns


@kernel
def _read(node: int, hung_up: bool, clients: np.ndarray, bus: np.ndarray, frame: Any, scratch: np.ndarray) -> bool:
    """Read one frame of a client into `frame[0]`; False if there is none.  A client that has left is closed."""
    got = _receive(clients[node].fd, frame, scratch)
    # 0 is either the end or an empty datagram: only the hang-up tells them apart.  An error (a reset because the
    # client died with unread frames) is reported once, and frames that it sent before may still follow: read on.
    if got < 0 or (got == 0 and hung_up):
        if got == 0:
            libc.close(np.int32(clients[node].fd))
            clients[node].fd = NO_FD
            clients[node].state = DRAINING
            bus[0].clients -= 1
        return False
    if got != FRAME_SIZE or frame[0]["length"] > 8 or frame[0]["identifier"] & _ERROR_FRAME:
        bus[0].malformed += 1
        return False
    return True


@kernel
def _deliver(sender: int, clients: np.ndarray, bus: np.ndarray, frame: np.ndarray) -> None:
    """Hand `frame[0]` to every client but its sender, without waiting for any of them."""
    for node in range(MAX_CLIENTS):
        if node != sender and clients[node].fd >= 0:
            done = libc.send(
                np.int32(clients[node].fd),
                np.uintp(frame.ctypes.data),
                np.uintp(FRAME_SIZE),
                np.int32(libc.MSG_DONTWAIT | libc.MSG_NOSIGNAL),
            )
            if done != FRAME_SIZE:
                bus[0].dropped += 1
    # Last, so that who sees the frame counted sees all its deliveries counted, too.
    bus[0].frames += 1


class HubMemory(NamedTuple):
    """What `run_hub` works on; record arrays of one element but for those of the clients."""

    stop_word: np.ndarray  # int64[1]
    poll_words: np.ndarray  # int64[POLL_COUNT]
    scratch: np.ndarray  # int64[SCRATCH_WORDS]
    clients: np.ndarray  # Client[MAX_CLIENTS]
    bus: np.ndarray  # BusCounters
    watch: np.ndarray  # SyncWatch
    wire: np.ndarray  # Wire
    frame: np.ndarray  # WireFrame: the one that is read or delivered
    frame_bytes: np.ndarray  # uint8[1, FRAME_SIZE]: the same memory
    on_wire: np.ndarray  # WireFrame
    waiting: Waiting  # with timing


@kernel
def _pass_on(memory: HubMemory, node: int, began_ns: int, timing: bool | None) -> None:
    """The frame that has been read from `node`, stamped, to the wire or to the clients; an answer too late to none."""
    frame, watch, now_ns = memory.frame_bytes[0], memory.watch[0], monotonic_ns(memory.scratch)
    stamp_us = stamp_of(frame)
    if stamp_us == 0:
        note_sent(watch, frame, node, _sent_ns(memory.scratch))
    elif over(watch, stamp_us, now_ns):
        memory.bus[0].late += 1
        return
    if timing is None:
        _deliver(node, memory.clients, memory.bus, memory.frame)
    else:
        pend_frame(memory.frame, node, began_ns, memory.waiting)


@kernel
def _finish_frames(memory: HubMemory, now_ns: int, timing: bool | None) -> None:
    """With `timing`, what has been on the wire for its time is delivered."""
    if timing is None:
        return
    wire, frames = memory.wire, memory.frame
    while True:
        sender = finish_frame(wire, now_ns, memory.waiting, memory.on_wire, frames)
        if sender == NO_NODE:
            break
        if outlived(memory.watch[0], memory.frame_bytes[0], sender, monotonic_ns(memory.scratch)):
            memory.bus[0].late += 1
            continue
        _deliver(sender, memory.clients, memory.bus, frames)


@kernel
def run_hub(listener: int, wake: int, timing: bool | None, memory: HubMemory) -> None:
    """Forward frames until the stop word is set (and `wake` is readable).  Allocation-free; see VirtualBusHub.

    `timing`: True, or None, and nothing of it is compiled.
    """
    poll_words, scratch, clients, bus, wire = (
        memory.poll_words, memory.scratch, memory.clients, memory.bus, memory.wire
    )  # fmt: skip
    frames, waiting = memory.frame, memory.waiting
    accepting = True
    while load_acquire(memory.stop_word, 0) == 0:
        for node in range(MAX_CLIENTS):
            poll_words[node] = _poll_word(clients[node].fd, waiting.counts[node] < QUEUE_DEPTH)
        poll_words[_WAKE] = _poll_word(wake, True)
        # The listener is looked at last and served first: a client that connected before a frame was sent is
        # then always there when that frame is read (one frame of each client a round).
        poll_words[_LISTENER] = _poll_word(listener, accepting)
        timeout = np.uintp(0)
        if timing is not None and wire[0].sender != NO_NODE:
            rest_ns = max(wire[0].delivered_ns - monotonic_ns(scratch), 0)
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
                if happened and _read(node, (happened & _GONE) != 0, clients, bus, frames, scratch):
                    _pass_on(memory, node, began_ns, timing)
        _finish_frames(memory, began_ns, timing)
        for node in range(MAX_CLIENTS):
            # A slot is used again only when the last frame of the client that left has been on the wire.
            if clients[node].state == DRAINING and waiting.counts[node] == 0 and wire[0].sender != node:
                clients[node].state = FREE
                accepting = True
    for node in range(MAX_CLIENTS):
        if clients[node].fd >= 0:
            libc.close(np.int32(clients[node].fd))
            clients[node].fd = NO_FD
            clients[node].state = FREE
    bus[0].clients = 0


@kernel
def store_release_word(words: np.ndarray, index: int, value: int) -> None:
    """`store_release` for callers in Python."""
    store_release(words, index, value)


# --- The virtual CAN bus: a hub to which many programs connect, and which hands every frame to all the others ---


_LONGEST_PATH = 107
_CHANNEL_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_PR_SET_TIMERSLACK = 29
_LOCK_TRIES = 5
_LOCK_PAUSE_S = 0.01


class VirtualBusError(Exception):
    """The virtual bus cannot be set up; one line."""


def default_socket_path(channel: str) -> Path:
    """Where the bus of this name listens, for this user: $XDG_RUNTIME_DIR/jointctl, else a folder per user in /tmp."""
    if not _CHANNEL_NAME.fullmatch(channel):
        raise VirtualBusError(f"channel (={channel!r}) must consist of letters, digits, '_', '-' and '.'")
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = Path(runtime) / "jointctl" if os.path.isdir(runtime) else Path(f"/tmp/jointctl-{os.getuid()}")
    return folder / f"{channel}.sock"


def _prepare_folder(path: Path) -> None:
    """Make the user's own folder (mode 0700), and refuse one that another user made; other folders must exist."""
    folder = path.parent
    if folder != default_socket_path("any").parent:
        if not folder.is_dir():
            raise VirtualBusError(f"folder of the virtual bus (={folder}) must exist")
        return
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = os.lstat(folder)
    except OSError as error:
        raise VirtualBusError(f"cannot make the folder of the virtual bus {folder}: {error.strerror}") from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise VirtualBusError(f"folder of the virtual bus (={folder}) must be a folder of this user with mode 0700")
    remove_dead_sockets(folder)


def _lock_path(path: Path) -> Path:
    return Path(f"{path}.lock")


def _take(lock: int) -> None:
    """The lock of an open file; BlockingIOError where another hub holds it."""
    from fcntl import LOCK_EX, LOCK_NB, flock  # not every system has it, and the simulation loads this module

    flock(lock, LOCK_EX | LOCK_NB)


def _lock(path: Path) -> int:
    """Descriptor of the locked file beside the socket; BlockingIOError when a hub holds it.

    The lock ends with its process, however that dies: its holder may remove what a dead hub left.  A hub that stops
    removes the file while it holds the lock, so that a lock counts only if the file still has its name.
    """
    name = _lock_path(path)
    tries_left = _LOCK_TRIES
    while True:
        lock = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            _take(lock)
            if os.path.samestat(os.fstat(lock), os.stat(name)):
                return lock
        except FileNotFoundError:  # between our open and our lock, its hub has stopped
            pass
        except BlockingIOError:
            tries_left -= 1
            if tries_left == 0:
                os.close(lock)
                raise
            time.sleep(_LOCK_PAUSE_S)  # who looks for dead hubs holds a lock for a moment
        os.close(lock)


def remove_dead_sockets(folder: Path) -> int:
    """Remove the sockets and lock files of hubs in `folder` that were killed; how many there were."""
    removed = 0
    for name in folder.glob("*.sock.lock"):
        try:
            lock = os.open(name, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            _take(lock)
            if os.path.samestat(os.fstat(lock), os.stat(name)):
                name.with_suffix("").unlink(missing_ok=True)
                name.unlink()
                removed += 1
        except OSError:  # its hub runs, or somebody else was faster
            pass
        finally:
            os.close(lock)
    return removed


class VirtualBusHub:
    """A running virtual bus at a socket path; use it as a context manager, or `start` and `stop`.

    `bitrate_bitps` gives, with `timing`, the duration of each frame.  `counters` may be read while the hub runs.
    """

    def __init__(self, path: str | os.PathLike[str], bitrate_bitps: int = 1_000_000, timing: bool = False) -> None:
        if not 1_000 <= bitrate_bitps <= 1_000_000:
            raise VirtualBusError(f"bitrate_bitps (={bitrate_bitps}) must be in [1000..1000000]")
        self.path = Path(path)
        if len(os.fsencode(self.path)) > _LONGEST_PATH:
            raise VirtualBusError(f"socket path (={self.path}) must have at most {_LONGEST_PATH} bytes")
        self.bitrate_bitps = bitrate_bitps
        self.timing = timing
        self._timed = True if timing else None
        self._thread: threading.Thread | None = None
        self._stop_word = np.zeros(1, np.int64)
        self._reset()

    def _reset(self) -> None:
        self._stop_word[0] = 0
        self._bus = new(BusCounters)
        self._clients = new(Client, MAX_CLIENTS)
        self._clients["fd"] = NO_FD
        self._wire = new(Wire)
        self._wire["bitrate_bitps"] = self.bitrate_bitps
        self._wire["sender"] = NO_NODE

    def _memory(self) -> HubMemory:
        length = MAX_CLIENTS * QUEUE_DEPTH
        frame = new(WireFrame)
        return HubMemory(
            stop_word=self._stop_word,
            poll_words=np.zeros(POLL_COUNT, np.int64),
            scratch=np.zeros(SCRATCH_WORDS, np.int64),
            clients=self._clients,
            bus=self._bus,
            watch=new(SyncWatch),
            wire=self._wire,
            frame=frame,
            frame_bytes=frame.view(np.ndarray).view(np.uint8).reshape(1, FRAME_SIZE),
            on_wire=new(WireFrame),
            waiting=Waiting(
                new(WireFrame, length),
                np.zeros(length, np.int64),
                np.zeros(MAX_CLIENTS, np.int64),
                np.zeros(MAX_CLIENTS, np.int64),
            ),
        )

    def start(self) -> VirtualBusHub:
        """Listen and forward; clients can connect when this returns.  VirtualBusError if a bus is already there."""
        if self._thread is not None:
            raise VirtualBusError(f"the virtual bus at {self.path} is already started")
        self._reset()
        self._stop_word[0] = 1
        run_hub(NO_FD, NO_FD, self._timed, self._memory())  # compile or load before anybody can connect
        self._reset()
        self._listen()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._thread = threading.Thread(target=self._run, name=f"virtual bus {self.path.name}", daemon=True)
        self._thread.start()
        return self

    def _listen(self) -> None:
        _prepare_folder(self.path)
        try:
            lock = _lock(self.path)
        except BlockingIOError:
            raise VirtualBusError(f"a virtual bus already runs at {self.path}") from None
        except OSError as error:
            raise VirtualBusError(f"cannot listen at {self.path}: {error.strerror or error}") from None
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            if self.path.is_socket():
                self.path.unlink()
            listener.bind(str(self.path))
            self.path.chmod(0o600)
            listener.listen(MAX_CLIENTS)
        except OSError as error:
            listener.close()
            os.close(lock)
            raise VirtualBusError(f"cannot listen at {self.path}: {error.strerror or error}") from None
        self._lock, self._listener = lock, listener

    def _run(self) -> None:
        # Signals are for the main thread, which would not wake up if this one took them.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        if self.timing:
            # The default slack of a timer is 50 us, as long as a short frame at 1 Mbit/s.
            ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1))
        run_hub(self._listener.fileno(), self._wake, self._timed, self._memory())

    def stop(self) -> None:
        """Disconnect all clients and remove the socket; does nothing if the hub does not run."""
        if self._thread is None:
            return
        store_release_word(self._stop_word, 0, 1)  # `run_hub` ends
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        self._thread = None
        self.path.unlink(missing_ok=True)
        self._listener.close()
        os.close(self._wake)
        _lock_path(self.path).unlink(missing_ok=True)
        os.close(self._lock)

    def __enter__(self) -> VirtualBusHub:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def counters(self) -> Any:
        return self._bus.copy()[0]
