"""Load for the computer while something is measured: a busy thread of this very process, or a busy process.

It stays on the first core.  Left to the system, it shares the core of one measured loop and not that of the next.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

LOADS = ("idle", "Python thread", "busy core")


def cores() -> list[int]:
    """The processors that this process may use."""
    return sorted(os.sched_getaffinity(0))


@contextmanager
def on_core(core: int | None) -> Iterator[None]:
    """Keeps the calling thread, and what it starts, on one core; None: wherever the system puts it."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, before if core is None else {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def python_thread() -> Iterator[None]:
    """A thread that computes in Python and so wants the interpreter's lock all the time."""
    ended = threading.Event()

    def work() -> None:
        total = 0
        with on_core(cores()[0]):
            while not ended.is_set():
                total += sum(range(2000))

    thread = threading.Thread(target=work, name="load", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def busy_core() -> Iterator[int]:
    """Another process that never sleeps; gives its number.  It ends by itself when this one has gone: input closes."""
    code = "import select, sys\nwhile not select.select([sys.stdin], [], [], 0)[0]: sum(range(20000))"
    with on_core(cores()[0]):
        process = subprocess.Popen([sys.executable, "-S", "-c", code], stdin=subprocess.PIPE)
    try:
        yield process.pid
    finally:
        process.kill()
        process.communicate()


@contextmanager
def load(name: str) -> Iterator[None]:
    """One of `LOADS`."""
    if name == "Python thread":
        with python_thread():
            yield
    elif name == "busy core":
        with busy_core():
            yield
    elif name == "idle":
        yield
    else:
        raise ValueError(f"load (={name!r}) must be one of {', '.join(LOADS)}")
