"""A run as lines: one for each phase and remark; for pipes, files and `--json`."""

from __future__ import annotations

import contextlib
from typing import Self

from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, Event
from jointctl.tools.running.display.display import OnlyShows, Snapshot


class PhaseLines(OnlyShows):
    """Writes a line for each phase, remark and fault."""

    def __init__(self, output: Output) -> None:
        self._output = output

    def note(self, text: str) -> None:
        """See `Display`."""
        with contextlib.suppress(OSError):  # the terminal may have been closed: no reason to stop watching
            self._output.note(f"  {text}")

    phase = note

    def event(self, event: Event) -> None:
        """A fault is told when it happens, not only at the end of the run; the other events are in the log."""
        if event.level >= ERROR:
            self.note(event.text)

    def show(self, snapshot: Snapshot) -> None:
        """Nothing: lines are for changes."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to take away."""
