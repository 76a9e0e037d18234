"""Multi-stage friction model (11): Stribeck near zero speed, a cubic polynomial beyond the knee.

Torque is that at the MOTOR, speed that of the JOINT in rad/s; the joint feels `reduction_ratio` times the torque.
Each direction is stored mirrored (positive speed, positive friction), so that one expression serves both:

    u = |v| <= knee :  tc + (ts - tc) exp(-u / ws) + tv u
    u > knee        :  a0 + a1 u + a2 u^2 + a3 u^3
    u > maximum     :  value and slope at the maximum are held (the data end there, so extrapolation is a guess)

(11) prints the exponent of the negative direction as -v/ws, which diverges; mirrored it is -|v|/ws.
The two stages need not meet at the knee (Table 3 has steps of 0.0017 and 0.0013 Nm).

With a load and a temperature, C = tc + (ts - tc) exp(-u / ws) and V = the rest of (11) at that speed:

    (C + kc |tau|) exp(-bc (T - T0)) + (V + kv |tau| u) exp(-bv (T - T0))

tau is the torque that the reducer transmits, T the drive's temperature.  Friction that goes with |tau| always opposes
the motion, as in the load-dependent models of Rhoban's BAM; the exponential is that of a lubricant's viscosity.  All of
it is times 1 + sum a_k sin(o_k theta + phi_k), theta the motor's angle / n: what tooth and wave generator do at each
turn, with the direction of the motion.  A torque that goes with the angle alone is no friction: `[ripple]`.

Not modelled: friction that differs between driving and being driven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.flexible_joint import (
    SHARE_VARIANCE,
    OFFSET_VARIANCE_rad2,
    SEEN_radps,
    sine_of_turns,
    value_at,
)
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.records import (
    ADAPTED_PARTS,
    BRISTLES,
    AdaptationConstants,
    AdaptationState,
    FrictionBranch,
    FrictionConstants,
    LawConstants,
    LuGreConstants,
)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, ZeroSpeedRule

DEGREE = math.pi / 180.0


@inlined
def branch_torque_Nm(branch: FrictionBranch, speed_radps: float) -> float:
    """Friction of one direction at the motor [Nm] for a speed >= 0; at 0 it is the static friction."""
    if speed_radps <= branch.knee_radps:
        decay = math.exp(-speed_radps / branch.stribeck_speed_radps)
        return branch.coulomb_Nm + (branch.static_Nm - branch.coulomb_Nm) * decay + branch.viscous_Nmspr * speed_radps
    a = branch.cubic
    u = min(speed_radps, branch.max_radps)
    torque = a[0] + u * (a[1] + u * (a[2] + u * a[3]))
    if speed_radps > branch.max_radps:
        torque += (speed_radps - u) * (a[1] + u * (2.0 * a[2] + 3.0 * u * a[3]))
    return torque


class Condition(NamedTuple):
    """What friction depends on besides the speed."""

    load_Nm: float  # size of the torque that the reducer transmits, at the motor: that at the joint over the ratio
    coulomb: float  # factors of temperature and angle
    viscous: float


UNLOADED = Condition(0.0, 1.0, 1.0)  # and at the temperature for which the curve holds


@kernel
def condition_of(
    friction: FrictionConstants, load_Nm: float, temperature_degC: float, motor_rad: float = 0.0
) -> Condition:
    """`load_Nm`: the torque that the reducer transmits, at the motor, of any sign; `motor_rad`: its angle / n."""
    if friction.conditioned == 0:
        return Condition(0.0, 1.0, 1.0)
    warming_K = min(max(temperature_degC, friction.lowest_degC), friction.highest_degC) - friction.reference_degC
    coulomb = math.exp(-friction.temperature_coulomb_pK * warming_K)
    viscous = math.exp(-friction.temperature_viscous_pK * warming_K)
    of_angle = 1.0 + value_at(friction.of_angle, motor_rad)
    return Condition(abs(load_Nm), coulomb * of_angle, viscous * of_angle)


@inlined
def conditioned_torque_Nm(
    friction: FrictionConstants, branch: FrictionBranch, speed_radps: float, condition: Condition
) -> float:
    """`branch_torque_Nm` of one direction under load and at a temperature."""
    torque = branch_torque_Nm(branch, speed_radps)
    if friction.conditioned == 0:
        return torque
    decay = math.exp(-speed_radps / branch.stribeck_speed_radps)
    coulomb = branch.coulomb_Nm + (branch.static_Nm - branch.coulomb_Nm) * decay
    viscous = torque - coulomb + friction.load_viscous_spr * condition.load_Nm * speed_radps
    return (coulomb + friction.load_coulomb * condition.load_Nm) * condition.coulomb + viscous * condition.viscous


@inlined
def friction_motor_torque_Nm(
    friction: FrictionConstants, velocity_radps: float, condition: Condition = UNLOADED
) -> float:
    """Friction at the motor [Nm], opposing the motion and counted positive for positive velocity; 0 at v = 0."""
    if velocity_radps > 0.0:
        return conditioned_torque_Nm(friction, friction.positive, velocity_radps, condition)
    if velocity_radps < 0.0:
        return -conditioned_torque_Nm(friction, friction.negative, -velocity_radps, condition)
    return 0.0


@kernel
def compensation_motor_torque_Nm(
    friction: FrictionConstants,
    zero_rule: int,
    zero_band_radps: float,
    velocity_radps: float,
    condition: Condition = UNLOADED,
) -> float:
    """Feed-forward friction torque at the motor [Nm] with an explicit rule at v = 0, where friction is set-valued.

    PAPER gives +static friction at exactly zero; LINEAR draws a line through zero inside +-zero_band_radps.
    """
    if zero_rule == ZeroSpeedRule.LINEAR and abs(velocity_radps) < zero_band_radps:
        edge = math.copysign(zero_band_radps, velocity_radps)
        return friction_motor_torque_Nm(friction, edge, condition) * abs(velocity_radps) / zero_band_radps
    if zero_rule == ZeroSpeedRule.PAPER and velocity_radps == 0.0:
        return conditioned_torque_Nm(friction, friction.positive, 0.0, condition)
    return friction_motor_torque_Nm(friction, velocity_radps, condition)


class PrintedBranch(NamedTuple):
    """One direction in the numbers of (11), in any units."""

    tc: float
    ts: float
    ws: float
    tv: float
    cubic: Sequence[float]  # (a0, a1, a2, a3) with the signs of (11)
    knee: float  # may carry the sign of the direction, as `maximum`
    maximum: float


def branch_constants(
    printed: PrintedBranch, *, negative: bool, radps_per_unit: float, torque_scale: float = 1.0
) -> Any:
    """A `FrictionBranch` record.

    Speeds are in a unit of `radps_per_unit` rad/s of the joint; `torque_scale` turns the given torque into motor Nm.
    """
    tc, ts, ws, tv, cubic, knee, maximum = printed
    branch = new(FrictionBranch)[0]
    mirror = (-1.0, 1.0, -1.0, 1.0) if negative else (1.0, 1.0, 1.0, 1.0)
    branch.coulomb_Nm = tc * torque_scale
    branch.static_Nm = ts * torque_scale
    branch.stribeck_speed_radps = ws * radps_per_unit
    branch.viscous_Nmspr = tv * torque_scale / radps_per_unit
    for power in range(4):
        branch.cubic[power] = mirror[power] * cubic[power] * torque_scale / radps_per_unit**power
    branch.knee_radps = abs(knee) * radps_per_unit
    branch.max_radps = abs(maximum) * radps_per_unit
    return branch


def friction_constants(positive: FrictionBranch, negative: FrictionBranch) -> Any:
    """A `FrictionConstants` record array of one record from two branches."""
    constants = new(FrictionConstants)
    constants[0].positive = positive
    constants[0].negative = negative
    return constants


def paper_friction() -> Any:
    """Table 3 of the paper: speed in deg/s of the joint, torque at the motor."""
    positive = branch_constants(
        PrintedBranch(0.11985, 0.14537, 1.2301, 0.0026518, (0.17995, 0.0012298, -6.5261e-7, -7.6969e-9), 40.0, 200.0),
        negative=False, radps_per_unit=DEGREE,
    )  # fmt: skip
    negative = branch_constants(
        PrintedBranch(0.1063, 0.1575, 2.887, 0.002475, (-0.1272, 0.0022866, 1e-5, 2.1182e-8), -40.0, -200.0),
        negative=True, radps_per_unit=DEGREE,
    )  # fmt: skip
    return friction_constants(positive, negative)


def friction_curve_Nm(constants: np.ndarray, velocity_radps: np.ndarray) -> np.ndarray:
    """(11) at many velocities; arrays of shape (N,)."""
    friction = constants[0]
    return np.array([friction_motor_torque_Nm(friction, float(v)) for v in velocity_radps])


# --- LuGre friction driven by a given velocity, for compensation: bristle deflection z [rad] at the joint ---
# z' = v - sigma0 |v| / g(v) z,     tau = sigma0 z + sigma1 z' + (viscous part)
#
# g(v) is the whole sliding curve n tau_f(v) of (11), viscous part included, so that the steady state is exactly (11)
# and no separate viscous term is added.  z is updated by the exact solution over one period at constant v, which is
# stable for any stiffness and period.


@inlined
def sliding_torque_Nm(
    friction: FrictionConstants, reduction_ratio: float, velocity_radps: float, condition: Condition
) -> float:
    """g(v) at the joint [Nm], for a speed other than 0."""
    branch = friction.positive if velocity_radps > 0.0 else friction.negative
    return reduction_ratio * conditioned_torque_Nm(friction, branch, abs(velocity_radps), condition)


@inlined
def bend_bristles(
    stiffness_Nmprad: float, damping_Nmspr: float, deflection_rad: float, velocity_radps: float, sliding_Nm: float,
    period_s: float,
) -> tuple[float, float]:  # fmt: skip
    """(new deflection [rad], friction torque at the joint [Nm]) after `period_s` at this velocity, other than 0."""
    settled_rad = math.copysign(sliding_Nm / stiffness_Nmprad, velocity_radps)
    decay = math.exp(-abs(velocity_radps) * period_s * stiffness_Nmprad / sliding_Nm)
    moved_rad = settled_rad + (deflection_rad - settled_rad) * decay
    rate_radps = (moved_rad - deflection_rad) / period_s
    return moved_rad, stiffness_Nmprad * moved_rad + damping_Nmspr * rate_radps


@kernel
def step_lugre(
    lugre: LuGreConstants,
    friction: FrictionConstants,
    reduction_ratio: float,
    deflection_rad: float,
    velocity_radps: float,
    period_s: float,
    condition: Condition = UNLOADED,
) -> tuple[float, float]:
    """(new deflection [rad], friction torque at the joint [Nm]) after `period_s` at `velocity_radps`."""
    if velocity_radps == 0.0:
        return deflection_rad, lugre.stiffness_Nmprad * deflection_rad
    sliding_Nm = sliding_torque_Nm(friction, reduction_ratio, velocity_radps, condition)
    return bend_bristles(
        lugre.stiffness_Nmprad, lugre.damping_Nmspr, deflection_rad, velocity_radps, sliding_Nm, period_s
    )


# --- Feed-forward that adapts to the joint while it moves, whatever the motion: no repetition is needed ---
# What is fed forward goes with the desired motion, so that it has no noise, and is linear in the weights:
#
#     F = sum_k (wp_k max(b_k, 0) + wn_k min(b_k, 0)) + sum_j (c_j cos(m_j theta) + s_j sin(m_j theta))
#
# b_k is the friction of the model with bristles STIFFNESS[k] times as stiff as configured (`step_lugre`), each
# direction with weights of its own; the sines are torque ripple of the motor angle theta.  The bristles as configured
# begin with the weight 1 and all others with 0: that is the feed-forward without adaptation.
#
# The disturbance observer (bandwidth L) has d = LP_L(friction - what was fed forward).  With the same low-pass on
# every part, now driven by the motion that is measured, d + LP_L(fed forward) = w^T LP_L(parts): a linear regression.
# Of a joint that is not rigid, d is that of an observer of its own (`flexible_joint.see_motion`).
# A Kalman filter solves it every `EVERY` cycles, for weights that drift slowly.  Driven by the desired motion the
# parts would be off where bristles give way, by as much as the joint is: soft and stiff ones would be mistaken for
# each other.
#
# While the desired motion rests nothing adapts, and what friction holds is anything.  The observer, which goes on
# until the joint is where it should be, would find that torque, and take it along into the next move as a disturbance.
# What it adds after a move has ended is therefore handed over to the bristles, which hold it until they slide
# (`take_at_rest`; without adaptation `take_unadapted_at_rest`, the same with the bristles as configured).
#
# Where a move has ended the bristles are near their limit, and creep on in its direction with every count of the
# encoder and every Nm that is fed forward too much.  They have to be let go: by as much as the joint is seen to go on,
# and of a joint that is not rigid, whose gains are too low to hold it, by half at once.  They spring back by what they
# were let go of, over their stiffness as it was found (`_share_kept`).  There the joint is a spring, and for a moment
# an integrator of that stiffness takes a rigid one back; for longer it would swing between two counts.  An adapting law
# holds it `BEHIND` of a count behind its place, away from the edge that it would creep over, and from there lets go by
# `UNSEEN` of a count less than it is seen to go on: where a count begins to show, it has only come over the edge.
# Of a joint that is not rigid the observer is slow as well: what it has found on arrival is mostly friction of this
# direction.  It keeps the mean of both directions, which is a load.
#
# Bounded by construction: bristles in parallel, none of them negative, that together have at most `reach` more or less
# than the configured friction in either direction, and sines of at most `ripple_max_Nm`.  Not modelled: friction that
# depends on the position.


STIFFNESS = (0.4, 1.0, 3.0, 30.0)  # of the bristles, times the configured one; the last ones hardly give way
AS_CONFIGURED = 1  # their number
SINES = 2 * BRISTLES  # the first part that is one
MOST = 1.2  # that a kind of bristles may weigh
LEAST_SHARE = 0.5  # of the bristles that take something over
TAKEN_radps = 20.0  # slow: with a reducer that is not rigid, friction moves the desired motor angle as well
LET_GO = 2.0  # by how many times their stiffness the bristles give way to a joint that goes on
LET_GO_s = 0.01  # not at once, or the joint, a spring there, would swing back too far
BACK_radps, BACK_s = 30.0, 0.08  # a rigid one goes back, for this time
UNSEEN = 0.4  # counts that it seems to go on where it has only come over an edge
BEHIND = 0.2  # counts by which it is held behind its place, since it creeps on and never back
TURNING_CYCLES = 4  # a motion that turns back rests for one
MOST_LET_GO, MOST_HELD = 0.8, 0.95  # of what they held when the motion came to rest
AT_ONCE, AT_ONCE_s = 0.5, 0.03  # of a joint that is not rigid, in this time
AVERAGED_s = 1.0  # of the observer's torque in one direction
LEAST_MOVED_s = 0.3  # in each direction, before their mean counts
EVERY = 10  # cycles between two steps of the regression
STILL_radps = 1e-4  # below this desired speed the parts say nothing
DRIFT = 1e-4  # of a weight's first variance, that comes back in each step


@kernel
def first_variance(constants: AdaptationConstants, part: int) -> float:
    """How far a weight may be from what is configured, squared."""
    if part < SINES:
        return constants.friction_error * constants.friction_error
    return constants.ripple_Nm * constants.ripple_Nm


@kernel
def reset_adaptation(constants: AdaptationConstants, state: AdaptationState, link_share: float) -> None:
    """Back to the configured friction, of which the link has this share."""
    for i in range(ADAPTED_PARTS):
        state.weights[i] = 0.0
        state.filtered_Nm[i] = 0.0
        for j in range(ADAPTED_PARTS):
            state.covariance[i, j] = 0.0
        state.covariance[i, i] = first_variance(constants, i)
    for k in range(BRISTLES):
        state.desired_deflection_rad[k] = 0.0
        state.deflection_rad[k] = 0.0
        state.link_deflection_rad[k] = 0.0
    for side in range(2):
        state.weights[2 * AS_CONFIGURED + side] = 1.0
    state.fed_filtered_Nm = 0.0
    state.seen_motor.primed = state.seen_link.primed = 0
    state.seen_fed_Nm = 0.0
    state.link_share = state.used_link_share = link_share
    for side in range(2):
        state.mean_disturbance_Nm[side] = state.moved_s[side] = 0.0
    state.twist_offset_rad = 0.0
    state.twist_covariance[0, 0], state.twist_covariance[1, 1] = OFFSET_VARIANCE_rad2, SHARE_VARIANCE
    state.twist_covariance[0, 1] = state.twist_covariance[1, 0] = 0.0
    state.resting = 0
    state.behind_rad = 0.0
    state.cycle = 0
    state.newest = 0
    for i in range(len(state.fed_Nm)):
        state.fed_Nm[i] = 0.0


@kernel
def adapted_bristles_Nm(
    law: LawConstants, state: AdaptationState, deflections_rad: np.ndarray, velocity_radps: float,
    condition: Condition = UNLOADED,
) -> float:  # fmt: skip
    """Friction at the joint [Nm] after a cycle at the desired speed; moves its bristles, shape (BRISTLES,)."""
    sliding_Nm = 0.0
    if velocity_radps != 0.0:
        sliding_Nm = sliding_torque_Nm(law.friction, law.reduction_ratio, velocity_radps, condition)
    fed = 0.0
    for k in range(BRISTLES):  # all slide at the same torque
        stiffness = STIFFNESS[k] * law.lugre.stiffness_Nmprad
        torque = stiffness * deflections_rad[k]
        if velocity_radps != 0.0:
            deflections_rad[k], torque = bend_bristles(
                stiffness, law.lugre.damping_Nmspr, deflections_rad[k], velocity_radps, sliding_Nm, law.period_s
            )
        fed += torque * state.weights[2 * k if torque >= 0.0 else 2 * k + 1]
    return fed


@kernel
def adapted_feed_forward_Nm(
    law: LawConstants, state: AdaptationState, position_rad: float, velocity_radps: float,
    condition: Condition = UNLOADED,
) -> float:  # fmt: skip
    """Friction and ripple at the joint [Nm] of the desired motion, `position_rad` that of the motor / n."""
    constants = law.adaptation
    fed = adapted_bristles_Nm(law, state, state.desired_deflection_rad, velocity_radps, condition)
    for j in range(constants.ripples):
        turns = constants.ripple_turns_prad[j] * position_rad
        fed += state.weights[SINES + 2 * j] * sine_of_turns(turns + 0.25)
        fed += state.weights[SINES + 2 * j + 1] * sine_of_turns(turns)
    return fed


@kernel
def _held_Nm(law: LawConstants, state: AdaptationState) -> float:
    """What the bristles of the desired motion hold."""
    held = 0.0
    for k in range(BRISTLES):
        torque = STIFFNESS[k] * law.lugre.stiffness_Nmprad * state.desired_deflection_rad[k]
        held += torque * state.weights[2 * k if torque >= 0.0 else 2 * k + 1]
    return held


@kernel
def _share_kept(
    law: LawConstants, state: AdaptationState, held_Nm: float, stiffness_Nmprad: float, error_rad: float
) -> float:
    """How much of what the bristles hold they keep where the joint goes on after the move; above 1 takes it back.

    They keep at least 1 - `MOST_LET_GO` of what they held when it came to rest, and get no more than `MOST_HELD` of it.
    """
    size, began = abs(held_Nm), abs(state.rest_friction_Nm)
    if held_Nm * state.rest_friction_Nm <= 0.0:
        return 1.0
    along_rad = math.copysign(error_rad, error_rad * held_Nm)
    rested_s = (state.resting - TURNING_CYCLES) * law.period_s
    if along_rad > state.rest_error_rad:
        state.to_let_go_Nm += LET_GO * stiffness_Nmprad * (along_rad - state.rest_error_rad)
        state.rest_error_rad = along_rad
    wanted_Nm = min(law.period_s / LET_GO_s, 1.0) * state.to_let_go_Nm
    state.to_let_go_Nm -= wanted_Nm
    if law.kind == ControllerKind.FLEXIBLE_JOINT:
        if rested_s <= AT_ONCE_s:
            wanted_Nm += AT_ONCE * began * law.period_s / AT_ONCE_s
    elif rested_s <= BACK_s:
        wanted_Nm += BACK_radps * law.period_s * stiffness_Nmprad * along_rad
    left = max(size - wanted_Nm, min(size, (1.0 - MOST_LET_GO) * began))
    return min(left, max(size, MOST_HELD * began)) / size


@kernel
def _comes_to_rest(
    law: LawConstants, state: AdaptationState, held_Nm: float, disturbance_Nm: float, desired_radps: float,
    error_rad: float,
) -> bool:  # fmt: skip
    """Whether a motion has ended, for longer than it takes to turn back; notes how it was where it ended.

    Before the first one, what the observer finds is a load.
    """
    if abs(desired_radps) >= STILL_radps:
        state.resting = 0
        state.behind_rad = 0.0
        side = 0 if desired_radps > 0.0 else 1
        state.moved_s[side] = min(state.moved_s[side] + law.period_s, AVERAGED_s)
        newer_Nm = disturbance_Nm - state.mean_disturbance_Nm[side]
        state.mean_disturbance_Nm[side] += law.period_s / state.moved_s[side] * newer_Nm
        return False
    if state.resting == 0:
        state.rest_disturbance_Nm = disturbance_Nm
        if law.kind == ControllerKind.FLEXIBLE_JOINT and min(state.moved_s[0], state.moved_s[1]) > LEAST_MOVED_s:
            state.rest_disturbance_Nm = 0.5 * (state.mean_disturbance_Nm[0] + state.mean_disturbance_Nm[1])
        state.rest_friction_Nm, state.to_let_go_Nm = held_Nm, 0.0
        state.rest_error_rad = (
            max(math.copysign(error_rad, error_rad * held_Nm), 0.0) + UNSEEN * law.adaptation.count_rad
        )
    if (state.resting - TURNING_CYCLES) * law.period_s <= BACK_s:
        state.resting += 1
    rests = state.resting > TURNING_CYCLES and state.moved_s[0] + state.moved_s[1] > 0.0
    if rests and state.rest_friction_Nm != 0.0:
        state.behind_rad = math.copysign(BEHIND * law.adaptation.count_rad, state.rest_friction_Nm)
    return rests


@kernel
def _taken_over_Nm(law: LawConstants, before_Nm: float, shift_Nm: float) -> float:
    """What bristles hold with that on top; no more than friction can."""
    branch = law.friction.positive if shift_Nm >= 0.0 else law.friction.negative
    most_Nm = law.reduction_ratio * branch.static_Nm
    return min(max(before_Nm + shift_Nm, min(before_Nm, -most_Nm)), max(before_Nm, most_Nm))


@kernel
def take_at_rest(
    law: LawConstants, state: AdaptationState, disturbance_Nm: float, desired_radps: float, error_rad: float
) -> float:
    """What the bristles take over from the observer [Nm]; 0 while the desired motion goes on."""
    held = _held_Nm(law, state) if abs(desired_radps) < STILL_radps else 0.0  # else nothing asks for it
    if not _comes_to_rest(law, state, held, disturbance_Nm, desired_radps, error_rad):
        return 0.0
    side, stiffness = 0 if held >= 0.0 else 1, 0.0
    for k in range(BRISTLES):
        stiffness += STIFFNESS[k] * state.weights[2 * k + side] * law.lugre.stiffness_Nmprad
    kept = _share_kept(law, state, held, stiffness, error_rad)
    wanted_Nm = TAKEN_radps * law.period_s * (disturbance_Nm - state.rest_disturbance_Nm)
    side, total = 0 if wanted_Nm >= 0.0 else 1, 0.0
    for k in range(BRISTLES):
        total += state.weights[2 * k + side]
    shift_Nm = wanted_Nm / max(total, LEAST_SHARE)
    taken = 0.0
    for k in range(BRISTLES):
        stiffness = STIFFNESS[k] * law.lugre.stiffness_Nmprad
        before = stiffness * state.desired_deflection_rad[k] * kept
        after = _taken_over_Nm(law, before, shift_Nm)
        taken += after * state.weights[2 * k if after >= 0.0 else 2 * k + 1]
        taken -= before * state.weights[2 * k if before >= 0.0 else 2 * k + 1]
        state.desired_deflection_rad[k] = state.deflection_rad[k] = after / stiffness
    return taken


@kernel
def take_unadapted_at_rest(
    law: LawConstants, state: AdaptationState, deflection_rad: float, disturbance_Nm: float, desired_radps: float,
    error_rad: float,
) -> tuple[float, float]:  # fmt: skip
    """(deflection [rad], what they have taken over [Nm]) of the bristles as configured, as `take_at_rest`."""
    stiffness = law.lugre.stiffness_Nmprad
    held = stiffness * deflection_rad
    if not _comes_to_rest(law, state, held, disturbance_Nm, desired_radps, error_rad):
        return deflection_rad, 0.0
    before = held * _share_kept(law, state, held, stiffness, error_rad)
    wanted_Nm = TAKEN_radps * law.period_s * (disturbance_Nm - state.rest_disturbance_Nm)
    after = _taken_over_Nm(law, before, wanted_Nm)
    return after / stiffness, after - before


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

    `explained_Nm` is the disturbance that the observer has found, of a joint that is not rigid that of its own,
    `fed_Nm` all that was fed forward and that it is to leave; position and velocity are the measured ones, of the
    motor / n.
    """
    constants = law.adaptation
    share = law.period_s * (SEEN_radps if state.seen_motor.primed != 0 else law.observer.bandwidth_radps)
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
    size = constants.noise_Nm * constants.noise_Nm
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
