"""`doctor --motion`: what the check is going to do, and what came of it.

A soft spring between joint and reference pulls it a little to and fro.

The spring is the loop's own law with gains that are made for it, so every limit, watchdog and stop of a run is in
force.  Its torque grows with the distance of the reference and is limited to a small share; a joint that is free
follows as soon as the torque exceeds its friction, one that is stuck does not, and one with a wrong sign runs into
the velocity limit or the following error of the check, which are as narrow as the encoder's counts allow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, text_Nm, text_radps
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.firmware_py.trajectory import eased, spline_table
from jointctl.tools.analysis.margin_gate import chatters, passes
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import (
    joint_rad_per_count,
    law_resolution_rad,
    static_friction_Nm,
    velocity_of_a_count_radps,
)
from jointctl.tools.configuration.drive_section import require_torque
from jointctl.tools.configuration.records import APPROACH_MIN_S, table_constants
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM, Finding
from jointctl.tools.recording.run_log import log_path
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.session.plan import Placed, RunPlan, joint_lines, remark_lines

TRAVEL_rad, TRAVEL_MAX_rad = 0.04, 0.3  # of the reference, to each side
TRAVEL_COUNTS = 60.0  # so coarse an encoder takes more travel
TRAVEL_OF_RANGE = 0.25  # at most, of the position limits' range, unless the encoder is too coarse for that
LONGER = 1.3  # from one travel that is tried to the next
REACH = 2.5  # times the travel: where the position limits of the check are
VELOCITY_MAX_radps = 0.5
COUNTS_IN_VELOCITY = 2.0  # what a coarse encoder may add to it, in steps of its reading
PEAK = 1.875  # of the velocity over its mean, in a minimum-jerk ramp
REFERENCE_SHARE = 0.5  # of the velocity limit, that the reference may have
STATIC_FRICTIONS = 2.0  # torque limit of the check, over the static friction that is configured
LEAST_FRICTIONS = 1.25  # the same where a soft reducer bears no more
TORQUE_SHARE = 0.1  # of limits.torque_max_Nm, where no friction is configured
# The spring reaches the limit at 0.7 of the travel.  Friction that takes half of the limit lets go at 0.36; on the way
# back the spring has to turn round first, and it takes twice that, with friction as strong as the push 1.07 travels.
SPRING_SHARE = 1.4  # of the torque limit that gravity leaves, at full travel
PUSH_SHARE = 0.75  # of it, and gravity, which may be believed wrongly: a joint that stands still under more is stuck
MOST_SPRING = 0.8  # of what the spring comes to: with much gravity that is less
PUSHED_FRICTION = 1.4  # static frictions at least: friction may be greater than configured
MOST_PUSH = 0.95  # of the torque limit, where gravity takes nearly all of it
STANDING_WAY = 1.2  # travels of the reference past a reading that stands still
DAMPING = 0.5
FILTER_OF_SPRING = 10.0  # times its natural frequency, the velocity filter at least where counts are coarse
RAMP_s, REST_s = 0.4, 0.4  # a longer travel takes a longer ramp
STOPS = (1.0, 0.0, -1.0, 0.0)  # where the reference goes, in travels
_ROWS_PER_RAMP = 16


@dataclass(frozen=True)
class CheckPlan:
    """The numbers that the user reads before anything moves; joint side."""

    torque_Nm: float
    travel_rad: float
    velocity_radps: float
    static_friction_Nm: float | None  # that is configured
    gravity_Nm: float  # that the law holds, at most

    @property
    def spring_Nm(self) -> float:
        """What gravity leaves of the torque."""
        return max(self.torque_Nm - self.gravity_Nm, 0.2 * self.torque_Nm)

    @property
    def pushed_Nm(self) -> float:
        """On top of what holds it: a joint that stands still under that is stuck, or its reading is."""
        wrong_Nm = PUSH_SHARE * self.spring_Nm + self.gravity_Nm  # gravity may not be what is believed
        push_Nm = min(wrong_Nm, MOST_SPRING * SPRING_SHARE * self.spring_Nm)
        friction_Nm = PUSHED_FRICTION * (self.static_friction_Nm or 0.0)
        return min(max(push_Nm, friction_Nm), MOST_PUSH * self.torque_Nm)

    @property
    def ramp_s(self) -> float:
        """Of one ramp: longer travel is no faster, nor a joint whose velocity limit is low."""
        quickest_s = PEAK * self.travel_rad / (REFERENCE_SHARE * self.velocity_radps)
        return max(RAMP_s * max(1.0, self.travel_rad / TRAVEL_rad), quickest_s)

    @property
    def reach_rad(self) -> float:
        """How far to each side the joint may come before it is braked."""
        return REACH * self.travel_rad

    @property
    def duration_s(self) -> float:
        return APPROACH_MIN_S + len(STOPS) * (self.ramp_s + REST_s)


def make_plan(config: Config, torque_Nm: float | None) -> CheckPlan:
    """`torque_Nm` is the user's; else twice the static friction, or a tenth of what a run may use.

    A reducer that is not rigid may be made unstable by the spring: over a longer travel it is softer, and with less
    torque, if that is not the user's.
    """
    limits, static_Nm, given = config.limits, static_friction_Nm(config), torque_Nm is not None
    if torque_Nm is None:
        own_Nm = STATIC_FRICTIONS * static_Nm if static_Nm else TORQUE_SHARE * limits.torque_max_Nm
        torque_Nm = min(own_Nm + abs(config.joint.gravity_Nm), limits.torque_max_Nm)
    elif not 0.0 < torque_Nm <= limits.torque_max_Nm:
        raise ConfigurationError(
            f"--torque (={torque_Nm:g}) must be in (0..{limits.torque_max_Nm:g}], which is limits.torque_max_Nm"
        )
    resolutions = [abs(joint_rad_per_count(config))]
    if config.joint_encoder is not None:
        resolutions.append(math.tau / config.joint_encoder.counts_per_turn)
    of_range = TRAVEL_OF_RANGE * (limits.position_max_rad - limits.position_min_rad)
    travel = min(max(min(TRAVEL_rad, of_range), TRAVEL_COUNTS * max(resolutions)), TRAVEL_MAX_rad)
    steps_radps = COUNTS_IN_VELOCITY * velocity_of_a_count_radps(config)
    velocity = min(max(VELOCITY_MAX_radps, steps_radps + PEAK * TRAVEL_rad / RAMP_s), limits.velocity_max_radps)
    plan = CheckPlan(torque_Nm, travel, velocity, static_Nm, abs(config.joint.gravity_Nm))
    # a joint that stands in the middle may have what it needs for a softer spring
    most = max(travel, min(TRAVEL_MAX_rad, of_range), min(TRAVEL_rad, 2.0 * of_range))
    least_Nm = LEAST_FRICTIONS * static_Nm + plan.gravity_Nm if static_Nm and not given else plan.torque_Nm
    while not passes(config_of_check(config, plan)):
        if plan.travel_rad < most:
            plan = replace(plan, travel_rad=min(LONGER * plan.travel_rad, most))
        elif plan.torque_Nm > least_Nm:
            plan = replace(plan, torque_Nm=max(plan.torque_Nm / LONGER, least_Nm))
        else:
            break
    return plan


def config_of_check(config: Config, plan: CheckPlan) -> Config:
    """The configuration with the limits and the law of the check; the drive's own torque limit follows from it."""
    require_torque(config, "the motion check")
    limits = {
        "torque_max_Nm": plan.torque_Nm, "velocity_max_radps": plan.velocity_radps,
        "following_error_max_rad": 1.25 * plan.travel_rad,
    }  # fmt: skip
    kp = SPRING_SHARE * plan.spring_Nm / plan.travel_rad / config.joint.inertia_kgm2
    control = {
        "kind": "computed_torque", "kp": kp, "kv": 2.0 * DAMPING * math.sqrt(kp), "feed_forward": "none",
        "learning": None,
    }  # fmt: skip
    made = config.changed(limits=limits, control=control, drive=config.drive.free_of_torque_limit())
    while chatters(made) and made.control.velocity_cutoff_Hz > FILTER_OF_SPRING * math.sqrt(kp) / math.pi:
        made = made.changed(control__velocity_cutoff_Hz=0.5 * made.control.velocity_cutoff_Hz)
    return made


