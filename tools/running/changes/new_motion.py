"""A new motion while the joint moves: checked against the limits, and made to begin at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.records import TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind, in_words
from jointctl.firmware_py.trajectory import peak_of
from jointctl.tools.configuration.checks import extremes_problems
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.problems import problem_line
from jointctl.tools.configuration.records import fill_trajectory
from jointctl.tools.configuration.sections import Section
from jointctl.tools.configuration.trajectory import Trajectory

CONFIGURED = "configured"


class _Chosen(Section):
    trajectory: Trajectory


def new_motion(config: Config, table: Any, values: Mapping[str, Any]) -> tuple[Any, str]:
    """(a record array of one `TrajectoryConstants`, the motion in words) of {"kind": ..., ...}.

    The keys are those of [trajectory]; kind "configured" is that section itself.  A sine begins at its crest, where it
    is at rest, and has no switch.  `ConfigurationError` for what is not allowed.
    """
    trajectory = _trajectory(config, values)
    constants = new(TrajectoryConstants)
    record: Any = constants[0]
    fill_trajectory(record, config.model_copy(update={"trajectory": trajectory}), table)
    if record.kind == TrajectoryKind.SINE:
        record.shift_s, record.switch_s = 0.5 * math.pi / record.omega_radps, 0.0
    peak = peak_of(record, table)
    problems = extremes_problems(config, peak.position_min_rad, peak.position_max_rad, peak.velocity_radps)
    torque_Nm = config.joint.inertia_kgm2 * peak.acceleration_radps2
    if not torque_Nm <= config.limits.torque_max_Nm:
        problems.append(
            f"trajectory: acceleration (={peak.acceleration_radps2:g} rad/s2) takes {torque_Nm:g} Nm, must be in "
            f"[0..{config.limits.torque_max_Nm:g}], up to limits.torque_max_Nm"
        )
    if problems:
        raise ConfigurationError(problems[0])
    return constants, motion_in_words(record, peak.velocity_radps)


def _trajectory(config: Config, values: Mapping[str, Any]) -> Any:
    kind = values.get("kind")
    if kind == CONFIGURED:
        return config.trajectory
    if kind == "table":
        raise ConfigurationError('trajectory.kind (=table) can only be chosen as "configured"')
    data = {"trajectory": dict(values)}
    try:
        return _Chosen.model_validate(data).trajectory
    except ValidationError as error:
        raise ConfigurationError(problem_line(error.errors(include_url=False)[0], data, ())) from None


def motion_in_words(record: Any, speed_radps: float) -> str:
    """`sine -0.350 .. +0.350 rad, up to 0.22 rad/s`; without a duration `, until stopped`."""
    return _what(record, speed_radps) + ("" if record.duration_s > 0.0 else ", until stopped")


def _what(record: Any, speed_radps: float) -> str:
    kind = TrajectoryKind(int(record.kind))
    if kind is TrajectoryKind.HOLD:
        return f"set-point {record.start_rad:+.4f} rad"
    name = in_words(kind)
    if kind is TrajectoryKind.SINE:
        ends = record.offset_rad - abs(record.amplitude_rad), record.offset_rad + abs(record.amplitude_rad)
    elif kind is TrajectoryKind.TABLE:
        return f"table, up to {speed_radps:.3g} rad/s"
    else:
        ends = record.start_rad, record.target_rad
    return f"{name} {ends[0]:+.4f} .. {ends[1]:+.4f} rad, up to {speed_radps:.3g} rad/s"
