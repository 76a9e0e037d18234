"""Margins of the linear loop: against the control specification, the model in itself, and the kernels in lockstep."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from jointctl.firmware_py.kernel import JIT_DISABLED, kernel
from jointctl.firmware_py.law import reset_law, solve_lyapunov_p, step_law
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import low_pass_gain, set_kalman_gains, step_velocity
from jointctl.firmware_py.records import LawConstants, LawState, VelocityConstants, VelocityState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind
from jointctl.firmware_py.trajectory import NO_REPETITION
from jointctl.hil.plant import plant, step_plant
from jointctl.hil.plant_records import DELAY_SLOTS
from jointctl.tools.analysis.linear_loop import LoopSettings, linear_loop, loop_settings, sampled_joint
from jointctl.tools.analysis.margin_gate import longest_delay_s, remedies
from jointctl.tools.analysis.margins import (
    delay_margin_s,
    least_between,
    margins,
    margins_on_grid,
    phase_margin_deg,
    row_response,
    theory,
    zero_between,
)
from tests.configurations import shipped


# --- Zeros and minima by narrowing, against places that are known ---
@pytest.mark.parametrize(("low", "high"), [(0.0, 2.0), (1.4, 1.5)])
def test_a_zero(low: float, high: float) -> None:
    assert zero_between(lambda x: x * x - 2.0, low, high) == pytest.approx(math.sqrt(2.0), abs=1e-12)


def test_a_zero_at_an_end_and_one_between_numbers_that_do_not_get_closer() -> None:
    assert zero_between(lambda x: x - 1.0, 1.0, 3.0) == pytest.approx(1.0, abs=1e-12)
    assert zero_between(lambda x: x - 1e9, 0.0, 3e9) == pytest.approx(1e9, abs=1e-6)


def test_no_zero_is_told() -> None:
    with pytest.raises(ValueError, match=r"no change of sign between 2\.0 and 3\.0"):
        zero_between(lambda x: x * x - 2.0, 2.0, 3.0)


@pytest.mark.parametrize(("low", "high", "place"), [(0.0, 3.0, 1.0), (1.5, 3.0, 1.5), (-1.0, 0.5, 0.5)])
def test_a_minimum_inside_and_at_either_end(low: float, high: float, place: float) -> None:
    found, value = least_between(lambda x: np.abs(x - 1.0) + 0.25, low, high)
    assert found == pytest.approx(place, abs=1e-8)
    assert value == pytest.approx(abs(place - 1.0) + 0.25, abs=1e-8)


# --- Two ways to the same response, and margins read off a grid ---
@pytest.mark.parametrize("name", ["precise", "paper", "realistic", "csp"])
def test_a_row_of_many_points_is_the_response(name: str) -> None:
    chosen, _ = loop_settings(shipped(name))
    z = np.exp(1j * np.geomspace(1.0, math.pi / chosen.period_s, 300) * chosen.period_s)
    law = linear_loop(chosen).controller
    expected = law.response(z)[:, 0]
    np.testing.assert_allclose(row_response(law, z), expected, rtol=0.0, atol=1e-9 * np.max(np.abs(expected)))


def test_margins_on_a_grid_are_those_of_the_loop() -> None:
    chosen, _ = loop_settings(shipped("precise"))
    omega = np.geomspace(1.0, math.pi / chosen.period_s, 2000)
    (phase,), (gain,), (peak,) = margins_on_grid(linear_loop(chosen).open_loop(omega)[None, :])
    exact = margins(chosen)
    assert phase == pytest.approx(exact.phase_margin_deg, abs=0.01)
    assert gain == pytest.approx(min(exact.gain_margin_up, 1.0 / max(exact.gain_margin_down, 1e-9)), rel=1e-3)
    assert peak == pytest.approx(exact.sensitivity_peak, rel=1e-3)


# --- The loops of section 4 of the control specification ---
_HALF = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
CENTRES = tuple((c, c) for c in (*_HALF, 0.0, *(-c for c in _HALF)))
Q1800 = LoopSettings(
    kind=ControllerKind.COMPUTED_TORQUE_RBF,
    period_s=1e-3,
    delay_s=1e-3,
    lag_s=0.5e-3,
    inertia_kgm2=2.1,
    kp=784.0,
    kv=56.0,
    cutoff_Hz=100.0,
    q=(1800.0, 1800.0),
    learning_rate=80.0,
    centres=CENTRES,
    widths=(5.0,) * 15,
    weight_Nm=0.01,
)
Q2500 = replace(Q1800, q=(2500.0, 2500.0))
ANY_KIND = (
    Q1800,
    replace(Q1800, kind=ControllerKind.COMPUTED_TORQUE),
    replace(Q1800, kind=ControllerKind.PID, kp=3 * 45.0**2, kv=3 * 45.0, ki=45.0**3),
    replace(Q1800, kind=ControllerKind.COMPUTED_TORQUE_OBSERVER, observer_radps=60.0, observer_delay_cycles=1),
)
KALMAN = replace(ANY_KIND[3], kalman=True, kp=2500.0, kv=100.0, cutoff_Hz=40.0, observer_radps=40.0)


# --- The model of the sampled loop in itself: two ways to the same number, and limits where they must be ---
@settings(max_examples=30)
@given(st.floats(0.0, 3.7), st.sampled_from([0.0, 1e-5, 5e-4, 3e-3]), st.floats(5e-4, 4e-3))
def test_the_sampled_joint_is_the_matrix_exponential(delay_periods, lag_s, period_s):
    joint = sampled_joint(period_s, delay_periods * period_s, lag_s, 2.1)
    assert joint.whole == math.floor(delay_periods + 1e-9)
    fraction_s = (delay_periods - joint.whole) * period_s
    # (q, q', torque, command); without lag the torque is the command and no state
    continuous = np.zeros((4, 4))
    continuous[0, 1] = 1.0
    if lag_s > 0.0:
        continuous[1, 2], continuous[2, 2], continuous[2, 3] = 1.0 / 2.1, -1.0 / lag_s, 1.0 / lag_s
    else:
        continuous[1, 3] = 1.0 / 2.1
    before, after = expm(continuous * fraction_s), expm(continuous * (period_s - fraction_s))
    n = 3 if lag_s > 0.0 else 2
    assert joint.late[:n] == pytest.approx(after[:n, 3], rel=1e-6, abs=1e-10)
    assert joint.early[:n] == pytest.approx(after[:n, :n] @ before[:n, 3], rel=1e-6, abs=1e-10)
    assert joint.phi[:n, :n] == pytest.approx((after @ before)[:n, :n], rel=1e-6, abs=1e-10)


@pytest.mark.parametrize("delay_s", [0.0, 0.3e-3, 1e-3, 2.6e-3, 3e-3])
@pytest.mark.parametrize("loop", [*ANY_KIND, KALMAN])
def test_frequency_response_and_state_space_agree(loop, delay_s):
    whole = linear_loop(replace(loop, delay_s=delay_s))
    omega = np.array([1.0, 80.0, 900.0, 3000.0])
    z = np.exp(1j * omega * 1e-3)
    by_states = -(whole.controller.response(z) @ whole.joint.state_space().response(z))[:, 0, 0]
    assert whole.open_loop(omega) == pytest.approx(by_states, rel=1e-7)


def test_no_jump_where_the_delay_reaches_a_whole_period():
    for whole in (1e-3, 3e-3):
        around = [phase_margin_deg(replace(Q1800, delay_s=whole + d)) for d in (-1e-9, -1e-13, 0.0, 1e-13, 1e-9)]
        assert max(around) - min(around) < 1e-4


@pytest.mark.parametrize(
    "loop", [*ANY_KIND, Q2500, replace(Q1800, q=(2.756e6, 4630.0), kp=2500.0, kv=130.0, cutoff_Hz=0.0)]
)
def test_each_margin_is_where_an_eigenvalue_leaves_the_unit_circle(loop):
    found, whole = margins(loop), linear_loop(loop)
    assert found.stable
    assert whole.is_stable(found.gain_margin_up * 0.999)
    assert not whole.is_stable(found.gain_margin_up * 1.001)
    if found.gain_margin_down > 0.0:
        assert whole.is_stable(found.gain_margin_down * 1.01)
        assert not whole.is_stable(found.gain_margin_down * 0.99)
    assert linear_loop(replace(loop, delay_s=loop.delay_s + 0.999 * found.delay_margin_s)).is_stable()
    assert not linear_loop(replace(loop, delay_s=loop.delay_s + 1.001 * found.delay_margin_s)).is_stable()
    assert found.sensitivity_peak >= 0.5 / math.sin(math.radians(found.phase_margin_deg) / 2.0)
    assert found.sensitivity_peak >= found.gain_margin_up / (found.gain_margin_up - 1.0) - 1e-6


def test_margins_fall_with_delay_up_to_the_limit_and_are_zero_beyond():
    limit_s = delay_margin_s(replace(Q2500, delay_s=0.0))
    values = [
        phase_margin_deg(replace(Q2500, delay_s=limit_s * share)) for share in (0.0, 0.5, 0.9, 0.99, 0.999, 1.001)
    ]
    assert values == sorted(values, reverse=True)
    assert 0.0 < values[-2] < 0.1
    assert values[-1] == 0.0


def test_computed_torque_alone_has_the_margin_of_no_adaptation():
    for change in ({"kind": ControllerKind.COMPUTED_TORQUE}, {"learning_rate": 0.0}):
        assert phase_margin_deg(replace(Q1800, **change)) == pytest.approx(
            phase_margin_deg(replace(Q1800, learning_rate=1e-9)), abs=1e-3
        )


def test_weights_act_by_the_gradient_of_the_hidden_layer():
    """Centres on one side and a weight: fhat = w exp(-|c|^2 / 2 b^2) (1 + c x / b^2), a spring and a damper."""
    one = replace(Q1800, centres=((0.02, 0.04),), widths=(0.05,), weight_Nm=3.0, learning_rate=0.0)
    slope = 3.0 * math.exp(-(0.02**2 + 0.04**2) / (2 * 0.05**2)) / 0.05**2
    same = replace(
        one, kind=ControllerKind.COMPUTED_TORQUE, kp=784.0 + 0.02 * slope / 2.1, kv=56.0 + 0.04 * slope / 2.1
    )
    assert phase_margin_deg(one) == pytest.approx(phase_margin_deg(same), rel=1e-9)
    assert phase_margin_deg(one) != pytest.approx(phase_margin_deg(replace(one, weight_Nm=0.0)), rel=1e-3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"delay_s": -1e-6}, "delay_s (=-1e-06) must be >= 0"),
        ({"delay_s": math.nan}, "delay_s (=nan) must be finite"),
        ({"delay_s": 0.6}, "delay_s (=0.6) must be in [0..0.5], 500 periods"),
        ({"period_s": 0.0}, "period_s (=0) must be > 0"),
        ({"inertia_kgm2": -1.0}, "inertia_kgm2 (=-1) must be > 0"),
        ({"widths": (5.0,)}, "as many as centres (15)"),
        ({"kind": 77}, "kind (=77) must be one of COMPUTED_TORQUE, COMPUTED_TORQUE_RBF"),
    ],
)
def test_bad_settings_are_named(change, text):
    with pytest.raises(ValueError, match="must be") as caught:
        replace(Q1800, **change)
    assert text in str(caught.value)


# --- Margins of the linear loop against section 4 of the control specification, and the advice that follows ---
# --- section 4 of the control specification ---
@pytest.mark.parametrize(("loop", "phase_deg", "delay_ms"), [(Q1800, 24.0, 5.1), (Q2500, 17.0, 3.2)])
def test_margins_of_the_specification(loop, phase_deg, delay_ms):
    found = margins(loop)
    assert found.stable
    assert round(found.phase_margin_deg) == phase_deg
    # the delay margin is what may be added to the 1 ms, not the total
    assert round(found.delay_margin_s * 1e3, 1) == delay_ms
    total = delay_margin_s(replace(loop, delay_s=0.0))
    assert total == pytest.approx(found.delay_margin_s + 1e-3, abs=1e-8)


def test_three_milliseconds_at_500_Hz_are_unstable_and_its_twin_is_not():
    slow = replace(Q2500, period_s=2e-3, delay_s=3e-3, lag_s=1e-3)
    found = margins(slow)
    assert not found.stable
    assert (found.phase_margin_deg, found.delay_margin_s, found.gain_margin_up) == (0.0, 0.0, 1.0)
    assert found.oscillation_damping < 0.0
    assert margins(replace(slow, delay_s=2e-3)).stable


@pytest.mark.parametrize(("delay_ms", "decays"), [(4.0, True), (4.4, True), (4.41, False), (5.0, False)])
def test_frictionless_check(delay_ms, decays):
    assert linear_loop(replace(Q2500, lag_s=0.3e-3, delay_s=delay_ms * 1e-3)).is_stable() is decays


def test_a_filter_of_30_Hz_leaves_one_degree_and_is_unstable_from_a_delay_of_1_2_ms_on():
    """The specification calls 30 Hz unstable at Q = 2500; with just 1 ms and 0.5 ms lag the linear loop still holds."""
    slow_filter = replace(Q2500, cutoff_Hz=30.0)
    found = margins(slow_filter)
    assert found.stable
    assert found.phase_margin_deg == pytest.approx(1.03, abs=0.02)
    assert found.sensitivity_peak > 50.0
    assert 1e-3 + found.delay_margin_s == pytest.approx(1.204e-3, abs=2e-6)
    for delay_s, stable in ((1.19e-3, True), (1.21e-3, False), (1.5e-3, False), (2e-3, False)):
        assert linear_loop(replace(slow_filter, delay_s=delay_s)).is_stable() is stable
        assert linear_loop(replace(Q2500, delay_s=delay_s)).is_stable()
    assert not linear_loop(replace(slow_filter, cutoff_Hz=28.0)).is_stable()


def test_theory_of_the_specification():
    found = theory(Q1800)
    assert found.p == pytest.approx((12680.357, 1.147959, 16.091928), rel=1e-6)
    assert found.p_eigenvalues == pytest.approx((16.0918, 12680.357), rel=1e-5)
    assert found.bound_per_Nm == pytest.approx(6.71, abs=0.005)
    assert found.tight_bound_per_Nm == pytest.approx(0.0085, abs=5e-5)
    assert found.natural_frequency_radps == pytest.approx(71.9, abs=0.1)
    assert math.sqrt(found.polynomial[2]) == pytest.approx(71.9, abs=0.05)
    assert found.damping == pytest.approx(0.39, abs=0.005)
    assert found.slowest_time_constant_s == pytest.approx(16.5, abs=0.05)
    assert margins(Q1800).slowest_time_constant_s == pytest.approx(16.5, abs=0.05)  # as that of the sampled loop
    # printed for h = 1 at every neuron; with b = 5 the squares of h sum to 14.9996 instead of 15
    assert theory(Q2500).polynomial == pytest.approx((1.0, 56.0, 6866.0, 434.0), rel=5e-4)
    assert theory(Q2500).p == pytest.approx((17611.607, 1.594388, 22.349900), rel=1e-6)


def test_leakage_makes_the_slow_mode_faster_than_its_own_time_constant_allows_to_forget():
    leaking = theory(replace(Q1800, leakage_1ps=0.5))
    assert leaking.polynomial == pytest.approx(
        (1.0, 56.5, theory(Q1800).polynomial[2] + 0.5 * 56.0, theory(Q1800).polynomial[3] + 0.5 * 784.0)
    )
    assert margins(replace(Q1800, leakage_1ps=0.5)).slowest_time_constant_s == pytest.approx(
        leaking.slowest_time_constant_s, rel=1e-3
    )


@pytest.mark.parametrize("loop", ANY_KIND)
def test_a_fast_sampled_loop_has_the_poles_of_the_theory(loop):
    fast = replace(loop, period_s=5e-6, delay_s=0.0, lag_s=0.0, cutoff_Hz=0.0, observer_delay_cycles=0)
    expected = theory(fast).polynomial
    z = sorted(linear_loop(fast).closed_loop_poles(), key=abs)[1 - len(expected) :]
    # by their polynomial, because a double pole is ill-conditioned
    assert np.poly(np.log(z) / fast.period_s).real == pytest.approx(expected, rel=3e-3)


def test_theory_without_a_network_has_no_p():
    found = theory(ANY_KIND[1])
    assert (found.p, found.bound_per_Nm) == (None, None)
    assert found.polynomial == (1.0, 56.0, 784.0)
    assert theory(ANY_KIND[2]).slowest_time_constant_s == pytest.approx(1.0 / 45.0, rel=1e-3)


# --- advice ---
@pytest.mark.parametrize("loop", [Q2500, replace(Q2500, delay_s=8e-3), replace(ANY_KIND[2], delay_s=9e-3)])
def test_every_remedy_reaches_the_margin(loop):
    wanted = 25.0
    found = remedies(loop, wanted)
    assert found
    for remedy in found:
        assert remedy.phase_margin_deg >= wanted
        assert phase_margin_deg(remedy.settings) == remedy.phase_margin_deg
        assert remedy.phase_margin_deg < wanted + 1.0  # not more than needed


def test_the_largest_q_is_named_with_its_number():
    text = next(remedy.text for remedy in remedies(Q2500, 20.0) if "control.lyapunov_q" in remedy.text)
    assert text.startswith("control.lyapunov_q = 2170 (now 2500")
    assert phase_margin_deg(replace(Q2500, q=(2170.0, 2170.0))) >= 20.0
    assert phase_margin_deg(replace(Q2500, q=(2180.0, 2180.0))) < 20.0


def test_longest_delay():
    longest_s = longest_delay_s(Q2500, 20.0)
    assert longest_s == pytest.approx(0.391e-3)
    assert phase_margin_deg(replace(Q2500, delay_s=longest_s)) >= 20.0
    assert longest_delay_s(Q1800, 20.0) == Q1800.delay_s
    assert longest_delay_s(Q1800, 60.0) is None


# --- Delay limits of the linear loop against the real kernels on the simulated joint ---
# plain Python is three hundred times slower: coarser and shorter there
SUBSTEP_s = 100e-6 if JIT_DISABLED else 25e-6


PERIOD_s = 1e-3


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
        torque = step_law(law_c, law_s, q, velocity_s, reference, torque, NO_REPETITION)
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


def law_records(loop: LoopSettings, matched: bool):
    """The law's constants and state, at rest."""
    law_c, law_s = new(LawConstants), new(LawState)
    law = law_c[0]
    law.kind, law.period_s, law.filtered_error_rate = loop.kind, loop.period_s, matched
    law.inertia_kgm2, law.kp, law.kv, law.ki = loop.inertia_kgm2, loop.kp, loop.kv, loop.ki
    law.observer.bandwidth_radps, law.observer.delay_cycles = loop.observer_radps, loop.observer_delay_cycles
    if loop.kalman:
        law.observer.kalman, law.observer.cutoff_Hz = 1, loop.cutoff_Hz
        set_kalman_gains(law.observer, loop.period_s)
    _, p12, p22 = solve_lyapunov_p(loop.kp, loop.kv, *loop.q)
    network = law.network
    network.p_b[0], network.p_b[1] = p12 / loop.inertia_kgm2, p22 / loop.inertia_kgm2
    network.centres[:] = loop.centres
    network.inverse_width[:] = [0.5 / b**2 for b in loop.widths]
    network.learning_rate, network.leakage = loop.learning_rate, loop.leakage_1ps
    reset_law(law, law_s[0])
    return law_c, law_s


