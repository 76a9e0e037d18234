"""What the drive does when it loses this computer: the reactions are set and read back, and one there must be.

The proof of the watchdog shows that a lost heartbeat is detected, with the power off.  That the motor then really stops
is not tried at commissioning: it would mean to enable before the user has been asked, and an enabled drive opens its
brake, at zero torque as well.  What can be had without that is the drive's own word for its reaction.
"""

from __future__ import annotations

import contextlib

from jointctl.drivers.canopen.pdo import COMMUNICATION_RPDO, DISABLED, EVENT_TIMER, IDENTIFIER, pdos_of
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.errors import DeviceError

ABORT_QUICK_STOP = 3  # object 6007
STOPPED = 2  # object 1029:1
RPDO_DEADLINE_SHARE = 0.5  # of drive.heartbeat_s
RPDO_DEADLINE_MIN_PERIODS = 5
LARGEST_MS = 0xFFFF
LARGEST_SUB = 0x80
_ALONE = "RPDOs that get lost while our heartbeat does not stop the joint only when the loop withholds its heartbeat"


def arm_reaction(objects: ObjectAccess, settings: CanopenSettings) -> tuple[str, list[str]]:
    """Abort connection option (6007), quick stop option (605A) and error behaviour (1029:1); (in words, remarks).

    `DeviceError` for a drive that has neither 6007 nor 1029:1: nothing would say that it stops.
    """
    stops = objects.write_if_present(0x6007, 0, ABORT_QUICK_STOP, what="abort connection option")
    objects.write_if_present(0x605A, 0, settings.quick_stop_option, what="quick stop option")
    # a communication error must not leave the drive in operational
    leaves = objects.write_if_present(0x1029, 1, STOPPED, what="error behaviour")
    if not (stops or leaves):
        raise DeviceError(
            f"node {settings.node} has neither object 6007 (abort connection option) nor 1029:1 (error behaviour): "
            "nothing says that it stops when this computer dies",
            "use the EDS that belongs to the drive's firmware; such a drive is not enabled",
        )
    if not stops:
        return "1029:1 = 2 (stopped), read back", [
            "no object 6007: a lost heartbeat takes the drive out of operational; how the motor stops is "
            "up to the drive"
        ]
    return "6007 = 3 (quick stop)" + (", 1029:1 = 2 (stopped)" if leaves else "") + ", read back", []


def rpdo_deadline_ms(settings: CanopenSettings) -> int:
    """How long RPDOs may stay away until the drive stops by itself."""
    seconds = max(RPDO_DEADLINE_SHARE * settings.heartbeat_s, RPDO_DEADLINE_MIN_PERIODS / settings.rate_Hz)
    return min(round(seconds * 1000.0), LARGEST_MS)


def _record_of(objects: ObjectAccess, rpdo_id: int) -> tuple[int, int]:
    """(communication record, COB-ID) of the RPDO with this identifier."""
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
        if cob_id & (DISABLED | IDENTIFIER) == rpdo_id:
            return base, cob_id
    raise DeviceError(f"no RPDO of the drive is enabled on {rpdo_id:03X}h any more")


def arm_rpdo_deadline(objects: ObjectAccess, settings: CanopenSettings, rpdo_id: int) -> tuple[str, list[str]]:
    """Event timer of the loop's RPDO (CiA 301: deadline monitoring, EMCY 8250h); ("", remarks) where there is none."""
    base, cob_id = _record_of(objects, rpdo_id)
    if not objects.has(base, EVENT_TIMER):
        return "", [f"no object {base:04X}:5 (RPDO event timer): {_ALONE}"]
    milliseconds = rpdo_deadline_ms(settings)
    error = _write_event_timer(objects, base, cob_id, milliseconds)
    if error is not None:
        return "", [f"{error.message}: {_ALONE}"]
    return f"{milliseconds} ms", []


def _write_event_timer(objects: ObjectAccess, base: int, cob_id: int, milliseconds: int) -> DeviceError | None:
    """Why the drive does not take it, or None.  The PDO is disabled meanwhile, as some drives insist."""
    what = f"PDO {base:04X} COB-ID"
    objects.write(base, 1, cob_id | DISABLED, what=what)
    try:
        objects.write_verified(base, EVENT_TIMER, milliseconds, what="RPDO event timer")
    except DeviceError as error:
        return error
    finally:
        objects.write_verified(base, 1, cob_id, what=what)
    return None


def clear_rpdo_deadlines(objects: ObjectAccess) -> None:
    """Event timers of all RPDOs to zero: which one an earlier run has armed is not known."""
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        if objects.read_if_present(base, EVENT_TIMER, what="RPDO event timer"):
            cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
            error = _write_event_timer(objects, base, cob_id, 0)
            if error is not None:
                raise error


def rpdo_identifiers(objects: ObjectAccess) -> list[int]:
    """COB-IDs of the drive's enabled RPDOs, as it has them now; those that cannot be read are left out."""
    found = []
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        with contextlib.suppress(DeviceError):
            cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
            if not cob_id & DISABLED:
                found.append(cob_id & IDENTIFIER)
    return found


def watched_nodes(objects: ObjectAccess) -> set[int]:
    """Nodes whose heartbeat the drive watches now (1016)."""
    found = set()
    for sub in range(1, LARGEST_SUB):
        entry = objects.read_if_present(0x1016, sub, what="consumer heartbeat time")
        if entry is None:
            break
        if entry & 0xFFFF:
            found.add(entry >> 16 & 0xFF)
    return found
