"""What a run tells whoever watches it, and what it hears from them: the `Display` protocol and the `Snapshot`."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

from jointctl.firmware_py.states import StopRequest
from jointctl.tools.recording.run_log import Event
from jointctl.tools.running.display.viewer_request import ViewerRequest


@dataclass(frozen=True)
class Snapshot:
    """The newest cycle and what has been counted so far; `histograms` is the loop's own memory, read when drawn."""

    record: Any  # LogRecord
    skipped: int
    histograms: np.ndarray
    duration_s: float  # of the trajectory; 0 = until stopped
    cia402: bool = True
    records: Any = ()  # all new ones, array of LogRecord (N,)
    temperature_degC: float | None = None  # None: the drive tells none, or not now


class Display(Protocol):
    """Shows how a run goes; nothing in it may raise or wait."""

    def note(self, text: str) -> None:
        """A remark that stays."""

    def phase(self, text: str) -> None:
        """The run has entered a phase."""

    def show(self, snapshot: Snapshot) -> None:
        """The state of things, called many times a second."""

    def event(self, event: Event) -> None:
        """Something that went into the log as an event."""

    def stop_request(self) -> StopRequest:
        """What whoever watches asks for."""
        ...

    def stop_reason(self) -> str:
        """Who or what asked for that stop; "" if nobody did."""
        ...

    def requests(self) -> Sequence[ViewerRequest]:
        """What else they have asked for since the last call."""
        ...

    def settings(self, values: Mapping[str, Any]) -> None:
        """What can be changed in this run, and how it stands."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class OnlyShows:
    """The half of `Display` that a display leaves out when it neither tells events nor takes orders."""

    def event(self, event: Event) -> None:
        """Events are in the log."""

    def stop_request(self) -> StopRequest:
        """Nobody can ask for anything here; signals have their own way."""
        return StopRequest.NONE

    def stop_reason(self) -> str:
        """As above."""
        return ""

    def requests(self) -> Sequence[ViewerRequest]:
        """As above."""
        return ()

    def settings(self, values: Mapping[str, Any]) -> None:
        """Nothing can be changed here."""


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
