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

import math
from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import AxisConstants, AxisState
from jointctl.firmware_py.schema import array_of, f8, i4, record
from jointctl.firmware_py.states import AxisPhase

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
    """The memory of the model; without links there is none."""

    constants: np.ndarray  # ArmConstants[1]
    links: np.ndarray  # ArmLink[N]
    motion: np.ndarray  # ArmMotion[N + 1]; the last one is the base, where the index BASE finds it


# --- Recursive Newton-Euler ---


@kernel
def _go_out(link: ArmLink, own: ArmMotion, parent: ArmMotion) -> None:
    """Motion of the link from that of its parent, and the force and moment that this takes."""
    c, s, shift = 1.0, 0.0, 0.0
    spin, spin_up, speed, speed_up = 0.0, 0.0, 0.0, 0.0
    if link.kind == JointKind.REVOLUTE:
        c, s = math.cos(own.position_rad), math.sin(own.position_rad)
        spin, spin_up = own.velocity_radps, own.acceleration_radps2
    else:
        shift, speed, speed_up = own.position_rad, own.velocity_radps, own.acceleration_radps2
    turn, fixed = own.turn, link.rotation
    for k in range(3):
        x, y, z = fixed[k, 0], fixed[k, 1], fixed[k, 2]
        turn[k, 0] = x * c + y * s
        turn[k, 1] = y * c - x * s
        turn[k, 2] = z
        own.place_m[k] = link.offset_m[k] + shift * z
    px, py, pz = own.place_m[0], own.place_m[1], own.place_m[2]
    wx, wy, wz = parent.spin_radps[0], parent.spin_radps[1], parent.spin_radps[2]
    ux, uy, uz = parent.spin_up_radps2[0], parent.spin_up_radps2[1], parent.spin_up_radps2[2]
    # the own origin's acceleration, in the parent's frame: a + w' x p + w x (w x p)
    qx, qy, qz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
    ax = parent.pull_mps2[0] + uy * pz - uz * py + wy * qz - wz * qy
    ay = parent.pull_mps2[1] + uz * px - ux * pz + wz * qx - wx * qz
    az = parent.pull_mps2[2] + ux * py - uy * px + wx * qy - wy * qx
    # the same in the own frame, with what the joint adds
    vx = turn[0, 0] * wx + turn[1, 0] * wy + turn[2, 0] * wz
    vy = turn[0, 1] * wx + turn[1, 1] * wy + turn[2, 1] * wz
    vz = turn[0, 2] * wx + turn[1, 2] * wy + turn[2, 2] * wz
    tx = turn[0, 0] * ux + turn[1, 0] * uy + turn[2, 0] * uz + vy * spin
    ty = turn[0, 1] * ux + turn[1, 1] * uy + turn[2, 1] * uz - vx * spin
    tz = turn[0, 2] * ux + turn[1, 2] * uy + turn[2, 2] * uz + spin_up
    bx = turn[0, 0] * ax + turn[1, 0] * ay + turn[2, 0] * az + 2.0 * vy * speed
    by = turn[0, 1] * ax + turn[1, 1] * ay + turn[2, 1] * az - 2.0 * vx * speed
    bz = turn[0, 2] * ax + turn[1, 2] * ay + turn[2, 2] * az + speed_up
    vz += spin
    own.spin_radps[0], own.spin_radps[1], own.spin_radps[2] = vx, vy, vz
    own.spin_up_radps2[0], own.spin_up_radps2[1], own.spin_up_radps2[2] = tx, ty, tz
    own.pull_mps2[0], own.pull_mps2[1], own.pull_mps2[2] = bx, by, bz
    # force m a + w' x h + w x (w x h), moment I w' + w x I w + h x a, at the origin
    m, hx, hy, hz = link.mass_kg, link.moment_kgm[0], link.moment_kgm[1], link.moment_kgm[2]
    gx, gy, gz = vy * hz - vz * hy, vz * hx - vx * hz, vx * hy - vy * hx
    own.force_N[0] = m * bx + ty * hz - tz * hy + vy * gz - vz * gy
    own.force_N[1] = m * by + tz * hx - tx * hz + vz * gx - vx * gz
    own.force_N[2] = m * bz + tx * hy - ty * hx + vx * gy - vy * gx
    xx, xy, xz = link.inertia_kgm2[0], link.inertia_kgm2[1], link.inertia_kgm2[2]
    yy, yz, zz = link.inertia_kgm2[3], link.inertia_kgm2[4], link.inertia_kgm2[5]
    lx, ly, lz = xx * vx + xy * vy + xz * vz, xy * vx + yy * vy + yz * vz, xz * vx + yz * vy + zz * vz
    own.moment_Nm[0] = xx * tx + xy * ty + xz * tz + vy * lz - vz * ly + hy * bz - hz * by
    own.moment_Nm[1] = xy * tx + yy * ty + yz * tz + vz * lx - vx * lz + hz * bx - hx * bz
    own.moment_Nm[2] = xz * tx + yz * ty + zz * tz + vx * ly - vy * lx + hx * by - hy * bx


