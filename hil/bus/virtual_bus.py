"""The virtual CAN bus: a hub to which many programs connect, and which hands every frame to all the others.

One AF_UNIX SEQPACKET datagram is one 16-byte `struct can_frame`.  The hub forwards in one thread, so that all
clients see all frames in the same order; a client does not get its own frames.  A client whose connect returned
before another client sent a frame gets that frame.  A client that does not read loses frames, which are counted,
and never holds up the others.

With `timing`, bit times and arbitration are modelled (`hil/bus/timing.py`) and a frame takes its time; a client that
sends faster than the bus finds its queue full.  Without it, frames are forwarded at once and only counted.

Not modelled: acknowledge (a lone node sends successfully), bit errors, error frames, error counters and bus-off,
overload frames, CAN FD, the delay and queueing inside an adapter.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import signal
import socket
import stat
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from jointctl.firmware_py.schema import new
from jointctl.hil.bus.forwarding import (
    CONNECTED,
    MAX_CLIENTS,
    NO_FD,
    POLL_COUNT,
    QUEUE_DEPTH,
    BusCounters,
    ClientCounters,
    run_hub,
    store_stop,
)
from jointctl.hil.bus.frames import WireFrame
from jointctl.hil.bus.timing import NO_NODE, Wire

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


def _lock(path: Path) -> int:
    """Descriptor of the locked file beside the socket; BlockingIOError when a hub holds it.

    The lock ends with its process, however that dies: whoever holds it may remove what a dead hub left.  A hub that
    stops removes the file while it holds the lock, so that a lock counts only if the file still has its name.
    """
    name = _lock_path(path)
    tries_left = _LOCK_TRIES
    while True:
        lock = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
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

    `bitrate_bitps` gives the bus load and, with `timing`, the duration of each frame.  `counters` and
    `client_counters` may be read at any time while the hub runs.
    """

    def __init__(self, path: str | os.PathLike[str], bitrate_bitps: int = 1_000_000, timing: bool = False) -> None:
        if not 1_000 <= bitrate_bitps <= 1_000_000:
            raise VirtualBusError(f"bitrate_bitps (={bitrate_bitps}) must be in [1000..1000000]")
        self.path = Path(path)
        if len(os.fsencode(self.path)) > _LONGEST_PATH:
            raise VirtualBusError(f"socket path (={self.path}) must have at most {_LONGEST_PATH} bytes")
        self.bitrate_bitps = bitrate_bitps
        self.timing = timing
        self._thread: threading.Thread | None = None
        self._stop_word = np.zeros(1, np.int64)
        self._reset()

    def _reset(self) -> None:
        self._stop_word[0] = 0
        self._bus = new(BusCounters)
        self._clients = new(ClientCounters, MAX_CLIENTS)
        self._clients["fd"] = NO_FD
        self._wire = new(Wire)
        self._wire["bitrate_bitps"] = self.bitrate_bitps
        self._wire["sender"] = NO_NODE

    def _arguments(self, listener_fd: int, wake_fd: int) -> tuple[Any, ...]:
        waiting = MAX_CLIENTS * QUEUE_DEPTH
        return (
            listener_fd,
            wake_fd,
            self.timing,
            self._stop_word,
            np.zeros(POLL_COUNT, np.int64),
            np.zeros(2, np.int64),
            self._clients,
            self._bus,
            self._wire,
            new(WireFrame),
            new(WireFrame),
            new(WireFrame, waiting),
            np.zeros(waiting, np.int64),
            np.zeros(MAX_CLIENTS, np.int64),
            np.zeros(MAX_CLIENTS, np.int64),
        )

    def start(self) -> VirtualBusHub:
        """Listen and forward; clients can connect when this returns.  VirtualBusError if a bus is already there."""
        if self._thread is not None:
            raise VirtualBusError(f"the virtual bus at {self.path} is already started")
        self._reset()
        self._stop_word[0] = 1
        run_hub(*self._arguments(NO_FD, NO_FD))  # compile or load before anybody can connect
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
        run_hub(*self._arguments(self._listener.fileno(), self._wake))

    def stop(self) -> None:
        """Disconnect all clients and remove the socket; does nothing if the hub does not run."""
        if self._thread is None:
            return
        store_stop(self._stop_word)
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def counters(self) -> Any:
        """A copy of the BusCounters record."""
        return self._bus.copy()[0]

    @property
    def client_counters(self) -> Any:
        """A copy of the ClientCounters records of the clients that are connected now, in the order of their slots."""
        clients = self._clients.copy()
        return clients[clients["state"] == CONNECTED]
