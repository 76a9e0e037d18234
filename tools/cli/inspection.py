"""The verbs that look at a bus and a drive: scan, info, monitor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.cli.options import INSPECT, Bitrate, Channel, Interface, Json, Port, Quiet, Target, config_path, loaded
from tools.output import Output

if TYPE_CHECKING:
    from tools.configuration.config import Config
    from tools.inspection.subject import Subject

_NICENESS = 10  # of the monitor: the loop of a run beside it goes first
MaybeConfig = Annotated[
    Path | None, typer.Argument(metavar="[CONFIG]", help="configuration; without it give the bus by -i and -c")
]
Eds = Annotated[Path | None, typer.Option("--eds", help="EDS or DCF file of the node; default: the configuration's")]


def config_of(
    path: Path | None,
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    port: str | None,
    target: int | None,
) -> Config | None:
    """The configuration if one is named.  Its `drive.kind` tells which branch of a verb is meant."""
    return None if path is None else loaded(config_path(path), interface, channel, bitrate, port, target)


def canopen_subject(
    config: Config | None,
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    target: int | None,
    eds: Path | None,
) -> Subject:
    """What a CANopen branch looks at."""
    from tools.inspection.subject import subject_of_config, subject_of_flags

    if config is None:
        return subject_of_flags(interface, channel, bitrate, target, eds)
    return subject_of_config(config, eds)


def scan(
    config: MaybeConfig = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    target: Target = None,
    listen: Annotated[float, typer.Option("--listen", help="seconds to listen before asking", min=0.0)] = 1.2,
    passive: Annotated[bool, typer.Option("--passive", help="only listen, ask nobody")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Which CANopen nodes are on the bus: identity, device type, NMT state, drive state.  Reads only."""
    from tools.verbs.scan import scan as run_scan

    joint = config_of(config, interface, channel, bitrate, None, target)
    subject = canopen_subject(joint, interface, channel, bitrate, target, None)
    raise typer.Exit(run_scan(subject, Output(json=json, quiet=quiet), listen_s=listen, passive=passive))


def info(
    config: MaybeConfig = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    port: Port = None,
    target: Target = None,
    eds: Eds = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """What a drive tells about itself: identity, state, errors by name, limits, ratings, PDO mapping.  Reads only."""
    joint = config_of(config, interface, channel, bitrate, port, target)
    output = Output(json=json, quiet=quiet)
    from tools.verbs.info import info as run_info

    raise typer.Exit(run_info(canopen_subject(joint, interface, channel, bitrate, target, eds), output))


def monitor(
    config: MaybeConfig = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    port: Port = None,
    target: Target = None,
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
    joint = config_of(config, interface, channel, bitrate, port, target)
    output = Output(json=json, quiet=quiet)
    from tools.verbs.monitor import monitor as run_monitor
    from tools.verbs.monitor import selection_of

    selection = selection_of(cob_id or [], kind or [], node or [], count, duration, changes)
    subject = canopen_subject(joint, interface, channel, bitrate, target, eds)
    os.nice(_NICENESS)
    raise typer.Exit(run_monitor(subject, output, selection, ask=ask))


def register(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command(rich_help_panel=INSPECT)(scan)
    app.command(rich_help_panel=INSPECT)(info)
    app.command(rich_help_panel=INSPECT)(monitor)
