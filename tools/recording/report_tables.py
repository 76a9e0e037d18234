"""The tables of runs: what ran, the figures of the run side by side with their difference, the events."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any

from jointctl.firmware_py.input_file import parse_toml
from jointctl.firmware_py.states import Fault
from jointctl.tools.recording.report_page import Table
from jointctl.tools.recording.run_log_reader import RunLog, began_at, event_rows, missing_in
from jointctl.tools.recording.run_summary import TIMES, TORQUES, Range, RunSummary, TimeSummary

Figures = list[tuple[str, float | None, int]]
_EVENTS_SHOWN = 300


def _configuration(log: RunLog) -> dict[str, Any]:
    try:
        return parse_toml(log.metadata.get("run", {}).get("configuration", ""))
    except tomllib.TOMLDecodeError:
        return {}


def what_ran(names: Sequence[str], logs: Sequence[RunLog]) -> Table:
    """One column a log."""
    rows: list[list[object]] = []
    settings = [_configuration(log) for log in logs]
    drives = [log.metadata.get("drive", {}) for log in logs]
    versions = [log.metadata.get("versions", {}) for log in logs]
    clean = {"": "-"}

    def add(name: str, values: Sequence[object]) -> None:
        if any(value not in ("", None) for value in values):
            rows.append([name, *(clean.get(str(value), value) for value in values)])

    def setting(section: str, key: str) -> list[object]:
        return [found.get(section, {}).get(key, "") for found in settings]

    add("began", [began_at(log) for log in logs])
    add("configuration", [log.metadata.get("run", {}).get("path", "") for log in logs])
    add("drive", [" ".join(filter(None, (d.get("name"), d.get("product")))) for d in drives])
    add("serial number", [d.get("serial", "") for d in drives])
    add("mode", [d.get("mode", "") for d in drives])
    add("controller", setting("control", "kind"))
    add(
        "kp [1/s²], kv [1/s]",
        [
            f"{a}, {b}" if a or b else ""
            for a, b in zip(setting("control", "kp"), setting("control", "kv"), strict=True)
        ],
    )
    add("friction feed-forward", setting("control", "feed_forward"))
    add("trajectory", setting("trajectory", "kind"))
    add("rate [Hz]", setting("loop", "rate_Hz"))
    add("friction model, SHA-256", [log.metadata.get("friction", {}).get("sha256", "")[:16] for log in logs])
    add("jointctl", [v.get("jointctl", "") for v in versions])
    add("log complete", ["yes" if log.complete else "no, cut off" for log in logs])
    return Table(["", *names], rows)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"  # never -0.00


def _ends(name: str, found: Range | None, unit: str, scale: float, digits: int) -> Figures:
    low = None if found is None else found.least * scale
    high = None if found is None else found.greatest * scale
    return [(f"{name}, least [{unit}]", low, digits), (f"{name}, greatest [{unit}]", high, digits)]


def _times(name: str, found: TimeSummary | None) -> Figures:
    keys = (("p50", "p50_us"), ("p99", "p99_us"), ("p99.9", "p99_9_us"), ("max", "max_us"))
    return [(f"{name}, {word} [us]", None if found is None else float(getattr(found, key)), 0) for word, key in keys]


def motion_of(summary: RunSummary) -> Figures:
    """(name with unit, value or None, digits) of what was tracked with which torque."""
    error, late = summary.error, summary.late_error
    rows: Figures = [
        ("duration [s]", summary.duration_s, 2),
        ("tracked [s]", summary.tracked_s, 2),
        *_ends("error", error.range_rad if error else None, "mrad", 1e3, 3),
        ("error, RMSE [mrad]", error.rmse_rad * 1e3 if error else None, 3),
        *_ends("error in the second half", late.range_rad if late else None, "mrad", 1e3, 3),
        ("error in the second half, RMSE [mrad]", late.rmse_rad * 1e3 if late else None, 3),
        ("within 1 mrad for good after [s]", summary.settling_s, 2),
    ]
    for name, key in TORQUES.items():
        rows += _ends(name, getattr(summary, key), "Nm", 1.0, 2)
    rows += _ends("temperature of the drive", summary.temperature_degC, "°C", 1.0, 1)
    return rows


def deadlines_of(summary: RunSummary, missing: int | None) -> Figures:
    """How well the loop kept its time, in the same form."""
    rows = [row for name, key in TIMES.items() for row in _times(name, getattr(summary, key))]
    rows += [
        ("cycles", float(summary.cycles), 0),
        ("cycles skipped", float(summary.skipped_cycles), 0),
        ("oldest sample [cycles]", float(summary.oldest_sample_cycles), 0),
        ("records missing in the log", None if missing is None else float(missing), 0),
    ]
    return rows


def figure_tables(names: Sequence[str], logs: Sequence[RunLog], summaries: Sequence[RunSummary]) -> list[Table]:
    """Motion and deadlines of each run; of two runs also the second less the first."""
    faults = [s.fault for s in summaries]
    ended = "" if all(fault == Fault.NONE.name for fault in faults) else f"Ended by a fault: {', '.join(faults)}."
    deadlines = [deadlines_of(s, missing_in(log)) for s, log in zip(summaries, logs, strict=True)]
    motion = [motion_of(s) for s in summaries]
    return [_side_by_side("motion", names, motion, ended), _side_by_side("deadlines", names, deadlines, "")]


def _side_by_side(title: str, names: Sequence[str], listed: Sequence[Figures], caption: str) -> Table:
    two = len(listed) == 2
    rows: list[list[object]] = []
    for row in zip(*listed, strict=True):
        name, digits = row[0][0], row[0][2]
        values = [value for _, value, _ in row]
        if all(value is None for value in values):
            continue
        cells: list[object] = [name, *(_number(value, digits) for value in values)]
        if two:
            first, second = values
            known = first is not None and second is not None
            cells.append(f"{round(second - first, digits) + 0.0:+.{digits}f}" if known else "-")
        rows.append(cells)
    return Table([title, *names, *(["difference"] if two else [])], rows, caption)


def events_table(log: RunLog) -> Table:
    """Time since the first record, level, source, text."""
    rows = event_rows(log)
    tones = {i: row[1] for i, row in enumerate(rows[:_EVENTS_SHOWN]) if row[1] in ("error", "warning")}
    left_out = len(rows) - _EVENTS_SHOWN
    caption = f"and {left_out} more; jointctl log info tells them all" if left_out > 0 else ""
    return Table(["time [s]", "level", "source", "text"], rows[:_EVENTS_SHOWN], caption, tones)
