"""Names and types of the objects that CiA 301 and CiA 402 standardise, for nodes whose EDS is not at hand.

Index[:sub], type as in the EDS (u8 = UNSIGNED8, s = VISIBLE_STRING), name.  `*` stands for every sub-index from 1.
"""

from __future__ import annotations

import canopen
from canopen.objectdictionary import ODVariable, datatypes

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
