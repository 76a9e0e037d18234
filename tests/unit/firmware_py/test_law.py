"""The control law (29) and its parts: velocity, Lyapunov equation (21), network (14), growth of what is learnt."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import friction_motor_torque_Nm, step_lugre
from jointctl.firmware_py.law import (
    GROWN,
    adapt_network,
    follow_temperature,
    friction_feed_forward_Nm,
    learning_torque_Nm,
    network_torque_Nm,
    record_correction,
    reset_law,
    reset_learning,
    reset_network,
    solve_lyapunov_p,
    step_law,
    watch_learning,
)
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import (
    PAIRED_FROM_radps,
    add_to_disturbance,
    low_pass_gain,
    reset_observer,
    step_observer,
    step_velocity,
)
from jointctl.firmware_py.records import (
    NEURONS,
    LawState,
    LearningConstants,
    LearningState,
    NetworkConstants,
    NetworkState,
    ObserverConstants,
    ObserverState,
    VelocityConstants,
    VelocityState,
)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, FeedForward, ZeroSpeedRule
from jointctl.firmware_py.trajectory import NO_REPETITION
from jointctl.tools.analysis.margins import eigenvalues, ultimate_bounds

# --- Velocity from position differences ---
PERIOD_s = 1e-3


def velocity_blocks(cutoff_Hz: float = 100.0) -> tuple[Any, Any]:
    constants, state = new(VelocityConstants)[0], new(VelocityState)[0]
    constants.period_s, constants.cutoff_Hz = PERIOD_s, cutoff_Hz
    constants.period_gain = low_pass_gain(cutoff_Hz, PERIOD_s)
    return constants, state


def test_the_gain_is_that_of_the_exact_discretisation() -> None:
    assert low_pass_gain(100.0, 1e-3) == pytest.approx(1.0 - math.exp(-0.2 * math.pi))
    assert low_pass_gain(0.0, 1e-3) == 1.0
    once, twice = low_pass_gain(30.0, 1e-3), low_pass_gain(30.0, 2e-3)
    assert 1.0 - twice == pytest.approx((1.0 - once) ** 2)


@pytest.mark.parametrize("gap_cycles", [1, 2, 5])
def test_the_first_sample_only_primes_and_a_gap_between_samples_is_counted(gap_cycles: int) -> None:
    constants, state = velocity_blocks(cutoff_Hz=0.0)
    step_velocity(constants, state, 0.7, 0.7, 1)
    assert (state.velocity_radps, state.error_rate_radps, state.primed) == (0.0, 0.0, 1)
    step_velocity(constants, state, 0.7 + 0.002 * gap_cycles, 0.7 + 0.001 * gap_cycles, gap_cycles)
    assert (state.velocity_radps, state.error_rate_radps) == pytest.approx((2.0, 1.0))


@pytest.mark.parametrize("gap_cycles", [1, 3])
def test_step_response_of_the_filter_depends_on_time_and_not_on_the_number_of_samples(gap_cycles: int) -> None:
    constants, state = velocity_blocks(cutoff_Hz=10.0)
    step_velocity(constants, state, 0.0, 0.0, 1)
    for k in range(gap_cycles, 31, gap_cycles):
        step_velocity(constants, state, 1.5 * k * PERIOD_s, 0.0, gap_cycles)
    assert state.velocity_radps == pytest.approx(1.5 * (1.0 - math.exp(-2.0 * math.pi * 10.0 * 0.030)))


def test_the_matched_filter_has_no_bias_where_the_plain_difference_has() -> None:
    """Perfect tracking of an accelerating reference: e' is zero, filtered velocity minus desired velocity is not."""
    constants, state = velocity_blocks(cutoff_Hz=30.0)
    for k in range(500):
        position = 0.5 * 2.0 * (k * PERIOD_s) ** 2
        step_velocity(constants, state, position, 0.0, 1)
    assert state.error_rate_radps == 0.0
    lag_radps = 2.0 * 499 * PERIOD_s - state.velocity_radps
    assert lag_radps == pytest.approx(2.0 / (2.0 * math.pi * 30.0), rel=0.2)


# --- The Lyapunov equation (21) and the ultimate bounds (30) ---
KP, KV = 784.0, 56.0


