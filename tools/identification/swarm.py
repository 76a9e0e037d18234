"""Particle swarm optimisation of one direction of (11), compiled: minimise E = sum of (weighted) squared errors (12).

A particle is a parameter vector in the box [lower, upper]:

    [ts, tc / ts, log ws, tv]  then  [c0, c1, c2, c3]  (multi-stage; without c0 if continuous)  then  [knee] if searched

Speeds are normalised to the highest one; the cubic is in Legendre polynomials on [given knee..1] (see `models`).
tc / ts in [0..1] keeps ts >= tc.  Velocity update with inertia w, cognitive c and social s weight, one best particle
for all, updated once per iteration (Kennedy and Eberhart 1995; default weights: Clerc's constriction, 2002):

    vel = w vel + c r1 (own best - pos) + s r2 (swarm best - pos),  pos = pos + vel, stopped at the box

The squared error needs no loop over the points.  The cubic is linear, so its part is a quadratic form of sums made
beforehand for every split of the sorted points.  The Stribeck stage is linear but for ws: its part is a quadratic form,
too, with four sums that depend on ws alone and are tabulated over log ws (cubic Hermite, error of E below 1e-11 of the
summed squares).  Only with a searched knee the points below it are gone through one by one.

The random numbers are an xorshift64 stream per particle and direction, seeded by splitmix64: the same seed gives the
same bits on every machine with the same floating point, however many threads run.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.tools.identification.fit import Fit, Problem, beta_from_vector, knee_candidates, vector_limits
from jointctl.tools.identification.models import legendre

CHUNK = 50  # iterations between two looks at the stop flag: some milliseconds
TABLE_NODES = 2048
_MASK = (1 << 64) - 1
_PER_2_31 = 1.0 / 2147483648.0


def splitmix64(value: int) -> int:
    """One step of Steele's generator: spreads a small seed over 64 bits."""
    z = (value + 0x9E3779B97F4A7C15) & _MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)


def stream_seed(seed: int, stream: int) -> np.uint64:
    """Start of an independent random stream; never zero, where xorshift would stay."""
    return np.uint64(splitmix64(splitmix64(seed & _MASK) ^ (stream + 1)) or 1)


@kernel
def next_random(state: np.uint64) -> np.uint64:
    """Marsaglia's xorshift64 (13, 7, 17): shifts only, so that plain Python wraps as the compiled code does."""
    state = state ^ (state << np.uint64(13))
    state = state ^ (state >> np.uint64(7))
    return state ^ (state << np.uint64(17))


