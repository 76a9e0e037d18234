"""Margins of the linear loop, the continuous-time figures of the theory beside them, and the convergence of learning.

Phase and gain margins and the sensitivity are read off L(e^{j omega T}), which is exact for the sampled loop.  The
delay margin is exact too: the additional delay at which a closed-loop eigenvalue reaches the unit circle; the quotient
phase margin / crossover frequency only indicates where to search, because a delay inside a period is not a pure phase.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jointctl.firmware_py.law import solve_lyapunov_p
from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.analysis.linear_loop import (
    MAX_DELAY_PERIODS,
    Array,
    ComplexArray,
    LinearLoop,
    LoopSettings,
    StateSpace,
    linear_loop,
    network_gains,
)
from jointctl.tools.configuration.checks import OBSERVING as OBSERVING_LAWS
from jointctl.tools.configuration.config import Learning

# --- zeros and minima by a grid that shrinks round by round: every start of a motion would wait for scipy.optimize ---

_ROUND_POINTS = 33  # of a round; an odd number keeps a symmetric extremum on the grid

OBSERVING = tuple(ControllerKind[kind.upper()] for kind in OBSERVING_LAWS)
LEARNING_RATE_Hz = 1000.0  # for which the cycles of the shipped laws are
LEARNING_FACTOR = 0.9  # of a repetition, wanted
SLOWEST_LEARNING_FACTOR = 0.99  # at most: at 1 nothing is learned
LATE_LEARNING_FACTOR = 0.96  # beyond it the quickest gains that converge do so on the model alone: one step slower

Function = Callable[[np.ndarray], np.ndarray]


def zero_between(function: Function, low: float, high: float, tolerance: float = 1e-12) -> float:
    """Where `function` changes its sign between `low` and `high` > `low`; the first such place on the grid.

    `function` maps an array of places, shape (N,), to real values of the same shape.  Raises ValueError without a
    change of sign.
    """
    while True:
        places = np.linspace(low, high, _ROUND_POINTS)
        positive = function(places) > 0.0
        changes = np.flatnonzero(positive[:-1] != positive[1:])
        if not len(changes):
            raise ValueError(f"no change of sign between {low} and {high}")
        last_width = high - low
        low, high = float(places[changes[0]]), float(places[changes[0] + 1])
        if high - low <= tolerance or high - low >= last_width:
            return 0.5 * (low + high)


def least_between(function: Function, low: float, high: float) -> tuple[float, float]:
    """(place, value) of the least value that `function`, as above, has on the grids from `low` to `high` > `low`."""
    while True:
        places = np.linspace(low, high, _ROUND_POINTS)
        values = function(places)
        least = int(np.argmin(values))
        last_width = high - low
        low, high = float(places[max(least - 1, 0)]), float(places[min(least + 1, _ROUND_POINTS - 1)])
        if high - low <= 1e-9 or high - low >= last_width:
            return float(places[least]), float(values[least])


# --- margins ---

_POINTS = 3000
_COARSE_POINTS = 600  # for searches
_DECADES = 6.5  # below pi / T
_SCAN = 12  # delays tried below the expected limit, in case that stability ends earlier


@dataclass(frozen=True)
class Margins:
    """What the loop bears.  An unstable loop has no margins: 0 deg, 0 s, factors 1, an infinite sensitivity."""

    stable: bool
    phase_margin_deg: float  # least, in either direction
    crossover_Hz: float  # |L| = 1 there; nan if |L| never is 1
    gain_margin_up: float  # factor on L, >= 1; inf = none needed
    gain_margin_down: float  # factor on L, <= 1; 0 = any
    delay_margin_s: float  # in addition to the assumed delay
    sensitivity_peak: float  # Ms = max |1 / (1 + L)|
    sensitivity_peak_Hz: float
    sensitivity_accepted: bool  # not more than `LoopSettings.largest_s`
    slowest_time_constant_s: float  # of the closed loop's slowest mode; inf if unstable
    oscillation_Hz: float  # of the complex pair that decays slowest; nan without one
    oscillation_damping: float  # its damping ratio, negative if it grows
    poles: tuple[complex, ...]  # eigenvalues z, largest first
    joint: str = ""  # the one that these are of, where the loop must bear several
    sensitivity_joint: str = ""  # the one with the highest peak, which is given


@dataclass(frozen=True)
class Theory:
    """Continuous time, no delay, no lag, no filter: the figures of the stability proof."""

    p: tuple[float, float, float] | None  # P11, P12, P22 of (21); None without network
    p_eigenvalues: tuple[float, float] | None
    bound_per_Nm: float | None  # |x| <= this times |eps|, as (30) prints it
    tight_bound_per_Nm: float | None  # with |P B|
    polynomial: tuple[float, ...]  # characteristic polynomial, highest power first
    natural_frequency_radps: float  # of the pair that decays slowest; nan without one
    damping: float
    slowest_time_constant_s: float


def frequencies_radps(period_s: float, points: int = _POINTS) -> Array:
    """Logarithmic grid up to the Nyquist frequency pi / T, twice as dense in its last two decades."""
    top = math.log10(math.pi / period_s)
    both = (np.linspace(top - _DECADES, top, points // 2), np.linspace(top - 2.0, top, points // 2))
    grid = np.sort(np.concatenate(both))  # `np.unique` would load masked arrays, 35 ms of every start
    grid = grid[np.append(np.diff(grid) > 0.0, True)]
    result: Array = np.power(10.0, grid)
    result[-1] = math.pi / period_s
    return result


def _at(loop: LinearLoop, log_omega: float) -> complex:
    return complex(loop.open_loop(np.array([math.exp(log_omega)]))[0])


def _between(omega: Array, i: int) -> tuple[float, float]:
    return math.log(omega[i]), math.log(omega[i + 1])


def _gain_crossings(loop: LinearLoop, omega: Array, magnitude: Array) -> list[tuple[float, complex]]:
    """(omega [rad/s], L) wherever |L| = 1."""
    found = []
    for i in np.flatnonzero((magnitude[:-1] > 1.0) != (magnitude[1:] > 1.0)):
        x = zero_between(lambda x: np.abs(loop.open_loop(np.exp(x))) - 1.0, *_between(omega, int(i)))
        found.append((math.exp(x), _at(loop, x)))
    return found


def _gain_factors(loop: LinearLoop, omega: Array, response: np.ndarray) -> list[float]:
    """Factors on L that bring it to -1: 1 / |L| wherever L is real and negative."""
    imaginary, real = response.imag[:-1], response.real
    factors = []
    for i in np.flatnonzero((imaginary[:-1] > 0.0) != (imaginary[1:] > 0.0)):
        if real[i] < 0.0 and real[i + 1] < 0.0:
            x = zero_between(lambda x: loop.open_loop(np.exp(x)).imag, *_between(omega, int(i)))
            factors.append(1.0 / abs(_at(loop, x)))
    if real[-1] < 0.0:  # at pi / T it is always real
        factors.append(1.0 / abs(real[-1]))
    return factors


def _with_more_delay_stable(settings: LoopSettings, more_s: float) -> bool:
    return linear_loop(replace(settings, delay_s=settings.delay_s + more_s)).is_stable()


def delay_margin_s(settings: LoopSettings, crossings: list[tuple[float, complex]] | None = None) -> float:
    """Additional delay that a stable loop bears; inf without a gain crossing.

    Beyond `MAX_DELAY_PERIODS` it is the estimate phase margin / frequency, which is good there: a period is short.
    """
    if crossings is None:
        loop = linear_loop(settings)
        omega = frequencies_radps(settings.period_s)
        crossings = _gain_crossings(loop, omega, np.abs(loop.open_loop(omega)))
    estimates = [(math.atan2(value.imag, value.real) + math.pi) % math.tau / at for at, value in crossings]
    if not estimates:
        return math.inf
    estimate = min(estimates)
    room_s = MAX_DELAY_PERIODS * settings.period_s - settings.delay_s
    if estimate > 0.4 * room_s:
        return estimate
    step = max(estimate / _SCAN, 0.1 * settings.period_s)
    low, high = 0.0, step
    while _with_more_delay_stable(settings, high):
        low, high = high, high + step
        if high > room_s:
            return estimate
    while high - low > 1e-7 * settings.period_s + 1e-7 * high:
        middle = 0.5 * (low + high)
        if _with_more_delay_stable(settings, middle):
            low = middle
        else:
            high = middle
    return low


def _sensitivity_peak(loop: LinearLoop, omega: Array, response: np.ndarray) -> tuple[float, float]:
    """(Ms, omega [rad/s])."""
    distance = np.abs(1.0 + response)
    i = int(np.argmin(distance))
    low, high = math.log(omega[max(i - 1, 0)]), math.log(omega[min(i + 1, len(omega) - 1)])
    log_omega, least = least_between(lambda x: np.abs(1.0 + loop.open_loop(np.exp(x))), low, high)
    if least < distance[i]:
        return 1.0 / least, math.exp(log_omega)
    return 1.0 / float(distance[i]), float(omega[i])


def _oscillation(poles_radps: list[complex]) -> tuple[float, float]:
    """(|s| [rad/s], damping ratio) of the complex pair with the slowest decay."""
    pairs = [s for s in poles_radps if s.imag > 1e-9 * abs(s)]
    if not pairs:
        return math.nan, math.nan
    slowest = max(pairs, key=lambda s: s.real)
    return abs(slowest), -slowest.real / abs(slowest)


def _in_s_plane(poles: list[complex], period_s: float) -> list[complex]:
    """s = ln z / T; a pole at the origin is a delay and negative real ones have no counterpart."""
    kept = [z for z in poles if abs(z) > 1e-6 and not (z.real < 0.0 and abs(z.imag) < 1e-9)]
    return [complex(math.log(abs(z)), math.atan2(z.imag, z.real)) / period_s for z in kept]


def cases(settings: LoopSettings) -> list[LoopSettings]:
    """One for each joint that the loop must bear."""
    return [replace(settings, joints=(joint,)) for joint in settings.joints] or [settings]


def worst_case(settings: LoopSettings) -> LoopSettings:
    """The joint with the least phase margin; where the loop is unstable with several, the fastest to grow."""
    return _worst_cases(settings)[0]


def row_response(system: StateSpace, z: ComplexArray) -> ComplexArray:
    """Transfer row (N, inputs) of a system with one output, at many points: a fifth of the time of its `response`.

    Schur's form of a is triangular, for all z alike.
    """
    from scipy.linalg import schur  # here: only a search for gains waits for it

    form, vectors = schur(system.a, output="complex", check_finite=False)
    known, row = (system.c @ vectors)[0], np.empty((len(form), len(z)), dtype=np.complex128)  # c (z - a)^-1
    for i in range(len(form)):
        row[i] = (known[i] + form[:i, i] @ row[:i]) / (z - form[i, i])
    return np.asarray(row.T @ (vectors.conj().T @ system.b) + system.d[0], dtype=np.complex128)


def margins_on_grid(open_loop: ComplexArray) -> tuple[Array, Array, Array]:
    """(phase margin [deg], gain margin in either direction, largest |S|) of each row (n, frequencies) of stable loops.

    Between two frequencies L is taken as straight: they are to be close enough.
    """

    def crossed(
        above: NDArray[np.bool_], height: Callable[[ComplexArray], Array]
    ) -> tuple[NDArray[np.intp], ComplexArray]:
        """The rows in which `above` changes between two frequencies, and L there, where `height` of it is 0."""
        rows, at = np.nonzero(above[:, :-1] != above[:, 1:])
        before, after = open_loop[rows, at], open_loop[rows, at + 1]
        share = height(before) / (height(before) - height(after))
        return rows, (1.0 - share) * before + share * after

    phase, gain = np.full(len(open_loop), 180.0), np.full(len(open_loop), math.inf)
    rows, at_one = crossed(np.abs(open_loop) > 1.0, lambda found: np.log(np.abs(found)))
    np.minimum.at(phase, rows, np.degrees(np.abs(np.angle(-at_one))))
    rows, real = crossed(open_loop.imag > 0.0, np.imag)
    rows, size = rows[real.real < 0.0], -real.real[real.real < 0.0]
    np.minimum.at(gain, rows, np.maximum(size, 1.0 / size))
    return phase, gain, 1.0 / np.min(np.abs(1.0 + open_loop), axis=1)


def _worst_cases(settings: LoopSettings) -> tuple[LoopSettings, LoopSettings]:
    """That one, and the joint with the highest peak of |S|, which means something where all are stable."""
    found = cases(settings)
    if len(found) == 1:
        return found[0], found[0]
    omega = frequencies_radps(settings.period_s, _COARSE_POINTS)
    z = np.exp(1j * omega * settings.period_s)
    law = linear_loop(settings).controller.response(z)  # the same for all of them

    def rank(case: LoopSettings) -> tuple[float, float, float]:
        loop = linear_loop(case)
        radius = float(np.max(np.abs(loop.closed_loop_poles())))
        if radius >= 1.0:
            return 0.0, -radius, 0.0
        (phase_deg,), _, (peak,) = margins_on_grid(-(law @ loop.joint.response(z))[None, :, 0, 0])
        return float(phase_deg), 0.0, 1.0 / float(peak)

    ranks = [rank(case) for case in found]
    return found[ranks.index(min(ranks))], found[int(np.argmin([closest for _, _, closest in ranks]))]


def largest_sensitivity(settings: LoopSettings) -> tuple[float, float, LoopSettings]:
    """(peak of |S|, at [Hz], the joint that has it); infinite where the loop is unstable with one."""
    worst, case = _worst_cases(settings)
    if not linear_loop(worst).is_stable():
        return math.inf, math.nan, worst
    return *_highest_peak(case), case


def _highest_peak(case: LoopSettings) -> tuple[float, float]:
    """(peak of |S|, at [Hz]) with one joint."""
    omega, loop = frequencies_radps(case.period_s), linear_loop(case)
    peak, peak_radps = _sensitivity_peak(loop, omega, loop.open_loop(omega))
    return peak, peak_radps / math.tau


@functools.lru_cache(maxsize=32)  # a tune asks for the same loop in each of its steps
def margins(settings: LoopSettings) -> Margins:
    """All margins of the loop with these settings; of several joints those of the worst one."""
    settings, most_sensitive = _worst_cases(settings)
    joint = settings.joints[0].name if settings.joints else ""
    loop = linear_loop(settings)
    poles = sorted((complex(z) for z in loop.closed_loop_poles()), key=abs, reverse=True)
    radius = abs(poles[0])
    frequency, damping = _oscillation(_in_s_plane(poles, settings.period_s))
    oscillation_Hz = frequency / math.tau
    if radius >= 1.0:
        return Margins(
            False, 0.0, math.nan, 1.0, 1.0, 0.0, math.inf, math.nan, False, math.inf, oscillation_Hz, damping,
            tuple(poles), joint, joint,
        )  # fmt: skip
    omega = frequencies_radps(settings.period_s)
    response = loop.open_loop(omega)
    crossings = _gain_crossings(loop, omega, np.abs(response))
    phases = [(abs(math.atan2(-value.imag, -value.real)), at) for at, value in crossings]  # distance from -180 deg
    phase, crossover = min(phases, default=(math.pi, math.nan))
    factors = _gain_factors(loop, omega, response)
    peak, peak_Hz = _highest_peak(most_sensitive)
    return Margins(
        stable=True,
        phase_margin_deg=math.degrees(phase),
        crossover_Hz=crossover / math.tau,
        gain_margin_up=min((f for f in factors if f > 1.0), default=math.inf),
        gain_margin_down=max((f for f in factors if f < 1.0), default=0.0),
        delay_margin_s=delay_margin_s(settings, crossings),
        sensitivity_peak=peak,
        sensitivity_peak_Hz=peak_Hz,
        sensitivity_accepted=peak <= settings.largest_s,
        slowest_time_constant_s=-settings.period_s / math.log(radius) if radius > 0.0 else 0.0,
        oscillation_Hz=oscillation_Hz,
        oscillation_damping=damping,
        poles=tuple(poles),
        joint=joint,
        sensitivity_joint=most_sensitive.joints[0].name if most_sensitive.joints else "",
    )


def phase_margin_deg(settings: LoopSettings) -> float:
    """Only the phase margin, for searches; 0 if unstable; of several joints that of the worst one."""
    settings = worst_case(settings)
    loop = linear_loop(settings)
    if not loop.is_stable():
        return 0.0
    omega = frequencies_radps(settings.period_s, _COARSE_POINTS)
    crossings = _gain_crossings(loop, omega, np.abs(loop.open_loop(omega)))
    return math.degrees(min((abs(math.atan2(-v.imag, -v.real)) for _, v in crossings), default=math.pi))


def eigenvalues(p11: float, p12: float, p22: float) -> tuple[float, float]:
    """(smallest, largest) eigenvalue of the symmetric 2x2 matrix; the smaller without cancellation."""
    largest = 0.5 * (p11 + p22) + math.hypot(0.5 * (p11 - p22), p12)
    return (p11 * p22 - p12 * p12) / largest, largest


def ultimate_bounds(
    p11: float, p12: float, p22: float, q1: float, q2: float, inertia_kgm2: float, residual_Nm: float
) -> tuple[float, float]:
    """Bounds on |x| = |(e, e')| for |eps| <= residual_Nm: (as (30) prints it, the tighter one with |P B|).

    (30) uses |M0^-1| lmax(P); the term that appears in V' is x^T P B eps, so |P B| is enough.
    """
    smallest_q = min(q1, q2)
    loose = 2.0 * eigenvalues(p11, p12, p22)[1] / inertia_kgm2 * residual_Nm / smallest_q
    tight = 2.0 * math.hypot(p12, p22) / inertia_kgm2 * residual_Nm / smallest_q
    return loose, tight


def theory(settings: LoopSettings) -> Theory:
    """P, both bounds (30) and the continuous-time modes, for the network of e'' + kv e' + kp e = -fhat / J."""
    kp, kv, inertia = settings.kp, settings.kv, settings.inertia_kgm2
    polynomial: tuple[float, ...] = (1.0, kv, kp)
    if settings.kind == ControllerKind.PID and settings.ki != 0.0:
        polynomial = (1.0, kv, kp, settings.ki)
    if settings.kind in OBSERVING and settings.observer_radps != 0.0:
        # with the exact inertia the observer's pole is not moved by the loop
        bandwidth = settings.observer_radps
        polynomial = (1.0, kv + bandwidth, kp + bandwidth * kv, bandwidth * kp)
    p = p_eigenvalues = loose = tight = None
    if settings.kind == ControllerKind.COMPUTED_TORQUE_RBF:
        p = solve_lyapunov_p(kp, kv, *settings.q)
        p_eigenvalues = eigenvalues(*p)
        loose, tight = ultimate_bounds(*p, *settings.q, inertia, 1.0)
        a1, a2, g1, g2 = (gain / inertia for gain in network_gains(settings))
        leak = settings.leakage_1ps
        polynomial = (1.0, kv + g2, kp + g1)
        if (a1, a2) != (0.0, 0.0):
            polynomial = (1.0, kv + g2 + leak, kp + g1 + leak * (kv + g2) + a2, leak * (kp + g1) + a1)
    roots = [complex(s) for s in np.roots(polynomial)]
    frequency, damping = _oscillation(roots)
    slowest = max(s.real for s in roots)
    return Theory(
        p, p_eigenvalues, loose, tight, polynomial, frequency, damping, -1.0 / slowest if slowest < 0.0 else math.inf
    )


# --- does iterative learning converge?  The factor by which one repetition multiplies what is still to be learned ---
# Linearised like `linear_loop`, a torque u that is fed forward moves the joint by G u, G = P / (1 + L), and takes T u,
# T = L / (1 + L), off feedback and observer.  The next repetition feeds forward (see `firmware_py.law`)
#
#     u_next = S (u + gain z^lead (correction - J error_gain e))   =>   u_next - u* = M (u - u*)
#     M(omega) = S (1 - gain z^lead (T + J error_gain G)),   S = the smoothing, a mean over 2 half_width + 1 cycles
#
# |M| < 1 at every frequency is enough for convergence; where |M| > 1 a ripple of that frequency grows from one
# repetition to the next.  The share of the disturbance that remains for ever is |1 - S| / |1 - M|.
#
# Neglected: the observer compares the learned torque with a command that is some cycles older, and the friction, which
# damps.


@dataclass(frozen=True)
class Convergence:
    """`worst_factor` < 1: every repetition is better than the one before, by this factor at the worst frequency."""

    worst_factor: float
    worst_Hz: float
    remaining_1_Hz: float  # share of a disturbance at 1 Hz that stays in the end


@dataclass(frozen=True)
class RepeatedLoop:
    """One joint's loop as learning meets it: G and T at frequencies (N,) of which the last is 1 Hz."""

    settings: LoopSettings
    omega_radps: Array
    moved: ComplexArray
    taken: ComplexArray

    def convergence(self, learning: Learning) -> Convergence:
        factor, remaining = self.factor(learning)
        worst = int(np.argmax(factor[:-1]))
        return Convergence(float(factor[worst]), float(self.omega_radps[worst]) / math.tau, float(remaining[-1]))

    def factor(self, learning: Learning) -> tuple[Array, Array]:
        """(|M|, |1 - S| / |1 - M|) at its frequencies, arrays (N,)."""
        angles = self.omega_radps * self.settings.period_s
        width = learning.half_width_cycles
        smoothing = np.ones_like(angles)
        for k in range(1, width + 1):
            smoothing = smoothing + 2.0 * np.cos(k * angles)
        smoothing = smoothing / (2 * width + 1)
        seen = self.taken + self.settings.inertia_kgm2 * learning.error_gain_ps2 * self.moved
        factor = smoothing * (1.0 - learning.gain * np.exp(1j * angles * learning.lead_cycles) * seen)
        return np.abs(factor), np.abs(1.0 - smoothing) / np.abs(1.0 - factor)


def repeated_loops(settings: LoopSettings) -> list[RepeatedLoop]:
    """One for each joint that the loop must bear; the law is the same for all of them."""
    omega = np.append(frequencies_radps(settings.period_s), math.tau)
    z = np.exp(1j * omega * settings.period_s)
    law = linear_loop(settings).controller.response(z)
    found = []
    for case in cases(settings):
        plant = linear_loop(case).joint.response(z)
        open_loop = -(law @ plant)[:, 0, 0]
        found.append(RepeatedLoop(case, omega, plant[:, 0, 0] / (1.0 + open_loop), open_loop / (1.0 + open_loop)))
    return found


def slowest_convergence(loops: list[RepeatedLoop], learning: Learning) -> Convergence:
    """Convergence of this learning on the joint that it is worst for."""
    return max((loop.convergence(learning) for loop in loops), key=lambda one: one.worst_factor)


def learning_convergence(settings: LoopSettings, learning: Learning) -> Convergence:
    """The same of the joints that the loop must bear."""
    return slowest_convergence(repeated_loops(settings), learning)


def at_rate(learning: Learning | None, rate_Hz: float) -> Learning | None:
    """Of a shipped law, whose cycles are those of LEARNING_RATE_Hz."""
    if learning is None:
        return None
    faster = rate_Hz / LEARNING_RATE_Hz
    lead, half_width = (
        min(round(cycles * faster), 100) for cycles in (learning.lead_cycles, learning.half_width_cycles)
    )
    return learning.model_copy(update={"lead_cycles": max(lead, 1), "half_width_cycles": half_width})


def converging(settings: LoopSettings, learning: Learning | None) -> Learning | None:
    """Learning that converges on every joint of the intervals: its gain from the error is lowered, then its gain.

    Where that brings none to `LEARNING_FACTOR`, the quickest that converges, of a late loop the next one; or None.
    """
    if learning is None or settings.kind not in OBSERVING:
        return None
    slow: list[tuple[float, Learning]] = []
    loops = repeated_loops(settings)
    for _ in range(8):
        factor = slowest_convergence(loops, learning).worst_factor
        if factor <= LEARNING_FACTOR:
            return learning
        if factor <= SLOWEST_LEARNING_FACTOR:
            slow.append((factor, learning))
        learning = learning.model_copy(
            update={"error_gain_ps2": 0.5 * learning.error_gain_ps2, "gain": 0.8 * learning.gain}
        )
    late = len(slow) > 1 and slow[0][0] > LATE_LEARNING_FACTOR
    return slow[int(late)][1] if slow else None