def motion_table(plan: CheckPlan, start_rad: float) -> np.ndarray:
    """Rows of `trajectory.reference_at`, float64 (N, 5): smooth ramps from stop to stop, and a rest at each."""
    times_s, places, end_s, place = [0.0], [0.0], 0.0, 0.0
    for stop in STOPS:
        shares = np.linspace(0.0, 1.0, _ROWS_PER_RAMP + 1)[1:]
        times_s += (end_s + shares * plan.ramp_s).tolist()
        places += (place + (stop - place) * eased(shares)).tolist()
        for share in (0.5, 1.0):
            times_s.append(end_s + plan.ramp_s + share * REST_s)
            places.append(stop)
        end_s, place = times_s[-1], stop
    position_rad = start_rad + plan.travel_rad * np.array(places)
    return spline_table(np.array(times_s), position_rad)


@dataclass(frozen=True)
class CheckMotion:
    """The motion of the check; see `session.plan.Motion`.  `config` is that of `config_of_check`."""

    config: Config
    plan: CheckPlan

    @property
    def table(self) -> np.ndarray:
        return motion_table(self.plan, 0.0)

    def placed(self, report: CommissioningReport) -> Placed:
        """See `Motion`; about the place where the joint stands."""
        table = motion_table(self.plan, report.start_position_rad)
        return Placed(self.constants(report, table), table, tuple(self._envelope(report)))

    def require_start(self, start_position_rad: float) -> None:
        """`ConfigurationError` if the joint stands too near to a limit."""
        limits, travel_rad = self.config.limits, self.plan.travel_rad
        low, high = limits.position_min_rad + travel_rad, limits.position_max_rad - travel_rad
        if low > high:
            raise ConfigurationError(
                f"limits.position_min_rad (={limits.position_min_rad:g}) and position_max_rad "
                f"(={limits.position_max_rad:g}) must be at least {2.0 * travel_rad:.3g} rad apart for the check, "
                f"{travel_rad:.3g} rad to either side of where the joint stands",
                "wider limits.position_*, or more counts_per_turn",
            )
        if not low <= start_position_rad <= high:
            raise ConfigurationError(
                f"the joint stands at {start_position_rad:.4f} rad; the check moves it by up to {travel_rad:g} rad to "
                f"both sides and needs [{low:g}..{high:g}]",
                "turn it by hand with the power off, or correct limits.position_*, encoder.zero_counts",
            )

    def _envelope(self, report: CommissioningReport) -> list[str]:
        plan, start = self.plan, report.start_position_rad
        return [
            *joint_lines(report, self.config.limits),
            f"motion     a soft spring pulls the joint towards {start + plan.travel_rad:+.3f}, then "
            f"{start - plan.travel_rad:+.3f} rad, {plan.duration_s:.0f} s",
            f"limits     {text_Nm(plan.torque_Nm)}, {text_radps(plan.velocity_radps)}; it is braked beyond "
            f"{plan.reach_rad:.2g} rad to either side: keep it free and unloaded, a hand on the emergency stop",
            "watch      which way it turns first: it must be the one that you call positive",
            *remark_lines(report.remarks),
        ]

    def constants(self, report: CommissioningReport, table: np.ndarray) -> Any:
        """`AxisConstants` of the check along `table`."""
        config, plan, start_rad = self.config, self.plan, report.start_position_rad
        hold = config.changed(sequence__approach_s=APPROACH_MIN_S)
        constants = table_constants(hold, table, float(table[-1, 0]), start_rad)
        axis = constants[0]
        axis.limits.position_min_rad = max(axis.limits.position_min_rad, start_rad - plan.reach_rad)
        axis.limits.position_max_rad = min(axis.limits.position_max_rad, start_rad + plan.reach_rad)
        axis.limits.frozen_max_rad, axis.limits.frozen_ahead_rad = STANDING_WAY * plan.travel_rad, 0.0
        lever = math.sin(start_rad - config.joint.gravity_zero_rad)  # it hardly changes over the travel
        axis.limits.frozen_bias_Nm = config.joint.gravity_Nm * lever
        axis.limits.frozen_torque_Nm = plan.pushed_Nm
        return constants


