"""The control laws: computed torque, friction feed-forward, and one of several ways to deal with the rest.

The paper's law (29) is COMPUTED_TORQUE_RBF:

    tau = M0 (q_d'' - kv e' - kp e) + C0 q' + G0(q) + n tau_f0 - fhat,   e = q - q_d

COMPUTED_TORQUE leaves fhat away, COMPUTED_TORQUE_OBSERVER replaces it by a disturbance observer, PID by an integral.
Iterative learning can be added to each.  All torques at the joint; nothing is limited here: the axis checks, limits
and rate-limits the result.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.disturbance_observer import add_to_disturbance, reset_observer, step_observer
from jointctl.firmware_py.friction import compensation_motor_torque_Nm
from jointctl.firmware_py.iterative_learning import (
    learning_torque_Nm,
    record_correction,
    reset_learning,
    watch_learning,
)
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.lugre import step_lugre
from jointctl.firmware_py.pid import integrate_error
from jointctl.firmware_py.rbfnn import adapt_network, network_torque_Nm, reset_network
from jointctl.firmware_py.records import LawConstants, LawState, Reference, VelocityState
from jointctl.firmware_py.states import ControllerKind, FeedForward


@kernel
def reset_law(constants: LawConstants, state: LawState) -> None:
    """Forget everything learned; the joint is at rest."""
    reset_network(constants.network, state.network)
    reset_observer(state.observer, 0.0)
    reset_learning(state.learning)
    state.learning.stopped = 0
    state.lugre_deflection_rad = 0.0
    state.integral_rads = 0.0
    state.inertia_torque_Nm = 0.0
    state.feedback_torque_Nm = 0.0
    state.friction_torque_Nm = 0.0
    state.gravity_torque_Nm = 0.0
    state.network_torque_Nm = 0.0
    state.observer_torque_Nm = 0.0
    state.learned_torque_Nm = 0.0


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
def _learn(
    constants: LawConstants,
    state: LawState,
    epoch: int,
    repeat_s: float,
    local_s: float,
    correction_Nm: float,
    error: float,
) -> float:
    """Torque from iterative learning [Nm]; what it stops adding at a change is handed to the observer."""
    before_Nm = state.learned_torque_Nm
    epoch_before = state.learning.epoch
    torque = learning_torque_Nm(constants.learning, state.learning, epoch, repeat_s, local_s, constants.period_s)
    watch_learning(constants.learning, state.learning, error)
    record_correction(constants.learning, state.learning, correction_Nm)
    if epoch_before != state.learning.epoch or repeat_s == 0.0:
        add_to_disturbance(constants.observer, state.observer, before_Nm)
        state.observer_torque_Nm = state.observer.disturbance_Nm
    return torque


@kernel
def _rest_torque_Nm(
    constants: LawConstants, state: LawState, error: float, error_rate: float, velocity_radps: float, sent_Nm: float
) -> float:
    """What the kind of law adds for all that the model does not know [Nm]."""
    state.network_torque_Nm = 0.0
    state.observer_torque_Nm = 0.0
    if constants.kind == ControllerKind.COMPUTED_TORQUE_RBF:
        state.network_torque_Nm = network_torque_Nm(constants.network, state.network, error, error_rate)
        adapt_network(constants.network, state.network, error, error_rate, constants.period_s)
        return -state.network_torque_Nm
    if constants.kind == ControllerKind.COMPUTED_TORQUE_OBSERVER:
        known = state.friction_torque_Nm + state.gravity_torque_Nm + state.learned_torque_Nm
        momentum = constants.inertia_kgm2 * velocity_radps
        state.observer_torque_Nm = step_observer(
            constants.observer, state.observer, sent_Nm, known, momentum, constants.period_s
        )
        return state.observer_torque_Nm
    if constants.kind == ControllerKind.PID:
        state.integral_rads = integrate_error(
            state.integral_rads, error, constants.period_s, constants.integral_limit_rads
        )
        integral_torque = -constants.inertia_kgm2 * constants.ki * state.integral_rads
        state.feedback_torque_Nm += integral_torque
        return integral_torque
    return 0.0


@kernel
def step_law(
    constants: LawConstants,
    state: LawState,
    position_rad: float,
    velocity: VelocityState,
    reference: Reference,
    sent_torque_Nm: float,
    epoch: int,
    repeat_s: float,
    local_s: float,
) -> float:
    """One cycle: the unlimited torque at the joint [Nm]; what adapts, adapts afterwards.

    `sent_torque_Nm` is the limited torque of the cycle before.  `epoch`, `repeat_s` and `local_s` say where in a
    repeating trajectory this is (`trajectory.repetition`); repeat_s = 0 where nothing repeats.
    """
    error = position_rad - reference.position_rad
    if constants.matched_filter != 0:
        error_rate = velocity.error_rate_radps
    else:
        error_rate = velocity.velocity_radps - reference.velocity_radps
    state.inertia_torque_Nm = constants.inertia_kgm2 * reference.acceleration_radps2
    proportional_Nm = -constants.inertia_kgm2 * (constants.kv * error_rate + constants.kp * error)
    state.feedback_torque_Nm = proportional_Nm
    state.gravity_torque_Nm = constants.coriolis_Nmspr * velocity.velocity_radps + constants.gravity_Nm * math.sin(
        position_rad - constants.gravity_zero_rad
    )
    state.friction_torque_Nm = friction_feed_forward_Nm(
        constants, state, velocity.velocity_radps, reference.velocity_radps
    )
    rest_Nm = _rest_torque_Nm(constants, state, error, error_rate, velocity.velocity_radps, sent_torque_Nm)
    correction_Nm = proportional_Nm + rest_Nm - constants.inertia_kgm2 * constants.learning.error_gain_ps2 * error
    state.learned_torque_Nm = _learn(constants, state, epoch, repeat_s, local_s, correction_Nm, error)
    if constants.kind == ControllerKind.COMPUTED_TORQUE_OBSERVER:
        rest_Nm = state.observer_torque_Nm
    return (
        state.inertia_torque_Nm
        + proportional_Nm
        + state.gravity_torque_Nm
        + state.friction_torque_Nm
        + state.learned_torque_Nm
        + rest_Nm
    )
