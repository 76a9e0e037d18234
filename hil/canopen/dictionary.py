"""Objects of the virtual drive: what is there, what may be written when, what a file keeps."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import canopen
import numpy as np
from canopen.objectdictionary import ODVariable

from jointctl.firmware_py.schema import dtype_of
from jointctl.hil.canopen.records import EVENT_DRIVEN, FIELDS, LAST_SYNCHRONOUS, MAPPED, PDOS, Device, PowerState

# --- The object dictionary of the virtual drive: what the EDS states, laid over the memory of the compiled core ---
# The EDS alone says what exists, its type, access, limits, default and PDO-mappability.  An object that the core uses
# lives in a field of `Device` (see `records.FIELDS`) and is read and written by one typed load or store, so
# that the SDO server may run beside the core.  Strings and constants live here.


_TYPES = {1: "u1", 2: "i1", 3: "<i2", 4: "<i4", 5: "u1", 6: "<u2", 7: "<u4"}
_OTHER_TYPES = {0x15: "<i8", 0x1B: "<u8"}  # of another drive's EDS; the core has none of them
_BYTES = {8: 4, 0x10: 3, 0x11: 8, 0x12: 5, 0x13: 6, 0x14: 7, 0x16: 3, 0x18: 5, 0x19: 6, 0x1A: 7}  # kept as they come
_VISIBLE_STRING = 9
MAKERS_LIMIT_BYTES = 4  # of `DriveObjects.makers_limit`

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
    """One (index, sub) as the EDS describes it; `dtype` is None for a string or bytes."""

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
            entries[key] = _entry(variable)
    return entries


def _entry(variable: ODVariable) -> Entry:
    name = {**_TYPES, **_OTHER_TYPES}.get(variable.data_type or 0)
    return Entry(
        variable.index,
        variable.subindex,
        name=variable.name,
        dtype=np.dtype(name) if name else None,
        readable=variable.readable,
        writable=variable.writable,
        mappable=bool(variable.pdo_mappable),
        default=variable.default if variable.default is not None else (0 if name else ""),
        low=variable.min,
        high=variable.max,
    )


def _foreign_entry(variable: ODVariable, own: Entry | None) -> Entry:
    """An object of another drive's EDS.  Where that leaves the default open, `own` has it.

    Many files give 0 as the default of everything: for a drive object (6000h and above) it counts as left open.
    Speeds and ramps are in counts of an encoder that no file knows: they are `own`, which suit the joint.
    Limits below 2000h are the standard's: files have them wrong (1016:1 up to 65535, without the node).
    """
    entry = _entry(variable)
    if own is not None and entry.index < 0x2000:
        entry = replace(entry, low=own.low, high=own.high)
    if entry.dtype is None:
        size = _BYTES.get(variable.data_type or 0)
        return replace(entry, default=str(entry.default) if size is None else "\0" * size)
    left_open = variable.default is None or (entry.default == 0 and entry.index >= 0x6000)
    left_open = left_open or (variable.index, variable.subindex) in _IN_COUNTS
    if left_open and own is not None and own.dtype is not None:
        return replace(entry, default=own.default)
    return entry


def split_field(field: str) -> tuple[str, int]:
    """ "name" or "name[flat element]" as (name, element)."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
    assert match is not None
    return match[1], int(match[2] or 0)


def field_view(memory: np.recarray, path: tuple[str, ...], field: str) -> np.ndarray:
    """A one-element view into the first `Device` of `memory`: of `field` in the record that `path` leads to."""
    name, element = split_field(field)
    record, offset = dtype_of(Device), 0
    for part in (*path, name):
        record, start = record.fields[part][:2]  # type: ignore[index]
        offset += start
    dtype = record.subdtype[0] if record.subdtype else record
    bytes_of_memory = memory.view(np.ndarray).view(np.uint8).data
    return np.ndarray((1,), dtype, buffer=bytes_of_memory, offset=offset + element * dtype.itemsize)


EDS_COUNTS_PER_TURN = 2.0**19  # of the joint, for which the EDS has its speeds and ramps
LARGEST_UNSIGNED = 0xFFFFFFFF
_IN_COUNTS = frozenset(((0x6081, 0), (0x6083, 0), (0x6084, 0), (0x6085, 0), (0x6099, 1), (0x6099, 2), (0x609A, 0)))


