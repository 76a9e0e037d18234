"""What `jointctl stop` leaves for a program that takes the lock of its bus later.

`stop` writes its note, and then asks the program that holds the lock; a program takes the lock, and then reads the
notes.  Whatever their order, one of the two sees the other: no one has to know who is about to start, nor to wait.

A note counts once, for each program that runs when it is written: for the next bus of that name that it takes.  It is a
file in the memory of this computer: the time by the clock that no standby stops, and the processes that the stop came
from.  Those of this user and of root count, for a day.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

FOLDER = Path("/dev/shm")
LOCKS = "jointctl-bus-"  # what the name of each lock begins with
KEPT_S = 86_400.0  # no program takes so long from its start to its bus
MOST = 64  # that are kept of a lock
SHARED_S = 60.0
_LONGEST = 4096  # bytes of a note
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # what is there may not be seen


class _Note(NamedTuple):
    time_ns: int
    began_ns: int  # it is for those that began since then; 0 = for all
    by: frozenset[str]  # the process of that stop, and those that it descends from, as `_process`


_settled_ns: dict[str, int] = {}  # for each lock: up to then this process knows of the stops
_anew_ns = 0  # when a user has asked this process for what it does next: what was before is over
_asked_ns: int | None = None  # when a program of the user's has asked for the joint; a verb is asked by its start


def now_ns() -> int:
    """CLOCK_BOOTTIME [ns], as the kernel dates its processes."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def asked(at_ns: int) -> None:
    """The program has asked for the joint at `at_ns`: stops that come from itself count since then only."""
    global _asked_ns
    _asked_ns = at_ns


def asked_anew(at_ns: int) -> None:
    """A user, who knows of the stops before, has asked this process at `at_ns`: as by a button of the page."""
    global _anew_ns
    _anew_ns = at_ns


def settle(lock: str) -> None:
    """The stops of this lock until now have reached what this process does."""
    _settled_ns[lock] = now_ns()


def write_note(lock: str, began_ns: int = 0) -> int:
    """From now on no program that runs already, and began after `began_ns`, gets on with this lock unseen; its time.

    `OSError` if it cannot be kept.  Loads and looks for nothing: the drive is still to be stopped.
    """
    written_ns = now_ns()
    path = FOLDER / f"{_prefix(lock)}{written_ns}-{os.getpid()}"
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    try:
        os.fchmod(fd, 0o644)  # whatever the umask: root's counts for everyone
        os.write(fd, " ".join((lock, str(written_ns), str(began_ns), *map(_process, _ancestors()))).encode())
    except BaseException:
        path.unlink()
        raise
    finally:
        os.close(fd)
    return written_ns


def remove_old(lock: str) -> None:
    """Those that count no longer, of all locks, and of this one what is more than `MOST`."""
    every = [(note, path) for path in _files(f"{LOCKS}*") if (note := _read(path)) is not None]
    outdated = [path for note, path in every if not _is_valid(note)]
    newest_first = sorted(((note.time_ns, path) for note, path in every if path.name.startswith(_prefix(lock))))[::-1]
    for path in [path for _, path in newest_first[MOST:]] + outdated:
        with contextlib.suppress(OSError):  # another stop was quicker, or it is root's
            path.unlink()


def stopped(lock: str) -> bool:
    """Whether a stop has come that this process does not know of (`settle`); to be called while it holds the lock.

    A stop that came from this process itself, as by `subprocess.run`, counts only after it has asked for the joint.
    """
    me, began_ns, settled_ns = _process(os.getpid()), max(_began_ns(), _anew_ns), _settled_ns.get(lock, 0)

    def counts(note: _Note) -> bool:
        since_ns = _asked_ns if me in note.by else began_ns
        is_for_it = since_ns is not None and note.time_ns >= since_ns and began_ns >= note.began_ns
        return is_for_it and note.time_ns > settled_ns and _is_valid(note)

    return any(counts(note) for note in map(_read, _files(lock)) if note is not None)


def _prefix(lock: str) -> str:
    return f"{lock}-stop-"


def _files(lock: str) -> Iterator[Path]:
    with contextlib.suppress(OSError):
        yield from FOLDER.glob(f"{_prefix(lock)}*")


def _is_valid(note: _Note) -> bool:
    return 0 <= now_ns() - note.time_ns <= KEPT_S * 1e9


def _read(path: Path) -> _Note | None:
    """None where it is no note, not one of ours, or not yet written: its stop has not asked for the lock then."""
    with contextlib.suppress(ValueError):
        try:
            fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            if error.errno in EXHAUSTED:
                raise
            return None
        try:
            about = os.fstat(fd)
            ours = stat.S_ISREG(about.st_mode) and about.st_uid in (os.geteuid(), 0)
            # what others may write to is no one's; what they have linked to this name has another one inside
            if ours and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                lock, time_ns, began_ns, *by = os.read(fd, _LONGEST).decode("ascii").split()
                if path.name.startswith(_prefix(lock)):
                    return _Note(int(time_ns), int(began_ns), frozenset(by))
        finally:
            os.close(fd)
    return None


# --- Processes and their dates ---


def _status(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name of the program, which may contain anything (proc(5))."""
    return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].decode("ascii").split()


def _process(pid: int) -> str:
    """With its date: another one may have the same number, later or in a container."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return f"{pid}:{_status(pid)[19]}"
    return f"{pid}:"


def _started_ns(pid: int) -> int:
    """When a process began, by the clock of the notes; up to one tick of the kernel's early.  0 where no one knows."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(_status(pid)[19]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    return 0


_first_ns = _started_ns(os.getpid())  # a process that is forked inherits what it acts for, and this date


def _began_ns() -> int:
    """When this program began: with the process that has started this one to share its work, where there is one.

    A minute before itself at most: what is started later than that after a stop is asked for anew.
    """
    own_ns = _started_ns(os.getpid())
    began_ns = min(_first_ns, own_ns)
    if (shared := sys.modules.get("multiprocessing.process")) is not None:
        parent = shared.parent_process()
        if parent is not None and (parents_ns := _started_ns(parent.pid)):
            began_ns = min(began_ns, parents_ns)
    return max(began_ns, own_ns - round(SHARED_S * 1e9))


def _ancestors() -> Iterator[int]:
    """This process and those that it descends from, as far as they are in its container."""
    pid = os.getpid()
    with contextlib.suppress(OSError, ValueError, IndexError):
        while pid > 0:
            yield pid
            pid = int(_status(pid)[1])
