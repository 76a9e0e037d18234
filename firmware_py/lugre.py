"""LuGre friction driven by a given velocity, for compensation: bristle deflection z [rad] at the joint.

    z' = v - sigma0 |v| / g(v) z,     tau = sigma0 z + sigma1 z' + (viscous part)

g(v) is the whole sliding curve n tau_f(v) of (11), viscous part included, so that the steady state is exactly (11)
and no separate viscous term is added.  z is updated by the exact solution over one period at constant v, which is
stable for any stiffness and period.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.friction import branch_torque_Nm
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import FrictionConstants, LuGreConstants


@kernel
def step_lugre(
    lugre: LuGreConstants,
    friction: FrictionConstants,
    reduction_ratio: float,
    deflection_rad: float,
    velocity_radps: float,
    period_s: float,
) -> tuple[float, float]:
    """(new deflection [rad], friction torque at the joint [Nm]) after `period_s` at `velocity_radps`."""
    speed = abs(velocity_radps)
    if speed == 0.0:
        return deflection_rad, lugre.stiffness_Nmprad * deflection_rad
    branch = friction.positive if velocity_radps > 0.0 else friction.negative
    sliding_Nm = reduction_ratio * branch_torque_Nm(branch, speed)
    settled_rad = math.copysign(sliding_Nm / lugre.stiffness_Nmprad, velocity_radps)
    decay = math.exp(-speed * period_s * lugre.stiffness_Nmprad / sliding_Nm)
    moved_rad = settled_rad + (deflection_rad - settled_rad) * decay
    rate_radps = (moved_rad - deflection_rad) / period_s
    return moved_rad, lugre.stiffness_Nmprad * moved_rad + lugre.damping_Nmspr * rate_radps