class ObjectDictionary:
    """Values of all objects of one device; `memory` is its `Device` record array of one element.

    `shown` are the objects of another drive: SDO and mappings know those and no others.  What the core has of them
    lives in `memory`, the rest is stored and read back and does nothing; what `shown` lacks works on unseen, with the
    defaults of the EDS.
    """

    def __init__(
        self,
        eds_path: Path,
        node_id: int,
        memory: np.recarray,
        shown: canopen.ObjectDictionary | None = None,
        counts_per_turn: float = EDS_COUNTS_PER_TURN,
    ) -> None:
        """`counts_per_turn` of the joint: speeds and ramps begin with those of the EDS, whatever the encoder."""
        self._memory = memory
        entries = load_entries(eds_path, node_id)
        for key in _IN_COUNTS.intersection(entries):
            scaled = round(int(entries[key].default) * counts_per_turn / EDS_COUNTS_PER_TURN)
            entries[key] = replace(entries[key], default=min(max(scaled, 1), LARGEST_UNSIGNED))
        self._take_entries(entries)
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
        if shown is not None:
            self._show(shown)
        self.restore_strings()

    def _take_entries(self, entries: dict[tuple[int, int], Entry]) -> None:
        self.entries = entries
        self._indices = {index for index, _ in entries}
        self._live: dict[tuple[int, int], np.ndarray] = {}
        self._initial: dict[tuple[int, int], np.ndarray] = {}
        self._strings: dict[tuple[int, int], bytes] = {}
        self._default_strings = {k: str(e.default).encode() for k, e in entries.items() if e.dtype is None}

    def _show(self, shown: canopen.ObjectDictionary) -> None:
        """Replace the entries by those of another drive; the core's objects keep their memory."""
        own, live, initial = self.entries, self._live, self._initial
        variables = [v for item in shown.values() for v in ([item] if isinstance(item, ODVariable) else item.values())]
        entries = {(v.index, v.subindex): _foreign_entry(v, own.get((v.index, v.subindex))) for v in variables}
        self._take_entries(entries)
        self._live, self._initial = live, initial
        for key, entry in entries.items():
            if entry.dtype is None:
                live.pop(key, None)
                initial.pop(key, None)
            elif key in live and live[key].dtype.itemsize == entry.size:
                live[key], initial[key] = live[key].view(entry.dtype), initial[key].view(entry.dtype)
                initial[key][0] = entry.default
            else:
                live.pop(key, None)
                initial.pop(key, None)
                self._default_strings[key] = np.array(entry.default, entry.dtype).tobytes()
        self._drop_odd_mappings()

    def _drop_odd_mappings(self) -> None:
        """A PDO of the file that the core cannot pack (too long, bits, too many objects) begins with nothing mapped."""
        for index in (base + pdo for base in (0x1600, 0x1A00) for pdo in range(PDOS)):
            count = self._initial.get((index, 0))
            if count is None:
                continue
            bits = [int(self._initial[index, sub][0]) & 0xFF for sub in range(1, min(int(count[0]), MAPPED) + 1)]
            if count[0] > MAPPED or sum(bits) > 64 or any(size % 8 for size in bits):
                count[0] = 0

    def limit_torque_by(self, index: int, sub: int, rated_counts: float) -> bool:
        """Make a number of the maker's own the core's limit; False if it is none, or one that the core has already.

        A default of 0 counts as left open: twice the rated value.
        """
        key, entry = (index, sub), self.entries.get((index, sub))
        if entry is None or entry.dtype is None or key in self._live or entry.size > MAKERS_LIMIT_BYTES:
            return False
        default = int(entry.default) or min(round(2.0 * rated_counts), int(np.iinfo(entry.dtype).max))
        for views, group in ((self._live, "drive"), (self._initial, "default_drive")):
            view = field_view(self._memory, (group,), "makers_limit")
            views[key] = view.view(np.uint8)[: entry.size].view(entry.dtype)
        self._default_strings.pop(key, None)
        self.set_default(*key, default)
        return True

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
        elif (index, sub) in self._initial:
            self._initial[index, sub][0] = value
        else:
            self._default_strings[index, sub] = np.array(value, self.entries[index, sub].dtype).tobytes()

    def set_ramp(self, index: int, radps2: float, counts_prad: float) -> None:
        """`set_default` of a ramp in counts per s2, rounded up, as far as a number there holds it."""
        if (index, 0) in self._initial:
            most = int(np.iinfo(self._initial[index, 0].dtype).max)
            self.set_default(index, 0, min(max(math.ceil(radps2 * counts_prad), 1), most))

    def default(self, index: int, sub: int) -> int | bytes:
        initial = self._initial.get((index, sub))
        return int(initial[0]) if initial is not None else self._default_strings[index, sub]

    def restore_strings(self) -> None:
        """Reset of the objects that the core does not know."""
        self._strings = dict(self._default_strings)

    def value(self, index: int, sub: int) -> int:
        """Present value of a number, whatever its access."""
        live = self._live.get((index, sub))
        if live is not None:
            return int(live[0])
        entry = self.entry(index, sub)
        stored = self._strings.get((index, sub))
        if stored is not None and entry.dtype is not None:
            return int(np.frombuffer(stored, entry.dtype)[0])
        return int(entry.default)

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
        elif (index, sub) in self._strings:
            self._strings[index, sub] = data


