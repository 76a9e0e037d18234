"""EDS files as makers of drives write them: which objects there are, their types and habits; made here, nobody's file.

Which of the objects that jointctl uses a make has, and with which type and access, is from EDS files that makers gave
out (docs/drives/ names them); everything else of those files is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

U8, I8, U16, I16, U32, I32, TEXT, REAL32 = 5, 2, 6, 3, 7, 4, 9, 8
MAPPED_ENTRIES = 8


@dataclass(frozen=True)
class Listed:
    """One (index, sub) as a section of the file."""

    index: int
    sub: int
    data_type: int
    access: str = "rw"
    default: str = ""
    mappable: bool = False


def _pdo(index: int, access: str, cob_id: int, objects: int) -> list[Listed]:
    mapping = index + 0x200
    return [
        Listed(index, 0, U8, "ro", "2"),
        Listed(index, 1, U32, access, f"$NODEID+{cob_id:#x}"),
        Listed(index, 2, U8, "rw", "255"),
        Listed(mapping, 0, U8, "rw", "0"),
        *(Listed(mapping, sub, U32, "rw", "0") for sub in range(1, objects + 1)),
    ]


def _communication(consumers: int, cob_access: str = "rw") -> list[Listed]:
    heartbeats = [Listed(0x1016, 0, U8, "ro", str(consumers))] if consumers else []
    heartbeats += [Listed(0x1016, sub, U32, "rw", "0") for sub in range(1, consumers + 1)]
    return [
        Listed(0x1000, 0, U32, "ro", "0x00020192"),
        Listed(0x1001, 0, U8, "ro", "0"),
        Listed(0x1005, 0, U32, "rw", "0x80"),
        Listed(0x1008, 0, TEXT, "const", "drive"),
        Listed(0x1014, 0, U32, "rw", "$NODEID+0x80"),
        *heartbeats,
        Listed(0x1017, 0, U16, "rw", "0"),
        Listed(0x1018, 0, U8, "ro", "4"),
        *(Listed(0x1018, sub, U32, "ro", "0") for sub in range(1, 5)),
        *_pdo(0x1400, cob_access, 0x200, MAPPED_ENTRIES),
        *_pdo(0x1800, cob_access, 0x180, MAPPED_ENTRIES),
    ]


def _drive(modes: int, *more: Listed) -> list[Listed]:
    return [
        Listed(0x603F, 0, U16, "ro", "0"),
        Listed(0x6040, 0, U16, "rww", "0", True),
        Listed(0x6041, 0, U16, "ro", "0", True),
        Listed(0x605A, 0, I16, "rw", "2"),
        Listed(0x6060, 0, I8, "rww", "0", True),
        Listed(0x6061, 0, I8, "ro", "0", True),
        Listed(0x6064, 0, I32, "ro", "0", True),
        Listed(0x6071, 0, I16, "rww", "0", True),
        Listed(0x6077, 0, I16, "ro", "0", True),
        Listed(0x60FF, 0, I32, "rww", "0", True),
        Listed(0x6502, 0, U32, "ro", hex(modes)),
        *more,
    ]


@dataclass(frozen=True)
class Style:
    """A make's habits; `refusal` is what commissioning it ends with, "" where it succeeds."""

    name: str
    vendor_id: int
    modes: int
    objects: tuple[Listed, ...]
    reference: str = "rated_torque"
    refusal: str = ""
    line_end: str = "\n"


