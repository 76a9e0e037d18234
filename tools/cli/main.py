"""The command line.  Verbs are imported when they are called, so that `--help` is quick."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from jointctl.drivers.errors import INTERRUPTED, DataError, JointctlError, UsageError
from jointctl.drivers.printable import one_line
from jointctl.tools.cli import experiments as cli_experiments
from jointctl.tools.cli import friction as cli_friction
from jointctl.tools.cli import inspection as cli_inspection
from jointctl.tools.cli import logs as cli_log
from jointctl.tools.cli.option_group import grouped
from jointctl.tools.cli.options import (
    BEGIN,
    MOVE,
    AllowLowMargin,
    BusOptions,
    ConfigPath,
    DryRun,
    Json,
    Quiet,
    Yes,
    config_path,
    loaded,
)
from jointctl.tools.cli.standard_streams import never_refuse_a_character, occupy_standard_streams
from jointctl.tools.cli.unexpected_end import end_unexpected
from jointctl.tools.output import Output, abandon, let_go

EPILOG = (
    "First steps: `jointctl demo` shows all of it on a virtual joint; `jointctl doctor` tells what this computer can "
    "do; `jointctl new my_joint.toml` begins a configuration of your own. CONFIG is a TOML file or the name of a "
    "shipped one: virtual, precise, paper, sweep_virtual, elmo_gold_can, elmo_serial."
)

app = typer.Typer(
    name="jointctl",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"jointctl {version('jointctl')}")
        raise typer.Exit()


@app.callback(epilog=EPILOG)
def callback(
    version: Annotated[
        bool, typer.Option("--version", help="print the version and end", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Robot joint controller: CANopen CiA 402 at 1 kHz, with a virtual joint to try it on."""


@app.command(rich_help_panel=BEGIN)
def demo(
    config: Annotated[Path, typer.Option("--config", help="configuration with a virtual joint")] = Path("virtual"),
    duration: Annotated[float | None, typer.Option("--duration", help="seconds of the trajectory", min=0.1)] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Track a trajectory on the virtual joint: no hardware, no set-up."""
    from jointctl.tools.verbs.demo import demo as run_demo

    raise typer.Exit(run_demo(config_path(config), Output(json=json, quiet=quiet), duration_s=duration))


@app.command(rich_help_panel=MOVE)
@grouped
def run(
    *,
    config: ConfigPath,
    bus: BusOptions,
    yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: AllowLowMargin = False,
    scope: Annotated[bool, typer.Option("--scope", help="live page in the browser (needs the extra scope)")] = False,
    scope_host: Annotated[str, typer.Option("--scope-host", help="address to serve the page at")] = "127.0.0.1",
    scope_port: Annotated[int, typer.Option("--scope-port", min=1, max=65535)] = 8642,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Track the configured trajectory on a real or virtual joint."""
    from jointctl.tools.verbs.run import run as run_run

    joint = loaded(config, bus)
    raise typer.Exit(
        run_run(
            joint,
            Output(json=json, quiet=quiet),
            assume_yes=yes,
            dry_run=dry_run,
            allow_low_margin=allow_low_margin,
            scope=(scope_host, scope_port) if scope else None,
        )
    )


@app.command(rich_help_panel=BEGIN)
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="configuration to write (TOML)")],
    shipped: Annotated[str, typer.Option("--from", help="name of the shipped configuration")] = "elmo_gold_can",
    quiet: Quiet = False,
) -> None:
    """Write a configuration of your own, a copy of a shipped one to fill in."""
    from jointctl.tools.verbs.new import new as run_new

    raise typer.Exit(run_new(file, Output(quiet=quiet), shipped=shipped))


@app.command(rich_help_panel=BEGIN)
@grouped
def hil(
    *,
    config: ConfigPath = Path("virtual"),
    bus: BusOptions,
    serial: Annotated[bool, typer.Option("--serial", help="the virtual serial drive instead of the CAN bus")] = False,
    link: Annotated[str | None, typer.Option("--link", help="serial drive: path of a link to its port")] = None,
    timing: Annotated[bool, typer.Option("--timing", help="model bit times and arbitration")] = False,
    ready_fd: Annotated[int | None, typer.Option("--ready-fd", hidden=True)] = None,
    quiet: Quiet = False,
) -> None:
    """Keep the virtual joint up, on a virtual bus or a pseudo-terminal, for other programs to attach to."""
    from jointctl.tools.verbs.hil import hil as run_hil

    if serial and config == Path("virtual"):
        config = Path("elmo_serial")
    joint = loaded(config, bus)
    if serial or link is not None or joint.is_serial:
        from jointctl.tools.verbs.hil_serial import hil_serial, refuse_options

        refuse_options(joint, port=bus.port, timing=timing)
        raise typer.Exit(hil_serial(joint, Output(quiet=quiet), link=link, ready_fd=ready_fd))
    raise typer.Exit(run_hil(joint, Output(quiet=quiet), timing=timing, ready_fd=ready_fd))


