"""Desired motion: profiles, tables, the approach and the ramp, and the largest speed that a motion asks for."""

from __future__ import annotations

import contextlib
import math
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.kernel import kernel, plain
from jointctl.firmware_py.motion_records import Reference, SetPoint, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind

# --- Position, velocity and acceleration of the joint at a given time, and the ways in and out ---
# Joint side, rad, rad/s, rad/s^2, time in s since the trajectory began.  Each kind of `TrajectoryKind` is a formula
# or a table; nothing is filtered, so that the three quantities belong together exactly.
#
# The paper's changes are a SINE with a second set of numbers from 82.5 s on, the time running through: 0.35 sin(0.2
# pi t) to 0.35 sin(0.125 pi (t + 1.5)), and to 0.175 sin(0.2 pi t) + 0.175.  Both happen at a crest: position (0.35
# rad) and velocity (0) are continuous, the acceleration jumps from -0.1382 rad/s^2 to -0.0540 and to -0.0691 rad/s^2.
# A TRAPEZOID's acceleration jumps unless it is rounded.  Nothing here limits jerk or checks limits: `safety` checks the
# reference.


ENDS_MEET_rad = 1e-9  # a table whose ends differ by more is not repeated: it would jump
# of a quintic of least jerk from rest to rest, in distance / duration and in distance / duration^2
QUINTIC_PEAK_SPEED = 1.875
QUINTIC_PEAK_ACCELERATION = 10.0 / math.sqrt(3.0)
_STEPS_BEFORE_SEARCH = 4


@kernel
def _rest_at(position_rad: float, reference: Reference) -> None:
    reference.position_rad = position_rad
    reference.velocity_radps = 0.0
    reference.acceleration_radps2 = 0.0
    reference.jerk_radps3 = 0.0
    reference.snap_radps4 = 0.0


@kernel
def _sine_at(c: TrajectoryConstants, t_s: float, reference: Reference) -> None:
    if c.switch_s > 0.0 and t_s >= c.switch_s:
        amplitude, omega, shift, offset = c.amplitude2_rad, c.omega2_radps, c.shift2_s, c.offset2_rad
    else:
        amplitude, omega, shift, offset = c.amplitude_rad, c.omega_radps, c.shift_s, c.offset_rad
    angle = omega * (t_s + shift)
    swing = amplitude * math.sin(angle)
    reference.position_rad = offset + swing
    reference.velocity_radps = amplitude * omega * math.cos(angle)
    reference.acceleration_radps2 = -omega * omega * swing
    reference.jerk_radps3 = -omega * omega * reference.velocity_radps
    reference.snap_radps4 = omega * omega * omega * omega * swing


@kernel
def _min_jerk_move(distance_rad: float, move_s: float, t_s: float, reference: Reference) -> None:
    """The quintic of least jerk between rests (Flash and Hogan 1985): 0 to `distance_rad` in 0 <= t <= move_s."""
    u = t_s / move_s
    rate = distance_rad / move_s
    reference.position_rad = distance_rad * u * u * u * (10.0 + u * (-15.0 + 6.0 * u))
    reference.velocity_radps = rate * u * u * (30.0 + u * (-60.0 + 30.0 * u))
    reference.acceleration_radps2 = rate / move_s * u * (60.0 + u * (-180.0 + 120.0 * u))
    reference.jerk_radps3 = rate / (move_s * move_s) * (60.0 + u * (-360.0 + 360.0 * u))
    reference.snap_radps4 = rate / (move_s * move_s * move_s) * (-360.0 + 720.0 * u)


@kernel
def trapezoid_times_s(distance_rad: float, speed_radps: float, acceleration_radps2: float) -> tuple[float, float]:
    """Times of accelerating and of constant speed for a distance >= 0; a short move is triangular (second time 0)."""
    ramp_s = speed_radps / acceleration_radps2
    if acceleration_radps2 * ramp_s * ramp_s >= distance_rad:
        return math.sqrt(distance_rad / acceleration_radps2), 0.0
    return ramp_s, distance_rad / speed_radps - ramp_s


