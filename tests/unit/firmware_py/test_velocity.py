"""Velocity from position differences."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.firmware_py.axis import low_pass_gain, step_velocity
from jointctl.firmware_py.records import VelocityConstants, VelocityState
from jointctl.firmware_py.schema import new

PERIOD_s = 1e-3


def blocks(cutoff_Hz: float = 100.0) -> tuple[Any, Any]:
    constants, state = new(VelocityConstants)[0], new(VelocityState)[0]
    constants.period_s, constants.cutoff_Hz = PERIOD_s, cutoff_Hz
    constants.period_gain = low_pass_gain(cutoff_Hz, PERIOD_s)
    return constants, state


def test_the_gain_is_that_of_the_exact_discretisation() -> None:
    assert low_pass_gain(100.0, 1e-3) == pytest.approx(1.0 - math.exp(-0.2 * math.pi))
    assert low_pass_gain(0.0, 1e-3) == 1.0
    once, twice = low_pass_gain(30.0, 1e-3), low_pass_gain(30.0, 2e-3)
    assert 1.0 - twice == pytest.approx((1.0 - once) ** 2)


def test_the_first_sample_only_primes() -> None:
    constants, state = blocks(cutoff_Hz=0.0)
    step_velocity(constants, state, 0.7, 0.7, 1)
    assert (state.velocity_radps, state.error_rate_radps, state.primed) == (0.0, 0.0, 1)
    step_velocity(constants, state, 0.701, 0.7005, 1)
    assert state.velocity_radps == pytest.approx(1.0)
    assert state.error_rate_radps == pytest.approx(0.5)


@pytest.mark.parametrize("gap_cycles", [1, 2, 5])
def test_a_gap_between_samples_is_counted(gap_cycles: int) -> None:
    constants, state = blocks(cutoff_Hz=0.0)
    step_velocity(constants, state, 0.0, 0.0, 1)
    step_velocity(constants, state, 0.002 * gap_cycles, 0.001 * gap_cycles, gap_cycles)
    assert state.velocity_radps == pytest.approx(2.0)
    assert state.error_rate_radps == pytest.approx(1.0)


@pytest.mark.parametrize("gap_cycles", [1, 3])
def test_step_response_of_the_filter_depends_on_time_and_not_on_the_number_of_samples(gap_cycles: int) -> None:
    constants, state = blocks(cutoff_Hz=10.0)
    step_velocity(constants, state, 0.0, 0.0, 1)
    for k in range(gap_cycles, 31, gap_cycles):
        step_velocity(constants, state, 1.5 * k * PERIOD_s, 0.0, gap_cycles)
    assert state.velocity_radps == pytest.approx(1.5 * (1.0 - math.exp(-2.0 * math.pi * 10.0 * 0.030)))


def test_the_matched_filter_has_no_bias_where_the_plain_difference_has() -> None:
    """Perfect tracking of an accelerating reference: e' is zero, filtered velocity minus desired velocity is not."""
    constants, state = blocks(cutoff_Hz=30.0)
    for k in range(500):
        position = 0.5 * 2.0 * (k * PERIOD_s) ** 2
        step_velocity(constants, state, position, 0.0, 1)
    assert state.error_rate_radps == 0.0
    lag_radps = 2.0 * 499 * PERIOD_s - state.velocity_radps
    assert lag_radps == pytest.approx(2.0 / (2.0 * math.pi * 30.0), rel=0.2)
