"""Friction: the multi-stage model (11) with Table 3, and LuGre driven by a given velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import (
    DEGREE,
    Condition,
    PrintedBranch,
    branch_constants,
    branch_torque_Nm,
    compensation_motor_torque_Nm,
    condition_of,
    friction_constants,
    friction_curve_Nm,
    friction_motor_torque_Nm,
    paper_friction,
    step_lugre,
)
from jointctl.firmware_py.records import LuGreConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ZeroSpeedRule
from jointctl.tools.configuration.conversions import fill_series

# --- The multi-stage friction model (11) with Table 3 ---
JUST = 1e-9
# joint speed [deg/s], motor torque [Nm]
CHECK_VALUES = [
    (JUST, 0.14537), (-JUST, -0.15750), (12.6, 0.15326), (-12.6, -0.13814), (40.0, 0.22592), (40.0 + JUST, 0.22761),
    (-40.0, -0.20530), (-40.0 - JUST, -0.20402), (100.0, 0.28871), (200.0, 0.33823), (-200.0, -0.35398),
]  # fmt: skip


@pytest.fixture
def friction() -> Any:
    return paper_friction()[0]


@pytest.mark.parametrize(("speed_degps", "torque_Nm"), CHECK_VALUES)
def test_check_values(friction: Any, speed_degps: float, torque_Nm: float) -> None:
    assert friction_motor_torque_Nm(friction, speed_degps * DEGREE) == pytest.approx(torque_Nm, abs=5.1e-6)


def test_every_speed_is_opposed_and_at_zero_there_is_none(friction: Any) -> None:
    speeds = np.linspace(0.01, 300.0, 500) * DEGREE
    assert all(friction_motor_torque_Nm(friction, v) > 0.1 for v in speeds)
    assert all(friction_motor_torque_Nm(friction, -v) < -0.1 for v in speeds)
    assert friction_motor_torque_Nm(friction, 0.0) == 0.0
    assert friction_motor_torque_Nm(friction, -0.0) == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_value_and_slope_are_held_beyond_the_maximum(friction: Any, sign: float) -> None:
    end, h = 200.0 * DEGREE, 1e-4

    def torque(speed: float) -> float:
        return sign * friction_motor_torque_Nm(friction, sign * speed)

    slope_inside = (torque(end) - torque(end - h)) / h
    slope_outside = (torque(end + h) - torque(end)) / h
    assert slope_outside == pytest.approx(slope_inside, abs=2e-4)
    assert torque(end + 2.0) - torque(end + 1.0) == pytest.approx(slope_outside, rel=1e-6)


@pytest.mark.parametrize(
    ("rule", "at_zero_Nm"), [(ZeroSpeedRule.ZERO, 0.0), (ZeroSpeedRule.PAPER, 0.14537), (ZeroSpeedRule.LINEAR, 0.0)]
)
def test_zero_speed_rules(friction: Any, rule: int, at_zero_Nm: float) -> None:
    for zero in (0.0, -0.0):
        assert compensation_motor_torque_Nm(friction, rule, 0.01, zero) == pytest.approx(at_zero_Nm, abs=1e-12)
    for v in (-1.0, -0.02, 0.02, 1.0):
        assert compensation_motor_torque_Nm(friction, rule, 0.01, v) == friction_motor_torque_Nm(friction, v)


def test_linear_rule_is_a_line_and_meets_the_curve_at_the_band(friction: Any) -> None:
    band = 0.01

    def torque(v: float) -> float:
        return compensation_motor_torque_Nm(friction, ZeroSpeedRule.LINEAR, band, v)

    for sign in (1.0, -1.0):
        edge = friction_motor_torque_Nm(friction, sign * band)
        assert torque(sign * band) == edge
        assert torque(sign * 0.5 * band) == pytest.approx(0.5 * edge)
        assert torque(sign * band * (1.0 - 1e-9)) == pytest.approx(edge, rel=1e-8)
    # without a band the rule is ZERO, never a division by zero
    assert compensation_motor_torque_Nm(friction, ZeroSpeedRule.LINEAR, 0.0, 0.0) == 0.0


def test_units_and_sides_are_converted_once() -> None:
    """The same joint, given in r/min of the motor and Nm at the joint, is the same curve."""
    ratio = 121.0
    factor = 6.0 / ratio  # joint deg/s per motor r/min

    def branch(tc: float, ts: float, ws: float, tv: float, cubic: Sequence[float], knee: float, negative: bool) -> Any:
        cubic = [a * ratio * factor**n for n, a in enumerate(cubic)]
        printed = PrintedBranch(
            tc * ratio, ts * ratio, ws / factor, tv * ratio * factor, cubic, knee / factor, 5.0 * knee / factor
        )
        return branch_constants(printed, negative=negative, radps_per_unit=factor * DEGREE, torque_scale=1.0 / ratio)

    given = friction_constants(
        branch(0.11985, 0.14537, 1.2301, 0.0026518, (0.17995, 0.0012298, -6.5261e-7, -7.6969e-9), 40.0, False),
        branch(0.1063, 0.1575, 2.887, 0.002475, (-0.1272, 0.0022866, 1e-5, 2.1182e-8), -40.0, True),
    )
    speeds = np.linspace(-240.0, 240.0, 97) * DEGREE
    np.testing.assert_allclose(friction_curve_Nm(given, speeds), friction_curve_Nm(paper_friction(), speeds), rtol=1e-9)


def test_not_a_number_does_not_look_like_a_torque_of_a_branch(friction: Any) -> None:
    assert math.isnan(branch_torque_Nm(friction.positive, math.nan))


# --- LuGre friction driven by a given velocity ---
RATIO = 121.0


@pytest.fixture
def lugre() -> Any:
    constants = new(LuGreConstants)[0]
    constants.stiffness_Nmprad, constants.damping_Nmspr = 8e4, 200.0
    return constants


@pytest.mark.parametrize("velocity_radps", [0.002, -0.002, 0.05, -0.05, 0.6, -0.6, 0.8, -0.8, 3.4, -3.4, 5.0])
def test_steady_state_is_the_multi_stage_model(lugre: Any, friction: Any, velocity_radps: float) -> None:
    deflection, torque = 0.0, 0.0
    for _ in range(2000):
        deflection, torque = step_lugre(lugre, friction, RATIO, deflection, velocity_radps, 1e-3)
    expected_Nm = RATIO * friction_motor_torque_Nm(friction, velocity_radps)
    assert torque == pytest.approx(expected_Nm, rel=1e-6)
    assert deflection == pytest.approx(expected_Nm / 8e4, rel=1e-6)


@pytest.mark.parametrize("steps", [2, 10, 1000])
@pytest.mark.parametrize("velocity_radps", [0.003, -0.02, 0.5])
def test_the_update_is_exact_and_so_does_not_depend_on_the_step(
    lugre: Any, friction: Any, velocity_radps: float, steps: int
) -> None:
    whole, _ = step_lugre(lugre, friction, RATIO, -1e-4, velocity_radps, 0.01)
    deflection = -1e-4
    for _ in range(steps):
        deflection, _ = step_lugre(lugre, friction, RATIO, deflection, velocity_radps, 0.01 / steps)
    assert deflection == pytest.approx(whole, rel=1e-9)


def test_a_huge_step_is_stable(lugre: Any, friction: Any) -> None:
    deflection, torque = step_lugre(lugre, friction, RATIO, 0.0, 3.0, 10.0)
    assert 0.0 < deflection <= RATIO * friction_motor_torque_Nm(friction, 3.0) / 8e4 * (1.0 + 1e-12)
    assert np.isfinite(torque)


def test_no_creep_at_standstill(lugre: Any, friction: Any) -> None:
    """At zero velocity the bristle keeps its deflection, and the torque is its spring, without damping."""
    for start_rad in (1e-4, -1e-4, 0.0):
        deflection = start_rad
        for _ in range(1000):
            deflection, torque = step_lugre(lugre, friction, RATIO, deflection, 0.0, 1e-3)
            assert torque == 8e4 * start_rad
        assert deflection == start_rad


def test_a_small_motion_is_a_spring(lugre: Any, friction: Any) -> None:
    moved_rad = 1e-7
    deflection, _ = step_lugre(lugre, friction, RATIO, 0.0, moved_rad / 1e-3, 1e-3)
    assert deflection == pytest.approx(moved_rad, rel=1e-3)


def test_torque_is_spring_plus_damping_of_the_mean_rate(lugre: Any, friction: Any) -> None:
    deflection, torque = step_lugre(lugre, friction, RATIO, 1e-5, 0.01, 1e-3)
    assert torque == pytest.approx(8e4 * deflection + 200.0 * (deflection - 1e-5) / 1e-3)


def test_a_reversal_uses_the_other_branch(lugre: Any, friction: Any) -> None:
    deflection, _ = step_lugre(lugre, friction, RATIO, 0.0, 0.2, 1.0)
    assert deflection > 0.0
    deflection, torque = step_lugre(lugre, friction, RATIO, deflection, -0.2, 1.0)
    assert torque < 0.0
    deflection, torque = step_lugre(lugre, friction, RATIO, deflection, -0.2, 1.0)
    assert torque == pytest.approx(RATIO * friction_motor_torque_Nm(friction, -0.2), rel=1e-6)


# --- load and temperature ---
SPEEDS_radps = (1e-4, 0.02, 0.3, 0.69, 0.71, 3.0)


def conditioned(**values: float) -> Any:
    friction = paper_friction()[0]
    friction.reference_degC, friction.lowest_degC, friction.highest_degC, friction.conditioned = 25.0, 0.0, 60.0, 1
    for name, value in values.items():
        setattr(friction, name, value)
    return friction


def test_a_curve_without_load_and_temperature_takes_no_notice_of_them():
    friction = paper_friction()[0]
    for v in SPEEDS_radps:
        assert friction_motor_torque_Nm(friction, v, Condition(3.0, 0.5, 2.0)) == friction_motor_torque_Nm(friction, v)
    assert condition_of(friction, -7.0, 80.0) == (0.0, 1.0, 1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("load_Nm", [0.1, -0.1])
def test_load_friction_opposes_the_motion_whichever_way_the_load_pushes(sign, load_Nm):
    friction = conditioned(load_coulomb=0.2, load_viscous_spr=0.1)
    condition = condition_of(friction, load_Nm, 25.0)
    for v in SPEEDS_radps:
        more = friction_motor_torque_Nm(friction, sign * v, condition) - friction_motor_torque_Nm(friction, sign * v)
        assert more == pytest.approx(sign * 0.1 * (0.2 + 0.1 * v), rel=1e-9)


@pytest.mark.parametrize("degC", [5.0, 25.0, 55.0])
def test_each_part_has_its_own_factor_of_temperature(degC):
    friction = conditioned(temperature_coulomb_pK=0.01, temperature_viscous_pK=0.03)
    coulomb, viscous = math.exp(-0.01 * (degC - 25.0)), math.exp(-0.03 * (degC - 25.0))
    branch, condition = friction.positive, condition_of(friction, 0.0, degC)
    for v in SPEEDS_radps:
        first = branch.coulomb_Nm + (branch.static_Nm - branch.coulomb_Nm) * math.exp(-v / branch.stribeck_speed_radps)
        rest = branch_torque_Nm(branch, v) - first
        expected = first * coulomb + rest * viscous
        assert friction_motor_torque_Nm(friction, v, condition) == pytest.approx(expected, rel=1e-9)


def test_beyond_the_range_of_temperatures_the_factors_are_held():
    friction = conditioned(temperature_coulomb_pK=0.01)
    assert condition_of(friction, 0.0, 4000.0) == condition_of(friction, 0.0, 60.0)
    assert condition_of(friction, 0.0, -273.0) == condition_of(friction, 0.0, 0.0)
    assert condition_of(friction, 0.0, 59.0) != condition_of(friction, 0.0, 60.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_that_goes_with_the_angle_turns_round_with_the_motion(sign):
    friction = conditioned()
    fill_series(friction.of_angle, 100.0, ((0.2, 0.1), (2.0, 0.01), (0.7, -0.3)))
    for motor_rad in (0.0, 0.123, -2.5):
        share = 0.2 * math.sin(200.0 * motor_rad + 0.7) + 0.1 * math.sin(motor_rad - 0.3)
        condition = condition_of(friction, 0.0, 25.0, motor_rad)
        for v in SPEEDS_radps:
            plain = friction_motor_torque_Nm(friction, sign * v)
            assert friction_motor_torque_Nm(friction, sign * v, condition) == pytest.approx(plain * (1.0 + share))


def test_the_steady_lugre_torque_has_load_and_temperature():
    friction = conditioned(load_coulomb=0.2, temperature_coulomb_pK=0.01, temperature_viscous_pK=0.03)
    lugre, condition = new(LuGreConstants)[0], condition_of(friction, 0.08, 45.0)
    lugre.stiffness_Nmprad, lugre.damping_Nmspr = 8e4, 200.0
    deflection, torque = 0.0, 0.0
    for _ in range(2000):
        deflection, torque = step_lugre(lugre, friction, RATIO, deflection, 0.2, 1e-3, condition)
    assert torque == pytest.approx(RATIO * friction_motor_torque_Nm(friction, 0.2, condition), rel=1e-9)
