"""The multi-stage friction model (11) with Table 3."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import (
    DEGREE,
    branch_constants,
    branch_torque_Nm,
    compensation_motor_torque_Nm,
    friction_constants,
    friction_curve_Nm,
    friction_motor_torque_Nm,
    paper_friction,
)
from jointctl.firmware_py.states import ZeroSpeedRule

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


def test_times_the_ratio_it_is_17_6_to_42_8_Nm_at_the_joint(friction: Any) -> None:
    assert 121.0 * friction_motor_torque_Nm(friction, JUST) == pytest.approx(17.6, abs=0.05)
    assert 121.0 * friction_motor_torque_Nm(friction, -200.0 * DEGREE) == pytest.approx(-42.8, abs=0.05)


@pytest.mark.parametrize(("sign", "step_Nm"), [(1.0, 0.0017), (-1.0, 0.0013)])
def test_the_stages_do_not_meet_at_the_knee(friction: Any, sign: float, step_Nm: float) -> None:
    inside = friction_motor_torque_Nm(friction, sign * 40.0 * DEGREE)
    outside = friction_motor_torque_Nm(friction, sign * (40.0 + JUST) * DEGREE)
    assert abs(outside - inside) == pytest.approx(step_Nm, abs=5e-5)


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

    def branch(
        tc: float, ts: float, ws: float, tv: float, cubic: tuple[float, ...], knee: float, negative: bool
    ) -> Any:
        return branch_constants(
            tc * ratio, ts * ratio, ws / factor, tv * ratio * factor,
            [a * ratio * factor**n for n, a in enumerate(cubic)], knee / factor, 5.0 * knee / factor,
            negative=negative, radps_per_unit=factor * DEGREE, torque_scale=1.0 / ratio,
        )  # fmt: skip

    given = friction_constants(
        branch(0.11985, 0.14537, 1.2301, 0.0026518, (0.17995, 0.0012298, -6.5261e-7, -7.6969e-9), 40.0, False),
        branch(0.1063, 0.1575, 2.887, 0.002475, (-0.1272, 0.0022866, 1e-5, 2.1182e-8), -40.0, True),
    )
    speeds = np.linspace(-240.0, 240.0, 97) * DEGREE
    np.testing.assert_allclose(friction_curve_Nm(given, speeds), friction_curve_Nm(paper_friction(), speeds), rtol=1e-9)


def test_not_a_number_does_not_look_like_a_torque_of_a_branch(friction: Any) -> None:
    assert math.isnan(branch_torque_Nm(friction.positive, math.nan))
