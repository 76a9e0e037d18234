"""Friction feed-forward that adapts to the joint while it moves, whatever the motion: no repetition is needed.

What is fed forward goes with the desired motion, so that it has no noise, and is linear in the weights:

    F = sum_k (wp_k max(b_k, 0) + wn_k min(b_k, 0)) + sum_j (c_j cos(m_j theta) + s_j sin(m_j theta))

b_k is the friction of the model with bristles STIFFNESS[k] times as stiff as configured (`step_lugre`), each direction
with weights of its own; the sines are torque ripple of the motor angle theta.  The bristles as configured begin with
the weight 1 and all others with 0: that is the feed-forward without adaptation.

The disturbance observer (bandwidth L) has d = LP_L(friction - what was fed forward).  With the same low-pass on every
part, now driven by the motion that is measured, d + LP_L(fed forward) = w^T LP_L(parts): a linear regression.  A Kalman
filter solves it every `EVERY` cycles, for weights that drift slowly.  Driven by the desired motion the parts would be
off where bristles give way, by as much as the joint is: soft and stiff ones would be mistaken for each other.

While the desired motion rests nothing adapts, and what friction holds is anything.  The observer, which goes on until
the joint is where it should be, would find that torque, and take it along into the next move as a disturbance.  What it
adds after a move has ended is therefore handed over to the bristles, which hold it until they slide (`take_at_rest`).

Bounded by construction: bristles in parallel, none of them negative, that together have at most `reach` more or less
than the configured friction in either direction, and sines of at most `ripple_max_Nm`.  Not modelled: friction that
depends on the position."""

from __future__ import annotations

from jointctl.firmware_py.flexible_joint import sine_of_turns
from jointctl.firmware_py.friction import UNLOADED, Condition, bend_bristles, sliding_torque_Nm
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import ADAPTED_PARTS, BRISTLES, AdaptationConstants, AdaptationState, LawConstants

STIFFNESS = (0.4, 1.0, 3.0, 30.0)  # of the bristles, times the configured one; the last ones hardly give way
AS_CONFIGURED = 1  # their number
SINES = 2 * BRISTLES  # the first part that is one
MOST = 1.2  # that a kind of bristles may weigh
LEAST_SHARE = 0.5  # of the bristles that take something over
TAKEN_radps = 20.0  # slow: with a reducer that is not rigid, friction moves the desired motor angle as well
EVERY = 10  # cycles between two steps of the regression
STILL_radps = 1e-4  # below this desired speed the parts say nothing
NOISE_Nm = 5.0  # of the regression: what friction and ripple do not explain, and its samples are not independent
DRIFT = 1e-4  # of a weight's first variance, that comes back in each step


@kernel
def first_variance(constants: AdaptationConstants, part: int) -> float:
    """How far a weight may be from what is configured, squared."""
    if part < SINES:
        return constants.friction_error * constants.friction_error
    return constants.ripple_Nm * constants.ripple_Nm


@kernel
def reset_adaptation(constants: AdaptationConstants, state: AdaptationState) -> None:
    """Back to the configured friction."""
    for i in range(ADAPTED_PARTS):
        state.weights[i] = 0.0
        state.filtered_Nm[i] = 0.0
        for j in range(ADAPTED_PARTS):
            state.covariance[i, j] = 0.0
        state.covariance[i, i] = first_variance(constants, i)
    for k in range(BRISTLES):
        state.desired_deflection_rad[k] = 0.0
        state.deflection_rad[k] = 0.0
    for side in range(2):
        state.weights[2 * AS_CONFIGURED + side] = 1.0
    state.fed_filtered_Nm = 0.0
    state.resting = 0
    state.cycle = 0
    state.newest = 0
    for i in range(len(state.fed_Nm)):
        state.fed_Nm[i] = 0.0


@kernel
def adapted_feed_forward_Nm(
    law: LawConstants, state: AdaptationState, position_rad: float, velocity_radps: float,
    condition: Condition = UNLOADED,
) -> float:  # fmt: skip
    """Friction and ripple at the joint [Nm] of the desired motion, `position_rad` that of the motor / n."""
    constants = law.adaptation
    sliding_Nm = 0.0
    if velocity_radps != 0.0:
        sliding_Nm = sliding_torque_Nm(law.friction, law.reduction_ratio, velocity_radps, condition)
    fed = 0.0
    for k in range(BRISTLES):  # all slide at the same torque
        stiffness = STIFFNESS[k] * law.lugre.stiffness_Nmprad
        torque = stiffness * state.desired_deflection_rad[k]
        if velocity_radps != 0.0:
            state.desired_deflection_rad[k], torque = bend_bristles(
                stiffness, law.lugre.damping_Nmspr, state.desired_deflection_rad[k], velocity_radps, sliding_Nm,
                law.period_s,
            )  # fmt: skip
        fed += torque * state.weights[2 * k if torque >= 0.0 else 2 * k + 1]
    for j in range(constants.ripples):
        turns = constants.ripple_turns_prad[j] * position_rad
        fed += state.weights[SINES + 2 * j] * sine_of_turns(turns + 0.25)
        fed += state.weights[SINES + 2 * j + 1] * sine_of_turns(turns)
    return fed


