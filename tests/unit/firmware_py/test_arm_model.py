"""The arm's model against an independent library."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from jointctl.firmware_py.arm_model import ArmFeedForward, JointKind, feed_arm, newton_euler
from jointctl.firmware_py.records import AxisConstants, AxisState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from tests.arms import arm_of, pinocchio_of, random_links, set_motion

JERK_radps3 = -40.0


@pytest.mark.parametrize("joints", range(2, 8))
def test_torques_are_those_of_pinocchio_on_random_trees(joints: int) -> None:
    rng = np.random.default_rng(joints)
    kinds = set()
    for _ in range(20):
        links = random_links(rng, joints)
        kinds |= {int(kind) for kind in links.kind}
        arm, model = arm_of(links), pinocchio_of(links)
        q, v, a = rng.uniform(-3, 3, joints), rng.uniform(-4, 4, joints), rng.uniform(-20, 20, joints)
        set_motion(arm, q, v, a)
        newton_euler(arm)
        expected = pin.rnea(model, model.createData(), pin.integrate(model, pin.neutral(model), q), v, a)
        found = arm.motion["torque_Nm"][:joints]
        assert np.max(np.abs(found - expected)) <= 1e-12 * np.max(np.abs(expected))
    assert kinds == {JointKind.REVOLUTE, JointKind.PRISMATIC}


def fed(
    kind: ArmFeedForward, phase: AxisPhase, lead_s: float = 0.0
) -> tuple[Any, Any, np.ndarray, np.ndarray, np.ndarray]:
    """(pinocchio's model, torques for the laws, positions, velocities, accelerations) of an arm on its reference."""
    rng = np.random.default_rng(1)
    links = random_links(rng, 3, prismatic=0.0)
    arm = arm_of(links)
    arm.constants[0].feed_forward = kind
    constants, states = new(AxisConstants, 3), new(AxisState, 3)
    q, v, a = rng.normal(size=(3, 3))
    for i in range(3):
        constants[i].law.inertia_kgm2 = 1.0 + i
        states[i].phase = phase
        reference = states[i].reference
        reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = q[i], v[i], a[i]
        reference.jerk_radps3, constants[i].law.feed_forward_lead_s = JERK_radps3, lead_s
        states[i].measured_position_rad = q[i] + 0.1
    feed_arm(arm, constants, states)
    return pinocchio_of(links), states.law.arm_torque_Nm, q, v, a


def at(model: Any, q: np.ndarray) -> Any:
    return pin.integrate(model, pin.neutral(model), q)


def test_a_law_gets_what_is_beyond_its_own_inertia() -> None:
    model, found, q, v, a = fed(ArmFeedForward.WHOLE, AxisPhase.TRACKING)
    expected = pin.rnea(model, model.createData(), at(model, q), v, a) - np.array([1.0, 2.0, 3.0]) * a
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_with_a_lead_it_is_the_model_of_the_motion_that_will_be() -> None:
    lead_s = 0.003
    model, found, q, v, a = fed(ArmFeedForward.WHOLE, AxisPhase.TRACKING, lead_s)
    later = a + lead_s * JERK_radps3
    ahead = q + lead_s * v + 0.5 * lead_s**2 * a, v + lead_s * a
    expected = (
        pin.rnea(model, model.createData(), at(model, ahead[0]), ahead[1], later) - np.array([1.0, 2.0, 3.0]) * later
    )
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_gravity_alone_is_of_the_desired_pose() -> None:
    model, found, q, _, _ = fed(ArmFeedForward.GRAVITY, AxisPhase.TRACKING)
    np.testing.assert_allclose(
        found, pin.computeGeneralizedGravity(model, model.createData(), at(model, q)), rtol=1e-12
    )


def test_without_a_reference_a_joint_rests_where_it_was_measured() -> None:
    model, found, q, _, _ = fed(ArmFeedForward.WHOLE, AxisPhase.QUICK_STOPPING)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), at(model, q + 0.1))
    np.testing.assert_allclose(found, gravity, rtol=1e-12)


def test_no_model_feeds_nothing() -> None:
    _, found, *_ = fed(ArmFeedForward.NONE, AxisPhase.TRACKING)
    assert not found.any()