def decays(loop: LoopSettings, delay_substeps: int, matched: bool) -> bool:
    """Whether the simulated joint comes to rest with this delay."""
    law_c, law_s = law_records(loop, matched)
    velocity_c, velocity_s, reference = new(VelocityConstants), new(VelocityState), new(Reference)
    velocity_c[0].period_s, velocity_c[0].cutoff_Hz = loop.period_s, loop.cutoff_Hz
    velocity_c[0].period_gain = low_pass_gain(loop.cutoff_Hz, loop.period_s)
    plant_c, plant_s = plant(
        step_s=SUBSTEP_s,
        inertia_kgm2=loop.inertia_kgm2,
        current_limit_A=1e4,
        current_lag_s=loop.lag_s,
        command_delay_s=delay_substeps * SUBSTEP_s,
        initial_position_rad=START_rad,
    )
    early, late = energies(
        law_c[0], law_s[0], velocity_c[0], velocity_s[0], reference[0], plant_c[0], plant_s[0],
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


def kalman_sets() -> list[LoopSettings]:
    """Seeded, around what docs/law.md recommends for coarse encoders, at three rates."""
    rng = np.random.default_rng(31)
    return [
        replace(
            KALMAN,
            period_s=(5e-4, 1e-3, 2e-3)[i % 3],
            lag_s=rng.uniform(0.0, 1e-3),
            cutoff_Hz=rng.uniform(25.0, 90.0),
            kp=2500.0 * rng.uniform(0.5, 1.5),
            kv=100.0 * rng.uniform(0.7, 1.3),
            observer_radps=rng.uniform(20.0, 80.0),
            observer_delay_cycles=int(rng.integers(0, 3)),
            inertia_kgm2=rng.uniform(0.5, 5.0),
        )
        for i in range(6)
    ]


FRICTIONLESS = replace(Q2500, lag_s=0.3e-3, weight_Nm=0.0)
OTHERS = [replace(Q2500, cutoff_Hz=30.0, weight_Nm=0.0), *gain_sets(), *kalman_sets()]
SIMULATED = [(FRICTIONLESS, False), (FRICTIONLESS, True), *((loop, i % 2 == 0) for i, loop in enumerate(OTHERS))]


@pytest.mark.parametrize("case", range(2 if JIT_DISABLED else len(SIMULATED)))
def test_predicted_and_simulated_delay_limits_agree(case):
    loop, matched = replace(SIMULATED[case][0], delay_s=0.0), SIMULATED[case][1]
    limit_s = delay_margin_s(loop)
    expected = limit_s / SUBSTEP_s
    margin = max(8, round(0.2 * expected))
    found = simulated_limit_substeps(
        loop, max(round(expected) - margin, 0), min(round(expected) + margin, DELAY_SLOTS - 1), matched
    )
    # the virtual joint takes the torque at the end of a substep for all of it: half a substep less lag
    assert abs(found + 0.5 - expected) <= 1.5, (limit_s, found * SUBSTEP_s)


@kernel
def injected_loop(
    law_c, law_s, velocity_c, velocity_s, reference, plant_c, plant_s, substeps, injected_Nm, commands, torques
):
    """The closed loop, `injected_Nm` added behind the law: what the law asks for, and what the joint is given."""
    torque = 0.0
    for k in range(len(injected_Nm)):
        q = plant_s.joint_position_rad
        step_velocity(velocity_c, velocity_s, q, q, 1)  # the Kalman filter does without
        torque = step_law(law_c, law_s, q, velocity_s, reference, torque, NO_REPETITION)
        commands[k] = torque
        torques[k] = torque + injected_Nm[k]
        for _ in range(substeps):
            step_plant(plant_c, plant_s, torques[k])


@pytest.mark.parametrize("case", range(1 if JIT_DISABLED else 9))
def test_injected_sines_find_the_gain_and_phase_of_kalman_filter_and_paired_observer(case):
    observer = replace(ANY_KIND[3], lag_s=(0.3e-3, 0.5e-3, 1e-3)[case % 3], observer_delay_cycles=case % 3)
    loop = replace([*kalman_sets(), observer, observer, observer][case], period_s=PERIOD_s, delay_s=1e-3)
    law_c, law_s = law_records(loop, True)
    law_c[0].observer.paired = not loop.kalman
    velocity_c = new(VelocityConstants)
    velocity_c[0].period_s, velocity_c[0].cutoff_Hz = loop.period_s, loop.cutoff_Hz
    velocity_c[0].period_gain = low_pass_gain(loop.cutoff_Hz, loop.period_s)
    plant_c, plant_s = plant(
        step_s=SUBSTEP_s, inertia_kgm2=loop.inertia_kgm2, current_limit_A=1e4, current_lag_s=loop.lag_s,
        command_delay_s=loop.delay_s,
    )  # fmt: skip
    found = margins(loop)
    assert found.stable
    period = 1000
    for line in sorted(
        {round(found.crossover_Hz), 2 * round(found.crossover_Hz), round(found.sensitivity_peak_Hz), 40}
    ):
        reset_law(law_c[0], law_s[0])
        injected = 1e-4 * np.sin(math.tau * line * np.arange(6 * period) / period)
        commands, torques = np.zeros(len(injected)), np.zeros(len(injected))
        injected_loop(
            law_c[0], law_s[0], velocity_c[0], new(VelocityState)[0], new(Reference)[0], plant_c[0], plant_s[0],
            round(PERIOD_s / SUBSTEP_s), injected, commands, torques,
        )  # fmt: skip
        wave = np.exp(-1j * math.tau * line * np.arange(period) / period)
        measured = -(commands[-period:] @ wave) / (torques[-period:] @ wave)
        # the virtual joint takes the torque at the end of a substep for all of it: half a substep less lag
        modelled = linear_loop(replace(loop, delay_s=loop.delay_s - 0.5 * SUBSTEP_s))
        expected = modelled.open_loop(np.array([math.tau * line]))[0]
        assert abs(measured) == pytest.approx(abs(expected), rel=0.03)
        assert abs(math.degrees(np.angle(measured / expected))) < 1.0