@kernel
def take_at_rest(law: LawConstants, state: AdaptationState, disturbance_Nm: float, desired_radps: float) -> float:
    """What the bristles take over from the observer [Nm]; 0 while the desired motion goes on."""
    if abs(desired_radps) >= STILL_radps:
        state.resting = 0
        return 0.0
    if state.resting == 0:
        state.resting = 1
        state.rest_disturbance_Nm = disturbance_Nm
    wanted_Nm = TAKEN_radps * law.period_s * (disturbance_Nm - state.rest_disturbance_Nm)
    side = 0 if wanted_Nm >= 0.0 else 1
    branch = law.friction.positive if wanted_Nm >= 0.0 else law.friction.negative
    most_Nm = law.reduction_ratio * branch.static_Nm
    total = 0.0
    for k in range(BRISTLES):
        total += state.weights[2 * k + side]
    shift_Nm = wanted_Nm / max(total, LEAST_SHARE)
    taken = 0.0
    for k in range(BRISTLES):
        stiffness = STIFFNESS[k] * law.lugre.stiffness_Nmprad
        before = stiffness * state.desired_deflection_rad[k]
        after = min(max(before + shift_Nm, min(before, -most_Nm)), max(before, most_Nm))
        taken += after * state.weights[2 * k if after >= 0.0 else 2 * k + 1]
        taken -= before * state.weights[2 * k if before >= 0.0 else 2 * k + 1]
        state.desired_deflection_rad[k] = after / stiffness
        state.deflection_rad[k] = after / stiffness
    return taken


@kernel
def fed_before_Nm(law: LawConstants, state: AdaptationState, fed_Nm: float) -> float:
    """What was fed forward `late_cycles` ago, which takes note of what is fed forward now."""
    size = len(state.fed_Nm)
    state.newest = (state.newest + 1) % size
    state.fed_Nm[state.newest] = fed_Nm
    late = min(max(law.adaptation.late_cycles, 0), size - 1)
    return state.fed_Nm[(state.newest - late + size) % size]


@kernel
def adapt(
    law: LawConstants,
    state: AdaptationState,
    explained_Nm: float,
    fed_Nm: float,
    desired_radps: float,
    position_rad: float,
    velocity_radps: float,
    condition: Condition = UNLOADED,
) -> None:
    """Learn from one cycle.

    `explained_Nm` is the observer's disturbance, `fed_Nm` all that was fed forward and that the observer is to leave;
    position and velocity are the measured ones, of the motor / n.
    """
    constants = law.adaptation
    share = law.observer.bandwidth_radps * law.period_s
    sliding_Nm = 0.0
    if velocity_radps != 0.0:
        sliding_Nm = sliding_torque_Nm(law.friction, law.reduction_ratio, velocity_radps, condition)
    for k in range(BRISTLES):  # without damping: of a measured speed it is noise
        stiffness = STIFFNESS[k] * law.lugre.stiffness_Nmprad
        torque = stiffness * state.deflection_rad[k]
        if velocity_radps != 0.0:
            state.deflection_rad[k], torque = bend_bristles(
                stiffness, 0.0, state.deflection_rad[k], velocity_radps, sliding_Nm, law.period_s
            )
        state.filtered_Nm[2 * k] += share * (max(torque, 0.0) - state.filtered_Nm[2 * k])
        state.filtered_Nm[2 * k + 1] += share * (min(torque, 0.0) - state.filtered_Nm[2 * k + 1])
    for j in range(constants.ripples):
        turns = constants.ripple_turns_prad[j] * position_rad
        cosine, sine = SINES + 2 * j, SINES + 2 * j + 1
        state.filtered_Nm[cosine] += share * (sine_of_turns(turns + 0.25) - state.filtered_Nm[cosine])
        state.filtered_Nm[sine] += share * (sine_of_turns(turns) - state.filtered_Nm[sine])
    wanted_Nm = explained_Nm + state.fed_filtered_Nm
    state.fed_filtered_Nm += share * (fed_Nm - state.fed_filtered_Nm)
    state.cycle += 1
    if state.cycle < EVERY:
        return
    state.cycle = 0
    if abs(desired_radps) >= STILL_radps:
        _regress(constants, state, wanted_Nm)
        _bound(constants, state)


@kernel
def _regress(constants: AdaptationConstants, state: AdaptationState, wanted_Nm: float) -> None:
    """One step of the Kalman filter of the weights."""
    used = SINES + 2 * constants.ripples
    size = NOISE_Nm * NOISE_Nm
    error = wanted_Nm
    for i in range(used):
        total = 0.0
        for j in range(used):
            total += state.covariance[i, j] * state.filtered_Nm[j]
        state.gain[i] = total
        size += total * state.filtered_Nm[i]
        error -= state.weights[i] * state.filtered_Nm[i]
    for i in range(used):
        state.weights[i] += state.gain[i] * error / size
        for j in range(used):
            state.covariance[i, j] -= state.gain[i] * state.gain[j] / size
        first = first_variance(constants, i)
        state.covariance[i, i] = min(first, state.covariance[i, i] + DRIFT * first)


@kernel
def _bound(constants: AdaptationConstants, state: AdaptationState) -> None:
    """Every weight back to where it may be."""
    for side in range(2):
        total = 0.0
        for k in range(BRISTLES):
            state.weights[2 * k + side] = min(max(state.weights[2 * k + side], 0.0), MOST)
            total += state.weights[2 * k + side]
        if total > 1.0 + constants.reach:
            for k in range(BRISTLES):
                state.weights[2 * k + side] *= (1.0 + constants.reach) / total
        elif total < 1.0 - constants.reach:
            state.weights[2 * AS_CONFIGURED + side] += 1.0 - constants.reach - total
    for i in range(SINES, ADAPTED_PARTS):
        state.weights[i] = min(max(state.weights[i], -constants.ripple_max_Nm), constants.ripple_max_Nm)
