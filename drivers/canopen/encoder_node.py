"""A joint-side encoder as a node of its own (CiA 406): identified, checked, and sending its position at every SYNC.

It is a sensor: nothing in it can move the joint, so it needs no watchdog of ours.  Its silence, its EMCY and its
restart end the run (`cyclic.publish_sample`).
"""

from __future__ import annotations

from dataclasses import dataclass

from jointctl.drivers.canopen.identifiers import TPDO1_ID, TPDO2_ID
from jointctl.drivers.canopen.pdo import (
    COMMUNICATION_TPDO,
    EVERY_SYNC,
    MappedObject,
    configure_pdo,
    disable_pdo,
    listen_to_our_sync,
    pdos_of,
)
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.canopen.settings import DRIVE_RANGE_COUNTS, JointEncoderSettings
from jointctl.drivers.errors import DeviceError

CIA406_PROFILE = 406
POSITION_VALUE = MappedObject(0x6004, 0, 32, "position value")
CYCLIC_TIMER = 0x6200
ALARMS = 0x6503


@dataclass(frozen=True)
class EncoderFindings:
    """What the node told."""

    range_counts: int
    start_counts: int
    words: str


def commission_encoder(
    objects: ObjectAccess, settings: JointEncoderSettings, rate_Hz: float, heartbeat_s: float
) -> EncoderFindings:
    """All steps on a node in pre-operational; `DeviceError` if it is no encoder or not the one that is configured."""
    node = settings.node
    assert node is not None
    profile = objects.read(0x1000, what="device type") & 0xFFFF
    if profile != CIA406_PROFILE:
        raise DeviceError(f"node {node} has device profile {profile}, an encoder has {CIA406_PROFILE} (CiA 406)")
    per_turn = objects.read(0x6001, what="measuring units per revolution")
    if per_turn != settings.counts_per_turn:
        raise DeviceError(
            f"joint_encoder.counts_per_turn (={settings.counts_per_turn}) differs from the encoder's 6001, {per_turn}"
        )
    range_counts = objects.read(0x6002, what="total measuring range") or 1 << 32
    if range_counts < per_turn:
        raise DeviceError(f"node {node}: 6002 (total measuring range, {range_counts}) is below one turn ({per_turn})")
    require_no_alarm(objects, node)
    listen_to_our_sync(objects, rate_Hz)
    if not objects.write_if_present(0x1017, 0, round(heartbeat_s * 1000.0), what="producer heartbeat time"):
        objects.remarks.append(f"node {node}: no object 1017: a restart is seen by its boot-up message")
    if objects.read_if_present(CYCLIC_TIMER, what="cyclic timer"):
        objects.write_verified(CYCLIC_TIMER, 0, 0, what="cyclic timer")
    configure_pdo(objects, COMMUNICATION_TPDO, TPDO1_ID + node, EVERY_SYNC, (POSITION_VALUE,))
    for base in pdos_of(objects, COMMUNICATION_TPDO):
        if base != COMMUNICATION_TPDO:
            disable_pdo(objects, base)
    start = objects.read(POSITION_VALUE.index, what="position value")
    name = objects.text(0x1008)
    return EncoderFindings(range_counts, start, f"node {node} {name}, {per_turn} counts a turn of {range_counts}")


def require_no_alarm(objects: ObjectAccess, node: int) -> None:
    """`DeviceError` if the encoder says that its position is not valid (6503, CiA 406)."""
    alarms = objects.read_if_present(ALARMS, what="alarms")
    if alarms:
        raise DeviceError(f"node {node}: the encoder reports alarms (6503 = {alarms:04X}h): its position is not valid")


def commission_drive_object(objects: ObjectAccess, settings: JointEncoderSettings, node: int) -> EncoderFindings:
    """The drive's second encoder in its TPDO2, at every SYNC."""
    mapped = MappedObject(settings.index, settings.sub, 32, "additional position actual value")
    base = COMMUNICATION_TPDO + 1
    objects.require(mapped.index, mapped.sub, what=mapped.name)
    objects.require(base, 1, what="PDO communication parameter")
    configure_pdo(objects, base, TPDO2_ID + node, EVERY_SYNC, (mapped,))
    start = objects.read(mapped.index, mapped.sub, what=mapped.name)
    return EncoderFindings(DRIVE_RANGE_COUNTS, start, f"object {settings.index:04X}:{settings.sub} of the drive")
