"""The virtual joint's mechanics against closed forms: inertia, gravity, load, flexibility, end stops, repeatability."""

import math

import numpy as np
import pytest

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.plant.joint import R1, FrictionKind, plant, step_plant

STEP_s = 50e-6


@kernel
def run(c, s, torque_Nm, substeps):
    for _ in range(substeps):
        step_plant(c, s, torque_Nm)


@kernel
def record_positions(c, s, torque_Nm, positions):
    for i in range(len(positions)):
        step_plant(c, s, torque_Nm)
        positions[i] = s.joint_position_rad


@kernel
def track_sine(c, s, substeps):
    """A proportional-derivative law at 1 kHz on 0.35 sin(0.2 pi t), enough to move the plant as the paper does."""
    torque = 0.0
    for k in range(substeps):
        if k % 20 == 0:
            angle = 0.2 * math.pi * k * 50e-6
            torque = -1646.0 * (s.joint_position_rad - 0.35 * math.sin(angle))
            torque -= 117.0 * (s.joint_velocity_radps - 0.07 * math.pi * math.cos(angle))
        step_plant(c, s, torque)


def test_constant_torque_gives_the_parabola_exactly():
    c, s = plant(initial_position_rad=0.2)
    run(c[0], s[0], 4.2, 1000)
    assert s[0].time_s == pytest.approx(0.05, rel=1e-12)
    assert s[0].joint_velocity_radps == pytest.approx(2.0 * 0.05, rel=1e-12)
    assert s[0].joint_position_rad == pytest.approx(0.2 + 0.5 * 2.0 * 0.05**2, rel=1e-12)
    assert s[0].motor_position_rad == s[0].joint_position_rad


def test_load_opposes_positive_motion_and_steps_at_its_time():
    c, s = plant(load_torque_Nm=1.0, load_step_Nm=3.0, load_step_at_s=0.01)
    run(c[0], s[0], 1.0, 200)
    assert s[0].load_torque_Nm == 1.0
    assert s[0].joint_velocity_radps == pytest.approx(0.0, abs=1e-15)
    run(c[0], s[0], 1.0, 1)
    assert s[0].load_torque_Nm == 4.0
    run(c[0], s[0], 1.0, 199)
    assert s[0].joint_velocity_radps == pytest.approx(-3.0 / 2.1 * 0.01, rel=1e-9)


def test_load_added_from_outside_acts():
    c, s = plant()
    s[0].added_load_torque_Nm = 2.1
    run(c[0], s[0], 0.0, 100)
    assert s[0].joint_velocity_radps == pytest.approx(-0.005, rel=1e-9)


def test_gravity_pendulum_keeps_its_energy_and_period():
    c, s = plant(gravity_Nm=21.0, initial_position_rad=0.01)
    omega = math.sqrt(21.0 / 2.1)
    period_substeps = round(2.0 * math.pi / omega / STEP_s)
    run(c[0], s[0], 0.0, 4 * period_substeps)
    energy = 0.5 * 2.1 * s[0].joint_velocity_radps ** 2 + 21.0 * (1.0 - math.cos(s[0].joint_position_rad))
    assert energy == pytest.approx(21.0 * (1.0 - math.cos(0.01)), rel=1e-6)
    assert s[0].joint_position_rad == pytest.approx(0.01, rel=1e-4)


def test_gravity_sign_pulls_towards_zero():
    c, s = plant(gravity_Nm=10.0, initial_position_rad=math.pi / 2.0)
    run(c[0], s[0], 0.0, 1)
    assert s[0].gravity_torque_Nm == pytest.approx(10.0)
    assert s[0].joint_velocity_radps < 0.0


