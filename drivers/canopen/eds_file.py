"""An EDS or DCF file as the `canopen` library's object dictionary, also where the file is sloppy.

The library's own reader ends at the first defect, in whatever object that is.  Here a defect costs the object that it
is in: an object that jointctl needs is refused when it is needed, with the defect; any other is only remarked on.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

from jointctl.drivers.canopen.eds_text import Sections, number_of, parse_sections, read_text, shown
from jointctl.drivers.canopen.standard_objects import BITS, CYCLIC, TYPE_NAME, standard_type
from jointctl.drivers.errors import ConfigurationError

DEFTYPES = 0x1000  # indices below are data types
ARRAY, RECORD = 8, 9
COMPACT_MOST = 254
_INDEX = re.compile(r"(?:0x)?([0-9a-f]{4})")
_SUB_INDEX = re.compile(r"(?:0x)?([0-9a-f]{4})\s*sub\s*([0-9a-f]{1,2})")
_STRINGS = (datatypes.VISIBLE_STRING, datatypes.OCTET_STRING, datatypes.UNICODE_STRING, datatypes.DOMAIN)
_KNOWN_TYPES = frozenset({*BITS, *_STRINGS, datatypes.REAL32, datatypes.REAL64, 0xC, 0xD})


@dataclass
class EdsFile:
    """What the file says, and what is wrong with it."""

    name: str
    dictionary: canopen.ObjectDictionary
    encoder: bool = False  # of an encoder (CiA 406), else of a drive (CiA 402)
    vendor_id: int | None = None  # None: the file does not tell
    product_code: int | None = None
    remarks: list[str] = field(default_factory=list)  # about the file and the objects that jointctl uses
    other_defects: list[str] = field(default_factory=list)  # in objects that it does not use
    unusable: dict[tuple[int, int], str] = field(default_factory=dict)  # left out of the dictionary, and why

    def all_remarks(self) -> list[str]:
        """One line each, those of other objects as one."""
        lines = [f"EDS {self.name}: {line}" for line in self.remarks]
        if self.other_defects:
            count, example = len(self.other_defects), self.other_defects[0]
            lines.append(f"EDS {self.name}: objects that jointctl does not use have {count} defects, such as {example}")
        return lines


def read_eds(path: Path, node: int, *, encoder: bool = False) -> EdsFile:
    """Read the file for `node` ($NODEID), a drive or encoder; `ConfigurationError` if it holds no object at all."""
    text, remarks = read_text(path)
    sections, defects = parse_sections(text)
    dictionary: Any = canopen.ObjectDictionary
    eds = EdsFile(path.name, dictionary(), encoder, remarks=remarks + defects)
    eds.dictionary.node_id = node
    for name, keys in sections.items():
        match = _INDEX.fullmatch(name)
        if match is not None and int(match[1], 16) >= DEFTYPES:
            _take_object(eds, int(match[1], 16), keys, sections, node)
    for name, keys in sections.items():
        match = _SUB_INDEX.fullmatch(name)
        if match is not None and int(match[1], 16) >= DEFTYPES:
            _take_member(eds, int(match[1], 16), int(match[2], 16), keys, sections, node)
    if not len(eds.dictionary):
        key = "joint_encoder.eds" if encoder else "drive.eds"
        raise ConfigurationError(f"{key} (={path}) is not a readable EDS file: it describes no object")
    _take_identity(eds, sections, node)
    return eds


def _defect(eds: EdsFile, index: int, sub: int, text: str) -> None:
    place = f"[{index:04X}sub{sub:X}]" if sub else f"[{index:04X}]"
    used = standard_type(index, sub, encoder=eds.encoder) is not None
    (eds.remarks if used else eds.other_defects).append(f"{place} {text}")


def _take_object(eds: EdsFile, index: int, keys: dict[str, str], sections: Sections, node: int) -> None:
    kind = number_of(keys.get("objecttype", "7"), node)
    members = number_of(keys.get("compactsubobj", "0"), node) or 0
    has_members = f"{index:04x}sub0" in sections or f"{index:04x}sub1" in sections
    if members or kind in (ARRAY, RECORD) or has_members:
        record = ODRecord(keys.get("parametername", f"{index:04X}"), index)
        eds.dictionary.add_object(record)
        if members:
            first = {"parametername": "Number of entries", "datatype": "0x5", "accesstype": "ro"}
            _take_member(eds, index, 0, first, sections, node)
        for sub in range(1, min(members, COMPACT_MOST) + 1):
            _take_member(eds, index, sub, keys, sections, node)
        if not members and not has_members:
            _defect(eds, index, 0, "is an array or record without members")
        return
    variable = _variable(eds, index, 0, keys, sections, node)
    if variable is not None:
        eds.dictionary.add_object(variable)


def _take_member(eds: EdsFile, index: int, sub: int, keys: dict[str, str], sections: Sections, node: int) -> None:
    record = eds.dictionary.indices.get(index)
    if not isinstance(record, ODRecord):
        if record is None:
            _defect(eds, index, sub, f"belongs to no section [{index:04X}]")
        record = ODRecord(f"{index:04X}", index)
        eds.dictionary.add_object(record)
    variable = _variable(eds, index, sub, keys, sections, node)
    if variable is not None:
        record.add_member(variable)


def _variable(
    eds: EdsFile, index: int, sub: int, keys: dict[str, str], sections: Sections, node: int
) -> ODVariable | None:
    data_type = _data_type(eds, index, sub, keys, sections, node)
    if data_type is None:
        return None
    variable = ODVariable(keys.get("parametername", f"{index:04X}:{sub}"), index, sub)
    variable.data_type = data_type
    variable.access_type = keys.get("accesstype", "rw").lower()
    variable.pdo_mappable = bool(number_of(keys.get("pdomapping", "0"), node))
    if data_type in BITS:
        for key, attribute in (
            ("lowlimit", "min"), ("highlimit", "max"), ("defaultvalue", "default"), ("parametervalue", "value"),
        ):  # fmt: skip
            setattr(variable, attribute, _value(eds, index, sub, key, keys.get(key, ""), data_type, node))
        if variable.min is not None and variable.max is not None and variable.min > variable.max:
            _defect(eds, index, sub, f"LowLimit (={variable.min}) is above HighLimit (={variable.max}): both ignored")
            variable.min = variable.max = None
    elif data_type in _STRINGS:
        variable.default = keys.get("defaultvalue")  # type: ignore[assignment]
        variable.value = keys.get("parametervalue")  # type: ignore[assignment]
    return variable


def _data_type(eds: EdsFile, index: int, sub: int, keys: dict[str, str], sections: Sections, node: int) -> int | None:
    """The type to use; None where the file leaves it open and no standard helps."""
    standard = standard_type(index, sub, encoder=eds.encoder)
    text = keys.get("datatype")
    found = None if text is None else number_of(text, node)
    if found is not None and found >= 0x40:
        # an editor's own type with limits: its basic type is the default of [<type>sub1]
        found = number_of(sections.get(f"{found:x}sub1", {}).get("defaultvalue", ""), node)
    if found in _KNOWN_TYPES:
        if standard is None or found == standard:
            return found
        name, right = TYPE_NAME.get(found, f"{found:#x}"), TYPE_NAME[standard]
        if BITS.get(found) == BITS[standard]:
            _defect(eds, index, sub, f"DataType (={name}) is {right} in the standard, which is used")
            return standard
        if (index, sub) not in CYCLIC and found in BITS:
            _defect(eds, index, sub, f"DataType (={name}) is {right} in the standard: the file's is used")
            return found
        text = f"DataType (={name}) must be {right}"
        eds.unusable[index, sub] = text
        _defect(eds, index, sub, text)
        return None
    wrong = "has no DataType" if text is None else f"DataType (={shown(text)}) is none"
    if standard is not None:
        _defect(eds, index, sub, f"{wrong}: {TYPE_NAME[standard]} of the standard is used")
        return standard
    eds.unusable[index, sub] = wrong
    _defect(eds, index, sub, wrong)
    return None


def _value(eds: EdsFile, index: int, sub: int, key: str, text: str, data_type: int, node: int) -> int | None:
    """A limit or default in the range of its type; None where there is none or it makes no sense."""
    if not text:
        return None
    bits = BITS[data_type]
    signed = data_type in datatypes.SIGNED_TYPES
    value = number_of(text, node)
    if value is not None and signed and 1 << (bits - 1) <= value < 1 << bits:
        value -= 1 << bits  # two's complement, as 0x8000 for the least INTEGER16
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    if value is None or not low <= value <= high:
        _defect(
            eds, index, sub, f"{key} (={shown(text)}) is no {TYPE_NAME.get(data_type, f'{bits} bit number')}: ignored"
        )
        return None
    return value


def _take_identity(eds: EdsFile, sections: Sections, node: int) -> None:
    """[DeviceInfo] and a DCF's own node number, which is spelt with one m in the standard."""
    device = sections.get("deviceinfo", {})
    vendor, product = (eds.dictionary.get_variable(0x1018, sub) for sub in (1, 2))
    eds.vendor_id = number_of(device.get("vendornumber", ""), node) or (vendor.default if vendor else None)
    eds.product_code = number_of(device.get("productnumber", ""), node) or (product.default if product else None)
    commissioning = sections.get("devicecomissioning") or sections.get("devicecommissioning") or {}
    own = number_of(commissioning.get("nodeid", ""), node)
    if own is not None and own != node:
        eds.remarks.append(f"was made for node {own}, this is node {node}")