@kernel
def _trapezoid_at(
    distance_rad: float, acceleration_radps2: float, ramp_s: float, cruise_s: float, t_s: float
) -> tuple[float, float, float, float]:
    """(integral [rad s], position, velocity, acceleration) from 0 to `distance_rad` (either sign), resting there."""
    acceleration = math.copysign(acceleration_radps2, distance_rad)
    speed = acceleration * ramp_s
    whole_s = 2.0 * ramp_s + cruise_s
    left_s = whole_s - t_s
    if not t_s > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    if not left_s > 0.0:
        return distance_rad * (t_s - 0.5 * whole_s), distance_rad, 0.0, 0.0
    if t_s < ramp_s:
        return acceleration * t_s * t_s * t_s / 6.0, 0.5 * acceleration * t_s * t_s, acceleration * t_s, acceleration
    if left_s > ramp_s:
        beyond_s = t_s - 0.5 * ramp_s
        integral = 0.5 * speed * (beyond_s * beyond_s + ramp_s * ramp_s / 12.0)
        return integral, speed * beyond_s, speed, 0.0
    # the end mirrors the beginning
    integral = distance_rad * (t_s - 0.5 * whole_s) + acceleration * left_s * left_s * left_s / 6.0
    return integral, distance_rad - 0.5 * acceleration * left_s * left_s, acceleration * left_s, -acceleration


@kernel
def _rounded_trapezoid(
    c: TrajectoryConstants, distance_rad: float, ramp_s: float, cruise_s: float, t_s: float, reference: Reference
) -> None:
    """The mean of the last `rounding_s`: the acceleration changes linearly; no limit is exceeded that was kept."""
    integral, position, velocity, acceleration = _trapezoid_at(
        distance_rad, c.acceleration_radps2, ramp_s, cruise_s, t_s
    )
    jerk = 0.0
    if c.rounding_s > 0.0:
        before = _trapezoid_at(distance_rad, c.acceleration_radps2, ramp_s, cruise_s, t_s - c.rounding_s)
        jerk = (acceleration - before[3]) / c.rounding_s
        acceleration = (velocity - before[2]) / c.rounding_s
        velocity = (position - before[1]) / c.rounding_s
        position = (integral - before[0]) / c.rounding_s
    reference.position_rad = position
    reference.velocity_radps = velocity
    reference.acceleration_radps2 = acceleration
    reference.jerk_radps3 = jerk
    reference.snap_radps4 = 0.0


@kernel
def _move_times_s(c: TrajectoryConstants) -> tuple[float, float, float]:
    """(whole move, accelerating, constant speed) of MIN_JERK and TRAPEZOID; the last two of a TRAPEZOID, else 0."""
    if c.kind != TrajectoryKind.TRAPEZOID:
        return c.move_s, 0.0, 0.0
    ramp_s, cruise_s = trapezoid_times_s(abs(c.target_rad - c.start_rad), c.speed_radps, c.acceleration_radps2)
    return 2.0 * ramp_s + cruise_s + c.rounding_s, ramp_s, cruise_s


@kernel
def _point_to_point_at(c: TrajectoryConstants, t_s: float, reference: Reference) -> None:
    """MIN_JERK and TRAPEZOID: start to target, and when repeated rest, back, rest, and so on."""
    distance = c.target_rad - c.start_rad
    move_s, ramp_s, cruise_s = _move_times_s(c)
    if not t_s > 0.0 or not move_s > 0.0:
        _rest_at(c.start_rad, reference)
        return
    from_rad = c.start_rad
    to_rad = c.target_rad
    if c.repeats != 0:
        leg_s = move_s + c.dwell_s
        t_s = t_s % (2.0 * leg_s)
        if t_s >= leg_s:
            t_s -= leg_s
            from_rad = c.target_rad
            to_rad = c.start_rad
            distance = -distance
    if t_s >= move_s:
        _rest_at(to_rad, reference)
        return
    if c.kind == TrajectoryKind.TRAPEZOID:
        _rounded_trapezoid(c, distance, ramp_s, cruise_s, t_s, reference)
    else:
        _min_jerk_move(distance, move_s, t_s, reference)
    reference.position_rad += from_rad


