"""Beside other processes: what a command leaves, Python code that must end well, waiting, children, no room."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

_T = TypeVar("_T")


@dataclass(frozen=True)
class Finished:
    """What a command left: exit code and its two streams."""

    code: int
    out: str
    err: str

    def refused(self, code: int, *words: str) -> None:
        """It ended with this exit code and one line of error that holds the words, and no traceback."""
        errors = [line for line in self.err.splitlines() if line.startswith("error: ")]
        assert (self.code, len(errors)) == (code, 1), self.err
        assert "Traceback" not in self.err
        assert "Traceback" not in self.out
        for word in words:
            assert word in self.err, self.err


def run_python(code: str, *arguments: str, **environment: str) -> str:
    """What it prints; `environment`: variables that are set for it."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=300.0,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def eventually(condition: Callable[[], _T], within_s: float = 10.0, shown: Callable[[], object] = lambda: "") -> _T:
    """What `condition` gives when it holds at last; a test that waits for ever fails with what is `shown`."""
    give_up_s = time.monotonic() + within_s
    while not (found := condition()):
        assert time.monotonic() < give_up_s, shown()
        time.sleep(0.005)
    return found


def children(parent: int) -> list[int]:
    """Process ids of the direct children."""
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def child(parent: int, module: str) -> int:
    """The direct child that runs this module; ValueError if there is none."""
    (pid,) = [pid for pid in children(parent) if module in Path(f"/proc/{pid}/cmdline").read_text()]
    return pid


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """What a process without room sees: a file cannot grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def forked() -> Iterator[int]:
    """A process forked from this one that does nothing, in the meantime."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writing, b"x")
        signal.pause()
    os.read(reading, 1)
    os.close(reading)
    os.close(writing)
    try:
        yield child
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
