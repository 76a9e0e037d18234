"""Picks the samples of every window out of the stream of log records and completes the points, one by one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.sweeping.grid import SweepPoint
from jointctl.tools.sweeping.plan import Window
from jointctl.tools.sweeping.statistics import LEAST_SAMPLES, PlateauResult, Samples, Tolerance, plateau

FEWEST_IN_WINDOW = 2


@dataclass(frozen=True)
class JointModel:
    """What the measured torque needs to become friction at the motor."""

    reduction_ratio: float
    gravity_Nm: float
    gravity_zero_rad: float
    resolution_rad: float  # of the position
    orders_prad: tuple[float, ...]  # ripple periods per joint radian


@dataclass(frozen=True)
class MeasuredPoint:
    point: SweepPoint
    result: PlateauResult
    time_s: float  # trajectory time at the end of its last window
    temperature_degC: float | None = None  # of the drive, if it tells one


class SweepMeter:
    """`feed` it every log record in order; `on_point` is called as soon as the last window of a point is over."""

    def __init__(
        self,
        windows: tuple[Window, ...],
        model: JointModel,
        on_point: Callable[[MeasuredPoint], None],
    ) -> None:
        self._windows = windows
        self._model = model
        self.tolerance = Tolerance(0.01, 0.0)  # set once the drive's resolution is known
        self.temperature_degC: float | None = None  # the drive's newest, set before `feed`
        self._on_point = on_point
        self._next = 0
        self._chunks: list[np.ndarray] = []
        self._open: dict[int, list[Samples]] = {}
        self.lost_points: list[SweepPoint] = []

    @property
    def current(self) -> SweepPoint | None:
        """The point whose window is under way or comes next; None after the last."""
        return self._windows[self._next].point if self._next < len(self._windows) else None

    def feed(self, records: Any) -> None:
        """Log records (recarray); only those of the motion itself with a fresh sample count."""
        use = (records.phase == AxisPhase.TRACKING) & (records.sample_age_cycles == 0)
        if not np.any(use):
            return
        chosen = records[use]
        self._chunks.append(
            np.array([chosen.trajectory_s, chosen.position_rad, chosen.velocity_radps, chosen.measured_torque_Nm])
        )
        latest_s = float(self._chunks[-1][0, -1])
        if self._next >= len(self._windows) or latest_s <= self._windows[self._next].end_s:
            return
        samples = np.concatenate(self._chunks, axis=1)
        begin = 0
        while self._next < len(self._windows) and latest_s > self._windows[self._next].end_s:
            window = self._windows[self._next]
            begin, end = np.searchsorted(samples[0], (window.start_s, window.end_s))
            self._take(window, samples[:, begin:end])
            self._next += 1
            begin = end
        self._chunks = [samples[:, begin:]]

    def _take(self, window: Window, samples: np.ndarray) -> None:
        model = self._model
        if samples.shape[1] >= FEWEST_IN_WINDOW:
            time_s, position_rad, velocity_radps, torque_Nm = samples
            gravity_Nm = model.gravity_Nm * np.sin(position_rad - model.gravity_zero_rad)
            motor_Nm = (torque_Nm - gravity_Nm) / model.reduction_ratio
            self._open.setdefault(window.point.index, []).append(
                Samples(time_s, position_rad, velocity_radps, motor_Nm)
            )
        if not window.last:
            return
        taken = self._open.pop(window.point.index, [])
        if sum(len(w.time_s) for w in taken) < LEAST_SAMPLES:
            self.lost_points.append(window.point)
            return
        result = plateau(taken, window.point.velocity_radps, model.orders_prad, self.tolerance, model.resolution_rad)
        if math.isfinite(result.velocity_radps) and math.isfinite(result.motor_torque_Nm):
            self._on_point(MeasuredPoint(window.point, result, window.end_s, self.temperature_degC))
