"""An arm file: the URDF, the joints' own configuration files, how much of the model is fed forward, and one motion.

Each joint keeps its file, which works alone as before; in the arm its [trajectory] is replaced by its part of
[motion], and its own gravity and Coriolis torque by the arm's model.  The angle of a joint is that of the URDF: its
encoder's zero and direction must say so.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from jointctl.firmware_py.arm_model import Arm, ArmConstants, ArmFeedForward, ArmLink, ArmMotion, JointKind
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import quintic_s
from jointctl.tools.configuration.canopen import TORQUE_WANTED, CanopenSection, canopen_section
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config, problem_line, problem_lines, raise_if
from jointctl.tools.configuration.load import config_of, read_document, with_units
from jointctl.tools.configuration.records import axis_constants
from jointctl.tools.configuration.sections import Duration, Rule, Section, Trajectory, between, is_number
from jointctl.tools.configuration.urdf import Body, LARGEST_LENGTH_m, Urdf, UrdfJoint, bodies_of, of_body, read_urdf

# --- [motion] of an arm file: one motion for all joints, turned into a [trajectory] for each of them ---

LARGEST_ARM = 16  # joints
PER_JOINT_TEXT = "a list of numbers, one a joint"
SHORTEST_MOVE_s, LONGEST_MOVE_s = 0.1, 1e5
SPEED_SHARE = 0.9  # of limits.velocity_max_radps that an automatic move may use
TORQUE_SHARE = 0.5  # of limits.torque_max_Nm that it may give the joint's inertia


def _per_joint(value: object) -> tuple[float, ...]:
    if isinstance(value, (list, tuple)) and 0 < len(value) <= LARGEST_ARM:
        if all(is_number(x) and math.isfinite(x) for x in value):
            return tuple(float(x) for x in value)
    raise PydanticCustomError("numbers", f"must be {PER_JOINT_TEXT}")


PerJoint = Annotated[tuple[float, ...], BeforeValidator(Rule(PER_JOINT_TEXT, _per_joint))]


def _auto_or_time(value: object) -> Any:
    if value == "auto" or (is_number(value) and 1e-3 <= value <= LONGEST_MOVE_s):
        return value
    raise PydanticCustomError("range", 'must be "auto" or in [0.001..1e5]')


class ArmSine(Section):
    kind: Literal["sine"]  # each joint its own
    duration_s: Duration  # 0 = until stopped
    amplitude_rad: PerJoint  # to each side of the offset
    frequency_Hz: PerJoint  # of each sine
    shift_s: PerJoint | None = None  # earlier by this time
    offset_rad: PerJoint | None = None  # middle of the motion


class ArmMove(Section):
    kind: Literal["min_jerk"]  # all joints begin and end together
    duration_s: Duration  # 0 = until stopped
    start_rad: PerJoint  # where they begin
    target_rad: PerJoint  # where they end
    # of one move; "auto": the shortest within every joint's limits
    move_s: Annotated[float | str, BeforeValidator(Rule('"auto" or in [0.001..1e5]', _auto_or_time))] = "auto"
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0  # rest at each end
    repeat: bool = False  # back and forth


class ArmTable(Section):
    kind: Literal["table"]  # a cubic spline through the rows of a file
    duration_s: Duration  # 0 = until stopped
    file: Annotated[str, Field(min_length=1)]  # CSV beside the arm file: time_s and a column NAME_rad of each joint
    repeat: bool = False  # start again at the end, which must meet the beginning


class ArmHold(Section):
    kind: Literal["hold"]  # stand still
    duration_s: Duration  # 0 = until stopped
    position_rad: PerJoint  # where to stand


ArmTrajectory = Annotated[ArmSine | ArmMove | ArmTable | ArmHold, Field(discriminator="kind")]
_OF_A_JOINT: TypeAdapter[Trajectory] = TypeAdapter(Trajectory)


def shortest_move_s(configs: tuple[Config, ...], way_rad: tuple[float, ...]) -> float:
    """Of a quintic from rest to rest that all joints take together, within every joint's limits."""
    longest = SHORTEST_MOVE_s
    for config, way in zip(configs, way_rad, strict=True):
        speed = SPEED_SHARE * config.limits.velocity_max_radps
        acceleration = TORQUE_SHARE * config.limits.torque_max_Nm / config.joint.inertia_kgm2
        longest = max(longest, quintic_s(abs(way), speed, acceleration))
    return math.ceil(min(longest, LONGEST_MOVE_s) * 1e3) * 1e-3


