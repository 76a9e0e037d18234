"""The loop's PDOs: what lies where in them, how they are set up, and what their numbers mean at the joint.

They are set up in the order that CiA 301 asks for, and read back: pre-operational, COB-ID with bit 31 set, transmission
type, sub 0 = 0, entries, sub 0 = n, COB-ID enabled.  A drive that does not let its map be changed is taken as it is if
one of its PDOs holds what the loop needs.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from typing import Any

from jointctl.drivers.canopen.cia import (
    EMERGENCY_ID,
    HEARTBEAT_ID,
    LAST_SYNCHRONOUS,
    RPDO1_ID,
    RPDO2_ID,
    SYNC_ID,
    TPDO1_ID,
    TPDO2_ID,
    State,
)
from jointctl.drivers.canopen.cyclic import AlignTo, CanopenPort, SecondPosition, centred
from jointctl.drivers.canopen.sdo import ObjectAccess, object_name, was_refused
from jointctl.drivers.canopen.settings import DRIVE_RANGE_COUNTS, CanopenSettings, JointEncoderSettings
from jointctl.drivers.errors import DeviceError
from jointctl.firmware_py.schema import new

DISABLED = 0x80000000
NO_REMOTE_REQUEST = 0x40000000
EXTENDED = 0x20000000
IDENTIFIER = 0x7FF
COMMUNICATION_TPDO = 0x1800
COMMUNICATION_RPDO = 0x1400
MAPPING_OFFSET = 0x200  # 1400 -> 1600, 1800 -> 1A00
LAST_PDO = 0x1FF
LONGEST_BYTES = 8
PRODUCES_SYNC = 0x40000000  # bit of 1005
EVERY_SYNC = 1
FIRST_IDENTIFIER, LAST_IDENTIFIER = 0x181, 0x57F
INHIBIT_TIME, EVENT_TIMER = 3, 5
FIXED_HINT = "change the map with the drive maker's software, or use a drive whose PDOs can be mapped"
DUMMIES = 0x20  # data types mapped as place holders have indices below


@dataclass(frozen=True)
class MappedObject:
    index: int
    sub: int
    bits: int
    name: str

    def entry(self) -> int:
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        return f"{self.name} ({object_name(self.index, self.sub)})"


STATUS = MappedObject(0x6041, 0, 16, "statusword")
POSITION = MappedObject(0x6064, 0, 32, "position actual value")
TORQUE = MappedObject(0x6077, 0, 16, "torque actual value")
CONTROL = MappedObject(0x6040, 0, 16, "controlword")
TARGET_TORQUE = MappedObject(0x6071, 0, 16, "target torque")
TARGET_VELOCITY = MappedObject(0x60FF, 0, 32, "target velocity")
TARGET_POSITION = MappedObject(0x607A, 0, 32, "target position")
TORQUE_OFFSET = MappedObject(0x60B2, 0, 16, "torque offset")
VELOCITY_OFFSET = MappedObject(0x60B1, 0, 32, "velocity offset")
_NAMES = {
    item.entry(): item.name
    for item in (
        STATUS, POSITION, TORQUE, CONTROL, TARGET_TORQUE, TARGET_VELOCITY, TARGET_POSITION, TORQUE_OFFSET,
        VELOCITY_OFFSET,
    )
}  # fmt: skip
OFFSET_RPDO = 0x1401  # the second one: 607A and 60B2 leave no room for 60B1 in the first

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
    torque_offset_at: int = -1
    offset_rpdo_id: int = 0  # of the RPDO with 60B1 alone; 0 = there is none
    fill: bytes = bytes(LONGEST_BYTES)  # of the RPDO where the loop writes nothing


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


def layout_of(tpdo: PdoMap, rpdo: PdoMap, target: MappedObject, fill: bytes = bytes(LONGEST_BYTES)) -> PdoLayout:
    """Of two PDOs that hold what the loop needs."""
    return PdoLayout(
        tpdo_id=tpdo.identifier, rpdo_id=rpdo.identifier, tpdo_length=tpdo.bytes, rpdo_length=rpdo.bytes,
        status_at=tpdo.at(STATUS), position_at=tpdo.at(POSITION), torque_at=tpdo.at(TORQUE),
        control_at=rpdo.at(CONTROL), target_at=rpdo.at(target), torque_offset_at=rpdo.at(TORQUE_OFFSET), fill=fill,
    )  # fmt: skip


def own_layout(node: int, *, velocity: bool = False) -> PdoLayout:
    """Statusword, position, torque; controlword and target torque (or target velocity)."""
    target = TARGET_VELOCITY if velocity else TARGET_TORQUE
    tpdo = PdoMap(COMMUNICATION_TPDO, TPDO1_ID + node, EVERY_SYNC, (STATUS, POSITION, TORQUE))
    return layout_of(tpdo, PdoMap(COMMUNICATION_RPDO, RPDO1_ID + node, EVERY_SYNC, (CONTROL, target)), target)


def read_map(objects: ObjectAccess, base: int) -> PdoMap:
    """What the drive has as the PDO whose communication record is at `base`."""
    what = f"PDO {base:04X}"
    mapping = base + MAPPING_OFFSET
    count = objects.read_if_present(mapping, 0, what=f"{what} number of mapped objects") or 0
    entries = []
    for position in range(1, min(count, 64) + 1):
        raw = objects.read(mapping, position, what=f"{what} mapping entry {position}") & 0xFFFFFFFF
        name = _NAMES.get(raw, "dummy" if raw >> 16 < DUMMIES else "object")
        entries.append(MappedObject(raw >> 16, raw >> 8 & 0xFF, raw & 0xFF, name))
    cob_id = objects.read(base, 1, what=f"{what} COB-ID") & 0xFFFFFFFF
    transmission_type = objects.read(base, 2, what=f"{what} transmission type") & 0xFF
    return PdoMap(base, cob_id, transmission_type, tuple(entries))


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


# --- set-up of SYNC and PDOs ---


def listen_to_our_sync(objects: ObjectAccess, rate_Hz: float) -> None:
    """1005 = 80h without production, 1006 our period if it is used at all, 1019 = 0: our SYNC carries no counter."""
    found = objects.read_if_present(0x1005, what="COB-ID SYNC")
    if found is not None and found & (PRODUCES_SYNC | 0x7FF) != SYNC_ID:
        objects.write_verified(0x1005, 0, SYNC_ID, what="COB-ID SYNC")
        objects.remarks.append(f"1005 was {found & 0xFFFFFFFF:08X}h, it is now {SYNC_ID:08X}h")
    period_us = round(1e6 / rate_Hz)
    if objects.read_if_present(0x1006, what="communication cycle period") not in (None, 0, period_us):
        objects.write_verified(0x1006, 0, period_us, what="communication cycle period")
    if objects.read_if_present(0x1019, what="synchronous counter overflow value"):
        objects.write_verified(0x1019, 0, 0, what="synchronous counter overflow value")


def configure_pdo(
    objects: ObjectAccess, base: int, cob_id: int, transmission_type: int, mapped: tuple[MappedObject, ...]
) -> None:
    """Map `mapped` into the PDO whose communication record is at `base`; the node is pre-operational.

    Bit 30 (no remote request) stays as the drive has it: some insist on it.
    """
    mapping = base + MAPPING_OFFSET
    what = f"PDO {base:04X}"
    found = objects.read(base, 1, what=f"{what} COB-ID") & 0xFFFFFFFF
    cob_id |= found & NO_REMOTE_REQUEST
    objects.write(base, 1, cob_id | DISABLED, what=f"{what} COB-ID")
    try:
        objects.write_verified(base, 2, transmission_type, what=f"{what} transmission type")
    except DeviceError as error:
        if base < COMMUNICATION_TPDO and transmission_type > LAST_SYNCHRONOUS:
            raise DeviceError(error.message, hint="set drive.rpdo_transmission_type = 1") from error.__cause__
        raise
    objects.write(mapping, 0, 0, what=f"{what} number of mapped objects")
    for position, item in enumerate(mapped, start=1):
        objects.write_verified(mapping, position, item.entry(), what=f"{what} mapping of {item.name}")
    objects.write_verified(mapping, 0, len(mapped), what=f"{what} number of mapped objects")
    if base >= COMMUNICATION_TPDO:
        quiet_timers(objects, base)
    objects.write_verified(base, 1, cob_id, what=f"{what} COB-ID")


def quiet_timers(objects: ObjectAccess, base: int) -> None:
    """No inhibit time and no event timer: a TPDO answers each SYNC, neither less often nor more."""
    for sub, what in ((INHIBIT_TIME, "inhibit time"), (EVENT_TIMER, "event timer")):
        if objects.read_if_present(base, sub, what=f"PDO {base:04X} {what}"):
            try:
                objects.write_verified(base, sub, 0, what=f"PDO {base:04X} {what}")
            except DeviceError as error:
                objects.remarks.append(f"{error.message}; a synchronous PDO should not heed it")


def disable_pdo(objects: ObjectAccess, base: int) -> None:
    """Set bit 31 of a PDO that is not used; its other bits stay.  One that stays enabled is a remark."""
    what = f"PDO {base:04X} COB-ID"
    cob_id = objects.read_if_present(base, 1, what=what)
    if cob_id is None or cob_id & DISABLED:
        return
    cob_id &= 0xFFFFFFFF
    try:
        objects.write_verified(base, 1, cob_id | DISABLED, what=what)
    except DeviceError as error:
        objects.remarks.append(f"{error.message}; it stays enabled on {cob_id & IDENTIFIER:03X}h")


def pdos_of(objects: ObjectAccess, first: int) -> list[int]:
    """Communication records from `first` (1400 or 1800) that the EDS lists."""
    return [base for base in objects.indices(first, first + LAST_PDO) if objects.has(base, 1)]


def configure_loop_pdos(
    objects: ObjectAccess,
    node: int,
    rpdo_transmission_type: int,
    target: MappedObject = TARGET_TORQUE,
    *,
    mode: int = 0,
    max_permille: int = 0,
    torque_offset: bool = False,
    spare: frozenset[int] = frozenset(),
) -> PdoLayout:
    """TPDO1 = statusword, position, torque at every SYNC; RPDO1 = controlword, `target`, torque offset; the others off.

    Where the drive refuses that, the first of its PDOs that holds what is needed is used as it is; `mode` and
    `max_permille` then fill 6060 and 6072 in it.  PDOs in `spare` stay as they are.
    Raises `DeviceError` with what is missing.
    """
    sent = (CONTROL, target, TORQUE_OFFSET) if torque_offset else (CONTROL, target)
    for item in (STATUS, POSITION, *sent):
        objects.require(item.index, item.sub, what=item.name)
    mapped = (STATUS, POSITION, TORQUE) if objects.has(TORQUE.index) else (STATUS, POSITION)
    tpdo = _map_or_find(objects, COMMUNICATION_TPDO, TPDO1_ID + node, EVERY_SYNC, mapped)
    rpdo = _map_or_find(objects, COMMUNICATION_RPDO, RPDO1_ID + node, rpdo_transmission_type, sent)
    for first, kept in ((COMMUNICATION_TPDO, tpdo), (COMMUNICATION_RPDO, rpdo)):
        for base in pdos_of(objects, first):
            if base != kept.base and base not in spare:
                disable_pdo(objects, base)
    layout = layout_of(tpdo, rpdo, target, fill_of(rpdo, target, mode, max_permille))
    return layout if torque_offset else replace(layout, torque_offset_at=-1)


def map_velocity_offset(objects: ObjectAccess, node: int, rpdo_transmission_type: int) -> int:
    """RPDO2 = velocity offset; its identifier."""
    objects.require(OFFSET_RPDO, 1, what="PDO communication parameter")
    configure_pdo(objects, OFFSET_RPDO, RPDO2_ID + node, rpdo_transmission_type, (VELOCITY_OFFSET,))
    return RPDO2_ID + node


def _map_or_find(
    objects: ObjectAccess, base: int, identifier: int, kind: int, mapped: tuple[MappedObject, ...]
) -> PdoMap:
    """The PDO at `base`, mapped as wanted, or the drive's own PDO that is used instead."""
    objects.require(base, 1, what="PDO communication parameter")
    before = read_map(objects, base)
    try:
        configure_pdo(objects, base, identifier, kind, mapped)
        return PdoMap(base, identifier, kind, mapped)
    except DeviceError as error:
        if not was_refused(error):
            raise
        refused = error
    _restore(objects, before)
    needed = tuple(item for item in mapped if item is not TORQUE)  # the measured torque is only logged
    found = next((m for m in (read_map(objects, b) for b in pdos_of(objects, base)) if m.holds(*needed)), None)
    if found is None:
        missing = ", ".join(str(item) for item in needed)
        raise DeviceError(
            f"{refused.message}; and none of the drive's own {'TPDOs' if base >= COMMUNICATION_TPDO else 'RPDOs'} "
            f"holds {missing} together",
            hint=refused.hint or FIXED_HINT,
        )
    found = _use_as_it_is(objects, before if found.base == base and before.holds(*needed) else found, kind)
    objects.remarks.append(f"{refused.message}: PDO {found.base:04X} is used as it is, on {found.identifier:03X}h")
    return found


