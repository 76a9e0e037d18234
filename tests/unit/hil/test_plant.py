"""The virtual joint against closed forms: mechanics, friction, actuator, encoder, and what its settings accept."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jointctl.firmware_py.friction import friction_motor_torque_Nm, paper_friction
from jointctl.firmware_py.kernel import kernel
from jointctl.hil.plant import (
    R1,
    EncoderSide,
    FrictionKind,
    PlantSettings,
    encoder_counts,
    hysteresis_torque_Nm,
    link_reading_rad,
    plant,
    sine_of_turns,
    step_plant,
)

# The virtual joint's mechanics against closed forms: inertia, gravity, load, flexibility, end stops, repeatability.
STEP_s = 50e-6


@kernel
def run(c, s, torque_Nm, substeps):
    for _ in range(substeps):
        step_plant(c, s, torque_Nm)


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
    s[0].added_load_torque_Nm = 2.1  # from outside
    run(c[0], s[0], 4.0, 100)
    assert s[0].joint_velocity_radps == pytest.approx(-3.0 / 2.1 * 0.01 - 0.005, rel=1e-9)


def test_gravity_pendulum_keeps_its_energy_and_period():
    c, s = plant(gravity_Nm=21.0, initial_position_rad=0.01)
    omega = math.sqrt(21.0 / 2.1)
    period_substeps = round(2.0 * math.pi / omega / STEP_s)
    run(c[0], s[0], 0.0, 4 * period_substeps)
    energy = 0.5 * 2.1 * s[0].joint_velocity_radps ** 2 + 21.0 * (1.0 - math.cos(s[0].joint_position_rad))
    assert energy == pytest.approx(21.0 * (1.0 - math.cos(0.01)), rel=1e-6)
    assert s[0].joint_position_rad == pytest.approx(0.01, rel=1e-4)


def test_gravity_has_no_lever_at_its_zero():
    for flexible in (False, True):
        c, s = plant(gravity_Nm=10.0, gravity_zero_rad=0.4, initial_position_rad=0.4, flexible=flexible)
        run(c[0], s[0], 0.0, 1000)
        assert s[0].joint_position_rad == pytest.approx(0.4, abs=1e-12)
        c, s = plant(gravity_Nm=10.0, gravity_zero_rad=0.4, initial_position_rad=0.4 + math.pi / 2.0, flexible=flexible)
        run(c[0], s[0], 0.0, 1)
        assert s[0].gravity_torque_Nm == pytest.approx(10.0)


def assert_rings(c, s, torque_Nm, about_rad, stiffness_Nmprad):
    """Undamped, at the free-free frequency of this stiffness; `about_rad`: twist that the torque holds."""
    twist = np.empty(20000)
    begun_rad = s[0].motor_position_rad - s[0].joint_position_rad - about_rad
    for i in range(len(twist)):
        step_plant(c[0], s[0], torque_Nm)
        twist[i] = s[0].motor_position_rad - s[0].joint_position_rad - about_rad
    crossings = np.flatnonzero((twist[:-1] < 0.0) & (twist[1:] >= 0.0))
    measured_Hz = (len(crossings) - 1) / ((crossings[-1] - crossings[0]) * STEP_s)
    reduced = 1.2 * 0.9 / 2.1
    assert measured_Hz == pytest.approx(math.sqrt(stiffness_Nmprad / reduced) / (2.0 * math.pi), rel=2e-3)
    assert np.max(np.abs(twist[-1000:])) == pytest.approx(begun_rad, rel=1e-2)


@pytest.mark.parametrize("stiffness", [1e4, 1.6e4])
def test_flexible_joint_rings_at_its_free_free_frequency(stiffness):
    c, s = plant(flexible=True, reducer_stiffness_Nmprad=stiffness, reducer_damping_Nmspr=0.0)
    s[0].motor_position_rad = 1e-3
    assert_rings(c, s, 0.0, 0.0, stiffness)
    momentum = 1.2 * s[0].motor_velocity_radps + 0.9 * s[0].joint_velocity_radps
    assert momentum == pytest.approx(0.0, abs=1e-12)


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


# --- The virtual joint's friction: the sliding curve (11), stick-slip, LuGre, ripple, temperature ---
RATIO = 121.0
DEGREE = math.pi / 180.0
STATIC_FORWARD_Nm = RATIO * 0.14537
STATIC_BACKWARD_Nm = -RATIO * 0.15750
# joint velocity [deg/s] -> friction at the motor [Nm], from the specification
CHECK_VALUES = [
    (12.6, 0.15326), (-12.6, -0.13814), (40.0, 0.22592), (40.0001, 0.22761), (-40.0, -0.20530), (-40.0001, -0.20402),
    (100.0, 0.28871), (200.0, 0.33823), (-200.0, -0.35398),
]  # fmt: skip


@kernel
def hold_velocity(c, s, velocity_radps, substeps):
    """Let friction act while the velocity is imposed."""
    for _ in range(substeps):
        s.joint_velocity_radps = velocity_radps
        step_plant(c, s, 0.0)


@kernel
def drive(c, s, amplitude_Nm, omega_radps, substeps):
    """A sinusoidal torque; returns how often the joint moved and how often its velocity changed sign directly."""
    moved = 0
    jumped = 0
    for k in range(substeps):
        before = s.joint_velocity_radps
        step_plant(c, s, amplitude_Nm * math.sin(omega_radps * k * 50e-6))
        after = s.joint_velocity_radps
        moved += after != 0.0
        jumped += before * after < 0.0
    return moved, jumped


@pytest.mark.parametrize("kind", [FrictionKind.SIGN, FrictionKind.STICK_SLIP, FrictionKind.LUGRE])
@pytest.mark.parametrize(("speed_degps", "motor_torque_Nm"), CHECK_VALUES)
def test_sliding_gives_the_check_values_of_the_curve(kind, speed_degps, motor_torque_Nm):
    c, s = plant(friction_kind=kind)
    hold_velocity(c[0], s[0], speed_degps * DEGREE, 4000)
    assert s[0].friction_torque_Nm / RATIO == pytest.approx(motor_torque_Nm, abs=1.5e-5)


@pytest.mark.parametrize("stiffness", [3e4, 8e4, 2.5e5])
@pytest.mark.parametrize("velocity", [-3.5, -0.2, -0.02, 0.02, 0.2, 3.5])
def test_lugre_steady_state_is_exactly_the_sliding_curve(stiffness, velocity):
    c, s = plant(friction_kind=FrictionKind.LUGRE, bristle_stiffness_Nmprad=stiffness)
    expected = RATIO * friction_motor_torque_Nm(paper_friction()[0], velocity)
    settling_s = 30.0 * expected / (stiffness * velocity)
    hold_velocity(c[0], s[0], velocity, 100 + round(settling_s / 50e-6))
    assert s[0].friction_torque_Nm == pytest.approx(expected, rel=1e-9)
    assert s[0].bristle_deflection_rad == pytest.approx(expected / stiffness, rel=1e-9)


def test_steady_velocity_under_constant_torque_is_where_the_curve_balances_it():
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP)
    s[0].joint_velocity_radps = 90.0 * DEGREE
    run(c[0], s[0], RATIO * 0.28871, 60000)
    assert s[0].joint_velocity_radps == pytest.approx(100.0 * DEGREE, rel=2e-3)


@pytest.mark.parametrize("limit_Nm", [STATIC_FORWARD_Nm, STATIC_BACKWARD_Nm])
def test_lugre_breaks_away_above_the_static_friction_and_not_well_below(limit_Nm):
    # not dense at the limit: creep of the bristle lowers the sliding curve, so that break-away depends on the rate
    for factor, moves in ((0.5, False), (0.9, False), (1.005, True), (1.05, True)):
        c, s = plant(friction_kind=FrictionKind.LUGRE)
        for percent in range(1, 101):
            run(c[0], s[0], limit_Nm * factor * percent / 100.0, 100)
        run(c[0], s[0], limit_Nm * factor, 20000)
        assert bool(abs(s[0].joint_position_rad) > 4e-3) == moves, factor


@pytest.mark.parametrize("limit_Nm", [STATIC_FORWARD_Nm, STATIC_BACKWARD_Nm])
def test_ideal_stiction_does_not_move_at_all_up_to_the_limit(limit_Nm):
    for factor, moves in ((0.5, False), (1.0 - 1e-9, False), (1.0 + 1e-9, True)):
        c, s = plant(friction_kind=FrictionKind.STICK_SLIP)
        run(c[0], s[0], limit_Nm * factor, 1000)
        assert bool(s[0].joint_position_rad != 0.0) == moves, factor
        if not moves:
            assert s[0].friction_torque_Nm == pytest.approx(limit_Nm * factor, rel=1e-12)


def test_no_creep_and_no_chatter_under_an_alternating_torque():
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP)
    moved, jumped = drive(c[0], s[0], 0.999 * STATIC_FORWARD_Nm, 200.0, 40000)
    assert moved == 0
    assert s[0].joint_position_rad == 0.0
    # the twin: enough torque moves it, and every reversal passes through rest
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP)
    moved, jumped = drive(c[0], s[0], 1.5 * STATIC_FORWARD_Nm, 20.0, 40000)
    assert 10000 < moved < 39000
    assert jumped == 0


def test_coasting_stops_dead_at_the_instant_the_velocity_is_zero():
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP, friction=_constant_friction(0.1))
    s[0].joint_velocity_radps = 0.5
    run(c[0], s[0], 0.0, 20000)
    assert s[0].joint_velocity_radps == 0.0
    # the energy is used up by the constant friction over the distance, exactly, although rest falls inside a substep
    assert s[0].joint_position_rad == pytest.approx(0.5 * 2.1 * 0.5**2 / (RATIO * 0.1), rel=1e-9)


def test_reversal_within_a_substep_is_exact():
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP, friction=_constant_friction(0.1))
    s[0].joint_velocity_radps = 3e-4
    torque = -40.0
    run(c[0], s[0], torque, 1)
    until_rest_s = 3e-4 * 2.1 / (12.1 + 40.0)
    left_s = 50e-6 - until_rest_s
    back = (torque + 12.1) / 2.1
    assert 0.0 < until_rest_s < 50e-6
    assert s[0].joint_velocity_radps == pytest.approx(back * left_s, rel=1e-12)
    assert s[0].joint_position_rad == pytest.approx(0.5 * 3e-4 * until_rest_s + 0.5 * back * left_s**2, rel=1e-9)


def _constant_friction(torque_Nm):
    friction = paper_friction()
    for branch in (friction[0].positive, friction[0].negative):
        branch.coulomb_Nm = branch.static_Nm = torque_Nm
        branch.viscous_Nmspr = 0.0
        branch.knee_radps = 100.0
    return friction


def test_sign_friction_is_zero_at_rest_and_moves_under_any_torque():
    c, s = plant(friction_kind=FrictionKind.SIGN)
    run(c[0], s[0], 0.1, 1)
    assert s[0].friction_torque_Nm == 0.0
    assert s[0].joint_velocity_radps > 0.0


@pytest.mark.parametrize("stiffness", [3e4, 8e4, 2.5e5])
def test_lugre_presliding_is_a_spring_that_comes_to_rest(stiffness):
    c, s = plant(friction_kind=FrictionKind.LUGRE, bristle_stiffness_Nmprad=stiffness)
    run(c[0], s[0], 5.0, 20000)
    assert s[0].friction_torque_Nm == pytest.approx(5.0, rel=1e-6)
    assert s[0].joint_velocity_radps == pytest.approx(0.0, abs=1e-7)
    assert 5.0 / stiffness <= s[0].joint_position_rad * (1 + 1e-9) < 2.5 * 5.0 / stiffness


def test_lugre_stays_bounded_at_the_stiffest_bristle_and_speed():
    c, s = plant(friction_kind=FrictionKind.LUGRE, bristle_stiffness_Nmprad=2.5e5)
    for torque in (60.0, -60.0, 60.0, 0.0):
        run(c[0], s[0], torque, 10000)
        assert abs(s[0].friction_torque_Nm) < 60.0
    assert s[0].joint_velocity_radps == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("velocity", "scale"), [(0.2, 1.1), (-0.2, 0.9)])
def test_each_direction_has_its_own_scale(velocity, scale):
    c, s = plant(friction_kind=FrictionKind.SIGN, friction_positive_scale=1.1, friction_negative_scale=0.9)
    hold_velocity(c[0], s[0], velocity, 1)
    expected = scale * RATIO * friction_motor_torque_Nm(paper_friction()[0], velocity)
    assert s[0].friction_torque_Nm == pytest.approx(expected, rel=1e-12)


def test_friction_ripple_has_its_period_and_amplitude():
    c, s = plant(friction_kind=FrictionKind.SIGN, friction_ripple=0.05, friction_ripple_per_joint_turn=18.0)
    plain = RATIO * friction_motor_torque_Nm(paper_friction()[0], 1e-3)
    for turns, factor in ((0.0, 1.0), (0.25, 1.05), (0.5, 1.0), (0.75, 0.95), (1.25, 1.05), (18.25, 1.05)):
        s[0].joint_position_rad = turns * 2.0 * math.pi / 18.0
        hold_velocity(c[0], s[0], 1e-3, 1)
        assert s[0].friction_torque_Nm == pytest.approx(factor * plain, rel=1e-6)


def test_heating_follows_current_squared_and_lowers_friction():
    settings = {"friction_kind": FrictionKind.STICK_SLIP, "thermal_time_s": 1.0, "heating_KpA2": 20.0}
    c, s = plant(**settings, thermal=True)
    run(c[0], s[0], 12.1, 20000)  # 1 A, held by static friction
    assert s[0].motor_temperature_degC == pytest.approx(25.0 + 20.0 * (1.0 - math.exp(-1.0)), rel=1e-9)
    hold_velocity(c[0], s[0], 0.2, 1)
    warm = 1.0 - 0.005 * (s[0].motor_temperature_degC - 25.0)
    plain = RATIO * friction_motor_torque_Nm(paper_friction()[0], 0.2)
    assert s[0].friction_torque_Nm == pytest.approx(warm * plain, rel=1e-3)
    c, s = plant(**settings)
    run(c[0], s[0], 12.1, 2000)
    assert s[0].motor_temperature_degC == 25.0


def curve_with(**values):
    friction = paper_friction()[0]
    friction.reference_degC, friction.lowest_degC, friction.highest_degC, friction.conditioned = 25.0, 0.0, 80.0, 1
    for name, value in values.items():
        setattr(friction, name, value)
    return friction


@kernel
def push(c, s, velocity_radps, torque_Nm, substeps):
    """As `hold_velocity`, with a torque of the motor."""
    for _ in range(substeps):
        s.joint_velocity_radps = velocity_radps
        step_plant(c, s, torque_Nm)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_goes_with_the_torque_through_the_reducer(sign):
    """The reducer transmits what friction leaves over: f = f0 + k (actuator - f), where the motor drives."""
    k, actuator_Nm = 0.2, 50.0
    c, s = plant(friction_kind=FrictionKind.SIGN, friction=curve_with(load_coulomb=k))
    push(c[0], s[0], sign * 0.2, sign * actuator_Nm, 8000)
    unloaded = RATIO * abs(friction_motor_torque_Nm(paper_friction()[0], sign * 0.2))
    expected = (unloaded + k * actuator_Nm) / (1.0 + k)
    assert s[0].friction_torque_Nm == pytest.approx(sign * expected, rel=1e-9)
    assert s[0].friction_load_Nm == pytest.approx(sign * (actuator_Nm - expected), rel=1e-9)


def test_load_raises_what_the_joint_breaks_away_at():
    """Held against gravity, the set-valued kind stands still up to the static friction of the present load."""
    c, s = plant(friction_kind=FrictionKind.STICK_SLIP, friction=curve_with(load_coulomb=0.3), load_torque_Nm=20.0)
    static_Nm = RATIO * 0.14537
    run(c[0], s[0], 20.0, 4000)
    assert s[0].friction_load_Nm == pytest.approx(20.0)
    for actuator_Nm, moves in ((20.0 + static_Nm + 5.0, False), (20.0 + static_Nm + 7.0, True)):
        run(c[0], s[0], actuator_Nm, 200)
        assert (s[0].joint_velocity_radps > 0.0) == moves


@pytest.mark.parametrize("degC", [15.0, 25.0, 55.0])
def test_the_curve_has_factors_of_the_temperature_and_no_other(degC):
    friction = curve_with(temperature_coulomb_pK=0.01, temperature_viscous_pK=0.01)
    settings = {"friction_kind": FrictionKind.SIGN, "ambient_degC": degC, "heating_KpA2": 0.0}
    c, s = plant(**settings, thermal=True, friction=friction)
    hold_velocity(c[0], s[0], 0.2, 1)
    plain = RATIO * friction_motor_torque_Nm(paper_friction()[0], 0.2)
    assert s[0].friction_torque_Nm == pytest.approx(math.exp(-0.01 * (degC - 25.0)) * plain, rel=1e-9)


@pytest.mark.parametrize("actuator_Nm", [50.0, -30.0])
def test_bristles_do_not_swing_with_their_own_load(actuator_Nm):
    """Driving and driven, at the speed and stiffness at which they answer most; settled after 0.2 s."""
    bristles = {"bristle_stiffness_Nmprad": 3e4, "bristle_damping_Nmspr": 200.0}
    c, s = plant(friction_kind=FrictionKind.LUGRE, friction=curve_with(load_coulomb=0.3), **bristles)
    push(c[0], s[0], 0.9, actuator_Nm, 4000)
    settled = s[0].friction_torque_Nm
    for _ in range(20):
        push(c[0], s[0], 0.9, actuator_Nm, 7)
        assert s[0].friction_torque_Nm == pytest.approx(settled, rel=1e-6)


def test_a_joint_that_locks_itself_is_refused():
    plant(friction=curve_with(load_coulomb=0.9))
    with pytest.raises(ValueError, match=r"friction.load.coulomb \(=0.95\) must be at most 0.9"):
        plant(friction=curve_with(load_coulomb=0.95))


# --- The reducer: three slopes, hysteresis, kinematic error, friction on both sides ---
SIZE_20 = {
    "flexible": True, "motor_side_inertia_kgm2": 1.2, "reducer_stiffness_Nmprad": 1.6e4,
    "reducer_knees_Nm": (7.0, 25.0),
    "reducer_stiffness_beyond_Nmprad": (2.5e4, 2.9e4), "reducer_damping_Nmspr": 0.0,
}  # fmt: skip
# transmitted torque [Nm] -> (twist [rad], slope there [Nm/rad])
WIND_UP = [
    (3.0, 3.0 / 1.6e4, 1.6e4), (16.0, 7.0 / 1.6e4 + 9.0 / 2.5e4, 2.5e4),
    (40.0, 7.0 / 1.6e4 + 18.0 / 2.5e4 + 15.0 / 2.9e4, 2.9e4),
]  # fmt: skip
WAVY = {"kinematic_error_rad": (1e-3, 3e-4), "kinematic_error_per_motor_turn": (2.0, 4.0)}


def kinematic_error(position_rad):
    return 1e-3 * math.sin(2.0 * RATIO * position_rad) + 3e-4 * math.sin(4.0 * RATIO * position_rad)


def spring_energy_J(twist_rad):
    """Of the three slopes, integrated by hand."""
    size, energy, slope, knee_Nm, knee_rad = abs(twist_rad), 0.0, 1.6e4, 0.0, 0.0
    for next_Nm, beyond in ((7.0, 2.5e4), (25.0, 2.9e4), (math.inf, math.nan)):
        next_rad = knee_rad + (next_Nm - knee_Nm) / slope
        way = min(size, next_rad) - knee_rad
        energy += knee_Nm * way + 0.5 * slope * way * way
        if size <= next_rad:
            return energy
        slope, knee_Nm, knee_rad = beyond, next_Nm, next_rad
    raise AssertionError


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("torque_Nm", "twist_rad", "slope_Nmprad"), WIND_UP)
def test_static_wind_up_follows_the_three_slopes(torque_Nm, twist_rad, slope_Nmprad, sign):
    c, s = plant(**{**SIZE_20, "reducer_damping_Nmspr": 40.0})
    s[0].added_load_torque_Nm = sign * torque_Nm
    run(c[0], s[0], sign * torque_Nm, 40000)
    assert s[0].motor_position_rad - s[0].joint_position_rad == pytest.approx(sign * twist_rad, rel=1e-6)
    assert s[0].reducer_torque_Nm == pytest.approx(sign * torque_Nm, rel=1e-6)


@pytest.mark.parametrize(("torque_Nm", "twist_rad", "slope_Nmprad"), WIND_UP)
def test_the_joint_rings_at_the_resonance_of_the_slope_it_is_on(torque_Nm, twist_rad, slope_Nmprad):
    c, s = plant(**SIZE_20)
    s[0].added_load_torque_Nm = torque_Nm
    s[0].motor_position_rad = twist_rad + 5e-5
    assert_rings(c, s, torque_Nm, twist_rad, slope_Nmprad)


def test_slopes_kinematic_error_and_gravity_neither_gain_nor_lose_energy():
    c, s = plant(**SIZE_20, **WAVY, gravity_Nm=20.0)

    def energy_J():
        state = s[0]
        twist = state.motor_position_rad + kinematic_error(state.motor_position_rad) - state.joint_position_rad
        kinetic = 0.5 * (1.2 * state.motor_velocity_radps**2 + 0.9 * state.joint_velocity_radps**2)
        return kinetic + spring_energy_J(twist) + 20.0 * (1.0 - math.cos(state.joint_position_rad))

    s[0].motor_velocity_radps = s[0].joint_velocity_radps = 0.3
    s[0].motor_position_rad += 2e-3
    at_start = energy_J()
    found = []
    for _ in range(400):
        run(c[0], s[0], 0.0, 100)
        found.append(energy_J())
    assert np.mean(found) == pytest.approx(at_start, rel=2e-3)
    assert np.max(np.abs(np.array(found) - at_start)) < 0.01 * at_start
    # no drift: the last tenth is like the first
    assert np.mean(found[-40:]) == pytest.approx(np.mean(found[:40]), rel=2e-3)


@pytest.mark.parametrize(("amplitude_rad", "width_rad"), [(1e-3, 2e-4), (1e-4, 2e-4), (5e-4, 3e-4), (2e-3, 1e-4)])
def test_the_area_of_the_hysteresis_loop(amplitude_rad, width_rad):
    c, s = plant(**SIZE_20, hysteresis_width_rad=width_rad)
    samples = 2000
    cycle = amplitude_rad * np.sin(2.0 * np.pi * np.arange(samples + 1) / samples)
    for _ in range(20):  # into the steady loop
        torques = np.array([hysteresis_torque_Nm(c[0], s[0], twist) for twist in cycle])
    area_J = np.sum(0.5 * (torques[1:] + torques[:-1]) * np.diff(cycle))
    slide = 0.5 * width_rad
    left = math.exp(-2.0 * amplitude_rad / slide)
    end = slide * math.tanh(amplitude_rad / slide)
    expected_J = 2.0 * 1.6e4 * slide * (2.0 * amplitude_rad - (end + slide) * (1.0 - left))
    assert area_J == pytest.approx(expected_J, rel=2e-3)
    assert abs(s[0].hysteresis_rad) <= slide


def test_hysteresis_leaves_half_its_width_behind_and_doubles_the_stiffness_of_a_small_motion():
    c, s = plant(**SIZE_20, hysteresis_width_rad=2e-4)
    for twist in np.linspace(0.0, 2e-3, 4000):
        hysteresis_torque_Nm(c[0], s[0], twist)
    assert s[0].hysteresis_rad == pytest.approx(1e-4, rel=1e-6)
    before = hysteresis_torque_Nm(c[0], s[0], 2e-3)
    slope = (before - hysteresis_torque_Nm(c[0], s[0], 2e-3 - 1e-7)) / 1e-7
    assert slope == pytest.approx(2.0 * 1.6e4, rel=2e-3)  # a reversal at full deflection: (1 + z / slide) K1
    c, s = plant(**SIZE_20, hysteresis_width_rad=2e-4)
    assert hysteresis_torque_Nm(c[0], s[0], 1e-7) / 1e-7 == pytest.approx(1.6e4, rel=2e-3)


def test_a_slow_link_follows_the_kinematic_error_of_the_reducer():
    c, s = plant(**{**SIZE_20, "reducer_damping_Nmspr": 60.0}, **WAVY)
    s[0].motor_velocity_radps = 0.02  # four per motor turn are 1.5 Hz, the resonance is at 28 Hz
    s[0].joint_velocity_radps = 0.02
    worst = 0.0
    for _ in range(4000):
        motor_rad = s[0].motor_position_rad
        s[0].motor_velocity_radps = 0.02  # an infinitely strong motor
        run(c[0], s[0], 0.0, 10)
        if s[0].time_s > 0.5:
            motor_rad = s[0].motor_position_rad
            worst = max(worst, abs(s[0].joint_position_rad - motor_rad - kinematic_error(motor_rad)))
    assert worst < 3e-5  # of 1.2e-3


@pytest.mark.parametrize("position_rad", [0.0, 0.4, -1.3])
def test_at_the_start_the_spring_is_slack(position_rad):
    phases = {"kinematic_error_phase_rad": (0.7, -2.0)}
    c, s = plant(**SIZE_20, **WAVY, **phases, initial_position_rad=position_rad)
    step_plant(c[0], s[0], 0.0)
    assert s[0].joint_position_rad == pytest.approx(position_rad, abs=1e-15)
    assert s[0].reducer_torque_Nm == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_friction_on_the_link_holds_its_share_before_the_reducer_feels_a_load(share):
    settings = {**SIZE_20, "reducer_damping_Nmspr": 40.0, "friction_kind": FrictionKind.STICK_SLIP}
    static_Nm = share * -STATIC_BACKWARD_Nm  # a positive load pushes the link backwards
    c, s = plant(**settings, link_friction_share=share)
    s[0].added_load_torque_Nm = 0.999 * static_Nm
    run(c[0], s[0], 0.0, 20000)
    assert s[0].joint_position_rad == 0.0
    assert s[0].friction_torque_Nm == pytest.approx(-0.999 * static_Nm)
    # the twin: a little more, and the spring carries what friction does not
    s[0].added_load_torque_Nm = static_Nm + 1.0
    run(c[0], s[0], 0.0, 40000)
    assert s[0].joint_position_rad < 0.0
    assert s[0].motor_position_rad == 0.0
    assert 0.0 < s[0].reducer_torque_Nm < 2.0 * 1.0 + 1e-6  # it may come to rest anywhere inside the friction's band


@pytest.mark.parametrize("kind", [FrictionKind.STICK_SLIP, FrictionKind.LUGRE])
def test_both_sides_together_have_the_friction_of_the_whole_joint(kind):
    c, s = plant(**{**SIZE_20, "reducer_damping_Nmspr": 40.0}, link_friction_share=0.2, friction_kind=kind)
    s[0].motor_velocity_radps = s[0].joint_velocity_radps = 100.0 * DEGREE
    run(c[0], s[0], RATIO * 0.28871, 60000)
    assert s[0].joint_velocity_radps == pytest.approx(100.0 * DEGREE, rel=5e-3)
    assert s[0].friction_torque_Nm == pytest.approx(RATIO * 0.28871, rel=2e-3)
    assert s[0].reducer_torque_Nm == pytest.approx(0.2 * RATIO * 0.28871, rel=5e-3)


REALISTIC = {
    **R1, **SIZE_20, "reducer_damping_Nmspr": 7.0, "hysteresis_width_rad": 2e-4, "link_friction_share": 0.12,
    "kinematic_error_rad": (2e-4, 5e-5), "kinematic_error_per_motor_turn": (2.0, 4.0), "command_delay_s": 0.0,
}  # fmt: skip


@kernel
def track_motor(c, s, seconds):
    """A damped law at 1 kHz on the motor, the same for any step of the plant."""
    torque = 0.0
    every = round(1e-3 / c.step_s)
    for k in range(round(seconds / c.step_s)):
        if k % every == 0:
            angle = 0.2 * math.pi * k * c.step_s
            torque = -640.0 * (s.motor_position_rad - 0.35 * math.sin(angle))
            torque -= 42.0 * (s.motor_velocity_radps - 0.07 * math.pi * math.cos(angle))
        step_plant(c, s, torque)


def test_the_step_is_short_enough_for_a_realistic_reducer():
    link_rad = []
    for step_s in (50e-6, 5e-6):
        c, s = plant(**REALISTIC, step_s=step_s)
        track_motor(c[0], s[0], 3.0)
        link_rad.append(float(s[0].joint_position_rad))
    assert link_rad[0] == pytest.approx(link_rad[1], abs=2e-6)


def test_an_eccentric_disc_reads_a_sine_too_much_once_a_turn_of_its_shaft():
    turn = {"encoder_counts_per_turn": 2**26}
    c, s = plant(**turn, joint_encoder_eccentricity_rad=1e-3, joint_encoder_eccentricity_phase_rad=0.4)
    for position in np.linspace(-7.0, 7.0, 50):
        s[0].joint_position_rad = position
        expected = position + 1e-3 * math.sin(position + 0.4)
        assert link_reading_rad(c[0], s[0]) == pytest.approx(expected, abs=1e-12)
        assert encoder_counts(c[0], s[0]) * 2.0 * math.pi / 2**26 == pytest.approx(expected, abs=1e-7)
    c, s = plant(**turn, encoder_side=EncoderSide.MOTOR, motor_encoder_eccentricity_rad=2e-3)
    for position in np.linspace(-0.1, 0.1, 50):
        s[0].motor_position_rad = position
        expected = position + 2e-3 * math.sin(RATIO * position) / RATIO
        assert encoder_counts(c[0], s[0]) * 2.0 * math.pi / 2**26 / RATIO == pytest.approx(expected, abs=1e-9)
    # the twin: a centred disc reads what there is
    c, s = plant(**turn)
    s[0].joint_position_rad = 1.0
    assert link_reading_rad(c[0], s[0]) == 1.0


# --- The virtual joint's actuator and encoder, and what its settings accept ---
def test_current_lag_is_the_exact_exponential():
    c, s = plant(current_lag_s=0.5e-3)
    for k in range(1, 41):
        step_plant(c[0], s[0], 12.1)
        assert s[0].current_A == pytest.approx(1.0 - math.exp(-k * 0.1), rel=1e-12)
        assert s[0].actuator_torque_Nm == pytest.approx(12.1 * s[0].current_A, rel=1e-12)


@pytest.mark.parametrize(
    ("target_Nm", "current_A"), [(12.1, 1.0), (59.9, 4.9504), (60.5, 5.0), (60.6, 5.0), (-1e9, -5.0), (math.inf, 5.0)]
)
def test_without_lag_the_torque_is_there_at_once_and_the_current_is_limited(target_Nm, current_A):
    c, s = plant(current_limit_A=5.0)
    step_plant(c[0], s[0], target_Nm)
    assert s[0].current_A == pytest.approx(current_A, rel=1e-4)
    assert s[0].actuator_torque_Nm == pytest.approx(12.1 * s[0].current_A, rel=1e-12)


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
        ({"inertia_kgm2": 0.0}, r"inertia_kgm2 (=0.0) must be a number in [1e-06..10000]"),
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
        ({"torque_ripple_Nm": (0.5,)}, r"torque_ripple_per_motor_turn (=[]) must be 1 orders, one per amplitude"),
        ({"torque_ripple_Nm": 0.5}, r"torque_ripple_Nm (=0.5) must be a list of numbers"),
        ({"torque_ripple_Nm": (-0.5,)}, r"torque_ripple_Nm (=[-0.5]) must be numbers in [0..10000]"),
        ({"kinematic_error_rad": (1e-4,)}, r"kinematic_error_per_motor_turn (=[]) must be 1 orders, one per amplitude"),
        ({"hysteresis_width_rad": 1e-4}, r"hysteresis_width_rad (=0.0001) must be left out unless flexible is true"),
        ({**SIZE_20, "reducer_knees_Nm": (25.0, 7.0)}, r"reducer_knees_Nm (=[25.0, 7.0]) must be at most 2 torques in"),
        ({**SIZE_20, "reducer_knees_Nm": (7.0,)}, r"reducer_stiffness_beyond_Nmprad (=[25000.0, 29000.0]) must be 1"),
        (
            {**SIZE_20, "kinematic_error_rad": (3e-3,), "kinematic_error_per_motor_turn": (2.0,)},
            r"kinematic_error_rad (=[0.003]) must be so small that",
        ),
        (
            {**SIZE_20, "reducer_stiffness_beyond_Nmprad": (2.5e4, 1e8)},
            r"reducer_stiffness_beyond_Nmprad (=[25000.0, 100000000.0]) must be at most",
        ),
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
        {"inertia_kgm2": 1e-6}, {"command_delay_s": 0.05115}, {"friction_kind": 3, "bristle_stiffness_Nmprad": 2.5e5},
        {"flexible": True, "reducer_stiffness_Nmprad": 1.6e4},
        {"torque_ripple_Nm": [1.0] * 4, "torque_ripple_per_motor_turn": [1.0] * 4}, R1,
    ],
)  # fmt: skip
def test_settings_at_the_edge_are_accepted(settings):
    plant(**settings)
    assert PlantSettings(**settings).step_s == 50e-6
