"""The control law (29), term by term and as a closed loop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import friction_motor_torque_Nm, step_lugre
from jointctl.firmware_py.law import friction_feed_forward_Nm, reset_law, step_law
from jointctl.firmware_py.records import LawState, Reference, VelocityState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, FeedForward, ZeroSpeedRule


@pytest.fixture
def law(axis_constants: Any) -> Any:
    return axis_constants[0].law


def blocks(law: Any) -> tuple[Any, Any, Any]:
    state, velocity, reference = new(LawState)[0], new(VelocityState)[0], new(Reference)[0]
    reset_law(law, state)
    return state, velocity, reference


def step(law: Any, state: Any, position_rad: float, velocity: Any, reference: Any) -> float:
    """`step_law` of a trajectory that does not repeat, the torque sent before being 0."""
    return step_law(law, state, position_rad, velocity, reference, 0.0, 0, 0.0, 0.0)


def test_every_term_has_the_sign_of_the_equation(law: Any) -> None:
    law.coriolis_Nmspr, law.gravity_Nm, law.gravity_zero_rad = 0.5, 3.0, 0.1
    law.feed_forward = FeedForward.DESIRED
    state, velocity, reference = blocks(law)
    velocity.velocity_radps = 0.25
    reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = 0.30, 0.20, -0.7
    position_rad = 0.31
    torque = step(law, state, position_rad, velocity, reference)
    e, rate = 0.01, 0.05
    assert state.inertia_torque_Nm == pytest.approx(2.1 * -0.7)
    assert state.feedback_torque_Nm == pytest.approx(-2.1 * (56.0 * rate + 784.0 * e))
    assert state.gravity_torque_Nm == pytest.approx(0.5 * 0.25 + 3.0 * math.sin(0.21))
    assert state.friction_torque_Nm == pytest.approx(121.0 * friction_motor_torque_Nm(law.friction, 0.20))
    assert state.network_torque_Nm == pytest.approx(0.15, rel=1e-3)
    parts = state.inertia_torque_Nm + state.feedback_torque_Nm + state.gravity_torque_Nm + state.friction_torque_Nm
    assert torque == pytest.approx(parts - state.network_torque_Nm)
    # a positive error must be pushed back by the network too: fhat, which is subtracted, grows
    assert np.all(state.network.weights > 0.01)


def test_the_output_is_that_of_the_old_weights(law: Any) -> None:
    state, velocity, reference = blocks(law)
    before = float(np.sum(state.network.weights))
    step(law, state, 0.1, velocity, reference)
    assert state.network_torque_Nm == pytest.approx(before, rel=2e-3)
    assert float(np.sum(state.network.weights)) > before * 1.01


def test_without_the_network_it_neither_acts_nor_learns(law: Any) -> None:
    law.kind = ControllerKind.COMPUTED_TORQUE
    state, velocity, reference = blocks(law)
    assert step(law, state, 0.1, velocity, reference) == pytest.approx(-2.1 * 784.0 * 0.1)
    assert state.network_torque_Nm == 0.0
    assert list(state.network.weights) == [0.01] * 15


@pytest.mark.parametrize(("matched", "rate_radps"), [(0, 0.3), (1, 0.07)])
def test_which_error_rate_is_used(law: Any, matched: int, rate_radps: float) -> None:
    law.kind, law.matched_filter = ControllerKind.COMPUTED_TORQUE, matched
    state, velocity, reference = blocks(law)
    velocity.velocity_radps, velocity.error_rate_radps, reference.velocity_radps = 0.5, 0.07, 0.2
    step(law, state, 0.0, velocity, reference)
    assert state.feedback_torque_Nm == pytest.approx(-2.1 * 56.0 * rate_radps)


@pytest.mark.parametrize(
    ("rule", "speed_radps"),
    [(FeedForward.NONE, 0.0), (FeedForward.MEASURED, 0.3), (FeedForward.DESIRED, -0.2)],
)
def test_feed_forward_velocity(law: Any, rule: int, speed_radps: float) -> None:
    law.feed_forward = rule
    state, _, _ = blocks(law)
    expected = 121.0 * friction_motor_torque_Nm(law.friction, speed_radps)
    assert friction_feed_forward_Nm(law, state, 0.3, -0.2) == pytest.approx(expected)


def test_feed_forward_by_lugre_keeps_its_deflection(law: Any) -> None:
    law.feed_forward = FeedForward.LUGRE_DESIRED
    state, _, _ = blocks(law)
    deflection = 0.0
    for _ in range(5):
        deflection, torque = step_lugre(law.lugre, law.friction, 121.0, deflection, -0.2, law.period_s)
        assert friction_feed_forward_Nm(law, state, 0.9, -0.2) == torque
        assert state.lugre_deflection_rad == deflection
    reset_law(law, state)
    assert state.lugre_deflection_rad == 0.0


def test_the_trap_of_the_paper_at_rest_is_the_users_choice(law: Any) -> None:
    law.feed_forward = FeedForward.MEASURED
    state, _, _ = blocks(law)
    law.zero_rule = ZeroSpeedRule.PAPER
    assert friction_feed_forward_Nm(law, state, 0.0, 0.1) == pytest.approx(121.0 * 0.14537)
    law.zero_rule = ZeroSpeedRule.ZERO
    assert friction_feed_forward_Nm(law, state, 0.0, 0.1) == 0.0


@pytest.mark.parametrize("kind", [ControllerKind.COMPUTED_TORQUE, ControllerKind.COMPUTED_TORQUE_RBF])
def test_closed_loop_on_the_exact_model(law: Any, kind: int) -> None:
    """Computed torque: the error of a constant load stays; with the network it goes."""
    law.kind = kind
    state, velocity, reference = blocks(law)
    position, speed, load_Nm = 0.0, 0.0, 5.0
    for _ in range(2000):
        velocity.velocity_radps = speed
        torque = step(law, state, position, velocity, reference)
        speed += (torque + load_Nm) / 2.1 * 1e-3
        position += speed * 1e-3
    alone_rad = load_Nm / (2.1 * 784.0)
    if kind == ControllerKind.COMPUTED_TORQUE:
        assert position == pytest.approx(alone_rad, rel=1e-3)
    else:
        # the slow mode of 16.5 s starts at a small fraction of what computed torque alone leaves
        assert 0.0 < position < 0.2 * alone_rad
        assert state.network_torque_Nm == pytest.approx(load_Nm, rel=0.15)
