"""The motion of a sweep: plateaus of constant speed back and forth within the travel, as an exact table.

Every plateau is a stroke: accelerate, lead in until the loop has settled, measure at constant speed, brake.  The
windows of measuring are known beforehand, so that acceleration never gets into the data.  A window covers whole
periods of the ripple, so that it averages out:

- fast and medium speeds: whole periods of the reducer's ripple at the joint (18 a turn), as many as the dwell time
  asks for; what does not fit into the travel is repeated in further strokes;
- slow speeds, where one such period would take too long: teeth of whole motor ripple periods (2 a motor turn),
  spread evenly over one period at the joint, with a quick hop in between.  A sum over evenly spread positions cancels
  the first harmonics of the ripple as well.

Positions are relative to the middle of the motion.  The table has the rows of `trajectory.reference_at`: constant
acceleration and constant speed are cubics, so nothing is approximated.  The acceleration jumps, as a trapezoid's does,
or changes within the period of the link where the jump would twist a soft reducer too much (`conversions.turning_of`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, DeviceError, UsageError
from jointctl.tools.analysis.loop_report import rated_contradiction
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import (
    joint_rad_per_count,
    torque_constant_NmpA,
    turning_of,
    velocity_of_a_count_radps,
)
from jointctl.tools.sweeping.options import (
    DEFAULT_POINTS,
    SPEED_RATIO,
    SweepOptions,
    SweepPoint,
    both_directions,
    check_options,
    grid_speeds,
    listed_velocities,
    ordered_points,
    plan_hash,
)

BATCHES = 16  # of the samples of a window; their spread tells how far its mean can be trusted
LEAST_SAMPLES = 4 * BATCHES
TEETH = 4
MOST_STROKES = 8  # of one point; more travel helps more than more strokes
PATIENCE = 3.0  # a whole period at the joint may take this many dwell times before teeth take its place
REVERSAL_s = 0.1
LEAD_rad = 0.002  # several times the deflection of the bristles before sliding


@dataclass(frozen=True)
class PlanSettings:
    """What shapes the motion; joint side."""

    width_rad: float  # of the travel that may be used
    acceleration_radps2: float
    transit_radps: float  # highest speed of moves without measuring
    dwell_s: float  # wanted time of measuring per point
    settle_s: float  # between the end of acceleration and the window
    reduction_ratio: float
    ripple_per_joint_turn: float = 18.0
    ripple_per_motor_turn: float = 2.0
    rounding_s: float = 0.0  # in which the acceleration changes

    @property
    def joint_period_rad(self) -> float:
        return math.tau / self.ripple_per_joint_turn

    @property
    def motor_period_rad(self) -> float:
        """Of the finest ripple; a direct drive has none that repeats more often than that of the joint."""
        period_rad = math.tau / (self.ripple_per_motor_turn * self.reduction_ratio)
        return period_rad if period_rad <= self.joint_period_rad else self.joint_period_rad / TEETH


@dataclass(frozen=True)
class Stroke:
    """How one speed is measured: `teeth` windows of `window_rad` a stroke, `strokes` times."""

    speed_radps: float
    window_rad: float
    teeth: int
    strokes: int
    pitch_rad: float  # from the beginning of one window to that of the next
    length_rad: float  # of the whole stroke, ramps included


@dataclass(frozen=True)
class Window:
    """From start_s to end_s of the trajectory the joint moves at the speed of this point; `last` completes it."""

    point: SweepPoint
    start_s: float
    end_s: float
    last: bool


@dataclass(frozen=True)
class SweepMotion:
    table: np.ndarray  # float64 (rows, 5)
    windows: tuple[Window, ...]
    low_rad: float
    high_rad: float

    @property
    def duration_s(self) -> float:
        return float(self.table[-1, 0])


def _lead_rad(speed_radps: float, s: PlanSettings) -> float:
    return speed_radps * s.settle_s + LEAD_rad


def _ramp_s(change_radps: float, s: PlanSettings) -> float:
    """Time of a change of the speed; no quicker than the acceleration may change."""
    return max(change_radps / s.acceleration_radps2, s.rounding_s) + s.rounding_s if change_radps else 0.0


def ramps_rad(speed_radps: float, s: PlanSettings, slow_radps: float = 0.0) -> float:
    """Distance of speeding up from `slow_radps` and of braking to it."""
    if s.rounding_s == 0.0:
        return (speed_radps * speed_radps - slow_radps * slow_radps) / s.acceleration_radps2
    return (speed_radps + slow_radps) * _ramp_s(speed_radps - slow_radps, s)


ROUNDING = 1e-6  # the highest speed must fit in spite of rounding


def room_rad(speed_radps: float, s: PlanSettings) -> float:
    """Longest window that fits into the travel at this speed; negative if not even the ramps fit."""
    return s.width_rad - ramps_rad(speed_radps, s) - _lead_rad(speed_radps, s)


def fastest_radps(s: PlanSettings) -> float:
    """Highest speed at which one ripple period of the joint (of the motor, if that does not fit) is measured."""
    for window in (s.joint_period_rad, s.motor_period_rad):
        left = s.width_rad - LEAD_rad - window
        if left > 0.0:
            # v^2 / a + v (rounding + settle) = left, or v (2 rounding + settle) = left of a short ramp
            half = 0.5 * (s.rounding_s + s.settle_s) * s.acceleration_radps2
            exact = math.sqrt(half * half + left * s.acceleration_radps2) - half
            if exact < s.acceleration_radps2 * s.rounding_s:
                exact = left / (2.0 * s.rounding_s + s.settle_s)
            return exact * (1.0 - ROUNDING)
    raise UsageError(
        f"the travel (={s.width_rad:.4f} rad) must be more than {s.motor_period_rad + LEAD_rad:.4f} rad, one ripple "
        "period of the motor; see limits.position_min_rad and position_max_rad"
    )


def stroke_of(speed_radps: float, s: PlanSettings) -> Stroke:
    """How a speed is measured within the travel; `UsageError` if it cannot be."""
    room = room_rad(speed_radps, s) * (1.0 - 1e-9)
    joint, motor = s.joint_period_rad, s.motor_period_rad
    if room < motor:
        raise UsageError(
            f"speed (={speed_radps:.4g} rad/s) must be at most {fastest_radps(s):.4g} rad/s within a travel of "
            f"{s.width_rad:.3f} rad at {s.acceleration_radps2:g} rad/s2; see --max-speed"
        )
    wanted = speed_radps * s.dwell_s
    tooth = max(1, math.floor(wanted / (TEETH * motor) + 1e-9)) * motor
    hop = joint / TEETH - tooth - _lead_rad(speed_radps, s)
    if wanted * PATIENCE < joint and hop > 0.0 and room >= joint:
        pitch = joint / TEETH
        length = ramps_rad(speed_radps, s) + _lead_rad(speed_radps, s) + (TEETH - 1) * pitch + tooth
        return Stroke(speed_radps, tooth, TEETH, 1, pitch, length)
    if room >= joint:
        periods = max(1, round(wanted / joint))
        window = min(periods, math.floor(room / joint)) * joint
        strokes = math.ceil(periods * joint / window - 1e-9)
    else:
        periods = max(1, round(wanted / motor))
        window = min(periods, math.floor(room / motor)) * motor
        strokes = math.ceil(periods * motor / window - 1e-9)
    length = ramps_rad(speed_radps, s) + _lead_rad(speed_radps, s) + window
    return Stroke(speed_radps, window, 1, min(strokes, MOST_STROKES), window, length)


class MotionBuilder:
    """Collects table rows; keeps time, position and velocity of the end of what has been planned."""

    def __init__(self, s: PlanSettings) -> None:
        self._s = s
        self._rows: list[tuple[float, float, float, float, float]] = []
        self.t_s, self.q_rad, self.v_radps = 0.0, 0.0, 0.0
        self.low_rad, self.high_rad = 0.0, 0.0

    def _row(self, duration_s: float, acceleration: float, jerk: float = 0.0) -> None:
        if self.t_s + duration_s <= self.t_s:  # of rounding alone, too
            return
        self._rows.append((self.t_s, self.q_rad, self.v_radps, 0.5 * acceleration, jerk / 6.0))
        self.q_rad += duration_s * (self.v_radps + duration_s * (0.5 * acceleration + jerk * duration_s / 6.0))
        self.t_s += duration_s
        self.low_rad, self.high_rad = min(self.low_rad, self.q_rad), max(self.high_rad, self.q_rad)

    def ramp(self, velocity_radps: float) -> None:
        """To another velocity at the acceleration of the plan, which changes within `rounding_s`."""
        change, rounding_s = velocity_radps - self.v_radps, self._s.rounding_s
        if change and rounding_s:
            level_s = max(abs(change) / self._s.acceleration_radps2 - rounding_s, 0.0)
            acceleration = change / (level_s + rounding_s)
            jerk = acceleration / rounding_s
            for duration_s, begin, slope in (
                (rounding_s, 0.0, jerk), (level_s, acceleration, 0.0), (rounding_s, acceleration, -jerk)
            ):  # fmt: skip
                self._row(duration_s, begin, slope)
                self.v_radps += duration_s * (begin + 0.5 * slope * duration_s)
        else:
            self._row(abs(change) / self._s.acceleration_radps2, math.copysign(self._s.acceleration_radps2, change))
        self.v_radps = velocity_radps

    def cruise(self, distance_rad: float) -> tuple[float, float]:
        """A distance > 0 in the direction of motion at constant speed; returns start and end [s]."""
        start_s = self.t_s
        self._row(distance_rad / abs(self.v_radps), 0.0)
        return start_s, self.t_s

    def peak_radps(self, distance_rad: float, slow: float) -> float:
        """Whose ramps from and to the speed `slow` take the distance; no less than `slow`."""
        a, rounding_s = self._s.acceleration_radps2, self._s.rounding_s
        half = 0.5 * a * rounding_s
        peak = math.sqrt((slow - half) * (slow - half) + a * distance_rad) - half
        if peak - slow < a * rounding_s:
            peak = 0.5 * distance_rad / rounding_s - slow
        return max(peak, slow)

    def rest(self, duration_s: float) -> None:
        self._row(duration_s, 0.0)

    def hop(self, distance_rad: float) -> None:
        """Quickly over a distance > 0 in the direction of motion, at the present speed again at its end."""
        slow = self.v_radps
        peak = min(self.peak_radps(distance_rad, abs(slow)), max(self._s.transit_radps, abs(slow)))
        ramps = ramps_rad(peak, self._s, abs(slow))
        self.ramp(math.copysign(peak, slow))
        if distance_rad > ramps:
            self.cruise(distance_rad - ramps)
        self.ramp(slow)

    def move_to(self, target_rad: float) -> None:
        """From rest to rest."""
        distance = target_rad - self.q_rad
        if abs(distance) > 1e-12:
            peak = min(self.peak_radps(abs(distance), 0.0), self._s.transit_radps)
            ramps = ramps_rad(peak, self._s)
            self.ramp(math.copysign(peak, distance))
            if abs(distance) > ramps:
                self.cruise(abs(distance) - ramps)
            self.ramp(0.0)
            self.q_rad = target_rad  # rounding does not add up

    def table(self) -> np.ndarray:
        return np.array([*self._rows, (self.t_s, self.q_rad, 0.0, 0.0, 0.0)])


def _measure(builder: MotionBuilder, stroke: Stroke, direction: int, s: PlanSettings) -> list[tuple[float, float]]:
    """One stroke from rest to rest; returns its windows."""
    velocity = direction * stroke.speed_radps
    builder.ramp(velocity)
    spans = []
    for tooth in range(stroke.teeth):
        if tooth:
            builder.hop(stroke.pitch_rad - stroke.window_rad - _lead_rad(stroke.speed_radps, s))
        builder.cruise(_lead_rad(stroke.speed_radps, s))
        spans.append(builder.cruise(stroke.window_rad))
    builder.ramp(0.0)
    return spans


def plan_motion(
    points: list[SweepPoint], s: PlanSettings, warm_up_turns: float = 0.0, warm_between_turns: float = 0.0
) -> SweepMotion:
    """The motion that visits `points` in their order; the two directions of a speed share their strokes.

    Turns before the first and before each further pass warm the joint up.
    """
    groups: list[list[SweepPoint]] = []
    for point in points:
        last = groups[-1] if groups else []
        same = last and (abs(last[0].velocity_radps), last[0].pass_number) == (
            abs(point.velocity_radps), point.pass_number,
        )  # fmt: skip
        if same and len(last) == 1 and last[0].direction != point.direction:
            last.append(point)
        else:
            groups.append([point])
    strokes = {abs(p.velocity_radps): stroke_of(abs(p.velocity_radps), s) for p in points}
    builder = MotionBuilder(s)
    builder.rest(REVERSAL_s)
    half = 0.5 * max((stroke.length_rad for stroke in strokes.values()), default=0.0)
    _warm_up(builder, half, warm_up_turns)
    windows: list[Window] = []
    for before, group in itertools.pairwise([groups[0] if groups else [], *groups]):
        if group[0].pass_number != before[0].pass_number:
            _warm_up(builder, half, warm_between_turns)
        stroke = strokes[abs(group[0].velocity_radps)]
        for number in range(stroke.strokes):
            for point in group:
                builder.move_to(-point.direction * 0.5 * stroke.length_rad)
                builder.rest(REVERSAL_s)
                spans = _measure(builder, stroke, point.direction, s)
                builder.rest(REVERSAL_s)
                complete = number == stroke.strokes - 1
                windows += [Window(point, *span, complete and span == spans[-1]) for span in spans]
    builder.move_to(0.0)
    builder.rest(REVERSAL_s)
    return SweepMotion(builder.table(), tuple(windows), builder.low_rad, builder.high_rad)


def _warm_up(builder: MotionBuilder, half_rad: float, turns: float) -> None:
    """Back and forth over +-half, so many turns of the joint in all."""
    left_rad, side = turns * math.tau, 1.0
    while left_rad > 0.0 and half_rad > 0.0:
        left_rad -= abs(side * half_rad - builder.q_rad)
        builder.move_to(side * half_rad)
        builder.rest(REVERSAL_s)
        side = -side


def shifted(motion: SweepMotion, middle_rad: float) -> SweepMotion:
    """The same motion about another position."""
    table = motion.table.copy()
    table[:, 1] += middle_rad
    return SweepMotion(table, motion.windows, motion.low_rad + middle_rad, motion.high_rad + middle_rad)


# --- the plan that follows from the options, for a joint ---

SPEED_SHARE = 0.9  # of limits.velocity_max_radps that the fastest plateau may have, and a count less than that limit
ACCELERATION_SHARE = 0.8  # of sequence.brake_radps2: braking must always be possible
TRANSIT_SHARE = 0.5  # of the fastest plateau, for ways without measuring
SETTLE_S = 0.3
QUICK_S = 450.0
QUICK_MOST, QUICK_LEAST = 120, 24
QUICK_DWELL_S = 0.5
SAMPLES_SPARE = 1.7  # windows are rounded to whole ripple periods, down to two thirds; 0.5 s at 125 Hz were too few
QUICK_RATIO = 500.0


@dataclass(frozen=True)
class SweepPlan:
    """Points, motion settings and identity of one sweep."""

    points: list[SweepPoint]
    settings: PlanSettings
    hash: str
    warm_between_turns: float = 0.0

    def motion(self, points: list[SweepPoint], warm_up_turns: float, dwell_factor: float = 1.0) -> SweepMotion:
        values = {**asdict(self.settings), "dwell_s": self.settings.dwell_s * dwell_factor}
        return plan_motion(points, PlanSettings(**values), warm_up_turns, self.warm_between_turns)


def position_margin_rad(config: Config) -> float:
    """Kept free at both ends of the travel: the joint may be so far from its reference."""
    return config.limits.following_error_max_rad


def fastest_allowed_radps(config: Config) -> float:
    """That no reading of it is beyond limits.velocity_max_radps: the speed of a coarse encoder jumps by a count.

    `UsageError` where a count is more than half of that limit.
    """
    fastest, count = config.limits.velocity_max_radps, velocity_of_a_count_radps(config)
    if count > 0.5 * fastest:
        raise UsageError(
            f"one count of the encoder reads as {count:.3g} rad/s behind control.velocity_cutoff_Hz "
            f"(={config.control.velocity_cutoff_Hz:g}), must be at most {0.5 * fastest:.3g}, half of "
            "limits.velocity_max_radps",
            "a lower control.velocity_cutoff_Hz, or an encoder with more counts",
        )
    return min(SPEED_SHARE * fastest, fastest - count)


def make_plan(config: Config, options: SweepOptions) -> SweepPlan:
    """Check the options against the joint and plan; `UsageError` in one line."""
    check_options(options)
    width = _width_rad(config, options)
    wanted_s = options.dwell_s or (QUICK_DWELL_S if options.quick else 1.0)
    dwell_s = max(wanted_s, SAMPLES_SPARE * LEAST_SAMPLES / config.loop.rate_Hz)
    allowed = fastest_allowed_radps(config)
    acceleration_radps2, rounding_s = turning_of(config, ACCELERATION_SHARE * config.sequence.brake_radps2)

    def settings(transit_radps: float) -> PlanSettings:
        return PlanSettings(
            width, acceleration_radps2, transit_radps, dwell_s, SETTLE_S, config.joint.reduction_ratio,
            rounding_s=rounding_s,
        )  # fmt: skip

    reachable = min(allowed, fastest_radps(settings(allowed)))
    if options.grid == "list":
        assert options.speeds is not None
        velocities = listed_velocities(options.speeds)
        fastest = max(abs(v) for v in velocities)
        _check_fastest(config, f"fastest speed of {options.speeds}", fastest, reachable, allowed)
    else:
        fastest = options.max_speed_radps or reachable
        _check_fastest(config, "--max-speed", fastest, reachable, allowed)
        slowest = options.min_speed_radps or fastest / (QUICK_RATIO if options.quick else SPEED_RATIO)
        if not slowest < fastest:
            raise UsageError(f"--min-speed (={slowest:g}) must be less than --max-speed, {fastest:g} rad/s")

        def grid(count: int) -> list[float]:
            return both_directions(grid_speeds(options.grid, (count + 1) // 2, slowest, fastest), count)

        velocities = grid(options.points or (QUICK_MOST if options.quick else DEFAULT_POINTS))
    chosen = settings(TRANSIT_SHARE * fastest)

    def ordered(velocities: list[float]) -> list[SweepPoint]:
        return ordered_points(velocities, options.passes, options.shuffle_seed, options.conditions)

    points = ordered(velocities)
    if options.quick:
        count = QUICK_MOST
        while plan_motion(points, chosen, options.warm_up_turns).duration_s > QUICK_S and count > QUICK_LEAST:
            count -= 4
            points = ordered(grid(count))
    other: dict[str, float] = {"warm_between_turns": options.warm_between_turns} if options.warm_between_turns else {}
    if options.lockstep:  # what was simulated and what was measured are two sweeps
        other["simulated"] = True
    shape = asdict(chosen)
    if not rounding_s:  # the identity of a motion that was begun before there was a rounded one
        del shape["rounding_s"]
    identity = plan_hash(points, shape | measuring_constants(config) | other)
    return SweepPlan(points, chosen, identity, options.warm_between_turns)


def _width_rad(config: Config, options: SweepOptions) -> float:
    """Of the travel, the same about each place."""
    low = config.limits.position_min_rad + position_margin_rad(config)
    high = config.limits.position_max_rad - position_margin_rad(config)
    for place in options.places_rad or ():
        if not low < place < high:
            raise UsageError(f"--at (={place:g}) must be in ({low:g}..{high:g}) rad, inside the limits")
    return min((2.0 * min(place - low, high - place) for place in options.places_rad or ()), default=high - low)


def _check_fastest(config: Config, name: str, fastest: float, reachable: float, allowed: float) -> None:
    if fastest > reachable * (1.0 + 1e-9):
        share = f"{allowed / config.limits.velocity_max_radps:.0%} of limits.velocity_max_radps"
        why = share if reachable == allowed else "what the travel allows"
        raise UsageError(f"{name} (={fastest:g}) must be at most {reachable:.4g} rad/s, {why}")


# --- Do the constants that turn the drive's reading into torque agree?  And what the sidecar keeps of them ---
# A CiA 402 drive tells its torque in thousandths of a rated value, so that a wrong torque constant or rated value
# scales all friction by the same factor, and nothing in the curve's shape shows it.  But three of the numbers are tied:
# rated torque is about torque constant times rated current.  A factor of 1.41 between them is rms against sine
# amplitude.  A serial drive tells amperes and has no rated torque: its torque constant cannot be checked this way.


WRONG_FACTOR = 3.0


def refuse_constants(config: Config) -> None:
    """Raise `ConfigurationError` if no motor can have these constants."""
    found = config.drive.constants_factor(config)
    if found is not None and not 1.0 / WRONG_FACTOR <= found[0] <= WRONG_FACTOR:
        raise ConfigurationError(f"{config.path}: {found[1]}", "nothing was moved; see the data sheets")


def require_torque(report: CommissioningReport) -> None:
    """`DeviceError` where the torque of every sample would be zero."""
    if not report.measures_torque:
        raise DeviceError(
            "the drive does not tell its torque in the cyclic exchange (object 6077): friction would read as zero, "
            "and a blocked joint would not be noticed",
            "use an EDS with 6077, and let it be mapped to a PDO",
        )


def constant_remarks(config: Config) -> list[str]:
    """What the user should look at before the joint moves."""
    return [line + "; friction would be wrong by that factor" for line in rated_contradiction(config)]


def recorded_limits(config: Config) -> dict[str, float]:
    """For the sidecar: what `identify` compares the data with when no configuration is at hand; at the joint."""
    return {"torque_max_Nm": config.limits.torque_max_Nm, "velocity_max_radps": config.limits.velocity_max_radps}


def measuring_constants(config: Config) -> dict[str, float]:
    """What turns readings into velocity and friction: points measured with other numbers are not one sweep."""
    return {
        "torque_constant_NmpA": torque_constant_NmpA(config),
        "torque_direction": float(config.drive.torque_direction),
        "rad_per_count": joint_rad_per_count(config),
        "gravity_Nm": config.joint.gravity_Nm,
        "gravity_zero_rad": config.joint.gravity_zero_rad,
        **config.drive.measuring_constants(),
    }