@pytest.mark.parametrize("stiffness", [1e4, 1.6e4])
def test_flexible_joint_rings_at_its_free_free_frequency(stiffness):
    c, s = plant(flexible=True, reducer_stiffness_Nmprad=stiffness, reducer_damping_Nmspr=0.0)
    s[0].motor_position_rad = 1e-3
    twist = np.empty(20000)
    for i in range(len(twist)):
        step_plant(c[0], s[0], 0.0)
        twist[i] = s[0].motor_position_rad - s[0].joint_position_rad
    crossings = np.flatnonzero((twist[:-1] < 0.0) & (twist[1:] >= 0.0))
    measured_Hz = (len(crossings) - 1) / ((crossings[-1] - crossings[0]) * STEP_s)
    reduced = 1.2 * 0.9 / 2.1
    assert measured_Hz == pytest.approx(math.sqrt(stiffness / reduced) / (2.0 * math.pi), rel=2e-3)
    assert np.max(np.abs(twist[-1000:])) == pytest.approx(1e-3, rel=1e-2)
    momentum = 1.2 * s[0].motor_velocity_radps + 0.9 * s[0].joint_velocity_radps
    assert momentum == pytest.approx(0.0, abs=1e-12)


def test_reducer_damping_takes_energy_and_static_twist_is_torque_over_stiffness():
    c, s = plant(flexible=True, reducer_stiffness_Nmprad=1e4, reducer_damping_Nmspr=20.0)
    s[0].added_load_torque_Nm = 10.0
    run(c[0], s[0], 10.0, 40000)
    assert s[0].motor_position_rad - s[0].joint_position_rad == pytest.approx(1e-3, rel=1e-6)
    assert s[0].reducer_torque_Nm == pytest.approx(10.0, rel=1e-6)


def test_end_stop_holds_the_joint_and_its_twin_without_stops_passes():
    c, s = plant(end_stops=True, end_stop_max_rad=0.1, end_stop_min_rad=-0.1)
    run(c[0], s[0], 20.0, 20000)
    assert s[0].joint_position_rad == pytest.approx(0.1 + 20.0 / 2e5, abs=1e-5)
    run(c[0], s[0], -20.0, 40000)
    assert s[0].joint_position_rad == pytest.approx(-0.1 - 20.0 / 2e5, abs=1e-5)
    c, s = plant(end_stop_max_rad=0.1, end_stop_min_rad=-0.1)
    run(c[0], s[0], 20.0, 20000)
    assert s[0].joint_position_rad > 1.0


@pytest.mark.parametrize("extra", [{}, {"flexible": True}, {"thermal": True}])
def test_a_run_repeats_bit_by_bit(extra):
    states = []
    for _ in range(2):
        c, s = plant(**{**R1, "encoder_noise_counts": 1.0, **extra})
        track_sine(c[0], s[0], 20000)
        states.append(s.tobytes())
    assert states[0] == states[1]


def test_the_realistic_plant_follows_a_simple_law():
    c, s = plant(**R1)
    track_sine(c[0], s[0], 100000)
    assert s[0].joint_position_rad == pytest.approx(0.35 * math.sin(math.pi), abs=0.02)
    assert s[0].joint_velocity_radps == pytest.approx(-0.07 * math.pi, abs=0.03)
    assert -24.0 < s[0].friction_torque_Nm < -15.0


def test_a_nan_target_is_no_torque():
    c, s = plant()
    run(c[0], s[0], math.nan, 10)
    assert s[0].joint_position_rad == 0.0
    assert s[0].current_A == 0.0


def test_friction_is_on_the_motor_side_of_a_flexible_joint():
    c, s = plant(flexible=True, friction_kind=FrictionKind.STICK_SLIP, reducer_damping_Nmspr=20.0)
    s[0].added_load_torque_Nm = 10.0
    run(c[0], s[0], 0.0, 40000)
    assert s[0].motor_position_rad == 0.0
    assert s[0].joint_position_rad == pytest.approx(-10.0 / 1.3e4, rel=1e-6)
    assert s[0].friction_torque_Nm == pytest.approx(-10.0, rel=1e-6)
