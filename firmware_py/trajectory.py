"""The desired motion: position, velocity and acceleration of the joint at a given time, and the ways in and out of it.

Joint side, rad, rad/s, rad/s^2, time in s since the trajectory began.  Each kind of `TrajectoryKind` is a formula or a
table; nothing is filtered, so that the three quantities belong together exactly.

The paper's changes are a SINE with a second set of numbers from 82.5 s on, the time running through:
0.35 sin(0.2 pi t) to 0.35 sin(0.125 pi (t + 1.5)), and to 0.175 sin(0.2 pi t) + 0.175.  Both happen at a crest:
position (0.35 rad) and velocity (0) are continuous, the acceleration jumps from -0.1382 rad/s^2 to -0.0540 and to
-0.0691 rad/s^2.
A TRAPEZOID's acceleration jumps by design.  Nothing here limits jerk or checks limits: `safety` checks the reference.
"""

from __future__ import annotations

import math

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.states import TrajectoryKind

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


@kernel
def _min_jerk_move(distance_rad: float, move_s: float, t_s: float, reference: Reference) -> None:
    """The quintic of least jerk between rests (Flash and Hogan 1985): 0 to `distance_rad` in 0 <= t <= move_s."""
    u = t_s / move_s
    rate = distance_rad / move_s
    reference.position_rad = distance_rad * u * u * u * (10.0 + u * (-15.0 + 6.0 * u))
    reference.velocity_radps = rate * u * u * (30.0 + u * (-60.0 + 30.0 * u))
    reference.acceleration_radps2 = rate / move_s * u * (60.0 + u * (-180.0 + 120.0 * u))


@kernel
def trapezoid_times_s(distance_rad: float, speed_radps: float, acceleration_radps2: float) -> tuple[float, float]:
    """Times of accelerating and of constant speed for a distance >= 0; a short move is triangular (second time 0)."""
    ramp_s = speed_radps / acceleration_radps2
    if acceleration_radps2 * ramp_s * ramp_s >= distance_rad:
        return math.sqrt(distance_rad / acceleration_radps2), 0.0
    return ramp_s, distance_rad / speed_radps - ramp_s


@kernel
def _trapezoid_move(
    distance_rad: float, acceleration_radps2: float, ramp_s: float, cruise_s: float, t_s: float, reference: Reference
) -> None:
    """From 0 to `distance_rad` (either sign) for 0 <= t <= 2 ramp_s + cruise_s."""
    acceleration = math.copysign(acceleration_radps2, distance_rad)
    speed = acceleration * ramp_s
    left_s = 2.0 * ramp_s + cruise_s - t_s
    if t_s < ramp_s:
        reference.position_rad = 0.5 * acceleration * t_s * t_s
        reference.velocity_radps = acceleration * t_s
        reference.acceleration_radps2 = acceleration
    elif left_s > ramp_s:
        reference.position_rad = speed * (t_s - 0.5 * ramp_s)
        reference.velocity_radps = speed
        reference.acceleration_radps2 = 0.0
    else:
        reference.position_rad = distance_rad - 0.5 * acceleration * left_s * left_s
        reference.velocity_radps = acceleration * left_s
        reference.acceleration_radps2 = -acceleration


@kernel
def _point_to_point_at(c: TrajectoryConstants, t_s: float, reference: Reference) -> None:
    """MIN_JERK and TRAPEZOID: start to target, and when repeated rest, back, rest, and so on."""
    distance = c.target_rad - c.start_rad
    ramp_s = 0.0
    cruise_s = 0.0
    move_s = c.move_s
    if c.kind == TrajectoryKind.TRAPEZOID:
        ramp_s, cruise_s = trapezoid_times_s(abs(distance), c.speed_radps, c.acceleration_radps2)
        move_s = 2.0 * ramp_s + cruise_s
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
        _trapezoid_move(distance, c.acceleration_radps2, ramp_s, cruise_s, t_s, reference)
    else:
        _min_jerk_move(distance, move_s, t_s, reference)
    reference.position_rad += from_rad


@kernel
def repetition(c: TrajectoryConstants, table: np.ndarray, t_s: float) -> tuple[int, float, float]:
    """(epoch, period [s], time in the period [s]): where in a repeating motion `t_s` is; period 0 if none repeats.

    The epoch changes where the motion changes: at a SINE's switch.
    """
    epoch = 0
    period_s = 0.0
    if t_s < 0.0:
        return epoch, 0.0, 0.0
    if c.kind == TrajectoryKind.SINE:
        omega = c.omega_radps
        if c.switch_s > 0.0 and t_s >= c.switch_s:
            omega = c.omega2_radps
            epoch = 1
        period_s = 2.0 * math.pi / abs(omega) if omega != 0.0 else 0.0
    elif c.repeats != 0 and (c.kind == TrajectoryKind.MIN_JERK or c.kind == TrajectoryKind.TRAPEZOID):
        move_s = c.move_s
        if c.kind == TrajectoryKind.TRAPEZOID:
            ramp_s, cruise_s = trapezoid_times_s(abs(c.target_rad - c.start_rad), c.speed_radps, c.acceleration_radps2)
            move_s = 2.0 * ramp_s + cruise_s
        period_s = 2.0 * (move_s + c.dwell_s)
    elif c.repeats != 0 and c.kind == TrajectoryKind.TABLE and c.table_rows >= 2:
        period_s = table[c.table_rows - 1, 0]
    if not period_s > 0.0:
        return epoch, 0.0, 0.0
    return epoch, period_s, t_s % period_s


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
