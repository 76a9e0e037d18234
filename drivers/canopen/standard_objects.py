"""Data types of the objects that jointctl uses, by CiA 301, 402 and 406: what an EDS file is measured by."""

from __future__ import annotations

from canopen.objectdictionary import datatypes as types

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
