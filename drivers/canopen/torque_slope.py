"""Profile torque mode (TQ) ramps its target by 6087 [1/1000 of rated torque per second]: the ramp must not be felt."""

from __future__ import annotations

from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.errors import DeviceError

STEEP_PERMILLE_PS = 1_000_000
TQ_REMARK = "torque mode with profile (TQ) instead of cyclic synchronous torque"


def set_torque_slope(objects: ObjectAccess, torque_per_permille_Nm: float, torque_rate_max_Nmps: float) -> list[str]:
    """Make 6087 as steep as the drive allows; remarks.

    `DeviceError` if it stays below `torque_rate_max_Nmps`, the loop's own limit: the law would reckon with a torque
    that the drive has not reached yet, which is a delay that no margin accounts for.
    """
    if not objects.has(0x6087):
        return [f"{TQ_REMARK}; no object 6087: see in the drive's manual that its torque ramp is steep or off"]
    highest = objects.highest(0x6087)
    steep = STEEP_PERMILLE_PS if highest is None else min(STEEP_PERMILLE_PS, highest)
    try:
        slope = objects.write_verified(0x6087, 0, steep, what="torque slope")
    except DeviceError:
        slope = objects.read(0x6087, what="torque slope")
    slope_Nmps = slope * torque_per_permille_Nm
    if slope_Nmps < torque_rate_max_Nmps:
        raise DeviceError(
            f"the drive ramps its torque with at most {slope_Nmps:.0f} Nm/s (6087 = {slope} permille/s), slower than "
            f"limits.torque_rate_max_Nmps (={torque_rate_max_Nmps:g})",
            hint=f"set limits.torque_rate_max_Nmps to {slope_Nmps:.0f} or less, or use cyclic synchronous torque",
        )
    return [TQ_REMARK] if slope == STEEP_PERMILLE_PS else [f"{TQ_REMARK}; 6087 = {slope} permille/s"]
