"""`jointctl` as somebody at a terminal meets it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import struct
import termios
import time
from typing import Any

from tests.hil.serial_bench import end_line_guards
from tests.python_process import Finished


def opened_terminal() -> tuple[int, int]:
    """Its end, which never blocks, and that of a program; 100 columns."""
    master, slave = pty.openpty()
    end_line_guards(os.ttyname(slave))  # of a test that had a terminal of this name before
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    os.set_blocking(master, False)
    return master, slave


class Terminal:
    """`jointctl` with a terminal as its standard input and error."""

    def __init__(self, bench: Any, *arguments: str, **options: Any) -> None:
        self.master, slave = opened_terminal()
        self.started = bench.start(*arguments, stdin=slave, stderr=slave, **options)
        os.close(slave)
        self.text = ""

    def saw(self, text: str, timeout_s: float = 180.0) -> Terminal:
        give_up = time.monotonic() + timeout_s
        while text not in self.text and text not in " ".join(self.text.split()):  # a terminal breaks long lines
            assert time.monotonic() < give_up, self.text
            try:
                self._read()
            except OSError as error:  # EIO: it has ended
                raise AssertionError(f"ended before {text!r}: {self.text}") from error
        return self

    def _read(self) -> None:
        try:
            self.text += os.read(self.master, 4096).decode(errors="replace")
        except BlockingIOError:
            time.sleep(0.01)

    def finished(self, timeout_s: float = 30.0) -> Finished:
        """Read to the end, as a terminal does."""
        give_up = time.monotonic() + timeout_s
        with contextlib.suppress(OSError):  # EIO: it has ended
            while time.monotonic() < give_up:
                self._read()
        return self.started.finished(timeout_s)