def trajectories(motion: ArmTrajectory, configs: tuple[Config, ...], names: tuple[str, ...]) -> Iterator[Trajectory]:
    """The section [trajectory] of each joint; `ValueError` with a line each for what it must not be."""
    given = {key: value for key, value in motion.model_dump().items() if value is not None}
    wrong = [
        f"motion.{key} (={len(value)} numbers) must have {len(configs)}, one a joint"
        for key, value in given.items()
        if isinstance(value, tuple) and len(value) != len(configs)
    ]
    if wrong:
        raise ValueError("\n".join(wrong))
    if given.get("move_s") == "auto":
        ways = tuple(b - a for a, b in zip(given["start_rad"], given["target_rad"], strict=True))
        given["move_s"] = shortest_move_s(configs, ways)
    for i, name in enumerate(names):
        own = {key: value[i] if isinstance(value, tuple) else value for key, value in given.items()}
        if motion.kind == "table":
            own["column"] = f"{name}_rad"
        try:
            yield _OF_A_JOINT.validate_python(own)
        except ValidationError as error:
            lines = []
            for problem in error.errors(include_url=False):
                one: Any = {**problem, "loc": problem["loc"][1:]}  # without the tag of the union
                lines.append(f"{problem_line(one, own, ('motion',))} (joint {name})")
            raise ValueError("\n".join(lines)) from None


# --- The file itself ---

SHIPPED_ARM = SHIPPED_FOLDER / "arm" / "arm.toml"
_SLACK_rad = 1e-6  # by which the digits of two files may differ
Names = Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1, max_length=LARGEST_ARM)]
GRAVITY_mps2 = (1.5, 30.0)  # of any place where an arm may be; beyond that it is in another unit
_GRAVITY_TEXT = f"3 numbers with a magnitude in [{GRAVITY_mps2[0]:g}..{GRAVITY_mps2[1]:g}] m/s2, or all 0"


def _gravity(value: object) -> list[float]:
    if isinstance(value, (list, tuple)) and len(value) == 3 and all(is_number(x) for x in value):
        magnitude = math.hypot(*value)
        if magnitude == 0.0 or GRAVITY_mps2[0] <= magnitude <= GRAVITY_mps2[1]:
            return [float(x) for x in value]
    raise PydanticCustomError("gravity", f"must be {_GRAVITY_TEXT}")


Gravity = Annotated[list[float], BeforeValidator(Rule(_GRAVITY_TEXT, _gravity))]
Vector = Annotated[
    list[Annotated[float, between(-LARGEST_LENGTH_m, LARGEST_LENGTH_m)]], Field(min_length=3, max_length=3)
]


class ArmSection(Section):
    urdf: Annotated[str, Field(min_length=1)]  # beside the arm file
    joints: Names  # configuration files, beside the arm file, in the order of the chain
    joint_names: Names | None = None  # of the URDF; none = all that move, in their order
    gravity_mps2: Gravity = Field(default=[0.0, 0.0, -9.81])  # in the frame of the URDF's base
    feed_forward: Literal["whole", "gravity", "none"] = "whole"  # how much of the arm's model the joints get
    # of motor and reducer, at the joint; none = reducer.motor_inertia_kgm2 of each joint
    motor_inertia_kgm2: PerJoint | None = None
    payload_kg: Annotated[float, between(0.0, 1000.0)] = 0.0  # at the last joint's link, on top of the URDF
    payload_at_m: Vector = Field(default=[0.0, 0.0, 0.0])  # its centre, in the frame of that link


class _ArmFile(Section):
    arm: ArmSection
    motion: ArmTrajectory


class ArmModel(NamedTuple):
    """For the kernels."""

    constants: np.ndarray  # ArmConstants[1]
    links: np.ndarray  # ArmLink[N]

    def memory(self) -> Arm:
        """Of a loop; constants and links are copies."""
        return Arm(self.constants.copy(), self.links.copy(), new(ArmMotion, len(self.links) + 1))


