"""The virtual joint's actuator and encoder, and what its settings accept."""

import math

import numpy as np
import pytest

from jointctl.hil.plant.joint import R1, EncoderSide, PlantSettings, encoder_counts, plant, sine_of_turns, step_plant

RATIO = 121.0


def test_current_lag_is_the_exact_exponential():
    c, s = plant(current_lag_s=0.5e-3)
    for k in range(1, 41):
        step_plant(c[0], s[0], 12.1)
        assert s[0].current_A == pytest.approx(1.0 - math.exp(-k * 0.1), rel=1e-12)
        assert s[0].actuator_torque_Nm == pytest.approx(12.1 * s[0].current_A, rel=1e-12)


def test_without_lag_the_torque_is_there_at_once():
    c, s = plant()
    step_plant(c[0], s[0], 12.1)
    assert s[0].actuator_torque_Nm == pytest.approx(12.1, rel=1e-12)


@pytest.mark.parametrize(
    ("target_Nm", "current_A"), [(59.9, 4.9504), (60.5, 5.0), (60.6, 5.0), (-1e9, -5.0), (math.inf, 5.0)]
)
def test_current_is_limited(target_Nm, current_A):
    c, s = plant(current_limit_A=5.0)
    step_plant(c[0], s[0], target_Nm)
    assert s[0].current_A == pytest.approx(current_A, rel=1e-4)


@pytest.mark.parametrize("delay_s", [0.0, 50e-6, 1e-3, 2e-3, 1023 * 50e-6])
def test_command_delay_is_a_whole_number_of_substeps(delay_s):
    c, s = plant(command_delay_s=delay_s)
    arrived = 0
    targets = [float(k + 1) for k in range(1100)]
    for k, target in enumerate(targets):
        step_plant(c[0], s[0], target)
        expected = targets[k - round(delay_s / 50e-6)] if k >= round(delay_s / 50e-6) else 0.0
        arrived += s[0].actuator_torque_Nm == pytest.approx(expected, rel=1e-12)
    assert arrived == len(targets)


def test_sine_of_turns_is_a_sine():
    for turns in np.linspace(-3.0, 3.0, 4001):
        assert sine_of_turns(float(turns)) == pytest.approx(math.sin(2.0 * math.pi * turns), abs=2e-11)


def test_torque_ripple_has_its_periods_amplitudes_and_phases():
    c, s = plant(
        torque_ripple_Nm=(0.5, 0.3), torque_ripple_per_motor_turn=(2.0, 10.0), torque_ripple_phase_rad=(0.3, -1.0)
    )
    for position in np.linspace(-0.2, 0.2, 301):
        s[0].joint_position_rad = position
        s[0].joint_velocity_radps = 0.0
        step_plant(c[0], s[0], 5.0)
        motor_angle = RATIO * position
        expected = 5.0 + 0.5 * math.sin(2.0 * motor_angle + 0.3) + 0.3 * math.sin(10.0 * motor_angle - 1.0)
        assert s[0].actuator_torque_Nm == pytest.approx(expected, abs=1e-9)


def test_encoder_reports_the_nearest_count():
    c, s = plant(encoder_counts_per_turn=1000)
    count_rad = 2.0 * math.pi / 1000
    for position, counts in ((0.0, 0), (0.49, 0), (0.51, 1), (1.49, 1), (-0.49, 0), (-0.51, -1), (2500.2, 2500)):
        s[0].joint_position_rad = position * count_rad
        assert encoder_counts(c[0], s[0]) == counts


def test_encoder_direction_offset_and_motor_side():
    c, s = plant(
        encoder_counts_per_turn=4096, encoder_direction=-1, encoder_offset_counts=777, encoder_side=EncoderSide.MOTOR
    )
    s[0].joint_position_rad = 99.0  # not this one
    s[0].motor_position_rad = 2.0 * math.pi / RATIO
    assert encoder_counts(c[0], s[0]) == 777 - 4096


