"""The limits of the loop, as pure functions: which fault a value means, what is done about a fault.

Every limit is inclusive: a value equal to the limit is allowed.  A NaN is never allowed.
"""

from __future__ import annotations

import math

from firmware_py.kernel import kernel
from firmware_py.records import LimitConstants
from firmware_py.states import AxisPhase, DriveState, Fault, LimitSource, Reaction


@kernel
def within(value: float, low: float, high: float) -> bool:
    """low <= value <= high; False for NaN (every comparison with NaN is false)."""
    return low <= value and value <= high


@kernel
def motion_fault(limits: LimitConstants, position_rad: float, velocity_radps: float, error_rad: float) -> Fault:
    """Fault of the measured motion, in the order position, velocity, following error."""
    if not within(position_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.POSITION_LIMIT
    if not within(velocity_radps, -limits.velocity_max_radps, limits.velocity_max_radps):
        return Fault.VELOCITY_LIMIT
    if not within(error_rad, -limits.following_error_max_rad, limits.following_error_max_rad):
        return Fault.FOLLOWING_ERROR
    return Fault.NONE


@kernel
def limit_position_rad(limits: LimitConstants, law_rad: float, other_rad: float) -> float:
    """The position that the position limits are checked with; of both, the one farther from the middle, or NaN."""
    if limits.limit_source == LimitSource.OTHER:
        return other_rad
    if limits.limit_source == LimitSource.BOTH:
        middle_rad = 0.5 * (limits.position_min_rad + limits.position_max_rad)
        if not abs(other_rad - middle_rad) <= abs(law_rad - middle_rad):
            return other_rad
    return law_rad


@kernel
def encoders_disagree(limits: LimitConstants, law_rad: float, other_rad: float, torque_Nm: float) -> bool:
    """Whether two encoders of one joint differ by more than allowed; a flexible reducer twists under `torque_Nm`."""
    if limits.disagreement_max_rad <= 0.0:
        return False
    allowed_rad = limits.disagreement_max_rad + limits.twist_radpNm * abs(torque_Nm)
    return not abs(law_rad - other_rad) <= allowed_rad


@kernel
def reference_fault(
    limits: LimitConstants, position_rad: float, velocity_radps: float, brake_radps2: float, ahead_s: float
) -> Fault:
    """Fault of the desired motion: braked `ahead_s` from now, it must come to rest inside the position limits."""
    stop_rad = position_rad + velocity_radps * (ahead_s + 0.5 * abs(velocity_radps) / brake_radps2)
    if not within(position_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.REFERENCE_LIMIT
    if not within(stop_rad, limits.position_min_rad, limits.position_max_rad):
        return Fault.REFERENCE_LIMIT
    if not within(velocity_radps, -limits.velocity_max_radps, limits.velocity_max_radps):
        return Fault.REFERENCE_LIMIT
    return Fault.NONE


@kernel
def drive_fault(drive_state: int, enabled_expected: bool, restarts: int) -> Fault:
    """Fault of the drive's own state; a restart first: the drive has lost its configuration."""
    if restarts != 0:
        return Fault.DRIVE_RESTARTED
    if drive_state == DriveState.FAULT or drive_state == DriveState.FAULT_BRAKING:
        return Fault.DRIVE_FAULT
    if enabled_expected and drive_state != DriveState.ENABLED:
        return Fault.DRIVE_NOT_ENABLED
    return Fault.NONE


@kernel
def reaction_to(fault: int, phase: int) -> Reaction:
    """What to do about a fault.

    Off only where the drive does not follow anyway or no torque is applied yet: it drops a gravity load.  A ramp
    only where the measurement and the law can still be trusted.  Everything else is the drive's quick stop.
    """
    if fault == Fault.NONE:
        return Reaction.NONE
    if phase <= AxisPhase.ENABLING or phase >= AxisPhase.QUICK_STOPPING:
        return Reaction.OFF
    if fault == Fault.DRIVE_FAULT or fault == Fault.DRIVE_NOT_ENABLED or fault == Fault.DRIVE_RESTARTED:
        return Reaction.OFF
    if fault == Fault.REFERENCE_LIMIT or fault == Fault.SUPERVISOR_LOST or fault == Fault.OVERRUN:
        return Reaction.RAMP
    return Reaction.QUICK_STOP


@kernel
def limited_torque_Nm(
    limits: LimitConstants, torque_Nm: float, last_torque_Nm: float, period_s: float
) -> tuple[float, bool]:
    """(torque to send [Nm], finite): finite check, torque limit, rate limit, in that order.

    Not finite: zero torque is returned at once, without the rate limit, and the caller must stop the joint.
    """
    if not math.isfinite(torque_Nm):
        return 0.0, False
    limited = min(max(torque_Nm, -limits.torque_max_Nm), limits.torque_max_Nm)
    step = limits.torque_rate_max_Nmps * period_s
    limited = min(max(limited, last_torque_Nm - step), last_torque_Nm + step)
    return limited, True
