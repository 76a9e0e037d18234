"""Picks the samples of every window out of the stream of log records and completes the points, one by one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.sweeping.options import SweepPoint
from jointctl.tools.sweeping.plan import BATCHES, LEAST_SAMPLES, Window

# --- From the samples of one plateau to its mean, its spread, and how far the mean can be trusted ---
# Velocity is distance over time, which the encoder's steps do not blur.  The mean torque is the plain mean over whole
# ripple periods.  Its confidence interval must not count the ripple as chance, nor successive samples as independent:
# the ripple (a sine and a cosine of the position for each order) is fitted and taken off, and what is left is averaged
# over BATCHES batches in the order of time, whose spread tells the standard error of the mean (batch means, Student's
# t).  A plateau is settled if that interval is narrow, the mean speed is the planned one, and the joint did not stick.


STUDENT_95 = 2.131  # two-sided, BATCHES - 1 degrees of freedom
COVERED_PERIODS = 0.7  # a ripple is fitted from so much of its period on
SPEED_TOLERANCE = 0.05  # of the planned speed
STICK_SPEED = 0.3  # share of the planned speed below which a moment counts as sticking
STICK_SHARE = 0.1  # of the moments
MOMENT_s = 0.05
MOMENT_STEPS = 20  # encoder steps in one moment


@dataclass(frozen=True)
class Tolerance:
    """When the mean torque is known well enough: half the 95 % interval, at the motor."""

    relative: float
    absolute_Nm: float


@dataclass
class Samples:
    """One window: arrays of shape (N,); time_s is trajectory time, torque at the motor without gravity."""

    time_s: np.ndarray
    position_rad: np.ndarray
    velocity_radps: np.ndarray
    motor_torque_Nm: np.ndarray


@dataclass(frozen=True)
class PlateauResult:
    velocity_radps: float
    motor_torque_Nm: float
    velocity_std_radps: float
    motor_torque_std_Nm: float
    samples: int
    position_min_rad: float
    position_max_rad: float
    half_interval_Nm: float  # of the mean torque, 95 %
    problem: str  # why it is not settled, or ""

    @property
    def settled(self) -> bool:
        return not self.problem


def without_ripple(position_rad: np.ndarray, values: np.ndarray, orders_prad: tuple[float, ...]) -> np.ndarray:
    """`values` minus their mean and minus the harmonics `orders_prad` [periods per joint radian] of the position."""
    centred = values - np.mean(values)
    span = float(np.ptp(position_rad))
    columns = [np.ones_like(position_rad)]
    for order in orders_prad:
        if span * order >= COVERED_PERIODS:
            phase = math.tau * order * position_rad
            columns += [np.sin(phase), np.cos(phase)]
    matrix = np.column_stack(columns)
    fitted = matrix[:, 1:] - np.mean(matrix[:, 1:], axis=0)
    if fitted.shape[1] == 0:
        return np.asarray(centred)
    coefficients, *_ = np.linalg.lstsq(fitted, centred, rcond=None)
    return np.asarray(centred - fitted @ coefficients)


def half_interval(residual: np.ndarray) -> float:
    """Half the 95 % confidence interval of the mean of correlated values, by batch means; inf if there are too few."""
    if len(residual) < LEAST_SAMPLES:
        return math.inf
    means = np.array([np.mean(batch) for batch in np.array_split(residual, BATCHES)])
    return float(STUDENT_95 * np.std(means, ddof=1) / math.sqrt(BATCHES))


def sticking_share(windows: list[Samples], planned_radps: float, resolution_rad: float) -> float:
    """Share of the moments in which the joint moved at less than STICK_SPEED of the planned speed."""
    moment_s = max(MOMENT_s, MOMENT_STEPS * resolution_rad / abs(planned_radps))
    slow = total = 0
    for window in windows:
        edges = np.arange(window.time_s[0], window.time_s[-1], moment_s)
        steps = np.diff(np.interp(edges, window.time_s, window.position_rad))
        slow += int(np.count_nonzero(steps / (planned_radps * moment_s) < STICK_SPEED))
        total += len(steps)
    return slow / total if total else 0.0


def plateau(
    windows: list[Samples],
    planned_radps: float,
    orders_prad: tuple[float, ...],
    tolerance: Tolerance,
    resolution_rad: float,
) -> PlateauResult:
    """All windows of one point together; every window has at least two samples."""
    position = np.concatenate([w.position_rad for w in windows])
    torque = np.concatenate([w.motor_torque_Nm for w in windows])
    velocity = np.concatenate([w.velocity_radps for w in windows])
    travelled = sum(float(w.position_rad[-1] - w.position_rad[0]) for w in windows)
    time_s = sum(float(w.time_s[-1] - w.time_s[0]) for w in windows)
    mean_radps = travelled / time_s
    mean_Nm = float(np.mean(torque))
    half_Nm = half_interval(without_ripple(position, torque, orders_prad))
    allowed_Nm = max(tolerance.relative * abs(mean_Nm), tolerance.absolute_Nm)
    problem = ""
    if not half_Nm <= allowed_Nm:
        problem = f"mean torque known to {half_Nm:.2g} Nm only, {allowed_Nm:.2g} Nm wanted"
    if not abs(mean_radps - planned_radps) <= SPEED_TOLERANCE * abs(planned_radps):
        problem = f"mean speed {mean_radps:.4g} rad/s, {planned_radps:.4g} planned"
    elif sticking_share(windows, planned_radps, resolution_rad) > STICK_SHARE:
        problem = "the joint stuck and slipped"
    return PlateauResult(
        mean_radps, mean_Nm, float(np.std(velocity)), float(np.std(torque)), len(torque),
        float(np.min(position)), float(np.max(position)), half_Nm, problem,
    )  # fmt: skip


# --- The meter ---


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
    load_Nm: float = 0.0  # mean of gravity and known load, at the joint


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
        self.warmth: tuple[np.ndarray, np.ndarray] | None = None  # in its place: trajectory time, temperature
        self._on_point = on_point
        self._next = 0
        self._chunks: list[np.ndarray] = []
        self._open: dict[int, list[Samples]] = {}
        self._loads: dict[int, list[np.ndarray]] = {}
        self.lost_points: list[SweepPoint] = []

    @property
    def current(self) -> SweepPoint | None:
        """The point whose window is under way or comes next; None after the last."""
        return self._windows[self._next].point if self._next < len(self._windows) else None

    def feed(self, records: np.recarray) -> None:
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
            load_Nm = model.gravity_Nm * np.sin(position_rad - model.gravity_zero_rad) + window.point.condition.load_Nm
            motor_Nm = (torque_Nm - load_Nm) / model.reduction_ratio
            self._loads.setdefault(window.point.index, []).append(load_Nm)
            self._open.setdefault(window.point.index, []).append(
                Samples(time_s, position_rad, velocity_radps, motor_Nm)
            )
        if not window.last:
            return
        taken, loads = self._open.pop(window.point.index, []), self._loads.pop(window.point.index, [])
        if sum(len(w.time_s) for w in taken) < LEAST_SAMPLES:
            self.lost_points.append(window.point)
            return
        result = plateau(taken, window.point.velocity_radps, model.orders_prad, self.tolerance, model.resolution_rad)
        if math.isfinite(result.velocity_radps) and math.isfinite(result.motor_torque_Nm):
            warmth = self.temperature_degC
            if self.warmth is not None:
                warmth = float(np.mean(np.interp(np.concatenate([w.time_s for w in taken]), *self.warmth)))
            self._on_point(
                MeasuredPoint(window.point, result, window.end_s, warmth, float(np.mean(np.concatenate(loads))))
            )