# --- What CiA 301 and CiA 402 demand of an SDO write beyond type and range: PDO set-up, COB-IDs, sets of values ---
# A PDO's mapping changes only while its COB-ID has bit 31 set and, for the entries, while sub 0 is 0; identifier and
# inhibit time of a valid PDO are fixed.  A COB-ID must be an 11-bit identifier outside the restricted ones.  Abort
# codes of a mapping are those of CiA 301, 7.5.2.36 and 7.5.2.38: an object that is not there, whole or its sub-index,
# is 0602 0000, one that cannot be mapped 0604 0041, more than there is room for 0604 0042.


NOT_MAPPABLE = 0x06040041
PARAMETER_CONFLICT = 0x06040043

_INVALID = 0x80000000
_EXTENDED = 0x20000000
_QUICK_STOP_OPTIONS = (0, 1, 2, 5, 6)
_MODES = (0, 1, 3, 4, 6, 8, 9, 10)
_HOMING_METHODS = (0, 33, 34, 35, 37)
_LINEAR_RAMP = (0,)  # of 6086 and 6088: the only profile there is
_VALUES = {
    0x605A: _QUICK_STOP_OPTIONS,
    0x6060: _MODES,
    0x6086: _LINEAR_RAMP,
    0x6088: _LINEAR_RAMP,
    0x6098: _HOMING_METHODS,
    0x1003: (0,),
}


def _restricted(identifier: int) -> bool:
    """Identifiers that CiA 301 keeps from being configured (NMT, SDO, heartbeat, ...)."""
    return (
        identifier <= 0x7F
        or 0x101 <= identifier <= 0x180
        or 0x581 <= identifier <= 0x5FF
        or 0x601 <= identifier <= 0x67F
        or identifier >= 0x6E0
    )


def _check_cob_id(old: int, new: int) -> None:
    """A COB-ID with a valid bit: changing the identifier needs bit 31 before or in the same write."""
    if new & _EXTENDED or new & 0x1FFFF800:
        raise SdoAbort(INVALID_VALUE)
    if not new & _INVALID:
        if _restricted(new & 0x7FF):
            raise SdoAbort(INVALID_VALUE)
        if not old & _INVALID and (old ^ new) & 0x7FF:
            raise SdoAbort(DEVICE_STATE)


def _check_entry(objects: ObjectDictionary, value: int, received: bool) -> int:
    """A mapping entry must name a mappable object with its own length; its length in bits."""
    entry = objects.entries.get((value >> 16, value >> 8 & 0xFF))
    if entry is None:
        raise SdoAbort(NO_OBJECT)
    if not entry.mappable or (received and not entry.writable) or value & 0xFF != 8 * entry.size:
        raise SdoAbort(NOT_MAPPABLE)
    return value & 0xFF


def _check_mapping(objects: ObjectDictionary, index: int, sub: int, value: int) -> None:
    received = index < 0x1800
    if not objects.value(index - 0x200, 1) & _INVALID:
        raise SdoAbort(UNSUPPORTED_ACCESS)
    if sub == 0:
        if value > MAPPED or (index, value) not in objects.entries:
            raise SdoAbort(PDO_LENGTH)
        bits = sum(_check_entry(objects, objects.value(index, i + 1), received) for i in range(value))
        if bits > 64:
            raise SdoAbort(PDO_LENGTH)
        return
    if objects.value(index, 0) != 0:
        raise SdoAbort(UNSUPPORTED_ACCESS)
    if value != 0:
        _check_entry(objects, value, received)


def _check_heartbeat(objects: ObjectDictionary, sub: int, value: int) -> None:
    """A producer may be watched once only; an entry without a time, or without a node that there can be, is unused."""
    others = [objects.value(0x1016, other) for other in (1, 2) if other != sub]
    used = value & 0xFFFF and 1 <= value >> 16 <= 127
    if used and any(other >> 16 == value >> 16 and other & 0xFFFF for other in others):
        raise SdoAbort(PARAMETER_CONFLICT)


