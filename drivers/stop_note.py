"""What `jointctl stop` leaves for a program that was started before it and takes the lock of its bus later.

`stop` writes its note, and then asks the program that holds the lock; a program takes the lock, and then reads the
notes.  Whatever their order, one of the two sees the other: no one has to know who is about to start, nor to wait.

A note is a file in the memory of this computer: the time by the clock that no standby stops, and the processes that
the stop came from.  It stays until the next stop of that bus, or for a day.  Those of this user and of root count.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

FOLDER = Path("/dev/shm")
KEPT_S = 86_400.0  # no program takes so long from its start to its bus
STARTING_S = 60.0  # a Python program that has not asked for its joint for so long was not started for it
_LONGEST = 4096  # bytes of a note


class _Note(NamedTuple):
    time_ns: int
    by: frozenset[int]  # the process of that stop, and those that it descends from


_asked_ns: int | None = (
    None  # when this process was asked for what it does; None = when it was started, as each verb is
)
_by_hand = False  # whether nothing that came before that counts
_served: set[str] = set()  # locks that it has had, or has given up for a note


def now_ns() -> int:
    """CLOCK_BOOTTIME [ns], as the kernel dates its processes."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def asked(at_ns: int, *, by_hand: bool = False) -> None:
    """This process was asked by its user at `at_ns`, for the lock that it takes next.

    For what lives on from one request to the next: a Python program, a page.  `by_hand`: by a press, so that a stop
    before it does not count, though the process was started before that.
    """
    global _asked_ns, _by_hand
    _asked_ns, _by_hand = at_ns, by_hand


def write_note(lock: str) -> None:
    """From now on no program that was started or asked before gets on with this lock; `OSError` if it cannot be kept.

    Loads and looks for nothing: the drive is still to be stopped.
    """
    written_ns = now_ns()
    path = FOLDER / f"{_prefix(lock)}{written_ns}-{os.getpid()}"
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    with open(fd, "wb") as file:
        os.fchmod(fd, 0o644)  # whatever the umask: root's counts for everyone
        file.write(" ".join(map(str, (written_ns, *_ancestors(os.getpid())))).encode())


def remove_older(lock: str) -> None:
    """All notes but the newest of this lock, and of every other lock those that are older than `KEPT_S`."""
    notes = [(note.time_ns, path) for path in _files(lock) if (note := _read(path)) is not None]
    long_ago_ns = now_ns() - KEPT_S * 1e9
    every = ((path, _read(path)) for path in _files("jointctl-bus-*"))
    outdated = [path for path, note in every if note is not None and note.time_ns < long_ago_ns]
    for path in [path for _, path in sorted(notes)[:-1]] + outdated:
        with contextlib.suppress(OSError):  # another stop was quicker, or it is root's
            path.unlink()


def stopped(lock: str) -> bool:
    """Whether a stop has come since this process was asked; to be called while it holds the lock.

    A stop that came from this process itself, as by `subprocess.run`, counts only after it was asked for the joint.
    """
    pid, first = os.getpid(), lock not in _served
    _served.add(lock)
    try:
        started_ns = _started_ns()
    except (OSError, ValueError, IndexError):  # no such files: then there are no locks either
        return False
    for note in filter(None, map(_read, _files(lock))):
        since_ns = started_ns
        if pid in note.by:
            since_ns = _asked_ns if _asked_ns is not None else note.time_ns + 1
        elif _asked_ns is not None and (_by_hand or not first or note.time_ns > started_ns + STARTING_S * 1e9):
            since_ns = _asked_ns
        if note.time_ns >= since_ns:
            return True
    return False


def _prefix(lock: str) -> str:
    return f"{lock}-stop-"


def _files(lock: str) -> Iterator[Path]:
    with contextlib.suppress(OSError):
        yield from FOLDER.glob(f"{_prefix(lock)}*")


def _read(path: Path) -> _Note | None:
    """None where it is no note, not one of ours, or not yet written: its stop has not asked for the lock then."""
    with contextlib.suppress(OSError, ValueError):
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(fd, "rb") as file:
            about = os.fstat(fd)
            if stat.S_ISREG(about.st_mode) and about.st_uid in (os.geteuid(), 0):
                time_ns, *by = map(int, file.read(_LONGEST).split())
                return _Note(time_ns, frozenset(by)) if time_ns <= now_ns() else None
    return None


def _status(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name of the program, which may contain anything (proc(5))."""
    return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].decode("ascii").split()


def _started_ns() -> int:
    """When this process began, by the same clock; up to one tick of the kernel's early."""
    return int(_status(os.getpid())[19]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")


def _ancestors(pid: int) -> Iterator[int]:
    """The process and those that it descends from, without the first of all."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        while pid > 1:
            yield pid
            pid = int(_status(pid)[1])
