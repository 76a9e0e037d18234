"""`jointctl paper`: every experiment of the paper on the virtual joint, the paper's figures beside ours."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from jointctl.tools.verbs.verb_options import Report, VerbOutput

if TYPE_CHECKING:
    from jointctl.tools.experiments.paper_experiments import PaperIdentification, PaperRow, PaperRun

PAPER = (
    "Shen, Zhou, Yu, Wang: Design of Adaptive RBFNN and Computed-torque Control for Manipulator Joint "
    "Considering Friction Modeling"
)


@dataclass(frozen=True)
class PaperResult:
    """The paper's experiments: the rows of the table, and the runs behind them by name."""

    rows: list[PaperRow]
    runs: dict[str, PaperRun]
    identified: PaperIdentification | None


def paper(
    output: VerbOutput,
    *,
    folder: Annotated[Path | None, typer.Option("--figures", help="folder for the figures; without it none")] = None,
    no_identification: Annotated[
        bool, typer.Option("--no-identification", help="leave the identification figures out")
    ] = False,
    report: Report = None,
) -> int:
    """Reproduce every experiment of the paper on the virtual joint, in lockstep: its figure beside ours."""
    from jointctl.tools.drawing import save_png
    from jointctl.tools.experiments.paper_experiments import (
        PaperRun,
        experiments,
        identify_paper_friction,
        paper_rows,
        window_s,
    )
    from jointctl.tools.experiments.scenarios import error_figures
    from jointctl.tools.recording.report_page import Section, check_target, from_terminal, svg_figure, write_verb_page
    from jointctl.tools.written_file import prepare_folder

    if report is not None:
        check_target(report)
    if folder is not None:
        prepare_folder(folder)
    listed = experiments()
    runs: dict[str, PaperRun] = {}
    identified: PaperIdentification | None = None
    with output.progress("the paper's experiments", len(listed) + 1) as advance:
        for number, experiment in enumerate(listed, 1):
            runs[experiment.key] = PaperRun(experiment, experiment.run())
            advance(number)
        if not no_identification:
            identified = identify_paper_friction()
        advance(len(listed) + 1)
    figures = _figures(runs, identified) if folder is not None or report is not None else {}
    pictures = (
        [save_png(drawn, folder / f"{name}.png") for name, drawn in figures.items()] if folder is not None else []
    )
    rows = paper_rows(runs, identified)
    data = {
        "paper": PAPER,
        "rows": [asdict(row) for row in rows],
        "runs": {key: asdict(error_figures(made.run, window_s(made.experiment))) for key, made in runs.items()},
        "pictures": [str(path) for path in pictures],
    }
    output.result(_table(rows), data, PaperResult(rows, runs, identified))
    for path in pictures:
        output.note(f"written: {path}")
    if report is not None:
        blocks = [svg_figure(drawn, name.replace("_", " ")) for name, drawn in figures.items()]
        sections = [Section("In numbers", [from_terminal(_table(rows))]), Section("Figures", blocks)]
        write_verb_page(report, "The paper's experiments", sections, output, subtitle=PAPER)
    return 0


def _figures(runs: dict[str, PaperRun], identified: PaperIdentification | None) -> dict[str, Any]:
    """By the name of the file, in the paper's order."""
    from jointctl.tools.experiments.paper_experiments import draw_all, identification_figure

    found = {"fig07_identification": identification_figure(identified)} if identified is not None else {}
    return {**found, **draw_all(runs)}


def _table(rows: list[PaperRow]) -> Table:
    from jointctl.tools.experiments.paper_experiments import AFTER_s

    table = Table(
        "experiment", "paper", "reference", "ours", "precise", "note",
        title=f"Errors in mrad from {AFTER_s:g} s on, after a change from it on: (least, greatest) RMSE",
        caption=f"paper: {PAPER}. reference: an independent simulation of the same equations. "
        "R1: realistic joint, friction 10 % above the model. precise: configs/precise.toml on R1.",
        title_justify="left",
        caption_justify="left",
    )  # fmt: skip
    for row in rows:
        table.add_row(row.experiment, row.paper, row.reference, row.ours, row.precise, row.note)
    return table
