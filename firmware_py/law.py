"""The control law: PID, adaptive network, iterative learning, and their sums with the disturbance observer.

Those are computed torque, and the law for a joint whose reducer is not rigid (`flexible_joint`)."""

from __future__ import annotations

import math

from jointctl.firmware_py.flexible_joint import (
    Reading,
    SHARE_USED_radps,
    adapt_link_share,
    desired_motor,
    motor_and_link_errors,
    reset_flexible,
    see_motion,
    value_at,
)
from jointctl.firmware_py.friction import (
    Condition,
    STILL_radps,
    adapt,
    adapted_bristles_Nm,
    adapted_feed_forward_Nm,
    compensation_motor_torque_Nm,
    condition_of,
    fed_before_Nm,
    reset_adaptation,
    step_lugre,
    take_at_rest,
    take_unadapted_at_rest,
)
from jointctl.firmware_py.kernel import kernel, plain
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import (
    AVERAGE_s,
    add_to_disturbance,
    applied_torque_Nm,
    known_since_Nm,
    reset_observer,
    step_kalman,
    step_observer,
    torque_at_work_Nm,
)
from jointctl.firmware_py.records import (
    LEARNING_BINS,
    NEURONS,
    LawConstants,
    LawState,
    LearningConstants,
    LearningState,
    NetworkConstants,
    NetworkState,
    VelocityState,
)
from jointctl.firmware_py.states import ControllerKind, Encoders, FeedForward
from jointctl.firmware_py.trajectory import Repetition

# --- PID on the joint's inertia, the honest baseline: no model but J ---
# tau = J (q_d'' - kd e' - kp e - ki int(e) dt)
#
# A triple pole p needs kd = 3 p, kp = 3 p^2, ki = p^3.


@kernel
def integrate_error(integral_rads: float, error_rad: float, period_s: float, limit_rads: float) -> float:
    """Next value of the integral [rad s], held within +-limit (0 = no limit)."""
    moved = integral_rads + error_rad * period_s
    if limit_rads > 0.0:
        return min(max(moved, -limit_rads), limit_rads)
    return moved


# --- The Lyapunov equation P A + A^T P = -Q of (21) for the error dynamics A = [[0, 1], [-kp, -kv]] ---


@kernel
def right_column_of_p(kp: float, kv: float, q1: float, q2: float) -> tuple[float, float]:
    """(P12, P22), all that the adaptation law needs of P; nothing is checked."""
    p12 = q1 / (2.0 * kp)
    return p12, (q2 + 2.0 * p12) / (2.0 * kv)


_right_column_of_p = plain(right_column_of_p)


def solve_lyapunov_p(kp: float, kv: float, q1: float, q2: float) -> tuple[float, float, float]:
    """(P11, P12, P22) for Q = diag(q1, q2), in closed form; kp, kv > 0.

    The off-diagonal and lower right elements give P12 = q1 / (2 kp) and P22 = (q2 + 2 P12) / (2 kv);
    the off-diagonal equation gives P11 = kp P22 + kv P12.
    """
    if not (kp > 0.0 and kv > 0.0):
        raise ValueError(f"kp (={kp:g}) and kv (={kv:g}) must be > 0: the error dynamics would not be stable")
    if not (q1 > 0.0 and q2 > 0.0):
        raise ValueError(f"Q (=diag({q1:g}, {q2:g})) must be positive definite")
    p12, p22 = _right_column_of_p(kp, kv, q1, q2)
    return kp * p22 + kv * p12, p12, p22


# --- The adaptive radial basis function network of (14) and (24) ---
# h_i(x) = exp(-|x - c_i|^2 / (2 b_i^2)),   fhat = w^T h(x),   w' = beta h(x) x^T P B,   x = [e, e']
#
# With the paper's b = 5 and |x| << 1 every h_i lies in [0.9985, 1]: the network is then one integrator, fhat' = (15
# beta / J) (P12 e + P22 e').  Not in the paper, and off at zero: leakage (sigma-modification), projection of the
# weights, a dead zone in the error.


