"""The law for a joint whose reducer is not rigid: damping from the motor's encoder, position from the link's.

    theta motor angle / n,  q link angle,  y_m, y_l their readings,  e_m = y_m - theta_d,  e_l = y_l - q_d
    b'  = wb ((e_l - e_m) - b)                                what the twist is away from the expected one, slowly
    v_m = low-pass(e_m'),  v_l = slower low-pass(e_l')
    d   = L (p - (Jm v_m + Jl v_l)),  p' = u_applied - d      disturbance observer on the momentum of both masses
    u   = -(Jm + Jl) (kp (e_m + b) + kv v_m) + d
    tau = tau_ff + u + learned torque

The feed-forward takes the desired motion of the link through the reducer (the joint is flat in q):

    tau_l   = Jl q_d'' + F_l + G(q_d) + C0 q_d'               torque through the reducer
    theta_d = q_d + twist(tau_l) - eps(theta_d)
    tau_ff  = Jm theta_d'' + (1 + eps') tau_l + F_m - r(theta_d)

Of the motion `feed_forward_lead_s` from now: the torque is that late.  e_m is that against theta_d of now.  F_m goes
with theta_d', twist included.  eps is the kinematic error of the reducer, as far as the motor has the torque to make up
for it, and r the torque ripple, both sums of sines of the motor angle; theta_d'' needs the fourth derivative of q_d.
With one encoder alone e_l = e_m: with the motor's, the link is where the feed-forward expects it; with the link's, the
loop must be slow against the reducer's resonance.

Not modelled: hysteresis and damping of the reducer, the rates of the friction in theta_d'', and in an arm those of what
the other joints ask."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import step_velocity
from jointctl.firmware_py.records import (
    KNEES,
    AdaptationState,
    FlexibleConstants,
    FlexibleState,
    HarmonicSeries,
    LawConstants,
    LawState,
)
from jointctl.firmware_py.states import Encoders


class Reading(NamedTuple):
    """What the encoders say in a cycle."""

    position_rad: float  # of the one that feeds the law
    second_position_rad: float
    gap_cycles: int  # periods since the last sample, 0 where there is no new one


@kernel
def reset_flexible(state: FlexibleState) -> None:
    """Nothing known of the twist; the next cycle begins with the errors that it finds."""
    state.primed = 0
    state.twist_error_rad = 0.0
    state.link_deflection_rad = 0.0
    state.motor_velocity.primed = 0
    state.link_velocity.primed = 0


@inlined
def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns), absolute error below 2e-11; range reduction in turns is exact, without branch or library call.

    Half a turn either way is r (1/4 - r^2) P(r^2), P of degree 6 fitted for the least maximum error.  Several times as
    fast as libm, which matters for the ripples of a simulated joint, two million substeps long.
    """
    r = turns - np.rint(turns)
    y = r * r
    y2 = y * y
    low = (25.1327412271771 - y * 64.8358437584691) + y2 * (67.0776056610595 - y * 38.5126054685551)
    high = (14.1788906187473 - y * 3.62170359416296) + y2 * 0.614277835548814
    return r * (0.25 - y) * (low + y2 * y2 * high)


@inlined
def series_at(series: HarmonicSeries, angle_rad: float) -> tuple[float, float, float]:
    """(value, first, second derivative) at a motor angle / n."""
    value = 0.0
    slope = 0.0
    bend = 0.0
    for i in range(series.count):
        order = 2.0 * math.pi * series.turns_prad[i]
        turns = series.turns_prad[i] * angle_rad + series.phase_turns[i]
        wave = series.amplitude[i] * sine_of_turns(turns)
        value += wave
        slope += order * series.amplitude[i] * sine_of_turns(turns + 0.25)
        bend -= order * order * wave
    return value, slope, bend


@inlined
def value_at(series: HarmonicSeries, angle_rad: float) -> float:
    """The value alone."""
    value = 0.0
    for i in range(series.count):
        value += series.amplitude[i] * sine_of_turns(series.turns_prad[i] * angle_rad + series.phase_turns[i])
    return value


@inlined
def twist_of(constants: FlexibleConstants, torque_Nm: float) -> tuple[float, float]:
    """(twist [rad], compliance there [rad/Nm]) of the reducer under a steady torque."""
    size = abs(torque_Nm)
    compliance = constants.compliance_radpNm
    twist = compliance * size
    for i in range(KNEES):
        beyond = size - constants.knee_Nm[i]
        if beyond > 0.0:
            twist -= constants.stiffening_radpNm[i] * beyond
            compliance -= constants.stiffening_radpNm[i]
    return math.copysign(twist, torque_Nm), compliance


