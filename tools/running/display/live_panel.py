"""What `run` shows while the joint moves: one calm panel on a terminal, one line a phase elsewhere.

The panel is drawn by a thread of its own, at most 4 times a second, from the newest `Snapshot`.  The supervisor only
leaves the snapshot there, so a terminal that is slow, stopped (Ctrl-S) or gone cannot hold it up: a frame that the
terminal does not take at once is dropped.
"""

from __future__ import annotations

import contextlib
import io
import os
import select
import threading
from collections.abc import Callable
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.panel import Panel

from jointctl.drivers.printable import message_line, printable
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, Event
from jointctl.tools.running.display.display import Display, OnlyShows, Snapshot
from jointctl.tools.running.display.panel import NOTES, panel
from jointctl.tools.running.display.phase_lines import PhaseLines

REFRESH_s = 0.25
CLOSE_s = 1.0  # how long the end of a run waits for the last frame


class _WholeFrames(io.StringIO):
    """Collects what rich writes and hands it over in one piece, or not at all if the terminal would make us wait."""

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._fd

    def flush(self) -> None:
        data = self.getvalue().encode("utf-8", "replace")
        self.seek(0)
        self.truncate()
        if not data:
            return
        with contextlib.suppress(OSError, ValueError):
            if select.select([], [self._fd], [], 0.0)[1]:
                os.write(self._fd, data)


class LivePanel(OnlyShows):
    """The panel on the terminal behind file descriptor `fd`."""

    def __init__(self, fd: int, title: str, refresh_s: float = REFRESH_s) -> None:
        self._title = printable(title)
        self._refresh_s = refresh_s
        self._snapshot: Snapshot | None = None
        self._phase = "starting"
        self._notes: list[str] = []
        self._ended = threading.Event()
        self._console = Console(file=_WholeFrames(fd), highlight=False, markup=False, emoji=False)
        self._thread = threading.Thread(target=self._draw_until_ended, name="live panel", daemon=True)

    def note(self, text: str) -> None:
        """See `Display`."""
        self._notes = [*self._notes, message_line(text)][-NOTES:]

    def event(self, event: Event) -> None:
        """As in `PhaseLines`."""
        if event.level >= ERROR:
            self.note(event.text)

    def phase(self, text: str) -> None:
        """See `Display`."""
        self._phase = text

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`."""
        self._snapshot = snapshot

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the panel away; a terminal that takes nothing is not waited for."""
        self._ended.set()
        self._thread.join(CLOSE_s)

    def _draw_until_ended(self) -> None:
        # whatever the terminal does wrong, the run goes on without its panel
        with contextlib.suppress(Exception):
            live = Live(
                self._panel(), console=self._console, auto_refresh=False, transient=True,
                redirect_stdout=False, redirect_stderr=False,
            )  # fmt: skip
            with live:
                while not self._ended.wait(self._refresh_s):
                    live.update(self._panel(), refresh=True)

    def _panel(self) -> Panel:
        return panel(self._title, self._phase, self._snapshot, self._notes)


def run_display(output: Output, title: str) -> Callable[[], Display]:
    """The panel if stderr is a terminal that can move its cursor, else lines; made when the run begins."""
    stream: Any = output.stderr
    terminal = not output.json and not output.quiet and stream.isatty() and not Console(file=stream).is_dumb_terminal
    return lambda: LivePanel(stream.fileno(), title) if terminal else PhaseLines(output)
