"""The verbs that look at a bus and a drive: scan, info, monitor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.cli.option_group import grouped
from jointctl.tools.cli.options import INSPECT, BusOptions, CanOptions, Json, Quiet, loaded
from jointctl.tools.output import Output

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.inspection.subject import Subject

_NICENESS = 10  # of the monitor: the loop of a run beside it goes first
MaybeConfig = Annotated[
    Path | None, typer.Argument(metavar="[CONFIG]", help="configuration; without it give the bus by -i and -c")
]
Eds = Annotated[Path | None, typer.Option("--eds", help="EDS or DCF file of the node; default: the configuration's")]


def config_of(path: Path | None, bus: CanOptions) -> Config | None:
    """The configuration if one is named.  Whether it `is_serial` tells which branch of a verb is meant."""
    if path is None and isinstance(bus, BusOptions) and bus.port is not None:
        raise ConfigurationError("-p needs a configuration: it tells the baud rate", "for example elmo_serial")
    return None if path is None else loaded(path, bus)


def canopen_subject(config: Config | None, bus: CanOptions, eds: Path | None) -> Subject:
    """What a CANopen branch looks at."""
    from jointctl.tools.inspection.subject import subject_of_config, subject_of_flags

    if config is None:
        return subject_of_flags(bus.interface, bus.channel, bus.bitrate, bus.target, eds)
    return subject_of_config(config, eds)


def subject_of(path: Path | None, bus: CanOptions, eds: Path | None = None) -> Subject:
    """For a verb that has a CANopen branch only."""
    return canopen_subject(config_of(path, bus), bus, eds)


@grouped
def scan(
    *,
    config: MaybeConfig = None,
    bus: CanOptions,
    listen: Annotated[float, typer.Option("--listen", help="seconds to listen before asking", min=0.0)] = 1.2,
    passive: Annotated[bool, typer.Option("--passive", help="only listen, ask nobody")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Which CANopen nodes are on the bus: identity, device type, NMT state, drive state.  Reads only."""
    from jointctl.tools.verbs.scan import scan as run_scan

    subject = subject_of(config, bus)
    raise typer.Exit(run_scan(subject, Output(json=json, quiet=quiet), listen_s=listen, passive=passive))


@grouped
def info(
    *,
    config: MaybeConfig = None,
    bus: BusOptions,
    eds: Eds = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """What a drive tells about itself: identity, state, errors by name, limits, ratings, PDO mapping.  Reads only."""
    joint = config_of(config, bus)
    output = Output(json=json, quiet=quiet)
    if joint is not None and joint.is_serial:
        from jointctl.tools.verbs.info_serial import info_serial

        raise typer.Exit(info_serial(joint, output))
    from jointctl.tools.verbs.info import info as run_info

    raise typer.Exit(run_info(canopen_subject(joint, bus, eds), output))


@grouped
def monitor(
    *,
    config: MaybeConfig = None,
    bus: BusOptions,
    eds: Eds = None,
    cob_id: Annotated[list[str] | None, typer.Option("--cob-id", help="identifier (hex); may be repeated")] = None,
    kind: Annotated[
        list[str] | None, typer.Option("--kind", help="nmt, sync, time, emcy, pdo, sdo, heartbeat, lss, error, other")
    ] = None,
    node: Annotated[list[int] | None, typer.Option("--node", help="node number; may be repeated")] = None,
    count: Annotated[int | None, typer.Option("--count", help="end after so many lines", min=1)] = None,
    duration: Annotated[float | None, typer.Option("--duration", help="end after so many seconds", min=0.0)] = None,
    changes: Annotated[bool, typer.Option("--changes", help="only frames that differ from the last of theirs")] = False,
    ask: Annotated[bool, typer.Option("--ask", help="read the PDO mapping from the drive first (sends SDO)")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """The traffic of a bus in words: NMT, SYNC, heartbeats, EMCY, SDO, PDO by their mapping.  Listens only."""
    joint = config_of(config, bus)
    output = Output(json=json, quiet=quiet)
    if joint is not None and joint.is_serial:
        from jointctl.tools.verbs.monitor_serial import monitor_serial

        raise typer.Exit(monitor_serial(joint, output, count=count, duration_s=duration, changes=changes))
    from jointctl.tools.verbs.monitor import monitor as run_monitor
    from jointctl.tools.verbs.monitor import selection_of

    selection = selection_of(cob_id or [], kind or [], node or [], count, duration, changes)
    subject = canopen_subject(joint, bus, eds)
    os.nice(_NICENESS)
    raise typer.Exit(run_monitor(subject, output, selection, ask=ask))


params_app = typer.Typer(help="All objects of a drive to a file and back.", no_args_is_help=True)


@params_app.command("dump")
@grouped
def params_dump(
    *,
    config: MaybeConfig = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="DCF to write (.dcf); default: stdout")] = None,
    bus: CanOptions,
    eds: Eds = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Read every readable object of the EDS.  Reads only."""
    from jointctl.tools.verbs.params import dump

    subject = subject_of(config, bus, eds)
    raise typer.Exit(dump(subject, Output(json=json, quiet=quiet), out))


@params_app.command("restore")
@grouped
def params_restore(
    *,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a DCF, or a TOML dump of an older version")],
    config: MaybeConfig = None,
    bus: CanOptions,
    eds: Eds = None,
    yes: Annotated[bool, typer.Option("-y", "--yes", help="write without asking")] = False,
    other_device: Annotated[
        bool, typer.Option("--other-device", help="write although maker, product or node differ")
    ] = False,
    skip: Annotated[list[str] | None, typer.Option("--skip", help="index to leave alone; may be repeated")] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write the parameters that differ, read each back, tell what was refused.  The drive must be off."""
    from jointctl.tools.verbs.params import place_index, restore_file

    subject = subject_of(config, bus, eds)
    indices = [place_index(text) for text in skip or []]
    output = Output(json=json, quiet=quiet)
    raise typer.Exit(restore_file(subject, file, output, assume_yes=yes, other_device=other_device, skip=indices))


@params_app.command("diff")
@grouped
def params_diff(
    *,
    first: Annotated[
        Path, typer.Argument(metavar="FIRST", help="DCF, EDS, older dump; or configuration: its drive now")
    ],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="the same")],
    bus: CanOptions,
    readings: Annotated[bool, typer.Option("--readings", help="what is no parameter as well")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare two files, or a file and a drive.  Exit code 11 if they differ."""
    from jointctl.tools.inspection.objects import Objects
    from jointctl.tools.inspection.parameters import is_parameter_file, load_parameters
    from jointctl.tools.verbs.params import diff, parameters_of_drive

    output = Output(json=json, quiet=quiet)
    objects, sides = Objects(), []
    for path in (first, second):
        if is_parameter_file(path):
            sides.append(load_parameters(path, bus.target or 1))
        else:
            subject = subject_of(path, bus)
            found, objects = parameters_of_drive(subject, output)
            sides.append(found)
    raise typer.Exit(diff(sides[0], sides[1], objects, output, readings=readings))


def register(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command(rich_help_panel=INSPECT)(scan)
    app.command(rich_help_panel=INSPECT)(info)
    app.command(rich_help_panel=INSPECT)(monitor)
    app.add_typer(params_app, name="params", rich_help_panel=INSPECT)
