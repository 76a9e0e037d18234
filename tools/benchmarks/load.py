"""Load for the computer while something is measured: a busy thread of this very process, or a busy core."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

LOADS = ("idle", "Python thread", "busy core")


@contextmanager
def python_thread() -> Iterator[None]:
    """A thread that computes in Python and so wants the interpreter's lock all the time."""
    ended = threading.Event()

    def work() -> None:
        total = 0
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
def busy_core() -> Iterator[None]:
    """Another process that never sleeps; it ends by itself when this one has gone (its input closes)."""
    code = "import select, sys\nwhile not select.select([sys.stdin], [], [], 0)[0]: sum(range(20000))"
    process = subprocess.Popen([sys.executable, "-S", "-c", code], stdin=subprocess.PIPE)
    try:
        yield
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