def test_encoder_noise_is_normal_seeded_and_off_by_default():
    c, s = plant(encoder_noise_counts=3.0, encoder_seed=5)
    noise = np.array([encoder_counts(c[0], s[0]) for _ in range(20000)], float)
    assert abs(noise.mean()) < 0.1
    assert noise.std() == pytest.approx(math.sqrt(9.0 + 1.0 / 12.0), rel=0.02)
    assert np.mean(np.abs(noise) > 6.5) == pytest.approx(math.erfc(6.5 / 3.0 / math.sqrt(2.0)), abs=0.006)
    assert abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 0.03
    again, other = plant(encoder_noise_counts=3.0, encoder_seed=5), plant(encoder_noise_counts=3.0, encoder_seed=6)
    assert [encoder_counts(again[0][0], again[1][0]) for _ in range(50)] == noise[:50].tolist()
    assert [encoder_counts(other[0][0], other[1][0]) for _ in range(50)] != noise[:50].tolist()
    c, s = plant()
    before = s[0].noise_state
    assert encoder_counts(c[0], s[0]) == 0
    assert s[0].noise_state == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inertia_kgm2": 0.0}, r"inertia_kgm2 (=0.0) must be a number in [0.001..10000]"),
        ({"inertia_kgm2": math.nan}, r"inertia_kgm2 (=nan) must be"),
        ({"inertia_kgm2": "2.1"}, r"inertia_kgm2 (=2.1) must be a number"),
        ({"step_s": 2e-3}, r"step_s (=0.002) must be a number in [1e-06..0.001]"),
        ({"command_delay_s": 0.0512}, r"command_delay_s (=0.0512) must be in [0..0.05115]"),
        ({"encoder_counts_per_turn": 1.5}, r"encoder_counts_per_turn (=1.5) must be a whole number in"),
        ({"encoder_direction": 0}, r"encoder_direction (=0) must be 1 or -1"),
        ({"friction_kind": 7}, r"friction_kind (=7) must be one of 0 NONE, 1 SIGN, 2 STICK_SLIP, 3 LUGRE"),
        ({"friction": 3.0}, r"friction (=3.0) must be a FrictionConstants record"),
        ({"flexible": 1}, r"flexible (=1) must be true or false"),
        ({"flexible": True, "motor_side_inertia_kgm2": 2.1}, r"motor_side_inertia_kgm2 (=2.1) must be below"),
        (
            {"flexible": True, "reducer_stiffness_Nmprad": 1e8},
            r"reducer_stiffness_Nmprad (=100000000.0) must be at most",
        ),
        ({"end_stop_max_rad": -3.0}, r"end_stop_max_rad (=-3.0) must be above end_stop_min_rad=-3.0"),
        ({"torque_ripple_Nm": (0.5,)}, r"torque_ripple_per_motor_turn (=()) must be 1 orders, one per amplitude"),
        ({"torque_ripple_Nm": 0.5}, r"torque_ripple_Nm (=0.5) must be a list of numbers"),
        ({"torque_ripple_Nm": (-0.5,)}, r"torque_ripple_Nm (=(-0.5,)) must be numbers in [0..10000]"),
        ({"inertia": 2.1}, r"inertia (=2.1) is not a setting of the virtual joint"),
    ],
)
def test_a_bad_setting_is_named_with_its_value_and_what_is_allowed(settings, message):
    with pytest.raises(ValueError, match=r"must be|is not a setting") as caught:
        plant(**settings)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "settings",
    [
        {"inertia_kgm2": 1e-3},
        {"command_delay_s": 0.05115},
        {"friction_kind": 3, "bristle_stiffness_Nmprad": 2.5e5},
        {"flexible": True, "reducer_stiffness_Nmprad": 1.6e4},
        {"torque_ripple_Nm": [1.0] * 4, "torque_ripple_per_motor_turn": [1.0] * 4},
        R1,
    ],
)
def test_settings_at_the_edge_are_accepted(settings):
    plant(**settings)
    assert PlantSettings(**settings).named()["step_s"] == 50e-6