@kernel
def reset_network(constants: NetworkConstants, state: NetworkState) -> None:
    """Set every weight to its initial value."""
    for i in range(NEURONS):
        state.weights[i] = constants.initial_weight
        state.hidden[i] = 0.0


@kernel
def network_torque_Nm(
    constants: NetworkConstants, state: NetworkState, error_rad: float, error_rate_radps: float
) -> float:
    """Hidden layer and output fhat(x) [Nm at the joint] with the present weights."""
    output = 0.0
    for i in range(NEURONS):
        d1 = error_rad - constants.centres[i, 0]
        d2 = error_rate_radps - constants.centres[i, 1]
        state.hidden[i] = math.exp(-(d1 * d1 + d2 * d2) * constants.inverse_width[i])
    for i in range(NEURONS):
        output += state.weights[i] * state.hidden[i]
    return output


@kernel
def adapt_network(
    constants: NetworkConstants, state: NetworkState, error_rad: float, error_rate_radps: float, period_s: float
) -> None:
    """One explicit Euler step of the adaptation law; call it after `network_torque_Nm` of the same x."""
    if abs(error_rad) < constants.dead_zone_rad:
        return
    drive = error_rad * constants.p_b[0] + error_rate_radps * constants.p_b[1]
    gain = constants.learning_rate * drive * period_s
    keep = 1.0 - constants.leakage * period_s
    for i in range(NEURONS):
        state.weights[i] = keep * state.weights[i] + gain * state.hidden[i]
    limit = constants.weight_limit
    if limit > 0.0:
        for i in range(NEURONS):
            state.weights[i] = min(max(state.weights[i], -limit), limit)


# --- Iterative learning for trajectories that repeat: the torque that feedback had to add is fed forward next time ---
# The period is divided into as many bins as it has cycles (at most LEARNING_BINS).  In each bin
#
# u_next = smooth(u + gain (correction, `lead_cycles` later))
#
# where `correction` is what feedback and observer added in this period, plus a term in the error itself: without it
# an error that decays at kp / kv would go unnoticed, because its parts cancel in the feedback.  The lead makes up for
# the delay from command to measured effect.  The smoothing over neighbouring bins has no phase shift: that stretch is
# over. What was learned belongs to the positions of one trajectory: a change of trajectory starts anew.
#
# A loop that learning makes worse gets worse by and by: where the error grows in GROWN repetitions in a row, learning
# fades out over `blend_s` and stays off for the rest of the run.


GROWN = 3  # repetitions in a row with a greater error than before end the learning


@kernel
def reset_learning(state: LearningState) -> None:
    """Forget what was learned; the next call begins a new epoch.  What was switched off stays off."""
    state.epoch = -1
    state.bins = 0
    state.torque_Nm = 0.0


@kernel
def _begin_epoch(state: LearningState, epoch: int, bins: int) -> None:
    state.epoch = epoch
    state.bins = bins
    state.filled = 0
    state.last_bin = -1
    state.weight = 0.0
    state.squares_rad2 = 0.0
    state.samples = 0
    state.error_rad = 0.0
    state.grown = 0


@kernel
def learning_torque_Nm(
    constants: LearningConstants, state: LearningState, epoch: int, period_s: float, local_s: float, cycle_s: float
) -> float:
    """Feed-forward torque [Nm] at the present place in the period; 0 until one whole period has been learned.

    `epoch` changes with the trajectory; `period_s` 0 means that it does not repeat; `local_s` in [0, period_s) is the
    time in the period; `cycle_s` the loop's.  What has been learned comes in over `blend_s`.
    """
    if constants.gain <= 0.0 or period_s <= 0.0:
        state.torque_Nm = 0.0
        state.bins = 0
        return 0.0
    if epoch != state.epoch:
        _begin_epoch(state, epoch, int(min(period_s / cycle_s + 0.5, float(LEARNING_BINS))))
    state.present_bin = min(int(local_s / period_s * state.bins), state.bins - 1)
    if state.stopped != 0:
        state.weight = max(0.0, state.weight - cycle_s / constants.blend_s)
    elif state.filled > state.bins + 2 * constants.half_width + constants.lead_cycles:
        state.weight = min(1.0, state.weight + cycle_s / constants.blend_s)
    state.torque_Nm = state.weight * state.learned_Nm[state.present_bin]
    return state.torque_Nm


