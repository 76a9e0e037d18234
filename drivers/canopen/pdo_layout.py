"""Where the loop's objects lie in the drive's PDOs: ours as we map them, or those of a map that cannot be changed."""

from __future__ import annotations

from dataclasses import dataclass

from jointctl.drivers.canopen.identifiers import RPDO1_ID, TPDO1_ID
from jointctl.drivers.canopen.sdo import ObjectAccess, object_name
from jointctl.drivers.errors import DeviceError

DISABLED = 0x80000000
NO_REMOTE_REQUEST = 0x40000000
EXTENDED = 0x20000000
IDENTIFIER = 0x7FF
COMMUNICATION_TPDO = 0x1800
COMMUNICATION_RPDO = 0x1400
MAPPING_OFFSET = 0x200  # 1400 -> 1600, 1800 -> 1A00
LAST_PDO = 0x1FF
LONGEST_BYTES = 8
DUMMIES = 0x20  # data types mapped as place holders have indices below


@dataclass(frozen=True)
class MappedObject:
    """One entry of a PDO."""

    index: int
    sub: int
    bits: int
    name: str

    def entry(self) -> int:
        """The 32 bit mapping entry."""
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.name} ({object_name(self.index, self.sub)})"


STATUS = MappedObject(0x6041, 0, 16, "statusword")
POSITION = MappedObject(0x6064, 0, 32, "position actual value")
TORQUE = MappedObject(0x6077, 0, 16, "torque actual value")
CONTROL = MappedObject(0x6040, 0, 16, "controlword")
TARGET_TORQUE = MappedObject(0x6071, 0, 16, "target torque")
TARGET_VELOCITY = MappedObject(0x60FF, 0, 32, "target velocity")
_NAMES = {item.entry(): item.name for item in (STATUS, POSITION, TORQUE, CONTROL, TARGET_TORQUE, TARGET_VELOCITY)}

# Further objects that a fixed RPDO may carry: zero is what they must hold while a torque or a velocity is commanded
# (60FF and 60B2 would add to it, 607A is not looked at).  6060 gets the mode, 6072 the limit; nothing else is known
# to be harmless: a zero in 60FE, say, may open a brake.
ZERO_IS_RIGHT = frozenset({0x6071, 0x60FF, 0x607A, 0x60B0, 0x60B1, 0x60B2})
MODE, TORQUE_LIMIT = 0x6060, 0x6072


@dataclass(frozen=True)
class PdoLayout:
    """Identifiers, lengths and byte positions of the two PDOs of the loop; -1 = not mapped."""

    tpdo_id: int
    rpdo_id: int
    tpdo_length: int
    rpdo_length: int
    status_at: int
    position_at: int
    torque_at: int
    control_at: int
    target_at: int
    fill: bytes = bytes(LONGEST_BYTES)  # of the RPDO where the loop writes nothing


def own_layout(node: int, *, velocity: bool = False, torque: bool = True) -> PdoLayout:
    """Statusword, position, torque; controlword and target torque (or target velocity)."""
    return PdoLayout(
        tpdo_id=TPDO1_ID + node,
        rpdo_id=RPDO1_ID + node,
        tpdo_length=8 if torque else 6,
        rpdo_length=6 if velocity else 4,
        status_at=0,
        position_at=2,
        torque_at=6 if torque else -1,
        control_at=0,
        target_at=2,
    )


@dataclass(frozen=True)
class PdoMap:
    """One PDO as the drive has it."""

    base: int  # of its communication record
    cob_id: int
    transmission_type: int
    entries: tuple[MappedObject, ...]

    @property
    def identifier(self) -> int:
        return self.cob_id & IDENTIFIER

    @property
    def bytes(self) -> int:
        return (sum(item.bits for item in self.entries) + 7) // 8

    def at(self, wanted: MappedObject) -> int:
        """Byte position of an object; -1 if it is not mapped, has another length or begins inside a byte."""
        bit = 0
        for item in self.entries:
            if (item.index, item.sub, item.bits) == (wanted.index, wanted.sub, wanted.bits) and bit % 8 == 0:
                return bit // 8
            bit += item.bits
        return -1

    def holds(self, *wanted: MappedObject) -> bool:
        return self.bytes <= LONGEST_BYTES and all(self.at(item) >= 0 for item in wanted)


def read_map(objects: ObjectAccess, base: int) -> PdoMap:
    """What the drive tells about the PDO whose communication record is at `base`."""
    what = f"PDO {base:04X}"
    mapping = base + MAPPING_OFFSET
    count = objects.read_if_present(mapping, 0, what=f"{what} number of mapped objects") or 0
    entries = []
    for position in range(1, min(count, 64) + 1):
        raw = objects.read(mapping, position, what=f"{what} mapping entry {position}") & 0xFFFFFFFF
        name = _NAMES.get(raw, "dummy" if raw >> 16 < DUMMIES else "object")
        entries.append(MappedObject(raw >> 16, raw >> 8 & 0xFF, raw & 0xFF, name))
    return PdoMap(
        base,
        objects.read(base, 1, what=f"{what} COB-ID") & 0xFFFFFFFF,
        objects.read(base, 2, what=f"{what} transmission type") & 0xFF,
        tuple(entries),
    )


def fill_of(rpdo: PdoMap, target: MappedObject, mode: int, max_permille: int) -> bytes:
    """Bytes of the RPDO between those that the loop writes; `DeviceError` if an object in it is not understood."""
    filled, bit = 0, 0
    for item in rpdo.entries:
        key = item.index, item.sub
        if key == (MODE, 0):
            filled |= (mode & (1 << item.bits) - 1) << bit
        elif key == (TORQUE_LIMIT, 0):
            filled |= (max_permille & (1 << item.bits) - 1) << bit
        elif item.index >= DUMMIES and key not in ((CONTROL.index, 0), (target.index, 0)):
            if item.index not in ZERO_IS_RIGHT:
                raise DeviceError(
                    f"PDO {rpdo.base:04X} cannot be changed and also carries object {object_name(*key)}: "
                    "jointctl does not know what to send there",
                    hint="map it with the drive maker's software, or store a map without that object",
                )
        bit += item.bits
    return filled.to_bytes(LONGEST_BYTES, "little")
