"""The drive's view of SYNC: our identifier, no counter, no SYNC of its own, and the period."""

from __future__ import annotations

from jointctl.drivers.canopen.identifiers import SYNC_ID
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.errors import DeviceError

PRODUCES_SYNC = 0x40000000
LONGEST_PERIOD = 255


def interpolation_period(rate_Hz: float) -> tuple[int, int]:
    """(60C2:1, 60C2:2): the period as value x 10^exponent s; `DeviceError` where there is no such value."""
    value, exponent = round(1e6 / rate_Hz), -6
    while value % 10 == 0 and exponent < 0:
        value //= 10
        exponent += 1
    if value > LONGEST_PERIOD:
        raise DeviceError(f"loop.rate_Hz (={rate_Hz:g}) has no 60C2 value: the period must be 1..255 x 10^n s")
    return value, exponent


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


def set_sync(objects: ObjectAccess, rate_Hz: float, *, cyclic: bool) -> dict[str, str]:
    """Settings for the report.  60C2 = SYNC period: needed in the cyclic modes, optional in the profile modes."""
    listen_to_our_sync(objects, rate_Hz)
    if not cyclic and not (objects.has(0x60C2, 1) and objects.has(0x60C2, 2)):
        return {}
    value, exponent = interpolation_period(rate_Hz)
    objects.write_verified(0x60C2, 1, value, what="interpolation time period")
    objects.write_verified(0x60C2, 2, exponent, what="interpolation time index")
    return {"60C2": f"{value}e{exponent} s"}
