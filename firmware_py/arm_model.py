"""The arm that joints belong to: what its links ask of every joint, by recursive Newton-Euler.

    tau = M(q) q'' + C(q, q') q' + G(q),   G without motion, M with the motors' inertias at their joints

Links form a tree; a link's index is that of the joint that moves it, and its parent's is lower.  A link's frame sits
at its joint, with z along the axis, so that a joint's motion is a turn about z (or a shift along it).  Forward, from
the base: w, w', a of each frame, gravity as an acceleration of the base; backward: force and moment at each joint
(Luh, Walker and Paul 1980; in link coordinates as in Featherstone, Rigid Body Dynamics Algorithms, 2008).

It is fed the desired motion and not the measured one: no encoder of a joint acts on the torque of another, and the
loop of each joint, with its margins, is what it is alone.

Not modelled: the gyroscopic torque of the motors, which turn about the axes of their joints; flexibility."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, new, record

BASE = -1  # parent of a link that hangs on no other


class JointKind(IntEnum):
    REVOLUTE = 0
    PRISMATIC = 1


class ArmFeedForward(IntEnum):
    """How much of the model the joints get."""

    NONE = 0  # each joint is on its own
    GRAVITY = 1
    WHOLE = 2


@record
class ArmConstants:
    feed_forward: i4  # ArmFeedForward
    gravity_mps2: Annotated[np.ndarray, array_of(f8, 3)]  # in the frame of the base


@record
class ArmLink:
    """A joint and the link that it moves."""

    parent: i4  # index of the link that it sits on, or BASE
    kind: i4  # JointKind
    rotation: Annotated[np.ndarray, array_of(f8, 3, 3)]  # columns: the own axes at angle 0, in the parent's frame
    offset_m: Annotated[np.ndarray, array_of(f8, 3)]  # the own origin in the parent's frame
    mass_kg: f8
    moment_kgm: Annotated[np.ndarray, array_of(f8, 3)]  # mass times centre
    inertia_kgm2: Annotated[np.ndarray, array_of(f8, 6)]  # about the origin: xx, xy, xz, yy, yz, zz
    motor_inertia_kgm2: f8  # at the joint


@record
class ArmMotion:
    """Of one joint and its link, in one cycle; `position_rad` [m], ... of a prismatic joint."""

    position_rad: f8
    velocity_radps: f8
    acceleration_radps2: f8
    torque_Nm: f8
    turn: Annotated[np.ndarray, array_of(f8, 3, 3)]  # columns: the own axes in the parent's frame
    place_m: Annotated[np.ndarray, array_of(f8, 3)]  # the own origin in the parent's frame
    spin_radps: Annotated[np.ndarray, array_of(f8, 3)]
    spin_up_radps2: Annotated[np.ndarray, array_of(f8, 3)]
    pull_mps2: Annotated[np.ndarray, array_of(f8, 3)]  # acceleration of the origin, less gravity
    force_N: Annotated[np.ndarray, array_of(f8, 3)]  # that the joint exerts on the link
    moment_Nm: Annotated[np.ndarray, array_of(f8, 3)]


class Arm(NamedTuple):
    """The memory of the model: of no arm all three are empty."""

    constants: np.ndarray  # ArmConstants[1]
    links: np.ndarray  # ArmLink[N]
    motion: np.ndarray  # ArmMotion[N]


def no_arm() -> Arm:
    """Of a joint, or joints, that no model connects."""
    return Arm(new(ArmConstants, 0), new(ArmLink, 0), new(ArmMotion, 0))
