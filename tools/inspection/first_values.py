"""What a CANopen drive says about itself, as keys of a configuration.  Reads only.

Taken for granted is what the drive cannot have wrong (identity) or what jointctl compares with it before every run
(rated values, counts).  Everything else is a suggestion, to be confirmed by somebody who knows the joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jointctl.drivers.canopen.eds import EdsFile, read_eds
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.template import Place
from jointctl.tools.inspection.drive_info import MILLI
from jointctl.tools.inspection.subject import SdoReader

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
    current_mA, torque_mNm = reader.value(0x6075), reader.value(0x6076)
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


def _encoder(reader: SdoReader, found: FirstValues) -> None:
    counts, turns = reader.value(0x608F, 1), reader.value(0x608F, 2)
    motor, shaft = reader.value(0x6091, 1), reader.value(0x6091, 2)
    ratio, origin = (motor / shaft, "6091") if motor and shaft and motor != shaft else (None, "")
    if counts and counts > 3 and turns:
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