@kernel
def uniform(state: np.uint64) -> float:
    """A number in [0..1) from the upper 53 bits."""
    return float(state >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def fill_uniform(random: np.ndarray, numbers: np.ndarray) -> None:
    """Draw numbers (N,) in [0..1) from the stream in random (1,), which moves on."""
    state = random[0]
    for k in range(len(numbers)):
        state = next_random(state)
        numbers[k] = uniform(state)
    random[0] = state


class Samples(NamedTuple):
    """What a particle is compared with."""

    x: np.ndarray  # (N,), sorted
    y: np.ndarray  # (N,) [Nm]
    weight: np.ndarray  # (N,) of the squared errors
    sums: np.ndarray  # (N + 1, 15) from `suffix_sums`
    table: np.ndarray  # from `stage_table`
    knee: float
    fixed_split: int  # of the points, where the knee is not searched
    has_cubic: bool
    continuous: bool
    search_knee: bool


class Swarm(NamedTuple):
    """Particles are the last axis, so that the compiler moves several of them at once."""

    position: np.ndarray  # (D, particles), as `velocity` and `best`
    velocity: np.ndarray
    best: np.ndarray
    best_error: np.ndarray  # (particles,)
    leader: np.ndarray  # (D,), the best position of all
    particle: np.ndarray  # (D,), scratch
    random: np.ndarray  # (particles,), a stream each
    lower: np.ndarray  # (D,)
    upper: np.ndarray  # (D,)


class Weights(NamedTuple):
    inertia: float
    cognitive: float
    social: float


@inlined
def hermite(ends: tuple[np.ndarray, np.ndarray], t: float, column: int) -> float:
    """Cubic between two rows of the table, `t` in [0, 1]: values in `column`, slopes four columns further."""
    from_left, from_right = (1.0 + 2.0 * t) * (1.0 - t) * (1.0 - t), t * t * (3.0 - 2.0 * t)
    slope_left, slope_right = t * (1.0 - t) * (1.0 - t), t * t * (t - 1.0)
    left, right = ends
    return (
        from_left * left[column]
        + from_right * right[column]
        + slope_left * left[column + 4]
        + slope_right * right[column + 4]
    )


@inlined
def squared_error(p: np.ndarray, samples: Samples) -> float:
    """E of one particle."""
    x, y, weight, sums, table, knee = samples.x, samples.y, samples.weight, samples.sums, samples.table, samples.knee
    tc = p[0] * p[1]
    d = p[0] - tc
    tv = p[3]
    split = samples.fixed_split
    at_knee = knee
    error = 0.0
    if samples.search_knee:
        at_knee = p[7] if samples.continuous else p[8]
        split = np.searchsorted(x, at_knee, side="right")
        inverse_ws = math.exp(-p[2])
        for i in range(split):
            r = tc + d * math.exp(-x[i] * inverse_ws) + tv * x[i] - y[i]
            error += weight[i] * r * r
    else:
        # row 0 holds n, x, x^2, y, x y, y^2 summed over the stage; first log ws and 1 / step
        place = (p[2] - table[0, 6]) * table[0, 7]
        node = min(max(int(place), 0), len(table) - 3)
        t = place - node
        ends = table[node + 1], table[node + 2]
        e, e_e = hermite(ends, t, 0), hermite(ends, t, 1)
        e_x, e_y = hermite(ends, t, 2), hermite(ends, t, 3)
        # |tc + d e + tv x - y|^2 multiplied out
        error = table[0, 5] + tc * (tc * table[0, 0] + 2.0 * (d * e + tv * table[0, 1] - table[0, 3]))
        error += d * (d * e_e + 2.0 * (tv * e_x - e_y)) + tv * (tv * table[0, 2] - 2.0 * table[0, 4])
    if samples.has_cubic:
        if samples.continuous:
            inverse_ws = math.exp(-p[2])
            c1, c2, c3 = p[4], p[5], p[6]
            z = (2.0 * at_knee - knee - 1.0) / (1.0 - knee)
            c0 = tc + d * math.exp(-at_knee * inverse_ws) + tv * at_knee
            c0 -= c1 * z + c2 * (1.5 * z * z - 0.5) + c3 * (2.5 * z * z * z - 1.5 * z)
        else:
            c0, c1, c2, c3 = p[4], p[5], p[6], p[7]
        # |y - P c|^2 = y'y - 2 (P'y)'c + c'(P'P)c over the points beyond the knee
        error += (
            sums[split, 0]
            - 2.0 * (sums[split, 1] * c0 + sums[split, 2] * c1 + sums[split, 3] * c2 + sums[split, 4] * c3)
            + c0 * (sums[split, 5] * c0 + 2.0 * (sums[split, 6] * c1 + sums[split, 7] * c2 + sums[split, 8] * c3))
            + c1 * (sums[split, 9] * c1 + 2.0 * (sums[split, 10] * c2 + sums[split, 11] * c3))
            + c2 * (sums[split, 12] * c2 + 2.0 * sums[split, 13] * c3)
            + c3 * sums[split, 14] * c3
        )
    # rounding of the quadratic form may end below zero where the data are fitted exactly
    return max(error, 0.0)


def suffix_sums(x: np.ndarray, y: np.ndarray, weight: np.ndarray, knee: float) -> np.ndarray:
    """Row k: y'y, P'y (4) and the upper triangle of P'P (10) over the points k.. of the sorted data; (N + 1, 15).

    Weighted sums, as those of `stage_table`.
    """
    polynomials = legendre(x, knee) if knee < 1.0 else np.zeros((len(x), 4))
    upper = [polynomials[:, i] * polynomials[:, j] for i in range(4) for j in range(i, 4)]
    terms = weight[:, None] * np.column_stack([y * y, *(polynomials[:, i] * y for i in range(4)), *upper])
    return np.vstack([np.cumsum(terms[::-1], axis=0)[::-1], np.zeros(15)])


def stage_table(x: np.ndarray, y: np.ndarray, weight: np.ndarray, log_ws_low: float, log_ws_high: float) -> np.ndarray:
    """Sums over the Stribeck stage for every ws; (TABLE_NODES + 1, 8).

    Row 0: sums of 1, x, x^2, y, x y, y^2, then the first log ws and the nodes per unit of log ws.  Row k + 1: at node k
    the sums of e, e^2, e x, e y with e = exp(-x / ws), and their derivatives by the node number.
    """
    nodes = np.linspace(log_ws_low, log_ws_high, TABLE_NODES)
    step = nodes[1] - nodes[0]
    scaled = x / np.exp(nodes)[:, None]
    e = np.exp(-scaled)
    rate = scaled * e * step  # d e / d node
    w, wx, wy = weight, weight * x, weight * y
    head = [np.sum(w), np.sum(wx), wx @ x, np.sum(wy), wx @ y, wy @ y, log_ws_low, 1.0 / step]
    columns = [e @ w, (e * e) @ w, e @ wx, e @ wy, rate @ w, 2.0 * (e * rate) @ w, rate @ wx, rate @ wy]
    return np.vstack([head, np.column_stack(columns)])


@kernel
def move_along(
    position: np.ndarray,
    velocity: np.ndarray,
    best: np.ndarray,
    random: np.ndarray,
    low: float,
    high: float,
    lead: float,
    weights: Weights,
) -> None:
    """Velocity and position of all particles in one dimension; arrays (particles,), a loop the compiler vectorises."""
    inertia, cognitive, social = weights
    for i in range(len(position)):
        # two numbers of 31 bits from one draw: plenty for weights, and quickly converted
        state = next_random(random[i])
        random[i] = state
        own = np.int32(state >> np.uint64(33)) * _PER_2_31
        shared = np.int32(state & np.uint64(0x7FFFFFFF)) * _PER_2_31
        here = position[i]
        v = inertia * velocity[i] + cognitive * own * (best[i] - here) + social * shared * (lead - here)
        there = here + v
        inside = low if there < low else high if there > high else there
        position[i] = inside
        velocity[i] = v if inside == there else 0.0


@kernel
def advance_swarm(swarm: Swarm, weights: Weights, samples: Samples, curve: np.ndarray) -> None:
    """len(curve) iterations; `curve` receives the leader's squared error after each of them."""
    position, velocity, best, best_error, leader, particle, random, lower, upper = swarm
    dimensions, particles = position.shape
    least = best_error[0]
    for i in range(1, particles):
        least = min(least, best_error[i])
    for step in range(len(curve)):
        first = -1
        for d in range(dimensions):
            move_along(position[d], velocity[d], best[d], random, lower[d], upper[d], leader[d], weights)
        for i in range(particles):
            for d in range(dimensions):
                particle[d] = position[d, i]
            error = squared_error(particle, samples)
            if error < best_error[i]:
                best_error[i] = error
                for d in range(dimensions):
                    best[d, i] = particle[d]
                if error < least:
                    least, first = error, i
        if first >= 0:
            for d in range(dimensions):
                leader[d] = best[d, first]
        curve[step] = least


# --- one swarm for each direction ---


@dataclass(frozen=True)
class SwarmSettings:
    """Budget and weights; `stall` > 0 stops early after so many iterations without 1e-12 of progress."""

    particles: int = 1000
    iterations: int = 5000
    inertia: float = 0.7298
    cognitive: float = 1.49618
    social: float = 1.49618
    seed: int = 1
    stall: int = 0


@dataclass(frozen=True)
class SwarmResult:
    """The best particle as a fit, and the best RMSE [Nm] after each iteration."""

    fit: Fit
    curve_Nm: np.ndarray
    iterations: int


def run_swarm(
    problem: Problem,
    settings: SwarmSettings,
    *,
    stream: int = 0,
    search_knee: bool = False,
    stop: threading.Event | None = None,
    progress: Callable[[int], None] | None = None,
) -> SwarmResult:
    """One direction; `progress` gets the iterations done, `stop` ends the search after the present chunk."""
    form = problem.form
    if not form.stribeck:
        raise ValueError(f"{form.name} is linear: there is nothing to search")
    search_knee = search_knee and form.cubic
    limits = vector_limits(problem)
    if search_knee:
        candidates = knee_candidates(problem)
        limits = np.column_stack([limits, [candidates[0], candidates[-1]]])
    lower, upper = np.ascontiguousarray(limits[0]), np.ascontiguousarray(limits[1])
    split = int(np.searchsorted(problem.x, problem.knee, side="right")) if form.cubic else len(problem.x)
    weight = problem.weight
    sums = suffix_sums(problem.x, problem.y_Nm, weight, problem.knee)
    shape = (len(lower), settings.particles)
    base = stream_seed(settings.seed, stream)
    # in an array, because a compiled function returns an unsigned scalar as a Python int, which is then taken as signed
    random = np.array([splitmix64(int(base) + k) or 1 for k in range(shape[1])], np.uint64)
    draws = np.empty(2 * shape[0] * shape[1])
    fill_uniform(np.array([base]), draws)
    start, speed = draws.reshape(2, *shape)
    width = (upper - lower)[:, None]
    position = lower[:, None] + width * start
    velocity = 0.1 * width * (2.0 * speed - 1.0)
    best, best_error = position.copy(), np.full(shape[1], np.inf)
    leader = position[:, 0].copy()
    curve = np.empty(settings.iterations)
    done, still = 0, 0
    stage = slice(0, split)
    table = stage_table(problem.x[stage], problem.y_Nm[stage], weight[stage], float(lower[2]), float(upper[2]))
    samples = Samples(
        problem.x, problem.y_Nm, weight, sums, table, problem.knee, split, form.cubic, form.continuous, search_knee
    )
    swarm = Swarm(position, velocity, best, best_error, leader, np.empty(shape[0]), random, lower, upper)
    weights = Weights(settings.inertia, settings.cognitive, settings.social)
    while done < settings.iterations and not (stop is not None and stop.is_set()):
        part = curve[done : done + CHUNK]
        advance_swarm(swarm, weights, samples, part)
        before = curve[done - 1] if done else np.inf
        done += len(part)
        still = still + len(part) if part[-1] >= before * (1.0 - 1e-12) else 0
        if progress is not None:
            progress(done)
        if settings.stall and still >= settings.stall:
            break
    knee = float(leader[-1]) if search_knee else problem.knee
    vector = leader[: len(vector_limits(problem)[0])]
    fit = _as_fit(problem, vector, knee)
    return SwarmResult(fit, np.sqrt(np.maximum(curve[:done], 0.0) / len(problem.x)), done)


def _as_fit(problem: Problem, vector: np.ndarray, knee: float) -> Fit:
    """The particle as a fit; its polynomials are on [problem.knee..1], those of a fit on [knee..1]."""
    beta, ws = beta_from_vector(problem, vector, knee)
    fit = Fit(problem, beta, ws, knee, 0.0)
    return replace(fit, rss=float(problem.weight @ fit.residual_Nm**2))


def run_swarms(
    problems: Sequence[Problem],
    settings: SwarmSettings,
    *,
    search_knee: bool = False,
    progress: Callable[[int], None] | None = None,
) -> list[SwarmResult]:
    """Each problem in a thread of its own (the kernel holds no lock of Python); Ctrl-C ends them within a chunk."""
    stop = threading.Event()
    done = [0] * len(problems)

    def one(k: int) -> SwarmResult:
        def tell(iterations: int) -> None:
            done[k] = iterations

        return run_swarm(problems[k], settings, stream=k, search_knee=search_knee, stop=stop, progress=tell)

    with ThreadPoolExecutor(max_workers=len(problems)) as pool:
        futures = [pool.submit(one, k) for k in range(len(problems))]
        try:
            while wait(futures, timeout=0.05).not_done:
                if progress is not None:
                    progress(sum(done))
        except BaseException:
            stop.set()
            raise
        return [future.result() for future in futures]
