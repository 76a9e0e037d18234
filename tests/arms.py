"""Random arms, for the model, for an independent library, and as a URDF."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from jointctl.firmware_py.arm_model import Arm, ArmConstants, ArmLink, ArmMotion, JointKind
from jointctl.firmware_py.schema import new

GRAVITY_mps2 = (1.5, -2.5, -9.0)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def random_links(rng: np.random.Generator, count: int, prismatic: float = 0.3) -> Any:
    """`ArmLink` records of a random tree, with motors."""
    links = new(ArmLink, count)
    for i, link in enumerate(links):
        link.parent = rng.integers(-1, i) if i else -1
        link.kind = JointKind.PRISMATIC if rng.random() < prismatic else JointKind.REVOLUTE
        link.rotation[:] = random_rotation(rng)
        link.offset_m[:] = rng.uniform(-0.5, 0.5, 3)
        mass, centre = rng.uniform(0.3, 8.0), rng.uniform(-0.3, 0.3, 3)
        moments = rng.uniform(0.01, 0.1, 3)
        turn = random_rotation(rng)
        about_centre = turn @ np.diag(moments.sum() - moments) @ turn.T
        inertia = about_centre + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        link.mass_kg, link.moment_kgm[:] = mass, mass * centre
        link.inertia_kgm2[:] = inertia[np.triu_indices(3)]
        link.motor_inertia_kgm2 = rng.uniform(0.0, 2.0)
    return links


def arm_of(links: Any) -> Arm:
    """The memory of the model."""
    constants = new(ArmConstants)
    constants[0].gravity_mps2[:] = GRAVITY_mps2
    return Arm(constants, links, new(ArmMotion, len(links) + 1))


def set_motion(arm: Arm, positions: np.ndarray, velocities: np.ndarray, accelerations: np.ndarray) -> None:
    for own, q, v, a in zip(arm.motion, positions, velocities, accelerations, strict=False):
        own.position_rad, own.velocity_radps, own.acceleration_radps2 = q, v, a


def pinocchio_of(links: Any) -> Any:
    """The same tree in pinocchio, its joints in the same order."""
    model = pin.Model()
    model.gravity.linear = np.array(GRAVITY_mps2)
    joints = []
    for i, link in enumerate(links):
        kind = pin.JointModelPZ() if link.kind == JointKind.PRISMATIC else pin.JointModelRZ()
        parent = joints[link.parent] if link.parent >= 0 else 0
        place = pin.SE3(np.array(link.rotation), np.array(link.offset_m))
        joints.append(model.addJoint(parent, kind, place, f"joint{i}"))
        mass, centre = float(link.mass_kg), np.array(link.moment_kgm) / float(link.mass_kg)
        inertia = np.zeros((3, 3))
        inertia[np.triu_indices(3)] = link.inertia_kgm2
        inertia = inertia + np.triu(inertia, 1).T
        about_centre = inertia - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        model.appendBodyToJoint(joints[-1], pin.Inertia(mass, centre, about_centre), pin.SE3.Identity())
    model.armature = np.array(links.motor_inertia_kgm2, dtype=float)
    return model
