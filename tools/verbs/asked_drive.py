"""What `scan`, `info`, `monitor` and `params` look at: the drive of a configuration, or one that options name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.verbs.verb_options import BusOptions, CanOptions, configurations, loaded, place

if TYPE_CHECKING:
    from jointctl.tools.inspection.subject import Subject
    from jointctl.tools.verbs.bench_drive import Asked

MaybeConfig = Annotated[
    Path | None,
    typer.Argument(
        metavar="[CONFIG]",
        help="configuration; without it give the bus by -i and -c",
        autocompletion=configurations,
    ),
]
Eds = Annotated[Path | None, typer.Option("--eds", help="EDS or DCF file of the node; default: the configuration's")]


def asked_of(path: Path | None, bus: CanOptions, eds: Path | None = None) -> Asked:
    """The configuration if one is named, else what the command line says."""
    from jointctl.tools.verbs.bench_drive import Asked

    given = place(bus)
    if path is None and given.port is not None:
        raise ConfigurationError("-p needs a configuration: it tells the baud rate", "for example elmo_serial")
    return Asked(None if path is None else loaded(path, bus), given, eds)


def subject_of(path: Path | None, bus: CanOptions, eds: Path | None = None) -> Subject:
    """For a verb that is for CANopen only."""
    from jointctl.tools.verbs.canopen_bench import canopen_subject

    return canopen_subject(asked_of(path, bus, eds))


def _asked(*, config: MaybeConfig = None, bus: BusOptions, eds: Eds = None) -> Asked:
    return asked_of(config, bus, eds)


def _subject(*, config: MaybeConfig = None, bus: CanOptions) -> Subject:
    return subject_of(config, bus)


def _subject_with_eds(*, config: MaybeConfig = None, bus: CanOptions, eds: Eds = None) -> Subject:
    return subject_of(config, bus, eds)


AskedDrive = Annotated["Asked", _asked]
NodeOnBus = Annotated["Subject", _subject]
NodeWithEds = Annotated["Subject", _subject_with_eds]
