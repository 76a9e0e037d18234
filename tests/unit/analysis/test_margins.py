"""Margins of the linear loop against section 4 of the control specification, and the advice that follows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jointctl.tools.analysis.linear_loop import linear_loop
from jointctl.tools.analysis.margin_gate import longest_delay_s, remedies
from jointctl.tools.analysis.margins import delay_margin_s, margins, phase_margin_deg, theory
from tests.unit.analysis.specified_loops import ANY_KIND, Q1800, Q2500

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
    # printed for h = 1 at every neuron; with b = 5 the squares of h sum to 14.9996 instead of 15
    assert theory(Q2500).polynomial == pytest.approx((1.0, 56.0, 6866.0, 434.0), rel=5e-4)
    assert theory(Q2500).p == pytest.approx((17611.607, 1.594388, 22.349900), rel=1e-6)


def test_the_sampled_loop_keeps_the_slow_mode_of_the_theory():
    assert margins(Q1800).slowest_time_constant_s == pytest.approx(16.5, abs=0.05)


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
    text = next(remedy.text for remedy in remedies(Q2500, 20.0) if "control.q" in remedy.text)
    assert text.startswith("control.q = 2170 (now 2500")
    assert phase_margin_deg(replace(Q2500, q=(2170.0, 2170.0))) >= 20.0
    assert phase_margin_deg(replace(Q2500, q=(2180.0, 2180.0))) < 20.0


def test_longest_delay():
    longest_s = longest_delay_s(Q2500, 20.0)
    assert longest_s == pytest.approx(0.391e-3)
    assert phase_margin_deg(replace(Q2500, delay_s=longest_s)) >= 20.0
    assert longest_delay_s(Q1800, 20.0) == Q1800.delay_s
    assert longest_delay_s(Q1800, 60.0) is None
