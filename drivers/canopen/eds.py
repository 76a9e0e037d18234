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
from canopen.objectdictionary import ODRecord, ODVariable
from canopen.objectdictionary import datatypes as types

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import read_input

# --- data types of the objects that jointctl uses, by CiA 301, 402 and 406: what a file is measured by ---

U8, U16, U32 = types.UNSIGNED8, types.UNSIGNED16, types.UNSIGNED32
I8, I16, I32 = types.INTEGER8, types.INTEGER16, types.INTEGER32

TYPE_NAME = {
    types.BOOLEAN: "BOOLEAN", I8: "INTEGER8", I16: "INTEGER16", I32: "INTEGER32", types.INTEGER64: "INTEGER64",
    U8: "UNSIGNED8", U16: "UNSIGNED16", U32: "UNSIGNED32", types.UNSIGNED64: "UNSIGNED64",
}  # fmt: skip
BITS = {
    types.BOOLEAN: 8, I8: 8, U8: 8, I16: 16, U16: 16, types.INTEGER24: 24, types.UNSIGNED24: 24, I32: 32, U32: 32,
    types.INTEGER40: 40, types.UNSIGNED40: 40, types.INTEGER48: 48, types.UNSIGNED48: 48, types.INTEGER56: 56,
    types.UNSIGNED56: 56, types.INTEGER64: 64, types.UNSIGNED64: 64,
}  # fmt: skip

_EVERY_DEVICE = {0x1000: U32, 0x1001: U8, 0x1005: U32, 0x1006: U32, 0x1014: U32, 0x1017: U16, 0x1019: U8}
_DRIVE = _EVERY_DEVICE | {
    0x6007: I16, 0x603F: U16, 0x6040: U16, 0x6041: U16, 0x605A: I16, 0x6060: I8, 0x6061: I8, 0x6064: I32,
    0x6071: I16, 0x6072: U16, 0x6075: U32, 0x6076: U32, 0x6077: I16, 0x607F: U32, 0x6083: U32, 0x6084: U32,
    0x6087: U32, 0x60B1: I32, 0x60B2: I16, 0x60FF: I32, 0x6502: U32,
}  # fmt: skip
_ENCODER = _EVERY_DEVICE | {0x6001: U32, 0x6002: U32, 0x6004: U32, 0x6200: U16, 0x6503: U16}
_MEMBERS = {
    (0x1018, 1): U32, (0x1018, 2): U32, (0x1018, 3): U32, (0x1018, 4): U32, (0x1029, 1): U8,
    (0x60E4, 1): I32, (0x60C2, 1): U8, (0x60C2, 2): I8,
}  # fmt: skip
_COMMUNICATION = {0: U8, 1: U32, 2: U8, 3: U16, 5: U16, 6: U8}
# mapped by the loop: their length is the length of their place in the PDO
CYCLIC = frozenset({(0x6040, 0), (0x6041, 0), (0x6064, 0), (0x6071, 0), (0x6077, 0), (0x60FF, 0), (0x6004, 0)})


def standard_type(index: int, sub: int, *, encoder: bool = False) -> int | None:
    """DataType (CiA 301, table 44) of an object of a drive or encoder; None for one that jointctl does not use."""
    single = _ENCODER if encoder else _DRIVE
    if sub == 0 and index in single:
        return single[index]
    if (index, sub) in _MEMBERS:
        return _MEMBERS[index, sub]
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return _COMMUNICATION.get(sub)
    if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00 or index == 0x1016:
        return U8 if sub == 0 else U32
    return None


# --- the file's text (CiA 306) as sections of keys: nothing here raises for a bad line, every defect is one remark ---

LONGEST_NUMBER = 40
LONGEST_SHOWN = 60
Sections = dict[str, dict[str, str]]

_LINE_END = re.compile(r"\r\n|\r|\n")
_SECTION = re.compile(r"\[\s*(.*?)\s*\]")
_NODE_ID = re.compile(r"\+?\$NODEID\+?")
_NUMBERS = (  # the first form counts; `int` by itself takes more, such as 1_0
    (re.compile(r"[+-]?0X[0-9A-F]+"), 16),
    (re.compile(r"[+-]?0[0-7]+"), 8),
    (re.compile(r"[+-]?[0-9]+"), 10),
    (re.compile(r"[0-9]*[A-F][0-9A-F]*"), 16),
)


