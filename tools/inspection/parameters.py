"""A drive's objects as a set of values: read, compared, kept in a file, and written back."""

from __future__ import annotations

import io
import logging
import re
import tomllib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.canopen.eds import Sections, number_of, parse_sections, read_text
from jointctl.drivers.canopen.eds import shown as shown_text
from jointctl.drivers.canopen.pdo import DISABLED
from jointctl.drivers.canopen.sdo import download
from jointctl.drivers.errors import DataError, printable
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.tools.inspection.objects import INTEGERS, TEXTS, Objects, Place, read_dictionary
from jointctl.tools.inspection.subject import ATTEMPTS, Refusal, SdoReader, abort_text

Value = int | float | str | bytes
# Writable, but commands or process data and not settings: error history, store and restore, programme download,
# controlword, targets and their offsets, interpolation data, digital outputs.  They are never restored.
COMMANDS = frozenset(
    (0x1003, 0x1010, 0x1011, 0x1F50, 0x1F51, 0x1F57, 0x6040, 0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1,
     0x60FE, 0x60FF)
)  # fmt: skip
_HISTORY = 0x1003
AXES, OF_AXIS = 8, 0x800  # a device has so many axes at most, so far apart are their objects (CiA 301, from 6000 on)


@dataclass
class ParameterSet:
    """`parameters` can be written back; `readings` cannot or must not; `unreadable` tells why."""

    origin: str
    device: dict[str, Any] = field(default_factory=dict)
    parameters: dict[Place, Value] = field(default_factory=dict)
    readings: dict[Place, Value] = field(default_factory=dict)
    unreadable: dict[Place, str] = field(default_factory=dict)

    def put(self, variable: ODVariable, value: Value) -> None:
        """Into the group that the object belongs to."""
        group = self.parameters if is_parameter(variable) else self.readings
        group[Place(variable.index, variable.subindex)] = value


@dataclass(frozen=True)
class Difference:
    """None where one side does not have the object."""

    place: Place
    first: Value | None
    second: Value | None


def is_parameter(variable: ODVariable) -> bool:
    """Whether restoring may write the object."""
    counts = variable.subindex == 0 and variable.parent is not None and hasattr(variable.parent, "subindices")
    mapping = 0x1600 <= variable.index < 0x1800 or 0x1A00 <= variable.index < 0x1C00
    index = variable.index
    if 0x6000 <= index < 0x6000 + AXES * OF_AXIS:  # the same of each axis
        index = 0x6000 + (index - 0x6000) % OF_AXIS
    return bool(variable.writable and variable.readable and index not in COMMANDS and (mapping or not counts))