@pytest.mark.parametrize(
    ("q", "expected"), [(2500.0, (17611.607, 1.594388, 22.349900)), (1800.0, (12680.357, 1.147959, 16.091928))]
)
def test_both_matrices_of_the_paper(q: float, expected: tuple[float, ...]) -> None:
    p11, p12, p22 = solve_lyapunov_p(KP, KV, q, q)
    assert p11 == pytest.approx(expected[0], abs=5e-4)
    assert (p12, p22) == pytest.approx(expected[1:], abs=5e-7)


@pytest.mark.parametrize(
    ("kp", "kv", "q1", "q2"), [(784.0, 56.0, 2500.0, 2500.0), (2500.0, 130.0, 2.756e6, 4630.0), (1.0, 0.1, 3.0, 7.0)]
)
def test_the_equation_holds(kp: float, kv: float, q1: float, q2: float) -> None:
    p11, p12, p22 = solve_lyapunov_p(kp, kv, q1, q2)
    p = np.array([[p11, p12], [p12, p22]])
    a = np.array([[0.0, 1.0], [-kp, -kv]])
    np.testing.assert_allclose(p @ a + a.T @ p, -np.diag([q1, q2]), atol=1e-9 * max(q1, q2, p11 * kv))
    np.testing.assert_allclose(eigenvalues(p11, p12, p22), np.linalg.eigvalsh(p), rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(p) > 0.0)


@pytest.mark.parametrize("q", [1800.0, 2500.0])
def test_ultimate_bounds(q: float) -> None:
    """Both scale with eps0 and neither depends on q for Q = q I."""
    loose, tight = ultimate_bounds(*solve_lyapunov_p(KP, KV, q, q), q, q, 2.1, 1.0)
    assert loose == pytest.approx(6.71, abs=5e-3)
    assert tight == pytest.approx(0.0085, abs=5e-5)
    twice = ultimate_bounds(*solve_lyapunov_p(KP, KV, q, q), q, q, 2.1, 2.0)
    assert twice == pytest.approx((2.0 * loose, 2.0 * tight))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((0.0, 56.0, 1.0, 1.0), r"kp \(=0\)"),
        ((784.0, -1.0, 1.0, 1.0), r"kv \(=-1\)"),
        ((float("nan"), 56.0, 1.0, 1.0), r"kp \(=nan\)"),
        ((784.0, 56.0, 0.0, 1.0), r"Q \(=diag\(0, 1\)\)"),
        ((784.0, 56.0, 1.0, -1.0), r"Q \(=diag\(1, -1\)\)"),
    ],
)
def test_what_has_no_positive_solution_is_refused(arguments: tuple[float, ...], named: str) -> None:
    with pytest.raises(ValueError, match=named) as caught:
        solve_lyapunov_p(*arguments)
    assert "\n" not in str(caught.value)


# --- The network (14) and its adaptation law (24) ---
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


@pytest.mark.parametrize("leakage", [0.5, 0.0])
def test_leakage_forgets_exponentially_and_without_it_nothing_is_forgotten(leakage: float) -> None:
    constants, state = network()
    constants.leakage = leakage
    state.weights[:] = 2.0
    for _ in range(1000):
        network_torque_Nm(constants, state, 0.0, 0.0)
        adapt_network(constants, state, 0.0, 0.0, 1e-3)
    np.testing.assert_allclose(state.weights, 2.0 * math.exp(-leakage), rtol=1e-3 if leakage else 0.0)


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


# --- The control law (29), term by term and as a closed loop ---
@pytest.fixture
def law(axis_constants: Any) -> Any:
    return axis_constants[0].law


def blocks(law: Any) -> tuple[Any, Any, Any]:
    state, velocity, reference = new(LawState)[0], new(VelocityState)[0], new(Reference)[0]
    reset_law(law, state)
    return state, velocity, reference


def step(law: Any, state: Any, position_rad: float, velocity: Any, reference: Any) -> float:
    """`step_law` of a trajectory that does not repeat, the torque sent before being 0."""
    return step_law(law, state, position_rad, velocity, reference, 0.0, NO_REPETITION)


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
    law.kind, law.filtered_error_rate = ControllerKind.COMPUTED_TORQUE, matched
    state, velocity, reference = blocks(law)
    velocity.velocity_radps, velocity.error_rate_radps, reference.velocity_radps = 0.5, 0.07, 0.2
    step(law, state, 0.0, velocity, reference)
    assert state.feedback_torque_Nm == pytest.approx(-2.1 * 56.0 * rate_radps)