class Repetition(NamedTuple):
    """Where in a repeating motion a time is."""

    epoch: int  # changes where the motion changes: at a SINE's switch
    period_s: float  # 0 where nothing repeats
    local_s: float  # time in the period


NO_REPETITION = Repetition(0, 0.0, 0.0)


@kernel
def repetition(c: TrajectoryConstants, table: np.ndarray, t_s: float) -> Repetition:
    """Where in its repeating motion `t_s` is."""
    epoch = 0
    period_s = 0.0
    if t_s < 0.0:
        return NO_REPETITION
    if c.kind == TrajectoryKind.SINE:
        omega = c.omega_radps
        if c.switch_s > 0.0 and t_s >= c.switch_s:
            omega = c.omega2_radps
            epoch = 1
        period_s = 2.0 * math.pi / abs(omega) if omega != 0.0 else 0.0
    elif c.repeats != 0 and (c.kind == TrajectoryKind.MIN_JERK or c.kind == TrajectoryKind.TRAPEZOID):
        period_s = 2.0 * (_move_times_s(c)[0] + c.dwell_s)
    elif c.repeats != 0 and c.kind == TrajectoryKind.TABLE and c.table_rows >= 2:
        period_s = table[c.table_rows - 1, 0]
    if not period_s > 0.0:
        return Repetition(epoch, 0.0, 0.0)
    return Repetition(epoch, period_s, t_s % period_s)


@kernel
def _find_row(table: np.ndarray, rows: int, hint: int, t_s: float) -> int:
    """The row i in [0, rows - 2] with t0[i] <= t < t0[i + 1]; quick where the hint is near, else by bisection."""
    row = min(max(hint, 0), rows - 2)
    if table[row, 0] <= t_s:
        for _ in range(_STEPS_BEFORE_SEARCH):
            if row >= rows - 2 or t_s < table[row + 1, 0]:
                return row
            row += 1
        low = row
        high = rows - 1
    else:
        low = 0
        high = row
    while high - low > 1:
        middle = (low + high) // 2
        if table[middle, 0] <= t_s:
            low = middle
        else:
            high = middle
    return low


@kernel
def _table_at(c: TrajectoryConstants, table: np.ndarray, row_hint: int, t_s: float, reference: Reference) -> int:
    rows = min(c.table_rows, table.shape[0])
    if rows < 2:
        _rest_at(c.start_rad, reference)
        return 0
    first_s = table[0, 0]
    last_s = table[rows - 1, 0]
    first_rad = table[0, 1]
    last_rad = table[rows - 1, 1]
    if not t_s > first_s:
        _rest_at(first_rad, reference)
        return 0
    if t_s >= last_s:
        if c.repeats == 0 or abs(last_rad - first_rad) > ENDS_MEET_rad:
            _rest_at(last_rad, reference)
            return rows - 2
        t_s = first_s + (t_s - first_s) % (last_s - first_s)
    row = _find_row(table, rows, row_hint, t_s)
    d = t_s - table[row, 0]
    c1, c2, c3 = table[row, 2], table[row, 3], table[row, 4]
    reference.position_rad = table[row, 1] + d * (c1 + d * (c2 + d * c3))
    reference.velocity_radps = c1 + d * (2.0 * c2 + d * 3.0 * c3)
    reference.acceleration_radps2 = 2.0 * c2 + 6.0 * c3 * d
    reference.jerk_radps3 = 6.0 * c3
    reference.snap_radps4 = 0.0
    return row


@kernel
def reference_at(c: TrajectoryConstants, table: np.ndarray, row_hint: int, t_s: float, reference: Reference) -> int:
    """Fill `reference` with the desired motion at time `t_s`; returns the row hint for the next call.

    `table` is float64 of shape (rows, 5): t0 [s], then c0..c3 of the cubic c0 + c1 d + c2 d^2 + c3 d^3 with d = t - t0,
    valid until the next row's t0; the last row is the end.  Kinds without a table ignore it (shape (0, 5) will do).
    Before the start and after the end of a motion from rest to rest the reference rests there.  A SINE has no start:
    its velocity at t = 0 is not zero (see `plan_approach`).  A repeated table whose ends do not meet stays at its end.
    """
    kind = c.kind
    if kind == TrajectoryKind.SINE:
        _sine_at(c, t_s, reference)
        return row_hint
    if kind == TrajectoryKind.MIN_JERK or kind == TrajectoryKind.TRAPEZOID:
        _point_to_point_at(c, t_s, reference)
        return row_hint
    if kind == TrajectoryKind.TABLE:
        return _table_at(c, table, row_hint, t_s, reference)
    _rest_at(c.start_rad, reference)
    return row_hint