def check_run(config: Config, plan: CheckPlan) -> RunPlan:
    """The plan of a session; `config` is the user's own."""
    inner = config_of_check(config, plan)
    return RunPlan(inner, CheckMotion(inner, plan), log_path(config))


# --- what encoders and records of the check say about directions and scale ---

SCALE_TOLERANCE = 0.001  # of the counts of a turn
_SCALE_REMEDY = (
    "encoder.counts_per_turn, encoder.side, joint.reduction_ratio; or the drive scales 6064 by 6091 and 6092: "
    "then turn the joint by hand by 90 deg with the power off and compare"
)

_SWAPPED_REMEDY = "swap encoder.counts_per_turn and joint_encoder.counts_per_turn if the makers' data agree"
_PLUGS_REMEDY = "swap the cables of the two encoders, or which object of the drive each is read from"

MOVED_SHARE = 0.03  # of the travel: less is no motion
MOVED_COUNTS = 6.0
LOOSE = 0.2  # of the way that it came: less may be the bristles of friction that holds it
HEAVY_radps2 = 6.0  # torque over the inertia, below which a joint moves visibly only long after friction has let it go
LEAST_OF_HEAVY = 0.1  # of the torque by then, is friction: less is none, the slide is not seen well
BEGUN = 0.05  # of the way at which it has begun to move, where it slides
ACTS_CYCLES = 2  # after the sample that it was computed from, a torque is seen in the next speed
SLOW_AGAIN = 0.3  # of its greatest speed, where the slide ends
STATIC_SHARE = 1.2  # of the friction of a slide: what let it go was more
SMOOTHED_CYCLES = 20  # torques are compared over so many: a coarse encoder makes them jump, and the measured one lags
HELD_s = 0.1  # so long a joint stands that the spring holds against a load
SAME_SCALE = 0.2  # by which two encoders may differ over the small way: backlash, twist
SAME_PLACE = 0.02  # the same of their positions at standstill
STOOD = 0.02  # of the way of the other encoder
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
    second = config.joint_encoder
    if second is not None and abs(second.counts_per_turn / counts_per_motor_turn - 1.0) < SCALE_TOLERANCE:
        return Finding("counts", NOTE, f"{text}, and so says joint_encoder.counts_per_turn", _SWAPPED_REMEDY, numbers)
    return Finding("counts", NOTE, f"{text}: {shown} times as many", _SCALE_REMEDY, numbers)