@dataclass(frozen=True)
class ArmConfig:
    """An arm, checked: every joint with its part of the motion."""

    path: Path
    text: str  # of the arm file, for the log
    arm: ArmSection
    joints: tuple[Config, ...]
    names: tuple[str, ...]  # of the joints in the URDF
    urdf: Urdf
    bodies: tuple[Body, ...]  # one a joint, the payload included
    model: ArmModel
    remarks: tuple[str, ...]  # what the user should know, one line each

    @property
    def rate_Hz(self) -> float:
        return self.joints[0].loop.rate_Hz

    def anchored(self) -> ArmConfig:
        """See `Config.anchored`."""
        joints = tuple(joint.anchored() for joint in self.joints)
        return replace(self, path=self.path.absolute(), joints=joints)

    def axis_constants(self, tables: Sequence[np.ndarray], starts_rad: Sequence[float]) -> Any:
        """A record array of N `AxisConstants`; `tables` as of `trajectory_table` of each joint."""
        parts = [
            axis_constants(config, table, start_position_rad=start)
            for config, table, start in zip(self.joints, tables, starts_rad, strict=True)
        ]
        return self.connected(parts)

    def connected(self, parts: Sequence[Any]) -> Any:
        """A record array of N `AxisConstants` of those of each joint alone.

        All joints approach in the same time, the longest of them, and follow set-points equally late.
        """
        constants: Any = np.concatenate(parts).view(np.recarray)
        constants.sequence.approach_s[:] = constants.sequence.approach_s.max()
        constants.stream.delay_ns[:] = constants.stream.delay_ns.max()
        constants.stream.timeout_ns[:] = constants.stream.timeout_ns.min()
        for axis, load in zip(constants, self.greatest_gravity_Nm(), strict=True):
            if self.arm.feed_forward != "none":
                axis.law.of_arm = 1
            if axis.limits.frozen_torque_Nm > 0.0:  # a healthy joint stands still under it
                axis.limits.frozen_torque_Nm += load
        return constants

    def greatest_gravity_Nm(self) -> list[float]:
        """For each joint what it never has to hold more than, in whatever pose."""
        return [moment * float(np.linalg.norm(self.arm.gravity_mps2)) for moment in _greatest_moments_kgm(self.bodies)]


def _greatest_moments_kgm(bodies: Sequence[Body]) -> list[float]:
    """Of each joint: mass times centre of all that it moves is never more, in whatever pose."""
    found = []
    for i in range(len(bodies)):
        total = 0.0
        reach = {i: 0.0}
        for k in range(i, len(bodies)):
            body = bodies[k]
            if k != i:
                if body.parent not in reach:
                    continue
                reach[k] = reach[body.parent] + float(np.linalg.norm(body.place.offset_m))
            total += body.mass.mass_kg * reach[k] + float(np.linalg.norm(body.mass.moment_kgm))
        found.append(total)
    return found


def load_joint_or_arm(path: str | Path) -> Config | ArmConfig:
    """As `load_config`, or as `load_arm` of a file with an [arm]."""
    path = Path(path)
    text, data = read_document(path)
    return (_arm_of if "arm" in data else config_of)(path, text, data)


def load_arm(path: str | Path) -> ArmConfig:
    """Read, check and freeze an arm file with all that it names; `ConfigurationError` holds one line per problem."""
    return _arm_of(Path(path), *read_document(Path(path)))


def _arm_of(path: Path, text: str, data: dict[str, Any]) -> ArmConfig:
    data, converted = with_units(data)
    try:
        file = _ArmFile.model_validate(data)
    except ValidationError as error:
        raise_if([f"{path}: {line}" for line in problem_lines(error.errors(include_url=False), data, _ArmFile)])
        raise
    arm = file.arm
    alone = tuple(_joint_alone(path, name) for name in arm.joints)
    urdf = read_urdf(path.parent / arm.urdf)
    names, remarks = _names(path, arm, urdf)
    bodies, inertias = _bodies(path, arm, urdf, names, alone)
    raise_if([f"{path}: {line}" for line in (*bus_problems(arm, alone), *_limit_problems(arm, alone, bodies))])
    joints = _moved(path, file.motion, alone, names)
    remarks += _files_of_others(arm, names)
    odd = (*urdf.remarks, *_without_mass(urdf, bodies), *_odd_limits(bodies), *_odd_effort(bodies))
    remarks += [f"{urdf.path.name}: {line}" for line in odd]
    for config, body in zip(joints, bodies, strict=True):
        remarks += [f"{config.path.name}: {line}" for line in _larger(config, body)]
    return ArmConfig(
        path, text, arm, joints, names, urdf, tuple(bodies), _model(arm, bodies, inertias), (*converted, *remarks)
    )


def _joint_alone(path: Path, name: str) -> Config:
    file, text, data = path.parent / name, *read_document(path.parent / name)
    if "arm" in data:
        raise_if([f"{path}: arm.joints: {name} must be the file of a joint, and is that of an arm"])
    return config_of(file, text, data)