@kernel
def desired_motor(constants: LawConstants, state: LawState, reference: Reference, gravity_slope_Nmprad: float) -> float:
    """Feed-forward torque [Nm] of the motion `feed_forward_lead_s` from now; leaves theta_d of now in the state.

    Friction and gravity of that time are there already.
    """
    flexible, lead_s = constants.flexible, constants.feed_forward_lead_s
    acceleration = reference.acceleration_radps2 + lead_s * (
        reference.jerk_radps3 + 0.5 * lead_s * reference.snap_radps4
    )
    speed = reference.velocity_radps + lead_s * (reference.acceleration_radps2 + 0.5 * lead_s * reference.jerk_radps3)
    mean_radps = reference.velocity_radps + lead_s * (
        0.5 * reference.acceleration_radps2 + lead_s / 6.0 * reference.jerk_radps3
    )
    link_rad = reference.position_rad + lead_s * mean_radps
    own = state.flexible
    link_friction = own.link_friction_Nm
    through = flexible.link_inertia_kgm2 * acceleration + link_friction + state.gravity_torque_Nm
    bend = flexible.link_inertia_kgm2 * reference.snap_radps4  # the second derivative of that torque
    if constants.of_arm == 0:
        through += constants.coriolis_Nmspr * speed
        bend += gravity_slope_Nmprad * acceleration - state.gravity_torque_Nm * speed * speed
    twist, compliance = twist_of(flexible, through)
    own.friction_twist_rad = compliance * own.whole_friction_Nm
    # theta + eps(theta) = q_d + twist: a step of Newton's method from where theta was, moved along
    ahead = link_rad + twist
    motor_rad = own.motor_rad + own.motor_per_link * (ahead - own.ahead_rad) if own.primed != 0 else ahead
    _follow(flexible, own.followed, speed)
    error, slope, curvature = series_at(own.followed, motor_rad)
    inverse = 1.0 / (1.0 + slope)
    motor_rad -= (motor_rad + error - ahead) * inverse
    own.motor_rad, own.ahead_rad, own.motor_per_link = motor_rad, ahead, inverse
    before_rad, before_apart_rad = own.target_rad, own.apart_rad[own.newest]
    own.target_rad = reference.position_rad + _apart_now(constants, own, motor_rad - link_rad)
    own.ahead_radps, own.target_radps = speed, reference.velocity_radps
    if own.primed != 0:
        own.ahead_radps += (motor_rad - link_rad - before_apart_rad) / constants.period_s
        own.target_radps = (own.target_rad - before_rad) / constants.period_s
    motor_speed = speed * inverse
    motor_acceleration = (acceleration + compliance * bend - curvature * motor_speed * motor_speed) * inverse
    motor_friction = state.friction_torque_Nm - link_friction - value_at(flexible.torque_ripple, motor_rad)
    return flexible.motor_inertia_kgm2 * motor_acceleration + (1.0 + slope) * through + motor_friction


@inlined
def _follow(flexible: FlexibleConstants, followed: HarmonicSeries, speed_radps: float) -> None:
    """What the motor makes up for of the kinematic error at this speed, for no more than `following_Nm` in all.

    A sine takes Jm A w^2, which grows with the square of the speed; the first in the list come first.
    """
    left_Nm = flexible.following_Nm
    followed.count = flexible.kinematic_error.count
    for i in range(followed.count):
        amplitude = flexible.kinematic_error.amplitude[i]
        omega_radps = 2.0 * math.pi * flexible.kinematic_error.turns_prad[i] * speed_radps
        needed_Nm = flexible.motor_inertia_kgm2 * abs(amplitude) * omega_radps * omega_radps
        if needed_Nm > left_Nm:
            amplitude *= left_Nm / needed_Nm
        left_Nm = max(left_Nm - needed_Nm, 0.0)
        followed.amplitude[i] = amplitude
        followed.turns_prad[i] = flexible.kinematic_error.turns_prad[i]
        followed.phase_turns[i] = flexible.kinematic_error.phase_turns[i]


@kernel
def _apart_now(constants: LawConstants, own: FlexibleState, apart_rad: float) -> float:
    """By how much the motor is to be ahead of the link now [rad], where it is to be so `feed_forward_lead_s` from now.

    What was worked out then is kept; between two cycles it is linear.  Only the difference of both is: through an
    overrun it hardly moves.
    """
    size = len(own.apart_rad)
    if own.primed == 0:
        for i in range(size):
            own.apart_rad[i] = apart_rad
    own.newest = (own.newest + 1) % size
    own.apart_rad[own.newest] = apart_rad
    cycles = min(constants.feed_forward_lead_s / constants.period_s, size - 2.0)
    whole = int(cycles)
    share = cycles - whole
    at = own.newest - whole + size
    return (1.0 - share) * own.apart_rad[at % size] + share * own.apart_rad[(at - 1) % size]


