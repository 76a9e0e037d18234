"""The velocity command: the reference's velocity plus a small position correction, for the drive's own velocity loop.

    v = v_d - k (q - q_d)          at the joint, rad/s, k = position_gain_ps [1/s]

The correction keeps the joint on the planned motion (a drive's velocity loop alone drifts); it is small on purpose,
so that at constant speed the torque is what friction asks for.  Sent only if it is finite, then limited by the
velocity limit and by the acceleration limit, in that order.  Not modelled: the drive's own ramps and limits.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import LimitConstants, Reference, VelocityCommandConstants


@kernel
def velocity_command_radps(constants: VelocityCommandConstants, reference: Reference, position_rad: float) -> float:
    """The unlimited velocity command [rad/s]."""
    return reference.velocity_radps - constants.position_gain_ps * (position_rad - reference.position_rad)


@kernel
def limited_velocity_radps(
    limits: LimitConstants, acceleration_max_radps2: float, velocity_radps: float, last_radps: float, interval_s: float
) -> tuple[float, bool]:
    """(velocity to send [rad/s], finite): finite check, velocity limit, acceleration limit, in that order.

    `interval_s` is the time since the last command.  Not finite: zero at once, and the caller must stop the joint.
    """
    if not math.isfinite(velocity_radps):
        return 0.0, False
    limited = min(max(velocity_radps, -limits.velocity_max_radps), limits.velocity_max_radps)
    step = acceleration_max_radps2 * interval_s
    return min(max(limited, last_radps - step), last_radps + step), True
