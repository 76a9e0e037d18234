"""Motions that never repeat, for studies: no law can learn them from one repetition to the next.

    multi_sine      six sines of 0.1 to 1.4 Hz with random phases, scaled to the joint's range and speed
    point_to_point  quintics between random places, 0.4 to 1 s of rest after each
    reversals       a spline through random turning points, 0.08 to 0.4 s apart, that never rests
    creep           0.001 rad/s, back and forth, turning every 5 to 15 s

Each is drawn from a seed and the number of the plant, begins and ends at rest, and is a table of `reference_at`:
position, velocity and acceleration are continuous.  No motion is faster than SPEED_radps and ACCELERATION_radps2, nor
farther than REACH_rad from zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from jointctl.firmware_py.trajectory import QUINTIC_PEAK_ACCELERATION, QUINTIC_PEAK_SPEED, eased, spline_table

RandomMotion = Literal["multi_sine", "point_to_point", "reversals", "creep"]
RANDOM_MOTIONS: tuple[RandomMotion, ...] = get_args(RandomMotion)
REACH_rad = 0.35  # that of the sine, which the limits of the shipped configurations leave room for
SPEED_radps = 0.8
ACCELERATION_radps2 = 4.0
FREQUENCIES_Hz = (0.1, 1.4)  # of the multi-sine, log-uniform
TURNS_s = (0.08, 0.4)  # between two reversals
CREEP_radps = 0.001
_ROW_S = 0.005  # of motions that are sampled: the spline between is 1e-9 rad off
_ROWS_OF_MOVES = 5  # of each of these, where a quintic begins or ends: a spline rings there, below 1e-6 rad/s
_NO_RESTS = np.zeros((0, 2))
_EASE_S = 2.0  # in which a motion that does not begin at rest is faded in


@dataclass(frozen=True)
class Motion:
    """The table float64 (N, 5), and when it rests: begin and end [s], float64 (M, 2)."""

    kind: RandomMotion
    table: np.ndarray
    rests_s: np.ndarray


def _within_limits(table: np.ndarray) -> np.ndarray:
    """The same motion, smaller by as much as the limits ask for."""
    inside = np.linspace(0.0, 1.0, 9)[:, None] * np.diff(table[:, 0])
    _, c0, c1, c2, c3 = table[:-1].T
    reach = np.max(np.abs(c0 + inside * (c1 + inside * (c2 + inside * c3)))) / REACH_rad
    speed = np.max(np.abs(c1 + inside * (2.0 * c2 + inside * 3.0 * c3))) / SPEED_radps
    acceleration = np.max(np.abs(2.0 * c2 + inside * 6.0 * c3)) / ACCELERATION_radps2
    scaled = table.copy()
    scaled[:, 1:] /= max(reach, speed, acceleration)
    return scaled


def _multi_sine(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.linspace(0.0, duration_s, round(duration_s / _ROW_S) + 1)
    position = np.zeros_like(time_s)
    for _ in range(6):
        frequency_Hz = math.exp(random.uniform(*np.log(FREQUENCIES_Hz)))
        amplitude = random.uniform(0.3, 1.0) / frequency_Hz
        position += amplitude * np.sin(math.tau * (frequency_Hz * time_s + random.uniform()))
    position *= eased(time_s / _EASE_S) * eased((duration_s - time_s) / _EASE_S)
    return _within_limits(spline_table(time_s, position)), _NO_RESTS


def _reversals(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    times, places = [0.0], [0.0]
    side = 1.0
    while times[-1] < duration_s:
        times.append(times[-1] + random.uniform(*TURNS_s))
        places.append(side * random.uniform(0.02, 0.3) * (times[-1] - times[-2]))
        side = -side
    return _within_limits(spline_table(np.array(times), np.array(places))), _NO_RESTS


def _sampled(moves: list[tuple[float, float, float]], duration_s: float) -> np.ndarray:
    """A table of quintics (begin [s], end [s], distance [rad]), one after the other, from zero."""
    time_s = np.linspace(0.0, duration_s, _ROWS_OF_MOVES * round(duration_s / _ROW_S) + 1)
    position = np.zeros_like(time_s)
    for begin_s, end_s, distance_rad in moves:
        position += distance_rad * eased((time_s - begin_s) / (end_s - begin_s))
    return spline_table(time_s, position)


def _point_to_point(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    moves: list[tuple[float, float, float]] = []
    rests: list[tuple[float, float]] = []
    now_s, place = 0.5, 0.0
    while True:
        target = random.uniform(-REACH_rad, REACH_rad)
        size = abs(target - place)
        slowness = random.uniform(1.0, 3.0)
        move_s = slowness * max(
            QUINTIC_PEAK_SPEED * size / SPEED_radps, math.sqrt(QUINTIC_PEAK_ACCELERATION * size / ACCELERATION_radps2)
        )
        rest_s = random.uniform(0.4, 1.0)
        # on rows, so that the spline has no corner between two
        end_s = round((now_s + move_s) / _ROW_S) * _ROW_S
        after_s = round((end_s + rest_s) / _ROW_S) * _ROW_S
        if after_s > duration_s:
            return _sampled(moves, duration_s), np.array(rests).reshape(-1, 2)
        moves.append((now_s, end_s, target - place))
        rests.append((end_s, after_s))
        now_s, place = after_s, target


def _creep(random: np.random.Generator, duration_s: float) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.linspace(0.0, duration_s, round(duration_s / _ROW_S) + 1)
    speed = np.zeros_like(time_s)
    turn_s, side = 0.5, 1.0
    while turn_s < duration_s:
        speed += side * eased((time_s - turn_s) / 0.2) * (2.0 if turn_s > 0.5 else 1.0)
        turn_s, side = turn_s + random.uniform(5.0, 15.0), -side
    speed *= CREEP_radps * eased((duration_s - 0.5 - time_s) / 0.2)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s))))
    return spline_table(time_s, position), _NO_RESTS


_DRAWN: dict[RandomMotion, Callable[[np.random.Generator, float], tuple[np.ndarray, np.ndarray]]] = {
    "multi_sine": _multi_sine,
    "point_to_point": _point_to_point,
    "reversals": _reversals,
    "creep": _creep,
}


def random_motion(kind: RandomMotion, seed: int, index: int, duration_s: float) -> Motion:
    """The motion of this kind for plant `index` of the study with this seed; at least `duration_s` long."""
    # a stream of its own: plants and motions do not depend on each other
    random = np.random.default_rng([seed, index, 1 + RANDOM_MOTIONS.index(kind)])
    return Motion(kind, *_DRAWN[kind](random, duration_s))
