"""`jointctl report LOG...`: one self-contained page about one run, or about several beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import DataError
from jointctl.tools.verbs.verb_options import ResultOutput

if TYPE_CHECKING:
    from jointctl.tools.recording.report_page import Block, Section
    from jointctl.tools.recording.run_log_reader import RunLog
    from jointctl.tools.recording.run_summary import RunSummary

MOST_LOGS = 16  # as many as the largest arm has joints


def report(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...", help="run logs; several are compared")],
    output: ResultOutput,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="HTML to write; default: beside the log")] = None,
) -> int:
    """One self-contained page about a run, or about several beside each other."""
    from jointctl.tools.recording.report_page import check_target, page, write_page
    from jointctl.tools.recording.run_log_reader import read_run_log
    from jointctl.tools.written_file import file_stems, with_ending

    if not 1 <= len(paths) <= MOST_LOGS:
        raise DataError(f"number of logs (={len(paths)}) must be in [1..{MOST_LOGS}]")
    logs = [read_run_log(path) for path in paths]
    target = out or with_ending(paths[0], ".html" if len(paths) == 1 else ".comparison.html")
    check_target(target, paths)
    for path, log in zip(paths, logs, strict=True):
        if len(log.records) < 2:
            raise DataError(f"{path}: nothing to report, the run has {len(log.records)} records")
    names = of_one_arm(logs)
    if names:
        title = f"{paths[0].stem.removesuffix(f'.{file_stems(names[:1])[0]}')}: {', '.join(names)}"
    else:
        names = log_names(paths)
        title = " and ".join(names)
    html = page(title, report_sections(names, logs), subtitle=", ".join(str(path) for path in paths))
    write_page(target, html, paths)
    output.result(str(target), {"report": str(target), "logs": [str(path) for path in paths]}, target)
    return 0


def log_names(paths: Sequence[Path]) -> list[str]:
    """Short and all different."""
    stems = [path.stem for path in paths]
    return [stem if stems.count(stem) == 1 else f"{stem} ({i})" for i, stem in enumerate(stems, 1)]


def of_one_arm(logs: Sequence[RunLog]) -> list[str]:
    """The joints' names where all are different joints of one arm in one run; else empty."""
    arms = [log.metadata.get("arm", {}) for log in logs]
    names = [arm.get("joint", "") for arm in arms]
    times_ns = [log.records["time_ns"][[0, -1]] for log in logs]
    at_once = max(first for first, _ in times_ns) < min(last for _, last in times_ns)
    same = len({arm.get("configuration") for arm in arms}) == 1 and at_once
    return names if len(logs) > 1 and all(names) and len(set(names)) == len(names) and same else []


def report_sections(names: Sequence[str], logs: Sequence[RunLog]) -> list[Section]:
    """The body of the page."""
    from jointctl.firmware_py.states import Fault
    from jointctl.tools.recording.report_figures import (
        comparison,
        events_table,
        figure_tables,
        run_figures,
        temperature_figure,
        together,
        what_ran,
    )
    from jointctl.tools.recording.report_page import Details, Paragraph, Section
    from jointctl.tools.recording.run_summary import summarise

    summaries = [summarise(log.records, temperatures_degC=log.temperatures["temperature_degC"]) for log in logs]
    verdicts = [
        Paragraph(verdict(name, s), "" if s.fault == Fault.NONE.name else "error")
        for name, s in zip(names, summaries, strict=True)
    ]
    joints = bool(of_one_arm(logs))
    sections = [
        Section("What ran", [*verdicts, what_ran(names, logs)]),
        Section("In numbers", figure_tables(names, logs, summaries, of_one_arm=joints)),
    ]
    if len(logs) > 1:
        records = [log.records for log in logs]
        blocks = together(names, records) if joints else comparison(names, records)
        sections.append(Section("Side by side", blocks))
    for name, log in zip(names, logs, strict=True):
        title = "Figures" if len(logs) == 1 else f"Figures of {name}"
        sections.append(Section(title, [*run_figures(log.records), *temperature_figure(log)]))
        events: list[Block] = [events_table(log)] if log.events else [Paragraph("The log holds no events.")]
        sections.append(Section("Events" if len(logs) == 1 else f"Events of {name}", events))
    details = [
        Details(f"Configuration of {name}", log.metadata["run"]["configuration"])
        for name, log in zip(names, logs, strict=True)
        if log.metadata.get("run", {}).get("configuration")
    ]
    return [*sections, Section("Configuration", details)] if details else sections


def verdict(name: str, summary: RunSummary) -> str:
    """The run in one sentence."""
    from jointctl.firmware_py.states import Fault

    if summary.fault != Fault.NONE.name:
        return f"{name} was ended by the fault {summary.fault} after {summary.tracked_s:.1f} s of tracking."
    if summary.error is None:
        return f"{name} never tracked."
    low, high = summary.error.range_rad.least * 1e3, summary.error.range_rad.greatest * 1e3
    return (
        f"{name} tracked {summary.tracked_s:.1f} s without a fault: error {low:.3f} to {high:.3f} mrad, "
        f"RMSE {summary.error.rmse_rad * 1e3:.3f} mrad, {summary.skipped_cycles} of "
        f"{summary.cycles + summary.skipped_cycles} cycles skipped."
    )