@kernel
def plan_approach(
    position_rad: float, target_reference: Reference, duration_s: float, coefficients: np.ndarray
) -> None:
    """Quintic from rest at `position_rad` to position, velocity and acceleration of the target after `duration_s`.

    Fills `coefficients` (float64[6], ascending powers of t).  A duration that is not positive gives rest at the start.
    """
    coefficients[:] = 0.0
    coefficients[0] = position_rad
    if not duration_s > 0.0:
        return
    distance = target_reference.position_rad - position_rad
    speed = target_reference.velocity_radps * duration_s
    bend = target_reference.acceleration_radps2 * duration_s * duration_s
    cube = duration_s * duration_s * duration_s
    coefficients[3] = (10.0 * distance - 4.0 * speed + 0.5 * bend) / cube
    coefficients[4] = (-15.0 * distance + 7.0 * speed - bend) / (cube * duration_s)
    coefficients[5] = (6.0 * distance - 3.0 * speed + 0.5 * bend) / (cube * duration_s * duration_s)


@kernel
def approach_at(coefficients: np.ndarray, t_s: float, reference: Reference) -> None:
    """Fill `reference` from the quintic at 0 <= t <= its duration (the caller ends it; before 0 it rests)."""
    a = coefficients
    t = max(t_s, 0.0)
    reference.position_rad = a[0] + t * (a[1] + t * (a[2] + t * (a[3] + t * (a[4] + t * a[5]))))
    reference.velocity_radps = a[1] + t * (2.0 * a[2] + t * (3.0 * a[3] + t * (4.0 * a[4] + t * 5.0 * a[5])))
    reference.acceleration_radps2 = 2.0 * a[2] + t * (6.0 * a[3] + t * (12.0 * a[4] + t * 20.0 * a[5]))
    reference.jerk_radps3 = 6.0 * a[3] + t * (24.0 * a[4] + t * 60.0 * a[5])
    reference.snap_radps4 = 24.0 * a[4] + t * 120.0 * a[5]


@kernel
def cubic(before: SetPoint, after: SetPoint) -> tuple[float, float, float]:
    """(duration [s], c2, c3) of p = p0 + v0 d + c2 d^2 + c3 d^3 between two set-points (Hermite)."""
    duration_s = (after.time_ns - before.time_ns) * 1e-9
    rate = (after.position_rad - before.position_rad) / duration_s
    v0, v1 = before.velocity_radps, after.velocity_radps
    return duration_s, (3.0 * rate - 2.0 * v0 - v1) / duration_s, (v0 + v1 - 2.0 * rate) / (duration_s * duration_s)


@kernel
def extremes_s(v0: float, c2: float, c3: float, duration_s: float) -> tuple[float, float, float]:
    """Times of that cubic: (its velocity is greatest, it turns back, it turns back); `duration_s` where it does not.

    The latter are the roots of v0 + 2 c2 d + 3 c3 d^2, the nearer one without a difference of large numbers.
    """
    quickest_s = turn_s = other_turn_s = duration_s
    if c3 != 0.0:
        quickest_s = -c2 / (3.0 * c3)
    under_root = c2 * c2 - 3.0 * c3 * v0
    if under_root >= 0.0:
        larger = -(c2 + math.copysign(math.sqrt(under_root), c2))
        if larger != 0.0:
            turn_s = v0 / larger
        if c3 != 0.0:
            other_turn_s = larger / (3.0 * c3)
    return quickest_s, turn_s, other_turn_s