def _restore(objects: ObjectAccess, before: PdoMap) -> None:
    """A drive may accept the first steps of a new map and refuse the others: undo what can be undone."""
    mapping = before.base + MAPPING_OFFSET
    for position, item in enumerate(before.entries, start=1):
        with contextlib.suppress(DeviceError):
            if objects.read(mapping, position, what="mapping entry") != item.entry():
                objects.write(mapping, position, item.entry(), what="mapping entry")
    with contextlib.suppress(DeviceError):
        objects.write(mapping, 0, len(before.entries), what="number of mapped objects")


def _use_as_it_is(objects: ObjectAccess, pdo: PdoMap, kind: int) -> PdoMap:
    """Enable a PDO with the drive's own map; its transmission type must suit the loop."""
    what = f"PDO {pdo.base:04X}"
    found_kind = pdo.transmission_type
    with contextlib.suppress(DeviceError):
        found_kind = objects.write_verified(pdo.base, 2, kind, what=f"{what} transmission type")
    if pdo.base >= COMMUNICATION_TPDO:
        if found_kind != EVERY_SYNC:
            raise DeviceError(
                f"{what} cannot be changed and has transmission type {found_kind}: it does not answer every SYNC",
                hint=FIXED_HINT,
            )
        quiet_timers(objects, pdo.base)
    elif found_kind != kind and not (found_kind <= LAST_SYNCHRONOUS and kind <= LAST_SYNCHRONOUS):
        raise DeviceError(
            f"{what} cannot be changed and has transmission type {found_kind}, the configuration says {kind}",
            hint=f"set drive.rpdo_transmission_type = {found_kind}, so that the delay of the loop is known",
        )
    if pdo.cob_id & EXTENDED or not FIRST_IDENTIFIER <= pdo.identifier <= LAST_IDENTIFIER:
        raise DeviceError(
            f"the map of {what} cannot be changed, and its COB-ID {pdo.cob_id:08X}h is no PDO's",
            hint=f"write an identifier that nothing else uses, {FIRST_IDENTIFIER:X}h to {LAST_IDENTIFIER:X}h, to "
            f"{pdo.base:04X}:1 with the drive maker's software; or {FIXED_HINT}",
        )
    objects.write_verified(pdo.base, 1, pdo.cob_id & ~DISABLED, what=f"{what} COB-ID")
    return pdo


