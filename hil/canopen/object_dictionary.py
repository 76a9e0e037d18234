"""The object dictionary of the virtual drive: what the EDS states, laid over the memory of the compiled core.

The EDS alone says what exists, its type, access, limits, default and PDO-mappability.  An object that the core uses
lives in a field of `Device` (see `device_fields.FIELDS`) and is read and written by one typed load or store, so
that the SDO server may run beside the core.  Strings and constants live here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import canopen
import numpy as np
from canopen.objectdictionary import ODVariable

from jointctl.firmware_py.schema import dtype_of
from jointctl.hil.canopen.device_fields import FIELDS
from jointctl.hil.canopen.device_records import Device

_TYPES = {1: "u1", 2: "i1", 3: "<i2", 4: "<i4", 5: "u1", 6: "<u2", 7: "<u4"}
_VISIBLE_STRING = 9

TOGGLE_ERROR = 0x05030000
TIMED_OUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
BLOCK_SIZE = 0x05040002
SEQUENCE_NUMBER = 0x05040003
CRC_ERROR = 0x05040004
UNSUPPORTED_ACCESS = 0x06010000
NO_OBJECT = 0x06020000
NO_SUB_INDEX = 0x06090011
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
PDO_LENGTH = 0x06040042
LENGTH_MISMATCH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
INVALID_VALUE = 0x06090030
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
HARDWARE = 0x06060000
CANNOT_STORE = 0x08000020
DEVICE_STATE = 0x08000022
NO_DATA = 0x08000024


def is_mapping(index: int) -> bool:
    """Whether the object maps a PDO."""
    return 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00


class SdoAbort(Exception):
    """An access that is answered with an SDO abort code (CiA 301, table 22)."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort 0x{code:08X}")
        self.code = code


@dataclass(frozen=True)
class Entry:
    """One (index, sub) as the EDS describes it; `dtype` is None for a string."""

    index: int
    sub: int
    name: str
    dtype: np.dtype[Any] | None
    readable: bool
    writable: bool
    mappable: bool
    default: int | str
    low: int | None
    high: int | None

    @property
    def size(self) -> int:
        """Bytes of a number, 0 for a string."""
        return self.dtype.itemsize if self.dtype is not None else 0


def load_entries(eds_path: Path, node_id: int) -> dict[tuple[int, int], Entry]:
    """Read the EDS; $NODEID is resolved."""
    entries: dict[tuple[int, int], Entry] = {}
    try:
        dictionary = canopen.import_od(str(eds_path), node_id=node_id)
    except Exception as error:  # the library lets every exception of its parsers through
        raise ValueError(f"{eds_path.name}: not a readable EDS file: {' '.join(str(error).split())}") from None
    for item in dictionary.values():
        for variable in [item] if isinstance(item, ODVariable) else item.values():
            key = (variable.index, variable.subindex)
            if variable.data_type not in _TYPES and variable.data_type != _VISIBLE_STRING:
                raise ValueError(
                    f"{eds_path.name}: DataType of {key[0]:04X}:{key[1]} (={variable.data_type}) must be in "
                    f"{sorted(_TYPES)} or {_VISIBLE_STRING}"
                )
            name = _TYPES.get(variable.data_type)
            entries[key] = Entry(
                *key,
                name=variable.name,
                dtype=np.dtype(name) if name else None,
                readable=variable.readable,
                writable=variable.writable,
                mappable=bool(variable.pdo_mappable),
                default=variable.default if variable.default is not None else (0 if name else ""),
                low=variable.min,
                high=variable.max,
            )
    return entries


