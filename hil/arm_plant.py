"""The virtual arm: joints of `hil.plant` that move one another, by the articulated-body algorithm.

    q'' = M^-1 (tau - C q' - G) = a0 + M^-1 tau        tau_i: actuator - friction - load of a rigid joint,
                                                       torsion - link friction - load of a flexible one

Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 7, here in coordinates of the base, so that what links
exchange needs no transformation: spatial vectors (turn, shift of the point at the base's origin), 6 x 6 inertias.  It
shares the links' figures with the controller's model, and none of its code.

M^-1 and a0 are made anew every `REFRESH_SUBSTEPS`, for where the arm will be in the middle of that time; torques act
in every substep.  A drive without power holds its joint with a brake, if it has one, a spring and damper to where it
closed.

Not modelled: set-valued friction (`FrictionKind.STICK_SLIP`), the gyroscopic torque of the motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from jointctl.firmware_py.arm_model import ArmLink, JointKind
from jointctl.firmware_py.friction import Condition, condition_of
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.schema import array_of, f8, i4, new, record
from jointctl.hil.plant import (
    end_stop_torque_Nm,
    finish_substep,
    load_torque_Nm,
    lugre_torque_Nm,
    modulation,
    rigid_actuator_Nm,
    sliding_torque_Nm,
    step_current,
    turn_motor,
)
from jointctl.hil.plant_records import FrictionKind, PlantConstants, PlantState

MOST_JOINTS = 16
REFRESH_SUBSTEPS = 10
BRAKE_radps = 300.0  # own frequency of a joint on its brake


@record
class ArmPlantConstants:
    gravity_mps2: Annotated[np.ndarray, array_of(f8, 3)]


@record
class JointOfArm:
    """One joint with its link; vectors in coordinates of the base."""

    target_Nm: f8  # what the drive asks for
    has_brake: i4
    braked: i4  # it is closed: the drive has no power
    held: i4  # of the drive: its torque stays until something happens
    brake_rad: f8  # where it closed
    torque_Nm: f8  # on the link, in this substep
    free_radps2: f8  # a0
    acceleration_radps2: f8
    ahead_rad: f8  # where M^-1 was made
    ahead_radps: f8
    motor_inertia_kgm2: f8  # that moves with the link: of a rigid joint
    inverse: Annotated[np.ndarray, array_of(f8, MOST_JOINTS)]  # row of M^-1
    turn: Annotated[np.ndarray, array_of(f8, 3, 3)]  # columns: axes of the link
    place_m: Annotated[np.ndarray, array_of(f8, 3)]
    axis: Annotated[np.ndarray, array_of(f8, 6)]  # S
    motion: Annotated[np.ndarray, array_of(f8, 6)]  # v
    drift: Annotated[np.ndarray, array_of(f8, 6)]  # v x S q'
    force: Annotated[np.ndarray, array_of(f8, 6)]  # pA
    body: Annotated[np.ndarray, array_of(f8, 6, 6)]  # IA
    reach: Annotated[np.ndarray, array_of(f8, 6)]  # U = IA S
    share: f8  # D = S U
    left: f8  # u


class ArmPlant(NamedTuple):
    """The memory of the arm; without links the joints are on their own, and only what their drives ask is kept."""

    constants: np.ndarray  # ArmPlantConstants[1]
    links: np.ndarray  # ArmLink[N]
    joints: np.ndarray  # JointOfArm[N + 1]; the last one is the base
    refresh: np.ndarray  # int64[1]: substeps until M^-1 is made anew


def no_arm_plant() -> ArmPlant:
    """Of joints that nothing connects."""
    return ArmPlant(new(ArmPlantConstants), new(ArmLink, 0), new(JointOfArm, MOST_JOINTS + 1), np.zeros(1, np.int64))


def arm_plant(links: np.ndarray, gravity_mps2: tuple[float, ...], brakes: Sequence[bool] = ()) -> ArmPlant:
    """Links as the arm truly has them, at rest and braked; of a flexible joint the motor is not the link's.

    `brakes`: of each joint whether it has one; by default all have.
    """
    if len(links) > MOST_JOINTS:
        raise ValueError(f"joints of an arm (={len(links)}) must be at most {MOST_JOINTS}")
    constants, joints = new(ArmPlantConstants), new(JointOfArm, len(links) + 1)
    constants[0].gravity_mps2[:] = gravity_mps2
    joints.has_brake[:-1] = brakes or 1
    joints.braked[:] = joints.has_brake
    for joint, link in zip(joints, links, strict=False):
        joint.brake_rad, joint.motor_inertia_kgm2 = math.nan, link.motor_inertia_kgm2
    joints[-1].turn[:] = np.eye(3)
    return ArmPlant(constants, links.copy(), joints, np.zeros(1, np.int64))


# --- Articulated bodies ---


@kernel
def _cross(a: np.ndarray, i: int, b: np.ndarray, j: int, out: np.ndarray, k: int) -> None:
    """out[k..] += a[i..] x b[j..]."""
    out[k] += a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1]
    out[k + 1] += a[i + 2] * b[j] - a[i] * b[j + 2]
    out[k + 2] += a[i] * b[j + 1] - a[i + 1] * b[j]


@kernel
def _place(link: ArmLink, own: JointOfArm, parent: JointOfArm, position: float) -> None:
    """Axes and origin of the link, and the axis of its joint."""
    c, s, shift = 1.0, 0.0, position
    if link.kind == JointKind.REVOLUTE:
        c, s, shift = math.cos(position), math.sin(position), 0.0
    for i in range(3):
        x, y, z, at = 0.0, 0.0, 0.0, parent.place_m[i]
        for k in range(3):
            x += parent.turn[i, k] * link.rotation[k, 0]
            y += parent.turn[i, k] * link.rotation[k, 1]
            z += parent.turn[i, k] * link.rotation[k, 2]
            at += parent.turn[i, k] * link.offset_m[k]
        own.turn[i, 0], own.turn[i, 1], own.turn[i, 2] = c * x + s * y, c * y - s * x, z
        own.place_m[i] = at + shift * z
        own.axis[i], own.axis[3 + i] = 0.0, 0.0
        own.axis[i if link.kind == JointKind.REVOLUTE else 3 + i] = z
    if link.kind == JointKind.REVOLUTE:
        _cross(own.place_m, 0, own.axis, 0, own.axis, 3)


@kernel
def _weigh(link: ArmLink, own: JointOfArm) -> None:
    """The link's inertia about the base's origin, 6 x 6."""
    local, r, p, body, m = link.inertia_kgm2, own.turn, own.place_m, own.body, link.mass_kg
    hx, hy, hz = link.moment_kgm[0], link.moment_kgm[1], link.moment_kgm[2]
    h0 = r[0, 0] * hx + r[0, 1] * hy + r[0, 2] * hz
    h1 = r[1, 0] * hx + r[1, 1] * hy + r[1, 2] * hz
    h2 = r[2, 0] * hx + r[2, 1] * hy + r[2, 2] * hz
    about = 2.0 * (p[0] * h0 + p[1] * h1 + p[2] * h2) + m * (p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    for i in range(3):
        x, y, z = r[i, 0], r[i, 1], r[i, 2]
        u = local[0] * x + local[1] * y + local[2] * z
        v = local[1] * x + local[3] * y + local[4] * z
        w = local[2] * x + local[4] * y + local[5] * z
        hi = h0 if i == 0 else h1 if i == 1 else h2
        for j in range(3):
            hj = h0 if j == 0 else h1 if j == 1 else h2
            value = u * r[j, 0] + v * r[j, 1] + w * r[j, 2] - p[i] * hj - hi * p[j] - m * p[i] * p[j]
            body[i, j] = value + (about if i == j else 0.0)
            body[3 + i, 3 + j] = m if i == j else 0.0
            body[i, 3 + j] = 0.0
            body[3 + i, j] = 0.0
    h0, h1, h2 = h0 + m * p[0], h1 + m * p[1], h2 + m * p[2]
    body[0, 4], body[0, 5], body[1, 5] = -h2, h1, -h0
    body[1, 3], body[2, 3], body[2, 4] = h2, -h1, h0
    for i in range(3):
        for j in range(3):
            body[3 + j, i] = body[i, 3 + j]


@kernel
def _go_out(link: ArmLink, own: JointOfArm, parent: JointOfArm, position: float, velocity: float) -> None:
    _place(link, own, parent, position)
    _weigh(link, own)
    for k in range(6):
        own.motion[k] = parent.motion[k] + own.axis[k] * velocity
        own.drift[k], own.force[k], own.reach[k] = 0.0, 0.0, 0.0
    _cross(own.motion, 0, own.axis, 0, own.drift, 0)
    _cross(own.motion, 0, own.axis, 3, own.drift, 3)
    _cross(own.motion, 3, own.axis, 0, own.drift, 3)
    for i in range(6):
        own.drift[i] *= velocity
        for k in range(6):
            own.reach[i] += own.body[i, k] * own.motion[k]  # the momentum, for a moment
    _cross(own.motion, 0, own.reach, 0, own.force, 0)
    _cross(own.motion, 3, own.reach, 3, own.force, 0)
    _cross(own.motion, 0, own.reach, 3, own.force, 3)


@kernel
def _come_back(own: JointOfArm, parent: JointOfArm) -> None:
    """IA and pA of the link without torque, handed on to its parent."""
    share = own.motor_inertia_kgm2
    left = 0.0
    for i in range(6):
        total = 0.0
        for k in range(6):
            total += own.body[i, k] * own.axis[k]
        own.reach[i] = total
        share += own.axis[i] * total
        left -= own.axis[i] * own.force[i]
    own.share, own.left = share, left
    # a moving link feels only what the joint does not let through
    for i in range(6):
        handed = own.force[i] + own.reach[i] * left / share
        for k in range(6):
            through = own.body[i, k] - own.reach[i] * own.reach[k] / share
            parent.body[i, k] += through
            handed += through * own.drift[k]
        parent.force[i] += handed


@kernel
def _accelerate(own: JointOfArm, parent: JointOfArm, drifting: bool) -> float:
    """q'' of the joint; leaves the link's acceleration in `force`, which has had its use."""
    resisting = 0.0
    for i in range(6):
        own.force[i] = parent.force[i] + (own.drift[i] if drifting else 0.0)
        resisting += own.reach[i] * own.force[i]
    acceleration = (own.left - resisting) / own.share
    for i in range(6):
        own.force[i] += own.axis[i] * acceleration
    return acceleration


