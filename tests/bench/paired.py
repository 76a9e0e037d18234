"""Ratios of two things measured in turn, the rows that a benchmark consists of, and those as table, JSON and picture.

On a computer that other programs use as well, two runs one after the other differ more than what is compared.
Each pair is therefore measured close together, its ratio is taken, and the median of the ratios is the result.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.table import Table
from rich.text import Text

from jointctl.tools.child_process import own_virtual_joint
from jointctl.tools.drawing import GREEN, GREY, INK, RED, canvas, save_png
from jointctl.tools.written_file import writing

# --- measured in turn ---

_T = TypeVar("_T")


@dataclass(frozen=True)
class Row:
    """One comparison; `ratio` is ours over the other's, so that less is faster, nan where there is nothing to compare.

    `low` and `high` are the quartiles of the paired ratios.  `goal` is the largest allowed ratio, or with
    `goal_is_value` the largest allowed value of ours.
    """

    group: str
    what: str
    ours: float
    unit: str
    other: float = math.nan
    other_name: str = ""
    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    pairs: int = 0
    goal: float | None = None
    goal_is_value: bool = False
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the goal is met; None where there is none, or nothing was measured for it."""
        value = self.ours if self.goal_is_value else self.ratio
        if self.goal is None or math.isnan(value):
            return None
        return value <= self.goal


def skipped(group: str, what: str, why: str) -> Row:
    """A comparison that could not be made, and why."""
    return Row(group, what, math.nan, "", note=f"skipped: {why}")


def measured(
    group: str,
    what: str,
    ours: Sequence[float],
    unit: str,
    *,
    goal: float | None = None,
    note: str = "",
) -> Row:
    """The median of values that are compared with nothing but a goal."""
    return Row(group, what, float(np.median(ours)), unit, goal=goal, goal_is_value=True, pairs=len(ours), note=note)


def compared(
    group: str,
    what: str,
    ours: Sequence[float],
    other: Sequence[float],
    unit: str,
    other_name: str,
    *,
    goal: float | None = None,
    note: str = "",
) -> Row:
    """Value k of `ours` and of `other` were measured next to each other."""
    if len(ours) != len(other) or not len(ours):
        raise ValueError(f"pairs (={len(ours)} of ours, {len(other)} of {other_name}) must be equal in number and > 0")
    ratios = np.asarray(ours, float) / np.asarray(other, float)
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    return Row(
        group, what, float(np.median(ours)), unit, float(np.median(other)), other_name,
        float(middle), float(low), float(high), len(ours), goal, note=note,
    )  # fmt: skip


def interleaved(pairs: int, *measure: Callable[[], _T]) -> list[list[_T]]:
    """The values of each function, called in turn `pairs` times; the order turns round each time."""
    values: list[list[_T]] = [[] for _ in measure]
    for pair in range(pairs):
        order = range(len(measure)) if pair % 2 == 0 else reversed(range(len(measure)))
        for index in order:
            values[index].append(measure[index]())
    return values


# --- the result for people and programs ---


def conditions() -> dict[str, Any]:
    """What the figures depend on."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "processor": model,
        "cores": os.cpu_count(),
        "load_average": [round(value, 2) for value in os.getloadavg()],
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numba": version("numba"),
        "numpy": version("numpy"),
    }


def _number(value: float, unit: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.3g} {unit}".strip() if value < 1000.0 else f"{value:.0f} {unit}".strip()


def _verdict(row: Row) -> str:
    if row.reached is None:
        return ""
    goal = _number(row.goal or 0.0, row.unit) if row.goal_is_value else f"{row.goal:g}"
    return f"{'yes' if row.reached else 'NO'} (<= {goal})"


def _ratio(row: Row) -> str:
    if math.isnan(row.ratio):
        return ""
    spread = "" if row.pairs < 2 else f" ({row.low:.3g}..{row.high:.3g})"
    return f"{row.ratio:.3g}{spread}"


COLUMNS = ("", "ours", "against", "theirs", "ratio (quartiles)", "goal met", "remark")


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table."""
    theirs = _number(row.other, row.unit)
    return (row.what, _number(row.ours, row.unit), row.other_name, theirs, _ratio(row), _verdict(row), row.note)


def outcome_table(rows: Sequence[Row]) -> Table:
    """All rows; a ratio below 1 means that ours is faster."""
    table = Table(title="Benchmark: ours / theirs, medians of pairs measured in turn", title_justify="left")
    for column in COLUMNS:
        table.add_column(column)
    group = None
    for row in rows:
        if row.group != group:
            table.add_section()
            table.add_row(Text(row.group, "bold"))
            group = row.group
        table.add_row(*cells(row))
    return table


def outcome_data(rows: Sequence[Row], found: dict[str, Any]) -> dict[str, Any]:
    """Conditions and rows as plain data; NaN becomes null when written."""

    def plain(row: Row) -> dict[str, Any]:
        fields = {key: None if isinstance(v, float) and math.isnan(v) else v for key, v in asdict(row).items()}
        return {**fields, "reached": row.reached}

    return {"conditions": found, "rows": [plain(row) for row in rows]}


def write_outcome(folder: Path, rows: Sequence[Row], data: dict[str, Any]) -> tuple[Path, Path]:
    """bench.json and bench.png in `folder`, which is made if it is not there."""
    path = folder / "bench.json"
    with writing(path):
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")
    shown = [row for row in rows if row.ratio > 0.0][::-1]
    with canvas(1.5 + 0.24 * len(shown)) as figure:
        _draw_ratios(figure.add_subplot(), shown)
    return path, save_png(figure, folder / "bench.png")


def _draw_ratios(axes: Any, shown: Sequence[Row]) -> None:
    """Every ratio with its quartiles on a logarithmic axis, the goals as marks."""
    axes.axvline(1.0, color=INK, linewidth=1.0)
    for place, row in enumerate(shown):
        colour = {None: GREY, True: GREEN, False: RED}[row.reached]
        axes.plot([row.low, row.high], [place, place], color=colour, linewidth=3.0, alpha=0.4)
        axes.plot([row.ratio], [place], "o", color=colour, markersize=5.0)
        if row.goal is not None and not row.goal_is_value:
            axes.plot([row.goal], [place], "|", color=INK, markersize=9.0)
    if shown:
        axes.set_xscale("log")
    axes.set_yticks(range(len(shown)), [f"{row.what} / {row.other_name}" for row in shown], fontsize=8)
    axes.set_ylim(-0.7, len(shown) - 0.3)
    axes.set_xlabel(
        "ours / theirs, left of 1 is faster\nbar: quartiles of the pairs; |: goal (green: met, red: missed)"
    )
    axes.grid(visible=False, axis="y")


@contextmanager
def separate_virtual_joint(
    config_path: Path, channel: str, *, timing: bool = False
) -> Iterator[subprocess.Popen[bytes]]:
    """`own_virtual_joint` whose drive answers when the block begins."""
    with own_virtual_joint(config_path, channel, timing=timing) as joint:
        joint.until_ready()
        yield joint.process
