"""The unit modes of an Elmo drive (UM) that the loop uses, set with the motor off and read back."""

from __future__ import annotations

import contextlib

from jointctl.drivers.elmo.codes import UnitMode
from jointctl.drivers.elmo.dialogue import Dialogue, RefusedError
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import DeviceError

TORQUE_MODE, SPEED_MODE = "torque (UM=1)", "speed (UM=2)"  # as commissioning reports them


def set_torque_mode(line: Dialogue) -> dict[str, str]:
    """UM=1 without the analog reference (RM=0), and TC known to be zero: MO=1 then applies no torque.

    Before every MO=1 in this mode; the motor is off.  Raises `DeviceError` where the drive does not confirm it.
    """
    found = {n: f"{line.assign_verified(n, v):g}" for n, v in (("UM", int(UnitMode.TORQUE)), ("RM", 0))}
    kept_A = line.number("TC")
    if kept_A != 0.0:
        with contextlib.suppress(RefusedError):  # most drives take TC only with the motor on
            line.assign("TC", 0)
        kept_A = line.number("TC")
    if kept_A != 0.0:
        raise DeviceError(
            f"TC (={kept_A:g}) of the drive must be 0 with the motor off: it would push at MO=1",
            "switch the drive's supply off and on",
        )
    return found


def set_speed_mode(line: Dialogue, settings: ElmoSettings) -> dict[str, str]:
    """UM=2 along the drive's own ramps (PM=1) without the analog reference, and JV known to be zero.

    AC, DC and SD are steeper than what the loop asks for, and bound what one damaged command does in a cycle.
    The motor is off.  Raises `DeviceError` where the drive does not confirm it.
    """
    ramp_cps2 = round(settings.ramp_radps2 / abs(settings.rad_per_count))
    values = [
        ("UM", int(UnitMode.SPEED)),
        ("RM", 0),
        ("PM", 1),
        ("AC", ramp_cps2),
        ("DC", ramp_cps2),
        ("SD", ramp_cps2),
    ]
    found = {name: f"{line.assign_verified(name, value):g}" for name, value in [*values, ("JV", 0)]}
    step_radps = abs(settings.rad_per_count)
    return found | {"speed": f"at most {settings.max_velocity_cps} counts/s, steps of {step_radps:.2g} rad/s"}
