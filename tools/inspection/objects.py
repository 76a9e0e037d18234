"""The objects of a node by name and type: from its EDS where there is one, else from the standard's own table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.sdo import object_name
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import require_input
from jointctl.tools.inspection import drive_words
from jointctl.tools.inspection.standard_objects import standard_variable
from jointctl.tools.session.fault_words import emergency_text

SIGNED = frozenset(datatypes.SIGNED_TYPES)
INTEGERS = frozenset(datatypes.INTEGER_TYPES)
TEXTS = frozenset((datatypes.VISIBLE_STRING, datatypes.UNICODE_STRING))
_LONGEST_SHOWN = 32  # bytes of a domain


def read_dictionary(path: Path, node: int) -> canopen.ObjectDictionary:
    """The objects of an EDS or DCF; `ConfigurationError` if it cannot be read."""
    try:
        require_input(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: is not a readable EDS file: {error.strerror or error}") from None
    return read_eds(path, node).dictionary


@dataclass(frozen=True)
class Place:
    """One object: index and sub-index."""

    index: int
    sub: int = 0

    def __str__(self) -> str:
        return object_name(self.index, self.sub)


class Objects:
    """Names, types and values in words for one node; without a dictionary only the standard's objects are known."""

    def __init__(self, dictionary: canopen.ObjectDictionary | None = None) -> None:
        self.dictionary = dictionary
        self.variable = lru_cache(maxsize=4096)(self._variable)

    def required(self) -> canopen.ObjectDictionary:
        """The dictionary, or `ConfigurationError`."""
        if self.dictionary is None:
            raise ConfigurationError("which objects does the drive have?", "give a configuration, or --eds FILE")
        return self.dictionary

    def _variable(self, index: int, sub: int = 0) -> ODVariable | None:
        found = self.dictionary.get_variable(index, sub) if self.dictionary is not None else None
        return found if found is not None else standard_variable(index, sub)

    def name(self, index: int, sub: int = 0) -> str:
        """`Statusword`; for a sub-index the name of its object as well; empty if nobody knows."""
        variable = self.variable(index, sub)
        if variable is None:
            return ""
        parent = variable.parent
        if isinstance(parent, (ODRecord, ODArray)) and parent.name not in variable.name:
            return f"{parent.name}, {variable.name}"
        return str(variable.name)

    def value(self, index: int, sub: int, data: bytes) -> Any:
        """What the bytes mean: int, float, text, or the bytes themselves where the type is not known."""
        variable = self.variable(index, sub)
        kind = None if variable is None else variable.data_type
        if kind in TEXTS:
            return data.rstrip(b"\0").decode("latin-1")
        if kind in INTEGERS:
            return int.from_bytes(data, "little", signed=kind in SIGNED)
        if kind in datatypes.FLOAT_TYPES and len(data) in (4, 8):
            assert variable is not None
            return float(variable.decode_raw(data))
        return int.from_bytes(data, "little") if kind is None and 0 < len(data) <= 4 else data

    def text(self, index: int, sub: int, data: bytes) -> str:
        """The value for people: hexadecimal where bits matter, words where codes have names."""
        value = self.value(index, sub, data)
        return self.value_text(index, sub, value, 8 * len(data))

    def value_text(self, index: int, sub: int, value: Any, bits: int) -> str:
        """As `text`, of a value that has been decoded."""
        if isinstance(value, bytes):
            return value[:_LONGEST_SHOWN].hex(" ") + (" ..." if len(value) > _LONGEST_SHOWN else "")
        if isinstance(value, str):
            return f'"{value}"'
        if isinstance(value, float):
            return f"{value:g}"
        words = _words(index, sub, value)
        if words is not None:
            return words
        variable = self.variable(index, sub)
        if variable is None or index < 0x2000 or (variable.data_type not in SIGNED and bits == 32 and value > 0xFFFFFF):
            return f"{value:0{bits // 4}X}h"
        return str(value)


def _words(index: int, sub: int, value: int) -> str | None:
    """Values that have names."""
    if index == 0x6041:
        return drive_words.status_text(value)
    if index == 0x6040:
        return drive_words.control_text(value)
    if index in (0x6060, 0x6061):
        return drive_words.mode_text(value)
    if index == 0x603F or (index == 0x1003 and sub > 0):
        return drive_words.no_error_or(value & 0xFFFF, emergency_text)
    if index == 0x1001:
        return drive_words.error_register_text(value)
    if index == 0x6502:
        return f"{value:08X}h, " + ", ".join(drive_words.supported_modes(value))
    if index in (0x1017, 0x100C):
        return f"{value} ms"
    if index == 0x1016 and sub > 0:
        return f"node {value >> 16 & 0x7F}, {value & 0xFFFF} ms"
    return None
