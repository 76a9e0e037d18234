"""What viewers may do with a run besides stopping it: change it, and have a stretch of it recorded on its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from jointctl.drivers.errors import DataError
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.run_log import INFO, WARNING, Event, RunLogWriter
from jointctl.tools.running.changes.live_changes import LiveChanges, settings_of
from jointctl.tools.running.display.display import Display
from jointctl.tools.running.display.viewer_request import ViewerRequest

SETTINGS_s = 0.5  # how often the page is told how things stand
UNWATCHED = "no page is open any more; the joint goes on, Ctrl-C or `jointctl stop` brakes it"


class ViewerOrders:
    """One run; `tell(level, text)` writes an event.  The run log has everything in any case.

    A recording is a log of its own beside the run log: NAME.recording-1.mcap.
    """

    def __init__(
        self,
        config: Config,
        block: Any,
        log_path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        tell: Callable[[int, str], None],
        delay_s: Callable[[], float | None],
        *,
        allow_low_margin: bool = False,
    ) -> None:
        self._config, self._log_path, self._metadata, self._tell = config, log_path, metadata, tell
        self._changes = LiveChanges(config, block, tell, delay_s, allow_low_margin=allow_low_margin)
        self._recording: RunLogWriter | None = None
        self._count = 0
        self._told_s = 0.0

    def serve(self, display: Display) -> None:
        """Take what was asked for since the last call, go on with what is open, tell the page."""
        for request in display.requests():
            if request.kind in ("gains", "set_point", "trajectory"):
                self._changes.take(request)
            elif request.kind == "record":
                self._record(bool(request.values.get("on")), request.who)
            elif request.kind == "viewers":
                self._count_viewers(request, display)
        self._changes.poll()
        now_s = time.monotonic()
        if now_s - self._told_s >= SETTINGS_s:
            self._told_s = now_s
            recording = self._recording.path.name if self._recording is not None else ""
            display.settings({"stage": "running", **settings_of(self._changes, self._config), "recording": recording})

    def _count_viewers(self, request: ViewerRequest, display: Display) -> None:
        """Whether anybody can see the joint move: told in the terminal and in the log."""
        watched = bool(request.values.get("count"))
        text = "a page is open again" if watched else str(request.values.get("text") or UNWATCHED)
        self._tell(INFO if watched else WARNING, text)
        display.note(text)

    def _record(self, on: bool, who: str) -> None:
        if on == (self._recording is not None):
            return
        if not on:
            self._end_recording(f"by {who}")
            return
        self._count += 1
        path = self._log_path.with_name(f"{self._log_path.stem}.recording-{self._count}.mcap")
        try:
            self._recording = RunLogWriter(path, self._metadata)
        except (DataError, OSError) as error:
            self._tell(WARNING, f"no recording: {error}")
            return
        self._tell(INFO, f"recording {path.name} begun by {who}")

    def _end_recording(self, how: str) -> None:
        if self._recording is None:
            return
        recording, self._recording = self._recording, None
        try:
            recording.close()
        except OSError as error:
            how += f", incomplete: {error.strerror or error}"
        self._tell(INFO, f"recording {recording.path.name} ended {how}")

    def keep(self, records: Any) -> None:
        """New records, as they go into the run log; a recording that cannot be written does not end the run."""
        if self._recording is None:
            return
        try:
            self._recording.write_records(records)
        except OSError as error:
            self._end_recording(f"because it cannot be written: {error.strerror or error}")

    def keep_event(self, event: Event) -> None:
        """As `keep`, for an event."""
        if self._recording is None:
            return
        try:
            self._recording.write_event(event.level, event.source, event.text, event.time_ns)
        except OSError as error:
            self._end_recording(f"because it cannot be written: {error.strerror or error}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The run is over."""
        self._end_recording("with the run")
        self._changes.close()
