"""What CiA 301 and CiA 402 demand of an SDO write beyond type and range: PDO set-up, COB-IDs, sets of values.

A PDO's mapping changes only while its COB-ID has bit 31 set and, for the entries, while sub 0 is 0; identifier and
inhibit time of a valid PDO are fixed.  A COB-ID must be an 11-bit identifier outside the restricted ones.  Abort codes
of a mapping are those of CiA 301, 7.5.2.36 and 7.5.2.38: an object that is not there, whole or its sub-index, is
0602 0000, one that cannot be mapped 0604 0041, more than there is room for 0604 0042.
"""

from __future__ import annotations

from jointctl.hil.canopen.device_records import EVENT_DRIVEN, LAST_SYNCHRONOUS, PowerState
from jointctl.hil.canopen.object_dictionary import (
    DEVICE_STATE,
    INVALID_VALUE,
    NO_OBJECT,
    PDO_LENGTH,
    UNSUPPORTED_ACCESS,
    ObjectDictionary,
    SdoAbort,
    is_mapping,
)

NOT_MAPPABLE = 0x06040041
PARAMETER_CONFLICT = 0x06040043

_INVALID = 0x80000000
_EXTENDED = 0x20000000
_QUICK_STOP_OPTIONS = (0, 1, 2, 5, 6)
_MODES = (0, 1, 3, 4, 6, 8, 9, 10)
_HOMING_METHODS = (0, 33, 34, 35, 37)
_LINEAR_RAMP = (0,)  # of 6086 and 6088: the only profile there is
_VALUES = {
    0x605A: _QUICK_STOP_OPTIONS,
    0x6060: _MODES,
    0x6086: _LINEAR_RAMP,
    0x6088: _LINEAR_RAMP,
    0x6098: _HOMING_METHODS,
    0x1003: (0,),
}


def _restricted(identifier: int) -> bool:
    """Identifiers that CiA 301 keeps from being configured (NMT, SDO, heartbeat, ...)."""
    return (
        identifier <= 0x7F
        or 0x101 <= identifier <= 0x180
        or 0x581 <= identifier <= 0x5FF
        or 0x601 <= identifier <= 0x67F
        or identifier >= 0x6E0
    )


def _check_cob_id(old: int, new: int) -> None:
    """A COB-ID with a valid bit: changing the identifier needs bit 31 before or in the same write."""
    if new & _EXTENDED or new & 0x1FFFF800:
        raise SdoAbort(INVALID_VALUE)
    if not new & _INVALID:
        if _restricted(new & 0x7FF):
            raise SdoAbort(INVALID_VALUE)
        if not old & _INVALID and (old ^ new) & 0x7FF:
            raise SdoAbort(DEVICE_STATE)


def _check_entry(objects: ObjectDictionary, value: int, received: bool) -> int:
    """A mapping entry must name a mappable object with its own length; its length in bits."""
    entry = objects.entries.get((value >> 16, value >> 8 & 0xFF))
    if entry is None:
        raise SdoAbort(NO_OBJECT)
    if not entry.mappable or (received and not entry.writable) or value & 0xFF != 8 * entry.size:
        raise SdoAbort(NOT_MAPPABLE)
    return value & 0xFF


def _check_mapping(objects: ObjectDictionary, index: int, sub: int, value: int) -> None:
    received = index < 0x1800
    if not objects.value(index - 0x200, 1) & _INVALID:
        raise SdoAbort(UNSUPPORTED_ACCESS)
    if sub == 0:
        if (index, value) not in objects.entries:
            raise SdoAbort(PDO_LENGTH)
        bits = sum(_check_entry(objects, objects.value(index, i + 1), received) for i in range(value))
        if bits > 64:
            raise SdoAbort(PDO_LENGTH)
        return
    if objects.value(index, 0) != 0:
        raise SdoAbort(UNSUPPORTED_ACCESS)
    if value != 0:
        _check_entry(objects, value, received)


def _check_heartbeat(objects: ObjectDictionary, sub: int, value: int) -> None:
    """A producer may be watched once only; an entry without a time, or without a node that there can be, is unused."""
    others = [objects.value(0x1016, other) for other in (1, 2) if other != sub]
    used = value & 0xFFFF and 1 <= value >> 16 <= 127
    if used and any(other >> 16 == value >> 16 and other & 0xFFFF for other in others):
        raise SdoAbort(PARAMETER_CONFLICT)


def check_write(objects: ObjectDictionary, index: int, sub: int, value: int, power_state: int) -> None:
    """Raise SdoAbort when the (well-formed, in range) value must not be written now."""
    pdo_parameter = 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00
    if pdo_parameter and sub == 1:
        _check_cob_id(objects.value(index, 1), value)
    elif pdo_parameter and sub == 2:
        if LAST_SYNCHRONOUS < value < EVENT_DRIVEN:
            raise SdoAbort(INVALID_VALUE)
    elif pdo_parameter and sub in (3, 6):
        if not objects.value(index, 1) & _INVALID:
            raise SdoAbort(DEVICE_STATE)
    elif is_mapping(index):
        _check_mapping(objects, index, sub, value)
    elif index == 0x1014:
        _check_cob_id(objects.value(0x1014, 0), value)
    elif index == 0x1005 and _restricted(value):
        raise SdoAbort(INVALID_VALUE)
    elif index == 0x1016:
        _check_heartbeat(objects, sub, value)
    elif index == 0x1019:
        if value == 1:
            raise SdoAbort(INVALID_VALUE)
        if objects.value(0x1006, 0):
            raise SdoAbort(DEVICE_STATE)
    elif index in _VALUES:
        if value not in _VALUES[index]:
            raise SdoAbort(INVALID_VALUE)
    elif index in (0x6075, 0x6076) and power_state >= PowerState.OPERATION_ENABLED:
        # rescaling a running torque would step it
        raise SdoAbort(DEVICE_STATE)
