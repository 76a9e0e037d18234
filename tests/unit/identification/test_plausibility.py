"""Plausibility of an identified friction: constants, units, sides and signs that are wrong on purpose."""

from dataclasses import replace

import numpy as np
import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.identification.fit import make_problem, project
from jointctl.tools.identification.identification import identify_friction
from jointctl.tools.identification.models import FORMS
from jointctl.tools.identification.plausibility import JointLimits, check_branches, check_data
from tests.unit.identification.synthetic_friction import LIMITS, QUICK, paper_data


def test_one_point_far_off_on_the_wrong_side_is_told_as_such():
    data = paper_data(0)
    torque = data.motor_torque_Nm.copy()
    torque[0] = 1e300
    problems = check_data(replace(data, motor_torque_Nm=torque), None).problems
    assert "mean torque at negative velocity drives the motion" in problems[0]
    assert not any("a factor of" in problem for problem in problems)


def test_right_data_raise_nothing():
    verdict = check_data(paper_data(0), LIMITS)
    assert verdict.problems == []
    assert verdict.warnings == []


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"torque_factor": -1.0}, "torque does not oppose the motion at positive velocity: right sign at 0%"),
        ({"speed_factor": -1.0}, "torque does not oppose the motion"),
        ({"offset_Nm": 0.4}, "does not oppose the motion at negative velocity"),
        ({"torque_factor": 121.0}, "times limits.torque_max_Nm"),  # joint torque taken for motor torque
        ({"torque_factor": 10.0}, r"6\.9\d times limits.torque_max_Nm"),  # torque constant ten times too large
        ({"speed_factor": 180.0 / np.pi}, "times limits.velocity_max_radps"),  # deg/s taken for rad/s
        ({"speed_factor": 121.0}, "times limits.velocity_max_radps"),  # motor speed taken for joint speed
        ({"ratio": 100.0}, r"reduction ratio of the data \(=100\) differs from joint.reduction_ratio \(=121\)"),
    ],
)
def test_what_is_wrong_on_purpose_is_refused(wrong, message):
    with pytest.raises(DataError, match=message):
        identify_friction(paper_data(0, **wrong), QUICK, limits=LIMITS)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"torque_factor": 1.0 / 121.0}, "times limits.torque_max_Nm"),  # motor torque divided by the ratio again
        ({"speed_factor": 1.0 / 121.0}, "or a unit or a side is wrong"),  # joint speed divided by the ratio again
        ({"speed_factor": np.pi / 180.0}, "or a unit or a side is wrong"),
        ({"offset_Nm": 0.14}, "a load"),
        ({"torque_factor": 1.3}, "times limits.torque_max_Nm"),
    ],
)
def test_what_may_be_wrong_is_warned_about(wrong, message):
    verdict = check_data(paper_data(0, **wrong), LIMITS)
    assert verdict.problems == []
    assert any(message in warning for warning in verdict.warnings)


@pytest.mark.parametrize(("constant", "refused"), [(0.1, False), (0.10009, False), (0.10011, True), (0.1414, True)])
def test_another_torque_constant_than_configured_is_refused(constant, refused):
    limits = JointLimits(60.0, 3.5, 121.0, constant)
    assert bool(check_data(paper_data(0), limits).problems) is refused


@pytest.mark.parametrize(("share", "refused"), [(1.19, False), (1.21, True)])
def test_friction_above_what_the_joint_can_drive_is_refused_at_the_limit(share, refused):
    data = paper_data(0)
    reach_Nm = 121.0 * np.percentile(np.abs(data.motor_torque_Nm), 95)
    limits = JointLimits(reach_Nm / share, 3.5, 121.0, 0.1)
    assert bool(check_data(data, limits).problems) is refused


def test_negative_viscous_friction_and_a_falling_end_are_told_with_their_numbers():
    u = np.linspace(0.05, 3.0, 80)
    found = project(make_problem(FORMS["coulomb-viscous"], u, 0.2 - 0.03 * u, 1.0, (None, 0.5))).branch()
    verdict = check_branches({"positive": found})
    assert any("tv = -0.03" in w for w in verdict.warnings)
    assert any("falls with speed" in w for w in verdict.warnings)
    steep = project(make_problem(FORMS["coulomb-viscous"], u, 0.2 - 0.08 * u, 1.0, (None, 0.5))).branch()
    assert "drives the motion" in check_branches({"positive": steep}).problems[0]
