"""Delay limits of the linear loop against the real kernels on the simulated joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointctl.firmware_py.axis import low_pass_gain, step_velocity
from jointctl.firmware_py.kernel import JIT_DISABLED, kernel
from jointctl.firmware_py.law import reset_law, solve_lyapunov_p, step_law
from jointctl.firmware_py.records import LawConstants, LawState, Reference, VelocityConstants, VelocityState
from jointctl.firmware_py.schema import new
from jointctl.hil.plant.joint import plant, step_plant
from jointctl.hil.plant.records import DELAY_SLOTS
from jointctl.tools.analysis.linear_loop import LoopSettings
from jointctl.tools.analysis.margins import delay_margin_s
from tests.unit.analysis.specified_loops import ANY_KIND, Q2500

# plain Python is three hundred times slower: coarser and shorter there
SUBSTEP_s = 100e-6 if JIT_DISABLED else 25e-6


DURATION_s = 2.0 if JIT_DISABLED else 20.0


# Far beyond the limit the law ends in a limit cycle, because h(x) falls as |x| nears b: stay where it is linear.
START_rad = 1e-6


GROWN_rad = 1e-3


@kernel
def energies(law_c, law_s, velocity_c, velocity_s, reference, plant_c, plant_s, substeps, periods):
    """Mean square velocity of the joint late in the first half and at the end: it grows or it decays."""
    early = late = torque = 0.0
    for k in range(periods):
        q = plant_s.joint_position_rad
        step_velocity(velocity_c, velocity_s, q, q, 1)
        torque = step_law(law_c, law_s, q, velocity_s, reference, torque, 0, 0.0, 0.0)
        for _ in range(substeps):
            step_plant(plant_c, plant_s, torque)
        v = plant_s.joint_velocity_radps
        if k >= periods - periods // 5:
            late += v * v
        elif periods // 2 - periods // 5 <= k < periods // 2:
            early += v * v
        if not abs(q) < GROWN_rad:
            return 0.0, 1.0
    return early, late


def decays(loop: LoopSettings, delay_substeps: int, matched: bool) -> bool:
    """Whether the simulated joint comes to rest with this delay."""
    law_c, law_s = new(LawConstants), new(LawState)
    velocity_c, velocity_s, reference = new(VelocityConstants), new(VelocityState), new(Reference)
    law = law_c[0]
    law.kind, law.period_s, law.matched_filter = loop.kind, loop.period_s, matched
    law.inertia_kgm2, law.kp, law.kv, law.ki = loop.inertia_kgm2, loop.kp, loop.kv, loop.ki
    law.observer.bandwidth_radps, law.observer.delay_cycles = loop.observer_radps, loop.observer_delay_cycles
    _, p12, p22 = solve_lyapunov_p(loop.kp, loop.kv, *loop.q)
    network = law.network
    network.p_b[0], network.p_b[1] = p12 / loop.inertia_kgm2, p22 / loop.inertia_kgm2
    network.centres[:] = loop.centres
    network.inverse_width[:] = [0.5 / b**2 for b in loop.widths]
    network.learning_rate, network.leakage = loop.learning_rate, loop.leakage_1ps
    velocity_c[0].period_s, velocity_c[0].cutoff_Hz = loop.period_s, loop.cutoff_Hz
    velocity_c[0].period_gain = low_pass_gain(loop.cutoff_Hz, loop.period_s)
    reset_law(law, law_s[0])
    plant_c, plant_s = plant(
        step_s=SUBSTEP_s,
        inertia_kgm2=loop.inertia_kgm2,
        current_limit_A=1e4,
        current_lag_s=loop.lag_s,
        command_delay_s=delay_substeps * SUBSTEP_s,
        initial_position_rad=START_rad,
    )
    early, late = energies(
        law, law_s[0], velocity_c[0], velocity_s[0], reference[0], plant_c[0], plant_s[0],
        round(loop.period_s / SUBSTEP_s), round(DURATION_s / loop.period_s),
    )  # fmt: skip
    return late < early


def simulated_limit_substeps(loop: LoopSettings, low: int, high: int, matched: bool) -> int:
    """The longest delay with which the simulation decays."""
    assert decays(loop, low, matched)
    assert not decays(loop, high, matched)
    while high - low > 1:
        middle = (low + high) // 2
        if decays(loop, middle, matched):
            low = middle
        else:
            high = middle
    return low


def gain_sets() -> list[LoopSettings]:
    """Seeded draws around the paper's gains, of every kind, at three rates."""
    rng = np.random.default_rng(20)
    chosen = []
    for i in range(9):
        scale = rng.uniform(0.6, 1.4)
        kind = ANY_KIND[i % len(ANY_KIND)]
        chosen.append(
            replace(
                kind,
                period_s=(5e-4, 1e-3, 2e-3)[i % 3],
                lag_s=rng.uniform(0.0, 1e-3),
                cutoff_Hz=rng.uniform(60.0, 200.0),
                kp=kind.kp * scale**2,
                kv=kind.kv * scale * rng.uniform(0.9, 1.3),
                ki=kind.ki * scale**3,
                q=(rng.uniform(500.0, 3000.0), rng.uniform(500.0, 2000.0)),
                leakage_1ps=rng.choice([0.0, 0.01]),
                inertia_kgm2=rng.uniform(0.5, 5.0),
                observer_radps=rng.uniform(20.0, 80.0) if kind.observer_radps else 0.0,
                weight_Nm=0.0,
            )
        )
    return chosen


FRICTIONLESS = replace(Q2500, lag_s=0.3e-3, weight_Nm=0.0)
SIMULATED = [FRICTIONLESS, replace(Q2500, cutoff_Hz=30.0, weight_Nm=0.0), *gain_sets()]


@pytest.mark.parametrize("case", range(1 if JIT_DISABLED else len(SIMULATED)))
def test_predicted_and_simulated_delay_limits_agree(case):
    loop = replace(SIMULATED[case], delay_s=0.0)
    limit_s = delay_margin_s(loop)
    expected = limit_s / SUBSTEP_s
    margin = max(8, round(0.2 * expected))
    found = simulated_limit_substeps(
        loop, max(round(expected) - margin, 0), min(round(expected) + margin, DELAY_SLOTS - 1), case % 2 == 1
    )
    # the virtual joint takes the torque at the end of a substep for all of it: half a substep less lag
    assert abs(found + 0.5 - expected) <= 1.5, (limit_s, found * SUBSTEP_s)


@pytest.mark.parametrize("matched", [False, True])
def test_frictionless_check_with_the_kernels(matched):
    assert decays(FRICTIONLESS, round(4.4e-3 / SUBSTEP_s), matched)
    assert not decays(FRICTIONLESS, round(5.0e-3 / SUBSTEP_s), matched)