# --- scaling: counts and per mille to radians and newton metres of the joint, and back ---


PERMILLE = 1000.0
RATED_TORQUE_UNITS_mNm = {"mNm": 1.0, "uNm": 1e-3}  # of 6076
# units of 60FF besides the encoder's counts per second: motor speed [rad/s] of one unit
VELOCITY_UNITS = {"counts/s": None, "r/min": math.tau / 60.0, "0.1 r/min": math.tau / 600.0}


def joint_torque_per_permille_Nm(settings: CanopenSettings, rated_torque_mNm: float, rated_current_mA: int) -> float:
    """Joint torque [Nm] of 1/1000 of rated in objects 6071 and 6077, without the direction."""
    if settings.torque_reference == "rated_torque":
        motor_Nm = rated_torque_mNm * 1e-3
    else:
        motor_Nm = rated_current_mA * 1e-3 * settings.torque_constant_NmpA
    return motor_Nm * settings.reduction_ratio / PERMILLE


def joint_angle_per_count_rad(settings: CanopenSettings) -> float:
    """Joint angle [rad] of one count of 6064, without the direction."""
    ratio = settings.reduction_ratio if settings.encoder_on_motor else 1.0
    return 2.0 * math.pi / (settings.counts_per_turn * ratio)


def joint_velocity_per_unit_radps(settings: CanopenSettings) -> float:
    """Joint velocity [rad/s] of one unit of 60FF, 606C and 607F, without the direction."""
    motor_radps = VELOCITY_UNITS[settings.velocity_unit]
    if motor_radps is None:
        return joint_angle_per_count_rad(settings)
    return motor_radps / settings.reduction_ratio