@kernel
def articulate(arm: ArmPlant) -> None:
    """a0 and M^-1 for `ahead_rad` and `ahead_radps` of the joints, into `arm.joints`."""
    links, joints, count = arm.links, arm.joints, len(arm.links)
    base = joints[-1]
    for i in range(count):
        _go_out(links[i], joints[i], joints[links[i].parent], joints[i].ahead_rad, joints[i].ahead_radps)
    for i in range(count - 1, -1, -1):
        _come_back(joints[i], joints[links[i].parent])
    for k in range(3):
        base.force[k], base.force[3 + k] = 0.0, -arm.constants[0].gravity_mps2[k]
    for i in range(count):
        joints[i].free_radps2 = _accelerate(joints[i], joints[links[i].parent], True)
    for column in range(count):
        for i in range(count + 1):
            joints[i].left = 1.0 if i == column else 0.0
            for k in range(6):
                joints[i].force[k] = 0.0
        for i in range(column, -1, -1):
            own, parent = joints[i], joints[links[i].parent]
            left = own.left
            for k in range(6):
                left -= own.axis[k] * own.force[k]
            own.left = left
            for k in range(6):
                parent.force[k] += own.force[k] + own.reach[k] * left / own.share
        for k in range(6):
            base.force[k] = 0.0
        for i in range(count):
            joints[i].inverse[column] = _accelerate(joints[i], joints[links[i].parent], False)
    for i in range(6):  # the base's share of all this is nobody's
        base.force[i] = 0.0
        for k in range(6):
            base.body[i, k] = 0.0


