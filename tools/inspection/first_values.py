"""A first configuration: the template, and what a CANopen drive says about itself as keys of it.  Reads only.

Taken for granted is what the drive cannot have wrong (identity) or what jointctl compares with it before every run
(rated values, counts).  Everything else is a suggestion, to be confirmed by somebody who knows the joint.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from jointctl.drivers.canopen.eds import EdsFile, read_eds
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import parse_toml
from jointctl.tools.configuration.checks import range_problems
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import section_class
from jointctl.tools.configuration.load import echo, understood, unit_of, unit_text
from jointctl.tools.inspection.drive_info import MAXON, MILLI, rated_torque_mNm
from jointctl.tools.inspection.subject import SdoReader

# --- A configuration that is still to be filled in: its marked lines, their values, and what each may be ---
# A marked line is a key that is commented out, with FILL IN and what to fill in behind it.


_SECTION = re.compile(r"\[(\w+)\]")
_KEY = re.compile(r"(?P<off># )?(?P<key>\w+)\s*=\s*(?P<value>\"[^\"]*\"|[^#\s]+)(?P<space>\s*)(?P<comment>#.*)?")
_MARK = re.compile(r"# FILL IN(?P<optional> if[^:]*)?: ?(?P<text>.*)")
_HEXADECIMAL = ("vendor_id", "product_code")
Place = tuple[str, str]


@dataclass(frozen=True)
class Mark:
    """One value to be filled in; `optional`: the key has a default, which holds if nobody gives another value."""

    section: str
    key: str
    text: str
    optional: bool

    @property
    def place(self) -> Place:
        """(section, key)."""
        return self.section, self.key

    @property
    def unit(self) -> str:
        """For a question; "" where there is none."""
        unit = unit_of(self.key)
        return unit_text(unit) if unit else ""


def marks(text: str) -> list[Mark]:
    """The lines that are to be filled in, in their order."""
    found, section = [], ""
    for line in text.splitlines():
        if head := _SECTION.match(line):
            section = head[1]
        key = _KEY.match(line)
        mark = _MARK.match(key["comment"] or "") if key and key["off"] else None
        if key and mark:
            found.append(Mark(section, key["key"], mark["text"], mark["optional"] is not None))
    return found


def filled(text: str, values: Mapping[Place, object], *, marked: bool = True) -> str:
    """The text with these values in the lines of their keys, which are no comments any more; other keys are left.

    `marked` False: comments are left as well.
    """
    lines, section = [], ""
    for whole in text.splitlines(keepends=True):
        line = whole
        if head := _SECTION.match(line):
            section = head[1]
        key = _KEY.match(line)
        if key and (section, key["key"]) in values and (marked or not key["off"]):
            value = toml_text(values[section, key["key"]], key["key"])
            comment = re.sub(r"FILL IN(?: if[^:]*)?: ", "", key["comment"] or "").rstrip()
            line = f"{key['key']} = {value}"
            line = f"{line:<33} {comment}".rstrip() if comment else line
            line += "\r\n" if whole.endswith("\r\n") else "\n"
        lines.append(line)
    return "".join(lines)


def toml_text(value: object, key: str = "") -> str:
    """A value as TOML has it; identities in hexadecimal, as data sheets have them."""
    if key in _HEXADECIMAL and isinstance(value, int):
        return f"{value:#x}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, float):
        return repr(value) if abs(value) < 1e16 else f"{value:e}"
    return str(value)


def _field(place: Place) -> FieldInfo:
    section, key = place
    model: Any = section_class("canopen") if section == "drive" else Config.model_fields[section].annotation
    model = next(iter(get_args(model)), model)  # of a section that may be left out
    fields: dict[str, FieldInfo] = model.model_fields
    return fields[key]


def default_of(place: Place) -> object:
    """What holds where the key is not given."""
    return _field(place).default


def answer_value(text: str) -> Any:
    """What somebody typed: a TOML value, else the text as it is."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def checked(place: Place, text: str) -> tuple[Any, str]:
    """The value that the text means for that key and what was made of it; `ValueError` in words if it may not be."""
    section, key = place
    number = understood(key, text)
    value: Any = answer_value(text) if number is None else number
    field = _field(place)
    if isinstance(value, int) and not isinstance(value, bool) and "float" in str(field.annotation):
        value = float(value)
    try:
        kind: Any = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
        TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False)).validate_python(value)
    except ValidationError as error:
        message = error.errors(include_url=False)[0]["msg"]
        raise ValueError(f"{section}.{key} (={text}) {message[0].lower()}{message[1:]}") from None
    return value, echo(key, text, number) if number is not None else ""


