"""Random arms, for the model and for an independent library; the files of an arm of seven joints."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jointctl.firmware_py.arm_model import Arm, ArmConstants, ArmLink, ArmMotion, JointKind
from jointctl.firmware_py.schema import new
from jointctl.tools.configuration.arm import SHIPPED_ARM

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


LONG_ARM, LONG_RATE_Hz = 7, 500.0  # joints: 83.3 % of a bus
_LINK = """  <link name="link{i}"><inertial><origin xyz="0.05 0 0"/><mass value="0.4"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial></link>
  <joint name="joint{i}" type="revolute"><parent link="{parent}"/><child link="link{i}"/><origin xyz="0.1 0 0"/>
    <axis xyz="{axis}"/><limit lower="-1.5" upper="1.5" velocity="3.4" effort="150"/></joint>
"""


def long_arm(folder: Path) -> Path:
    """The file of an arm of seven light links, with the shipped shoulder's drives and softer gains at 500 Hz."""
    text = (SHIPPED_ARM.parent / "shoulder.toml").read_text()
    for key, value in (("rate_Hz", LONG_RATE_Hz), ("kp", 900.0), ("kv", 60.0), ("observer_radps", 20.0)):
        text, count = re.subn(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
        assert count == 1, key
    links = ""
    for i in range(LONG_ARM):
        (folder / f"joint{i}.toml").write_text(re.sub(r"(?m)^node = 1", f"node = {i + 1}", text))
        axis = ("0 0 1", "0 1 0")[i % 2]
        links += _LINK.format(i=i, parent=f"link{i - 1}" if i else "base", axis=axis)
    (folder / "arm.urdf").write_text(f'<robot name="long">\n  <link name="base"/>\n{links}</robot>\n')
    path = folder / "arm.toml"
    path.write_text(
        f"[arm]\nurdf = 'arm.urdf'\njoints = {[f'joint{i}.toml' for i in range(LONG_ARM)]}\n"
        f"motor_inertia_kgm2 = {[2.2] * LONG_ARM}\n\n[motion]\nkind = 'sine'\nduration_s = 0.0\n"
        f"amplitude_rad = {[0.2] * LONG_ARM}\nfrequency_Hz = {[0.2 + 0.05 * i for i in range(LONG_ARM)]}\n"
    )
    return path