# --- whether the whole numbers of the drive suit the joint: each (what is wrong, remedy), or None ---


LARGEST_SIGNED = 0x7FFFFFFF  # of 607A, 60FF and 60B1
LEAST_UNITS = 10.0  # of 60FF in the velocity limit: 607F, rounded up, is a tenth more at most
MOST_WIDER = 1.1  # over limits.torque_max_Nm, of a limit of the drive that holds alone
FINE_UNITS = 100.0  # in a limit; with fewer, that numbers are coarse is reported
Misfit = tuple[str, str] | None


def sends_velocity(settings: CanopenSettings) -> bool:
    """Whether 60FF or 60B1 is part of a cycle."""
    return settings.mode in ("csv", "pv", "velocity or torque") or (settings.mode == "csp" and settings.velocity_offset)


def velocity_misfit(settings: CanopenSettings) -> Misfit:
    """Of the velocity limit and the unit of 60FF, 60B1 and 607F."""
    speed, unit_radps = settings.velocity_max_radps, joint_velocity_per_unit_radps(settings)
    if speed is None or not sends_velocity(settings) or LEAST_UNITS * unit_radps <= speed < LARGEST_SIGNED * unit_radps:
        return None
    remedy = "a unit of the drive that suits the joint (drive.velocity_unit), or a mode that sends no velocity"
    start = f"limits.velocity_max_radps (={speed:g}) must be"
    if speed < LEAST_UNITS * unit_radps:
        return (
            f"{start} at least {LEAST_UNITS * unit_radps:.3g}, ten units of 60FF (drive.velocity_unit = "
            f"{settings.velocity_unit}, at the joint {unit_radps:.3g} rad/s): the speed would be rounded away",
            remedy,
        )
    return (
        f"{start} less than {LARGEST_SIGNED * unit_radps:.3g}, what the 32 bit of 60FF and 60B1 hold in "
        f"{settings.velocity_unit}",
        remedy,
    )


