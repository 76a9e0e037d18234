"""`jointctl new FILE`: a configuration of one's own, copied from a shipped one or filled in from the drive."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError, DataError, UsageError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import Bitrate, Channel, Interface, ProgressOutput, shipped_configurations

if TYPE_CHECKING:
    from jointctl.tools.inspection.first_values import Mark, Place
    from jointctl.tools.inspection.subject import Subject

Node = Annotated[int | None, typer.Option("--node", "-t", help="CANopen node of the drive", min=1, max=127)]
_OPEN = "-"  # an answer: leave it marked


@dataclass(frozen=True)
class DriveOptions:
    """Where the drive is, if it is to be asked."""

    interface: Interface = None
    channel: Channel = None
    bitrate: Bitrate = None
    node: Node = None


NOBODY = DriveOptions()


def new(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="configuration to write (TOML); with --arm a folder")],
    output: ProgressOutput,
    *,
    shipped: Annotated[
        str,
        typer.Option("--from", help="name of the shipped configuration", autocompletion=shipped_configurations),
    ] = "elmo_gold_can",
    drive: DriveOptions = NOBODY,
    no_input: Annotated[bool, typer.Option("--no-input", help="ask nothing; what is open stays marked")] = False,
    arm: Annotated[bool, typer.Option("--arm", help="a folder with the shipped arm: URDF, arm file, joints")] = False,
) -> int:
    """Write a configuration of your own, a copy of a shipped one to fill in; with -i, -c and --node from the drive.

    The drive says what it knows (identity, rated values, counts), the rest is asked for, one question each.
    """
    if arm:
        if drive != NOBODY:
            raise UsageError("--arm asks no drive: -i, -c, -b and --node are for a joint's file")
        return _new_arm(path, output)
    from jointctl.tools.configuration.load import read_text, shipped_config
    from jointctl.tools.inspection.first_values import filled

    source = shipped_config(shipped)
    text = read_text(source)
    if path.suffix != ".toml":
        raise DataError(f"{path}: the name of a configuration must end in .toml")
    if path.exists():
        raise DataError(f"{path}: exists already, a configuration is never overwritten")
    if drive != NOBODY:
        text = filled(text, _from_drive(drive, text, path.parent, output, ask=not no_input))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise DataError(f"{path}: exists already, a configuration is never overwritten") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    output.note(f"written: {path}, a copy of {source.name}")
    marked = text.count("FILL IN: ")
    if marked:
        output.note(f"next: fill in the {marked} values marked FILL IN, then jointctl doctor {path}")
    elif drive != NOBODY:
        output.note(f"next: jointctl doctor {path}, then jointctl run {path} --dry-run")
    return 0


def _new_arm(folder: Path, output: Output) -> int:
    """The files of the shipped arm in a folder of their own."""
    from jointctl.tools.configuration.arm import SHIPPED_ARM

    try:
        folder.mkdir(parents=True)
        for source in sorted(SHIPPED_ARM.parent.iterdir()):
            if source.suffix in (".toml", ".urdf"):
                (folder / source.name).write_bytes(source.read_bytes())
                output.note(f"written: {folder / source.name}")
    except FileExistsError:
        raise DataError(f"{folder}: exists already, a configuration is never overwritten") from None
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    arm_file = folder / SHIPPED_ARM.name
    output.note(f"next: put your URDF in, name its joints in {arm_file}, then jointctl check {arm_file}")
    return 0


def _from_drive(drive: DriveOptions, text: str, folder: Path, output: Output, *, ask: bool) -> dict[Place, object]:
    """The values that the drive and the user give."""
    from jointctl.tools.configuration.drive_section import GivenPlace
    from jointctl.tools.inspection.first_values import first_values, marks, toml_text
    from jointctl.tools.inspection.subject import SdoReader, canopen_network, subject_of_flags

    given = GivenPlace(drive.interface, drive.channel, drive.bitrate, None, drive.node)
    subject = subject_of_flags(given, None)
    if subject.node is None:
        raise ConfigurationError("which node?", "give it: --node 1; `jointctl scan` finds nodes")
    if ask and not sys.stdin.isatty():
        raise UsageError("there are questions and no terminal to ask on", "give --no-input: what is open stays marked")
    with canopen_network(subject) as network:
        output.note(f"reading node {subject.node} on {subject.place}")
        found = first_values(SdoReader(network, subject.node), folder)
    for remark in found.remarks:
        output.warning(remark)
    values: dict[Place, object] = {}
    for (section, key), (value, origin) in {**_bus(subject), **found.known}.items():
        values[section, key] = value
        output.note(f"  {section}.{key} = {toml_text(value, key)} ({origin})")
    if ask:
        output.note(f"Enter takes the value in brackets; {_OPEN} leaves a value open, to be filled in later")
        for mark in marks(text):
            if mark.place not in values:
                values |= dict(_asked(mark, found.suggested.get(mark.place), output))
    return values


def _bus(subject: Subject) -> dict[Place, tuple[object, str]]:
    found: dict[Place, tuple[object, str]] = {
        ("bus", "interface"): (subject.interface, "as given"),
        ("bus", "channel"): (subject.channel, "as given"),
    }
    if subject.bitrate_bitps is not None:
        found["bus", "bitrate_bitps"] = subject.bitrate_bitps, "as given"
    return found


def _asked(mark: Mark, suggested: tuple[object, str] | None, output: Output) -> Iterator[tuple[Place, object]]:
    """One question, until its answer may be; nothing if it is left open."""
    from jointctl.tools.inspection.first_values import checked, default_of, toml_text

    usual = toml_text(default_of(mark.place)) if mark.optional else ""
    default = usual if suggested is None else toml_text(suggested[0])
    origin = f" ({suggested[1]})" if suggested is not None else ""
    question = f"{mark.section}.{mark.key}{f' [{mark.unit}]' if mark.unit else ''}: {mark.text or 'see the file'}"
    bracket = f" [{default}{origin}]" if default else ""
    while True:
        output.note(f"{question}{bracket}: ")
        line = sys.stdin.readline()
        text = line.strip() or default
        if not line or text in ("", _OPEN):
            return
        try:
            value, echoed = checked(mark.place, text)
        except ValueError as error:
            output.note(f"  {error}")
            continue
        if echoed:
            output.note(f"  {echoed}")
        if text != usual:
            yield mark.place, value
        return
