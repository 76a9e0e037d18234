"""Means, spreads and confidence of plateaus of a known signal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.tools.sweeping.statistics import (
    BATCHES,
    LEAST_SAMPLES,
    Samples,
    Tolerance,
    half_interval,
    plateau,
    sticking_share,
    without_ripple,
)

JOINT_ORDER = 18.0 / math.tau
MOTOR_ORDER = 2.0 * 121.0 / math.tau
TIGHT = Tolerance(0.01, 0.0)


def window(
    velocity: float = 0.5, periods: float = 2.0, noise_Nm: float = 0.0, ripple_Nm: float = 0.0, seed: int = 1
) -> Samples:
    """`periods` of the joint ripple at 1 kHz; torque 0.2 Nm and ripples of both orders."""
    length = periods * math.tau / 18.0
    count = round(length / abs(velocity) * 1000.0)
    time_s = 10.0 + np.arange(count) * 1e-3
    position = 0.3 + velocity * (time_s - 10.0)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (2, count))
    torque = 0.2 + noise_Nm * noise[0] + ripple_Nm * (np.sin(18.0 * position) + np.cos(242.0 * position))
    return Samples(time_s, position, velocity + 0.01 * noise[1], torque)


def result(windows: list[Samples], planned: float = 0.5, tolerance: Tolerance = TIGHT) -> Any:
    return plateau(windows, planned, (JOINT_ORDER, MOTOR_ORDER), tolerance, 1.2e-5)


def test_mean_and_spread_of_a_known_signal() -> None:
    found = result([window(noise_Nm=0.002, ripple_Nm=0.01)])
    assert found.velocity_radps == pytest.approx(0.5, rel=1e-9)
    assert found.motor_torque_Nm == pytest.approx(0.2, abs=3e-4)
    assert found.motor_torque_std_Nm == pytest.approx(math.sqrt(0.01**2 + 0.002**2), rel=0.05)
    assert found.velocity_std_radps == pytest.approx(0.01, rel=0.1)
    assert found.samples == len(window().time_s)
    assert found.position_min_rad == pytest.approx(0.3)
    assert found.settled


def test_ripple_is_not_mistaken_for_chance() -> None:
    w = window(noise_Nm=1e-4, ripple_Nm=0.02)
    residual = without_ripple(w.position_rad, w.motor_torque_Nm, (JOINT_ORDER, MOTOR_ORDER))
    assert np.std(residual) == pytest.approx(1e-4, rel=0.1)
    untouched = without_ripple(w.position_rad, w.motor_torque_Nm, ())
    assert np.std(untouched) > 0.015


def test_a_ripple_of_which_too_little_was_seen_is_not_fitted() -> None:
    w = window(periods=0.5, ripple_Nm=0.02)
    only_motor = without_ripple(w.position_rad, w.motor_torque_Nm, (MOTOR_ORDER,))
    assert np.array_equal(without_ripple(w.position_rad, w.motor_torque_Nm, (JOINT_ORDER, MOTOR_ORDER)), only_motor)


def test_half_interval_covers_the_truth_about_nineteen_times_in_twenty() -> None:
    generator = np.random.default_rng(5)
    white = generator.normal(0.0, 1.0, (400, 1600))
    covered = sum(abs(np.mean(x)) <= half_interval(x) for x in white)
    assert 360 <= covered <= 396


def test_correlated_samples_give_a_wider_interval_than_independent_ones() -> None:
    white = np.random.default_rng(6).normal(0.0, 1.0, 16_000)
    red = np.empty_like(white)
    value = 0.0
    for i, x in enumerate(white):
        value = 0.95 * value + x
        red[i] = value
    red /= np.std(red)
    assert half_interval(red) > 3.0 * half_interval(white / np.std(white))


@pytest.mark.parametrize("count", [0, BATCHES, LEAST_SAMPLES - 1])
def test_too_few_samples_are_never_enough(count: int) -> None:
    assert half_interval(np.zeros(count)) == math.inf
    assert half_interval(np.zeros(LEAST_SAMPLES)) == 0.0


def test_noise_decides_whether_a_point_is_settled() -> None:
    assert result([window(noise_Nm=0.005)]).settled
    noisy = result([window(noise_Nm=0.1)])
    assert not noisy.settled
    assert "known to" in noisy.problem
    assert result([window(noise_Nm=0.1)], tolerance=Tolerance(0.01, 0.05)).settled


@pytest.mark.parametrize(
    ("share", "settled"), [(0.94, False), (0.951, True), (1.0, True), (1.049, True), (1.06, False)]
)
def test_the_planned_speed_must_be_held(share: float, settled: bool) -> None:
    found = result([window(velocity=0.5 * share)])
    assert found.settled is settled
    assert settled or "planned" in found.problem


def test_stick_slip_is_seen_and_even_motion_is_not() -> None:
    even = window(velocity=0.05, periods=1.0)
    jerky = window(velocity=0.05, periods=1.0)
    # the same way in steps of 0.02 rad: at rest for most of the time
    steps = np.floor((jerky.position_rad - 0.3) / 0.02) * 0.02
    jerky.position_rad = 0.3 + steps + np.clip((jerky.position_rad - 0.3 - steps) * 5.0, 0.0, 0.02)
    assert sticking_share([even], 0.05, 1.2e-5) == 0.0
    assert sticking_share([jerky], 0.05, 1.2e-5) > 0.5
    assert result([even], 0.05).settled
    assert result([jerky], 0.05).problem == "the joint stuck and slipped"


def test_windows_of_one_point_are_taken_together() -> None:
    found = result([window(noise_Nm=0.002, seed=1), window(noise_Nm=0.002, seed=2)])
    assert found.samples == 2 * len(window().time_s)
    assert found.velocity_radps == pytest.approx(0.5, rel=1e-9)