def position_misfit(settings: CanopenSettings) -> Misfit:
    """Of the position limits and the 32 bit of 607A in CSP: beyond them the target would jump by their whole range."""
    if settings.mode != "csp":
        return None
    ends_rad, count_rad = (settings.position_min_rad, settings.position_max_rad), joint_angle_per_count_rad(settings)
    ends = [settings.zero_counts + settings.encoder_direction * rad / count_rad for rad in ends_rad]
    if max(map(abs, ends)) < LARGEST_SIGNED:
        return None
    return (
        f"limits.position_min_rad (={ends_rad[0]:g}) and position_max_rad (={ends_rad[1]:g}) are {min(ends):.4g} to "
        f"{max(ends):.4g} counts of 607A, which holds 32 bit with a sign",
        "narrower limits, another encoder.zero_counts, positions scaled in the drive (6091, 6092), or "
        'drive.mode = "csv"',
    )


def torque_misfit(settings: CanopenSettings, permille: int, permille_Nm: float) -> Misfit:
    """Of 6072 and the torque limit, where the drive closes its own loop and 6072 alone limits its torque."""
    limit_Nm, widest_Nm = settings.torque_max_Nm, permille * permille_Nm
    if not settings.holds_alone or settings.torque_limit is not None or widest_Nm <= MOST_WIDER * limit_Nm:
        return None
    start = f"limits.torque_max_Nm (={limit_Nm:g}): in mode {settings.mode} the drive alone limits its torque, to"
    if settings.max_torque_permille is not None:
        return (
            f"{start} {widest_Nm:.3g} Nm by drive.max_torque_permille (={permille})",
            "leave drive.max_torque_permille out: it follows from limits.torque_max_Nm",
        )
    return (
        f"{start} {widest_Nm:.3g} Nm, since 6072 counts in {permille_Nm:.3g} Nm",
        "a drive, or a rated torque in it (6076), that suits the joint; or its maker's own limit: "
        "drive.torque_limit_object",
    )


def coarse_numbers(settings: CanopenSettings, permille_Nm: float) -> list[str]:
    """One line for each of the drive's numbers that is coarse for the joint's limits."""
    found, unit_radps, speed = [], joint_velocity_per_unit_radps(settings), settings.velocity_max_radps
    if FINE_UNITS * permille_Nm > settings.torque_max_Nm * (1.0 + 1e-9):
        found.append(
            f"the drive counts torque in {permille_Nm:.3g} Nm (thousandths of its rated torque), "
            f"{permille_Nm / settings.torque_max_Nm:.0%} of limits.torque_max_Nm (={settings.torque_max_Nm:g})"
        )
    if speed is not None and sends_velocity(settings) and FINE_UNITS * unit_radps > speed * (1.0 + 1e-9):
        found.append(
            f"the drive counts velocity in {unit_radps:.3g} rad/s (drive.velocity_unit = {settings.velocity_unit}), "
            f"{unit_radps / speed:.0%} of limits.velocity_max_radps (={speed:g})"
        )
    return found


