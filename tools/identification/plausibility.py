"""Does the result look like the friction of a joint?  A wrong torque constant, ratio, unit or side shows here.

`problems` are refused, `warnings` are reported; each line gives the number it is about.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from jointctl.tools.identification.friction_data import FrictionData
from jointctl.tools.identification.models import Branch
from jointctl.tools.identification.motion_data import Motion

_OPPOSING = 0.9  # least share of points whose torque has the sign of the velocity
_SPEED_WARN_RADPS, _SPEED_MAX_RADPS = 30.0, 1000.0  # of a joint behind a reducer
_TORQUE_MAX = 1.2  # of the limit: the sweep itself cannot have driven harder
_TORQUE_SMALL = 0.01
# of the speed limit; mixing up two of r/min, deg/s and rad/s is a factor of 6, 9.5 or 57
_SPEED_OVER, _SPEED_UNDER = 5.0, 0.2
_ASYMMETRIC, _ASYMMETRIC_MAX = 3.0, 10.0
_CAUSES = "check torque constant, ratio, units and sides"


@dataclass(frozen=True)
class JointLimits:
    """What is known about the joint, if a configuration is given."""

    torque_max_Nm: float  # at the joint
    velocity_max_radps: float
    reduction_ratio: float
    torque_constant_NmpA: float


@dataclass
class Verdict:
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def recorded_limits(data: FrictionData) -> JointLimits | None:
    """What the sidecar tells about the joint; ratio and torque constant are then the data's own."""
    if data.recorded_limits is None:
        return None
    torque_Nm, velocity_radps = data.recorded_limits
    return JointLimits(torque_Nm, velocity_radps, data.reduction_ratio, data.torque_constant_NmpA or math.nan)


def check_data(data: FrictionData, limits: JointLimits | None) -> Verdict:
    """Signs, sizes and constants, before anything is fitted; without `limits` those of the sidecar, if it has some."""
    verdict = Verdict()
    if limits is None:
        limits = recorded_limits(data)
    means = {}
    for sign, word in ((1, "positive"), (-1, "negative")):
        chosen = data.direction(sign)
        if not len(chosen):
            continue
        torque = sign * data.motor_torque_Nm[chosen]
        means[word] = float(np.mean(torque))
        share = float(np.mean(torque > 0.0))
        if share < _OPPOSING:
            verdict.problems.append(
                f"torque does not oppose the motion at {word} velocity: right sign at {share:.0%} of the points, mean "
                f"{sign * means[word]:.4g} Nm at the motor: sign of torque or velocity is wrong, or a load was attached"
            )
    if verdict.problems:
        return verdict
    larger, smaller = max(means.values()), min(means.values())
    if smaller <= 0.0:
        word = min(means, key=lambda key: means[key])
        verdict.problems.append(
            f"mean torque at {word} velocity drives the motion ({abs(smaller):.4g} Nm at the motor), although most of "
            "its points oppose it: some of them are far off, or a load was attached"
        )
    elif larger > _ASYMMETRIC * smaller:
        text = (
            f"mean friction is {means['positive']:.4g} Nm at positive and {means['negative']:.4g} Nm at negative "
            f"velocity, a factor of {larger / smaller:.1f}: a load (offset {(larger - smaller) / 2:.3g} Nm)?"
        )
        (verdict.problems if larger > _ASYMMETRIC_MAX * smaller else verdict.warnings).append(text)
    top = float(np.max(np.abs(data.velocity_radps)))
    if top > _SPEED_WARN_RADPS:
        text = f"highest joint speed is {top:.4g} rad/s ({top * 60.0 / np.pi / 2.0:.4g} r/min): {_CAUSES}"
        (verdict.problems if top > _SPEED_MAX_RADPS else verdict.warnings).append(text)
    if limits is not None:
        _check_limits(data, limits, top, verdict)
    return verdict