@kernel
def watch_learning(constants: LearningConstants, state: LearningState, error_rad: float) -> None:
    """Compare the error of each repetition with that of the one before; call it after `learning_torque_Nm`."""
    if constants.growth <= 0.0 or state.bins == 0 or state.stopped != 0:
        return
    if state.present_bin < state.last_bin:  # a repetition is over
        mean_rad = math.sqrt(state.squares_rad2 / state.samples)
        grows = state.error_rad > 0.0 and state.error_rad * constants.growth < mean_rad
        state.grown = state.grown + 1 if grows else 0
        state.error_rad = mean_rad
        state.squares_rad2 = 0.0
        state.samples = 0
        if state.grown >= GROWN:
            state.stopped = 1
    state.squares_rad2 += error_rad * error_rad
    state.samples += 1


@kernel
def _smooth(state: LearningState, index: int, half_width: int) -> None:
    """Mean of the recorded torque over bins index - half_width .. index + half_width, around the period."""
    total = 0.0
    for offset in range(-half_width, half_width + 1):
        total += state.recorded_Nm[(index + offset + state.bins) % state.bins]
    state.learned_Nm[index] = total / (2 * half_width + 1)


@kernel
def record_correction(constants: LearningConstants, state: LearningState, correction_Nm: float) -> None:
    """Note what feedback and observer added in this cycle; call it after `learning_torque_Nm`."""
    bins = state.bins
    half_width = constants.half_width
    if state.stopped != 0 or bins <= 2 * half_width + constants.lead_cycles + 2:
        return
    index = state.present_bin if state.last_bin < 0 else (state.last_bin + 1) % bins
    state.last_bin = state.present_bin
    # usually one bin; after an overrun the ones in between as well, as far as the smoothing reaches
    for _ in range(half_width + 1):
        target = (index - constants.lead_cycles + bins) % bins
        state.recorded_Nm[target] = state.weight * state.learned_Nm[target] + constants.gain * correction_Nm
        state.filled += 1
        if state.filled > 2 * half_width:
            _smooth(state, (target - half_width + bins) % bins, half_width)
        if index == state.present_bin:
            break
        index = (index + 1) % bins


# --- The control laws: computed torque, friction feed-forward, and one of several ways to deal with the rest ---
# The paper's law (29) is COMPUTED_TORQUE_RBF:
#
# tau = M0 (q_d'' - kv e' - kp e) + C0 q' + G0(q) + n tau_f0 - fhat,   e = q - q_d
#
# COMPUTED_TORQUE leaves fhat away, COMPUTED_TORQUE_OBSERVER replaces it by a disturbance observer, PID by an
# integral. Iterative learning can be added to each.  All torques at the joint; nothing is limited here: the axis
# checks, limits and rate-limits the result.


@kernel
def follow_temperature(constants: LawConstants, state: LawState, at_once: bool) -> None:
    """The temperature for the feed-forward: that of the newest reading, however old it is; none: that of the curve."""
    if constants.friction.conditioned == 0:
        return
    newest_degC = constants.friction.reference_degC
    if constants.temperature.time_ns[0] != 0:
        newest_degC = constants.temperature.degC[0]
    gain = 1.0 if at_once else constants.temperature.gain
    state.temperature_degC += gain * (newest_degC - state.temperature_degC)


