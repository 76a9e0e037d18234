"""Particle swarm optimisation of one direction of (11), compiled: minimise E = sum of squared errors (12).

A particle is a parameter vector in the box [lower, upper]:

    [ts, tc / ts, log ws, tv]  then  [c0, c1, c2, c3]  (multi-stage; without c0 if continuous)  then  [knee] if searched

Speeds are normalised to the highest one; the cubic is in Legendre polynomials on [given knee..1] (see `models`).
tc / ts in [0..1] keeps ts >= tc.  Velocity update with inertia w, cognitive c and social s weight, one best particle
for all, updated once per iteration (Kennedy and Eberhart 1995; default weights: Clerc's constriction, 2002):

    vel = w vel + c r1 (own best - pos) + s r2 (swarm best - pos),  pos = pos + vel, stopped at the box

The same seed gives the same bits, however many threads run; the compiled part is in `swarm_kernels`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass

import numpy as np

from jointctl.tools.identification.polish import beta_from_vector, vector_limits
from jointctl.tools.identification.swarm_kernels import (
    advance_swarm,
    fill_uniform,
    splitmix64,
    stage_table,
    stream_seed,
    suffix_sums,
)
from jointctl.tools.identification.variable_projection import Fit, Problem, knee_candidates

CHUNK = 50  # iterations between two looks at the stop flag: some milliseconds


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
    sums = suffix_sums(problem.x, problem.y_Nm, problem.knee)
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
    particle = np.empty(shape[0])
    curve = np.empty(settings.iterations)
    done, still = 0, 0
    table = stage_table(problem.x[:split], problem.y_Nm[:split], float(lower[2]), float(upper[2]))
    data = (problem.x, problem.y_Nm, sums, table, problem.knee, split, form.cubic, form.continuous, search_knee)
    weights = (settings.inertia, settings.cognitive, settings.social)
    while done < settings.iterations and not (stop is not None and stop.is_set()):
        part = curve[done : done + CHUNK]
        advance_swarm(
            position, velocity, best, best_error, leader, particle, random, lower, upper, weights, *data, part
        )
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
    residual = problem.y_Nm - fit.torque_Nm(problem.x)
    return Fit(problem, beta, ws, knee, float(residual @ residual))


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