GOLD = Style(  # every default 0, heartbeat consumers limited to 16 bits in the file
    "Elmo Gold", 0x9A, 0x3ED,
    (*_communication(2), *_drive(
        0x3ED, Listed(0x6007, 0, I16), Listed(0x6072, 0, U16), Listed(0x6073, 0, U16), Listed(0x6075, 0, U32),
        Listed(0x6076, 0, U32, "rw", "0"), Listed(0x6087, 0, U32, "rww", "0"), Listed(0x60C2, 1, U8, "rw", "1"),
        Listed(0x60C2, 2, I8, "rw", "-3"), Listed(0x60E4, 1, I32, "ro"), Listed(0x2086, 0, U32, "ro", "0"),
    )),
    "rated_current", line_end="\r\n",
)  # fmt: skip
EPOS4 = Style(  # no 6072, 6075, 6087: the limit is an object of the maker's own
    "maxon EPOS4", 0xFB, 0x225,
    (*_communication(2), *_drive(
        0x225, Listed(0x6007, 0, I16, "rw", "3"), Listed(0x6076, 0, U32, "rw", "0"), Listed(0x60C2, 1, U8),
        Listed(0x60C2, 2, I8), Listed(0x60E4, 1, I32, "ro"), Listed(0x3001, 1, U32, "rw", "5000"),
        Listed(0x3001, 2, U32, "rw", "5000"),
    )),
    refusal="has no object 6072 (max torque)",
)  # fmt: skip
NANOTEC = Style(  # per mille of the rated current; one heartbeat consumer, 1029 for want of 6007; 608F signed
    "Nanotec CL4-E", 0x26C, 0x3EF,
    (*_communication(1), *_drive(
        0x3EF, Listed(0x6072, 0, U16, "rww", "100"), Listed(0x6075, 0, U32), Listed(0x6087, 0, U32, "rww", "0"),
        Listed(0x608F, 1, I32, "rww", "2000"), Listed(0x60C2, 1, U8, "rw", "1"), Listed(0x60C2, 2, I8, "rw", "-3"),
        Listed(0x1029, 1, U8, "rw", "0"), Listed(0x2031, 0, U32, "rw", "1000"), Listed(0x3212, 1, I8, "rw", "-5"),
        Listed(0x4014, 1, REAL32, "ro", "1.5"),
    )),
    "rated_current",
)  # fmt: skip
NANOTEC_OLD = Style(
    "Nanotec C5-E", 0x26C, 0x3EF,
    tuple(o for o in NANOTEC.objects if o.index != 0x1016),
    "rated_current", refusal="1016",
)  # fmt: skip
IPOS = Style(  # no torque mode in 6502, nothing that watches a heartbeat
    "Technosoft iPOS", 0x1A3, 0x1F0065,
    (*_communication(0), *_drive(0x1F0065, Listed(0x6007, 0, I16))),
    refusal="does not support cyclic_sync_torque or torque (6502 = 001F0065h)",
)  # fmt: skip
SIMPLIQ = Style(
    "Elmo SimplIQ", 0x9A, 0x6D,
    (*_communication(1, "ro"), *_drive(
        0x6D, Listed(0x6007, 0, I16), Listed(0x6072, 0, U16), Listed(0x6075, 0, U32), Listed(0x6076, 0, U32),
        Listed(0x6087, 0, U32, "rw", "0"),
    )),
    "rated_current", refusal="object is read only",
)  # fmt: skip
# of [drive] in a copy of virtual.toml; 5 A yield its rated torque, 3001:2 counts mA, 6076 counts µNm
EPOS4_KEYS: dict[str, object] = {
    "eds": "maker.eds", "rated_current_A": None, "max_torque_permille": None, "temperature_object": None,
    "temperature_unit_degC": None, "rated_torque_unit": "uNm",
    "torque_limit_object": "3001:2", "torque_limit_rated_counts": 5000.0,
}  # fmt: skip
STYLES = (GOLD, EPOS4, NANOTEC, NANOTEC_OLD, IPOS, SIMPLIQ)


def eds_text(style: Style) -> str:
    """The file: one section for each object, those of one index under a section of it."""
    lines = ["[FileInfo]", "FileName=maker.eds", "[DeviceInfo]", f"VendorName={style.name}"]
    lines += [f"VendorNumber={style.vendor_id:#010x}", "ProductNumber=0x00000010", "[DummyUsage]", "Dummy0005=1"]
    records = {listed.index for listed in style.objects if listed.sub}
    for index in sorted({listed.index for listed in style.objects}):
        if index in records:
            lines += [f"[{index:X}]", f"ParameterName={style.name} {index:X}", "ObjectType=0x9", "SubNumber=9"]
    for listed in style.objects:
        place = f"{listed.index:X}sub{listed.sub:X}" if listed.index in records else f"{listed.index:X}"
        lines += [f"[{place}]", f"ParameterName={style.name} {place} °", "ObjectType=0x7"]
        lines += [f"DataType={listed.data_type:#06x}", f"AccessType={listed.access}"]
        lines += [f"DefaultValue={listed.default}", f"PDOMapping={int(listed.mappable)}"]
        if (listed.index, listed.sub) == (0x1016, 1):
            lines += ["LowLimit=0", "HighLimit=65535"]
    return style.line_end.join(lines) + style.line_end