@kernel
def reset_law(constants: LawConstants, state: LawState) -> None:
    """Forget everything learned; the joint is at rest."""
    reset_network(constants.network, state.network)
    reset_observer(state.observer, 0.0)
    reset_learning(state.learning)
    state.learning.stopped = 0
    state.temperature_degC = constants.friction.reference_degC
    follow_temperature(constants, state, True)
    reset_flexible(state.flexible)
    reset_adaptation(constants.adaptation, state.adaptation, constants.flexible.link_friction_share)
    state.arm_torque_Nm = 0.0
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
def _condition(constants: LawConstants, state: LawState, transmitted_Nm: float, motor_rad: float) -> Condition:
    load_Nm = transmitted_Nm / constants.reduction_ratio
    return condition_of(constants.friction, load_Nm, state.temperature_degC, motor_rad)


@kernel
def friction_feed_forward_Nm(
    constants: LawConstants,
    state: LawState,
    velocity_radps: float,
    desired_velocity_radps: float,
    transmitted_Nm: float = 0.0,
    motor_rad: float = 0.0,
) -> float:
    """n tau_f0 at the joint [Nm] by the configured rule; `transmitted_Nm` through the reducer by the model.

    `motor_rad`: desired angle of the motor / n.
    """
    if constants.feed_forward == FeedForward.NONE:
        return 0.0
    condition = _condition(constants, state, transmitted_Nm, motor_rad)
    if constants.feed_forward == FeedForward.LUGRE_DESIRED:
        deflection, torque = step_lugre(
            constants.lugre,
            constants.friction,
            constants.reduction_ratio,
            state.lugre_deflection_rad,
            desired_velocity_radps,
            constants.period_s,
            condition,
        )
        state.lugre_deflection_rad = deflection
        return torque
    speed = velocity_radps if constants.feed_forward == FeedForward.MEASURED else desired_velocity_radps
    return constants.reduction_ratio * compensation_motor_torque_Nm(
        constants.friction, constants.zero_rule, constants.zero_band_radps, speed, condition
    )


@kernel
def _friction_Nm(
    constants: LawConstants, state: LawState, velocity_radps: float, desired_radps: float, ahead_rad: float,
    transmitted_Nm: float,
) -> float:  # fmt: skip
    """The same, perhaps adapted, for the motion of the motor / n that is fed forward."""
    if constants.adaptation.enabled != 0:
        condition = _condition(constants, state, transmitted_Nm, ahead_rad)
        return adapted_feed_forward_Nm(constants, state.adaptation, ahead_rad, desired_radps, condition)
    return friction_feed_forward_Nm(constants, state, velocity_radps, desired_radps, transmitted_Nm, ahead_rad)


@kernel
def _adapt(
    constants: LawConstants, state: LawState, desired_radps: float, position_rad: float, error_rad: float,
    error_rate_radps: float, transmitted_Nm: float,
) -> None:  # fmt: skip
    """Adapt the friction to what the observer has found; at rest, give it what the observer has added."""
    taken_Nm = take_at_rest(constants, state.adaptation, state.observer_torque_Nm, desired_radps, error_rad)
    _take_over(constants, state, taken_Nm)
    fed_Nm = fed_before_Nm(constants, state.adaptation, state.friction_torque_Nm + state.learned_torque_Nm)
    seen, seen_Nm = state.adaptation, state.observer_torque_Nm
    if seen.seen_motor.primed != 0:
        seen.seen_fed_Nm += constants.adaptation.seen.period_gain * (fed_Nm - seen.seen_fed_Nm)
        seen_Nm, fed_Nm = seen.seen_disturbance_Nm, seen.seen_fed_Nm
    adapt(
        constants, state.adaptation, seen_Nm, fed_Nm, desired_radps, position_rad,
        desired_radps + error_rate_radps, _condition(constants, state, transmitted_Nm, position_rad),
    )  # fmt: skip


