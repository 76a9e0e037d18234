"""First files: the template with what a CANopen drive says about itself as keys of it, or an arm by its URDF.

A drive is only read, and an arm's is not there yet.

Taken for granted is what the drive cannot have wrong (identity) or what jointctl compares with it before every run
(rated values, counts).  Everything else is a suggestion, to be confirmed by somebody who knows the joint.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, get_args

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from jointctl.drivers.canopen.eds import EdsFile, read_eds
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import parse_toml
from jointctl.tools.analysis.arm_check import (
    BusBudget,
    JointOfArm,
    RATES_Hz,
    bus_budgets,
    joint_loop,
    not_held,
    pose_ranges,
)
from jointctl.tools.configuration.arm import LARGEST_ARM, SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.checks import range_problems
from jointctl.tools.configuration.config import Config, raise_if
from jointctl.tools.configuration.drive_section import section_class
from jointctl.tools.configuration.load import decimal_point, echo, understood, unit_of, unit_text
from jointctl.tools.configuration.urdf import Urdf, UrdfJoint, bodies_of, read_urdf
from jointctl.tools.inspection.drive_info import MAXON, MILLI, rated_torque_mNm
from jointctl.tools.inspection.subject import SdoReader
from jointctl.tools.written_file import file_stems

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
        hint = decimal_point(text) if "number" in message else ""
        raise ValueError(f"{section}.{key} (={text}) {message[0].lower()}{message[1:]}{hint}") from None
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


# --- The files of an arm, from its URDF: an arm file, a configuration a joint, a copy of the URDF ---
# The URDF gives names, order, limits, and with the motors' inertias what each loop has to move in whatever pose.  It
# says nothing about drives, encoders and friction: there each joint gets the shipped shoulder's, with all torques in
# proportion to its effort, on a virtual bus.  So `check`, `hil` and `run` work at once, and what is real comes in its
# place, value by value.  Rate and gains are those that the buses carry and the margins over the poses allow.

TEMPLATE = SHIPPED_ARM.parent / "shoulder.toml"
ARM_FILE = "arm.toml"
# of the template, all of which go with the torque that the joint has
_TORQUES = (
    "torque_rate_max_Nmps|ripple_Nm|tc_Nm|ts_Nm|tv|a0|a1|a2|a3|stiffness_Nmprad|"
    "damping_Nmspr|torque_ripple_Nm|current_limit_A|bristle_stiffness_Nmprad|bristle_damping_Nmspr"
)
_MOTOR_INERTIA_kgm2 = 1.2  # of the shipped arm's shoulder
_TURN_rad = 3.1  # to each side, of a joint that may turn on for ever
# natural frequency of the loop [rad/s] and disturbance observer [rad/s], the stiffest first
_GAINS = ((60.0, 60.0), (45.0, 40.0), (30.0, 20.0), (20.0, 15.0), (12.0, 8.0), (8.0, 5.0))
_MARGIN_TO_SPARE_deg = 2.0  # a run measures the loop delay, which check takes as configured
_JUMP_SHARE = 1.5  # of the way in a period at the greatest speed that is a jump
_SPEED_SHARE, _LARGEST_SWING_rad, _FIRST_Hz = 0.2, 0.3, 0.1  # of the motion to begin with


@dataclass(frozen=True)
class JointAnswers:
    """What the URDF does not say of a joint and cannot be left open; `values` are keys of its file."""

    motor_inertia_kgm2: float  # motor and reducer, at the joint
    values: Mapping[Place, object]


def moving_joints(urdf: Urdf, names: Sequence[str] = ()) -> tuple[UrdfJoint, ...]:
    """Those that get a drive: `names`, or all that turn by themselves; `ConfigurationError` where they make no arm."""
    turning = [joint for joint in urdf.moving if joint.kind != "prismatic"]
    known = ", ".join(joint.name for joint in turning) or "none"
    wrong = [
        f"--joints: {name} must be a joint of {urdf.path.name} that turns by itself: {known}"
        for name in names
        if name not in [joint.name for joint in turning]
    ]
    if len(set(names)) < len(names):
        wrong.append(f"--joints (={','.join(names)}) must not name a joint twice")
    raise_if(wrong)
    joints = tuple(joint for joint in turning if not names or joint.name in names)
    if not 1 <= len(joints) <= LARGEST_ARM:
        more = "name those of one arm with --joints" if joints else "joints that shift are left out"
        raise ConfigurationError(f"{urdf.path}: {len(joints)} joints turn, must be 1 to {LARGEST_ARM}; {more}")
    bodies_of(urdf, tuple(joint.name for joint in joints), lambda text: wrong.append(f"{urdf.path}: {text}"))
    for joint in joints:
        wrong += [f"{urdf.path}: joint {joint.name}: {text}" for text in _unknown_limits(joint)]
    raise_if(wrong)
    return joints


def _unknown_limits(joint: UrdfJoint) -> list[str]:
    given = {"velocity": joint.velocity_max_radps, "effort": joint.effort_max_Nm}
    ends = {"lower": joint.lower_rad, "upper": joint.upper_rad} if joint.kind == "revolute" else {}
    missing = [key for key, value in {**ends, **given}.items() if value is None]
    found = [f"<limit> must have {', '.join(missing)}"] if missing else []
    return found + [
        f"limit {key} (={value:g}) must be above 0; not known?"
        for key, value in given.items()
        if value is not None and not value > 0.0
    ]


def file_names(joints: Sequence[UrdfJoint]) -> list[str]:
    """Of the joints' configurations."""
    return [f"{stem}.toml" for stem in file_stems([joint.name for joint in joints], taken=("arm",))]


