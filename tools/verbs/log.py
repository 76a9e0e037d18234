"""`jointctl log info | plot | export`: look at a run log without another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group
from rich.table import Column, Table

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.verbs.verb_options import ResultOutput, Verb, Verbs, grouped

if TYPE_CHECKING:
    from jointctl.tools.recording.run_log_reader import RunLog

_SHOWN_EVENTS = 100

LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="run log (MCAP)")]


def log_info(path: LogPath, output: ResultOutput) -> int:
    """What the log holds, the run in numbers, its events."""
    from jointctl.tools.recording.run_log_reader import began_at, kept_share, level_name, missing_in, read_run_log
    from jointctl.tools.recording.run_summary import summarise, summary_table

    log = read_run_log(path)
    summary = summarise(log.records, temperatures_degC=log.temperatures["temperature_degC"])
    drive = log.metadata.get("drive", {})
    facts = {
        "file": str(path),
        "bytes": path.stat().st_size,
        "complete": log.complete,
        "began": began_at(log),
        "configuration": log.metadata.get("run", {}).get("path", ""),
        "records": len(log.records),
        "records_kept": kept_share(log),
        "missing_records": missing_in(log),
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
            {"time_ns": e.time_ns, "level": level_name(e), "source": e.source, "text": e.text} for e in log.events
        ],
    }
    shown = [_facts_table(facts, drive), summary_table(summary), _event_table(log)]
    output.result(Group(*shown[: 2 if not log.events else 3]), data)
    if not log.complete:
        output.warning(f"{path}: was cut off, its tail is lost")
    return 0


def _facts_table(facts: dict[str, Any], drive: dict[str, str]) -> Table:
    table = Table(Column(style="bold"), "", title="Log", show_header=False, title_justify="left")
    for name, value in facts.items():
        if value not in ("", None):
            text = str(value) if not isinstance(value, bool) else "yes" if value else "no, cut off"
            table.add_row(name.replace("_", " "), text)
    identity = ", ".join(
        f"{key} {drive[key]}" for key in ("name", "vendor", "product", "serial", "mode") if drive.get(key)
    )
    if identity:
        table.add_row("drive", identity)
    return table


def _event_table(log: RunLog) -> Table:
    from jointctl.tools.recording.run_log_reader import event_rows

    rows = event_rows(log)
    left_out = len(rows) - _SHOWN_EVENTS
    columns = (Column("time [s]", justify="right"), "level", "source", "text")
    caption = f"and {left_out} more" if left_out > 0 else None
    table = Table(*columns, title="Events", title_justify="left", caption=caption)
    for at, level, source, text in rows[:_SHOWN_EVENTS]:
        style = {"error": "red", "warning": "yellow"}.get(level)
        table.add_row(at, level, source, text, style=style)
    return table


def log_plot(
    path: LogPath,
    output: ResultOutput,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="PNG to write; default: beside the log")] = None,
) -> int:
    """The picture of the run."""
    from jointctl.tools.recording.run_log_reader import read_run_log
    from jointctl.tools.recording.run_summary import save_run_figure

    log = read_run_log(path)
    if not len(log.records):
        raise DataError(f"{path}: nothing to draw, the run has 0 records")
    target = _target(path, out, ".png")
    save_run_figure(log.records, target, path.stem)
    output.result(str(target), {"picture": str(target)})
    return 0


def log_export(
    path: LogPath,
    output: ResultOutput,
    format: Annotated[str, typer.Option("-f", "--format", help="csv, npz, parquet, or candump for the raw frames")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="file to write; default: beside the log")] = None,
) -> int:
    """The log in another format."""
    from jointctl.tools.recording.run_log_reader import FORMATS, read_run_log
    from jointctl.tools.written_file import replace_file

    if format not in FORMATS:
        raise UsageError(f"--format (={format}) must be one of {', '.join(FORMATS)}")
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
    from jointctl.tools.recording.run_log_reader import FORMATS
    from jointctl.tools.written_file import require_target

    target = out if out is not None else path.with_suffix(ending)
    require_target(target, (path,))
    known = {".png", ".mcap", *(each for each, _ in FORMATS.values())}
    if target.suffix in known and target.suffix != ending:  # most likely one that is there
        raise UsageError(f"--out (={target}) is the name of another kind of file, must end in {ending}")
    return target


log_app = typer.Typer(
    cls=Verbs, help="Look at a run log: what it holds, a picture, other formats.", no_args_is_help=True
)
for _verb in (log_info, log_plot, log_export):
    log_app.command(_verb.__name__.removeprefix("log_"), cls=Verb)(grouped(_verb))
