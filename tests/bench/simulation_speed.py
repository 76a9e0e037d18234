"""Simulated joint time against the clock, and the particle swarm against pyswarms."""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import jointctl
from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification.fit import Problem, make_problem, vector_limits
from jointctl.tools.identification.models import FORMS, legendre
from jointctl.tools.identification.swarm import SwarmSettings, run_swarms
from jointctl.tools.lockstep import LockstepJoint
from tests.bench.paired import Row, compared, interleaved, measured, skipped

LOCKSTEP_S = 100.0
LOCKSTEP_GOAL_S, REALISTIC_GOAL_S = 0.15, 0.25
ITERATIONS = 5000
NOISE_Nm = 0.0046
SPEEDS = 225
STEP_S, STEP_GOAL_ms = 0.1, 0.5  # of `Joint.step`: 200 times as fast as real time
CYCLES, CYCLE_GOAL_us = 2000, 50.0  # of `Joint.step_torque`: 20,000 a second


def _lockstep(config: Config, log_every: int = 0) -> Callable[[], float]:
    """Takes the time [s] of `LOCKSTEP_S` of this joint."""
    joint = LockstepJoint(config)
    constants = joint.constants()
    constants[0].trajectory.duration_s = 2.0 * LOCKSTEP_S
    joint.run(constants, longest_s=0.1)  # compiles

    def measure() -> float:
        begin_s = time.perf_counter()
        joint.run(constants, longest_s=LOCKSTEP_S, log_every=log_every)
        return time.perf_counter() - begin_s

    return measure


def lockstep_rows(config: Config, *, runs: int) -> Iterator[Row]:
    """100 s of joint time: controller, codec, drive and plant, with and without a log record each cycle."""
    realistic = load_config(shipped_config("realistic"))
    bare, logged, soft = interleaved(runs, _lockstep(config), _lockstep(config, log_every=1), _lockstep(realistic))
    best = f"best {min(bare):.3f} s; {LOCKSTEP_S / float(np.median(bare)):.0f} times as fast as real time"
    yield measured("simulation", f"{LOCKSTEP_S:g} s of lockstep", bare, "s", goal=LOCKSTEP_GOAL_S, note=best)
    cycles = LOCKSTEP_S * config.loop.rate_Hz
    yield measured("simulation", "one cycle of it", [value / cycles * 1e9 for value in bare], "ns")
    note = f"with a log record each cycle; best {min(logged):.3f} s"
    yield measured("simulation", f"{LOCKSTEP_S:g} s of lockstep, logged", logged, "s", note=note)
    note = f"joint and law of realistic.toml; best {min(soft):.3f} s"
    yield measured(
        "simulation", f"{LOCKSTEP_S:g} s of lockstep, flexible joint", soft, "s", goal=REALISTIC_GOAL_S, note=note
    )


def program_rows(config: Config, *, runs: int) -> Iterator[Row]:
    """A program at simulated time: `Joint.step` in short steps, and a law in Python, one cycle a call."""
    steps_ms, cycles_us = [], []
    for _ in range(runs):
        with jointctl.Joint(config, lockstep=True) as joint:
            joint.enable()
            joint.step(STEP_S)  # compiles
            begin_s = time.perf_counter()
            for _ in range(100):
                joint.step(STEP_S)
            steps_ms.append((time.perf_counter() - begin_s) * 10.0)
            state = joint.state
            hold_rad, begin_s = state.position_rad, time.perf_counter()
            for _ in range(CYCLES):
                state = joint.step_torque(8000.0 * (hold_rad - state.position_rad) - 300.0 * state.velocity_radps)
            cycles_us.append((time.perf_counter() - begin_s) * 1e6 / CYCLES)
    note = f"{STEP_S * 1e3 / float(np.median(steps_ms)):.0f} times as fast as real time"
    what = f"program: {STEP_S:g} s by Joint.step"
    yield measured("simulation", what, steps_ms, "ms", goal=STEP_GOAL_ms, note=note)
    note = f"{1e6 / float(np.median(cycles_us)):.0f} a second"
    yield measured("simulation", "program: a cycle by step_torque", cycles_us, "us", goal=CYCLE_GOAL_us, note=note)


def paper_problems() -> list[Problem]:
    """Table 3 at 225 speeds with noise, a problem for each direction."""
    velocity = np.linspace(-200.0, 200.0, SPEEDS) * DEGREE
    noise = np.random.default_rng(1).normal(0.0, NOISE_Nm, SPEEDS)
    torque = friction_curve_Nm(paper_friction(), velocity) + noise
    found = []
    for sign in (1, -1):
        chosen = sign * velocity > 0.0
        knee_limits = (None, 20.0 * DEGREE)
        found.append(
            make_problem(
                FORMS["multi-stage"], sign * velocity[chosen], sign * torque[chosen], 40.0 * DEGREE, knee_limits
            )
        )
    return found


def written_cost(problem: Problem) -> Callable[[np.ndarray], np.ndarray]:
    """(11) vectorised over the particles, as pyswarms' manual asks for: (particles, 8) -> (particles,)."""
    x, y = problem.x, problem.y_Nm
    polynomials = legendre(x, problem.knee)

    def cost(p: np.ndarray) -> np.ndarray:
        ts, tc = p[:, :1], p[:, :1] * p[:, 1:2]
        stribeck = tc + (ts - tc) * np.exp(-x / np.exp(p[:, 2:3])) + p[:, 3:4] * x
        model = np.where(x <= problem.knee, stribeck, p[:, 4:] @ polynomials.T)
        return np.asarray(np.sum((model - y) ** 2, axis=1))

    return cost


def _pyswarms_s(problems: list[Problem], iterations: int) -> float:
    """Seconds that pyswarms takes for the whole budget, scaled from `iterations`."""
    import pyswarms.single as single  # no dependency of ours

    total_s = 0.0
    for problem in problems:
        limits = vector_limits(problem)
        options = {"w": 0.7298, "c1": 1.49618, "c2": 1.49618}
        swarm: Any = single.GlobalBestPSO(
            n_particles=1000, dimensions=limits.shape[1], bounds=(limits[0], limits[1]), options=options
        )
        cost = written_cost(problem)
        begin_s = time.perf_counter()
        swarm.optimize(cost, iters=iterations, verbose=False)
        total_s += time.perf_counter() - begin_s
    return total_s * ITERATIONS / iterations


def swarm_rows(*, pairs: int, pyswarms_iterations: int) -> Iterator[Row]:
    """1000 particles, 5000 iterations, both directions; pyswarms does a part of them."""
    problems = paper_problems()
    run_swarms(problems, SwarmSettings(iterations=1))  # compiles

    def ours() -> float:
        begin_s = time.perf_counter()
        run_swarms(problems, SwarmSettings(iterations=ITERATIONS))
        return time.perf_counter() - begin_s

    what = "particle swarm, 1000 x 5000"
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # pyswarms writes a log file where it is imported
        try:
            _pyswarms_s(problems, 2)
            values = interleaved(pairs, ours, lambda: _pyswarms_s(problems, pyswarms_iterations))
        except ImportError as error:
            yield measured("identification", what, interleaved(pairs, ours)[0], "s")
            yield skipped("identification", f"{what} against pyswarms", f"not installed ({error})")
            return
        finally:
            logging.shutdown()
            os.chdir(before)
    note = f"pyswarms: {pyswarms_iterations} iterations, scaled to {ITERATIONS}"
    yield compared("identification", what, values[0], values[1], "s", "pyswarms", note=note)
