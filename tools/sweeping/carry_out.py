"""Carrying out the motion of a sweep and measuring its plateaus: on the drive, by the session of `run`, or in lockstep.

The drive is in a velocity mode if it has one (CSV, else PV; UM=2 on a serial line); else our own law closes the
velocity loop on torque.  In every mode the torque is the one that the drive measures.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import (
    INTERRUPTED,
    ConfigurationError,
    DataError,
    UsageError,
    text_Nm,
    text_radps,
)
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, CommandKind, Fault
from jointctl.firmware_py.trajectory import approach_duration_s
from jointctl.hil.lockstep import TRUE_WARMTH_degC
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import APPROACH_MIN_S, APPROACH_SPEED, table_constants
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from jointctl.tools.output import Advance, Output
from jointctl.tools.recording.run_log import RunLogWriter, log_path, run_metadata
from jointctl.tools.session.control import in_control
from jointctl.tools.session.display import Display, Snapshot, run_display
from jointctl.tools.session.fault_words import FaultText, ended_by
from jointctl.tools.session.plan import Consent, Motion, Placed, RunPlan, TerminalConsent, joint_lines, remark_lines
from jointctl.tools.session.result import RunResult, broken_off, never_begun, require_off
from jointctl.tools.session.session import Session
from jointctl.tools.session.session_drive import latched_text
from jointctl.tools.sweeping.options import SweepPoint
from jointctl.tools.sweeping.plan import (
    BATCHES,
    LEAST_SAMPLES,
    SweepMotion,
    Window,
    constant_remarks,
    position_margin_rad,
    require_torque,
    shifted,
)

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


# --- The meter: it picks the samples of every window out of the log records, and completes point by point ---


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
        self, windows: tuple[Window, ...], model: JointModel, on_point: Callable[[MeasuredPoint], None]
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


# --- Carrying it out ---

MODES = ("auto", "csv", "pv", "speed", "torque")
POSITION_GAIN_ps = 5.0  # slow: far below any drive's velocity loop, fast enough to keep the joint on the plan
OBSERVER_radps = 30.0  # of the law that takes the place of one without an integral action
ACCELERATION_SPARE = 3.0  # limit of the velocity command's slope over sequence.brake_radps2
LOG_EVERY = 20  # records of the run log: a sweep takes minutes, and its data are in its own file
LOG_FULL_RATE_S = 2.0  # the last ones are all in it
LOCKSTEP_RECORDS = 250_000
OVERHEAD_S = 3.0  # commissioning, enabling, release

Begin = Callable[[CommissioningReport], None]  # called when the joint is known and may move


def with_mode(config: Config, mode: str) -> Config:
    """The configuration in the wanted mode: auto, csv, pv, speed (serial drive), or torque (as [drive] says)."""
    if mode not in MODES:
        raise UsageError(f"--mode (={mode}) must be one of {', '.join(MODES)}")
    return config.changed(drive=config.drive.in_sweep_mode(mode))


def config_of_sweep(config: Config, mode: str) -> Config:
    """The configuration in the wanted mode, with the law that a sweep on torque uses."""
    return with_tracking_law(with_mode(config, mode))


def with_tracking_law(config: Config) -> Config:
    """For torque mode: a law that holds a speed against unknown friction; one with integral action is kept."""
    if config.control.kind not in ("pid", "computed_torque_observer", "flexible_joint"):
        config = config.changed(control__kind="computed_torque_observer", control__observer_radps=OBSERVER_radps)
    return config.changed(control__learning=None)


def middle_rad(config: Config, motion: SweepMotion, start_rad: float) -> float:
    """Where the middle of the motion lies: as near to where the joint stands as the limits allow."""
    margin = position_margin_rad(config)
    low = config.limits.position_min_rad + margin - motion.low_rad
    high = config.limits.position_max_rad - margin - motion.high_rad
    return min(max(start_rad, low), max(high, low))


def approach_time_s(config: Config, start_rad: float, middle: float) -> float:
    """Time of the way from where the joint stands to the beginning of the motion."""
    target = new(Reference)[0]
    target.position_rad = middle
    speed = APPROACH_SPEED * config.limits.velocity_max_radps
    try:
        return approach_duration_s(start_rad, target, speed, config.sequence.brake_radps2, APPROACH_MIN_S)
    except ValueError as error:
        raise ConfigurationError(f"{config.path}: {error}") from None


def sweep_constants(config: Config, report: CommissioningReport, motion: SweepMotion) -> Any:
    """`AxisConstants` for the motion (already about its middle) in the mode that the drive was set to."""
    constants = table_constants(config, motion.table, motion.duration_s, report.start_position_rad)
    axis = constants[0]
    axis.sequence.approach_s = approach_time_s(config, report.start_position_rad, float(motion.table[0, 1]))
    if report.commands_velocity:
        axis.command_kind = CommandKind.VELOCITY
        axis.velocity_command.position_gain_ps = POSITION_GAIN_ps
        axis.velocity_command.acceleration_max_radps2 = ACCELERATION_SPARE * config.sequence.brake_radps2
    return constants


@dataclass(frozen=True)
class SweepPass:
    """One way along points of a sweep; see `session.plan.Motion`.  `config` is that of `config_of_sweep`."""

    config: Config
    motion: SweepMotion
    points: Sequence[SweepPoint]

    @property
    def table(self) -> np.ndarray:
        return self.motion.table

    def placed(self, report: CommissioningReport) -> Placed:
        """See `Motion`; about the place where the joint stands, as far as the limits allow."""
        require_torque(report)
        motion = shifted(self.motion, self._middle_rad(report))
        constants = sweep_constants(self.config, report, motion)
        if constants[0].limits.frozen_torque_Nm > 0.0:  # a healthy joint may stand still under so much more
            constants[0].limits.frozen_torque_Nm += abs(self.points[0].condition.load_Nm)
        return Placed(constants, motion.table, tuple(self._envelope(report)))

    def require_start(self, start_position_rad: float) -> None:
        """From everywhere within the limits."""

    def _middle_rad(self, report: CommissioningReport) -> float:
        place_rad = self.points[0].condition.place_rad
        return middle_rad(self.config, self.motion, report.start_position_rad) if place_rad is None else place_rad

    def _envelope(self, report: CommissioningReport) -> list[str]:
        config, motion = self.config, self.motion
        limits = config.limits
        middle = self._middle_rad(report)
        approach_s = approach_time_s(config, report.start_position_rad, middle)
        speeds = sorted(abs(p.velocity_radps) for p in self.points)
        total_s = motion.duration_s + approach_s + OVERHEAD_S
        gravity_Nm = config.joint.gravity_Nm
        own = [f"joint.gravity_Nm (={gravity_Nm:g}) is subtracted from what is measured"] if gravity_Nm else []
        load_Nm = self.points[0].condition.load_Nm
        own += [f"a load of {load_Nm:g} Nm at the joint is subtracted; the drive must hold it"] if load_Nm else []
        return [
            *joint_lines(report, limits),
            f"approach   to {middle:+.4f} rad in {approach_s:.1f} s",
            f"sweep      {len(self.points)} points from {speeds[0]:.4g} to {speeds[-1]:.4g} rad/s, "
            "both directions together",
            f"motion     {middle + motion.low_rad:+.3f} .. {middle + motion.high_rad:+.3f} rad, back and forth, "
            f"about {_duration_text(total_s)}; points that do not settle are visited once more",
            f"limits     {limits.position_min_rad:+.3f} .. {limits.position_max_rad:+.3f} rad, "
            f"{text_radps(limits.velocity_max_radps)}, {text_Nm(limits.torque_max_Nm)}",
            *remark_lines((*own, *constant_remarks(config), *report.remarks)),
        ]


def _duration_text(time_s: float) -> str:
    return f"{time_s:.0f} s" if time_s < 100.0 else f"{round(time_s / 60.0)} min"


def sweep_run(swept: SweepPass, *, allow_low_margin: bool = False) -> RunPlan:
    """The plan of a session along it."""
    return RunPlan(swept.config, swept, log_path(swept.config), allow_low_margin, LOG_EVERY, LOG_FULL_RATE_S)


class MeterDisplay(Display):
    """Gives the records of a pass to the meter, and its progress to the terminal; the lines of the run say the rest."""

    def __init__(self, meter: SweepMeter, output: Output, title: str, duration_s: float) -> None:
        self._meter, self._output, self._title, self._duration_s = meter, output, title, duration_s
        self._stack = contextlib.ExitStack()
        self._advance: Advance | None = None

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`; `DataError` where the data cannot be written: the run is over."""
        self._meter.temperature_degC = snapshot.temperature_degC
        self._meter.feed(snapshot.records)
        with contextlib.suppress(OSError):  # the terminal may have been closed
            if self._advance is None:  # not before: it would paint over what the loop says while it starts
                self._advance = self._stack.enter_context(self._output.progress(self._title, self._duration_s))
            self._advance(max(0.0, float(snapshot.record.trajectory_s)))

    def __exit__(self, *exception: Any) -> None:
        self._stack.__exit__(*exception)


