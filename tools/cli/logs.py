"""The verbs that look at run logs: log info, plot, export; report; scope."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jointctl.tools.cli.option_group import grouped
from jointctl.tools.cli.options import LOOK, AllowLowMargin, CanOptions, Json, Quiet, loaded
from jointctl.tools.output import Output

LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="run log (MCAP)")]

log_app = typer.Typer(help="Look at a run log: what it holds, a picture, other formats.", no_args_is_help=True)


@log_app.command("info")
def info(log: LogPath, json: Json = False) -> None:
    """What the log holds, the run in numbers, its events."""
    from jointctl.tools.verbs.log import log_info

    raise typer.Exit(log_info(log, Output(json=json)))


@log_app.command("plot")
def plot(
    log: LogPath,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="PNG to write; default: beside the log")] = None,
    json: Json = False,
) -> None:
    """The picture of the run."""
    from jointctl.tools.verbs.log import log_plot

    raise typer.Exit(log_plot(log, Output(json=json), out))


@log_app.command("export")
def export(
    log: LogPath,
    format: Annotated[str, typer.Option("-f", "--format", help="csv, npz, parquet, or candump for the raw frames")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="file to write; default: beside the log")] = None,
    json: Json = False,
) -> None:
    """The log in another format."""
    from jointctl.tools.verbs.log import log_export

    raise typer.Exit(log_export(log, Output(json=json), format, out))


def report(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="run logs; several are compared")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="HTML to write; default: beside the log")] = None,
    json: Json = False,
) -> None:
    """One self-contained page about a run, or about several beside each other."""
    from jointctl.tools.verbs.report import report as run_report

    raise typer.Exit(run_report(logs, Output(json=json), out))


@grouped
def scope(
    *,
    path: Annotated[Path, typer.Argument(metavar="LOG|CONFIG", help="run log (MCAP), or configuration of a joint")],
    host: Annotated[str, typer.Option("--host", help="address to serve at")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", help="of the page")] = 8642,
    bus: CanOptions,
    allow_low_margin: AllowLowMargin = False,
    stop_unwatched: Annotated[
        float | None,
        typer.Option("--stop-unwatched", metavar="S", min=1.0, help="brake when no page has been open for S seconds"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """A local web page: a run log to zoom into, or a joint to start, watch, change and stop from the browser."""
    from jointctl.tools.verbs.scope import live_scope
    from jointctl.tools.verbs.scope import scope as run_scope

    output = Output(quiet=quiet)
    if path.suffix == ".mcap":
        raise typer.Exit(run_scope(path, output, host=host, port=port))
    joint = loaded(path, bus)
    code = live_scope(
        joint, output, host=host, port=port, allow_low_margin=allow_low_margin, unwatched_s=stop_unwatched
    )
    raise typer.Exit(code)


def register(app: typer.Typer) -> None:
    """Add the verbs."""
    app.add_typer(log_app, name="log", rich_help_panel=LOOK)
    app.command(rich_help_panel=LOOK)(report)
    app.command(rich_help_panel=LOOK)(scope)
