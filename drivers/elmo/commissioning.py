"""What commissioning sets in an Elmo drive and reads back: its unit mode (UM) and its own limits.

The motor is off.  The limits are all that watches the joint when the line is cut.
"""

from __future__ import annotations

import contextlib

from jointctl.drivers.elmo.codes import UnitMode
from jointctl.drivers.elmo.dialogue import Dialogue, RefusedError
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import DeviceError

TORQUE_MODE, SPEED_MODE = "torque (UM=1)", "speed (UM=2)"  # as commissioning reports them
PEAK_SHARE = 1.02  # in speed mode, of the current of limits.torque_max_Nm: the loop must see that it is reached


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


def _write_currents(line: Dialogue, settings: ElmoSettings, found: dict[str, str], speed_mode: bool) -> None:
    """CL and PL.  In speed mode the drive decides on the current: PL[1] stands for the loop's torque limit."""
    maximum_A = line.number("MC")
    continuous_A, peak_A = settings.continuous_current_A, settings.peak_current_A
    for key, value in (("peak", peak_A), ("continuous", continuous_A)):
        if value > maximum_A:
            raise DeviceError(f"drive.{key}_current_A (={value:g}) must be at most {maximum_A:g}, the drive's MC")
    found["MC"] = f"{maximum_A:g} A"
    if speed_mode:
        peak_A = min(peak_A, PEAK_SHARE * settings.max_current_A)
        continuous_A = min(continuous_A, peak_A)
    # lower the continuous limit first: it may not be above the peak limit at any moment
    order = [("CL", 1, continuous_A, "A"), ("PL", 1, peak_A, "A")]
    if continuous_A > line.number("PL", 1):
        order.reverse()
    for name, index, value, unit in [*order, ("PL", 2, settings.peak_time_s, "s")]:
        found[f"{name}[{index}]"] = f"{line.assign_verified(name, value, index):g} {unit}"


def write_limits(line: Dialogue, settings: ElmoSettings, found: dict[str, str], *, speed_mode: bool) -> list[str]:
    """All limits into `found`; returns what is not in force, in words.  The motor is off."""
    _write_currents(line, settings, found, speed_mode)
    per_rad = 1.0 / abs(settings.rad_per_count)
    speed = round((1.0 + settings.limit_margin) * settings.velocity_max_radps * per_rad)
    slack_rad = settings.limit_margin * (settings.position_max_rad - settings.position_min_rad)
    ends = sorted(
        settings.counts_at(position)
        for position in (settings.position_min_rad - slack_rad, settings.position_max_rad + slack_rad)
    )
    limits = [
        ("HL", 2, speed), ("LL", 2, -speed), ("HL", 3, ends[1]), ("LL", 3, ends[0]),
        ("ER", 2, round(settings.speed_error_radps * per_rad)),
        ("ER", 3, round(settings.position_error_rad * per_rad)),
    ]  # fmt: skip
    missing = []
    for name, index, count in limits:
        try:
            found[f"{name}[{index}]"] = f"{line.assign_verified(name, count, index):.0f} counts"
        except RefusedError as error:
            if (name, index) in (("HL", 2), ("LL", 2)):
                raise  # without a speed limit of the drive nothing would stop a joint whose line is cut
            missing.append(f"{name}[{index}] is not in force: {error.message}")
    return missing