def carried_out(plan: RunPlan, output: Output, what: str, *, assume_yes: bool, dry_run: bool) -> RunResult | int:
    """One run of `plan`, its motion shown and agreed to before: its result, or the exit code without one.

    `what` it is for ("map"); `MotionFault` where a fault has ended it.
    """
    consent = TerminalConsent(output, assume_yes=assume_yes, dry_run=dry_run)
    display = run_display(output, f"{plan.config.path.stem}: {what}")
    with in_control(plan.config, output) as control:
        session = Session(plan, consent, output, control, display)
        try:
            result = session.run()
        except KeyboardInterrupt:
            return broken_off(session.drive_state, output, control.signals.by_command)
    if result is None:
        return never_begun(session.drive_state, output, dry_run=dry_run)
    if (result.fault_text is not None or result.stopped_by) and not result.log_lost:
        output.note(f"log: {result.log_path}")
    require_off(session.drive_state)
    if result.fault_text is not None:
        raise ended_by(result.fault, result.fault_text, after=f"; no {what}")
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; no {what}")
        return INTERRUPTED
    if result.log_lost:
        raise DataError(f"{result.log_path}: this log is lost; no {what}")
    return result


def lockstep_log(config: Config, motion: Motion, consent: Consent, *, allow_low_margin: bool = False) -> Path | None:
    """A run log of the motion on the virtual joint in simulated time; None after a dry run."""
    done = simulated_run(config, motion, consent, "log", allow_low_margin=allow_low_margin)
    if done is None:
        return None
    joint, run = done
    path = log_path(config)
    with RunLogWriter(path, run_metadata(config, joint.report)) as log:
        log.write_records(run.log)
        if run.thermometer:
            for at in range(0, len(run.log), round(config.loop.rate_Hz)):
                log.write_temperature(int(run.log.time_ns[at]), float(run.truth[at, TRUE_WARMTH_degC]))
    return path


