"""The model of the sampled loop in itself: two ways to the same number, and limits where they must be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.analysis.linear_loop import linear_loop, sampled_joint
from jointctl.tools.analysis.margins import delay_margin_s, margins, phase_margin_deg
from tests.unit.analysis.specified_loops import ANY_KIND, Q1800, Q2500


@settings(max_examples=30, deadline=None)
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
@pytest.mark.parametrize("loop", ANY_KIND)
def test_frequency_response_and_state_space_agree(loop, delay_s):
    whole = linear_loop(replace(loop, delay_s=delay_s))
    omega = np.array([1.0, 80.0, 900.0, 3000.0])
    z = np.exp(1j * omega * 1e-3)
    by_states = -whole.joint.state_space().response(z) * whole.controller.response(z)
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
