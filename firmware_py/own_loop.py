"""What a drive gets that closes its velocity loop, or its position loop as well: the limits of its target included."""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.records import LimitConstants, VelocityCommandConstants

# --- The velocity command: the reference's velocity plus a small position correction ---
# For a drive that closes the velocity loop itself:
# v = v_d - k (q - q_d)          at the joint, rad/s, k = position_gain_ps [1/s]
#
# The correction keeps the joint on the planned motion (a drive's velocity loop alone drifts); it is small on purpose,
# so that at constant speed the torque is what friction asks for.  Sent only if it is finite, then limited by the
# velocity limit and by the acceleration limit, in that order.  Not modelled: the drive's own ramps and limits.
#
# A run in CSP or CSV (docs/law.md) sends the motion that is desired `lead_s` later, when it takes effect, and the law's
# feed-forward for it as torque offset.  In CSP the target position is limited like a joint that moves.


@kernel
def velocity_command_radps(constants: VelocityCommandConstants, reference: Reference, position_rad: float) -> float:
    """The unlimited velocity command [rad/s] for the motion that is desired now."""
    return reference.velocity_radps - constants.position_gain_ps * (position_rad - reference.position_rad)


@kernel
def look_ahead(reference: Reference, lead_s: float, ahead: Reference) -> None:
    """The desired motion `lead_s` later, as far as its derivatives of now say."""
    ahead.position_rad = reference.position_rad + lead_s * (
        reference.velocity_radps + 0.5 * lead_s * reference.acceleration_radps2
    )
    ahead.velocity_radps = reference.velocity_radps + lead_s * reference.acceleration_radps2
    ahead.acceleration_radps2 = reference.acceleration_radps2
    ahead.jerk_radps3 = reference.jerk_radps3
    ahead.snap_radps4 = reference.snap_radps4


@kernel
def limited_target_radps(
    limits: LimitConstants, acceleration_max_radps2: float, period_s: float, target: Reference, position_rad: float,
    velocity_radps: float,
) -> tuple[float, bool]:  # fmt: skip
    """(velocity of the target position [rad/s], finite): finite, position, velocity, acceleration limit, in that order.

    `position_rad` and `velocity_radps` are those of the last target.  A target that is out of reach is caught up with
    as a joint would, without a jump and without going beyond it; half of the acceleration is left for braking.
    Not finite: the last target stays, and the caller must stop the joint.
    """
    if not (math.isfinite(target.position_rad) and math.isfinite(target.velocity_radps)):
        return 0.0, False
    aim_rad = min(max(target.position_rad, limits.position_min_rad), limits.position_max_rad)
    step = acceleration_max_radps2 * period_s
    wanted = (aim_rad - position_rad) / period_s
    if abs(wanted - velocity_radps) > step:
        left_rad = aim_rad - position_rad - target.velocity_radps * period_s
        speed = min(math.sqrt(acceleration_max_radps2 * abs(left_rad)), abs(left_rad) / period_s)
        wanted = target.velocity_radps + math.copysign(speed, left_rad)
    wanted = min(max(wanted, -limits.velocity_max_radps), limits.velocity_max_radps)
    return min(max(wanted, velocity_radps - step), velocity_radps + step), True