def default_motor_inertia_kgm2(joint: UrdfJoint) -> float:
    """That of the shipped shoulder's drive with this joint's torque: a guess."""
    return float(f"{_MOTOR_INERTIA_kgm2 * _scale(joint):.3g}")


def _scale(joint: UrdfJoint) -> float:
    assert joint.effort_max_Nm is not None
    return joint.effort_max_Nm / _template_value("torque_max_Nm")


def _rated(joint: UrdfJoint) -> tuple[float, float]:
    """Current [A] and torque [Nm] of the motor: whole mNm, as drives count it, and not less than the limit."""
    template_Nm = _template_value("rated_torque_Nm")
    torque_Nm = math.ceil(template_Nm * _scale(joint) / MILLI) * MILLI
    return round(_template_value("rated_current_A") * torque_Nm / template_Nm, 6), round(torque_Nm, 6)


def _template_value(key: str) -> float:
    found = re.search(rf"(?m)^{key} = (\S+)", TEMPLATE.read_text(encoding="utf-8"))
    assert found is not None, key
    return float(found[1])


def _turn_limits(joint: UrdfJoint) -> tuple[float, float]:
    if joint.lower_rad is None or joint.upper_rad is None:
        return -_TURN_rad, _TURN_rad
    return joint.lower_rad, joint.upper_rad


def _scaled(text: str, factor: float) -> str:
    """The template with its torques in proportion, and no comments that were about its own figures."""

    def times(match: re.Match[str]) -> str:
        value = tomllib.loads(f"x = {match[2]}")["x"]
        values = [float(f"{factor * one:.5g}") for one in (value if isinstance(value, list) else [value])]
        return f"{match[1]}{values if isinstance(value, list) else values[0]}{match[3] or ''}"

    text = re.sub(rf"(?m)^((?:{_TORQUES}) = )(\[[^\]]*\]|[^\s#]+)(.*)$", times, text)
    text = re.sub(r"(?m)^(max_torque_permille = \S+ *#)[^\n]*", r"\1 6072, the drive's own limit", text)
    return re.sub(r"(?m)^\[friction\].*$", "[friction]                        # a guess: the paper's, scaled", text)