@dataclass(frozen=True)
class Motion:
    """Figures of the motion, by the encoder that feeds the law."""

    moved_rad: float  # farthest from the start, with its sign
    work_J: float  # of the commanded torque without gravity: negative if the joint moved against it
    accelerating: float  # torque times change of speed, summed: negative if the joint sped up against the torque
    break_away_Nm: float  # commanded beside gravity when the joint began to move
    torque_max_Nm: float  # commanded, without kicks too short to move anything: those of a coarse encoder's counts
    torque_ratio: float | None  # measured over commanded; None where the drive measures none
    other_ratio: float | None  # way of the other encoder over that of this one
    other_moved_rad: float
    held_Nm: float  # with which the spring held it where something had moved it against the torque; 0: it did not

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


def motion_of(records: np.recarray, threshold_rad: float, held_cycles: int) -> Motion | None:
    """None if the drive was never enabled."""
    rows: Any = records[np.isin(records.phase, [*_POWERED, AxisPhase.QUICK_STOPPING])]
    powered = np.isin(rows.phase, _POWERED)
    if powered.sum() < 2:
        return None
    way = np.asarray(rows.position_rad - rows.position_rad[0])
    other = np.asarray(rows.second_position_rad - rows.second_position_rad[0])
    torque = np.where(powered, rows.command_torque_Nm, 0.0)
    pushed = np.where(powered, rows.command_torque_Nm - rows.gravity_torque_Nm, 0.0)
    work = float(np.sum(pushed[:-1] * np.diff(way)))
    loose = np.nonzero(np.abs(way) >= max(threshold_rad, LOOSE * np.abs(way).max()))[0]
    first = int(loose[0]) if len(loose) else -1
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
        break_away_Nm=_break_away_Nm(rows, way, pushed, first),
        torque_max_Nm=float(np.abs(smooth).max()),
        torque_ratio=ratio,
        other_ratio=float(np.sum(way * other) / square) if square > 0.0 else None,
        other_moved_rad=float(other[np.argmax(np.abs(other))]),
        held_Nm=_held_Nm(way[powered], pushed[powered], threshold_rad, held_cycles),
    )


