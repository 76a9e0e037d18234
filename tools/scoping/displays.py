"""Terminal and scope at once: several displays as one."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, Self

from jointctl.firmware_py.states import StopRequest
from jointctl.tools.recording.run_log import Event
from jointctl.tools.running.display.display import Display, Snapshot
from jointctl.tools.running.display.viewer_request import ViewerRequest


class Displays:
    """Several displays as one."""

    def __init__(self, displays: Sequence[Display]) -> None:
        self._displays = displays
        self._stack = contextlib.ExitStack()

    def note(self, text: str) -> None:
        """See `Display`."""
        for display in self._displays:
            display.note(text)

    def phase(self, text: str) -> None:
        """See `Display`."""
        for display in self._displays:
            display.phase(text)

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`."""
        for display in self._displays:
            display.show(snapshot)

    def event(self, event: Event) -> None:
        """See `Display`."""
        for display in self._displays:
            display.event(event)

    def stop_request(self) -> StopRequest:
        """See `Display`."""
        return max(display.stop_request() for display in self._displays)

    def stop_reason(self) -> str:
        """See `Display`."""
        return next((reason for display in self._displays if (reason := display.stop_reason())), "")

    def requests(self) -> Sequence[ViewerRequest]:
        """See `Display`."""
        return [request for display in self._displays for request in display.requests()]

    def settings(self, values: Mapping[str, Any]) -> None:
        """See `Display`."""
        for display in self._displays:
            display.settings(values)

    def __enter__(self) -> Self:
        for display in self._displays:
            self._stack.enter_context(display)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave all of them."""
        self._stack.close()
