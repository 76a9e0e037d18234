"""The verbs around simulated experiments: paper, study, fault-campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from jointctl.tools.cli.options import COMPARE, Json, Quiet, Report, Workers, loaded
from jointctl.tools.output import Output

LARGEST = 2**31 - 1  # of a seed or of a scenario's number


def paper(
    figures: Annotated[Path | None, typer.Option("--figures", help="folder for the figures; without it none")] = None,
    no_identification: Annotated[
        bool, typer.Option("--no-identification", help="leave the identification figures out")
    ] = False,
    report: Report = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Reproduce every experiment of the paper on the virtual joint, in lockstep: its figure beside ours."""
    from jointctl.tools.verbs.paper import paper as run_paper

    output = Output(json=json, quiet=quiet)
    raise typer.Exit(run_paper(output, folder=figures, identification=not no_identification, report=report))


def study(
    file: Annotated[Path | None, typer.Option("--file", help="TOML with plants, seed and controllers")] = None,
    plants: Annotated[int | None, typer.Option("--plants", help="how many random plants")] = None,
    seed: Annotated[int | None, typer.Option("--seed")] = None,
    after: Annotated[float | None, typer.Option("--after", help="errors are taken after this time (s)")] = None,
    scenario: Annotated[str | None, typer.Option("--scenario", help="sine, frequency, amplitude or load")] = None,
    controller: Annotated[
        list[str] | None, typer.Option("--controller", help="name or configuration file; may be repeated")
    ] = None,
    base: Annotated[str | None, typer.Option("--base", help="configuration of the joint: name or file")] = None,
    workers: Workers = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="file for all single results")] = None,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG with a box plot")] = None,
    report: Report = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare controllers on many random joints: medians and 5-95 % ranges of error, peak and settling time."""
    from jointctl.tools.experiments.controller_study import StudySettings, checked, load_study
    from jointctl.tools.verbs.study import study as run_study

    given: dict[str, Any] = {
        "plants": plants,
        "seed": seed,
        "after_s": after,
        "scenario": scenario,
        "controllers": controller or None,
        "base": base,
    }
    flags = {key: value for key, value in given.items() if value is not None}
    settings = load_study(file) if file is not None else StudySettings()
    settings = checked({**settings.model_dump(), **flags}, "command line")
    output = Output(json=json, quiet=quiet)
    raise typer.Exit(run_study(settings, output, file=file, workers=workers, csv=csv, figure=figure, report=report))


def fault_campaign(
    config: Annotated[Path, typer.Argument(metavar="CONFIG")] = Path("virtual"),
    count: Annotated[int, typer.Option("--count", help="how many random scenarios", min=1, max=LARGEST)] = 10_000,
    seed: Annotated[int, typer.Option("--seed", min=0, max=LARGEST)] = 1,
    scenario: Annotated[
        int | None, typer.Option("--scenario", help="replay this one alone", min=0, max=LARGEST)
    ] = None,
    sweep: Annotated[bool, typer.Option("--sweep", help="during a sweep, in its mode, instead of a run")] = False,
    folder: Annotated[Path, typer.Option("--folder", help="for report, JSON and picture")] = Path("fault-campaign"),
    workers: Workers = None,
    report: Report = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Random faults on random joints in lockstep; every safety invariant is checked in every scenario."""
    from jointctl.tools.verbs.fault_campaign import fault_campaign as run_campaign

    output = Output(json=json, quiet=quiet)
    raise typer.Exit(
        run_campaign(
            loaded(config),
            output,
            count=count,
            seed=seed,
            scenario=scenario,
            sweep=sweep,
            folder=folder,
            workers=workers,
            report=report,
        )
    )


def register(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command(rich_help_panel=COMPARE)(paper)
    app.command(rich_help_panel=COMPARE)(study)
    app.command("fault-campaign", rich_help_panel=COMPARE)(fault_campaign)