_LOW, _HIGH = ("limits", "position_min_rad"), ("limits", "position_max_rad")


def in_order(place: Place, value: object, before: Mapping[Place, object]) -> None:
    """`ValueError` in words where the limits that are known by now leave no range."""
    if place not in (_LOW, _HIGH):
        return
    known = {**before, place: value}
    low, high = known.get(_LOW), known.get(_HIGH)
    if isinstance(low, float) and isinstance(high, float) and (problems := range_problems(low, high)):
        raise ValueError(problems[0])


# --- What the drive says of itself ---


CAUTIOUS_RADPS = 0.5  # of the template
_ALL = 2**31 - 1
_POSITION_INVERTED, _VELOCITY_INVERTED = 0x80, 0x40  # of 607E


@dataclass
class FirstValues:
    """`known` is taken, `suggested` is the default of a question, each with its origin; `remarks` are for the user."""

    known: dict[Place, tuple[object, str]] = field(default_factory=dict)
    suggested: dict[Place, tuple[object, str]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def eds_of_identity(folder: Path, node: int, vendor: int | None, product: int | None) -> tuple[Path | None, str]:
    """The EDS or DCF file in `folder` that is for this maker and product, and what there is to say about it."""
    fitting: list[tuple[Path, EdsFile]] = []
    others = []
    for path in sorted([*folder.glob("*.[eE][dD][sS]"), *folder.glob("*.[dD][cC][fF]")]):
        try:
            eds = read_eds(path, node)
        except ConfigurationError:
            continue
        if eds.vendor_id == vendor and eds.product_code in (product, None, 0):
            fitting.append((path, eds))
        elif eds.vendor_id == vendor:
            others.append(path.name)
    exact = [path for path, eds in fitting if eds.product_code == product] or [path for path, _ in fitting]
    if len(exact) == 1:
        return exact[0], ""
    if exact:
        return None, f"EDS files for this drive: {', '.join(path.name for path in exact)}: which one?"
    if others:
        return None, f"EDS files of this maker, but of another product: {', '.join(others)}"
    return None, f"no EDS file for this drive in {folder}: it comes from the maker and goes there"


def first_values(reader: SdoReader, folder: Path) -> FirstValues:
    """Asks the drive; `NoDeviceError` if it does not answer."""
    reader.require_answer()
    found = FirstValues()
    _identity(reader, folder, found)
    _ratings(reader, found)
    _encoder(reader, found)
    _limits(reader, found)
    return found


def _identity(reader: SdoReader, folder: Path, found: FirstValues) -> None:
    vendor, product = reader.value(0x1018, 1), reader.value(0x1018, 2)
    found.known["drive", "node"] = reader.node, "it answers"
    for key, value, sub in (("vendor_id", vendor, 1), ("product_code", product, 2)):
        if value is not None:
            found.known["drive", key] = value, f"1018:{sub}"
    path, remark = eds_of_identity(folder, reader.node, vendor, product)
    if path is not None:
        found.known["drive", "eds"] = path.name, "for this maker and product"
    else:
        found.remarks.append(remark)


def _ratings(reader: SdoReader, found: FirstValues) -> None:
    current_mA, torque_mNm = reader.value(0x6075), rated_torque_mNm(reader)
    if current_mA:
        found.known["drive", "rated_current_A"] = current_mA * MILLI, "6075"
    if torque_mNm:
        found.known["drive", "rated_torque_Nm"] = torque_mNm * MILLI, "6076"
    if current_mA and torque_mNm:
        constant = torque_mNm / current_mA
        found.suggested["joint", "torque_constant_NmpA"] = constant, "6076 / 6075; compare it with the data sheet"
    elif current_mA or torque_mNm:
        reference = "rated_current" if current_mA else "rated_torque"
        found.suggested["drive", "torque_reference"] = reference, "the only one of 6075 and 6076 that the drive has"
    if torque_mNm and reader.value(0x1018, 1) == MAXON:
        found.remarks.append(
            "6076 was taken to count µNm, as in maxon's EPOS4: compare rated_torque_Nm with the motor's data sheet, "
            'and add rated_torque_unit = "uNm" to [drive]'
        )
    if reader.value(0x6072) is None:
        found.remarks.append(
            "no 6072 (max torque): name the maker's own limit in drive.torque_limit_object, see docs/drives"
        )


def _encoder(reader: SdoReader, found: FirstValues) -> None:
    counts, turns = reader.value(0x608F, 1), reader.value(0x608F, 2)
    motor, shaft = reader.value(0x6091, 1), reader.value(0x6091, 2)
    ratio, origin = (motor / shaft, "6091") if motor and shaft and motor != shaft else (None, "")
    feed, shaft_turns = reader.value(0x6092, 1), reader.value(0x6092, 2)
    if feed and shaft_turns and counts and turns and feed * turns != counts * shaft_turns:
        found.remarks.append(
            f"6092 is {feed}:{shaft_turns}: by it 6064 is not in counts of the encoder (608F) but in units of that "
            "feed, and encoder.counts_per_turn must be in them"
        )
        if feed % shaft_turns == 0 and feed > 3 * shaft_turns:
            found.suggested["encoder", "counts_per_turn"] = feed // shaft_turns, "6092; compare it with a turn by hand"
    elif counts and counts > 3 and turns:
        if counts % turns == 0:
            found.known["encoder", "counts_per_turn"] = counts // turns, "608F"
            found.suggested["encoder", "side"] = "motor", "608F counts turns of the motor"
        else:  # no whole number for a turn of the motor: it counts turns of the joint
            found.known["encoder", "counts_per_turn"] = counts, "608F"
            found.suggested["encoder", "side"] = "joint", f"608F: {counts} counts for {turns} turns of the motor"
            ratio, origin = ratio or float(turns), origin or "608F"
    if ratio:
        found.suggested["joint", "reduction_ratio"] = ratio, origin
    found.suggested["encoder", "direction"] = 1, "change it if the angle grows the wrong way"
    position = reader.value(0x6064)
    if position is not None:
        found.suggested["encoder", "zero_counts"] = position, "6064, where the joint stands now"
    polarity = reader.value(0x607E) or 0
    if polarity & (_POSITION_INVERTED | _VELOCITY_INVERTED):
        found.remarks.append(
            f"607E (polarity) is {polarity:02X}h: the drive inverts positions or speeds, and jointctl gets them so"
        )


def _limits(reader: SdoReader, found: FirstValues) -> None:
    """The drive's own limits at the joint, where counts and ratio are clear; never wider than the template's speed."""
    scale = _rad_per_count(found)
    zero = found.suggested.get(("encoder", "zero_counts"))
    low, high = reader.value(0x607D, 1), reader.value(0x607D, 2)
    if scale and zero and low is not None and high is not None and -_ALL < low < high < _ALL:
        origin = "607D at the drive, seen from where it stands; stay well inside the end stops"
        for key, counts in (("position_min_rad", low), ("position_max_rad", high)):
            found.suggested["limits", key] = round((counts - int(str(zero[0]))) * scale, 4), origin
    ratio = found.suggested.get(("joint", "reduction_ratio"))
    speed_rpm = reader.value(0x6080)
    if ratio and speed_rpm:
        speed = speed_rpm * math.tau / 60.0 / float(str(ratio[0]))
        if 0.0 < speed < CAUTIOUS_RADPS:
            found.known["limits", "velocity_max_radps"] = speed, "6080 at the joint"


def _rad_per_count(found: FirstValues) -> float | None:
    counts, side = found.known.get(("encoder", "counts_per_turn")), found.suggested.get(("encoder", "side"))
    ratio = found.suggested.get(("joint", "reduction_ratio"))
    if counts is None or side is None or (side[0] == "motor" and ratio is None):
        return None
    turns: Any = ratio[0] if ratio is not None and side[0] == "motor" else 1.0
    return math.tau / (int(str(counts[0])) * float(turns))
