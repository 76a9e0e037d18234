"""What a run sends to a display, and what comes back: the `Display`, several as one, lines, a calm panel."""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jointctl.drivers.errors import decimals_of, message_line, printable
from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, StopRequest, fault_name, in_words
from jointctl.tools.configuration.drive_section import DEFAULT_KIND
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, Event
from jointctl.tools.session.fault_words import FAULT_TEXTS
from jointctl.tools.session.loop_memory import quantile_s
from jointctl.tools.session.session_drive import SessionDrive, drive_state_name, session_drive

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
    joint: str = ""  # whose it is, in an arm
    move_s: float = 0.0  # that the way to its beginning takes at least


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


# --- What a run reports to its viewers, and what it hears from them: the `Display` and the `Snapshot` ---


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
    joint: str = ""  # which joint of an arm
    axis: int = 0  # its number
    torque_max_Nm: float = 0.0  # limits, a hundredth of which is to be seen in two digits; 0 = not known
    velocity_max_radps: float = 0.0

    @property
    def torque_decimals(self) -> int:
        return decimals_of(0.01 * self.torque_max_Nm, 2)


class Display:
    """Shows how a run goes; nothing in it may raise or wait.  As it is, it shows faults alone and takes no orders."""

    def note(self, text: str) -> None:
        """A remark that stays."""

    def phase(self, text: str) -> None:
        """The run has entered a phase."""

    def show(self, snapshot: Snapshot) -> None:
        """The state of things, called many times a second."""

    def event(self, event: Event) -> None:
        """Something that went into the log; a fault is reported when it happens, not only at the end of the run."""
        if event.level >= ERROR:
            self.note(event.text)

    def stop_request(self) -> StopRequest:
        """What a viewer asks for; signals have their own way."""
        return StopRequest.NONE

    def stop_reason(self) -> str:
        """Who or what asked for that stop; "" if nobody did."""
        return ""

    def requests(self) -> Sequence[ViewerRequest]:
        """What else they have asked for since the last call."""
        return ()

    def settings(self, values: Mapping[str, Any]) -> None:
        """What can be changed in this run, and how it stands."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """What it has opened is closed."""


class Displays(Display):
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


class PhaseLines(Display):
    """Writes a line for each phase, remark and fault."""

    def __init__(self, output: Output) -> None:
        self._output = output

    def note(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the terminal may have been closed: no reason to stop watching
            self._output.note(f"  {text}")

    phase = note


class JointDisplay(Display):
    """What a display gets from one joint of an arm: with its name in front, and a phase from the first one only.

    The joints share `orders`, what was asked for and no joint has taken yet.  `display` is entered once for all.
    """

    def __init__(self, display: Display, name: str, orders: list[ViewerRequest], axis: int) -> None:
        self._display, self._name, self._orders, self._axis = display, name, orders, axis

    def stop_request(self) -> StopRequest:
        return self._display.stop_request()

    def stop_reason(self) -> str:
        return self._display.stop_reason()

    def note(self, text: str) -> None:
        self._display.note(f"{self._name}: {text}")

    def phase(self, text: str) -> None:
        """All joints go on together."""
        if self._axis == 0:
            self._display.phase(text)

    def show(self, snapshot: Snapshot) -> None:
        self._display.show(replace(snapshot, joint=self._name, axis=self._axis))

    def event(self, event: Event) -> None:
        self._display.event(replace(event, text=f"{self._name}: {event.text}"))

    def requests(self) -> Sequence[ViewerRequest]:
        """Motions of the program for this joint, the first one's the number of viewers.

        Viewers change neither gains nor motion of an arm.
        """
        new = self._display.requests()
        self._orders += [each for each in new if isinstance(each, PreparedMotion) or each.kind == "viewers"]
        own = [order for order in self._orders if self._is_own(order)]
        self._orders[:] = [order for order in self._orders if not self._is_own(order)]
        return own

    def _is_own(self, order: ViewerRequest) -> bool:
        return order.joint == self._name if isinstance(order, PreparedMotion) else self._axis == 0


# --- What happened in a run, in words, found by comparing each log record with the one before ---
# Drive states, emergency codes, faults, phases and long overruns all show in the records, so the loop need not tell
# them. Between two records a state may have come and gone unseen: the events are as fine as the cycle.


OVERRUN_CYCLES = 10  # so many skipped slots in one go are worth a line


def phase_name(phase: int) -> str:
    """`quick stopping` and so on."""
    return in_words(AxisPhase(phase))


def fault_words(code: int) -> str:
    """`position limit` and so on; `fault 99` for a number that this version does not know."""
    return fault_name(code).replace("_", " ").lower()


def _likely_cause(fault: Fault, _drive_error: int) -> str:
    """Without the value that tripped it, which is not in the records."""
    return f"likely cause: {FAULT_TEXTS[fault].cause}" if fault in FAULT_TEXTS else ""


class EventFinder:
    """Feed it the records of a run in order, in pieces of any size.

    `drive` has the words for its states and errors.  `fault_words(fault, drive_error)` says more about a fault than its
    name.
    """

    def __init__(self, drive: SessionDrive, fault_words: Callable[[Fault, int], str] = _likely_cause) -> None:
        self._drive = drive
        self._fault_words = fault_words
        self._last: tuple[int, ...] | None = None

    def take(self, records: np.recarray) -> list[Event]:
        """Events in the new records (array of LogRecord, shape (N,)), in order of time."""
        if not len(records):
            return []
        fields = ("phase", "fault", "drive_state", "status_word", "drive_error")
        columns = np.stack([np.asarray(records[name], np.int64) for name in fields], axis=1)
        changed = np.ones(len(records), bool)
        changed[1:] = np.any(columns[1:] != columns[:-1], axis=1)
        events = []
        for i in np.flatnonzero(changed | (records["skipped"] >= OVERRUN_CYCLES)).tolist():
            now = tuple(columns[i].tolist())
            events += self._compare(int(records["time_ns"][i]), now, int(records["skipped"][i]))
            self._last = now
        return events

    def _compare(self, time_ns: int, now: tuple[int, ...], skipped: int) -> list[Event]:
        phase, fault, drive, word, error = now
        before = self._last if self._last is not None else (-1, 0, -1, 0, 0)
        events = []
        if skipped >= OVERRUN_CYCLES:
            events.append(Event(time_ns, WARNING, "loop", f"held up: {skipped} cycles skipped"))
        state = drive_state_name(self._drive, word, drive)
        state_before = drive_state_name(self._drive, before[3], before[2]) if before[2] >= 0 else ""
        if error != before[4]:
            level, text = (ERROR, self._drive.error_text(error)) if error else (INFO, "error code cleared")
            events.append(Event(time_ns, level, "drive", text))
        if state != state_before:
            bad = drive in (DriveState.FAULT, DriveState.FAULT_BRAKING) or (
                drive != DriveState.UNKNOWN and self._drive.in_fault(word)
            )
            shown = drive != DriveState.UNKNOWN and self._drive.state_text(word) is not None
            word_text = f" (statusword {word:04X}h)" if shown else ""
            events.append(Event(time_ns, WARNING if bad else INFO, "drive", state + word_text))
        if fault != before[1] and fault:
            events.append(Event(time_ns, ERROR, "loop", self._fault_text(fault, error)))
        if phase != before[0]:
            events.append(Event(time_ns, INFO, "loop", phase_name(phase)))
        return events

    def _fault_text(self, code: int, drive_error: int) -> str:
        if code not in list(Fault):
            return f"fault {code}"
        words = self._fault_words(Fault(code), drive_error)
        return f"{Fault(code).name} ({code})" + (f": {words}" if words else "")


# --- The panel of `run`: the picture of one moment, from the newest `Snapshot`; nothing here is drawn or waits ---


NOTES = 3  # how many of the newest remarks stay in the panel
_ALONE: Mapping[str, Snapshot] = {}  # a joint that is no arm's
_NAME_WIDTH, _LEAST_WIDTH, _RIGHT_WIDTH = 11, 15, 19  # columns of the panel


def panel(
    title: str, phase: str, snapshot: Snapshot | None, notes: list[str], joints: Mapping[str, Snapshot] = _ALONE
) -> Panel:
    """The picture of one moment; the same number of lines whatever happens, so that nothing jumps.

    `joints`: the newest snapshots of an arm's, by name.
    """
    lines = [Text(f"  {line}", style="dim", no_wrap=True) for line in [*notes, *[""] * (NOTES - len(notes))]]
    shown = list(joints.values()) or ([snapshot] if snapshot is not None else [])
    border = "red" if any(int(each.record.fault) for each in shown) else "blue"
    body = _joint_rows(joints) if joints else _Grid(_cells(phase, snapshot))
    foot = "Ctrl-C: brake and disable; again: quick stop"
    return Panel(
        # a str would be read as markup
        Group(body, *lines), title=Text(title), subtitle=foot, title_align="left",
        subtitle_align="left", border_style=border, width=78,
    )  # fmt: skip


class _Grid:
    """Two fields a line where they fit, else one."""

    def __init__(self, cells: list[tuple[str, str | Text]]) -> None:
        self._cells = cells

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> RenderResult:
        left = min(28, options.max_width - 2 * _NAME_WIDTH - _RIGHT_WIDTH)
        widths = [_NAME_WIDTH, options.max_width - _NAME_WIDTH]
        if left >= _LEAST_WIDTH:
            widths = [_NAME_WIDTH, left, _NAME_WIDTH, _RIGHT_WIDTH]
        grid, step = Table.grid(), len(widths) // 2
        for width, style in zip(widths, ("dim", "") * step, strict=True):
            grid.add_column(style=style, no_wrap=True, width=width)
        for at in range(0, len(self._cells), step):
            grid.add_row(*(part for name, value in self._cells[at : at + step] for part in (name, _indented(value))))
        yield grid


def _indented(value: str | Text) -> Text:
    """A column of space that belongs to the value."""
    return Text(f" {value}") if isinstance(value, str) else Text(f" {value.plain}", style=value.style)


def _cells(phase: str, snapshot: Snapshot | None) -> list[tuple[str, str | Text]]:
    """(name, value) of each field, in the order of reading."""
    names = (
        "phase", "drive", "error", "fault", "angle", "torque", "velocity", "measured", "time left", "temperature",
        "wake-up p99", "skipped",
    )  # fmt: skip
    if snapshot is None:
        return [(name, Text(phase, style="bold") if name == "phase" else "-") for name in names]
    record = snapshot.record
    active = AxisPhase.APPROACH <= int(record.phase) <= AxisPhase.RAMPING
    fault = int(record.fault)
    p99_s = quantile_s(snapshot.histograms[Histogram.WAKE])
    values: tuple[str | Text, ...] = (
        Text(phase_name(int(record.phase)), style="bold"),
        drive_state_name(session_drive(snapshot.drive), int(record.status_word), int(record.drive_state)),
        f"{float(record.error_rad) * 1e3:+8.3f} mrad" if active else "-",
        Text(fault_words(fault), style="bold red") if fault else "none",
        f"{float(record.position_rad):+8.4f} rad",
        f"{float(record.command_torque_Nm):+8.{snapshot.torque_decimals}f} Nm",
        f"{float(record.velocity_radps):+7.{decimals_of(0.01 * snapshot.velocity_max_radps, 3)}f} rad/s",
        f"{float(record.measured_torque_Nm):+8.{snapshot.torque_decimals}f} Nm",
        time_left(float(record.trajectory_s), snapshot.duration_s, int(record.phase)),
        "-" if snapshot.temperature_degC is None else f"{snapshot.temperature_degC:.1f} °C",
        f"{p99_s * 1e6:.0f} us" if np.isfinite(p99_s) else "-",
        f"{snapshot.skipped} cycles",
    )
    return list(zip(names, values, strict=True))


def _joint_rows(joints: Mapping[str, Snapshot]) -> Table:
    """A line for each joint of an arm."""
    table = Table(box=None, show_header=True, header_style="dim", pad_edge=False)
    for heading in ("joint", "phase", "angle [rad]", "error [mrad]", "torque [Nm]", "fault"):
        table.add_column(heading, no_wrap=True, justify="left" if heading in ("joint", "phase", "fault") else "right")
    for name, snapshot in joints.items():
        record = snapshot.record
        active = AxisPhase.APPROACH <= int(record.phase) <= AxisPhase.RAMPING
        fault = int(record.fault)
        table.add_row(
            Text(name), phase_name(int(record.phase)), f"{float(record.position_rad):+.4f}",
            f"{float(record.error_rad) * 1e3:+.3f}" if active else "-",
            f"{float(record.command_torque_Nm):+.{snapshot.torque_decimals}f}",
            Text(fault_words(fault), style="bold red") if fault else "none",
        )  # fmt: skip
    return table


def time_left(trajectory_s: float, duration_s: float, phase: int) -> str:
    """In words; while the joint approaches, trajectory time is negative and counts as well."""
    if phase > AxisPhase.TRACKING:
        return "stopping"
    if duration_s <= 0.0:
        return "until stopped"
    minutes, seconds = divmod(max(0.0, duration_s - trajectory_s), 60.0)
    return f"{int(minutes)}:{seconds:04.1f} min" if minutes else f"{seconds:.1f} s"


# --- What `run` shows while the joint moves: one calm panel on a terminal, one line a phase elsewhere ---
# The panel is drawn by a thread of its own, at most 4 times a second, from the newest `Snapshot`.  The supervisor
# only leaves the snapshot there, so a terminal that is slow, stopped (Ctrl-S) or gone cannot hold it up: a frame that
# the terminal does not take at once is dropped.


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


class LivePanel(Display):
    """The panel on the terminal behind file descriptor `fd`."""

    def __init__(self, fd: int, title: str, refresh_s: float = REFRESH_s) -> None:
        self._title = printable(title)
        self._refresh_s = refresh_s
        self._snapshot: Snapshot | None = None
        self._joints: dict[str, Snapshot] = {}  # of an arm
        self._phase = "starting"
        self._notes: list[str] = []
        self._ended = threading.Event()
        self._console = Console(file=_WholeFrames(fd), highlight=False, markup=False, emoji=False)
        self._thread = threading.Thread(target=self._draw_until_ended, name="live panel", daemon=True)

    def note(self, text: str) -> None:
        self._notes = [*self._notes, message_line(text)][-NOTES:]

    def phase(self, text: str) -> None:
        self._phase = text

    def show(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        if snapshot.joint:
            self._joints = {**self._joints, snapshot.joint: snapshot}

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
        return panel(self._title, self._phase, self._snapshot, self._notes, self._joints)


def run_display(output: Output, title: str) -> Callable[[object], Display]:
    """The panel if stderr is a terminal that can move its cursor, else lines; made when the run begins."""
    stream: Any = output.stderr
    terminal = not output.json and not output.quiet and stream.isatty() and not Console(file=stream).is_dumb_terminal
    return lambda _: LivePanel(stream.fileno(), title) if terminal else PhaseLines(output)
