"""The control law (29): computed torque, friction feed-forward, and the network that learns the rest.

    tau = M0 (q_d'' - kv e' - kp e) + C0 q' + G0(q) + n tau_f0 - fhat,   e = q - q_d

All torques at the joint.  The result is not limited here: the axis checks, limits and rate-limits it.
"""

from __future__ import annotations

import math

from firmware_py.friction import compensation_motor_torque_Nm
from firmware_py.kernel import kernel
from firmware_py.lugre import step_lugre
from firmware_py.rbfnn import adapt_network, network_torque_Nm, reset_network
from firmware_py.records import LawConstants, LawState, Reference, VelocityState
from firmware_py.states import ControllerKind, FeedForward


@kernel
def reset_law(constants: LawConstants, state: LawState) -> None:
    """Forget everything learned."""
    reset_network(constants.network, state.network)
    state.lugre_deflection_rad = 0.0


@kernel
def friction_feed_forward_Nm(
    constants: LawConstants, state: LawState, velocity_radps: float, desired_velocity_radps: float
) -> float:
    """n tau_f0 at the joint [Nm] by the configured rule."""
    if constants.feed_forward == FeedForward.NONE:
        return 0.0
    if constants.feed_forward == FeedForward.LUGRE_DESIRED:
        deflection, torque = step_lugre(
            constants.lugre,
            constants.friction,
            constants.reduction_ratio,
            state.lugre_deflection_rad,
            desired_velocity_radps,
            constants.period_s,
        )
        state.lugre_deflection_rad = deflection
        return torque
    speed = velocity_radps if constants.feed_forward == FeedForward.MEASURED else desired_velocity_radps
    return constants.reduction_ratio * compensation_motor_torque_Nm(
        constants.friction, constants.zero_rule, constants.zero_band_radps, speed
    )


@kernel
def step_law(
    constants: LawConstants, state: LawState, position_rad: float, velocity: VelocityState, reference: Reference
) -> float:
    """One cycle: the unlimited torque at the joint [Nm]; adapts the network afterwards."""
    error = position_rad - reference.position_rad
    if constants.matched_filter != 0:
        error_rate = velocity.error_rate_radps
    else:
        error_rate = velocity.velocity_radps - reference.velocity_radps
    state.inertia_torque_Nm = constants.inertia_kgm2 * reference.acceleration_radps2
    state.feedback_torque_Nm = -constants.inertia_kgm2 * (constants.kv * error_rate + constants.kp * error)
    state.gravity_torque_Nm = constants.coriolis_Nmspr * velocity.velocity_radps + constants.gravity_Nm * math.sin(
        position_rad - constants.gravity_zero_rad
    )
    state.friction_torque_Nm = friction_feed_forward_Nm(
        constants, state, velocity.velocity_radps, reference.velocity_radps
    )
    torque = state.inertia_torque_Nm + state.feedback_torque_Nm + state.gravity_torque_Nm + state.friction_torque_Nm
    if constants.kind == ControllerKind.COMPUTED_TORQUE_RBF:
        state.network_torque_Nm = network_torque_Nm(constants.network, state.network, error, error_rate)
        adapt_network(constants.network, state.network, error, error_rate, constants.period_s)
        torque -= state.network_torque_Nm
    else:
        state.network_torque_Nm = 0.0
    return torque