# --- A substep ---


@inlined
def _friction_Nm(
    c: PlantConstants, velocity_radps: float, bristle_rad: float, factor: float, condition: Condition
) -> tuple[float, float]:
    """Friction at the joint and the bristle's deflection after the substep."""
    if c.friction_kind == FrictionKind.LUGRE:
        return lugre_torque_Nm(c, bristle_rad, velocity_radps, factor, condition)
    if c.friction_kind == FrictionKind.NONE or velocity_radps == 0.0:
        return 0.0, bristle_rad
    return factor * sliding_torque_Nm(c, velocity_radps, condition), bristle_rad


@inlined
def _brake_Nm(joint: JointOfArm, c: PlantConstants, position_rad: float, velocity_radps: float) -> float:
    """Of a closed brake, against the motion."""
    if joint.braked == 0:
        joint.brake_rad = math.nan
        return 0.0
    if joint.brake_rad != joint.brake_rad:
        joint.brake_rad = position_rad
    way = position_rad - joint.brake_rad
    return c.driven_inertia_kgm2 * BRAKE_radps * (BRAKE_radps * way + 2.0 * velocity_radps)


@kernel
def _torque_on_link(joint: JointOfArm, c: PlantConstants, s: PlantState) -> None:
    """Motor and reducer of one joint, and what they do to its link in this substep."""
    current = step_current(c, s, joint.target_Nm)
    velocity = s.joint_velocity_radps
    middle = s.joint_position_rad + 0.5 * c.step_s * velocity
    load = load_torque_Nm(c, s)
    resisting = load + _brake_Nm(joint, c, middle, velocity)
    if c.end_stops != 0:
        resisting += end_stop_torque_Nm(c, middle, velocity)
    load_Nm = s.friction_load_Nm * c.inverse_ratio
    condition = condition_of(c.friction, load_Nm, s.motor_temperature_degC, s.motor_position_rad)
    if c.flexible == 0:
        actuator = rigid_actuator_Nm(c, current, middle)
        factor = modulation(c, s, middle)
        friction, s.bristle_deflection_rad = _friction_Nm(c, velocity, s.bristle_deflection_rad, factor, condition)
        through = actuator - friction
        joint.torque_Nm = through - resisting
    else:
        through, actuator, motor_friction, factor = turn_motor(c, s, current, middle, condition)
        link_friction, s.link_bristle_deflection_rad = _friction_Nm(
            c, velocity, s.link_bristle_deflection_rad, factor, condition
        )
        link_friction *= 1.0 - c.motor_friction_share
        friction = motor_friction + link_friction
        joint.torque_Nm = through - link_friction - resisting
        s.reducer_torque_Nm = through
    finish_substep(c, s, current, actuator, friction, load, 0.0, through)


