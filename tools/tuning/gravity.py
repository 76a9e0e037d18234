"""Gravity of a joint from a motion back and forth at constant speed: what the torque has in common in both directions.

    torque = F+ or F- by direction + a sin q + b cos q,    gravity_Nm sin(q - gravity_zero_rad) = a sin q + b cos q

The friction of a direction is a constant, because the legs of the motion hardly differ in speed; what it does besides
is noise.  Neighbouring samples are alike, so that the interval counts a sample for each turn of the ripple.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.tools.tuning.excitation import ResponsePlan

LEAST_Nm = 0.5  # less is no gravity
SURE = 4.0  # standard errors
BLOCK_rad = 0.1  # of the way, one independent value each


@dataclass(frozen=True)
class Gravity:
    """Amplitude with its interval, angle without lever; `found` where it is more than friction may look like."""

    torque_Nm: float
    half_Nm: float
    zero_rad: float

    @property
    def found(self) -> bool:
        return abs(self.torque_Nm) > max(LEAST_Nm, 0.5 * SURE * self.half_Nm)


def gravity_of(plan: ResponsePlan, records: Any, period_s: float, zero_rad: float) -> Gravity:
    """Of the legs of a frequency response, whose multisine has no mean over its period.

    Over the way of a joint the cosine is hardly told from the friction's asymmetry: where it is not sure, the angle
    without lever is the configured `zero_rad`.
    """
    cycle = np.round(np.asarray(records.trajectory_s) / period_s).astype(int)
    position, torque, sides = [], [], []
    for start in plan.legs.starts:
        first, last = np.searchsorted(cycle, (start, start + plan.samples))
        rows = records[first:last]
        if len(rows) < 0.99 * plan.samples:
            continue
        way = abs(float(rows.position_rad[-1] - rows.position_rad[0]))
        excitation = plan.peak_Nm * plan.sine.wave[np.asarray(cycle[first:last]) % plan.samples]
        for part in np.array_split(np.arange(len(rows)), max(round(way / BLOCK_rad), 2)):
            position.append(float(np.mean(rows.position_rad[part])))
            torque.append(float(np.mean(rows.command_torque_Nm[part] - excitation[part])))
            sides.append(math.copysign(1.0, rows.desired_velocity_radps[part[0]]))
    angle, side = np.array(position) - zero_rad, np.array(sides)
    constant = np.column_stack((side > 0.0, side < 0.0)).astype(float)
    both, spread = _fitted(np.column_stack((constant, np.sin(angle), np.cos(angle))), np.array(torque))
    if abs(both[3]) > SURE * spread[3]:
        size = math.hypot(both[2], both[3])
        return Gravity(size, 2.0 * float(np.max(spread[2:])), zero_rad + math.atan2(-both[3], both[2]))
    one, spread = _fitted(np.column_stack((constant, np.sin(angle))), np.array(torque))
    return Gravity(float(one[2]), 2.0 * float(spread[2]), zero_rad)


def _fitted(columns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(least squares, standard errors)."""
    found, *_ = np.linalg.lstsq(columns, values, rcond=None)
    left = values - columns @ found
    variance = float(left @ left) / max(len(values) - columns.shape[1], 1)
    return found, np.sqrt(variance * np.diag(np.linalg.pinv(columns.T @ columns)))