@app.command(rich_help_panel=MOVE)
@grouped
def stop(
    *,
    config: ConfigPath,
    bus: BusOptions,
    json: Json = False,
) -> None:
    """Stop and disable the drive now, also while another program controls it."""
    from jointctl.tools.configuration.stop_target import GivenTarget
    from jointctl.tools.verbs.stop import stop as run_stop

    given = GivenTarget(bus.interface, bus.channel, bus.bitrate, bus.port, bus.target)
    raise typer.Exit(run_stop(config_path(config), Output(json=json), given))


@app.command("clear-fault", rich_help_panel=MOVE)
@grouped
def clear_fault(
    *,
    config: ConfigPath,
    bus: BusOptions,
    json: Json = False,
) -> None:
    """Reset the drive's fault; it stays disabled."""
    from jointctl.tools.verbs.clear_fault import clear_fault as run_clear_fault

    joint = loaded(config, bus)
    raise typer.Exit(run_clear_fault(joint, Output(json=json)))


@app.command(rich_help_panel=BEGIN)
@grouped
def doctor(
    *,
    config: ConfigPath = Path("virtual"),
    bus: BusOptions,
    cold: Annotated[bool, typer.Option("--cold", help="measure the cold start as well (about a minute)")] = False,
    motion: Annotated[
        bool, typer.Option("--motion", help="instead: pull the joint a little; are torque and encoders right?")
    ] = False,
    torque: Annotated[
        float | None, typer.Option("--torque", help="Nm at the joint at most, with --motion", min=0.0)
    ] = None,
    yes: Yes = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """What this computer and bus allow: real-time rights, wake-up times, kernel cache, bus budget.

    Moves nothing; with --motion it asks first, then checks the directions of torque and encoders and their counts.
    """
    joint = loaded(config, bus)
    if motion:
        from jointctl.tools.verbs.doctor_motion import doctor_motion

        raise typer.Exit(doctor_motion(joint, Output(json=json, quiet=quiet), assume_yes=yes, torque_Nm=torque))
    from jointctl.tools.verbs.doctor import doctor as run_doctor

    raise typer.Exit(run_doctor(joint, Output(json=json, quiet=quiet), cold=cold))


@app.command(rich_help_panel=MOVE)
def check(
    config: ConfigPath,
    delay: Annotated[float | None, typer.Option("--delay", help="measured loop delay (s)", min=0.0)] = None,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG to write: Bode, sensitivity, poles")] = None,
    allow_low_margin: Annotated[bool, typer.Option("--allow-low-margin", help="accept a stable loop below it")] = False,
    json: Json = False,
) -> None:
    """Is the control loop stable enough?  Margins, bounds and what would help."""
    from jointctl.tools.verbs.check import check as run_check

    joint = loaded(config)
    raise typer.Exit(run_check(joint, Output(json=json), delay, figure=figure, allow_low_margin=allow_low_margin))


cli_inspection.register(app)
cli_friction.register(app)
cli_log.register(app)
cli_experiments.register(app)


def _start_quickly() -> None:
    """What makes the imports of a verb cost a third less: before numpy, and for the processes that a verb starts.

    One thread for the linear algebra: idle ones spin while they start, and nothing here is large enough to need two.
    And the garbage of an import is not worth looking for.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(100_000, 50, 100)


# typer's own parser or click, as the version has it
_USAGE: type[Exception] = typer.BadParameter.__mro__[1]


def _refuse_usage(error: Any) -> None:
    """One line for what the parser did not understand; without any argument it has shown the help instead."""
    text = one_line(error.format_message())
    if not text:
        return
    command = error.ctx.command_path if error.ctx is not None else "jointctl"
    Output().error(text[0].lower() + text[1:], f"`{command} --help` shows what there is")


def main() -> None:
    """Run a verb; every known error is one line and its own exit code."""
    occupy_standard_streams()
    never_refuse_a_character()
    atexit.register(let_go, sys.stderr)
    _start_quickly()
    try:
        sys.exit(app(standalone_mode=False))
    except JointctlError as error:
        Output().error(error.message, error.hint)
        sys.exit(error.exit_code)
    except _USAGE as error:
        _refuse_usage(error)
        sys.exit(UsageError.exit_code)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            end_unexpected(error)
        Output().error(f"{error.filename or 'a file or the output'}: cannot be written: {error.strerror}")
        if error.filename is None:
            abandon(sys.stdout)
        sys.exit(DataError.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        Output().note("interrupted")
        sys.exit(INTERRUPTED)
    except Exception as error:
        end_unexpected(error)
