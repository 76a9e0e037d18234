"""`jointctl` as somebody at a terminal meets it."""

from __future__ import annotations

import contextlib
import os
import pty
import time
from typing import Any

from tests.hil.bench import Finished
from tests.hil.serial_bench import end_line_guards


class Terminal:
    """`jointctl` with a terminal as its standard input and error."""

    def __init__(self, bench: Any, *arguments: str) -> None:
        self.master, slave = pty.openpty()
        end_line_guards(os.ttyname(slave))  # of a test that had a terminal of this name before
        self.started = bench.start(*arguments, stdin=slave, stderr=slave)
        os.close(slave)
        os.set_blocking(self.master, False)
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
