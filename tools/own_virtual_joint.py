"""The virtual joint of a configuration in a process of its own, `jointctl hil`, on a bus that nobody else knows."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from jointctl.drivers.errors import BusError
from jointctl.tools.child_process import Starting

BUS, DRIVE = b"b", b"+"  # what the process says once they are there, in this order
_POLL_S = 0.02


class OwnVirtualJoint:
    """A process that starts: its bus comes first, its drive when everything is compiled."""

    def __init__(self, process: subprocess.Popen[bytes], said_fd: int, tell: Callable[[str], None]) -> None:
        self.process, self._said_fd = process, said_fd
        self._starting = Starting("the virtual joint", process, tell, BusError)
        self._said = b""

    def until_bus(self) -> None:
        """`BusError` if it ends, or hangs, before."""
        self._until(BUS)

    def until_ready(self, alive: Callable[[], None] = lambda: None) -> None:
        """Its drive answers; `alive` is called all the time and may raise.  `BusError` as above."""
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


@contextmanager
def separate_virtual_joint(
    config_path: Path, channel: str, *, timing: bool = False
) -> Iterator[subprocess.Popen[bytes]]:
    """`own_virtual_joint` whose drive answers when the block begins."""
    with own_virtual_joint(config_path, channel, timing=timing) as joint:
        joint.until_ready()
        yield joint.process
