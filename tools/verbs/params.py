"""`jointctl params dump | restore | diff`: all objects of a drive to a file and back."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from jointctl.drivers.errors import DECLINED, ConfigurationError, DataError, DeviceError
from jointctl.tools.output import Output
from jointctl.tools.verbs.bench_drive import NodeWithEds, subject_of
from jointctl.tools.verbs.verb_options import CanOptions, Verb, VerbOutput, Verbs, grouped

if TYPE_CHECKING:
    from jointctl.tools.inspection.objects import Objects
    from jointctl.tools.inspection.parameters import Difference, ParameterSet, Value, Written
    from jointctl.tools.inspection.subject import SdoReader, Subject

DIFFERENT = 11  # exit code of diff
MASTER_NODE = 126  # of jointctl, unless a configuration has another one
_SETTLE_S = 0.02


def _known_objects(subject: Subject) -> Objects:
    objects = subject.objects()
    objects.required()
    return objects


def parameters_of_drive(subject: Subject, output: Output) -> tuple[ParameterSet, Objects]:
    """All readable objects as the drive has them now."""
    from jointctl.tools.inspection.parameters import read_parameters, variables
    from jointctl.tools.inspection.subject import SdoReader, canopen_network

    node, objects = subject.required_node(), _known_objects(subject)
    total = len(list(variables(objects.required())))
    output.note(f"reading node {node} on {subject.place}")
    with canopen_network(subject) as network, output.progress("reading", total) as advance:
        return read_parameters(SdoReader(network, node, objects), advance), objects


def dump(
    subject: NodeWithEds,
    output: VerbOutput,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="DCF to write (.dcf); default: stdout")] = None,
) -> int:
    """Read every readable object of the EDS.  Reads only."""
    from jointctl.tools.inspection.parameters import dcf_text
    from jointctl.tools.written_file import replace_file

    if out is not None and out.suffix.lower() != ".dcf":
        raise DataError(f"{out}: the name of a dump must end in .dcf: parameters are written as DCF only")
    if out is not None and out.exists():
        raise DataError(f"{out}: exists already", "give another name; a dump is never overwritten")
    found, objects = parameters_of_drive(subject, output)
    text = dcf_text(found, objects.required())
    if out is not None:
        replace_file(out, text.encode())
        output.note(
            f"{out}: {len(found.parameters)} parameters, {len(found.readings)} readings, "
            f"{len(found.unreadable)} objects could not be read"
        )
    if output.json:
        output.result("", _as_data(found))
    elif out is None:
        output.line(text.rstrip("\n"))
    return 0


def _as_data(found: ParameterSet) -> dict[str, Any]:
    return {
        "device": found.device,
        "parameters": {str(place): _plain(value) for place, value in found.parameters.items()},
        "readings": {str(place): _plain(value) for place, value in found.readings.items()},
        "unreadable": {str(place): why for place, why in found.unreadable.items()},
    }


def _plain(value: Value | None) -> Any:
    return {"hex": value.hex()} if isinstance(value, bytes) else value


def _table(objects: Objects, found: Iterable[Difference], first: str, second: str) -> Table:
    from jointctl.tools.inspection.parameters import shown

    table = Table(box=None, pad_edge=False)
    for title in ("object", "name", first, second):
        table.add_column(title, overflow="fold")
    for item in found:
        place = item.place
        table.add_row(
            str(place), objects.name(place.index, place.sub), shown(objects, place, item.first),
            shown(objects, place, item.second),
        )  # fmt: skip
    return table


def diff(first: ParameterSet, second: ParameterSet, objects: Objects, output: Output, *, readings: bool = False) -> int:
    """Show what differs; 0 if nothing does, else DIFFERENT."""
    from jointctl.tools.inspection.parameters import differences

    found = differences(first, second, readings=readings)
    rows = [{"object": str(item.place), "name": objects.name(item.place.index, item.place.sub),
             "first": _plain(item.first), "second": _plain(item.second)} for item in found]  # fmt: skip
    data = {"first": first.origin, "second": second.origin, "differences": rows}
    output.result(_table(objects, found, first.origin, second.origin) if found else "no difference", data)
    return DIFFERENT if found else 0


def restore_file(
    subject: Subject, path: Path, output: Output, *, assume_yes: bool, other_device: bool = False, skip: list[int]
) -> int:
    """Show what would change, ask, write, read back, report; `DeviceError` if something was not taken."""
    from jointctl.drivers.canopen.cia import NmtCommand
    from jointctl.drivers.canopen.network import OtherControllers, send_nmt
    from jointctl.tools.configuration.canopen import canopen_section
    from jointctl.tools.inspection.parameters import load_parameters, restore
    from jointctl.tools.inspection.subject import SdoReader, canopen_network
    from jointctl.tools.session.control import control_of
    from jointctl.tools.session.plan import agreed, require_terminal

    node, objects = subject.required_node(), _known_objects(subject)
    wanted = load_parameters(path, node)
    others = OtherControllers(
        [node], MASTER_NODE if subject.config is None else canopen_section(subject.config).master_node
    )
    with control_of(subject.interface, subject.channel, output), canopen_network(subject, others) as network:
        time.sleep(others.to_listen_s)
        others.refuse()
        reader = SdoReader(network, node, objects)
        reader.require_answer()
        _require_same_device(reader, wanted, path, other_device)
        _require_off(reader)
        changes = _changes(reader, wanted, skip)
        if not changes:
            output.result("nothing to restore: the drive has these values", {"restored": [], "failed": []})
            return 0
        output.note(f"{len(changes)} parameters differ; the drive as it is, and {path.name}:")
        output.note(_table(objects, changes, "drive", "file"))
        if not assume_yes:
            require_terminal("this writes into the drive and there is no terminal to ask on", "give -y to write")
        if not (assume_yes or agreed(output, "Write these into the drive?")):
            output.note("nothing was written")
            return DECLINED
        # the answer may have taken minutes: a joint that moves by now must not lose its controller
        _require_off(reader)
        others.refuse()  # after an answer: what came before it has been received by then
        send_nmt(network, NmtCommand.ENTER_PRE_OPERATIONAL, node)  # PDOs can only be changed there
        time.sleep(_SETTLE_S)
        _require_off(reader)
        values = {change.place: change.second for change in changes if change.second is not None}
        done = restore(reader, values, wanted.parameters)
    return _report(done, objects, output)


def _require_off(reader: SdoReader) -> None:
    """All axes of the device: it leaves operational as a whole."""
    from jointctl.drivers.canopen.cia import State, state_of_word, state_text
    from jointctl.tools.inspection.parameters import AXES, OF_AXIS

    under_power = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
    for place in range(0x6041, 0x6041 + AXES * OF_AXIS, OF_AXIS):
        word = reader.value(place) if reader.objects.variable(place, 0) is not None else None
        if word is not None and state_of_word(word) in under_power:
            axis = f", axis {(place - 0x6041) // OF_AXIS + 1}," if place != 0x6041 else ""
            raise DeviceError(
                f"node {reader.node}{axis} is in {state_text(word)}: nothing is written into a drive under power",
                "jointctl stop CONFIG",
            )


def _require_same_device(reader: SdoReader, wanted: ParameterSet, path: Path, other_device: bool) -> None:
    from jointctl.tools.inspection.parameters import identity_of

    present = identity_of(reader)
    for key in ("vendor_id", "product_code", "node"):
        expected = wanted.device.get(key)
        if expected is not None and expected != present[key] and not other_device:
            raise DeviceError(
                f"{path}: {key} (={expected}) is not that of the drive (={present[key]})",
                "give --other-device to write it all the same; identifiers contain the node number",
            )


def _changes(reader: SdoReader, wanted: ParameterSet, skip: list[int]) -> list[Difference]:
    """What the file has otherwise than the drive, of the objects that may be written."""
    from jointctl.tools.inspection.parameters import Difference, is_parameter
    from jointctl.tools.inspection.subject import Refusal

    found = []
    for place, value in wanted.parameters.items():
        variable = reader.objects.variable(place.index, place.sub)
        if place.index in skip or variable is None or not is_parameter(variable):
            continue
        data = reader.upload(place.index, place.sub)
        if isinstance(data, Refusal):
            if not data.absent:
                found.append(Difference(place, None, value))
            continue
        present = reader.objects.value(place.index, place.sub, data)
        if present != value:
            found.append(Difference(place, present, value))
    return found


def _report(done: list[Written], objects: Objects, output: Output) -> int:
    from jointctl.tools.inspection.parameters import shown

    failed = [item for item in done if item.failure]
    table = Table(box=None, pad_edge=False)
    for title in ("object", "name", "value", ""):
        table.add_column(title, overflow="fold")
    for item in done:
        name = objects.name(item.place.index, item.place.sub)
        table.add_row(str(item.place), name, shown(objects, item.place, item.wanted), item.failure or "restored")
    data = {
        "restored": [str(item.place) for item in done if not item.failure],
        "failed": [{"object": str(item.place), "reason": item.failure} for item in failed],
    }
    output.result(table, data)
    if failed:
        raise DeviceError(f"{len(failed)} of {len(done)} parameters were not taken (see above)")
    return 0


def place_index(text: str) -> int:
    """An index of the command line, hexadecimal; `ConfigurationError` for anything else."""
    from jointctl.tools.inspection.objects import Place

    try:
        index = int(text, 16)
    except ValueError:
        index = -1
    if not 0 <= index <= 0xFFFF:
        raise ConfigurationError(f"--skip (={text}) must be the index of an object, such as 2012")
    return Place(index).index


params_app = typer.Typer(cls=Verbs, help="All objects of a drive to a file and back.", no_args_is_help=True)


params_app.command("dump", cls=Verb)(grouped(dump))


@params_app.command("restore", cls=Verb)
@grouped
def params_restore(
    *,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="a DCF, or a TOML dump of an older version")],
    subject: NodeWithEds,
    yes: Annotated[bool, typer.Option("-y", "--yes", help="write without asking")] = False,
    other_device: Annotated[
        bool, typer.Option("--other-device", help="write although maker, product or node differ")
    ] = False,
    skip: Annotated[list[str] | None, typer.Option("--skip", help="index to leave alone; may be repeated")] = None,
    output: VerbOutput,
) -> int:
    """Write the parameters that differ, read each back, tell what was refused.  The drive must be off."""
    indices = [place_index(text) for text in skip or []]
    return restore_file(subject, file, output, assume_yes=yes, other_device=other_device, skip=indices)


@params_app.command("diff", cls=Verb)
@grouped
def params_diff(
    *,
    first: Annotated[
        Path, typer.Argument(metavar="FIRST", help="DCF, EDS, older dump; or configuration: its drive now")
    ],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="the same")],
    bus: CanOptions,
    readings: Annotated[bool, typer.Option("--readings", help="what is no parameter as well")] = False,
    output: VerbOutput,
) -> int:
    """Compare two files, or a file and a drive.  Exit code 11 if they differ."""
    from jointctl.tools.inspection.objects import Objects
    from jointctl.tools.inspection.parameters import is_parameter_file, load_parameters

    objects, sides = Objects(), []
    for path in (first, second):
        if is_parameter_file(path):
            sides.append(load_parameters(path, bus.target or 1))
        else:
            subject = subject_of(path, bus)
            found, objects = parameters_of_drive(subject, output)
            sides.append(found)
    return diff(sides[0], sides[1], objects, output, readings=readings)
