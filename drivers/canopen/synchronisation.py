"""The drive's view of SYNC: our identifier, no counter, no SYNC of its own, and the period."""

from __future__ import annotations

from jointctl.drivers.canopen.pdo import listen_to_our_sync
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.errors import DeviceError

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


def set_sync(objects: ObjectAccess, rate_Hz: float, *, cyclic: bool) -> dict[str, str]:
    """Settings for the report.  60C2 = SYNC period: needed in the cyclic modes, optional in the profile modes."""
    listen_to_our_sync(objects, rate_Hz)
    if not cyclic and not (objects.has(0x60C2, 1) and objects.has(0x60C2, 2)):
        return {}
    value, exponent = interpolation_period(rate_Hz)
    objects.write_verified(0x60C2, 1, value, what="interpolation time period")
    objects.write_verified(0x60C2, 2, exponent, what="interpolation time index")
    return {"60C2": f"{value}e{exponent} s"}
