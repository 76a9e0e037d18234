"""`jointctl new FILE`: a configuration of one's own, copied from a shipped one or filled in from the drive."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError, DataError, UsageError
from jointctl.tools.output import Output, command_line
from jointctl.tools.verbs.verb_options import Bitrate, Channel, Interface, ProgressOutput, shipped_configurations
from jointctl.tools.written_file import replace_file, writing

if TYPE_CHECKING:
    from jointctl.tools.configuration.urdf import UrdfJoint
    from jointctl.tools.inspection.first_files import JointAnswers, Mark, Place
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
        str | None,
        typer.Option(
            "--from",
            help="name of a shipped configuration, or a file of yours",
            show_default="elmo_gold_can",
            autocompletion=shipped_configurations,
        ),
    ] = None,
    drive: DriveOptions = NOBODY,
    no_input: Annotated[bool, typer.Option("--no-input", help="ask nothing; what is open stays marked")] = False,
    arm: Annotated[bool, typer.Option("--arm", help="a folder with an arm file, its URDF, its joints' files")] = False,
    urdf: Annotated[
        Path | None, typer.Option("--urdf", help="of the arm, with --arm; left out: the shipped arm", dir_okay=False)
    ] = None,
    joints: Annotated[str, typer.Option("--joints", help="of the URDF: A,B,C; left out: all that turn")] = "",
) -> int:
    """Write a configuration of your own, a copy of a shipped one to fill in; with -i, -c and --node from the drive.

    The drive says what it knows (identity, rated values, counts), the rest is asked for, one question each.
    """
    if arm:
        if drive != NOBODY:
            raise UsageError("--arm asks no drive: -i, -c, -b and --node are for a joint's file")
        if shipped is not None:
            raise UsageError(
                f"--from (={shipped}) is for a joint's file: an arm is made of the shipped one or of --urdf"
            )
        if urdf is None and joints:
            raise UsageError("--joints names joints of a URDF: give --urdf as well")
        return _new_arm(path, output) if urdf is None else _arm_of_urdf(path, urdf, joints, output, ask=not no_input)
    if urdf is not None or joints:
        raise UsageError("--urdf and --joints are for an arm: give --arm as well")
    from jointctl.tools.configuration.load import read_text, shipped_config
    from jointctl.tools.inspection.first_files import filled

    source = shipped_config("elmo_gold_can" if shipped is None else shipped)
    if not os.path.isfile(source) and shipped is not None and shipped.endswith(".toml") and os.path.isfile(shipped):
        source = Path(shipped)
    text = read_text(source)
    if "[arm]" in text.splitlines():
        raise UsageError(
            f"--from (={shipped}) is an arm, which is several files", "give --arm and the name of a folder"
        )
    if path.suffix != ".toml":
        raise DataError(f"{path}: the name of a configuration must end in .toml")
    _refuse_existing(path)
    with writing(path), TemporaryFile(dir=path.parent):  # before anything is asked
        pass
    if drive != NOBODY:
        with _nothing_written():
            text = filled(text, _from_drive(drive, text, path.parent, output, ask=not no_input))
    replace_file(path, text.encode(), lambda _: _refuse_existing(path))
    output.note(f"written: {path}, a copy of {source.name}")
    marked = text.count("FILL IN: ")
    if marked:
        output.note(f"next: fill in the {marked} values marked FILL IN, then {command_line('doctor', path)}")
    elif drive != NOBODY:
        output.note(f"next: {command_line('doctor', path)}, then {command_line('run', path, '--dry-run')}")
    return 0


@contextmanager
def _nothing_written() -> Iterator[None]:
    """Ctrl-C within says so."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(f"{error}; nothing was written") from None


def _new_arm(folder: Path, output: Output) -> int:
    """The files of the shipped arm in a folder of their own."""
    from jointctl.tools.configuration.arm import SHIPPED_ARM

    sources = [one for one in sorted(SHIPPED_ARM.parent.iterdir()) if one.suffix in (".toml", ".urdf")]
    _write_folder(folder, {source.name: source.read_bytes() for source in sources}, output)
    output.note(f"next: {command_line('check', folder / SHIPPED_ARM.name)}; for an arm of your own give --urdf FILE")
    return 0


def _refuse_existing(path: Path) -> None:
    if os.path.lexists(path):
        raise DataError(f"{path}: exists already, a configuration is never overwritten")