def new_port(
    settings: CanopenSettings,
    torque_per_permille_Nm: float,
    max_permille: int,
    *,
    velocity: bool = False,
    position: bool = False,
    layout: PdoLayout | None = None,
    heartbeat_watched: bool = True,
    second_range_counts: int = DRIVE_RANGE_COUNTS,
) -> Any:
    """A `CanopenPort` record array of one record; the file descriptor is still missing.

    `velocity`: the drive is in a velocity mode and the RPDO carries 60FF; `position`: CSP and 607A.
    `layout`: of the PDOs (None: our own).  `heartbeat_watched`: the drive sends its own heartbeat.
    """
    layout = layout or own_layout(settings.node, velocity=velocity)
    ports = new(CanopenPort)
    port = ports[0]
    port.fd = -1
    port.node = settings.node
    port.sync_id = SYNC_ID
    port.emergency_id = EMERGENCY_ID + settings.node
    port.heartbeat_id = HEARTBEAT_ID + settings.node
    port.own_heartbeat_id = HEARTBEAT_ID + settings.master_node
    # three heartbeats within the drive's time-out, so that one or two lost ones do not stop the joint
    port.heartbeat_cycles = max(1, int(settings.heartbeat_s * settings.rate_Hz / 3.0))
    port.period_ns = round(1e9 / settings.rate_Hz)
    port.heartbeat_watched = int(heartbeat_watched)
    for key in (
        "tpdo_id", "rpdo_id", "tpdo_length", "rpdo_length",
        "status_at", "position_at", "torque_at", "control_at", "target_at",
        "torque_offset_at", "offset_rpdo_id",
    ):  # fmt: skip
        setattr(port, key, getattr(layout, key))
    for i, value in enumerate(layout.fill):
        port.rpdo_filler[i] = value
    port.target_is_velocity, port.target_is_position = int(velocity), int(position)
    port.has_torque_offset = int(layout.torque_offset_at >= 0)
    port.offset_share = settings.velocity_share
    # the drive counts speed in the direction of its encoder
    port.velocity_radpspunit = joint_velocity_per_unit_radps(settings) * settings.encoder_direction
    port.position_radpcount = joint_angle_per_count_rad(settings) * settings.encoder_direction
    port.zero_counts = settings.zero_counts
    port.torque_Nmppermille = torque_per_permille_Nm * settings.torque_direction
    port.max_permille = max_permille
    port.state = State.UNDEFINED
    if settings.joint_encoder is not None:
        _fill_second(port.second, settings, settings.joint_encoder, second_range_counts)
    return ports


def _fill_second(
    second: SecondPosition, settings: CanopenSettings, encoder: JointEncoderSettings, range_counts: int
) -> None:
    if encoder.node is None:
        second.tpdo_id = TPDO2_ID + settings.node
    else:
        second.tpdo_id = TPDO1_ID + encoder.node
        second.emergency_id = EMERGENCY_ID + encoder.node
        second.heartbeat_id = HEARTBEAT_ID + encoder.node
    second.tpdo_length = 4
    second.position_at = 0
    second.range_counts = range_counts
    second.zero_counts = encoder.zero_counts
    second.radpcount = encoder.rad_per_count
    second.feeds_law = int(encoder.feeds_law)
    if encoder.incremental:
        second.align = AlignTo.FIRST
    elif settings.encoder_incremental:
        second.align = AlignTo.SECOND


def start_position_rad(settings: CanopenSettings, first_counts: int, second_counts: int, range_counts: int) -> float:
    """Where the joint stands by the encoder that feeds the law; an incremental one takes the other's angle."""
    first_rad = (first_counts - settings.zero_counts) * joint_angle_per_count_rad(settings) * settings.encoder_direction
    encoder = settings.joint_encoder
    if encoder is None:
        return first_rad
    second_rad = centred(second_counts - encoder.zero_counts, range_counts) * encoder.rad_per_count
    if encoder.incremental:
        return first_rad
    if settings.encoder_incremental or encoder.feeds_law:
        return second_rad
    return first_rad