def _names(path: Path, arm: ArmSection, urdf: Urdf) -> tuple[tuple[str, ...], list[str]]:
    moving = tuple(joint.name for joint in urdf.moving)
    names = moving if arm.joint_names is None else tuple(arm.joint_names)
    known = ", ".join(moving) or "none"
    wrong = [
        f"arm.joint_names: {name} must be a joint of {urdf.path.name} that moves by itself: {known}"
        for name in names
        if name not in moving
    ]
    if len(set(names)) < len(names):
        wrong.append(f"arm.joint_names (={', '.join(names)}) must not name a joint twice")
    if len(set(arm.joints)) < len(arm.joints):
        wrong.append(f"arm.joints (={', '.join(arm.joints)}) must not name a file twice: each joint has its own")
    if not wrong and len(names) != len(arm.joints):
        key = "arm.joint_names" if arm.joint_names is not None else f"{urdf.path.name}: joints that move"
        wrong.append(f"{key} (={len(names)}: {', '.join(names)}) must be as many as arm.joints (={len(arm.joints)})")
    raise_if([f"{path}: {line}" for line in wrong])
    standing = [
        f"joint {joint.name} of {urdf.path.name} is not the arm's: it stands at 0{_unless_it_can(joint)}"
        for joint in urdf.moving
        if joint.name not in names
    ]
    standing += [
        f"joint {joint.name} of {urdf.path.name} mimics {joint.mimics}: for the model it stands at 0"
        for joint in urdf.joints
        if joint.mimics is not None
    ]
    return names, standing


def _unless_it_can(joint: UrdfJoint) -> str:
    low, high = joint.lower_rad, joint.upper_rad
    within = low is None or high is None or low <= 0.0 <= high
    return "" if within else f", where its limits [{low:g}..{high:g}] let it never be: the model is of another arm"


def _files_of_others(arm: ArmSection, names: tuple[str, ...]) -> Iterator[str]:
    """A file of equal limits that stands in another joint's place fits, and gets that joint's torque."""
    for file, name in zip(arm.joints, names, strict=True):
        named = Path(file).stem
        if named != name and named in names:
            yield f"arm.joints: {file} stands in the place of joint {name}; is it that of joint {named}?"


def _bodies(
    path: Path, arm: ArmSection, urdf: Urdf, names: tuple[str, ...], joints: tuple[Config, ...]
) -> tuple[list[Body], tuple[float, ...]]:
    """The links with the payload, and the motors' inertias at their joints."""
    wrong: list[str] = []
    bodies = bodies_of(urdf, names, wrong.append)
    wrong += [
        f"joint {body.joint.name} (=prismatic) must be revolute: the joints' files are in rad"
        for body in bodies
        if body.joint.kind == "prismatic"
    ]
    inertias = arm.motor_inertia_kgm2
    if inertias is None:
        without = [c.path.name for c in joints if c.reducer is None]
        if without:
            wrong.append(f"arm.motor_inertia_kgm2 must be given: {', '.join(without)} has no [reducer] to take it from")
        inertias = tuple(0.0 if c.reducer is None else c.reducer.motor_inertia_kgm2 for c in joints)
    elif len(inertias) != len(joints) or min(inertias) < 0.0:
        wrong.append(
            f"arm.motor_inertia_kgm2 (={list(inertias)}) must be {len(joints)} inertias of at least 0, one a joint"
        )
    else:
        wrong += [
            f"arm.motor_inertia_kgm2 (={inertia:g}) of {config.path.name} must be its reducer.motor_inertia_kgm2 "
            f"(={config.reducer.motor_inertia_kgm2:g})"
            for inertia, config in zip(inertias, joints, strict=True)
            if config.reducer is not None and not math.isclose(inertia, config.reducer.motor_inertia_kgm2)
        ]
    raise_if([f"{path}: {line}" for line in wrong])
    last = bodies[-1]
    if arm.payload_kg > 0.0:
        payload = of_body(arm.payload_kg, np.array(arm.payload_at_m), np.zeros((3, 3))).seen_from(last.frame)
        bodies[-1] = Body(last.parent, last.joint, last.place, last.frame, last.mass + payload)
    return bodies, inertias


