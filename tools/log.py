"""`jointctl log info | plot | export`: look at a run log without another program."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from drivers.errors import DataError
from tools.identification.friction_section import replace_file
from tools.log_export import FORMATS, calendar_offset_ns
from tools.output import Output
from tools.run_figure import save_run_figure
from tools.run_log import ERROR, WARNING, Event, RunLog, read_run_log
from tools.run_summary import summarise, summary_table

_LEVELS = ((ERROR, "error"), (WARNING, "warning"), (20, "information"), (0, "debug"))
_SHOWN_EVENTS = 100


def missing_records(records: Any) -> int:
    """Cycles that the loop executed but the log does not hold: the cycle counter jumps by more than was skipped."""
    if len(records) < 2:
        return 0
    jumps = np.diff(np.asarray(records["cycle"], np.int64)) - 1 - np.asarray(records["skipped"][1:], np.int64)
    return int(np.sum(np.maximum(jumps, 0)))


def began_at(log: RunLog) -> str:
    """Local time of the first record; "" if the log does not tell."""
    offset_ns = calendar_offset_ns(log)
    if not offset_ns or not len(log.records):
        return ""
    at = datetime.fromtimestamp((int(log.records["time_ns"][0]) + offset_ns) * 1e-9, UTC)
    return at.astimezone().isoformat(sep=" ", timespec="seconds")


def event_rows(log: RunLog) -> list[tuple[str, str, str, str]]:
    """(seconds since the first record, level, source, text) of every event."""
    start_ns = int(log.records["time_ns"][0]) if len(log.records) else log.events[0].time_ns if log.events else 0
    return [
        (f"{(event.time_ns - start_ns) * 1e-9:.3f}", _level(event), event.source, event.text)
        for event in sorted(log.events, key=lambda event: event.time_ns)
    ]


def _level(event: Event) -> str:
    return next(name for level, name in _LEVELS if event.level >= level)


def log_info(path: Path, output: Output) -> int:
    """What the log holds, what was run, the summary of the run, its events."""
    log = read_run_log(path)
    summary = summarise(log.records)
    drive = log.metadata.get("drive", {})
    facts = {
        "file": str(path),
        "bytes": path.stat().st_size,
        "complete": log.complete,
        "began": began_at(log),
        "configuration": log.metadata.get("run", {}).get("path", ""),
        "records": len(log.records),
        "missing_records": missing_records(log.records),
        "events": len(log.events),
        "can_frames": len(log.frames),
    }
    data = {
        **facts,
        "drive": drive,
        "versions": log.metadata.get("versions", {}),
        "friction_sha256": log.metadata.get("friction", {}).get("sha256", ""),
        "summary": summary.to_dict(),
        "event_list": [
            {"time_ns": e.time_ns, "level": _level(e), "source": e.source, "text": e.text} for e in log.events
        ],
    }
    shown = [_facts_table(facts, drive), summary_table(summary), _event_table(log)]
    output.result(Group(*shown[: 2 if not log.events else 3]), data)
    if not log.complete:
        output.warning(f"{path}: was cut off, its tail is lost")
    return 0


def _facts_table(facts: dict[str, Any], drive: dict[str, str]) -> Table:
    table = Table(title="Log", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in facts.items():
        if value != "":
            text = str(value) if not isinstance(value, bool) else "yes" if value else "no, cut off"
            table.add_row(name.replace("_", " "), text)
    identity = ", ".join(
        f"{key} {drive[key]}" for key in ("name", "vendor", "product", "serial", "mode") if drive.get(key)
    )
    if identity:
        table.add_row("drive", identity)
    return table


def _event_table(log: RunLog) -> Table:
    rows = event_rows(log)
    left_out = len(rows) - _SHOWN_EVENTS
    table = Table(title="Events", title_justify="left", caption=f"and {left_out} more" if left_out > 0 else None)
    table.add_column("time [s]", justify="right")
    for heading in ("level", "source", "text"):
        table.add_column(heading, overflow="fold")
    for at, level, source, text in rows[:_SHOWN_EVENTS]:
        style = {"error": "red", "warning": "yellow"}.get(level)
        table.add_row(at, level, source, text, style=style)
    return table


def log_plot(path: Path, output: Output, out: Path | None = None) -> int:
    """The picture of the run as a PNG; by default beside the log."""
    log = read_run_log(path)
    target = _target(path, out, ".png")
    save_run_figure(log.records, target, path.stem)
    output.result(str(target), {"picture": str(target)})
    return 0


def log_export(path: Path, output: Output, format: str, out: Path | None = None) -> int:
    """Write the log in another format (see `log_export.FORMATS`); by default beside the log."""
    if format not in FORMATS:
        raise DataError(f"format (={format!r}) must be one of {', '.join(FORMATS)}")
    ending, content = FORMATS[format]
    log = read_run_log(path)
    target = _target(path, out, ending)
    replace_file(target, content(log, path))
    count = len(log.frames) if format == "candump" else len(log.records)
    output.result(str(target), {"file": str(target), "format": format, "rows": count})
    if not log.complete:
        output.warning(f"{path}: was cut off, its tail is lost")
    return 0


def _target(path: Path, out: Path | None, ending: str) -> Path:
    target = out if out is not None else path.with_suffix(ending)
    if target.resolve() == path.resolve():
        raise DataError(f"{target}: is the log itself and would be overwritten", "choose another -o")
    if not target.parent.is_dir():
        raise DataError(f"{target}: cannot be written: no folder {target.parent}")
    return target
