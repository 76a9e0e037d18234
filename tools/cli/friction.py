"""The verbs around friction: sweep, identify, validate."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.tools.cli.option_group import grouped
from jointctl.tools.cli.options import FRICTION, Json, Quiet, Report, config_path
from jointctl.tools.cli.sweep_command import sweep_command
from jointctl.tools.output import Output

if TYPE_CHECKING:
    from jointctl.tools.identification.friction_data import ForeignFormat

Data = Annotated[Path, typer.Argument(metavar="DATA", help="CSV of velocity plateaus, from sweep or elsewhere")]
Model = Annotated[str, typer.Option("--model", help="multi-stage, stribeck, coulomb-viscous, or auto (held-out error)")]


@dataclass(frozen=True)
class TableOptions:
    """How to read a table that is not ours; a field of `ForeignFormat` each."""

    velocity_column: Annotated[str | None, typer.Option("--velocity-column", help="name of the velocity column")] = None
    torque_column: Annotated[str | None, typer.Option("--torque-column", help="name of the torque column (Nm)")] = None
    current_column: Annotated[str | None, typer.Option("--current-column", help="name of the current column (A)")] = (
        None
    )
    velocity_unit: Annotated[str | None, typer.Option("--velocity-unit", help="deg/s, rad/s or r/min")] = None
    side: Annotated[str | None, typer.Option("--side", help="of the velocity: joint or motor")] = None
    torque_side: Annotated[str | None, typer.Option("--torque-side", help="motor or joint")] = None
    ratio: Annotated[float | None, typer.Option("--ratio", help="reduction ratio")] = None
    torque_constant_NmpA: Annotated[float | None, typer.Option("--torque-constant", help="of the motor (Nm/A)")] = None
    delimiter: Annotated[str, typer.Option("--delimiter", help="between columns: auto, or the character")] = "auto"

    def told(self) -> ForeignFormat:
        from jointctl.tools.identification.friction_data import ForeignFormat

        return ForeignFormat(**asdict(self))


def _radps(speed_degps: float | None) -> float | None:
    return None if speed_degps is None else math.radians(speed_degps)


@grouped
def identify(
    *,
    data: Data,
    into: Annotated[Path | None, typer.Option("--into", help="configuration whose friction section to replace")] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="TOML file to write instead")] = None,
    config: Annotated[Path | None, typer.Option("--config", help="configuration to check plausibility against")] = None,
    table: TableOptions,
    model: Model = "multi-stage",
    continuous: Annotated[bool, typer.Option("--continuous", help="let the two stages meet at the knees")] = False,
    search_knee: Annotated[bool, typer.Option("--search-knee", help="search the knees as well")] = False,
    knee: Annotated[float, typer.Option("--knee", help="speed at which the stages change (deg/s of the joint)")] = 40.0,
    ws_min: Annotated[float | None, typer.Option("--ws-min", help="least Stribeck speed (deg/s)")] = None,
    ws_max: Annotated[float, typer.Option("--ws-max", help="greatest Stribeck speed (deg/s)")] = 20.0,
    static_max: Annotated[
        float | None, typer.Option("--static-max", help="greatest static friction (Nm, motor)")
    ] = None,
    outlier_threshold: Annotated[float, typer.Option("--outlier-threshold", help="robust deviations; 0 = off")] = 5.0,
    folds: Annotated[int, typer.Option("--folds", help="of the held-out error")] = 10,
    particles: Annotated[int, typer.Option("--particles")] = 1000,
    iterations: Annotated[int, typer.Option("--iterations")] = 5000,
    inertia: Annotated[float, typer.Option("--inertia", help="of the swarm")] = 0.7298,
    cognitive: Annotated[float, typer.Option("--cognitive")] = 1.49618,
    social: Annotated[float, typer.Option("--social")] = 1.49618,
    seed: Annotated[int, typer.Option("--seed")] = 1,
    stall: Annotated[
        int, typer.Option("--stall", help="stop after so many iterations without progress; 0 = never")
    ] = 0,
    report: Report = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fit the friction model (11) to measured plateaus; writes TOML, figures and a report beside the data."""
    from jointctl.tools.identification.identification import Options
    from jointctl.tools.identification.swarm import SwarmSettings
    from jointctl.tools.verbs.identify import identify as run_identify

    options = Options(
        model=model,
        continuous=continuous,
        search_knee=search_knee,
        knee_radps=math.radians(knee),
        ws_min_radps=_radps(ws_min),
        ws_max_radps=math.radians(ws_max),
        static_max_Nm=static_max,
        outlier_threshold=outlier_threshold,
        folds=folds,
        swarm=SwarmSettings(particles, iterations, inertia, cognitive, social, seed, stall),
    )
    output = Output(json=json, quiet=quiet)
    config = None if config is None else config_path(config)
    raise typer.Exit(
        run_identify(data, output, into=into, out=out, config=config, told=table.told(), options=options, report=report)
    )


@grouped
def validate(
    *,
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="configuration with the identified friction section")
    ],
    data: Data,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG to write")] = None,
    table: TableOptions,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """An identified friction model against other data of the same joint."""
    from jointctl.tools.verbs.validate import validate as run_validate

    raise typer.Exit(
        run_validate(config_path(config), data, Output(json=json, quiet=quiet), told=table.told(), figure=figure)
    )


def register(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command("sweep", rich_help_panel=FRICTION)(sweep_command)
    app.command(rich_help_panel=FRICTION)(identify)
    app.command(rich_help_panel=FRICTION)(validate)
