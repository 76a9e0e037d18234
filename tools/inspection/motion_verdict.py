"""What encoders and records of the check say about directions and scale."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import law_resolution_rad
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM, Finding
from jointctl.tools.inspection.motion_check import CheckPlan
from jointctl.tools.session.fault_words import FaultText

SCALE_TOLERANCE = 0.001  # of the counts of a turn
_SCALE_CURE = (
    "encoder.counts_per_turn, encoder.side, joint.reduction_ratio; or the drive scales 6064 by 6091 and 6092: "
    "then turn the joint by hand by 90 deg with the power off and compare"
)

MOVED_SHARE = 0.03  # of the travel: less is no motion
MOVED_COUNTS = 6.0
SMOOTHED_CYCLES = 20  # torques are compared over so many: a coarse encoder makes them jump, and the measured one lags
SAME_SCALE = 0.2  # by which two encoders may differ over the small way: backlash, twist
LITTLE_WORK = 0.05  # of the largest torque times the farthest way
FRICTION_FACTOR = 2.5  # measured over configured static friction, either way
TORQUE_FACTOR = 2.0  # measured over commanded torque, either way
_POWERED = (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING)
# what a joint that runs the wrong way, or whose reading stands, ends with
_WAY_FAULTS = (Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_LIMIT, Fault.POSITION_DISAGREEMENT)
_STANDING_FAULTS = (*_WAY_FAULTS, Fault.POSITION_FROZEN, Fault.TORQUE_SATURATED)


def judged(config: Config, counts_per_motor_turn: float) -> Finding:
    """The drive's counts of one motor turn (608F) against the configuration's."""
    own, ratio = config.encoder.counts_per_turn, config.joint.reduction_ratio
    expected = [counts_per_motor_turn]
    if config.encoder.side == "joint":
        expected.append(counts_per_motor_turn * ratio)
    factors = [own / counts for counts in expected]
    numbers = {"counts_per_motor_turn": counts_per_motor_turn}
    text = f"encoder.counts_per_turn is {own}, 608F of the drive says {counts_per_motor_turn:.6g} a motor turn"
    if any(abs(factor - 1.0) < SCALE_TOLERANCE for factor in factors):
        return Finding("counts", OK, text, "", numbers)
    shown = " or ".join(f"{factor:.4g}" for factor in factors)
    return Finding("counts", NOTE, f"{text}: {shown} times as many", _SCALE_CURE, numbers)


@dataclass(frozen=True)
class Motion:
    """Figures of the motion, by the encoder that feeds the law."""

    moved_rad: float  # farthest from the start, with its sign
    work_J: float  # of the commanded torque without gravity: negative if the joint moved against it
    accelerating: float  # torque times change of speed, summed: negative if the joint sped up against the torque
    break_away_Nm: float  # commanded when the joint began to move
    torque_max_Nm: float
    torque_ratio: float | None  # measured over commanded; None where the drive measures none
    other_ratio: float | None  # way of the other encoder over that of this one
    other_moved_rad: float

    @property
    def along(self) -> bool:
        """Whether the joint moved with the torque.  One without friction gives all of the work back."""
        if abs(self.work_J) < LITTLE_WORK * self.torque_max_Nm * abs(self.moved_rad):
            return self.accelerating > 0.0
        return self.work_J > 0.0


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Moving mean."""
    cycles = min(SMOOTHED_CYCLES, len(values))
    return np.convolve(values, np.ones(cycles) / cycles, "valid")


