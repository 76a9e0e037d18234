"""[motion] of an arm file: one motion for all joints, turned into a [trajectory] for each of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from jointctl.firmware_py.trajectory import QUINTIC_PEAK_ACCELERATION, QUINTIC_PEAK_SPEED
from jointctl.tools.configuration.config import Config, problem_line
from jointctl.tools.configuration.sections import Duration, Rule, Section, Trajectory, between, is_number

LARGEST_ARM = 16  # joints
PER_JOINT_TEXT = "a list of numbers, one a joint"
SHORTEST_MOVE_s = 0.1
SPEED_SHARE = 0.9  # of limits.velocity_max_radps that an automatic move may use
TORQUE_SHARE = 0.5  # of limits.torque_max_Nm that it may give the joint's inertia


def _per_joint(value: object) -> tuple[float, ...]:
    if isinstance(value, (list, tuple)) and 0 < len(value) <= LARGEST_ARM:
        if all(is_number(x) and math.isfinite(x) for x in value):
            return tuple(float(x) for x in value)
    raise PydanticCustomError("numbers", f"must be {PER_JOINT_TEXT}")


PerJoint = Annotated[tuple[float, ...], BeforeValidator(Rule(PER_JOINT_TEXT, _per_joint))]


def _auto_or_time(value: object) -> Any:
    if value == "auto" or (is_number(value) and 1e-3 <= value <= 1e5):
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
        longest = max(
            longest, QUINTIC_PEAK_SPEED * abs(way) / speed,
            math.sqrt(QUINTIC_PEAK_ACCELERATION * abs(way) / acceleration),
        )  # fmt: skip
    return math.ceil(longest * 1e3) * 1e-3


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
