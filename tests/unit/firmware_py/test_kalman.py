"""The Kalman filter of error, rate and disturbance: its gains, its estimates, and its place in the law."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from jointctl.firmware_py.live_change import gains_of, set_gains
from jointctl.firmware_py.motion_records import ChangeConstants, Gains
from jointctl.firmware_py.observers import kalman_gains, low_pass_gain, set_kalman_gains, step_kalman
from jointctl.firmware_py.records import LawState, ObserverConstants, ObserverState
from jointctl.firmware_py.schema import new
from jointctl.tools.configuration.records import axis_constants
from tests.configurations import shipped

PERIOD_s = 1e-3
INERTIA_kgm2 = 2.1
COUNT_rad = math.tau / 2**15
MOVED = np.array([[1.0, PERIOD_s, 0.5 * PERIOD_s**2], [0.0, 1.0, PERIOD_s], [0.0, 0.0, 1.0]])  # error, rate, -d / J
SEEN = np.array([[1.0, 0.0, 0.0]])


def blocks(cutoff_Hz: float = 50.0, bandwidth_radps: float = 50.0) -> tuple[Any, Any]:
    constants, state = new(ObserverConstants)[0], new(ObserverState)[0]
    constants.kalman, constants.cutoff_Hz, constants.bandwidth_radps = 1, cutoff_Hz, bandwidth_radps
    set_kalman_gains(constants, PERIOD_s)
    return constants, state


@pytest.mark.parametrize("cutoff_Hz", [5.0, 50.0, 200.0])
@pytest.mark.parametrize("bandwidth_radps", [1.0, 60.0, 400.0])
def test_the_poles_are_those_of_the_two_bandwidths(cutoff_Hz: float, bandwidth_radps: float) -> None:
    gains = np.array([kalman_gains(cutoff_Hz, bandwidth_radps, PERIOD_s)]).T
    found = np.linalg.eigvals((np.eye(3) - gains @ SEEN) @ MOVED)
    w = math.tau * cutoff_Hz
    spectrum = np.roots([1.0, 0.0, 0.0, 0.0, w**4, 0.0, -(w**4) * bandwidth_radps**2])
    expected = np.exp(spectrum[spectrum.real < 0.0] * PERIOD_s)
    assert np.poly(found).real == pytest.approx(np.poly(expected).real, abs=1e-9)


def test_the_gains_are_those_of_the_riccati_equation() -> None:
    """Noise of the torque, white and wandering, and of the reading, as the module says; small against the rate."""
    cutoff_Hz, bandwidth_radps, reading = 10.0, 12.0, 1e-9
    white = (math.tau * cutoff_Hz) ** 4 * reading * PERIOD_s
    noise = np.diag([0.0, white * PERIOD_s, white * bandwidth_radps**2 * PERIOD_s])
    noise[0, 0], noise[0, 1], noise[1, 0] = white * PERIOD_s**3 / 3.0, *(white * PERIOD_s**2 / 2.0,) * 2
    covariance = solve_discrete_are(MOVED.T, SEEN.T, noise, np.array([[reading]]))
    expected = covariance @ SEEN.T / (SEEN @ covariance @ SEEN.T + reading)
    assert kalman_gains(cutoff_Hz, bandwidth_radps, PERIOD_s) == pytest.approx(expected[:, 0], rel=0.02)


def follow(constants: Any, state: Any, load_Nm: float, periods: int, count_rad: float = 0.0) -> np.ndarray:
    """Rows [true error, true rate, error, rate, disturbance] of a joint under a swinging torque and this load."""
    error = rate = applied = 0.0
    rows = []
    for k in range(periods):
        seen = count_rad * round(error / count_rad) if count_rad else error
        disturbance = step_kalman(constants, state, applied, seen, INERTIA_kgm2, PERIOD_s)
        rows.append((error, rate, state.error_rad, state.error_rate_radps, disturbance))
        applied = 5.0 * math.sin(3.0 * k * PERIOD_s)
        acceleration = (applied - load_Nm) / INERTIA_kgm2
        error += PERIOD_s * (rate + 0.5 * PERIOD_s * acceleration)
        rate += PERIOD_s * acceleration
    return np.array(rows)


def test_what_the_model_explains_is_followed_without_an_error() -> None:
    rows = follow(*blocks(), load_Nm=0.0, periods=500)
    np.testing.assert_allclose(rows[:, 2:4], rows[:, :2], atol=1e-12)
    np.testing.assert_allclose(rows[:, 4], 0.0, atol=1e-8)


def test_a_load_is_found_with_the_sign_that_cancels_it() -> None:
    rows = follow(*blocks(), load_Nm=3.0, periods=500)
    assert rows[-1, 4] == pytest.approx(3.0, rel=1e-3)
    np.testing.assert_allclose(rows[-1, 2:4], rows[-1, :2], atol=1e-5)
    assert abs(rows[30, 4]) > 1.0  # 50 rad/s: most of it after 30 ms


def test_between_two_counts_the_rate_is_better_known_than_by_differences() -> None:
    constants, state = blocks(cutoff_Hz=30.0, bandwidth_radps=20.0)
    rows = follow(constants, state, load_Nm=0.0, periods=3000, count_rad=COUNT_rad)
    gain, filtered, last, lagged = low_pass_gain(30.0, PERIOD_s), 0.0, 0.0, []
    for error in rows[:, 0]:
        seen = COUNT_rad * round(error / COUNT_rad)
        filtered += gain * ((seen - last) / PERIOD_s - filtered)
        last = seen
        lagged.append(filtered)
    by_filter = np.std((rows[:, 3] - rows[:, 1])[500:])
    assert by_filter < 0.3 * np.std((np.array(lagged) - rows[:, 1])[500:])


def test_the_first_reading_is_taken_as_it_is() -> None:
    constants, state = blocks()
    assert step_kalman(constants, state, 40.0, 0.02, INERTIA_kgm2, PERIOD_s) == 0.0
    assert (state.error_rad, state.error_rate_radps) == (0.02, 0.0)


def test_gains_that_change_while_the_joint_moves_change_the_filter() -> None:
    config = shipped("precise", control__velocity_filter="kalman", control__velocity_cutoff_Hz=60.0)
    law = axis_constants(config, np.zeros((1, 5)))[0].law
    before = (float(law.observer.error_gain), float(law.observer.disturbance_gain_1ps2))
    assert before[0] == pytest.approx(kalman_gains(60.0, 60.0, PERIOD_s)[0])
    gains, change = new(Gains)[0], new(ChangeConstants)[0]
    gains_of(law, gains)
    change.q1 = change.q2 = 1.0
    gains.observer_radps = 30.0
    state = new(LawState)[0]
    state.observer.disturbance_Nm = 4.0
    set_gains(change, law, state, gains)
    assert (law.observer.error_gain, law.observer.disturbance_gain_1ps2) == pytest.approx(
        [kalman_gains(60.0, 30.0, PERIOD_s)[i] for i in (0, 2)]
    )
    assert law.observer.disturbance_gain_1ps2 < before[1]
    assert state.observer.disturbance_Nm == 4.0  # no jump of the torque


def test_without_it_the_filter_is_not_touched() -> None:
    observer = axis_constants(shipped("precise"), np.zeros((1, 5)))[0].law.observer
    assert (observer.kalman, observer.error_gain) == (0, 0.0)
