"""Setting up the two PDOs of the loop, in the order that CiA 301 asks for, and reading them back.

Pre-operational, COB-ID with bit 31 set, transmission type, sub 0 = 0, entries, sub 0 = n, COB-ID enabled.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.canopen.object_access import ObjectAccess

DISABLED = 0x80000000
COMMUNICATION_TPDO = 0x1800
COMMUNICATION_RPDO = 0x1400
MAPPING_OFFSET = 0x200  # 1400 -> 1600, 1800 -> 1A00
PDOS = 4


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


STATUS = MappedObject(0x6041, 0, 16, "statusword")
POSITION = MappedObject(0x6064, 0, 32, "position actual value")
TORQUE = MappedObject(0x6077, 0, 16, "torque actual value")
CONTROL = MappedObject(0x6040, 0, 16, "controlword")
TARGET_TORQUE = MappedObject(0x6071, 0, 16, "target torque")
TARGET_VELOCITY = MappedObject(0x60FF, 0, 32, "target velocity")


def configure_pdo(
    objects: ObjectAccess, base: int, cob_id: int, transmission_type: int, mapped: tuple[MappedObject, ...]
) -> None:
    """Map `mapped` into the PDO whose communication record is at `base`; the node is pre-operational."""
    for item in mapped:
        objects.require(item.index, item.sub, what=item.name)
    mapping = base + MAPPING_OFFSET
    what = f"PDO {base:04X}"
    objects.write(base, 1, cob_id | DISABLED, what=f"{what} COB-ID")
    objects.write_verified(base, 2, transmission_type, what=f"{what} transmission type")
    objects.write(mapping, 0, 0, what=f"{what} number of mapped objects")
    for position, item in enumerate(mapped, start=1):
        objects.write_verified(mapping, position, item.entry(), what=f"{what} mapping of {item.name}")
    objects.write_verified(mapping, 0, len(mapped), what=f"{what} number of mapped objects")
    objects.write_verified(base, 1, cob_id, what=f"{what} COB-ID")


def disable_pdo(objects: ObjectAccess, base: int) -> None:
    """Set bit 31 of a PDO that is not used; its other bits stay."""
    if not objects.has(base, 1):
        return
    cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID")
    if not cob_id & DISABLED:
        objects.write(base, 1, cob_id | DISABLED, what=f"PDO {base:04X} COB-ID")


def configure_loop_pdos(
    objects: ObjectAccess, node: int, rpdo_transmission_type: int, target: MappedObject = TARGET_TORQUE
) -> None:
    """TPDO1 = statusword, position, torque at every SYNC; RPDO1 = controlword, `target`; the others off."""
    for number in range(1, PDOS):
        disable_pdo(objects, COMMUNICATION_TPDO + number)
        disable_pdo(objects, COMMUNICATION_RPDO + number)
    configure_pdo(objects, COMMUNICATION_TPDO, 0x180 + node, 1, (STATUS, POSITION, TORQUE))
    configure_pdo(objects, COMMUNICATION_RPDO, 0x200 + node, rpdo_transmission_type, (CONTROL, target))
