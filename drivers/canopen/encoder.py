"""A second encoder of the joint: a node of its own (CiA 406), or another object of the drive.

It is identified, checked, and sends its position at every SYNC.  A node is a sensor: nothing in it can move the joint,
so it needs no watchdog of ours.  Its silence, its EMCY and its restart end the run (`cyclic.publish_sample`).
"""

from __future__ import annotations

from dataclasses import dataclass

import canopen

from jointctl.drivers.canopen.cia import TPDO1_ID, TPDO2_ID, NmtCommand
from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.network import send_nmt
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
from jointctl.drivers.canopen.settings import DRIVE_RANGE_COUNTS, CanopenSettings, JointEncoderSettings
from jointctl.drivers.errors import DeviceError

CIA406_PROFILE = 406
POSITION_VALUE = MappedObject(0x6004, 0, 32, "position value")
CYCLIC_TIMER = 0x6200
ALARMS = 0x6503


@dataclass(frozen=True)
class EncoderFindings:
    """What was read from the node, or from the drive."""

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


class EncoderEnd:
    """The joint's encoder node as the driver of the drive uses it; where there is none, every method does nothing.

    `ConfigurationError` if its EDS cannot be read.
    """

    def __init__(self, network: canopen.Network, settings: CanopenSettings, timeout_s: float) -> None:
        encoder = settings.joint_encoder
        self._network, self._settings = network, settings
        self._node = encoder.node if encoder is not None else None
        self._objects: ObjectAccess | None = None
        self._eds_remarks: list[str] = []
        if encoder is not None and encoder.node is not None and encoder.eds_path is not None:
            eds = read_eds(encoder.eds_path, encoder.node, encoder=True)
            node = network.add_node(encoder.node, eds.dictionary)
            node.sdo.RESPONSE_TIMEOUT = timeout_s
            self._eds_remarks = eds.all_remarks()
            self._objects = ObjectAccess(node, eds.name, eds.unusable)

    def send_command(self, command: NmtCommand) -> None:
        if self._node is not None:
            send_nmt(self._network, command, self._node)

    def commission(self) -> tuple[EncoderFindings, list[str]] | None:
        """Identify, check and map; findings and remarks."""
        encoder = self._settings.joint_encoder
        if self._objects is None or encoder is None:
            return None
        self.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        self._objects.forget_verified()
        self._objects.remarks.clear()
        found = commission_encoder(self._objects, encoder, self._settings.rate_Hz, self._settings.heartbeat_s)
        return found, self._eds_remarks + self._objects.remarks

    def verify_again(self) -> None:
        """See `ObjectAccess.verify_again`; `DeviceError` as well if the encoder has an alarm by now.

        Its EMCY may have come while no one listened.
        """
        if self._objects is not None and self._node is not None:
            self._objects.verify_again()
            require_no_alarm(self._objects, self._node)