def _break_away_Nm(rows: Any, way: np.ndarray, pushed: np.ndarray, first: int) -> float:
    """Of the torques (N,) up to the row `first` of the way (N,) that counts as motion; -1: of all, it did not move.

    By then a heavy joint is under far more torque than let it go: it needs as much as it slides under, and a little.
    """
    # a count of a coarse encoder is a kick of many Nm, too short to move anything
    most_Nm = float(np.abs(_smoothed(pushed[: first + 1 or None])).max())
    if first <= 0:
        return most_Nm
    sliding_Nm, inertia_kgm2 = _slide(rows, way, pushed, first)
    held_Nm, heavy = STATIC_SHARE * sliding_Nm, most_Nm < HEAVY_radps2 * inertia_kgm2
    return held_Nm if heavy and LEAST_OF_HEAVY * most_Nm < held_Nm < most_Nm else most_Nm


def _slide(rows: Any, way: np.ndarray, pushed: np.ndarray, first: int) -> tuple[float, float]:
    """Friction [Nm] and inertia [kg m^2] of the first slide, until it is slow again: J q'' = u - F, summed up twice.

    The inertia is 0 where neither is seen; that of the file may be many times wrong.
    """
    begin = int(np.argmax(np.abs(way) >= BEGUN * abs(way[first])))
    sign = np.sign(way[first])
    speed = np.asarray(rows.velocity_radps[begin:]) * sign
    slow = speed < SLOW_AGAIN * np.maximum.accumulate(speed)
    slow[: first - begin + 1] = False
    slow |= ~np.isin(rows.phase[begin:], _POWERED)  # the drive's own ramp, which no row says
    slide = slice(begin, begin + int(np.argmax(slow)) if slow.any() else len(way))
    time_s = (rows.time_ns[slide] - rows.time_ns[begin]) * 1e-9
    step_s = np.diff(time_s, prepend=0.0)
    acting = np.roll(pushed, ACTS_CYCLES)[slide] * sign
    twice = np.cumsum(np.cumsum(acting * step_s) * step_s)
    columns = np.column_stack((twice, 0.5 * time_s**2, time_s, np.ones(len(time_s))))
    per_Nm, per_s2 = (float(one) for one in np.linalg.lstsq(columns, way[slide] * sign, rcond=None)[0][:2])
    return (-per_s2 / per_Nm, 1.0 / per_Nm) if per_Nm > 0.0 else (0.0, 0.0)