@kernel
def motor_and_link_errors(
    constants: FlexibleConstants, state: FlexibleState, reading: Reading, desired_rad: float
) -> tuple[float, float]:
    """(e_m, e_l) [rad]; moves the filters of both and the correction of the twist on."""
    position = reading.position_rad
    if constants.encoders == Encoders.LINK:
        motor, target = position, desired_rad
    elif constants.encoders == Encoders.MOTOR:
        motor, target = position, state.target_rad
    else:
        motor, target = reading.second_position_rad, state.target_rad
    motor_error = motor - target
    link_error = motor_error
    if constants.encoders == Encoders.BOTH:
        link_error = position - desired_rad
    if reading.gap_cycles > 0 or state.primed == 0:
        gap = max(reading.gap_cycles, 1)
        step_velocity(constants.motor_velocity, state.motor_velocity, motor, motor_error, gap)
        step_velocity(constants.link_velocity, state.link_velocity, position, link_error, gap)
    apart = link_error - motor_error
    if state.primed == 0:
        state.primed = 1
        state.twist_error_rad = apart
    state.twist_error_rad += constants.twist_gain * (apart - state.twist_error_rad)
    return motor_error, link_error


# --- What adaptation sees of such a joint (`friction`), with both encoders ---
# The observer of the loop has the bandwidth that the loop bears, and its speeds are filtered as much as that needs:
# next to it friction that changes within milliseconds is taken for something else.  Adaptation therefore has an
# observer of its own on the momentum of both masses, whose disturbance moves nothing.
#
# How much of the friction lies behind the reducer decides by how much the reducer springs over where the motion turns
# back, and the motor has to make up for that before the link moves.  The two encoders show it:
#
#     (y_l - q_d) - (y_m - theta_d) = expected twist - twist = offset + (share fed forward - share) C F
#
# with the compliance C and the friction F that is fed forward (`feed_forward_lead_s` ahead, which at a reversal is a
# sample of the wrong sign at most).  A Kalman filter follows both, in every tenth cycle whatever its length.  The
# offset is a load, and what the encoders' zeros and maps leave; hysteresis of the reducer looks like friction of the
# other sign, and is found with it.

SEEN_radps = 80.0  # bandwidth of that observer
SEEN_Hz = 100.0  # of the low-pass on its speeds, and on what was fed forward that it is compared with
LARGEST_SHARE = 0.4  # unless more is configured
SHARE_USED_radps = 5.0  # with which what is found is fed forward
TWIST_NOISE_rad = 3e-4  # of a sample: what the masses swing, and samples are not independent
OFFSET_VARIANCE_rad2, SHARE_VARIANCE = 1e-7, 1e-2  # at first
OFFSET_DRIFT, SHARE_DRIFT = 1e-3, 1e-4  # of these, that comes back in each step: a load changes sooner than a share


@kernel
def see_motion(
    law: LawConstants, state: AdaptationState, applied_Nm: float, motor_rad: float, link_rad: float, gap_cycles: int
) -> None:
    """One cycle of the observer: `applied_Nm` of the feedback alone, the errors of motor and link."""
    if state.seen_motor.primed == 0:
        state.seen_integral_Nms = state.seen_disturbance_Nm = 0.0
        state.twist_offset_rad = link_rad - motor_rad
    if gap_cycles > 0 or state.seen_motor.primed == 0:
        gap = max(gap_cycles, 1)
        step_velocity(law.adaptation.seen, state.seen_motor, motor_rad, motor_rad, gap)
        step_velocity(law.adaptation.seen, state.seen_link, link_rad, link_rad, gap)
    momentum_Nms = law.flexible.motor_inertia_kgm2 * state.seen_motor.error_rate_radps
    momentum_Nms += law.flexible.link_inertia_kgm2 * state.seen_link.error_rate_radps
    state.seen_integral_Nms += law.period_s * (applied_Nm - state.seen_disturbance_Nm)
    state.seen_disturbance_Nm = SEEN_radps * (state.seen_integral_Nms - momentum_Nms)


@kernel
def adapt_link_share(
    constants: FlexibleConstants, state: AdaptationState, friction_twist_rad: float, apart_rad: float
) -> None:
    """Learn from `apart_rad`, by which link and motor are nearer than expected; with both encoders.

    `friction_twist_rad`: by which the whole friction would twist the reducer.
    """
    covariance = state.twist_covariance
    offset = covariance[0, 0] + covariance[0, 1] * friction_twist_rad
    share = covariance[1, 0] + covariance[1, 1] * friction_twist_rad
    size = TWIST_NOISE_rad * TWIST_NOISE_rad + offset + friction_twist_rad * share
    # against what is fed forward, which is on its way to what is found
    expected_rad = state.twist_offset_rad + (state.used_link_share - state.link_share) * friction_twist_rad
    error = (apart_rad - expected_rad) / size
    state.twist_offset_rad += offset * error
    largest = max(LARGEST_SHARE, constants.link_friction_share)
    state.link_share = min(max(state.link_share - share * error, 0.0), largest)
    covariance[0, 0] -= offset * offset / size
    covariance[0, 1] -= offset * share / size
    covariance[1, 0] = covariance[0, 1]
    covariance[1, 1] -= share * share / size
    covariance[0, 0] = min(covariance[0, 0] + OFFSET_DRIFT * OFFSET_VARIANCE_rad2, OFFSET_VARIANCE_rad2)
    covariance[1, 1] = min(covariance[1, 1] + SHARE_DRIFT * SHARE_VARIANCE, SHARE_VARIANCE)
