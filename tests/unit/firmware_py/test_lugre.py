"""LuGre friction driven by a given velocity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import friction_motor_torque_Nm, paper_friction, step_lugre
from jointctl.firmware_py.records import LuGreConstants
from jointctl.firmware_py.schema import new

RATIO = 121.0


@pytest.fixture
def lugre() -> Any:
    constants = new(LuGreConstants)[0]
    constants.stiffness_Nmprad, constants.damping_Nmspr = 8e4, 200.0
    return constants


@pytest.fixture
def friction() -> Any:
    return paper_friction()[0]


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
