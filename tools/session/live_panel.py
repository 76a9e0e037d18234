"""The calm panel of a run on a terminal: its picture, and the thread that draws it."""

from __future__ import annotations

import contextlib
import io
import os
import select
import threading
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jointctl.drivers.errors import message_line, printable
from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, Event
from jointctl.tools.session.display import Display, OnlyShows, PhaseLines, Snapshot, fault_words, phase_name
from jointctl.tools.session.loop_memory import QUANTILE, quantile_s
from jointctl.tools.session.session_drive import drive_state_name, session_drive

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
    p99_s = quantile_s(snapshot.histograms[Histogram.WAKE], QUANTILE)
    values: tuple[str | Text, ...] = (
        Text(phase_name(int(record.phase)), style="bold"),
        drive_state_name(session_drive(snapshot.drive), int(record.status_word), int(record.drive_state)),
        f"{float(record.error_rad) * 1e3:+8.3f} mrad" if active else "-",
        Text(fault_words(fault), style="bold red") if fault else "none",
        f"{float(record.position_rad):+8.4f} rad",
        f"{float(record.command_torque_Nm):+8.2f} Nm",
        f"{float(record.velocity_radps):+7.3f} rad/s",
        f"{float(record.measured_torque_Nm):+8.2f} Nm",
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
            f"{float(record.error_rad) * 1e3:+.3f}" if active else "-", f"{float(record.command_torque_Nm):+.2f}",
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


class LivePanel(OnlyShows):
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

    def event(self, event: Event) -> None:
        """As in `PhaseLines`."""
        if event.level >= ERROR:
            self.note(event.text)

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


def run_display(output: Output, title: str) -> Callable[[], Display]:
    """The panel if stderr is a terminal that can move its cursor, else lines; made when the run begins."""
    stream: Any = output.stderr
    terminal = not output.json and not output.quiet and stream.isatty() and not Console(file=stream).is_dumb_terminal
    return lambda: LivePanel(stream.fileno(), title) if terminal else PhaseLines(output)