def simulated_run(
    config: Config, motion: Motion, consent: Consent, what: str, *, allow_low_margin: bool
) -> tuple[LockstepJoint, LockstepRun] | None:
    """See `simulated`, carried out; `what` it is for ("map"); `MotionFault` where a fault has ended it."""
    begun = simulated(config, motion, consent, allow_low_margin=allow_low_margin)
    if begun is None:
        return None
    joint, placed = begun
    run = joint.run_as_configured(placed.constants, placed.table)
    if (text := latched_text(config, run.state)) is not None:
        raise ended_by(run.fault, text, after=f"; no {what}")
    return joint, run


def simulated(
    config: Config, motion: Motion, consent: Consent, *, allow_low_margin: bool
) -> tuple[LockstepJoint, Placed] | None:
    """The virtual joint for simulated time, and the motion that a session would carry out; None after a dry run."""
    if not config.drive.simulated:
        raise UsageError('--lockstep is for drive.kind = "canopen": the serial joint runs in real time only')
    joint = LockstepJoint(config)
    placed = motion.placed(joint.report)
    consent.show(placed.lines)
    if consent.dry_run:
        return None
    if not joint.report.commands_velocity:  # then the drive closes the loop
        require_margin(config, allow_low_margin=allow_low_margin)
    motion.require_start(joint.report.start_position_rad)
    return joint, placed


def sweep_in_lockstep(
    swept: SweepPass, meter: SweepMeter, consent: Consent, begin: Begin, *, allow_low_margin: bool = False
) -> tuple[Fault, FaultText | None] | None:
    """The whole motion on the virtual joint in simulated time; the fault, in words too; None after a dry run."""
    config = swept.config
    begun = simulated(config, swept, consent, allow_low_margin=allow_low_margin)
    if begun is None:
        return None
    joint, placed = begun
    begin(joint.report)
    cycles = (swept.motion.duration_s + float(placed.constants[0].sequence.approach_s)) * config.loop.rate_Hz
    run = joint.run_as_configured(placed.constants, placed.table, max(1, math.ceil(cycles / LOCKSTEP_RECORDS)))
    if run.thermometer:
        meter.warmth = run.log.trajectory_s[run.tracking], run.truth[run.tracking, TRUE_WARMTH_degC]
    meter.feed(run.log)
    return run.fault, latched_text(config, run.state)
