"""The panel of `run`: the picture of one moment, from the newest `Snapshot`; nothing here is drawn or waits."""

from __future__ import annotations

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jointctl.firmware_py.realtime import Histogram
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.running.display.display import Snapshot
from jointctl.tools.running.events.event_finder import drive_state_name, fault_words, phase_name
from jointctl.tools.running.loop.loop_delay import quantile_s

NOTES = 3  # how many of the newest remarks stay in the panel
_QUANTILE = 0.99
_NAME_WIDTH, _LEAST_WIDTH, _RIGHT_WIDTH = 11, 15, 19  # columns of the panel


def panel(title: str, phase: str, snapshot: Snapshot | None, notes: list[str]) -> Panel:
    """The picture of one moment; the same number of lines whatever happens, so that nothing jumps."""
    lines = [Text(f"  {line}", style="dim", no_wrap=True) for line in [*notes, *[""] * (NOTES - len(notes))]]
    border = "red" if snapshot is not None and int(snapshot.record.fault) else "blue"
    foot = "Ctrl-C: brake and disable; again: quick stop"
    return Panel(
        # a str would be read as markup
        Group(_Grid(_cells(phase, snapshot)), *lines), title=Text(title), subtitle=foot, title_align="left",
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
    p99_s = quantile_s(snapshot.histograms[Histogram.WAKE], _QUANTILE)
    values: tuple[str | Text, ...] = (
        Text(phase_name(int(record.phase)), style="bold"),
        drive_state_name(int(record.status_word), int(record.drive_state), cia402=snapshot.cia402),
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


def time_left(trajectory_s: float, duration_s: float, phase: int) -> str:
    """In words; while the joint approaches, trajectory time is negative and counts as well."""
    if phase > AxisPhase.TRACKING:
        return "stopping"
    if duration_s <= 0.0:
        return "until stopped"
    minutes, seconds = divmod(max(0.0, duration_s - trajectory_s), 60.0)
    return f"{int(minutes)}:{seconds:04.1f} min" if minutes else f"{seconds:.1f} s"