def _moved(path: Path, motion: ArmTrajectory, alone: tuple[Config, ...], names: tuple[str, ...]) -> tuple[Config, ...]:
    """The joints with their parts of the motion, which keeps their limits."""
    try:
        parts = list(trajectories(motion, alone, names))
    except ValueError as error:
        raise_if([f"{path}: {line}" for line in str(error).splitlines()])
        raise
    joints, wrong = [], []
    for config, part in zip(alone, parts, strict=True):
        if part.kind == "table":
            file = (path.parent / part.file).absolute()
            if not file.is_file():
                raise_if([f"{path}: motion.file (={part.file}) must name a file beside the arm file"])
            part = part.model_copy(update={"file": str(file)})
        one = config.changed(trajectory=part)
        wrong += [f"{path}: with [motion], {config.path.name}: {line}" for line in problems_between_sections(one)]
        joints.append(one)
    raise_if(wrong)
    return tuple(joints)


def _nodes(config: Config) -> Iterator[tuple[str, int]]:
    drive, encoder = config.drive, config.joint_encoder
    assert isinstance(drive, CanopenSection)
    yield "drive.node", drive.node
    if encoder is not None and encoder.node is not None:
        yield "joint_encoder.node", encoder.node


def bus_problems(arm: ArmSection, joints: tuple[Config, ...]) -> list[str]:
    """Nodes, rates and buses of the joints against each other."""
    other = [(name, c) for name, c in zip(arm.joints, joints, strict=True) if not isinstance(c.drive, CanopenSection)]
    if other:
        return [f"{name}: drive.kind (={c.drive.kind}) must be canopen in an arm" for name, c in other]
    own = [(name, c.drive) for name, c in zip(arm.joints, joints, strict=True) if isinstance(c.drive, CanopenSection)]
    found = [f"{name}: {TORQUE_WANTED.format(d.mode, 'an arm')}" for name, d in own if d.cascade is not None]
    first, rate_Hz = arm.joints[0], joints[0].loop.rate_Hz
    taken: dict[tuple[str, str, int], str] = {}
    bitrates: dict[tuple[str, str], tuple[str, int]] = {}
    for name, config in zip(arm.joints, joints, strict=True):
        if config.loop.rate_Hz != rate_Hz:
            found.append(
                f"{name}: loop.rate_Hz (={config.loop.rate_Hz:g}) must be that of {first} (={rate_Hz:g}): one loop"
            )
        for key in ("heartbeat_s", "master_node"):
            value, of_first = getattr(canopen_section(config), key), getattr(canopen_section(joints[0]), key)
            if value != of_first:
                found.append(
                    f"{name}: drive.{key} (={value:g}) must be that of {first} (={of_first:g}): one heartbeat for all"
                )
        bus = config.bus.interface, config.bus.channel
        before, bitrate = bitrates.setdefault(bus, (name, config.bus.bitrate_bitps))
        if config.bus.bitrate_bitps != bitrate:
            found.append(
                f"{name}: bus.bitrate_bitps (={config.bus.bitrate_bitps}) must be that of {before} (={bitrate}), "
                f"which is on the same bus, {bus[1]}"
            )
        assert isinstance(config.drive, CanopenSection)
        for key, node in _nodes(config):
            owner = taken.setdefault((*bus, node), f"{key} of {name}")
            if owner != f"{key} of {name}":
                found.append(f"{name}: {key} (={node}) must differ from {owner}, which is on the same bus, {bus[1]}")
    return found


def _limit_problems(arm: ArmSection, joints: tuple[Config, ...], bodies: list[Body]) -> list[str]:
    """What the URDF allows less than a joint's file, and what it must say of a joint's limits."""
    found = []
    for name, config, body in zip(arm.joints, joints, bodies, strict=True):
        limits, joint = config.limits, body.joint
        stated = {
            "lower": joint.lower_rad, "upper": joint.upper_rad, "velocity": joint.velocity_max_radps,
            "effort": joint.effort_max_Nm,
        }  # fmt: skip
        missing = [key for key, value in stated.items() if value is None]
        if missing and joint.kind == "revolute":
            found.append(f"joint {joint.name} in {arm.urdf}: <limit> must have {', '.join(missing)}")
        for key in ("velocity", "effort"):
            value = stated[key]
            if value is not None and not value > 0.0:
                found.append(f"joint {joint.name} in {arm.urdf}: limit {key} (={value:g}) must be above 0; not known?")
        if found:
            continue
        rows: tuple[tuple[str, float, str, float | None], ...] = (
            ("position_min_rad", limits.position_min_rad, "least", joint.lower_rad),
            ("position_max_rad", limits.position_max_rad, "most", joint.upper_rad),
            ("velocity_max_radps", limits.velocity_max_radps, "most", joint.velocity_max_radps),
            ("torque_max_Nm", limits.torque_max_Nm, "most", joint.effort_max_Nm),
        )
        for key, value, word, allowed in rows:
            beyond = allowed is not None and (value < allowed if word == "least" else value > allowed)
            if beyond and allowed is not None and abs(value - allowed) > _SLACK_rad:
                found.append(
                    f"{name}: limits.{key} (={value:g}) must be at {word} {allowed:g}, the limit of joint {joint.name} "
                    "in the URDF"
                )
    return found