@pytest.mark.parametrize(
    ("rule", "speed_radps"), [(FeedForward.NONE, 0.0), (FeedForward.MEASURED, 0.3), (FeedForward.DESIRED, -0.2)]
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


def conditioned(law: Any) -> Any:
    friction = law.friction
    friction.conditioned, friction.load_coulomb, friction.temperature_coulomb_pK = 1, 0.2, 0.01
    friction.temperature_viscous_pK = 0.01
    friction.reference_degC, friction.lowest_degC, friction.highest_degC = 25.0, 0.0, 60.0
    law.temperature.gain = 0.5
    return law


def test_feed_forward_takes_the_torque_that_the_model_transmits(law: Any) -> None:
    """Inertia and gravity, each with its sign; friction goes with the size of their sum."""
    conditioned(law)
    law.kind, law.feed_forward = ControllerKind.COMPUTED_TORQUE, FeedForward.DESIRED
    law.gravity_Nm = 30.0
    state, velocity, reference = blocks(law)
    reference.velocity_radps, reference.acceleration_radps2 = 0.2, -4.0
    step(law, state, 0.5, velocity, reference)
    transmitted = -4.0 * 2.1 + 30.0 * math.sin(0.5 - law.gravity_zero_rad)
    plain = 121.0 * friction_motor_torque_Nm(law.friction, 0.2)
    assert state.friction_torque_Nm == pytest.approx(plain + 0.2 * abs(transmitted))


def test_the_temperature_of_the_feed_forward_is_the_last_that_was_read(law: Any) -> None:
    conditioned(law)
    law.feed_forward = FeedForward.DESIRED
    state, _, _ = blocks(law)
    plain = 121.0 * friction_motor_torque_Nm(law.friction, 0.2)
    follow_temperature(law, state, True)
    assert state.temperature_degC == 25.0  # none was read: the curve as it stands
    law.temperature.degC[0], law.temperature.time_ns[0] = 45.0, 1
    follow_temperature(law, state, False)
    assert state.temperature_degC == 35.0  # it does not jump while the joint moves
    for _ in range(200):
        follow_temperature(law, state, False)  # no new reading: held
    assert friction_feed_forward_Nm(law, state, 0.0, 0.2) == pytest.approx(plain * math.exp(-0.2))
    law.temperature.degC[0] = 5.0
    follow_temperature(law, state, True)
    assert friction_feed_forward_Nm(law, state, 0.0, 0.2) == pytest.approx(plain * math.exp(0.2))
    reset_law(law, state)  # the joint is about to be enabled: it does not begin with the temperature of the curve
    assert state.temperature_degC == 5.0


def test_a_known_ripple_is_taken_off_the_feed_forward_where_it_will_be(law: Any) -> None:
    law.kind, law.feed_forward = ControllerKind.COMPUTED_TORQUE, FeedForward.DESIRED
    state, velocity, reference = blocks(law)
    reference.velocity_radps = 0.2
    step(law, state, 0.5, velocity, reference)
    plain = state.friction_torque_Nm
    ripple = law.flexible.torque_ripple
    ripple.count, ripple.amplitude[0], ripple.turns_prad[0], ripple.phase_turns[0] = 1, 0.8, 242.0 / math.tau, 0.1
    for lead_s in (0.0, 0.01):
        law.feed_forward_lead_s = lead_s
        step(law, state, 0.5, velocity, reference)
        ahead_rad = reference.position_rad + lead_s * 0.2
        expected = plain - 0.8 * math.sin(242.0 * ahead_rad + 0.1 * math.tau)
        assert state.friction_torque_Nm == pytest.approx(expected, abs=1e-9)


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


# --- The observer that compares what was fed forward with the torque of its own command ---
def found_while_turning(law: Any, speed_radps: float, acceleration_radps2: float = 0.0) -> np.ndarray:
    """What the observer finds while the desired speed turns round every 100 cycles, and nothing else moves [Nm]."""
    state, velocity, reference = blocks(law)
    state.observer.speed_radps = speed_radps
    sent_Nm, found_Nm = 0.0, []
    for k in range(400):
        reference.velocity_radps = speed_radps if k // 100 % 2 else -speed_radps
        reference.acceleration_radps2 = acceleration_radps2
        sent_Nm = step_law(law, state, 0.0, velocity, reference, sent_Nm, NO_REPETITION)
        found_Nm.append(float(state.observer_torque_Nm))
    return np.array(found_Nm)


@pytest.mark.parametrize("paired", [1, 0])
@pytest.mark.parametrize("delay_cycles", [0, 1, 4])
def test_friction_fed_forward_ahead_is_a_disturbance_only_to_the_observer_that_is_not_paired(
    law: Any, delay_cycles: int, paired: int
) -> None:
    """The model is true and the friction comes when the command is torque: nothing moves that should not."""
    law.kind, law.feed_forward, law.filtered_error_rate = (
        ControllerKind.COMPUTED_TORQUE_OBSERVER, FeedForward.DESIRED, 1,
    )  # fmt: skip
    law.observer.bandwidth_radps, law.observer.delay_cycles, law.observer.paired = 60.0, delay_cycles, paired
    found_Nm = np.abs(found_while_turning(law, 0.2))
    if paired:
        assert max(found_Nm) < 1e-12
    else:  # some 17 Nm that turn round, for as many cycles as a command takes, at 60 rad/s
        assert max(found_Nm) > 0.06 * 17.0 * (delay_cycles + 1)


@pytest.mark.parametrize(("speed_radps", "alike"), [(0.8 * PAIRED_FROM_radps, True), (1.2 * PAIRED_FROM_radps, False)])
def test_where_the_joint_hardly_moves_both_observers_are_the_same(law: Any, speed_radps: float, alike: bool) -> None:
    law.kind, law.feed_forward, law.filtered_error_rate = (
        ControllerKind.COMPUTED_TORQUE_OBSERVER, FeedForward.DESIRED, 1,
    )  # fmt: skip
    law.observer.bandwidth_radps, law.observer.delay_cycles = 60.0, 3
    plain = found_while_turning(law, speed_radps)
    law.observer.paired = 1
    paired = found_while_turning(law, speed_radps)
    assert np.max(np.abs(plain)) > 1.0
    assert np.allclose(paired, plain, atol=1e-9) == alike


def test_inertia_that_is_fed_forward_is_no_disturbance_to_the_paired_observer(law: Any) -> None:
    """The momentum is that of the error, so that the torque of the whole motion is off both sides."""
    law.kind, law.feed_forward, law.filtered_error_rate = ControllerKind.COMPUTED_TORQUE_OBSERVER, FeedForward.NONE, 1
    law.observer.bandwidth_radps, law.observer.delay_cycles, law.observer.paired = 60.0, 3, 1
    assert np.max(np.abs(found_while_turning(law, 0.2, 5.0))) < 1e-12


@pytest.mark.parametrize("lead_s", [0.0, 0.003])
def test_inertia_is_fed_forward_for_the_acceleration_that_will_be(law: Any, lead_s: float) -> None:
    law.kind, law.feed_forward_lead_s = ControllerKind.COMPUTED_TORQUE, lead_s
    state, velocity, reference = blocks(law)
    reference.acceleration_radps2, reference.jerk_radps3 = 0.4, -30.0
    step(law, state, 0.5, velocity, reference)
    assert state.inertia_torque_Nm == pytest.approx(law.inertia_kgm2 * (0.4 - 30.0 * lead_s))


@pytest.mark.parametrize("paired", [1, 0])
def test_a_torque_that_is_handed_over_is_not_taken_back_by_commands_on_their_way(paired: int) -> None:
    constants, state = new(ObserverConstants)[0], new(ObserverState)[0]
    constants.bandwidth_radps, constants.delay_cycles, constants.paired = 60.0, 5, paired
    reset_observer(state, 0.0)
    fed_Nm = 8.0
    for _ in range(1000):  # all of it is fed forward, nothing is unknown
        step_observer(constants, state, 0.0 if paired else fed_Nm, 0.0 if paired else fed_Nm, 0.0, 1e-3)
    add_to_disturbance(constants, state, fed_Nm)
    for _ in range(20):
        assert step_observer(constants, state, fed_Nm, 0.0, 0.0, 1e-3) == pytest.approx(fed_Nm)


# --- Iterative learning that makes the error grow is switched off; its twin goes on learning ---
BINS = 40
CYCLE_s = 1e-3


def learning() -> tuple[Any, Any]:
    """(`LearningConstants`, `LearningState`) of a repetition of 40 cycles."""
    constants, state = new(LearningConstants)[0], new(LearningState)[0]
    constants.gain, constants.blend_s, constants.growth = 0.5, 0.01, 1.05
    constants.half_width, constants.lead_cycles = 1, 1
    reset_learning(state)
    return constants, state


def repeat(constants: Any, state: Any, errors_rad: Sequence[float], *, epoch: int = 0, more: int = 1) -> list[float]:
    """A repetition with each of these errors, of changing sign, and `more` cycles; the torques [Nm]."""
    torques = []
    for cycle in range(BINS * len(errors_rad) + more):
        place = cycle % BINS
        torques.append(learning_torque_Nm(constants, state, epoch, BINS * CYCLE_s, (place + 0.5) * CYCLE_s, CYCLE_s))
        error = errors_rad[min(cycle // BINS, len(errors_rad) - 1)] * (-1.0) ** cycle
        watch_learning(constants, state, error)
        record_correction(constants, state, 10.0)
    return torques


@pytest.mark.trips("loop: what it learns", "(1.05 + 1e-9, True)")
@pytest.mark.stays("loop: what it learns", "(1.05 - 1e-9, False)")
@pytest.mark.parametrize(("growth", "stops"), [(1.05 + 1e-9, True), (1.05 - 1e-9, False)])
def test_an_error_that_grows_in_three_repetitions_switches_learning_off(growth: float, stops: bool) -> None:
    constants, state = learning()
    errors = [1e-3 * growth**i for i in range(GROWN + 1)]
    repeat(constants, state, errors)
    assert bool(state.stopped) is stops
    assert state.error_rad == pytest.approx(errors[-1], rel=1e-12)
    assert state.grown == (GROWN if stops else 0)


@pytest.mark.parametrize(
    ("errors_mrad", "grown"),
    [
        ([1, 2, 4], GROWN - 1),  # two that grow are not enough
        ([1, 2, 4, 3, 5, 9], 2),  # a better one begins anew
        ([1], 0),  # the first one is compared with nothing
        ([0, 1, 2, 3], 2),  # and nothing has grown from no error at all
    ],
)
def test_what_does_not_grow_three_times_in_a_row_goes_on(errors_mrad: list[int], grown: int) -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3 * error for error in errors_mrad])
    assert (state.grown, state.stopped, state.samples) == (grown, 0, 1)
    assert state.error_rad == pytest.approx(1e-3 * errors_mrad[-1])


def test_what_was_learned_fades_out_over_the_blend_time_and_stays_off() -> None:
    constants, state = learning()
    torques = repeat(constants, state, [1e-3, 1e-3, 1e-3, 1e-3])
    assert torques[-1] > 4.9
    before = float(state.torque_Nm)
    state.stopped = 1
    learned = state.learned_Nm[:BINS].copy()
    faded = repeat(constants, state, [1e-3, 1e-3], more=0)
    steps = [a - b for a, b in zip([before, *faded], faded, strict=False)]
    assert faded[0] < before
    assert max(abs(step) for step in steps) < 0.2 * before  # 10 cycles
    assert faded[12:] == [0.0] * (2 * BINS - 12)
    assert state.weight == 0.0
    assert (state.learned_Nm[:BINS] == learned).all()  # nothing is learned any more
    assert state.samples < BINS  # nor watched


def test_a_change_of_trajectory_does_not_switch_it_on_again() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3, 8e-3])
    assert state.stopped == 1
    reset_learning(state)
    torques = repeat(constants, state, [1e-3] * 4, epoch=1)
    assert (state.stopped, torques) == (1, [0.0] * len(torques))


def test_a_change_of_trajectory_begins_the_comparison_anew() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3])
    repeat(constants, state, [9e-3, 9e-3], epoch=1)
    assert (state.grown, state.stopped, state.error_rad) == (0, 0, pytest.approx(9e-3))


@pytest.mark.parametrize("watched", [True, False])
def test_without_a_limit_it_is_not_watched(watched: bool) -> None:
    constants, state = learning()
    constants.growth = 1.05 if watched else 0.0
    repeat(constants, state, [1e-3, 2e-3, 4e-3, 8e-3])
    assert bool(state.stopped) is watched
    assert bool(state.samples > 0) is watched


def test_what_does_not_repeat_is_not_watched() -> None:
    constants, state = learning()
    learning_torque_Nm(constants, state, 0, 0.0, 0.0, CYCLE_s)
    watch_learning(constants, state, 1.0)
    assert (state.samples, state.squares_rad2) == (0, 0.0)