@kernel
def brake_step(reference: Reference, brake_radps2: float, period_s: float) -> None:
    """Advance a controlled stop by one period: constant deceleration down to a velocity of exactly zero.

    The acceleration is that of this step, and position and velocity are its exact integrals.  The last step
    decelerates by less, so that it ends in standstill at its end; the next one rests.  A brake that is not positive
    stops at once: a stop that never ends is worse than a jump.
    """
    velocity = reference.velocity_radps
    if not brake_radps2 > 0.0 or not period_s > 0.0:
        _rest_at(reference.position_rad, reference)
        return
    if abs(velocity) <= brake_radps2 * period_s:
        acceleration = -velocity / period_s
        next_velocity = 0.0
    else:
        acceleration = -math.copysign(brake_radps2, velocity)
        next_velocity = velocity + acceleration * period_s
    reference.position_rad += 0.5 * (velocity + next_velocity) * period_s
    reference.velocity_radps = next_velocity
    reference.acceleration_radps2 = acceleration
    reference.jerk_radps3 = 0.0
    reference.snap_radps4 = 0.0


# --- A table from points, with a cubic spline through them ---
# Plain Python, joint side, SI units.


def spline_table(time_s: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
    """The table of `reference_at`, float64 (N, 5), from ascending times and places (N,), N >= 2; the last row ends it.

    A cubic spline at rest at both ends; velocity and acceleration are continuous between.  ValueError where the
    steps of time are too short for one.
    """
    from scipy.interpolate import CubicSpline  # here: every start of a run would wait a third of a second for it

    table = np.zeros((len(time_s), 5))
    table[:, 0] = time_s
    table[-1, 1] = position_rad[-1]
    with np.errstate(all="ignore"), contextlib.suppress(ValueError, np.linalg.LinAlgError):
        table[:-1, 1:] = CubicSpline(time_s, position_rad, bc_type="clamped").c[::-1].T
        if np.all(np.isfinite(table)):
            return table
    closest = float(np.min(np.diff(time_s)))
    raise ValueError(f"the smallest time step (={closest:g} s) must be longer, no spline can be computed")


def quintic_s(way_rad: float, speed_radps: float, acceleration_radps2: float) -> float:
    """Of a quintic of least jerk from rest to rest that keeps to both."""
    of_acceleration_s = math.sqrt(QUINTIC_PEAK_ACCELERATION * way_rad / acceleration_radps2)
    return max(QUINTIC_PEAK_SPEED * way_rad / speed_radps, of_acceleration_s)


def eased(share: np.ndarray) -> np.ndarray:
    """0 to 1 with continuous acceleration, and rest outside: the quintic of a move."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 + u * (-15.0 + 6.0 * u)))


def ends_meet(table: np.ndarray) -> bool:
    """Whether the table can be repeated: it ends where it starts (both ends are at rest)."""
    return len(table) >= 2 and abs(float(table[-1, 1] - table[0, 1])) <= ENDS_MEET_rad


# --- What a desired motion demands at most, and how long an approach to it takes: known before anything moves ---
# Plain Python, joint side, SI units.  Errors are ValueError with one line that names the value and what is allowed.


NO_TABLE = np.zeros((0, 5))
_LONGEST_APPROACH_s = 3600.0


class MotionPeak(NamedTuple):
    """What a motion demands: its range, and the greatest magnitudes of velocity and acceleration."""

    position_min_rad: float
    position_max_rad: float
    velocity_radps: float
    acceleration_radps2: float


def _sine_range(from_rad: float, to_rad: float) -> tuple[float, float]:
    """Least and greatest value of sin over an interval of angles, which may end at infinity."""
    if to_rad < from_rad:
        from_rad, to_rad = to_rad, from_rad
    if to_rad - from_rad >= 2.0 * math.pi:
        return -1.0, 1.0
    ends = (math.sin(from_rad), math.sin(to_rad))
    crest = math.ceil((from_rad - 0.5 * math.pi) / (2.0 * math.pi)) * 2.0 * math.pi + 0.5 * math.pi
    trough = math.ceil((from_rad + 0.5 * math.pi) / (2.0 * math.pi)) * 2.0 * math.pi - 0.5 * math.pi
    return (-1.0 if trough <= to_rad else min(ends)), (1.0 if crest <= to_rad else max(ends))


def _sine_peak(amplitude: float, omega: float, shift: float, offset: float, from_s: float, to_s: float) -> MotionPeak:
    start = omega * (from_s + shift)
    end = math.copysign(math.inf, omega) if math.isinf(to_s) and omega != 0.0 else omega * (min(to_s, 1e300) + shift)
    sines, cosines = _sine_range(start, end), _sine_range(start + 0.5 * math.pi, end + 0.5 * math.pi)
    ends = (offset + amplitude * sines[0], offset + amplitude * sines[1])
    velocity = abs(amplitude * omega) * max(map(abs, cosines))
    return MotionPeak(min(ends), max(ends), velocity, abs(amplitude) * omega**2 * max(map(abs, sines)))


def _joined(first: MotionPeak, second: MotionPeak) -> MotionPeak:
    return MotionPeak(
        min(first[0], second[0]), max(first[1], second[1]), max(first[2], second[2]), max(first[3], second[3])
    )


def _table_peak(table: np.ndarray) -> MotionPeak:
    steps = np.diff(table[:, 0])
    c0, c1, c2, c3 = table[:-1, 1:].T

    def at(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inside = np.where(np.isfinite(d), np.clip(d, 0.0, steps), 0.0)
        return c0 + inside * (c1 + inside * (c2 + inside * c3)), c1 + inside * (2.0 * c2 + 3.0 * c3 * inside)

    with np.errstate(all="ignore"):
        # turning points of the position: roots of c1 + 2 c2 d + 3 c3 d^2, in the form that survives c3 = 0
        half = -(c2 + np.copysign(np.sqrt(np.maximum(c2 * c2 - 3.0 * c1 * c3, 0.0)), c2))
        candidates = (np.zeros_like(steps), steps, half / (3.0 * c3), c1 / half, -c2 / (3.0 * c3))
    values = [at(d) for d in candidates]
    positions = np.concatenate([value[0] for value in values])
    velocities = np.concatenate([value[1] for value in values])
    accelerations = np.concatenate([2.0 * c2, 2.0 * c2 + 6.0 * c3 * steps])
    greatest = (float(np.max(np.abs(velocities))), float(np.max(np.abs(accelerations))))
    return MotionPeak(float(np.min(positions)), float(np.max(positions)), *greatest)


def peak_of(constants: TrajectoryConstants, table: np.ndarray = NO_TABLE) -> MotionPeak:
    """What the trajectory demands at most, from its formula and not from samples; for the motion envelope.

    A SINE over the run's duration (without end if 0); the other kinds over a whole move or the whole table, even where
    the run ends earlier.  The approach is not in it.
    """
    c: Any = constants
    if c.kind == TrajectoryKind.SINE:
        run_s = float(c.duration_s) if c.duration_s > 0.0 else math.inf
        switch_s = float(c.switch_s) if 0.0 < c.switch_s <= run_s else run_s
        first = (float(c.amplitude_rad), float(c.omega_radps), float(c.shift_s), float(c.offset_rad))
        peak = _sine_peak(*first, 0.0, switch_s)
        if 0.0 < c.switch_s <= run_s:
            second = (float(c.amplitude2_rad), float(c.omega2_radps), float(c.shift2_s), float(c.offset2_rad))
            peak = _joined(peak, _sine_peak(*second, switch_s, run_s))
        return peak
    rows = min(int(c.table_rows), len(table))
    if c.kind == TrajectoryKind.TABLE and rows >= 2:
        return _table_peak(table[:rows])
    start = float(c.start_rad)
    if c.kind in (TrajectoryKind.HOLD, TrajectoryKind.TABLE):
        return MotionPeak(start, start, 0.0, 0.0)
    target = float(c.target_rad)
    distance = abs(target - start)
    low, high = min(start, target), max(start, target)
    if distance == 0.0:
        return MotionPeak(low, high, 0.0, 0.0)
    if c.kind == TrajectoryKind.MIN_JERK:
        move_s = float(c.move_s)
        speed, acceleration = QUINTIC_PEAK_SPEED / move_s, QUINTIC_PEAK_ACCELERATION / move_s**2
        return MotionPeak(low, high, speed * distance, acceleration * distance)
    ramp_s, _ = trapezoid_times_s(distance, float(c.speed_radps), float(c.acceleration_radps2))
    return MotionPeak(low, high, float(c.acceleration_radps2 * ramp_s), float(c.acceleration_radps2))


def _quadratic_roots(a: float, b: float, c: float) -> list[float]:
    if a == 0.0:
        return [] if b == 0.0 else [-c / b]
    inside = b * b - 4.0 * a * c
    if inside < 0.0:
        return []
    half = -0.5 * (b + math.copysign(math.sqrt(inside), b))
    return [half / a] if half == 0.0 else [half / a, c / half]


def approach_peak(position_rad: float, target_reference: Reference, duration_s: float) -> MotionPeak:
    """What the approach of `plan_approach` demands at most; it may swing back to gain the target's velocity."""
    coefficients = np.zeros(6)
    plain(plan_approach)(position_rad, target_reference, duration_s, coefficients)
    position = np.polynomial.Polynomial(coefficients)
    c3, c4, c5 = (float(value) for value in coefficients[3:])
    ends = [0.0, duration_s]
    # besides t = 0: velocity 3 c3 + 4 c4 t + 5 c5 t^2, acceleration 6 c3 + 12 c4 t + 20 c5 t^2, jerk likewise
    turning = (
        _quadratic_roots(5.0 * c5, 4.0 * c4, 3.0 * c3),
        _quadratic_roots(20.0 * c5, 12.0 * c4, 6.0 * c3),
        _quadratic_roots(60.0 * c5, 24.0 * c4, 6.0 * c3),
    )
    inside = [np.array(ends + [t for t in roots if 0.0 < t < duration_s]) for roots in turning]
    positions = position(inside[0])
    velocity = float(np.max(np.abs(position.deriv()(inside[1]))))
    acceleration = float(np.max(np.abs(position.deriv(2)(inside[2]))))
    return MotionPeak(float(np.min(positions)), float(np.max(positions)), velocity, acceleration)


def approach_duration_s(
    position_rad: float,
    target_reference: Reference,
    velocity_max_radps: float,
    acceleration_max_radps2: float,
    minimum_s: float = 0.1,
) -> float:
    """Shortest duration, not below `minimum_s`, of an approach within both limits, to 0.1 %.

    ValueError if the target's own velocity or acceleration is above a limit, or if no duration will do: a target with
    an acceleration makes a long approach swing far; starting nearer or higher limits help.
    """
    for name, value, limit in (
        ("velocity_radps", target_reference.velocity_radps, velocity_max_radps),
        ("acceleration_radps2", target_reference.acceleration_radps2, acceleration_max_radps2),
    ):
        if not abs(value) <= limit:
            raise ValueError(f"{name} (={value:g}) at the trajectory start must be in [{-limit:g}..{limit:g}]")

    def fits(duration_s: float) -> bool:
        peak = approach_peak(position_rad, target_reference, duration_s)
        within = peak.velocity_radps <= velocity_max_radps * (1.0 + 1e-9)
        return within and peak.acceleration_radps2 <= acceleration_max_radps2 * (1.0 + 1e-9)

    too_short_s, long_enough_s = 0.0, minimum_s
    while not fits(long_enough_s):
        too_short_s, long_enough_s = long_enough_s, 1.1 * long_enough_s
        if long_enough_s > _LONGEST_APPROACH_s:
            distance = target_reference.position_rad - position_rad
            within = f"{velocity_max_radps:g} rad/s and {acceleration_max_radps2:g} rad/s^2"
            raise ValueError(f"approach distance (={distance:g} rad) cannot be covered by one quintic within {within}")
    while too_short_s > 0.0 and long_enough_s - too_short_s > 1e-3 * long_enough_s:
        middle_s = 0.5 * (too_short_s + long_enough_s)
        too_short_s, long_enough_s = (too_short_s, middle_s) if fits(middle_s) else (middle_s, long_enough_s)
    return long_enough_s


def approach_start(constants: TrajectoryConstants, table: np.ndarray = NO_TABLE) -> Any:
    """A `Reference` record of the trajectory at t = 0, the target of an approach."""
    reference = new(Reference)[0]
    plain(reference_at)(constants, table, 0, 0.0, reference)
    return reference
