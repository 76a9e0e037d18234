"""The objects of a node: names and types from its EDS or the standards' own table, and their values in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from jointctl.drivers.canopen.cia import LAST_SYNCHRONOUS, SUPPORTED_MODE_BIT, Mode, NmtCommand, NmtState, state_text
from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.sdo import object_name, visible_string
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import require_input
from jointctl.tools.session.fault_words import emergency_text

# --- codes and bits of CiA 301 and CiA 402 in words ---

# CiA 402-2, 6041: bits that say more than the state
_STATUS_BITS = {
    4: "voltage enabled", 7: "warning", 9: "remote", 10: "target reached", 11: "internal limit active",
    12: "mode bit 12", 13: "mode bit 13",
}  # fmt: skip
# CiA 301, 7.5.2.2
_ERROR_BITS = (
    "generic", "current", "voltage", "temperature", "communication", "device profile", "reserved", "manufacturer",
)  # fmt: skip
NMT_STATES: Mapping[int, str] = {
    NmtState.BOOT_UP: "boot-up", NmtState.STOPPED: "stopped", NmtState.OPERATIONAL: "operational",
    NmtState.PRE_OPERATIONAL: "pre-operational",
}  # fmt: skip
NMT_COMMANDS: Mapping[int, str] = {
    NmtCommand.START: "start (operational)", NmtCommand.STOP: "stop",
    NmtCommand.ENTER_PRE_OPERATIONAL: "enter pre-operational", NmtCommand.RESET_NODE: "reset node",
    NmtCommand.RESET_COMMUNICATION: "reset communication",
}  # fmt: skip
MODES = {
    -1: "manufacturer specific", 0: "no mode", 1: "profile position (PP)", 2: "velocity (VL)",
    3: "profile velocity (PV)", 4: "torque (TQ)", 6: "homing (HM)", 7: "interpolated position (IP)",
    8: "cyclic synchronous position (CSP)", 9: "cyclic synchronous velocity (CSV)",
    10: "cyclic synchronous torque (CST)", 11: "cyclic synchronous torque with angle (CSTCA)",
}  # fmt: skip
QUICK_STOP_OPTIONS = {
    0: "disable at once", 1: "slow down on the ramp", 2: "quick stop ramp, then disable", 3: "current limit",
    4: "voltage limit", 5: "slow down, stay in quick stop", 6: "quick stop ramp, stay in quick stop",
    7: "current limit, stay in quick stop", 8: "voltage limit, stay in quick stop",
}  # fmt: skip
ABORT_OPTIONS = {0: "no action", 1: "fault", 2: "disable voltage", 3: "quick stop"}
DEVICE_PROFILES = {
    0: "no standard profile", 401: "I/O modules", 402: "drives", 404: "measuring devices", 406: "encoders",
    408: "fluid power", 410: "inclinometers", 418: "batteries", 419: "battery chargers",
}  # fmt: skip


def status_bits(status_word: int) -> list[str]:
    """The bits of a statusword that are set beside the state."""
    return [name for bit, name in _STATUS_BITS.items() if status_word >> bit & 1]


def status_text(status_word: int) -> str:
    """`0237h operation enabled`."""
    return f"{status_word & 0xFFFF:04X}h {state_text(status_word)}"


def control_text(word: int) -> str:
    """The command of a controlword (CiA 402-2, table of commands), with halt where it is set."""
    if word & 0x80:
        command = "fault reset"
    elif not word & 0x02:
        command = "disable voltage"
    elif not word & 0x04:
        command = "quick stop"
    elif not word & 0x01:
        command = "shutdown"
    else:
        command = "enable operation" if word & 0x08 else "switch on"
    return f"{word & 0xFFFF:04X}h {command}" + (", halt" if word & 0x100 else "")


def mode_text(mode: int) -> str:
    """`10 cyclic synchronous torque (CST)`."""
    return f"{mode} {MODES.get(mode, 'manufacturer specific' if mode < 0 else 'reserved')}"


def supported_modes(bits: int) -> list[str]:
    """Names of the modes in 6502."""
    known = {bit: MODES[int(mode)] for mode, bit in SUPPORTED_MODE_BIT.items()}
    known |= {1: MODES[2], 6: MODES[7], 10: MODES[11]}
    names = [name for bit, name in sorted(known.items()) if bits >> bit & 1]
    return names + (["manufacturer's own"] if bits >> 16 else [])


def error_register_text(value: int) -> str:
    """`81h generic, manufacturer`; `00h none`."""
    names = [name for bit, name in enumerate(_ERROR_BITS) if value >> bit & 1]
    return f"{value & 0xFF:02X}h {', '.join(names) or 'none'}"


def polarity_text(value: int) -> str:
    """Of 607E: `C0h inverts positions, velocities`; `00h inverts nothing`."""
    names = [name for bit, name in ((7, "positions"), (6, "velocities")) if value >> bit & 1]
    return f"{value & 0xFF:02X}h inverts {', '.join(names) or 'nothing'}"


def no_error_or(code: int, text: Callable[[int], str]) -> str:
    """`0000h, no error`, or what `text` says."""
    return text(code) if code else "0000h, no error"


def nmt_state(byte: int | None) -> str:
    """Of a heartbeat byte; the toggle bit of node guarding is not looked at."""
    if byte is None:
        return "no heartbeat heard"
    return NMT_STATES.get(byte & 0x7F, f"unknown state {byte & 0x7F}")


def transmission_text(kind: int) -> str:
    """Of a PDO (CiA 301, 7.5.2.35)."""
    if kind == 0:
        return "synchronous, on an event"
    if kind <= LAST_SYNCHRONOUS:
        return "every SYNC" if kind == 1 else f"every {kind} SYNC"
    return {252: "on request, sampled at SYNC", 253: "on request", 254: "event (manufacturer)", 255: "event"}.get(
        kind, f"reserved ({kind})"
    )


def device_type_text(device_type: int) -> str:
    """Profile of 1000h in words."""
    profile = device_type & 0xFFFF
    return f"{device_type:08X}h, CiA {profile} ({DEVICE_PROFILES.get(profile, 'another profile')})"


assert {int(mode) for mode in Mode} <= set(MODES)


# --- objects that CiA 301 and CiA 402 standardise, for nodes whose EDS is not at hand ---

# Index[:sub], type as in the EDS (u8 = UNSIGNED8, s = VISIBLE_STRING), name.  `*` stands for every sub-index from 1.
_TYPES = {
    "u8": datatypes.UNSIGNED8, "u16": datatypes.UNSIGNED16, "u32": datatypes.UNSIGNED32,
    "i8": datatypes.INTEGER8, "i16": datatypes.INTEGER16, "i32": datatypes.INTEGER32, "s": datatypes.VISIBLE_STRING,
}  # fmt: skip
_TABLE = """
1000 u32 Device type|1001 u8 Error register|1002 u32 Manufacturer status register|1003:0 u8 Number of errors
1003:* u32 Pre-defined error field|1005 u32 COB-ID SYNC|1006 u32 Communication cycle period
1007 u32 Synchronous window length|1008 s Manufacturer device name|1009 s Manufacturer hardware version
100A s Manufacturer software version|100C u16 Guard time|100D u8 Life time factor|1010:0 u8 Highest sub-index
1010:* u32 Store parameters|1011:0 u8 Highest sub-index|1011:* u32 Restore default parameters|1012 u32 COB-ID TIME
1014 u32 COB-ID EMCY|1015 u16 Inhibit time EMCY|1016:0 u8 Highest sub-index|1016:* u32 Consumer heartbeat time
1017 u16 Producer heartbeat time|1018:0 u8 Highest sub-index|1018:1 u32 Vendor-ID|1018:2 u32 Product code
1018:3 u32 Revision number|1018:4 u32 Serial number|1019 u8 Synchronous counter overflow value
1029:0 u8 Highest sub-index|1029:* u8 Error behaviour
6007 i16 Abort connection option code|603F u16 Error code|6040 u16 Controlword|6041 u16 Statusword
605A i16 Quick stop option code|605B i16 Shutdown option code|605C i16 Disable operation option code
605D i16 Halt option code|605E i16 Fault reaction option code|6060 i8 Modes of operation
6061 i8 Modes of operation display|6062 i32 Position demand value|6063 i32 Position actual internal value
6064 i32 Position actual value|6065 u32 Following error window|6066 u16 Following error time out
6067 u32 Position window|6068 u16 Position window time|606B i32 Velocity demand value|606C i32 Velocity actual value
606D u16 Velocity window|606E u16 Velocity window time|606F u16 Velocity threshold|6070 u16 Velocity threshold time
6071 i16 Target torque|6072 u16 Max torque|6073 u16 Max current|6074 i16 Torque demand|6075 u32 Motor rated current
6076 u32 Motor rated torque|6077 i16 Torque actual value|6078 i16 Current actual value
6079 u32 DC link circuit voltage|607A i32 Target position|607C i32 Home offset|607D:0 u8 Highest sub-index
607D:1 i32 Min position limit|607D:2 i32 Max position limit|607E u8 Polarity|607F u32 Max profile velocity
6080 u32 Max motor speed|6081 u32 Profile velocity|6082 u32 End velocity|6083 u32 Profile acceleration
6084 u32 Profile deceleration|6085 u32 Quick stop deceleration|6086 i16 Motion profile type|6087 u32 Torque slope
608F:0 u8 Highest sub-index|608F:1 u32 Encoder increments|608F:2 u32 Motor revolutions
6091:0 u8 Highest sub-index|6091:1 u32 Motor shaft revolutions|6091:2 u32 Driving shaft revolutions
6092:0 u8 Highest sub-index|6092:1 u32 Feed|6092:2 u32 Shaft revolutions|6098 i8 Homing method
6099:0 u8 Highest sub-index|6099:1 u32 Speed during search for switch|6099:2 u32 Speed during search for zero
609A u32 Homing acceleration|60B0 i32 Position offset|60B1 i32 Velocity offset|60B2 i16 Torque offset
60C2:0 u8 Highest sub-index|60C2:1 u8 Interpolation time period value|60C2:2 i8 Interpolation time index
60C5 u32 Max acceleration|60C6 u32 Max deceleration|60E4:0 u8 Highest sub-index
60E4:* i32 Additional position actual value|60F4 i32 Following error actual value
60FD u32 Digital inputs|60FE:0 u8 Highest sub-index|60FE:1 u32 Digital outputs|60FF i32 Target velocity
6402 u16 Motor type|6502 u32 Supported drive modes
"""


def _parsed() -> dict[tuple[int, int | None], tuple[int, str]]:
    found: dict[tuple[int, int | None], tuple[int, str]] = {}
    for item in _TABLE.strip().replace("\n", "|").split("|"):
        place, kind, name = item.split(" ", 2)
        index, _, sub = place.partition(":")
        found[int(index, 16), None if sub == "*" else int(sub or "0", 16)] = _TYPES[kind], name
    return found


_OBJECTS = _parsed()
_PDO = {0x1400: "RPDO", 0x1600: "RPDO", 0x1800: "TPDO", 0x1A00: "TPDO"}
_PDO_SPAN = 0x200
_COMMUNICATION_SUBS = {
    1: (datatypes.UNSIGNED32, "COB-ID"),
    2: (datatypes.UNSIGNED8, "transmission type"),
    3: (datatypes.UNSIGNED16, "inhibit time"),
    5: (datatypes.UNSIGNED16, "event timer"),
    6: (datatypes.UNSIGNED8, "SYNC start value"),
}


def _pdo_object(index: int, sub: int) -> tuple[int, str] | None:
    base = next((start for start in reversed(_PDO) if start <= index < start + _PDO_SPAN), None)
    if base is None:
        return None
    name = f"{_PDO[base]}{index - base + 1}"
    mapping = base in (0x1600, 0x1A00)
    if sub == 0:
        return datatypes.UNSIGNED8, f"{name} {'number of mapped objects' if mapping else 'highest sub-index'}"
    if mapping:
        return datatypes.UNSIGNED32, f"{name} mapping entry {sub}"
    kind, what = _COMMUNICATION_SUBS.get(sub, (datatypes.UNSIGNED32, f"parameter {sub}"))
    return kind, f"{name} {what}"


def standard_variable(index: int, sub: int) -> ODVariable | None:
    """The standard's object as the `canopen` library describes variables; None for what is not in the table."""
    found = _OBJECTS.get((index, sub)) or (_OBJECTS.get((index, None)) if sub else None) or _pdo_object(index, sub)
    if found is None:
        return None
    variable = canopen.objectdictionary.ODVariable(found[1], index, sub)
    variable.data_type = found[0]
    return variable


# --- objects of a node ---

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
            return visible_string(data)
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

    def value_text(self, index: int, sub: int, value: bytes | str | float, bits: int) -> str:
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
        return status_text(value)
    if index == 0x6040:
        return control_text(value)
    if index in (0x6060, 0x6061):
        return mode_text(value)
    if index == 0x603F or (index == 0x1003 and sub > 0):
        return no_error_or(value & 0xFFFF, emergency_text)
    if index == 0x1001:
        return error_register_text(value)
    if index == 0x6502:
        return f"{value:08X}h, " + ", ".join(supported_modes(value))
    if index in (0x1017, 0x100C):
        return f"{value} ms"
    if index == 0x1016 and sub > 0:
        return f"node {value >> 16 & 0x7F}, {value & 0xFFFF} ms"
    return None
