"""The result of a benchmark for people and programs: table, JSON, picture."""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from jointctl.tools.benchmarks.paired import Row
from jointctl.tools.drawing import GREEN, GREY, INK, RED, canvas, save_png
from jointctl.tools.written_file import writing


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
