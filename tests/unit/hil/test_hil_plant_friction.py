"""The virtual joint's friction: the sliding curve (11), stick-slip, LuGre, ripple, temperature."""

import math

import pytest

from jointctl.firmware_py.friction import friction_motor_torque_Nm, paper_friction
from jointctl.firmware_py.kernel import kernel
from jointctl.hil.plant.joint import FrictionKind, plant, step_plant

RATIO = 121.0
DEGREE = math.pi / 180.0
STATIC_FORWARD_Nm = RATIO * 0.14537
STATIC_BACKWARD_Nm = -RATIO * 0.15750
# joint velocity [deg/s] -> friction at the motor [Nm], from the specification
CHECK_VALUES = [
    (12.6, 0.15326),
    (-12.6, -0.13814),
    (40.0, 0.22592),
    (40.0001, 0.22761),
    (-40.0, -0.20530),
    (-40.0001, -0.20402),
    (100.0, 0.28871),
    (200.0, 0.33823),
    (-200.0, -0.35398),
]


@kernel
def run(c, s, torque_Nm, substeps):
    for _ in range(substeps):
        step_plant(c, s, torque_Nm)


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
