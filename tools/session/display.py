"""What a run sends to a display, and what comes back: the `Display` protocol, several as one, lines for each phase."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, Self

import numpy as np

from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.drive_section import DEFAULT_KIND
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, Event

# --- What somebody who watches a run asks for, as it comes from the page: nothing in it has been checked ---


LONGEST_BYTES = 4096


@dataclass(frozen=True)
class ViewerRequest:
    """`kind` is gains, set_point, trajectory, record, start or prepare; `values` belong to it.

    Two kinds come from the page's server itself: viewers, with the `count` of open pages, and stop, with `strength`.
    """

    kind: str
    who: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def encoded(self) -> bytes:
        return json.dumps(asdict(self)).encode()


@dataclass(frozen=True)
class PreparedMotion(ViewerRequest):
    """A motion that a program of this very process has checked; `answered` gets "" or why the loop refused it."""

    trajectory: Any = None  # record array of one TrajectoryConstants
    words: str = ""
    answered: Callable[[str], None] = lambda _: None


def viewer(address: str | None) -> str:
    """What a viewer is called in events."""
    return f"a viewer at {address or 'an unknown address'}"


def decoded(message: bytes) -> ViewerRequest | None:
    """The request in a message; None if it is none."""
    try:
        found = json.loads(message)
        kind, who, values = found["kind"], found["who"], found["values"]
    except (ValueError, TypeError, KeyError):
        return None
    if not (isinstance(kind, str) and isinstance(who, str) and isinstance(values, dict)):
        return None
    return ViewerRequest(kind, " ".join(who.split())[:80], values)


# --- What a run reports to its viewers, and what it hears from them: the `Display` protocol and the `Snapshot` ---


@dataclass(frozen=True)
class Snapshot:
    """The newest cycle and what has been counted so far; `histograms` is the loop's own memory, read when drawn."""

    record: Any  # LogRecord
    skipped: int
    histograms: np.ndarray
    duration_s: float  # of the trajectory; 0 = until stopped
    drive: str = DEFAULT_KIND  # drive.kind
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
        """What a viewer asks for."""
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
        return ""

    def requests(self) -> Sequence[ViewerRequest]:
        return ()

    def settings(self, values: Mapping[str, Any]) -> None:
        """Nothing can be changed here."""


class Displays:
    """Several displays as one."""

    def __init__(self, displays: Sequence[Display]) -> None:
        self._displays = displays
        self._stack = contextlib.ExitStack()

    def note(self, text: str) -> None:
        for display in self._displays:
            display.note(text)

    def phase(self, text: str) -> None:
        for display in self._displays:
            display.phase(text)

    def show(self, snapshot: Snapshot) -> None:
        for display in self._displays:
            display.show(snapshot)

    def event(self, event: Event) -> None:
        for display in self._displays:
            display.event(event)

    def stop_request(self) -> StopRequest:
        return max(display.stop_request() for display in self._displays)

    def stop_reason(self) -> str:
        return next((reason for display in self._displays if (reason := display.stop_reason())), "")

    def requests(self) -> Sequence[ViewerRequest]:
        return [request for display in self._displays for request in display.requests()]

    def settings(self, values: Mapping[str, Any]) -> None:
        for display in self._displays:
            display.settings(values)

    def __enter__(self) -> Self:
        for display in self._displays:
            self._stack.enter_context(display)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


# --- A run as lines: one for each phase and remark; for pipes, files and `--json` ---


class PhaseLines(OnlyShows):
    """Writes a line for each phase, remark and fault."""

    def __init__(self, output: Output) -> None:
        self._output = output

    def note(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the terminal may have been closed: no reason to stop watching
            self._output.note(f"  {text}")

    phase = note

    def event(self, event: Event) -> None:
        """A fault is reported when it happens, not only at the end of the run; the other events are in the log."""
        if event.level >= ERROR:
            self.note(event.text)

    def show(self, snapshot: Snapshot) -> None:
        """Nothing: lines are for changes."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to take away."""