def variables(dictionary: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    """Every object with a value, in the order of their indices; dummy entries for gaps in PDOs are left out."""
    for index in sorted(dictionary):
        if index < 0x1000:
            continue
        entry = dictionary[index]
        if isinstance(entry, ODVariable):
            yield entry
        else:
            yield from (variable for _, variable in sorted(entry.subindices.items()))


def identity_of(reader: SdoReader) -> dict[str, Any]:
    """What a file is checked against before it is restored; names for people."""
    keys = ("vendor_id", "product_code", "revision", "serial_number")
    numbers = {key: reader.value(0x1018, sub) for sub, key in enumerate(keys, start=1)}
    return {"node": reader.node, **numbers, "name": reader.value(0x1008), "software": reader.value(0x100A)}


def read_parameters(reader: SdoReader, advance: Callable[[float], None] = lambda _: None) -> ParameterSet:
    """All readable objects of the EDS as the drive has them now; `advance` gets how many have been asked for."""
    reader.require_answer()
    found = ParameterSet(f"node {reader.node}", identity_of(reader))
    entries = 0
    for number, variable in enumerate(variables(reader.objects.required()), start=1):
        advance(number)
        place = Place(variable.index, variable.subindex)
        if not variable.readable or (place.index == _HISTORY and place.sub > entries):
            continue
        data = reader.upload(place.index, place.sub)
        if isinstance(data, Refusal):
            found.unreadable[place] = str(data)
            continue
        value = reader.objects.value(place.index, place.sub, data)
        if place == Place(_HISTORY):
            entries = int(value)
        found.put(variable, value)
    return found


def differences(first: ParameterSet, second: ParameterSet, *, readings: bool = False) -> list[Difference]:
    """Objects whose values differ, in order; `readings` looks at those that are no parameters as well."""
    a, b = dict(first.parameters), dict(second.parameters)
    if readings:
        a |= first.readings
        b |= second.readings
    places = sorted(set(a) | set(b), key=lambda place: (place.index, place.sub))
    return [Difference(place, a.get(place), b.get(place)) for place in places if a.get(place) != b.get(place)]


def shown(objects: Objects, place: Place, value: Value | None) -> str:
    if value is None:
        return "-"
    variable = objects.variable(place.index, place.sub)
    bits = len(variable) if variable is not None and variable.fixed_size else 32
    return objects.value_text(place.index, place.sub, value, bits)


# --- files: DCF (CiA 306), and the TOML dumps of older versions, which are only read ---

# TOML: `format`, [device], [parameters], [readings]; keys are "6072" or "1018:1" in hexadecimal, values numbers, texts,
# or {hex = "..."} for bytes.  Of a DCF, ParameterValue counts; of an EDS, or where it is missing, the default.
FORMAT = "jointctl parameters 1"
_DICTIONARIES = (".dcf", ".eds")
_NUMBERS = INTEGERS | {datatypes.BOOLEAN}  # in a file
_COMPACT_VALUES = re.compile(r"[0-9a-f]{4}value")
_REMARK = re.compile(r"\s;")  # what follows in a line is none of its value


def is_parameter_file(path: Path) -> bool:
    """A DCF or EDS by its name, a parameter file by its first key; everything else is a configuration."""
    if path.suffix.lower() in _DICTIONARIES:
        return True
    try:
        data = parse_toml(read_input(path).decode("utf-8"))
        return str(data.get("format", "")).startswith(FORMAT[:-2])
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return False


def _place(text: str, path: Path) -> Place:
    index, _, sub = text.partition(":")
    try:
        place = Place(int(index, 16), int(sub or "0", 16))
    except ValueError:
        place = Place(-1)
    if not (0 <= place.index <= 0xFFFF and 0 <= place.sub <= 0xFF):
        raise DataError(f"{path}: {text} is not an object: 6072 or 1018:1 is meant") from None
    return place


def _from_toml(raw: object, key: str, path: Path) -> Value:
    if isinstance(raw, dict) and set(raw) == {"hex"}:
        try:
            return bytes.fromhex(raw["hex"])
        except (ValueError, TypeError):
            raise DataError(f"{path}: {key} (={raw['hex']}) must be hexadecimal digits") from None
    if isinstance(raw, bool) or not isinstance(raw, (int, float, str)):
        raise DataError(f'{path}: {key} (={raw}) must be a number, a text, or {{hex = "..."}}')
    return raw


def load_parameters(path: Path, node: int = 1) -> ParameterSet:
    """A TOML, DCF or EDS file; `DataError` if it is none.  `node` is put where a DCF says $NODEID."""
    if path.suffix.lower() in _DICTIONARIES:
        return _load_dictionary(path, node)
    try:
        data = parse_toml(read_input(path).decode("utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from None
    if data.get("format") != FORMAT:
        raise DataError(f'{path}: format (={data.get("format")}) must be "{FORMAT}"')
    found = ParameterSet(path.name, dict(data.get("device", {})))
    for name, group in (("parameters", found.parameters), ("readings", found.readings)):
        section = data.get(name, {})
        if not isinstance(section, dict):
            raise DataError(f"{path}: {name} must be a section: [{name}]")
        group.update({_place(key, path): _from_toml(raw, f"{name}.{key}", path) for key, raw in section.items()})
    return found


def _load_dictionary(path: Path, node: int) -> ParameterSet:
    found = ParameterSet(path.name)
    dictionary = read_dictionary(path, node)
    sections, _ = parse_sections(read_text(path)[0])
    if compact := next(filter(_COMPACT_VALUES.fullmatch, sections), None):
        raise DataError(f"{path}: [{compact}] has values of members without sections of their own, which are not read")
    for variable in variables(dictionary):
        value = _from_dcf(path, variable, sections)
        if variable.readable and value is not None:
            found.put(variable, value)
    for sub, key in enumerate(("vendor_id", "product_code"), start=1):
        found.device[key] = found.readings.get(Place(0x1018, sub))
    commissioning = sections.get("devicecomissioning") or sections.get("devicecommissioning") or {}
    found.device["node"] = number_of(commissioning.get("nodeid", ""), node)
    return found


def _from_dcf(path: Path, variable: ODVariable, sections: Sections) -> Value | None:
    """As `Objects.value` gives it; None where the file has none; `DataError` for a setting's that is no number."""
    name = f"{variable.index:04x}"
    section = f"{name}sub{variable.subindex:x}"
    keys = sections.get(section, sections.get(name, {}))
    wanted = keys.get("parametervalue")
    text = keys.get("defaultvalue") if wanted is None else wanted
    value: Value | None = text
    if variable.data_type in _NUMBERS:
        value = variable.value if wanted else variable.default
        if value is not None and variable.data_type == datatypes.BOOLEAN:
            value = bytes([value])
    elif text is not None and variable.data_type not in TEXTS:
        try:
            value = float(text) if variable.data_type in datatypes.FLOAT_TYPES else bytes.fromhex(text)
        except ValueError:
            value = None
    numeric = variable.data_type in (*_NUMBERS, *datatypes.FLOAT_TYPES)
    if value is None and wanted and numeric and is_parameter(variable):  # else its default would be written
        place = section if section in sections else name
        raise DataError(f"{path}: [{place}] ParameterValue (={shown_text(wanted)}) is no number of its DataType")
    return value


def _dcf_value(variable: ODVariable, value: Value) -> str | None:
    """What stands in the file; None for a text that a DCF cannot hold: it has neither quotes nor escapes."""
    if isinstance(value, bytes):
        return str(value[0]) if variable.data_type == datatypes.BOOLEAN and value else value.hex()
    if not isinstance(value, str):
        return str(value)
    return value if printable(value) == value.strip() and not _REMARK.search(value) else None


def dcf_text(found: ParameterSet, dictionary: canopen.ObjectDictionary) -> str:
    """The EDS with the values as ParameterValue, by the `canopen` library.

    What the drive did not report has neither value nor default, so that restoring does not write it; a text that a DCF
    cannot hold is moved to `found.unreadable`.
    """
    for variable in variables(dictionary):
        raw: Any = variable  # the library writes negative numbers, and bytes, in a way that it cannot read
        raw.default_raw = None if variable.default is None else str(variable.default)
        place = Place(variable.index, variable.subindex)
        group = found.parameters if place in found.parameters else found.readings
        raw.value_raw = _dcf_value(variable, group[place]) if place in group else None
        if raw.value_raw is None and variable.readable:
            variable.default = raw.default_raw = None
            if group.pop(place, None) is not None:
                found.unreadable[place] = "a text that a DCF cannot hold"
    logging.getLogger("canopen").setLevel(logging.ERROR)
    text = io.StringIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the library, about utcnow
        canopen.export_od(dictionary, text, "dcf")
    return text.getvalue()


# --- writing back ---

_SPAN = 0x200
_COMMUNICATION, _MAPPING_OFFSET = (0x1400, 0x1800), 0x200


@dataclass(frozen=True)
class Written:
    """`failure` is empty if the value was taken and reads back."""

    place: Place
    wanted: Value
    failure: str = ""


def write_value(reader: SdoReader, place: Place, value: Value) -> str:
    """Write and read back; "" or what went wrong."""
    variable = reader.objects.variable(place.index, place.sub)
    if variable is None:
        return "the EDS does not have it"
    try:
        data = variable.encode_raw(value)
    except Exception as error:  # the library raises whatever struct does
        return f"{value!r} does not fit its type: {error}"
    failure = _download(reader, place, data)
    if failure:
        return failure
    found = reader.upload(place.index, place.sub)
    if isinstance(found, Refusal):
        return f"written, but not read back: {found}"
    value_read = reader.objects.value(place.index, place.sub, found)
    return "" if value_read == value else f"reads back {reader.objects.text(place.index, place.sub, found)}"


def _download(reader: SdoReader, place: Place, data: bytes) -> str:
    for _ in range(ATTEMPTS):
        try:
            download(reader.remote.sdo, place.index, place.sub, data)
            return ""
        except SdoAbortedError as error:
            return abort_text(error.code)
        except SdoCommunicationError:
            continue
    return "no answer"


def _pdo_of(place: Place) -> int | None:
    """Index of the communication record that an object of a PDO belongs to."""
    for base in _COMMUNICATION:
        if base <= place.index < base + _SPAN:
            return place.index
        if base + _MAPPING_OFFSET <= place.index < base + _MAPPING_OFFSET + _SPAN:
            return place.index - _MAPPING_OFFSET
    return None


def _write_pdo(
    reader: SdoReader, communication: int, changed: dict[Place, Value], all_values: dict[Place, Value]
) -> Iterator[Written]:
    """One PDO: switched off while it changes; its identifier, which may switch it on again, comes last."""
    identifier, mapping = Place(communication, 1), communication + _MAPPING_OFFSET
    before = reader.value(identifier.index, 1)
    final = all_values.get(identifier, before)
    if isinstance(before, int) and not before & DISABLED:
        _download(reader, identifier, (before | DISABLED).to_bytes(4, "little"))
    for place, value in changed.items():
        if place.index == communication and place != identifier:
            yield Written(place, value, write_value(reader, place, value))
    mapped = {place: value for place, value in changed.items() if place.index == mapping}
    if mapped:
        count = all_values.get(Place(mapping, 0), reader.value(mapping, 0) or 0)
        off = _download(reader, Place(mapping, 0), b"\0")
        for place, value in mapped.items():
            if place.sub:
                yield Written(place, value, off or write_value(reader, place, value))
        failure = write_value(reader, Place(mapping, 0), count)
        if failure or Place(mapping, 0) in mapped:
            yield Written(Place(mapping, 0), count, failure)
    if final is not None:
        failure = write_value(reader, identifier, final)
        if failure or identifier in changed:
            yield Written(identifier, final, failure)


def restore(reader: SdoReader, changed: dict[Place, Value], all_values: dict[Place, Value]) -> list[Written]:
    """Write `changed`, a part of `all_values` of the file; the node is pre-operational and its drive is off.

    Each value is read back; what is refused is reported and does not end the work.  The order is that of the indices,
    except for PDOs, whose identifier and mapping change in the order of CiA 301 (disable, type, number 0, entries,
    number, enable).  What was refused is tried once more at the end: one object may only accept its value after another
    has got its own (a minimum above the old maximum).
    """
    results: dict[Place, Written] = {}
    pdos: dict[int, dict[Place, Value]] = {}
    for place, value in changed.items():
        pdo = _pdo_of(place)
        if pdo is None:
            results[place] = Written(place, value, write_value(reader, place, value))
        else:
            pdos.setdefault(pdo, {})[place] = value
    for communication, part in pdos.items():
        for done in _write_pdo(reader, communication, part, all_values):
            results[done.place] = done
    for place, done in list(results.items()):
        if done.failure and _pdo_of(place) is None:
            results[place] = Written(place, done.wanted, write_value(reader, place, done.wanted))
    return list(results.values())