def motion_of(records: Any, threshold_rad: float) -> Motion | None:
    """None if the drive was never enabled."""
    rows = records[np.isin(records.phase, [*_POWERED, AxisPhase.QUICK_STOPPING])]
    powered = np.isin(rows.phase, _POWERED)
    if powered.sum() < 2:
        return None
    way = np.asarray(rows.position_rad - rows.position_rad[0])
    other = np.asarray(rows.second_position_rad - rows.second_position_rad[0])
    torque = np.where(powered, rows.command_torque_Nm, 0.0)
    pushed = np.where(powered, rows.command_torque_Nm - rows.gravity_torque_Nm, 0.0)
    work = float(np.sum(pushed[:-1] * np.diff(way)))
    moved = np.nonzero(np.abs(way) >= threshold_rad)[0]
    first = int(moved[0]) if len(moved) else -1
    smooth, measured = _smoothed(torque), _smoothed(np.asarray(rows.measured_torque_Nm))
    strong = np.abs(smooth) > 0.5 * np.abs(smooth).max()
    ratio = None
    if measured.any() and strong.any():
        ratio = float(np.sum(measured[strong] * smooth[strong]) / np.sum(smooth[strong] ** 2))
    square = float(np.sum(way**2))
    return Motion(
        moved_rad=float(way[np.argmax(np.abs(way))]),
        work_J=work,
        accelerating=float(np.sum(_smoothed(pushed[1:-1]) * _smoothed(np.diff(way, 2)))) if len(way) > 2 else 0.0,
        break_away_Nm=float(np.abs(torque[: first + 1 or None]).max()),
        torque_max_Nm=float(np.abs(torque).max()),
        torque_ratio=ratio,
        other_ratio=float(np.sum(way * other) / square) if square > 0.0 else None,
        other_moved_rad=float(other[np.argmax(np.abs(other))]),
    )


def motion_findings(
    config: Config, plan: CheckPlan, records: Any, fault: Fault, text: FaultText | None
) -> Iterator[Finding]:
    """Every finding of one check; `config` is the user's own."""
    second = config.joint_encoder
    law, other = "encoder", "joint_encoder"
    if second is not None and second.law == "joint_encoder":
        law, other = other, law
    threshold_rad = max(MOVED_SHARE * plan.travel_rad, MOVED_COUNTS * law_resolution_rad(config))
    motion = motion_of(records, threshold_rad)
    if motion is None:
        yield ended_finding(records, fault, text)
        return
    numbers = {key: value for key, value in vars(motion).items() if value is not None}
    if abs(motion.moved_rad) < threshold_rad:
        if fault is Fault.VELOCITY_LIMIT:  # of an encoder that stands still there is none
            yield ended_finding(records, fault, text)
            return
        yield _standing(motion, law, other, threshold_rad, second is not None, numbers)
        if fault is not Fault.NONE and fault not in _STANDING_FAULTS:
            yield ended_finding(records, fault, text)
        return
    encoders = list(_encoders(motion, law, other)) if second is not None else []
    yield from encoders
    direction = _direction(motion, law, other, numbers)
    yield direction
    if motion.torque_ratio is not None:
        yield _measured_torque(motion.torque_ratio)
    if motion.along:
        yield from _friction(motion, plan)
    explained = direction.status == PROBLEM and fault in _WAY_FAULTS
    if fault is Fault.POSITION_DISAGREEMENT:
        explained = explained or any(finding.status == PROBLEM for finding in encoders)
    if fault is not Fault.NONE and not explained:
        yield ended_finding(records, fault, text)


def ended_finding(records: Any, fault: Fault, text: FaultText | None) -> Finding:
    """The fault that ended the check."""
    moved = np.isin(records.phase, _POWERED).any()
    when = "while the joint moved" if moved else "before the drive was enabled"
    if text is None:
        return Finding("check", PROBLEM, f"ended {when}", "repeat it")
    return Finding("check", PROBLEM, f"ended {when}: {fault.name}: {text.happened}", text.next_step)


def _standing(
    motion: Motion, law: str, other: str, threshold_rad: float, two: bool, numbers: dict[str, Any]
) -> Finding:
    reading = f"the reading of [{law}] stood still (within {threshold_rad * 1e3:.2g} mrad)"
    reading += f" at up to {motion.torque_max_Nm:.1f} Nm"
    if two and abs(motion.other_moved_rad) > threshold_rad:
        remedy = f"[{law}] is dead or its cable, object or node is wrong: [{other}] moved"
        return Finding("motion", PROBLEM, f"{reading}, that of [{other}] moved", remedy, numbers)
    remedy = "turn the joint by hand with the power off and watch the position: a reading that stands is the encoder; "
    remedy += "else brake, blocked joint, motor supply, torque constant, or more friction than --torque"
    return Finding("motion", PROBLEM, reading, remedy, numbers)