@kernel
def _come_back(link: ArmLink, own: ArmMotion, parent: ArmMotion) -> None:
    """Torque of the joint; its force and moment are added to those of the parent."""
    fx, fy, fz = own.force_N[0], own.force_N[1], own.force_N[2]
    nx, ny, nz = own.moment_Nm[0], own.moment_Nm[1], own.moment_Nm[2]
    along = nz if link.kind == JointKind.REVOLUTE else fz
    own.torque_Nm = along + link.motor_inertia_kgm2 * own.acceleration_radps2
    turn = own.turn
    gx = turn[0, 0] * fx + turn[0, 1] * fy + turn[0, 2] * fz
    gy = turn[1, 0] * fx + turn[1, 1] * fy + turn[1, 2] * fz
    gz = turn[2, 0] * fx + turn[2, 1] * fy + turn[2, 2] * fz
    px, py, pz = own.place_m[0], own.place_m[1], own.place_m[2]
    parent.force_N[0] += gx
    parent.force_N[1] += gy
    parent.force_N[2] += gz
    parent.moment_Nm[0] += turn[0, 0] * nx + turn[0, 1] * ny + turn[0, 2] * nz + py * gz - pz * gy
    parent.moment_Nm[1] += turn[1, 0] * nx + turn[1, 1] * ny + turn[1, 2] * nz + pz * gx - px * gz
    parent.moment_Nm[2] += turn[2, 0] * nx + turn[2, 1] * ny + turn[2, 2] * nz + px * gy - py * gx


@kernel
def newton_euler(arm: Arm) -> None:
    """Torques of all joints for the positions, velocities and accelerations that stand in `arm.motion`."""
    links, motion = arm.links, arm.motion
    base = motion[BASE]
    for k in range(3):
        base.pull_mps2[k] = -arm.constants[0].gravity_mps2[k]
    for i in range(len(links)):
        _go_out(links[i], motion[i], motion[links[i].parent])
    for i in range(len(links) - 1, -1, -1):
        _come_back(links[i], motion[i], motion[links[i].parent])


# --- In the loop ---


@kernel
def feed_arm(arm: Arm, constants: np.ndarray, states: np.ndarray) -> None:
    """For each law what the arm asks of its joint beyond the joint's own inertia: `LawState.arm_torque_Nm`.

    Of the motion desired `feed_forward_lead_s` later.  Where an axis follows no reference the joint counts as resting
    where it was measured.
    """
    kind = arm.constants[0].feed_forward
    if kind == ArmFeedForward.NONE:
        return
    for axis in range(len(arm.links)):
        state: AxisState = states[axis]
        own: ArmMotion = arm.motion[axis]
        own.velocity_radps = own.acceleration_radps2 = 0.0
        if state.phase >= AxisPhase.APPROACH and state.phase <= AxisPhase.RAMPING:
            one: AxisConstants = constants[axis]
            desired = state.reference
            lead_s = one.law.feed_forward_lead_s
            mean_radps = desired.velocity_radps + 0.5 * lead_s * desired.acceleration_radps2
            own.position_rad = desired.position_rad + lead_s * mean_radps
            if kind == ArmFeedForward.WHOLE:
                own.velocity_radps = desired.velocity_radps + lead_s * desired.acceleration_radps2
                own.acceleration_radps2 = desired.acceleration_radps2 + lead_s * desired.jerk_radps3
        else:
            own.position_rad = state.measured_position_rad
    newton_euler(arm)
    for axis in range(len(arm.links)):
        law: AxisConstants = constants[axis]
        own = arm.motion[axis]
        states[axis].law.arm_torque_Nm = own.torque_Nm - law.law.inertia_kgm2 * own.acceleration_radps2