def check_write(objects: ObjectDictionary, index: int, sub: int, value: int, power_state: int) -> None:
    """Raise SdoAbort when the (well-formed, in range) value must not be written now."""
    pdo_parameter = 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00
    if pdo_parameter and sub == 1:
        _check_cob_id(objects.value(index, 1), value)
    elif pdo_parameter and sub == 2:
        if LAST_SYNCHRONOUS < value < EVENT_DRIVEN:
            raise SdoAbort(INVALID_VALUE)
    elif pdo_parameter and sub in (3, 6):
        if not objects.value(index, 1) & _INVALID:
            raise SdoAbort(DEVICE_STATE)
    elif is_mapping(index):
        _check_mapping(objects, index, sub, value)
    elif index == 0x1014:
        _check_cob_id(objects.value(0x1014, 0), value)
    elif index == 0x1005 and _restricted(value):
        raise SdoAbort(INVALID_VALUE)
    elif index == 0x1016:
        _check_heartbeat(objects, sub, value)
    elif index == 0x1019:
        if value == 1:
            raise SdoAbort(INVALID_VALUE)
        if objects.value(0x1006, 0):
            raise SdoAbort(DEVICE_STATE)
    elif index in _VALUES:
        # a mode of another drive's EDS must also be in its 6502
        if value not in _VALUES[index] or (index == 0x6060 and value and not objects.value(0x6502, 0) >> value - 1 & 1):
            raise SdoAbort(INVALID_VALUE)
    elif index in (0x6075, 0x6076) and power_state >= PowerState.OPERATION_ENABLED:
        # rescaling a running torque would step it
        raise SdoAbort(DEVICE_STATE)


# --- Objects 1010 and 1011 of the virtual drive: what a reset brings back (CiA 301, 7.5.2.13 and 14) ---
# "save" written to 1010 makes the present values the ones that a reset restores; "load" written to 1011 makes it
# those of the EDS and the drive's settings again.  Sub 1 means all, 2 the communication objects (1000..1FFF), 3 the
# others. Commands and targets are never saved (6040, 6060, 6071, 607A, 60B1, 60B2, 60FF), nor the error history.  With
# a file the saved values outlive the process.


SAVE = 0x65766173
LOAD = 0x64616F6C
_NEVER_SAVED = (0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x6071, 0x607A, 0x60B1, 0x60B2, 0x60FF)


class ParameterStore:
    """Saves and restores the writable objects of one device; `path` is read once, at construction (ValueError)."""

    def __init__(self, objects: ObjectDictionary, path: Path | None) -> None:
        self._objects = objects
        self._path = path
        self._keys = [(e.index, e.sub) for e in objects if e.writable and e.index not in _NEVER_SAVED]
        self._factory = {key: objects.default(*key) for key in self._keys}
        self._saved: dict[tuple[int, int], int | bytes] = {}
        if path is not None and path.exists():
            self._load(path)

    def _load(self, path: Path) -> None:
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            self._saved = {}
            for text, value in stored.items():
                index, sub = (int(part, 16) for part in text.split(":"))
                data = value.encode("latin-1") if isinstance(value, str) else int(value)
                if (index, sub) not in self._factory or type(data) is not type(self._factory[index, sub]):
                    raise ValueError(f"{text} (={value}) is not a parameter of this drive")
                self._objects.set_default(index, sub, data)
                self._saved[index, sub] = data
        except (OSError, AttributeError, ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"parameter file {path.name}: {' '.join(str(error).split())}") from None

    def command(self, index: int, sub: int, signature: int, power_state: int) -> None:
        """Carry out a write of 1010 or 1011; SdoAbort when the signature is wrong or the motor has torque."""
        if signature != (SAVE if index == 0x1010 else LOAD):
            raise SdoAbort(CANNOT_STORE)
        if power_state in (
            PowerState.OPERATION_ENABLED,
            PowerState.QUICK_STOP_ACTIVE,
            PowerState.FAULT_REACTION_ACTIVE,
        ):
            raise SdoAbort(DEVICE_STATE)
        saved = dict(self._saved)
        for key in self._keys:
            if sub == 1 or (sub == 2) == (key[0] < 0x2000):
                saved.pop(key, None)
                if index == 0x1010:
                    is_text = isinstance(self._factory[key], bytes)
                    saved[key] = self._objects.read(*key) if is_text else self._objects.value(*key)
        self._write_file(saved)
        self._saved = saved
        for key, value in self._factory.items():
            self._objects.set_default(*key, saved.get(key, value))

    def _write_file(self, saved: dict[tuple[int, int], int | bytes]) -> None:
        if self._path is None:
            return
        texts = {
            f"{index:04X}:{sub:X}": value.decode("latin-1") if isinstance(value, bytes) else value
            for (index, sub), value in saved.items()
        }
        new = self._path.with_name(self._path.name + ".new")
        try:
            new.write_text(json.dumps(texts, indent=1) + "\n", encoding="utf-8")
            os.replace(new, self._path)
        except OSError:
            with contextlib.suppress(OSError):
                new.unlink()
            raise SdoAbort(HARDWARE) from None