@dataclass(frozen=True)
class _Draft:
    """Of all files, what they hold in the end."""

    urdf: Urdf
    joints: tuple[UrdfJoint, ...]
    answers: tuple[JointAnswers, ...]
    rate_Hz: float = 1000.0
    inertias_kgm2: tuple[float, ...] = ()
    gains: tuple[tuple[float, float], ...] = ()

    def text_of(self, i: int) -> str:
        joint, (low, high) = self.joints[i], _turn_limits(self.joints[i])
        text = _scaled(TEMPLATE.read_text(encoding="utf-8"), _scale(joint))
        name = " ".join(joint.name.split())
        head = (
            f"# Joint {name} of {ARM_FILE}, made from {self.urdf.path.name}; works alone as well.\n"
            "# Limits are the URDF's; drive, encoder and friction are those of the shipped arm's shoulder, scaled to\n"
            "# the effort: put those of your joint in their place, then the interface of your bus.\n"
        )
        text = head + re.sub(r"\A#.*\n", "", text)
        swing_rad, frequency_Hz, middle_rad = self.swing(i)
        gains = _gain_keys(self.gains[i] if self.gains else _GAINS[-1])
        rated_current_A, rated_torque_Nm = _rated(joint)
        values: dict[Place, object] = {
            ("drive", "node"): i + 1,
            ("drive", "rated_current_A"): rated_current_A,
            ("drive", "rated_torque_Nm"): rated_torque_Nm,
            ("limits", "position_min_rad"): low,
            ("limits", "position_max_rad"): high,
            ("limits", "velocity_max_radps"): joint.velocity_max_radps,
            ("limits", "torque_max_Nm"): joint.effort_max_Nm,
            ("limits", "position_jump_max_rad"): self.jump_rad(joint),
            ("joint", "inertia_kgm2"): self.inertias_kgm2[i] if self.inertias_kgm2 else 1.0,
            ("loop", "rate_Hz"): self.rate_Hz,
            **{("control", key): value for key, value in gains.items()},
            ("control", "feed_forward_lead_s"): "auto",
            ("control", "velocity_cutoff_Hz"): 0.2 * self.rate_Hz,
            ("trajectory", "amplitude_rad"): swing_rad,
            ("trajectory", "frequency_Hz"): frequency_Hz,
            ("trajectory", "offset_rad"): middle_rad,
            ("virtual", "initial_position_rad"): middle_rad,
            **self.answers[i].values,
        }
        text = filled(text, values)
        return re.sub(r"(?m)^((?:position_min_rad|torque_max_Nm|kp|kv|feed_forward_lead_s) = \S+) .*$", r"\1", text)

    def swing(self, i: int) -> tuple[float, float, float]:
        """Amplitude, frequency and middle of the first motion, near 0 as far as the limits allow."""
        joint, (low, high) = self.joints[i], _turn_limits(self.joints[i])
        assert joint.velocity_max_radps is not None
        frequency_Hz = round(_FIRST_Hz * (1.0 + 0.13 * i), 4)
        fastest = _SPEED_SHARE * joint.velocity_max_radps / (math.tau * frequency_Hz)
        amplitude = min(_LARGEST_SWING_rad, 0.2 * (high - low), fastest)
        middle = min(max(0.0, low + 1.5 * amplitude), high - 1.5 * amplitude)
        return float(f"{amplitude:.3g}"), frequency_Hz, round(middle, 4)

    def jump_rad(self, joint: UrdfJoint) -> float:
        """Between two samples at this rate: the template's, or more where the joint moves on by more."""
        assert joint.velocity_max_radps is not None
        way_rad = _JUMP_SHARE * joint.velocity_max_radps / self.rate_Hz
        return max(_template_value("position_jump_max_rad"), float(f"{way_rad:.3g}"))

    def arm_text(self) -> str:
        files = file_names(self.joints)
        swings = [self.swing(i) for i in range(len(self.joints))]
        names = ", ".join(toml_text(joint.name) for joint in self.joints)
        return (
            f"# The arm of {self.urdf.path.name}.  `jointctl check` says how much of the bus it needs and what\n"
            "# margins its poses leave.\n\n[arm]\n"
            f"urdf = {toml_text(self.urdf.path.name)}  # beside this file; masses, inertias, axes, limits\n"
            f"joints = [{', '.join(map(toml_text, files))}]  # beside this file\n"
            f"joint_names = [{names}]  # of the URDF\n"
            "gravity_mps2 = [0.0, 0.0, -9.81]  # in the frame of the URDF's base\n"
            'feed_forward = "whole"  # of the arm\'s model: whole, gravity, none\n'
            f"motor_inertia_kgm2 = {[one.motor_inertia_kgm2 for one in self.answers]}  # and reducer, at the joint\n"
            "payload_kg = 0.0\npayload_at_m = [0.0, 0.0, 0.0]  # in the frame of the last joint's link\n\n"
            '[motion]\nkind = "sine"\nduration_s = 20.0\n'
            f"amplitude_rad = {[one[0] for one in swings]}\n"
            f"frequency_Hz = {[one[1] for one in swings]}\n"
            f"offset_rad = {[one[2] for one in swings]}\n"
        )

    def files(self) -> dict[str, bytes]:
        found = {ARM_FILE: self.arm_text().encode(), self.urdf.path.name: self.urdf.path.read_bytes()}
        for i, name in enumerate(file_names(self.joints)):
            found[name] = self.text_of(i).encode()
        return found

    def loaded(self, folder: Path) -> ArmConfig:
        for name, content in self.files().items():
            (folder / name).write_bytes(content)
        return load_arm(folder / ARM_FILE)