def split_field(field: str) -> tuple[str, int]:
    """ "name" or "name[flat element]" as (name, element)."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
    assert match is not None
    return match[1], int(match[2] or 0)


def field_view(memory: Any, path: tuple[str, ...], field: str) -> np.ndarray:
    """A one-element view into the first `Device` of `memory`: of `field` in the record that `path` leads to."""
    name, element = split_field(field)
    record, offset = dtype_of(Device), 0
    for part in (*path, name):
        record, start = record.fields[part][:2]  # type: ignore[index]
        offset += start
    dtype = record.subdtype[0] if record.subdtype else record
    bytes_of_memory = memory.view(np.ndarray).view(np.uint8).data
    return np.ndarray((1,), dtype, buffer=bytes_of_memory, offset=offset + element * dtype.itemsize)


class ObjectDictionary:
    """Values of all objects of one device; `memory` is its `Device` record array of one element."""

    def __init__(self, eds_path: Path, node_id: int, memory: Any) -> None:
        self._take_entries(load_entries(eds_path, node_id))
        for key, field in FIELDS.items():
            if key not in self.entries:
                raise ValueError(f"{eds_path.name}: object {key[0]:04X}:{key[1]} must be there, the drive uses it")
            group = "communication" if key[0] < 0x2000 else "drive"
            self._live[key] = field_view(memory, (group,), field)
            self._initial[key] = field_view(memory, (f"default_{group}",), field)
            if self._live[key].dtype != self.entries[key].dtype:
                raise ValueError(
                    f"{eds_path.name}: type of {key[0]:04X}:{key[1]} (={self.entries[key].dtype}) "
                    f"must be {self._live[key].dtype}"
                )
            default = self.entries[key].default
            try:
                self.set_default(*key, int(default))
            except (ValueError, OverflowError):
                place, kind = f"{key[0]:04X}:{key[1]}", self._live[key].dtype
                raise ValueError(f"{eds_path.name}: DefaultValue of {place} (={default}) must be a {kind}") from None
        self.restore_strings()

    def _take_entries(self, entries: dict[tuple[int, int], Entry]) -> None:
        self.entries = entries
        self._indices = {index for index, _ in entries}
        self._live: dict[tuple[int, int], np.ndarray] = {}
        self._initial: dict[tuple[int, int], np.ndarray] = {}
        self._strings: dict[tuple[int, int], bytes] = {}
        self._default_strings = {k: str(e.default).encode() for k, e in entries.items() if e.dtype is None}

    def __iter__(self) -> Iterator[Entry]:
        return iter(self.entries.values())

    def entry(self, index: int, sub: int) -> Entry:
        """The entry, or the abort that says what is missing."""
        found = self.entries.get((index, sub))
        if found is None:
            raise SdoAbort(NO_SUB_INDEX if index in self._indices else NO_OBJECT)
        return found

    def set_default(self, index: int, sub: int, value: int | bytes) -> None:
        """Change what a reset restores (settings of the device); the present value changes at the next reset."""
        if isinstance(value, bytes):
            self._default_strings[index, sub] = value
        else:
            self._initial[index, sub][0] = value

    def default(self, index: int, sub: int) -> int | bytes:
        """What a reset restores."""
        initial = self._initial.get((index, sub))
        return int(initial[0]) if initial is not None else self._default_strings[index, sub]

    def restore_strings(self) -> None:
        """Reset of the objects that the core does not know."""
        self._strings = dict(self._default_strings)

    def value(self, index: int, sub: int) -> int:
        """Present value of a number, whatever its access."""
        live = self._live.get((index, sub))
        return int(live[0]) if live is not None else int(self.entry(index, sub).default)

    def read(self, index: int, sub: int) -> bytes:
        """What an SDO upload gives."""
        entry = self.entry(index, sub)
        if not entry.readable:
            raise SdoAbort(WRITE_ONLY)
        if index == 0x1003 and sub > self.value(0x1003, 0):
            raise SdoAbort(NO_DATA)
        if entry.dtype is None:
            return self._strings[index, sub]
        return np.array(self.value(index, sub), entry.dtype).tobytes()

    def check(self, index: int, sub: int, data: bytes) -> int:
        """Judge a download by what the EDS says: access, length, range.  The number, or 0 for a string."""
        entry = self.entry(index, sub)
        if not entry.writable:
            raise SdoAbort(READ_ONLY)
        if entry.dtype is None:
            return 0
        if len(data) != entry.size:
            raise SdoAbort(TOO_LONG if len(data) > entry.size else TOO_SHORT)
        value = int(np.frombuffer(data, entry.dtype)[0])
        if entry.high is not None and value > entry.high:
            raise SdoAbort(PDO_LENGTH if sub == 0 and is_mapping(index) else TOO_HIGH)
        if entry.low is not None and value < entry.low:
            raise SdoAbort(TOO_LOW)
        return value

    def store(self, index: int, sub: int, data: bytes) -> None:
        """Write without judging."""
        if (index, sub) in self._live:
            live = self._live[index, sub]
            live[0] = np.frombuffer(data, live.dtype)[0]
        elif self.entries[index, sub].dtype is None:
            self._strings[index, sub] = data