@kernel
def _take_over(constants: LawConstants, state: LawState, taken_Nm: float) -> None:
    """From the observer to what is fed forward."""
    state.friction_torque_Nm += taken_Nm
    add_to_disturbance(constants.observer, state.observer, -taken_Nm)
    state.observer_torque_Nm = state.observer.disturbance_Nm


@kernel
def _rest_unadapted(constants: LawConstants, state: LawState, desired_radps: float, error_rad: float) -> None:
    """At rest, give the friction that is fed forward what the observer has added, without adaptation."""
    if constants.feed_forward != FeedForward.LUGRE_DESIRED or constants.observer.bandwidth_radps <= 0.0:
        return
    state.lugre_deflection_rad, taken_Nm = take_unadapted_at_rest(
        constants, state.adaptation, state.lugre_deflection_rad, state.observer_torque_Nm, desired_radps, error_rad
    )
    _take_over(constants, state, taken_Nm)


@kernel
def _learn(constants: LawConstants, state: LawState, where: Repetition, correction_Nm: float, error: float) -> float:
    """Torque from iterative learning [Nm]; what it stops adding at a change is handed to the observer."""
    before_Nm = state.learned_torque_Nm
    epoch_before = state.learning.epoch
    torque = learning_torque_Nm(
        constants.learning, state.learning, where.epoch, where.period_s, where.local_s, constants.period_s
    )
    watch_learning(constants.learning, state.learning, error)
    record_correction(constants.learning, state.learning, correction_Nm)
    if epoch_before != state.learning.epoch or where.period_s == 0.0:
        add_to_disturbance(constants.observer, state.observer, before_Nm)
        state.adaptation.rest_disturbance_Nm += before_Nm
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
    if constants.observer.kalman != 0:
        state.observer_torque_Nm = state.observer.disturbance_Nm
        return state.observer_torque_Nm
    if constants.kind == ControllerKind.COMPUTED_TORQUE_OBSERVER:
        known = state.friction_torque_Nm + state.gravity_torque_Nm + state.learned_torque_Nm
        momentum = constants.inertia_kgm2 * velocity_radps
        if constants.observer.paired != 0:
            momentum = constants.inertia_kgm2 * error_rate
            sent_Nm -= state.observer.known_torque_Nm
            known = known_since_Nm(constants.observer, state.observer, known)
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
    where: Repetition,
) -> float:
    """One cycle: the unlimited torque at the joint [Nm]; what adapts, adapts afterwards.

    `sent_torque_Nm` is the limited torque of the cycle before, `where` the place in a repeating trajectory.
    """
    if constants.kind == ControllerKind.OUTSIDE:
        return state.outside_torque_Nm
    error = position_rad - reference.position_rad + state.adaptation.behind_rad
    velocity_radps = velocity.velocity_radps
    if constants.observer.kalman != 0:
        observer = state.observer
        applied_Nm = applied_torque_Nm(constants.observer, observer, sent_torque_Nm - observer.known_torque_Nm)
        step_kalman(constants.observer, observer, applied_Nm, error, constants.inertia_kgm2, constants.period_s)
        error, error_rate = observer.error_rad, observer.error_rate_radps
        velocity_radps = reference.velocity_radps + error_rate
    elif constants.filtered_error_rate != 0:
        error_rate = velocity.error_rate_radps
    else:
        error_rate = velocity.velocity_radps - reference.velocity_radps
    lead_s = constants.feed_forward_lead_s
    ahead_radps2 = reference.acceleration_radps2 + lead_s * reference.jerk_radps3
    state.inertia_torque_Nm = constants.inertia_kgm2 * ahead_radps2
    proportional_Nm = -constants.inertia_kgm2 * (constants.kv * error_rate + constants.kp * error)
    state.feedback_torque_Nm = proportional_Nm
    if constants.of_arm != 0:
        state.gravity_torque_Nm = state.arm_torque_Nm
    else:
        state.gravity_torque_Nm = constants.coriolis_Nmspr * velocity_radps + constants.gravity_Nm * math.sin(
            position_rad - constants.gravity_zero_rad
        )
    transmitted_Nm = state.inertia_torque_Nm + state.gravity_torque_Nm
    ahead_rad = reference.position_rad + lead_s * reference.velocity_radps
    ahead_radps = reference.velocity_radps + lead_s * reference.acceleration_radps2
    state.friction_torque_Nm = _friction_Nm(constants, state, velocity_radps, ahead_radps, ahead_rad, transmitted_Nm)
    state.friction_torque_Nm -= value_at(constants.flexible.torque_ripple, ahead_rad)
    faster_radps = abs(reference.velocity_radps) - state.observer.speed_radps
    state.observer.speed_radps += constants.period_s / AVERAGE_s * faster_radps
    rest_Nm = _rest_torque_Nm(constants, state, error, error_rate, velocity_radps, sent_torque_Nm)
    if constants.adaptation.enabled != 0:
        _adapt(constants, state, reference.velocity_radps, position_rad, error, error_rate, transmitted_Nm)
        rest_Nm = state.observer_torque_Nm
    elif constants.kind == ControllerKind.COMPUTED_TORQUE_OBSERVER:
        _rest_unadapted(constants, state, reference.velocity_radps, error)
        rest_Nm = state.observer_torque_Nm
    correction_Nm = proportional_Nm + rest_Nm - constants.inertia_kgm2 * constants.learning.error_gain_ps2 * error
    state.learned_torque_Nm = _learn(constants, state, where, correction_Nm, error)
    if constants.kind == ControllerKind.COMPUTED_TORQUE_OBSERVER:
        rest_Nm = state.observer_torque_Nm
    known_Nm = state.inertia_torque_Nm + state.gravity_torque_Nm + state.friction_torque_Nm + state.learned_torque_Nm
    state.observer.known_torque_Nm = known_Nm
    return (
        state.inertia_torque_Nm
        + proportional_Nm
        + state.gravity_torque_Nm
        + state.friction_torque_Nm
        + state.learned_torque_Nm
        + rest_Nm
    )