def first_arm(
    urdf: Urdf, joints: tuple[UrdfJoint, ...], answers: tuple[JointAnswers, ...], folder: Path
) -> tuple[dict[str, bytes], list[str]]:
    """Name and content of each file of the folder to come, and remarks; `ConfigurationError` where they make no arm."""
    draft = _Draft(urdf, joints, answers)
    with TemporaryDirectory() as name:
        trial = Path(name)
        try:
            arm = draft.loaded(trial)
            rate_Hz = _rate(bus_budgets(arm))
            ranges = pose_ranges(arm)
            inertias = tuple(float(f"{math.sqrt(one.least_kgm2 * one.greatest_kgm2):.3g}") for one in ranges)
            draft = replace(draft, rate_Hz=rate_Hz, inertias_kgm2=inertias)
            arm = draft.loaded(trial)
            ranges = pose_ranges(arm)
            remarks = list(not_held(arm, ranges))
            gains = []
            for i, config in enumerate(arm.joints):
                found = next((g for g in _GAINS if _bears(joint_loop(arm.names[i], _with(config, g), ranges[i]))), None)
                if found is None:
                    remarks.append(f"joint {arm.names[i]}: no gains were found for all poses; jointctl check says more")
                gains.append(found or _GAINS[-1])
            draft = replace(draft, gains=tuple(gains))
            remarks += draft.loaded(trial).remarks
        except ConfigurationError as error:
            error.message = error.message.replace(f"{trial}", f"{folder}")
            error.hint = (
                error.hint or f"nothing was written: it is made of the limits in {urdf.path.name} and the answers"
            )
            raise
    return draft.files(), remarks


def _rate(budgets: Sequence[BusBudget]) -> float:
    fits = min(min(budget.fitting_Hz for budget in budgets), 1000.0)
    if fits == 0.0:
        raise ConfigurationError(f"the joints do not fit on one bus at {RATES_Hz[-1]} Hz")
    return fits


def _gain_keys(gains: tuple[float, float]) -> dict[str, float]:
    """One of `_GAINS` as keys of [control]."""
    natural_radps, observer_radps = gains
    return {"kp": natural_radps**2, "kv": 2.0 * natural_radps, "observer_radps": observer_radps}


def _with(config: Config, gains: tuple[float, float]) -> Config:
    return config.changed(control=_gain_keys(gains))


def _bears(loop: JointOfArm) -> bool:
    margins, wanted_deg = loop.margins, loop.config.margin.min_phase_margin_deg
    enough = margins.phase_margin_deg >= wanted_deg + _MARGIN_TO_SPARE_deg
    return margins.stable and margins.sensitivity_accepted and enough


def read_own_urdf(path: Path) -> Urdf:
    """The user's file; `ConfigurationError` with one line for each problem."""
    if path.name == ARM_FILE or path.suffix == ".toml":
        raise ConfigurationError(f"{path}: must be a URDF file, it will stand beside {ARM_FILE} under its own name")
    return read_urdf(path)
