"""The network (14) and its adaptation law (24)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.law import adapt_network, network_torque_Nm, reset_network, solve_lyapunov_p
from jointctl.firmware_py.records import NEURONS, NetworkConstants, NetworkState
from jointctl.firmware_py.schema import new

INERTIA_kgm2 = 2.1
HALF = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
CENTRES = (*(-c for c in HALF), 0.0, *HALF)


def network(width: float = 5.0) -> tuple[Any, Any]:
    constants, state = new(NetworkConstants)[0], new(NetworkState)[0]
    for i, centre in enumerate(CENTRES):
        constants.centres[i, 0] = constants.centres[i, 1] = centre
        constants.inverse_width[i] = 1.0 / (2.0 * width**2)
    _, p12, p22 = solve_lyapunov_p(784.0, 56.0, 2500.0, 2500.0)
    constants.p_b[0], constants.p_b[1] = p12 / INERTIA_kgm2, p22 / INERTIA_kgm2
    constants.learning_rate, constants.initial_weight = 80.0, 0.01
    reset_network(constants, state)
    return constants, state


def test_output_is_the_weighted_sum_of_gaussians() -> None:
    constants, state = network(width=0.02)
    state.weights[:] = np.linspace(-1.0, 2.0, NEURONS)
    e, rate = 0.012, -0.007
    hidden = [math.exp(-((e - c) ** 2 + (rate - c) ** 2) / (2.0 * 0.02**2)) for c in CENTRES]
    expected = float(np.dot(np.linspace(-1.0, 2.0, NEURONS), hidden))
    assert network_torque_Nm(constants, state, e, rate) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(state.hidden, hidden, rtol=1e-12)


def test_initial_weights() -> None:
    constants, state = network()
    assert list(state.weights) == [0.01] * NEURONS
    assert network_torque_Nm(constants, state, 0.0, 0.0) == pytest.approx(0.15, rel=1e-3)


@pytest.mark.parametrize(("e", "rate"), [(0.001, 0.0), (0.0, 0.03), (-0.2, 0.1)])
def test_one_step_of_the_adaptation_law(e: float, rate: float) -> None:
    constants, state = network()
    network_torque_Nm(constants, state, e, rate)
    adapt_network(constants, state, e, rate, 1e-3)
    x_p_b = (1.594388 * e + 22.349900 * rate) / INERTIA_kgm2
    np.testing.assert_allclose(state.weights, 0.01 + 80.0 * np.array(state.hidden) * x_p_b * 1e-3, rtol=1e-6)


def test_with_the_papers_width_the_network_is_one_integrator() -> None:
    """fhat' = (15 beta / J) (P12 e + P22 e') for a second of a decaying oscillation of the error."""
    constants, state = network(width=5.0)
    period_s, integral_Nm = 1e-3, 0.15
    hidden_min, hidden_max, largest = 1.0, 0.0, 0.0
    for k in range(1000):
        t = k * period_s
        e = 0.01 * math.exp(-t) * math.sin(20.0 * t)
        rate = 0.01 * math.exp(-t) * (20.0 * math.cos(20.0 * t) - math.sin(20.0 * t))
        output = network_torque_Nm(constants, state, e, rate)
        assert output == pytest.approx(integral_Nm, abs=0.0015 * 130.0)  # 1 - h, of the largest swing
        largest = max(largest, abs(integral_Nm))
        adapt_network(constants, state, e, rate, period_s)
        integral_Nm += 15.0 * 80.0 / INERTIA_kgm2 * (1.594388 * e + 22.349900 * rate) * period_s
        hidden_min, hidden_max = min(hidden_min, *state.hidden), max(hidden_max, *state.hidden)
    assert largest > 100.0
    assert hidden_min >= 0.9985
    assert hidden_max <= 1.0


def test_leakage_forgets_exponentially() -> None:
    constants, state = network()
    constants.leakage = 0.5
    state.weights[:] = 2.0
    for _ in range(1000):
        network_torque_Nm(constants, state, 0.0, 0.0)
        adapt_network(constants, state, 0.0, 0.0, 1e-3)
    np.testing.assert_allclose(state.weights, 2.0 * math.exp(-0.5), rtol=1e-3)


def test_without_leakage_nothing_is_forgotten() -> None:
    constants, state = network()
    for _ in range(1000):
        network_torque_Nm(constants, state, 0.0, 0.0)
        adapt_network(constants, state, 0.0, 0.0, 1e-3)
    assert list(state.weights) == [0.01] * NEURONS


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_projection_bounds_every_weight(sign: float) -> None:
    constants, state = network()
    constants.weight_limit = 0.05
    for _ in range(200):
        network_torque_Nm(constants, state, sign * 0.01, sign * 0.1)
        adapt_network(constants, state, sign * 0.01, sign * 0.1, 1e-3)
    assert list(state.weights) == [sign * 0.05] * NEURONS


@pytest.mark.parametrize(("e", "adapts"), [(0.00099, False), (-0.00099, False), (0.001, True), (-0.001, True)])
def test_dead_zone(e: float, adapts: bool) -> None:
    constants, state = network()
    constants.dead_zone_rad = 0.001
    network_torque_Nm(constants, state, e, 0.1)
    adapt_network(constants, state, e, 0.1, 1e-3)
    assert bool(state.weights[0] != 0.01) is adapts
