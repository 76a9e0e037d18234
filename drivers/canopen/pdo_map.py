"""Setting up the two PDOs of the loop, in the order that CiA 301 asks for, and reading them back.

Pre-operational, COB-ID with bit 31 set, transmission type, sub 0 = 0, entries, sub 0 = n, COB-ID enabled.  A drive
that does not let its map be changed is taken as it is if one of its PDOs holds what the loop needs.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

from jointctl.drivers.canopen.identifiers import LAST_SYNCHRONOUS
from jointctl.drivers.canopen.pdo_layout import (
    COMMUNICATION_RPDO,
    COMMUNICATION_TPDO,
    CONTROL,
    DISABLED,
    EXTENDED,
    IDENTIFIER,
    LAST_PDO,
    MAPPING_OFFSET,
    NO_REMOTE_REQUEST,
    POSITION,
    STATUS,
    TARGET_TORQUE,
    TORQUE,
    MappedObject,
    PdoLayout,
    PdoMap,
    fill_of,
    own_layout,
    read_map,
)
from jointctl.drivers.canopen.sdo import ObjectAccess, was_refused
from jointctl.drivers.errors import DeviceError

EVERY_SYNC = 1
FIRST_IDENTIFIER, LAST_IDENTIFIER = 0x181, 0x57F
INHIBIT_TIME, EVENT_TIMER = 3, 5
FIXED_HINT = "change the map with the drive maker's software, or use a drive whose PDOs can be mapped"


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
    """Set bit 31 of a PDO that is not used; its other bits stay.  One that stays enabled is told."""
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
    spare: frozenset[int] = frozenset(),
) -> PdoLayout:
    """TPDO1 = statusword, position, torque at every SYNC; RPDO1 = controlword, `target`; the others off.

    Where the drive refuses that, the first of its PDOs that holds what is needed is used as it is; `mode` and
    `max_permille` then fill 6060 and 6072 in it.  PDOs in `spare` stay as they are.
    Raises `DeviceError` with what is missing.
    """
    for item in (STATUS, POSITION, CONTROL, target):
        objects.require(item.index, item.sub, what=item.name)
    mapped = (STATUS, POSITION, TORQUE) if objects.has(TORQUE.index) else (STATUS, POSITION)
    own = own_layout(node, velocity=target is not TARGET_TORQUE, torque=TORQUE in mapped)
    tpdo = _map_or_find(objects, COMMUNICATION_TPDO, own.tpdo_id, EVERY_SYNC, mapped)
    rpdo = _map_or_find(objects, COMMUNICATION_RPDO, own.rpdo_id, rpdo_transmission_type, (CONTROL, target))
    for first, kept in ((COMMUNICATION_TPDO, tpdo), (COMMUNICATION_RPDO, rpdo)):
        for base in pdos_of(objects, first):
            if base != (first if kept is None else kept.base) and base not in spare:
                disable_pdo(objects, base)
    layout = own
    if tpdo is not None:
        layout = replace(
            layout, tpdo_id=tpdo.identifier, tpdo_length=tpdo.bytes, status_at=tpdo.at(STATUS),
            position_at=tpdo.at(POSITION), torque_at=tpdo.at(TORQUE),
        )  # fmt: skip
    if rpdo is not None:
        fill = fill_of(rpdo, target, mode, max_permille)
        layout = replace(
            layout, rpdo_id=rpdo.identifier, rpdo_length=rpdo.bytes, control_at=rpdo.at(CONTROL),
            target_at=rpdo.at(target), fill=fill,
        )  # fmt: skip
    return layout


def _map_or_find(
    objects: ObjectAccess, base: int, identifier: int, kind: int, mapped: tuple[MappedObject, ...]
) -> PdoMap | None:
    """None if the PDO at `base` was mapped as wanted, else the drive's own PDO that is used instead."""
    objects.require(base, 1, what="PDO communication parameter")
    before = read_map(objects, base)
    try:
        configure_pdo(objects, base, identifier, kind, mapped)
        return None
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
        raise DeviceError(f"{what} cannot be changed and has COB-ID {pdo.cob_id:08X}h, which is no PDO's", FIXED_HINT)
    objects.write_verified(pdo.base, 1, pdo.cob_id & ~DISABLED, what=f"{what} COB-ID")
    return pdo