# --- The law for a joint whose reducer is not rigid; see `flexible_joint` for the equations ---


@kernel
def _link_friction(constants: LawConstants, state: LawState, link_radps: float, condition: Condition) -> None:
    """That share of the friction which the reducer transmits, of the motion that is fed forward."""
    own, share = state.flexible, constants.flexible.link_friction_share
    own.whole_friction_Nm = state.friction_torque_Nm
    if constants.adaptation.enabled != 0:
        seen = state.adaptation
        seen.used_link_share += SHARE_USED_radps * constants.period_s * (seen.link_share - seen.used_link_share)
        share = seen.used_link_share
        own.whole_friction_Nm = adapted_bristles_Nm(constants, seen, seen.link_deflection_rad, link_radps, condition)
    elif constants.feed_forward == FeedForward.LUGRE_DESIRED:
        own.link_deflection_rad, own.whole_friction_Nm = step_lugre(
            constants.lugre, constants.friction, constants.reduction_ratio, own.link_deflection_rad, link_radps,
            constants.period_s, condition,
        )  # fmt: skip
    own.link_friction_Nm = share * own.whole_friction_Nm


@kernel
def step_flexible_law(
    constants: LawConstants,
    state: LawState,
    reading: Reading,
    reference: Reference,
    sent_torque_Nm: float,
    where: Repetition,
) -> float:
    """One cycle, as `step_law`: the unlimited torque at the joint [Nm]."""
    flexible, own = constants.flexible, state.flexible
    gravity_slope_Nmprad = 0.0
    state.gravity_torque_Nm = 0.0
    if constants.of_arm != 0:
        state.gravity_torque_Nm = state.arm_torque_Nm
    elif constants.gravity_Nm != 0.0:
        ahead_rad = reference.position_rad + constants.feed_forward_lead_s * reference.velocity_radps
        lever = ahead_rad - constants.gravity_zero_rad
        state.gravity_torque_Nm = constants.gravity_Nm * math.sin(lever)
        gravity_slope_Nmprad = constants.gravity_Nm * math.cos(lever)
    transmitted_Nm = flexible.link_inertia_kgm2 * reference.acceleration_radps2 + state.gravity_torque_Nm
    ahead_radps = reference.velocity_radps + constants.feed_forward_lead_s * reference.acceleration_radps2
    motor_rad, motor_radps = reference.position_rad, ahead_radps
    if own.primed != 0:
        motor_rad = own.motor_rad + constants.period_s * reference.velocity_radps
        if constants.feed_forward == FeedForward.LUGRE_DESIRED:  # its bristles bend by as little as the reducer twists
            motor_radps = own.ahead_radps
    state.friction_torque_Nm = _friction_Nm(constants, state, 0.0, motor_radps, motor_rad, transmitted_Nm)
    _link_friction(constants, state, ahead_radps, _condition(constants, state, transmitted_Nm, motor_rad))
    known_Nm = desired_motor(constants, state, reference, gravity_slope_Nmprad)
    state.inertia_torque_Nm = known_Nm - state.friction_torque_Nm - state.gravity_torque_Nm
    motor_rad, link_rad = motor_and_link_errors(flexible, own, reading, reference.position_rad)
    rate_radps = own.motor_velocity.error_rate_radps
    momentum = flexible.motor_inertia_kgm2 * rate_radps
    momentum += flexible.link_inertia_kgm2 * own.link_velocity.error_rate_radps
    sent_torque_Nm -= state.observer.known_torque_Nm
    state.observer_torque_Nm = step_observer(
        constants.observer, state.observer, sent_torque_Nm, 0.0, momentum, constants.period_s
    )
    if constants.adaptation.enabled != 0:
        known_Nm -= state.friction_torque_Nm
        moving_radps = own.target_radps if reference.velocity_radps != 0.0 else 0.0
        rate_seen_radps = rate_radps
        if flexible.encoders == Encoders.BOTH:
            seen, at_work_Nm = state.adaptation, torque_at_work_Nm(constants.observer, state.observer)
            see_motion(constants, seen, at_work_Nm, motor_rad, link_rad, reading.gap_cycles)
            rate_seen_radps = seen.seen_motor.error_rate_radps
            if reading.gap_cycles > 0 and seen.cycle == 0 and abs(moving_radps) >= STILL_radps:
                adapt_link_share(flexible, seen, own.friction_twist_rad, link_rad - motor_rad)
        read_rad = own.target_rad + motor_rad
        _adapt(constants, state, moving_radps, read_rad, motor_rad, rate_seen_radps, transmitted_Nm)
        known_Nm += state.friction_torque_Nm
    else:
        known_Nm -= state.friction_torque_Nm
        _rest_unadapted(constants, state, own.target_radps if reference.velocity_radps != 0.0 else 0.0, motor_rad)
        known_Nm += state.friction_torque_Nm
    state.feedback_torque_Nm = -constants.inertia_kgm2 * (
        constants.kp * (motor_rad + own.twist_error_rad) + constants.kv * rate_radps
    )
    correction_Nm = state.feedback_torque_Nm + state.observer_torque_Nm
    correction_Nm -= constants.inertia_kgm2 * constants.learning.error_gain_ps2 * link_rad
    state.learned_torque_Nm = _learn(constants, state, where, correction_Nm, link_rad)
    state.observer.known_torque_Nm = known_Nm + state.learned_torque_Nm
    return state.observer.known_torque_Nm + state.feedback_torque_Nm + state.observer_torque_Nm
