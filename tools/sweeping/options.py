"""What the user asks of a sweep: the options of the command line, and whether they go together.

`--help` loads this: what takes its time is in `plan`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.sweeping.grid import MOST_POINTS, check_range
from jointctl.tools.written_file import require_target


@dataclass(frozen=True)
class SweepOptions:
    """None = the default that fits the joint."""

    points: Annotated[int | None, typer.Option("--points", help="plateaus in both directions together (225)")] = None
    grid: Annotated[str, typer.Option("--grid", help="near-zero, linear, log, or list")] = "near-zero"
    speeds: Annotated[
        Path | None, typer.Option("--speeds", metavar="FILE", help="of --grid list: velocities in rad/s, one a line")
    ] = None
    max_speed_radps: Annotated[
        float | None,
        typer.Option("--max-speed", metavar="RAD/S", help="fastest plateau (what limits and travel allow)"),
    ] = None
    min_speed_radps: Annotated[
        float | None, typer.Option("--min-speed", metavar="RAD/S", help="slowest plateau (a thousandth of the fastest)")
    ] = None
    quick: Annotated[bool, typer.Option("--quick", help="as many points as fit into 8 minutes, 120 at most")] = False
    warm_up_turns: Annotated[
        float, typer.Option("--warm-up", metavar="TURNS", help="of the joint, before measuring")
    ] = 1.0
    shuffle_seed: Annotated[
        int | None, typer.Option("--shuffle", metavar="SEED", help="speeds in random order, against drift")
    ] = None
    passes: Annotated[int, typer.Option("--passes", help="times that the whole grid is measured")] = 1
    dwell_s: Annotated[
        float | None, typer.Option("--dwell", metavar="S", help="wanted measuring time per point (1, quick 0.5)")
    ] = None
    mode: Annotated[str, typer.Option("--mode", help="auto, csv, pv or speed (the drive's velocity loop), torque")] = (
        "auto"
    )
    resume: Annotated[bool, typer.Option("--resume", help="measure what is missing in an interrupted sweep")] = False
    dry_run: Annotated[bool, typer.Option("--dry-run", help="commission, show the motion envelope, move nothing")] = (
        False
    )
    assume_yes: Annotated[bool, typer.Option("-y", "--yes", help="move without asking")] = False
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False
    allow_low_margin: Annotated[
        bool,
        typer.Option("--allow-low-margin", help="torque mode: run a stable loop below the wanted phase margin"),
    ] = False
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE.html", help="the result as one self-contained page as well")
    ] = None


AS_IT_FITS = SweepOptions()


def check_options(options: SweepOptions) -> None:
    """`UsageError` for what no joint can have, and for what contradicts itself."""
    if options.points is not None:
        check_range("--points", options.points, 2, MOST_POINTS)
    check_range("--passes", options.passes, 1, 100)
    check_range("--warm-up", options.warm_up_turns, 0.0, 1000.0)
    for name, value in (("--max-speed", options.max_speed_radps), ("--min-speed", options.min_speed_radps)):
        if value is not None:
            check_range(name, value, 1e-5, 1000.0)
    if options.dwell_s is not None:
        check_range("--dwell", options.dwell_s, 0.1, 600.0)
    if (options.grid == "list") != (options.speeds is not None):
        raise UsageError(f"--speeds FILE goes with --grid list (={options.grid}), and --grid list with --speeds")
    if options.grid == "list" and (options.points or options.max_speed_radps or options.min_speed_radps):
        raise UsageError("--points, --max-speed and --min-speed do not go with --grid list: the list says it all")
    if options.quick and (options.points is not None or options.grid == "list"):
        raise UsageError("--quick chooses the number of points: it does not go with --points and --grid list")


def check_files(out: Path, resume: bool) -> None:
    if out.suffix != ".csv":
        raise UsageError(f"-o (={out}) must end in .csv; its sidecar gets the same name with .json")
    require_target(out)
    for file in (out, out.with_suffix(".json")):
        if file.exists() and not resume:
            raise DataError(f"{file}: exists already", "--resume goes on with it, -o gives another name")