@kernel
def _refresh(constants: np.ndarray, states: np.ndarray, arm: ArmPlant) -> None:
    """M^-1 and a0 for the middle of the next substeps."""
    ahead_s = 0.5 * REFRESH_SUBSTEPS * constants[0].step_s
    joints, count = arm.joints, len(arm.links)
    for i in range(count):
        state: PlantState = states[i]
        speed = state.joint_velocity_radps
        joints[i].ahead_radps = speed + ahead_s * joints[i].acceleration_radps2
        joints[i].ahead_rad = state.joint_position_rad + ahead_s * speed
    articulate(arm)


@kernel
def step_arm(constants: np.ndarray, states: np.ndarray, arm: ArmPlant) -> None:
    """Advance all joints by one substep; `JointOfArm.target_Nm` and `braked` say what the drives do."""
    joints, count, step_s = arm.joints, len(arm.links), constants[0].step_s
    if arm.refresh[0] <= 0:
        _refresh(constants, states, arm)
        arm.refresh[0] = REFRESH_SUBSTEPS
    arm.refresh[0] -= 1
    for i in range(count):
        _torque_on_link(joints[i], constants[i], states[i])
    for i in range(count):
        acceleration = joints[i].free_radps2
        for k in range(count):
            acceleration += joints[i].inverse[k] * joints[k].torque_Nm
        joints[i].acceleration_radps2 = acceleration
        state: PlantState = states[i]
        velocity = state.joint_velocity_radps + step_s * acceleration
        state.joint_position_rad += 0.5 * step_s * (state.joint_velocity_radps + velocity)
        state.joint_velocity_radps = velocity
        if constants[i].flexible == 0:
            state.motor_position_rad = state.joint_position_rad
            state.motor_velocity_radps = velocity
