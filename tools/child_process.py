"""Processes that jointctl starts: waiting until one that compiles is ready, and Ctrl-C kept from them.

A fixed time to wait would be wrong: the first start takes a minute on an idle computer and many on a busy one.  A
process that works uses processor time; one that hangs does not.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path

from jointctl.drivers.errors import BusError, JointctlError

TELL_S = 15.0  # how often it is reported that it still compiles
IDLE_S = 60.0  # alive, but at work for less than WORK_S in so long: it hangs
WORK_S = 0.05


def processor_time_s(pid: int) -> float:
    """What the process has used of all processors, its threads included; 0 where it has gone."""
    try:
        return time.clock_gettime(~pid << 3 | 2)  # its clock, as of clock_getcpuclockid(3): /proc need not be mounted
    except OSError:
        return 0.0


def end_text(code: int) -> str:
    """How a process ended, by its return code; one that ended by itself has said why on its stderr."""
    if code < 0:
        name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
        return f"was killed by signal {-code} ({name})"
    return f"ended with exit code {code}, see its message above" if code else "ended without a message"


class Starting:
    """`check()` it many times until it is ready.  `name` as in "the virtual joint", `error` is what is raised."""

    def __init__(
        self,
        name: str,
        process: subprocess.Popen[bytes],
        tell: Callable[[str], None],
        error: type[JointctlError] = JointctlError,
        *,
        clock: Callable[[], float] = time.monotonic,
        used: Callable[[int], float] = processor_time_s,
    ) -> None:
        self._name, self._process, self._tell, self._error = name, process, tell, error
        self._clock, self._used = clock, used
        self._started_s = self._told_s = self._worked_s = clock()
        self._used_s = 0.0

    def check(self) -> None:
        """Tell now and then that it is at work; raises if it has ended, or hangs."""
        now_s = self._clock()
        so_far = f"{now_s - self._started_s:.0f} s"
        code = self._process.poll()
        if code is not None:
            raise self._error(f"{self._name} {end_text(code)}; it was starting, for {so_far}")
        used_s = self._used(self._process.pid)
        if used_s - self._used_s > WORK_S:
            self._used_s, self._worked_s = used_s, now_s
        elif now_s - self._worked_s > IDLE_S:
            raise self._error(
                f"{self._name} did not start: after {so_far} it has not worked for {IDLE_S:.0f} s "
                f"({used_s:.0f} s of processor time before)",
                "it may have been stopped, or the computer is out of memory; then start again",
            )
        if now_s - self._told_s >= TELL_S:
            self._told_s = now_s
            self._tell(f"{self._name} is starting: {so_far} so far, {used_s:.0f} s of processor time")


def say(text: str) -> None:
    """One line on stderr from a process that was started; what nobody reads any more is no reason to end it."""
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def own_threads() -> set[int]:
    """Of this process: the kernel's list may leave one out while others end, and needs /proc; Python knows its own."""
    own = {thread.native_id for thread in threading.enumerate() if thread.native_id is not None}
    with suppress(OSError):
        own |= set(map(int, os.listdir("/proc/self/task")))
    return own


def keep_off(processor: int | None) -> dict[int, set[int]]:
    """All threads of this process, and what they start, keep off a processor where there is another.

    Gives where each of them was allowed to run before, for `let_run`.
    """
    before: dict[int, set[int]] = {}
    if processor is None or not hasattr(os, "sched_setaffinity"):
        return before
    for thread in own_threads():
        with suppress(OSError):  # one that has ended in the meantime
            allowed = os.sched_getaffinity(thread)
            if others := allowed - {processor}:
                os.sched_setaffinity(thread, others)
                before[thread] = allowed
    return before


def let_run(allowed: Mapping[int, set[int]]) -> None:
    """Each thread on the processors that `keep_off` has found; the number of one that has ended may be another's."""
    for thread in own_threads() & allowed.keys():
        with suppress(OSError):
            os.sched_setaffinity(thread, allowed[thread])


@contextmanager
def interrupts_left_to_the_parent() -> Iterator[None]:
    """Processes that are started within hold Ctrl-C back from their first instruction on; here it comes afterwards.

    An initialiser of a worker would be too late: its imports take a second, and each would end with a traceback.
    A system without masks of signals starts them without.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # with the first spawned process it would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# The virtual joint of a configuration in a process of its own, `jointctl hil`, on a bus that nobody else knows.

BUS, DRIVE = b"b", b"+"  # what the process says once they are there, in this order
_POLL_S = 0.02


class OwnVirtualJoint:
    """A process that starts: its bus comes first, its drive when everything is compiled."""

    def __init__(self, process: subprocess.Popen[bytes], said_fd: int, tell: Callable[[str], None]) -> None:
        self.process, self._said_fd = process, said_fd
        self._starting = Starting("the virtual joint", process, tell, BusError)
        self._said = b""

    def until_bus(self, alive: Callable[[], None] = lambda: None) -> None:
        """`alive` is called all the time and may raise.  `BusError` if it ends, or hangs, before."""
        self._until(BUS, alive)

    def until_ready(self, alive: Callable[[], None] = lambda: None) -> None:
        """Its drive answers; `alive` and `BusError` as above."""
        self._until(DRIVE, alive)

    def _until(self, word: bytes, alive: Callable[[], None] = lambda: None) -> None:
        while word not in self._said:
            alive()
            if not select.select([self._said_fd], [], [], _POLL_S)[0]:
                self._starting.check()
            elif heard := os.read(self._said_fd, 1):
                self._said += heard
            else:  # its end of the pipe has gone, and so will it
                self.process.wait()
                self._starting.check()


@contextmanager
def own_virtual_joint(
    config_path: Path, channel: str, tell: Callable[[str], None] = lambda _: None, *, timing: bool = False
) -> Iterator[OwnVirtualJoint]:
    """`jointctl hil` on a bus of the given name, with `--timing` or not; ended with the block.

    `tell` gets a line now and then while it compiles.
    """
    read_end, write_end = os.pipe()
    command = [sys.executable, "-P", "-m", "jointctl.tools.verbs", "hil", str(config_path), "--interface", "jointctl"]
    command += ["--channel", channel, "--ready-fd", str(write_end), "--quiet", *(["--timing"] if timing else [])]
    process = subprocess.Popen(command, pass_fds=(write_end,), stdin=subprocess.DEVNULL, start_new_session=True)
    os.close(write_end)
    try:
        yield OwnVirtualJoint(process, read_end, tell)
    finally:
        os.close(read_end)
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