# --- What is allowed, but looks like a mistake, such as another unit: remarks, where no usual robot has it ---

_NMM = 300.0  # times too large: 1000 from Nm to Nmm, and a torque limit may be a third of the effort
_LEAST_EFFORT = 0.01  # of what the arm weighs when it is stretched: 0.001 from g to kg and from mm to m


def _without_mass(urdf: Urdf, bodies: Sequence[Body]) -> Iterator[str]:
    """A frame that moves, and carries its body by a fixed joint; or a body that was forgotten."""
    for body in bodies:
        if urdf.links[body.joint.child] is None:
            what = f"link {body.joint.child}, which joint {body.joint.name} moves, has no <inertial>"
            yield f"{what}: it has the mass of what is fixed to it, {body.mass.mass_kg:.3g} kg"


def _odd_limits(bodies: Sequence[Body]) -> Iterator[str]:
    """More than a turn and a whole number is no number of turns."""
    for joint in (body.joint for body in bodies):
        for key, value in (("lower", joint.lower_rad), ("upper", joint.upper_rad)):
            if value is not None and abs(value) > math.tau + 1e-2 and value == round(value):
                yield f"joint {joint.name}: limit {key} (={value:g}) is more than a turn; degrees instead of rad?"


def _odd_effort(bodies: Sequence[Body]) -> Iterator[str]:
    """Of the joint that carries most against what it may have to carry."""
    moments = _greatest_moments_kgm(bodies)
    i = int(np.argmax(moments))
    joint, load_Nm = bodies[i].joint, moments[i] * 9.81
    if joint.effort_max_Nm is None or not load_Nm > 0.0:
        return
    what = f"joint {joint.name}: limit effort (={joint.effort_max_Nm:g})"
    if joint.effort_max_Nm > _NMM * load_Nm:
        yield f"{what} is {joint.effort_max_Nm / load_Nm:.0f} times the arm's weight, stretched; Nmm instead of Nm?"
    elif joint.effort_max_Nm < _LEAST_EFFORT * load_Nm:
        yield (
            f"{what} is {joint.effort_max_Nm / load_Nm:.1%} of the arm's weight, stretched ({load_Nm:.3g} Nm); grams "
            "instead of kg, or millimetres instead of m?"
        )


def _larger(config: Config, body: Body) -> Iterator[str]:
    """An effort that the joint's own torque limit is far below."""
    effort_Nm, limit_Nm = body.joint.effort_max_Nm, config.limits.torque_max_Nm
    if effort_Nm is not None and effort_Nm > _NMM * limit_Nm:
        yield (
            f"limits.torque_max_Nm (={limit_Nm:g}) is 1/{effort_Nm / limit_Nm:.0f} of the effort of joint "
            f"{body.joint.name} in the URDF (={effort_Nm:g}); Nmm instead of Nm?"
        )


def _model(arm: ArmSection, bodies: list[Body], inertias: tuple[float, ...]) -> ArmModel:
    constants, links = new(ArmConstants), new(ArmLink, len(bodies))
    constants[0].feed_forward = ArmFeedForward[arm.feed_forward.upper()]
    constants[0].gravity_mps2[:] = arm.gravity_mps2
    for link, body, inertia in zip(links, bodies, inertias, strict=True):
        fill_link(link, body, inertia)
    return ArmModel(constants, links)


def fill_link(link: ArmLink, body: Body, motor_inertia_kgm2: float) -> None:
    """The record of a link."""
    link.parent = body.parent
    link.kind = JointKind.PRISMATIC if body.joint.kind == "prismatic" else JointKind.REVOLUTE
    link.rotation[:] = body.place.rotation
    link.offset_m[:] = body.place.offset_m
    link.mass_kg = body.mass.mass_kg
    link.moment_kgm[:] = body.mass.moment_kgm
    link.inertia_kgm2[:] = body.mass.inertia_kgm2[np.triu_indices(3)]
    link.motor_inertia_kgm2 = motor_inertia_kgm2