def _write_folder(folder: Path, files: Mapping[str, bytes], output: Output) -> None:
    """In one step: half of it would count as a configuration of the user."""
    _refuse_existing(folder)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder.parent, prefix=".arm.") as beside:
            whole = Path(beside) / "whole"
            whole.mkdir()  # the temporary one is for its owner alone
            for name, content in files.items():
                (whole / name).write_bytes(content)
            whole.rename(folder)
    for name in files:
        output.note(f"written: {folder / name}")


def _arm_of_urdf(folder: Path, urdf_file: Path, names: str, output: Output, *, ask: bool) -> int:
    """The files of an arm of one's own; what its URDF does not say is asked for, or has a default."""
    from jointctl.tools.inspection.first_files import ARM_FILE, first_arm, moving_joints, read_own_urdf

    _refuse_existing(folder)
    urdf = read_own_urdf(urdf_file)
    joints = moving_joints(urdf, [name.strip() for name in names.split(",")] if names else ())
    output.note(f"joints of {urdf_file.name}, in their order: {', '.join(joint.name for joint in joints)}")
    if ask:
        _require_terminal("what is open has a default")
        output.note("Enter takes the value in brackets")
    with _nothing_written():
        answers = tuple(_answers(joint, i + 1, output, ask=ask) for i, joint in enumerate(joints))
        files, remarks = first_arm(urdf, joints, answers, folder)
    _write_folder(folder, files, output)
    for remark in remarks:
        output.warning(remark)
    arm_file = folder / ARM_FILE
    output.note("drives, encoders and friction are the shipped shoulder's, scaled to each effort, on a virtual bus")
    output.note(
        f"next: {command_line('check', arm_file)}, hil and run; then put the values of your drives in its joints' files"
    )
    return 0


def _require_terminal(otherwise: str) -> None:
    if not sys.stdin.isatty():
        raise UsageError("there are questions and no terminal to ask on", f"give --no-input: {otherwise}")


def _answers(joint: UrdfJoint, node: int, output: Output, *, ask: bool) -> JointAnswers:
    """Of one joint."""
    from jointctl.tools.inspection.first_files import JointAnswers, Mark, default_motor_inertia_kgm2

    inertia_kgm2 = default_motor_inertia_kgm2(joint)
    values: dict[Place, object] = {}
    if ask:
        output.note(f"--- {joint.name}")
        node_mark = Mark("drive", "node", "CANopen node of its drive", optional=False)
        values |= dict(_asked(node_mark, (node, "in their order"), output, values))
        what = Mark("reducer", "motor_inertia_kgm2", "motor and reducer, seen at the joint", optional=False)
        for _, value in _asked(what, (inertia_kgm2, "a guess"), output, values):
            inertia_kgm2 = float(str(value))
    return JointAnswers(inertia_kgm2, values)


def _from_drive(drive: DriveOptions, text: str, folder: Path, output: Output, *, ask: bool) -> dict[Place, object]:
    """The values that the drive and the user give."""
    from jointctl.tools.configuration.drive_section import GivenPlace
    from jointctl.tools.inspection.first_files import first_values, marks, toml_text
    from jointctl.tools.inspection.subject import SdoReader, canopen_network, subject_of_flags

    given = GivenPlace(drive.interface, drive.channel, drive.bitrate, None, drive.node)
    subject = subject_of_flags(given, None)
    if subject.node is None:
        raise ConfigurationError("which node?", "give it: --node 1; `jointctl scan` finds nodes")
    if ask:
        _require_terminal("what is open stays marked")
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
                values |= dict(_asked(mark, found.suggested.get(mark.place), output, values))
    return values


def _bus(subject: Subject) -> dict[Place, tuple[object, str]]:
    found: dict[Place, tuple[object, str]] = {
        ("bus", "interface"): (subject.interface, "as given"),
        ("bus", "channel"): (subject.channel, "as given"),
    }
    if subject.bitrate_bitps is not None:
        found["bus", "bitrate_bitps"] = subject.bitrate_bitps, "as given"
    return found


def _asked(
    mark: Mark, suggested: tuple[object, str] | None, output: Output, before: Mapping[Place, object]
) -> Iterator[tuple[Place, object]]:
    """One question, until its answer may be beside those `before`; nothing if it is left open."""
    from jointctl.tools.inspection.first_files import checked, default_of, in_order, toml_text

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
            in_order(mark.place, value, before)
        except ValueError as error:
            output.note(f"  {error}")
            continue
        if echoed:
            output.note(f"  {echoed}")
        if text != usual:
            yield mark.place, value
        return
