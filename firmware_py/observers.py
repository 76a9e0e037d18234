"""What readings do not show: velocity, by low-pass or Kalman filter; what disturbs the joint; whether it swings.

The low-pass lags, and a velocity error e' = filter(q') - q_d' then carries the lag of q' but not of q_d', which an
integrating law absorbs as a bias.  `error_rate_radps` is the matched version: the difference quotient of e = q - q_d
sent as a whole through the same filter.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import (
    TORQUE_HISTORY,
    ObserverConstants,
    ObserverState,
    Swing,
    SwingConstants,
    SwingState,
    VelocityConstants,
    VelocityState,
)

COAST_s = 0.01  # in which a velocity that is not read comes to that of the reference
BRIDGED_CYCLES = 2  # without a sample, before it does: filters are slower, and lose damping where single ones are lost


@kernel
def low_pass_gain(cutoff_Hz: float, interval_s: float) -> float:
    """Weight of the new value in one step of the exactly discretised first-order low-pass; 1 = no filter."""
    if cutoff_Hz <= 0.0:
        return 1.0
    return 1.0 - math.exp(-2.0 * math.pi * cutoff_Hz * interval_s)


@kernel
def step_velocity(
    constants: VelocityConstants, state: VelocityState, position_rad: float, error_rad: float, elapsed_cycles: int
) -> None:
    """Take a sample that came `elapsed_cycles` (>= 1) periods after the last one; the first one only primes."""
    if state.primed == 0:
        state.primed = 1
        state.velocity_radps = 0.0
        state.error_rate_radps = 0.0
    else:
        interval_s = elapsed_cycles * constants.period_s
        if elapsed_cycles == 1:
            gain = constants.period_gain
        else:
            gain = low_pass_gain(constants.cutoff_Hz, interval_s)
        state.velocity_radps += gain * ((position_rad - state.last_position_rad) / interval_s - state.velocity_radps)
        state.error_rate_radps += gain * ((error_rad - state.last_error_rad) / interval_s - state.error_rate_radps)
    state.last_position_rad = position_rad
    state.last_error_rad = error_rad


@kernel
def coast_velocity(
    constants: VelocityConstants, state: VelocityState, reference_radps: float, elapsed_cycles: int
) -> None:
    """More periods without a sample: the velocity comes to that of the reference, as the loop would have it.

    Held, its last noise would push the joint for as long as nothing is read.
    """
    share = -math.expm1(-elapsed_cycles * constants.period_s / COAST_s)
    state.error_rate_radps -= share * state.error_rate_radps
    state.velocity_radps += share * (reference_radps - state.velocity_radps)


# --- Error, its rate and a disturbance by a Kalman filter: for an encoder too coarse for differences ---
#
#     e'' = (u - d) / J,   d' = noise        u: torque of feedback and observer that is at work
#     prediction over one period T:  e- = e + T e' + T^2 a / 2,   e'- = e' + T a,   a = (u - d) / J
#     correction by the reading:     r = (q - q_d) - e-,   e += g1 r,   e' += g2 r,   d -= J g3 r
#
# Between two counts the model of the joint goes on; what was fed forward is taken to cancel what it was meant for.  The
# gains are those of the steady state for noise of the torque, white and wandering, and of the reading: the intensities
# enter as two bandwidths, `cutoff_Hz` of the velocity and `bandwidth_radps` of the disturbance,
#
#     w = 2 pi cutoff = (torque noise / reading noise)^(1/4),   L = bandwidth = (wandering / white)^(1/2)
#     spectrum of the reading = 0:   x^3 + w^4 x - w^4 L^2 = 0,   x = s^2, of which the left half plane counts
#
# Its poles are near -L and w exp(+-i 135 deg).  Not modelled: the noise of a count is uniform, not Gaussian; the lag of
# the current loop; an overrun, in which the error moves on by one period only.

_ROUNDS = 60  # of Newton's method, which begins above the root of a convex function: it never fails


@kernel
def kalman_gains(cutoff_Hz: float, bandwidth_radps: float, period_s: float) -> tuple[float, float, float]:
    """(g1, g2 [1/s], g3 [1/s^2]) of the steady state; both bandwidths > 0."""
    fourth = (2.0 * math.pi * cutoff_Hz) ** 4
    x = bandwidth_radps**2
    for _ in range(_ROUNDS):
        step = (x * x * x + fourth * (x - bandwidth_radps**2)) / (3.0 * x * x + fourth)
        x -= step
        if step <= 1e-15 * x:
            break
    # the other two are -x/2 +- i y; their square roots in the left half plane are -a +- i b
    y = math.sqrt(0.75 * x * x + fourth)
    a = math.sqrt(0.5 * (math.sqrt(x * x + fourth) - 0.5 * x))
    b = 0.5 * y / a
    real = math.exp(-math.sqrt(x) * period_s)
    pair, product = 2.0 * math.exp(-a * period_s) * math.cos(b * period_s), math.exp(-2.0 * a * period_s)
    # the characteristic polynomial of prediction and correction has these three roots
    first, second, third = real + pair, real * pair + product, real * product
    g1 = 1.0 - third
    g2 = 0.5 * (6.0 - first - second - 3.0 * g1)
    g3 = second - first + g1
    return g1, g2 / period_s, g3 / (period_s * period_s)


@kernel
def set_kalman_gains(constants: ObserverConstants, period_s: float) -> None:
    """Put the gains of the configured bandwidths into force."""
    constants.error_gain, constants.rate_gain_1ps, constants.disturbance_gain_1ps2 = kalman_gains(
        constants.cutoff_Hz, constants.bandwidth_radps, period_s
    )


@kernel
def step_kalman(
    constants: ObserverConstants,
    state: ObserverState,
    applied_torque_Nm: float,
    error_rad: float,
    inertia_kgm2: float,
    period_s: float,
) -> float:
    """Take the error that the encoder shows; the disturbance [Nm] as that of `step_observer`.

    `applied_torque_Nm` is what feedback and observer asked for and the joint was given in the period before.
    """
    if state.primed == 0:
        state.primed = 1
        state.error_rad = error_rad
        state.error_rate_radps = 0.0
        return state.disturbance_Nm
    acceleration = (applied_torque_Nm - state.disturbance_Nm) / inertia_kgm2
    expected = state.error_rad + period_s * (state.error_rate_radps + 0.5 * period_s * acceleration)
    apart = error_rad - expected
    state.error_rad = expected + constants.error_gain * apart
    state.error_rate_radps += period_s * acceleration + constants.rate_gain_1ps * apart
    state.disturbance_Nm -= inertia_kgm2 * constants.disturbance_gain_1ps2 * apart
    return state.disturbance_Nm


# --- The disturbance: what the model does not explain, estimated from momentum and applied torque ---
#     r = L (z - J q'),   z' = tau_applied - known + r       =>   r' = L (d - r),   d = known parts of the model missing
#
# `r` [Nm at the joint] follows minus the unknown torque with bandwidth L [rad/s]; the law adds it with the sign that
# cancels.  No acceleration is differentiated.  The applied torque is the one that was sent, limited, as many cycles
# ago as a command needs to become torque, so that saturation does not wind the observer up.  `known` is that of this
# cycle, or, `paired`, that of the same command: then friction fed forward ahead of the motion is no disturbance.
# While the joint hardly moves (the average of the desired speed over AVERAGE_s is below PAIRED_FROM_radps) the other
# way is the better one all the same: bristles load up over a distance, and a joint that sticks breaks loose with less
# torque.


AVERAGE_s = 0.1
PAIRED_FROM_radps = 0.005


@kernel
def reset_observer(state: ObserverState, momentum_Nms: float) -> None:
    """No disturbance known, the joint moving with the given momentum."""
    state.integral_Nms = momentum_Nms
    state.disturbance_Nm = 0.0
    state.newest = 0
    state.primed = 0
    state.known_torque_Nm = 0.0
    state.speed_radps = 0.0
    for i in range(TORQUE_HISTORY):
        state.known_Nm[i] = 0.0
        state.sent_torque_Nm[i] = 0.0


@kernel
def applied_torque_Nm(constants: ObserverConstants, state: ObserverState, sent_torque_Nm: float) -> float:
    """The torque at work: that of `delay_cycles` before the command of the cycle before, which it takes note of."""
    state.newest = (state.newest + 1) % TORQUE_HISTORY
    state.sent_torque_Nm[state.newest] = sent_torque_Nm
    return torque_at_work_Nm(constants, state)


@kernel
def torque_at_work_Nm(constants: ObserverConstants, state: ObserverState) -> float:
    """The same once more in this cycle."""
    delay = min(max(constants.delay_cycles, 0), TORQUE_HISTORY - 1)
    return state.sent_torque_Nm[(state.newest - delay + TORQUE_HISTORY) % TORQUE_HISTORY]


@kernel
def known_since_Nm(constants: ObserverConstants, state: ObserverState, known_Nm: float) -> float:
    """What a paired observer that is not to be paired leaves to the model [Nm]: the change of what was fed forward
    between the command that is at work and this cycle.  Call it before `step_observer`."""
    at = (state.newest + 1) % TORQUE_HISTORY
    state.known_Nm[at] = known_Nm
    if state.speed_radps >= PAIRED_FROM_radps:
        return 0.0
    late = min(max(constants.delay_cycles, 0) + 1, TORQUE_HISTORY - 1)
    return known_Nm - state.known_Nm[(at - late + TORQUE_HISTORY) % TORQUE_HISTORY]


@kernel
def step_observer(
    constants: ObserverConstants,
    state: ObserverState,
    sent_torque_Nm: float,
    known_torque_Nm: float,
    momentum_Nms: float,
    period_s: float,
) -> float:
    """Disturbance [Nm], positive when it opposes positive motion; to be added to the torque.

    `sent_torque_Nm` is the command of the cycle before; `known_torque_Nm` what the model says opposes the motion
    (friction, gravity), `momentum_Nms` is J q'.
    """
    applied = applied_torque_Nm(constants, state, sent_torque_Nm)
    state.integral_Nms += period_s * (applied - known_torque_Nm - state.disturbance_Nm)
    state.disturbance_Nm = constants.bandwidth_radps * (state.integral_Nms - momentum_Nms)
    return state.disturbance_Nm


@kernel
def add_to_disturbance(constants: ObserverConstants, state: ObserverState, torque_Nm: float) -> None:
    """Hand a torque over to the observer without a jump of their sum (iterative learning that starts anew)."""
    if constants.bandwidth_radps > 0.0:
        state.integral_Nms += torque_Nm / constants.bandwidth_radps
        state.disturbance_Nm += torque_Nm
        if constants.paired != 0:  # as if it had been the observer's in the commands that are no torque yet, too
            for i in range(TORQUE_HISTORY):
                state.sent_torque_Nm[i] += torque_Nm
                state.known_Nm[i] -= torque_Nm


# --- Does a quantity swing: turns in a row and how they grow, for `safety.check_swing`; readings at rest; noise ---

GROWTH = 1.05  # from one half swing to the next
REST_STEPS = 8.0  # times the steps of the reading at rest: a smaller swing is the encoder's
HUNTING_SWINGS = 6  # half swings in a row
HUNTING_SLOWER = 16  # times the slowest half swing of a limit cycle
REVERSAL_SWINGS = 3  # that friction alone makes of one reversal of the reference: they do not count


@kernel
def _reset_one(swing: Swing) -> None:
    swing.direction = 0
    swing.low = 0.0
    swing.high = 0.0
    swing.amplitude = 0.0
    swing.count = 0
    swing.growing = 0
    swing.last_cycle = 0
    swing.half_cycles = 0


@kernel
def reset_swing(state: SwingState) -> None:
    """Begin a run: nothing swings, nothing is known of the reading at rest."""
    _reset_one(state.torque)
    _reset_one(state.error)
    _reset_one(state.faint_error)
    _reset_one(state.rest_error)
    state.reference_direction = 0
    state.rest_rad = 0.0
    state.rest_position_rad = 0.0
    state.noise_Nm = 0.0
    state.noise_told_Nm = 0.0


@kernel
def step_swing(swing: Swing, value: float, least: float, slowest_cycles: int, cycle: int) -> None:
    """Follow a quantity and count how often in a row it turns, each time by more than `least` from peak to peak.

    It has turned when it has come back by more than `least` from where it was farthest; `amplitude` is the way between
    the two turns before.  Where half a swing takes more than `slowest_cycles`, the count begins anew.
    """
    if swing.direction >= 0:
        swing.high = max(swing.high, value)
    if swing.direction <= 0:
        swing.low = min(swing.low, value)
    fell = swing.direction >= 0 and swing.high - value > least
    rose = swing.direction <= 0 and value - swing.low > least
    if not fell and not rose:
        return
    amplitude = swing.high - swing.low
    swing.half_cycles = cycle - swing.last_cycle
    if swing.half_cycles > slowest_cycles:
        swing.count = 0
        swing.growing = 0
    elif not amplitude >= GROWTH * swing.amplitude:
        swing.growing = 0
    swing.count += 1
    swing.growing += 1
    swing.amplitude = amplitude
    swing.last_cycle = cycle
    if fell:
        swing.direction = -1
        swing.low = value
    else:
        swing.direction = 1
        swing.high = value


@kernel
def allow_reversal(swing: Swing) -> None:
    """The reference has turned: friction does, and the torque with it."""
    swing.count = max(swing.count - REVERSAL_SWINGS, 0)
    swing.growing = max(swing.growing - REVERSAL_SWINGS, 0)


@kernel
def step_hunting(constants: SwingConstants, state: SwingState, error_rad: float, rests: bool, cycle: int) -> bool:
    """Whether a joint that is to rest swings about that place, by more than its reading does at rest.

    An observer pushes on against friction that sticks until that gives way; where it then falls, the joint slips past
    the place, and sticks on its other side.
    """
    if not rests:
        _reset_one(state.rest_error)
    elif constants.hunting_rad > 0.0:
        least_rad = max(constants.hunting_rad, REST_STEPS * state.rest_rad)
        step_swing(state.rest_error, error_rad, least_rad, HUNTING_SLOWER * constants.slowest_cycles, cycle)
    return state.rest_error.count >= HUNTING_SWINGS


@kernel
def note_rest(state: SwingState, position_rad: float, moving: bool) -> None:
    """A new sample with the power off: by how much the reading of a joint that stands changes."""
    if moving:
        state.rest_rad = 0.0
    else:
        state.rest_rad = max(state.rest_rad, abs(position_rad - state.rest_position_rad))
    state.rest_position_rad = position_rad


@kernel
def torque_noise(constants: SwingConstants, state: SwingState, change_Nm: float) -> bool:
    """Take the change of the command in this cycle; whether their mean is more than is worth a warning."""
    state.noise_Nm += constants.noise_gain * (abs(change_Nm) - state.noise_Nm)
    return 0.0 < constants.noise_Nm < state.noise_Nm