def check_motion(motion: Motion, limits: JointLimits) -> Verdict:
    """Ratio and sizes of a motion against a configuration."""
    verdict = Verdict()
    if abs(motion.reduction_ratio / limits.reduction_ratio - 1.0) > 1e-6:
        verdict.problems.append(_other_ratio(motion.reduction_ratio, limits))
    top_radps = float(np.max(np.abs(motion.velocity_radps)))
    joint_Nm = float(np.percentile(np.abs(motion.torque_Nm), 95))
    for share, text in (
        (top_radps / limits.velocity_max_radps / _SPEED_OVER,
         f"{motion.speed_name}: reaches {top_radps:.4g} rad/s, {top_radps / limits.velocity_max_radps:.3g} times "
         "limits.velocity_max_radps"),
        (joint_Nm / limits.torque_max_Nm / _TORQUE_MAX,
         f"{motion.torque_name}: reaches {joint_Nm:.4g} Nm at the joint, {joint_Nm / limits.torque_max_Nm:.3g} times "
         "limits.torque_max_Nm"),
    ):  # fmt: skip
        if share > 1.0:
            verdict.problems.append(f"{text}: {_CAUSES}")
    if joint_Nm < _TORQUE_SMALL * limits.torque_max_Nm:
        text = f"{motion.torque_name}: reaches no more than {joint_Nm:.4g} Nm at the joint"
        verdict.warnings.append(f"{text}, {joint_Nm / limits.torque_max_Nm:.3g} times limits.torque_max_Nm: {_CAUSES}")
    return verdict


def _other_ratio(ratio: float, limits: JointLimits) -> str:
    return f"reduction ratio of the data (={ratio:g}) differs from joint.reduction_ratio (={limits.reduction_ratio:g})"


def _check_limits(data: FrictionData, limits: JointLimits, top_radps: float, verdict: Verdict) -> None:
    if abs(data.reduction_ratio / limits.reduction_ratio - 1.0) > 1e-6:
        verdict.problems.append(_other_ratio(data.reduction_ratio, limits))
    constant = data.torque_constant_NmpA
    if constant is not None and abs(constant / limits.torque_constant_NmpA - 1.0) > 1e-3:
        verdict.problems.append(
            f"torque constant of the data (={constant:g} Nm/A) differs from the configured one "
            f"(={limits.torque_constant_NmpA:.6g} in the drive's ampere, from joint.torque_constant_NmpA)"
        )
    joint_Nm = data.reduction_ratio * float(np.percentile(np.abs(data.motor_torque_Nm), 95))
    share = joint_Nm / limits.torque_max_Nm
    text = f"friction at the joint reaches {joint_Nm:.4g} Nm, {share:.3g} times limits.torque_max_Nm: {_CAUSES}"
    if share > _TORQUE_MAX:
        verdict.problems.append(text)
    elif share > 0.8 or share < _TORQUE_SMALL:
        verdict.warnings.append(text)
    if top_radps > _SPEED_OVER * limits.velocity_max_radps:
        verdict.problems.append(
            f"highest joint speed (={top_radps:.4g} rad/s) is {top_radps / limits.velocity_max_radps:.3g} times "
            f"limits.velocity_max_radps: {_CAUSES}"
        )
    elif top_radps < _SPEED_UNDER * limits.velocity_max_radps:
        verdict.warnings.append(
            f"highest joint speed (={top_radps:.4g} rad/s) is {top_radps / limits.velocity_max_radps:.3g} times "
            "limits.velocity_max_radps: beyond it the friction is a guess; or a unit or a side is wrong"
        )


def check_branches(branches: dict[str, Branch]) -> Verdict:
    """Shape of the identified curve of each direction."""
    verdict = Verdict()
    for word, found in branches.items():
        speeds = np.linspace(0.0, found.max_radps, 401)
        torque = found.torque_Nm(speeds)
        if torque.min() <= 0.0:
            at = float(speeds[int(np.argmin(torque))])
            verdict.problems.append(
                f"the identified friction at {word} velocity drives the motion: {torque.min():.4g} Nm at {at:.3g} rad/s"
            )
        if found.viscous_Nmspr < 0.0:
            verdict.warnings.append(
                f"viscous friction at {word} velocity is negative: tv = {found.viscous_Nmspr:.4g} Nm s/rad to the knee"
            )
        a = found.cubic
        u = found.max_radps
        slope = a[1] + u * (2.0 * a[2] + 3.0 * u * a[3])
        if slope < -0.02 * torque.max() / u:
            verdict.warnings.append(
                f"friction at {word} velocity falls with speed at {u:.3g} rad/s (slope {slope:.3g} Nm s/rad), and that "
                "slope is held beyond"
            )
    return verdict