def _encoders(motion: Motion, law: str, other: str) -> Iterator[Finding]:
    ratio = motion.other_ratio
    if ratio is None:
        return
    numbers = {"other_ratio": ratio}
    if abs(ratio) < 0.02:
        yield Finding(
            "two encoders",
            PROBLEM,
            f"[{other}] stood still while [{law}] moved",
            f"cable or object of [{other}]",
            numbers,
        )
    elif ratio < 0.0:
        wrong = other if motion.along else law
        text = f"[{law}] and [{other}] count against each other"
        remedy = f"{wrong}.direction: [{law if wrong == other else other}] agrees with the torque"
        yield Finding("two encoders", PROBLEM, text, remedy, numbers)
    if abs(ratio) >= 0.02 and abs(abs(ratio) - 1.0) > SAME_SCALE:
        text = f"[{other}] moves {abs(ratio):.3g} times as far as [{law}]"
        remedy = "counts_per_turn of one of them, encoder.side or joint.reduction_ratio, by that factor"
        yield Finding("scale", PROBLEM, text, remedy, numbers)
    elif ratio > 0.0:
        yield Finding("two encoders", OK, f"the same direction, and {ratio:.3f} times the same way", "", numbers)


def _direction(motion: Motion, law: str, other: str, numbers: dict[str, Any]) -> Finding:
    way = f"by up to {abs(motion.moved_rad) * 1e3:.1f} mrad ({math.degrees(abs(motion.moved_rad)):.2f} deg)"
    if not motion.along:
        remedy = (
            f"if the joint turned the way that you call positive at first: {law}.direction; else drive.torque_direction"
        )
        if motion.other_ratio is not None and motion.other_ratio < -0.02:
            remedy = f"{law}.direction: [{other}] agrees with the torque"
        text = f"by [{law}] the joint moved against the torque, {way}: feedback would be positive"
        return Finding("direction", PROBLEM, text, remedy, numbers)
    remedy = "by eye: it must turn to positive first, and as far as stated; else reverse encoder.direction, "
    remedy += "joint_encoder.direction and drive.torque_direction together, or correct counts_per_turn"
    return Finding("direction", OK, f"the joint moved with the torque, {way} by [{law}]", remedy, numbers)


def _measured_torque(ratio: float) -> Finding:
    numbers = {"torque_ratio": ratio}
    text = f"the drive measures {ratio:.2f} times the torque that it is sent"
    if ratio < 0.0:
        return Finding(
            "measured torque", PROBLEM, text, "the drive's own polarity (607E), its current sensors", numbers
        )
    if not 1.0 / TORQUE_FACTOR <= ratio <= TORQUE_FACTOR:
        remedy = "drive.torque_reference, rated values, the drive's own current limit"
        return Finding("measured torque", NOTE, text, remedy, numbers)
    return Finding("measured torque", OK, text, "", numbers)


def _friction(motion: Motion, plan: CheckPlan) -> Iterator[Finding]:
    text = f"it began to move at {motion.break_away_Nm:.1f} Nm"
    numbers = {"break_away_Nm": motion.break_away_Nm}
    static_Nm = plan.static_friction_Nm
    if not static_Nm:
        yield Finding("friction", OK, text, "", numbers)
    elif 1.0 / FRICTION_FACTOR <= motion.break_away_Nm / static_Nm <= FRICTION_FACTOR:
        yield Finding("friction", OK, f"{text}; [friction] says {static_Nm:.1f} Nm", "", numbers)
    else:
        remedy = "joint.torque_constant_NmpA and its ampere, joint.reduction_ratio, units of [friction]; then sweep"
        yield Finding("friction", NOTE, f"{text}; [friction] says {static_Nm:.1f} Nm", remedy, numbers)