def _held_Nm(way: np.ndarray, torque: np.ndarray, threshold_rad: float, cycles: int) -> float:
    """Torque in the last place away from the start where the joint stood for so many cycles and was pulled back; or 0.

    A joint with a wrong sign does not come to stand: the torque drives it on.
    """
    for end in range(len(way), cycles - 1, -max(cycles // 4, 1)):
        stood, pulled_Nm = way[end - cycles : end], float(torque[end - 1])
        if np.ptp(stood) < threshold_rad / 3.0 and abs(stood[-1]) >= threshold_rad and pulled_Nm * stood[-1] < 0.0:
            return pulled_Nm
    return 0.0


def motion_findings(
    config: Config, plan: CheckPlan, records: np.recarray, fault: Fault, text: FaultText | None
) -> Iterator[Finding]:
    """Every finding of one check; `config` is the user's own."""
    second = config.joint_encoder
    law, other = "encoder", "joint_encoder"
    if second is not None and second.law == "joint_encoder":
        law, other = other, law
    threshold_rad = max(MOVED_SHARE * plan.travel_rad, MOVED_COUNTS * law_resolution_rad(config))
    # a reading that stands still ends the check before it has stood for long
    held_cycles = 1 if fault is Fault.POSITION_FROZEN else round(HELD_s * config.loop.rate_Hz)
    motion = motion_of(records, threshold_rad, held_cycles)
    if motion is None:
        misplaced = fault in (Fault.POSITION_DISAGREEMENT, Fault.POSITION_LIMIT)
        if misplaced and len(records) and records.position_rad[-1]:
            places = float(records.second_position_rad[-1] / records.position_rad[-1])
            yield from _swapped(config, law, other, places, SAME_PLACE)
        yield ended_finding(records, fault, text)
        return
    numbers = {key: value for key, value in vars(motion).items() if value is not None}
    if abs(motion.moved_rad) < threshold_rad:
        if fault is Fault.VELOCITY_LIMIT:  # of an encoder that stands still there is none
            yield ended_finding(records, fault, text)
            return
        moved = second is not None and abs(motion.other_moved_rad) > threshold_rad
        swapped = list(_swapped(config, law, other, motion.other_ratio)) if moved else []
        yield from swapped or [_standing(motion, law, other, threshold_rad, moved, numbers)]
        if fault is not Fault.NONE and fault not in _STANDING_FAULTS:
            yield ended_finding(records, fault, text)
        return
    along = motion.along or (motion.held_Nm != 0.0 and fault is Fault.NONE)  # it was pulled to and fro, and followed
    loaded = not along and motion.held_Nm != 0.0
    encoders = list(_encoders(config, motion, None if loaded else along, law, other)) if second is not None else []
    yield from encoders
    direction = _loaded(motion, numbers) if loaded else _direction(motion, along, law, other, numbers)
    yield direction
    if motion.torque_ratio is not None:
        yield _measured_torque(motion.torque_ratio)
    stands = not loaded and fault in (Fault.POSITION_FROZEN, Fault.TORQUE_SATURATED)
    if stands:
        yield _came_to_stand(motion)
    elif motion.along:
        yield from _friction(motion, plan)
    explained = stands or (direction.status == PROBLEM and fault in (_STANDING_FAULTS if loaded else _WAY_FAULTS))
    if fault is Fault.POSITION_DISAGREEMENT:
        explained = explained or any(finding.status == PROBLEM for finding in encoders)
    if fault is not Fault.NONE and not explained:
        yield ended_finding(records, fault, text)


def ended_finding(records: np.recarray, fault: Fault, text: FaultText | None) -> Finding:
    """The fault that ended the check."""
    moved = np.isin(records.phase, _POWERED).any()
    when = "while the joint moved" if moved else "before the drive was enabled"
    if text is None:
        return Finding("check", PROBLEM, f"ended {when}", "repeat it")
    return Finding("check", PROBLEM, f"ended {when}: {fault.name}: {text.happened}", text.next_step)


def _standing(
    motion: Motion, law: str, other: str, threshold_rad: float, other_moved: bool, numbers: dict[str, Any]
) -> Finding:
    reading = f"the reading of [{law}] stood still (within {threshold_rad * 1e3:.2g} mrad)"
    reading += f" at up to {text_Nm(motion.torque_max_Nm)}"
    if other_moved:
        remedy = f"[{law}] is dead or its cable, object or node is wrong: [{other}] moved"
        return Finding("motion", PROBLEM, f"{reading}, that of [{other}] moved", remedy, numbers)
    remedy = "turn the joint by hand with the power off and watch the position: a reading that stands is the encoder; "
    remedy += "else brake, blocked joint, motor supply, torque constant, or more friction than --torque"
    return Finding("motion", PROBLEM, reading, remedy, numbers)


def _swapped(
    config: Config, law: str, other: str, ratio: float | None, tolerance: float = SAME_SCALE
) -> Iterator[Finding]:
    """One where `ratio`, of the other encoder over that of the law, is that of the counts of each in the other's key.

    Or that of the readings of each in the place of the other: cables, or the drive's objects.  Each is wrong by the
    quotient of their counts then, in the key or of the joint, one too long and one too short.
    """
    if config.joint_encoder is None or ratio is None:
        return
    own, second = config.encoder.counts_per_turn, config.joint_encoder.counts_per_turn
    keys = f"encoder.counts_per_turn (={own}) and joint_encoder.counts_per_turn (={second})"
    own_of_joint = math.tau / abs(joint_rad_per_count(config))
    for counts, what, remedy in (
        (own, keys, _SWAPPED_REMEDY),
        (own_of_joint, "the readings of [encoder] and [joint_encoder]", _PLUGS_REMEDY),
    ):
        expected = (second / counts) ** (2 if law == "joint_encoder" else -2)
        if abs(expected - 1.0) > SAME_SCALE and abs(abs(ratio) / expected - 1.0) <= tolerance:
            text = f"[{other}] moves {abs(ratio):.3g} times as far as [{law}], as if {what} were swapped"
            yield Finding("scale", PROBLEM, text, remedy, {"other_ratio": ratio})
            return


def _encoders(config: Config, motion: Motion, along: bool | None, law: str, other: str) -> Iterator[Finding]:
    """`along`: whether the joint moved with the torque by the encoder of the law; None where that is not known."""
    ratio = motion.other_ratio
    if ratio is None:
        return
    numbers = {"other_ratio": ratio}
    swapped = list(_swapped(config, law, other, ratio))
    stood = abs(ratio) < STOOD and not swapped
    if stood:
        text = f"[{other}] stood still while [{law}] moved"
        yield Finding("two encoders", PROBLEM, text, f"cable or object of [{other}]", numbers)
    elif ratio < 0.0:
        text = f"[{law}] and [{other}] count against each other"
        wrong, right = (other, law) if along else (law, other)
        remedy = f"{wrong}.direction: [{right}] agrees with the torque"
        if along is None:
            remedy = f"{law}.direction or {other}.direction: turn the joint by hand with the power off"
        yield Finding("two encoders", PROBLEM, text, remedy, numbers)
    if swapped:
        yield from swapped
    elif not stood and abs(abs(ratio) - 1.0) > SAME_SCALE:
        text = f"[{other}] moves {abs(ratio):.3g} times as far as [{law}]"
        remedy = "counts_per_turn of one of them, encoder.side or joint.reduction_ratio, by that factor"
        yield Finding("scale", PROBLEM, text, remedy, numbers)
    elif not stood and ratio > 0.0:
        yield Finding("two encoders", OK, f"the same direction, and {ratio:.3f} times the same way", "", numbers)


def _way(motion: Motion) -> str:
    return f"by up to {abs(motion.moved_rad) * 1e3:.1f} mrad ({math.degrees(abs(motion.moved_rad)):.2f} deg)"


_LOAD_REMEDY = (
    "free it, or state its load: joint.gravity_Nm, joint.gravity_zero_rad; a joint of an arm is checked in a pose in "
    "which it hangs down; more --torque"
)


def _loaded(motion: Motion, numbers: dict[str, Any]) -> Finding:
    held = text_Nm(abs(motion.held_Nm))
    text = f"something moved the joint against the torque, {_way(motion)}, and it stood at {held}: "
    return Finding("load", PROBLEM, f"{text}a load or an end stop; no direction can be judged", _LOAD_REMEDY, numbers)


def _came_to_stand(motion: Motion) -> Finding:
    text = f"the joint, or its reading, came to stand at up to {text_Nm(motion.torque_max_Nm)}: "
    text += "a load, an end stop, more friction than configured, or the encoder"
    return Finding("load", PROBLEM, text, f"{_LOAD_REMEDY}; the encoder's cable")


def _direction(motion: Motion, along: bool, law: str, other: str, numbers: dict[str, Any]) -> Finding:
    way = _way(motion)
    if not along:
        both = f"{law}.direction"
        if motion.other_ratio is not None and motion.other_ratio > STOOD:
            both += f" and {other}.direction"
        remedy = (
            f"if the joint turned the way that you call positive at first: {both}; else drive.torque_direction; but "
            "first make sure that no load moved it, such as gravity that joint.gravity_Nm does not state"
        )
        if motion.other_ratio is not None and motion.other_ratio < -STOOD:
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
    text = f"it began to move at {text_Nm(motion.break_away_Nm)}{' beside gravity' if plan.gravity_Nm else ''}"
    numbers = {"break_away_Nm": motion.break_away_Nm}
    static_Nm = plan.static_friction_Nm
    if not static_Nm:
        yield Finding("friction", OK, text, "", numbers)
    elif 1.0 / FRICTION_FACTOR <= motion.break_away_Nm / static_Nm <= FRICTION_FACTOR:
        yield Finding("friction", OK, f"{text}; [friction] says {text_Nm(static_Nm)}", "", numbers)
    else:
        remedy = "joint.torque_constant_NmpA and its ampere, joint.reduction_ratio, units of [friction]; then sweep"
        yield Finding("friction", NOTE, f"{text}; [friction] says {text_Nm(static_Nm)}", remedy, numbers)
