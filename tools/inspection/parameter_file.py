"""Parameter files: TOML of our own for people and version control, and DCF (CiA 306) for other tools.

TOML: `format`, [device], [parameters], [readings], [unreadable]; keys are "6072" or "1018:1" in hexadecimal, values
numbers, texts, or {hex = "..."} for bytes.  Of a DCF, ParameterValue counts; of an EDS, or where it is missing, the
default.
"""

from __future__ import annotations

import logging
import tomllib
import warnings
from pathlib import Path
from typing import Any

import canopen
import tomlkit

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.tools.inspection.objects import Objects, Place, read_dictionary
from jointctl.tools.inspection.parameters import ParameterSet, Value, shown, variables

FORMAT = "jointctl parameters 1"
_DICTIONARIES = (".dcf", ".eds")
_HEX_FROM = 0x2000  # below, values are identifiers and mappings, which people read in hexadecimal


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


def _from_toml(raw: Any, key: str, path: Path) -> Value:
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
    for variable in variables(dictionary):
        value = variable.value if variable.value is not None else variable.default
        if variable.readable and value is not None:
            found.put(variable, value)
    for sub, key in enumerate(("vendor_id", "product_code"), start=1):
        found.device[key] = found.readings.get(Place(0x1018, sub))
    return found


def toml_text(found: ParameterSet, objects: Objects) -> str:
    """The file, with the names of the objects as comments."""
    document = tomlkit.document()
    document.add("format", tomlkit.item(FORMAT))
    device = tomlkit.table()
    for key, value in found.device.items():
        if value is not None:
            device.add(key, value)
    document.add("device", device)
    for name, group in (("parameters", found.parameters), ("readings", found.readings)):
        table = tomlkit.table()
        for place, value in group.items():
            item: Any = tomlkit.inline_table() if isinstance(value, bytes) else None
            if isinstance(value, bytes):
                item["hex"] = value.hex()
            elif isinstance(value, int) and place.index < _HEX_FROM and value > 9:
                item = tomlkit.items.Integer(value, tomlkit.items.Trivia(), f"{value:#x}")
            else:
                item = tomlkit.item(value)
            words = shown(objects, place, value)
            item.comment(objects.name(place.index, place.sub) + (f": {words}" if " " in words else ""))
            table.add(str(place), item)
        document.add(name, table)
    refused = tomlkit.table()
    for place, why in found.unreadable.items():
        refused.add(str(place), why)
    document.add("unreadable", refused)
    return tomlkit.dumps(document)


def write_dcf(found: ParameterSet, dictionary: canopen.ObjectDictionary, path: Path) -> None:
    """The EDS with the values as ParameterValue, by the `canopen` library."""
    for variable in variables(dictionary):
        value = (found.parameters | found.readings).get(Place(variable.index, variable.subindex))
        if value is None:
            continue
        # the library writes negative numbers in a way that it cannot read
        raw: Any = variable
        raw.value_raw = value.hex() if isinstance(value, bytes) else str(value)
    logging.getLogger("canopen").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the library, about utcnow
        canopen.export_od(dictionary, str(path), "dcf")
