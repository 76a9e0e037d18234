"""The motion of `jointctl sweep` as a scenario: a few plateaus of constant speed, in the mode in which a sweep runs.

The drive closes the velocity loop where it can (CSV, else PV), as for the verb; else the law that a sweep uses does.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.tools.configuration.config import Config
from jointctl.tools.simulation.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import (
    VELOCITY_MODES,
    middle_rad,
    position_margin_rad,
    sweep_constants,
    with_tracking_law,
)
from jointctl.tools.sweeping.grid import SweepPoint
from jointctl.tools.sweeping.options import ACCELERATION_SHARE
from jointctl.tools.sweeping.plan import PlanSettings, plan_motion, shifted

SLOWEST_SHARE, FASTEST_SHARE = 0.03, 0.5  # of limits.velocity_max_radps; a real sweep goes up to 0.9 of it
SETTLE_s = 0.1
LONGEST_s = 8.0  # of such a motion, about


@dataclass(frozen=True)
class SweepStrokes:
    """Plateaus in their order: speeds as signed shares of the velocity limit, and the time of measuring wanted."""

    shares: tuple[float, ...]
    dwell_s: float


def draw_strokes(random: np.random.Generator) -> SweepStrokes:
    """One or two speeds, each in both directions."""
    shares = [float(random.uniform(SLOWEST_SHARE, FASTEST_SHARE)) for _ in range(int(random.integers(1, 3)))]
    return SweepStrokes(
        tuple(signed for share in shares for signed in (share, -share)), float(random.uniform(0.1, 0.3))
    )


@dataclass(frozen=True)
class PlacedSweep:
    """What a lockstep run needs of it."""

    constants: Any  # AxisConstants, a record array of one
    table: np.ndarray
    start_rad: float
    duration_s: float


def placed_sweep(config: Config, joint: LockstepJoint, strokes: SweepStrokes, start_offset_rad: float) -> PlacedSweep:
    """The motion about the middle of the travel; the joint stands `start_offset_rad` beside it."""
    limits = config.limits
    width_rad = limits.position_max_rad - limits.position_min_rad - 2.0 * position_margin_rad(config)
    speeds = [share * limits.velocity_max_radps for share in strokes.shares]
    settings = PlanSettings(
        width_rad, ACCELERATION_SHARE * config.sequence.brake_radps2, max(map(abs, speeds)), strokes.dwell_s, SETTLE_s,
        config.joint.reduction_ratio,
    )  # fmt: skip
    motion = plan_motion([SweepPoint(i, speed, 0) for i, speed in enumerate(speeds)], settings)
    middle = middle_rad(config, motion, 0.5 * (limits.position_min_rad + limits.position_max_rad))
    placed = shifted(motion, middle)
    start_rad = middle + start_offset_rad
    if joint.report.mode not in VELOCITY_MODES:
        config = with_tracking_law(config)
    constants = sweep_constants(config, dataclasses.replace(joint.report, start_position_rad=start_rad), placed)
    return PlacedSweep(constants, placed.table, start_rad, placed.duration_s)