def shown(text: str) -> str:
    """What a file holds, for a message: one line, no control characters, not too long."""
    clean = "".join(character if character.isprintable() else "?" for character in text)
    return clean if len(clean) <= LONGEST_SHOWN else clean[:LONGEST_SHOWN] + "..."


def decoded(data: bytes) -> tuple[str, list[str]]:
    """Text of UTF-8 (with or without byte order mark), UTF-16 with a mark, else Latin-1, which takes any byte."""
    remarks = []
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
        remarks.append("is UTF-16, CiA 306 asks for ASCII")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1").removeprefix("\xef\xbb\xbf")
            remarks.append("is not UTF-8: read as Latin-1")
    if "\0" in text:
        text = text.replace("\0", "")
        remarks.append("holds NUL characters, which were skipped")
    return text, remarks


def read_text(path: Path) -> tuple[str, list[str]]:
    """The file's text and what is odd about its encoding; `ConfigurationError` if it cannot be read at all."""
    try:
        return decoded(read_input(path))
    except OSError as error:
        refusal = f"drive.eds (={path}) is not a readable EDS file: {error.strerror or error}"
        raise ConfigurationError(refusal) from error


def parse_sections(text: str) -> tuple[Sections, list[str]]:
    """Sections by their name in lower case, keys in lower case.  What comes first counts."""
    sections: Sections = {}
    remarks: list[str] = []
    current: dict[str, str] | None = None
    name = ""
    for number, raw in enumerate(_LINE_END.split(text), start=1):
        line = raw.strip()
        if not line or line[0] in ";#":
            continue
        header = _SECTION.match(line)
        if header is not None:
            name = header[1].lower()
            if name in sections:
                remarks.append(f"line {number}: [{shown(header[1])}] a second time: only what the first lacks is taken")
            current = sections.setdefault(name, {})
            continue
        key, equals, value = line.partition("=")
        if not equals or not key.strip():
            remarks.append(f"line {number}: neither [section] nor key=value: skipped")
        elif current is None:
            remarks.append(f"line {number}: before the first section: skipped")
        else:
            key, value = key.strip().lower(), re.split(r"\s;", value, maxsplit=1)[0].strip()
            if current.setdefault(key, value) != value:
                remarks.append(f"line {number}: [{shown(name)}] {shown(key)} a second time with another value: skipped")
    return sections, remarks


def number_of(text: str, node: int) -> int | None:
    """A number as CiA 306 writes it: decimal, 0x.., octal with a leading 0, $NODEID+..; None if it is none.

    Hexadecimal digits without 0x are taken where they can be nothing else (1F).
    """
    compact = re.sub(r"\s", "", text)
    if len(compact) > LONGEST_NUMBER or not compact.isascii():
        return None
    compact = compact.upper().rstrip("UL")
    if "$NODEID" in compact:
        rest = _NODE_ID.sub("", compact)
        offset = number_of(rest, node) if rest else 0
        return None if offset is None else offset + node
    for form, base in _NUMBERS:
        if form.fullmatch(compact):
            return int(compact, base)
    return None


# --- sections as an object dictionary ---

DEFTYPES = 0x1000  # indices below are data types
ARRAY, RECORD = 8, 9
COMPACT_MOST = 254
_INDEX = re.compile(r"(?:0x)?([0-9a-f]{4})")
_SUB_INDEX = re.compile(r"(?:0x)?([0-9a-f]{4})\s*sub\s*([0-9a-f]{1,2})")
_STRINGS = (types.VISIBLE_STRING, types.OCTET_STRING, types.UNICODE_STRING, types.DOMAIN)
_KNOWN_TYPES = frozenset({*BITS, *_STRINGS, types.REAL32, types.REAL64, 0xC, 0xD})


@dataclass
class EdsFile:
    """What the file says, and what is wrong with it."""

    name: str
    dictionary: canopen.ObjectDictionary
    encoder: bool = False  # of an encoder (CiA 406), else of a drive (CiA 402)
    vendor_id: int | None = None  # None: the file does not state it
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
    _give_each_pdo_a_mapping(eds)
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
    signed = data_type in types.SIGNED_TYPES
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


def _give_each_pdo_a_mapping(eds: EdsFile) -> None:
    """A PDO whose mapping the file leaves out has an empty one: the library looks up the mapping of each PDO."""
    for index in list(eds.dictionary):
        if (0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00) and index + 0x200 not in eds.dictionary:
            _defect(eds, index + 0x200, 0, f"is missing: PDO {index:04X} has no mapping")
            eds.dictionary.add_object(ODRecord(f"{index + 0x200:04X}", index + 0x200))


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
