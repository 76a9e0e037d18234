"""Waiting for a process that compiles: as long as it works, and in words when it ends or hangs."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from jointctl.drivers.errors import BusError
from jointctl.tools.simulation.child_process import IDLE_S, TELL_S, Starting, processor_time_s


class Waiting:
    """A process that sleeps behind a clock and a processor time that the test moves."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.now_s, self.used_s = 0.0, 0.0
        self.told: list[str] = []
        self.starting = Starting(
            "the virtual joint", process, self.told.append, BusError, clock=lambda: self.now_s,
            used=lambda pid: self.used_s,
        )  # fmt: skip

    def go(self, time_s: float, share: float) -> None:
        """Seconds in which the process gets this share of a processor."""
        for _ in range(int(time_s)):
            self.now_s += 1.0
            self.used_s += share
            self.starting.check()


@pytest.fixture
def process() -> subprocess.Popen[bytes]:
    return subprocess.Popen(["/bin/sleep", "600"])


@pytest.fixture
def waiting(process: subprocess.Popen[bytes]) -> Iterator[Waiting]:
    yield Waiting(process)
    process.kill()
    process.wait()


def test_it_is_waited_for_as_long_as_it_works_and_told_meanwhile(waiting: Waiting) -> None:
    waiting.go(1000.0, 0.01)  # a hundredth of a processor: a computer that is very busy
    assert len(waiting.told) == int(1000.0 / TELL_S)
    assert waiting.told[1] == "the virtual joint is compiling: 30 s so far, 0 s of processor time"


def test_one_that_does_not_work_any_more_hangs_and_its_twin_does_not(waiting: Waiting) -> None:
    waiting.go(100.0, 0.5)
    waiting.go(IDLE_S, 0.0)
    waiting.go(1.0, 0.5)
    waiting.go(IDLE_S, 0.0)
    with pytest.raises(BusError, match=r"after 222 s it has not worked for 60 s \(50 s of processor time before\)"):
        waiting.go(1.0, 0.0)


@pytest.mark.parametrize(
    ("end", "words"),
    [
        ("import os; os.kill(os.getpid(), 9)", r"was killed by signal 9 \(SIGKILL\); it was starting, for 7 s"),
        ("raise SystemExit(4)", "ended with exit code 4, see its message above; it was"),
        ("", "ended without a message"),
    ],
)
def test_its_end_is_told(end: str, words: str) -> None:
    process = subprocess.Popen([sys.executable, "-c", end])
    waiting = Waiting(process)
    process.wait()
    waiting.now_s = 7.0
    with pytest.raises(BusError, match=words):
        waiting.starting.check()


def test_the_processor_time_of_a_process_grows_with_its_work() -> None:
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    give_up_s = time.monotonic() + 30.0
    while processor_time_s(process.pid) < 0.1:
        assert time.monotonic() < give_up_s
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert processor_time_s(process.pid) == 0.0
