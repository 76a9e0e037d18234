"""What a desired motion demands at most, and how long an approach to it takes: known before anything moves.

Plain Python, joint side, SI units.  Errors are ValueError with one line that names the value and what is allowed.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import (
    QUINTIC_PEAK_ACCELERATION,
    QUINTIC_PEAK_SPEED,
    plan_approach,
    reference_at,
    trapezoid_times_s,
)

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
    plan_approach(position_rad, target_reference, duration_s, coefficients)
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
    reference_at(constants, table, 0, 0.0, reference)
    return reference
