"""The options of `jointctl sweep`, as the command line shows them; everything else is in `sweep`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jointctl.tools.cli.option_group import grouped
from jointctl.tools.cli.options import (
    BusOptions,
    ConfigPath,
    DryRun,
    Json,
    Quiet,
    Report,
    Yes,
    loaded,
)
from jointctl.tools.output import Output


@grouped
def sweep_command(
    *,
    config: ConfigPath,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="CSV file to write; its sidecar is the same name with .json")
    ],
    points: Annotated[int | None, typer.Option("--points", help="plateaus in both directions together (225)")] = None,
    grid: Annotated[str, typer.Option("--grid", help="near-zero, linear, log, or list")] = "near-zero",
    speeds: Annotated[
        Path | None, typer.Option("--speeds", metavar="FILE", help="of --grid list: velocities in rad/s, one a line")
    ] = None,
    max_speed: Annotated[
        float | None,
        typer.Option("--max-speed", metavar="RAD/S", help="fastest plateau (what limits and travel allow)"),
    ] = None,
    min_speed: Annotated[
        float | None, typer.Option("--min-speed", metavar="RAD/S", help="slowest plateau (a thousandth of the fastest)")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="as many points as fit into 8 minutes, 120 at most")] = False,
    warm_up: Annotated[float, typer.Option("--warm-up", metavar="TURNS", help="of the joint, before measuring")] = 1.0,
    shuffle: Annotated[
        int | None, typer.Option("--shuffle", metavar="SEED", help="speeds in random order, against drift")
    ] = None,
    passes: Annotated[int, typer.Option("--passes", help="times that the whole grid is measured")] = 1,
    dwell: Annotated[
        float | None, typer.Option("--dwell", metavar="S", help="wanted measuring time per point (1, quick 0.5)")
    ] = None,
    mode: Annotated[
        str, typer.Option("--mode", help="auto, csv, pv or speed (the drive's velocity loop), torque")
    ] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="measure what is missing in an interrupted sweep")] = False,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False,
    bus: BusOptions,
    yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: Annotated[
        bool,
        typer.Option("--allow-low-margin", help="torque mode: run a stable loop below the wanted phase margin"),
    ] = False,
    report: Report = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure friction: plateaus of constant speed in both directions, into a CSV file for `identify`."""
    from jointctl.tools.sweeping.options import SweepOptions
    from jointctl.tools.verbs.sweep import sweep

    configuration = loaded(config, bus)
    options = SweepOptions(
        points=points, grid=grid, speeds=speeds, max_speed_radps=max_speed, min_speed_radps=min_speed, quick=quick,
        warm_up_turns=warm_up, shuffle_seed=shuffle, passes=passes, dwell_s=dwell, mode=mode, resume=resume,
        dry_run=dry_run, assume_yes=yes, lockstep=lockstep, allow_low_margin=allow_low_margin,
        report=report,
    )  # fmt: skip
    raise typer.Exit(sweep(configuration, Output(json=json, quiet=quiet), out, options))
