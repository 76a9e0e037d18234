"""The virtual arm's articulated bodies against an independent library, and its joints against a fine integration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from jointctl.firmware_py.arm_model import BASE
from jointctl.hil.arm_plant import ArmPlant, arm_plant, articulate, step_arm
from jointctl.hil.plant import plant, step_plant
from jointctl.hil.plant_records import FrictionKind
from tests.arms import GRAVITY_mps2, pinocchio_of, random_links

STEP_s = 50e-6


def at(model: Any, q: np.ndarray) -> Any:
    return pin.integrate(model, pin.neutral(model), q)


@pytest.mark.parametrize("joints", range(2, 8))
def test_forward_dynamics_is_that_of_pinocchio_on_random_trees(joints: int) -> None:
    rng = np.random.default_rng(100 + joints)
    for _ in range(10):
        links = random_links(rng, joints)
        arm, model = arm_plant(links, GRAVITY_mps2), pinocchio_of(links)
        q, v, torque = rng.uniform(-3, 3, joints), rng.uniform(-4, 4, joints), rng.uniform(-50, 50, joints)
        moving = arm.joints[:joints]
        moving.ahead_rad[:], moving.ahead_radps[:] = q, v
        articulate(arm)
        articulate(arm)  # nothing is left over from the first time
        inverse = moving.inverse[:, :joints]
        expected = pin.aba(model, model.createData(), at(model, q), v, torque)
        found = moving.free_radps2 + inverse @ torque
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * np.max(np.abs(expected)))
        rest = pin.aba(model, model.createData(), at(model, q), v, np.zeros(joints))
        for column in range(joints):  # pinocchio's mass matrix wants joints in another order
            unit = np.eye(joints)[column]
            pushed = pin.aba(model, model.createData(), at(model, q), v, unit)
            np.testing.assert_allclose(inverse[:, column], pushed - rest, atol=1e-10)


def free_arm(links: Any, **settings: Any) -> tuple[Any, Any, ArmPlant]:
    """Joints without brakes."""
    parts = [plant(step_s=STEP_s, **settings) for _ in links]
    arm = arm_plant(links, GRAVITY_mps2)
    arm.joints.braked[:] = 0
    constants = np.concatenate([c for c, _ in parts]).view(np.recarray)
    return constants, np.concatenate([s for _, s in parts]).view(np.recarray), arm


def chain(seed: int, joints: int = 3) -> Any:
    links = random_links(np.random.default_rng(seed), joints, prismatic=0.0)
    links.parent[:] = np.arange(joints) - 1
    return links


def test_a_falling_arm_moves_as_a_fine_integration_says() -> None:
    links = chain(3)
    constants, states, arm = free_arm(links)
    model = pinocchio_of(links)
    data, q, v = model.createData(), np.zeros(3), np.zeros(3)
    states.joint_velocity_radps[:] = v = np.array([1.0, -2.0, 1.5])
    torque = np.zeros(3)

    def slope(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return v, pin.aba(model, data, at(model, q), v, torque)

    h = 2e-4
    for _ in range(2500):  # 0.5 s, Runge-Kutta of the fourth order
        k1 = slope(q, v)
        k2 = slope(q + 0.5 * h * k1[0], v + 0.5 * h * k1[1])
        k3 = slope(q + 0.5 * h * k2[0], v + 0.5 * h * k2[1])
        k4 = slope(q + h * k3[0], v + h * k3[1])
        q = q + h / 6.0 * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0])
        v = v + h / 6.0 * (k1[1] + 2.0 * k2[1] + 2.0 * k3[1] + k4[1])
    for _ in range(10_000):
        step_arm(constants, states, arm)
    assert np.max(np.abs(states.joint_position_rad)) > 0.3
    np.testing.assert_allclose(states.joint_position_rad, q, atol=2e-5)


RIGID: dict[str, Any] = {"friction_kind": FrictionKind.LUGRE, "inertia_kgm2": 2.0}
FLEXIBLE: dict[str, Any] = {
    **RIGID, "flexible": True, "motor_side_inertia_kgm2": 1.2, "reducer_stiffness_Nmprad": 1.3e4,
    "hysteresis_width_rad": 2e-4, "link_friction_share": 0.1,
}  # fmt: skip


@pytest.mark.parametrize(("settings", "within_rad"), [(RIGID, 1e-6), (FLEXIBLE, 2e-6)], ids=["rigid", "flexible"])
def test_one_joint_is_the_joint_that_stands_alone(settings: dict[str, Any], within_rad: float) -> None:
    """A link about a horizontal axis under gravity, with friction: the plant of one joint has the same equation.

    The motor of a flexible joint is no part of the link, which the reducer moves.
    """
    links = new_pendulum()
    if settings is FLEXIBLE:
        links[0].inertia_kgm2[5], links[0].motor_inertia_kgm2 = 0.8, 0.0
    constants, states, arm = free_arm(links, **settings)
    arm.constants[0].gravity_mps2[:] = [0.0, 0.0, -9.81]
    alone_c, alone = plant(step_s=STEP_s, gravity_Nm=0.5 * 9.81, **settings)
    for k in range(20_000):
        torque = 40.0 * np.sin(2e-3 * k)
        arm.joints.target_Nm[0] = torque
        step_arm(constants, states, arm)
        step_plant(alone_c[0], alone[0], torque)
    assert abs(alone[0].joint_position_rad) > 0.005
    assert states[0].joint_position_rad == pytest.approx(alone[0].joint_position_rad, abs=within_rad)
    if settings is FLEXIBLE:
        assert states[0].motor_position_rad == pytest.approx(alone[0].motor_position_rad, abs=within_rad)


def new_pendulum() -> Any:
    """m g l = 0.5 g, 2 kg m2 in all; hanging down at angle 0."""
    links = chain(1, 1)
    link = links[0]
    link.rotation[:] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # z of the joint along x of the base
    link.mass_kg, link.moment_kgm[:] = 1.0, [0.0, -0.5, 0.0]
    link.inertia_kgm2[:] = [0.3, 0.0, 0.0, 0.3, 0.0, 0.3]
    link.motor_inertia_kgm2 = 1.7
    return links


def test_brakes_hold_the_arm() -> None:
    links = chain(5)
    constants, states, arm = free_arm(links)
    arm.joints.braked[:-1] = 1
    for _ in range(20_000):
        step_arm(constants, states, arm)
    assert np.max(np.abs(states.joint_position_rad)) < 2e-3
    assert np.max(np.abs(states.joint_velocity_radps)) < 1e-6


def test_the_base_does_not_move() -> None:
    constants, states, arm = free_arm(chain(6))
    for _ in range(100):
        step_arm(constants, states, arm)
    assert not arm.joints[BASE].motion.any()
