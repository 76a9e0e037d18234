"""Who has a serial port open, and what a process is called: asked of the system; what a forked process does not get."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar
from weakref import WeakSet

# --- A process that is forked from a controller would keep its locks, also when the controller has gone ---


class HasDescriptor(Protocol):
    """A socket, a file, a port or a bus."""

    def fileno(self) -> int: ...


Held = TypeVar("Held", bound=HasDescriptor)
_held: WeakSet[HasDescriptor] = WeakSet()


def keep_from_forks(held: Held) -> Held:
    """The same; processes that are forked have the null device in its place, its number stays theirs to close."""
    _held.add(held)
    return held


def _let_go() -> None:
    for held in list(_held):
        with contextlib.suppress(Exception):  # closed already, as its library says it
            number = held.fileno()
            os.close(number)  # before another one is opened: there may be no room for one more
            null = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
            if null != number:
                os.dup2(null, number, inheritable=False)
                os.close(null)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


# --- Who has a port ---

# who has one of these keeps up a pseudo-terminal, as `jointctl hil --serial` does, and is no user of it
_TERMINAL_MAKERS = {"/dev/ptmx", "/dev/pts/ptmx"}


@dataclass(frozen=True)
class PortUser:
    """A process with the port open, ourselves not among them."""

    pid: int
    name: str


def port_users(path: str) -> list[PortUser]:
    """As far as this user may look into other processes; empty where the system has no /proc."""
    real = os.path.realpath(path)
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        pid = int(folder.name)
        if pid == os.getpid():
            continue
        try:
            opened = {os.readlink(link) for link in (folder / "fd").iterdir()}
            if real in opened and not opened & _TERMINAL_MAKERS:
                found.append(PortUser(pid, program_name(pid)))
        except OSError:  # gone, or another user's
            continue
    return sorted(found, key=lambda user: user.pid)


def program_name(pid: int) -> str:
    """The program by its command line; `OSError` where there is no such process."""
    words = [Path(word).name for word in Path(f"/proc/{pid}/cmdline").read_text(errors="replace").split("\0") if word]
    for at, word in enumerate(words):
        if word == "-m" and at + 1 < len(words):
            return words[at + 1]
    return next((word for word in words if not word.startswith(("-", "python"))), words[0] if words else "?")


def users_text(path: str) -> str:
    """`jointctl, pid 1234`; empty where none is to be seen."""
    return "; ".join(f"{user.name}, pid {user.pid}" for user in port_users(path))
