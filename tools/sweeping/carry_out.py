"""Carrying out the motion of a sweep: on the drive through the same loop and session as `run`, or in lockstep.

The drive is in a velocity mode if it has one (CSV, else PV; UM=2 on a serial line); else our own law closes the
velocity loop on torque.  In every mode the torque is the one that the drive measures.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import INTERRUPTED, ConfigurationError, MotionFault, UsageError
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import CommandKind, Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import approach_duration_s
from jointctl.hil.lockstep import TRUE_WARMTH_degC
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import APPROACH_MIN_S, APPROACH_SPEED, axis_constants
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Advance, Output
from jointctl.tools.recording.run_log import RunLogWriter, log_path, run_metadata
from jointctl.tools.session.control import in_control
from jointctl.tools.session.display import Display, OnlyShows, Snapshot, run_display
from jointctl.tools.session.plan import Consent, Motion, Placed, RunPlan, TerminalConsent, joint_lines, remark_lines
from jointctl.tools.session.result import RunResult, broken_off, never_begun, require_off
from jointctl.tools.session.session import Session
from jointctl.tools.sweeping.meter import SweepMeter
from jointctl.tools.sweeping.options import SweepPoint
from jointctl.tools.sweeping.plan import SweepMotion, constant_remarks, position_margin_rad, require_torque, shifted

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
    return config.model_copy(update={"drive": config.drive.in_sweep_mode(mode)})


def config_of_sweep(config: Config, mode: str) -> Config:
    """The configuration in the wanted mode, with the law that a sweep on torque uses."""
    return with_tracking_law(with_mode(config, mode))


def with_tracking_law(config: Config) -> Config:
    """For torque mode: a law that holds a speed against unknown friction; one with integral action is kept."""
    control = config.control
    if control.kind in ("pid", "computed_torque_observer", "flexible_joint"):
        update: dict[str, Any] = {"learning": None}
    else:
        update = {"kind": "computed_torque_observer", "observer_radps": OBSERVER_radps, "learning": None}
    return config.model_copy(update={"control": control.model_copy(update=update)})


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
    constants = axis_constants(config, motion.table, start_position_rad=report.start_position_rad)
    axis = constants[0]
    axis.trajectory.kind = TrajectoryKind.TABLE
    axis.trajectory.repeats = 0
    axis.trajectory.table_rows = len(motion.table)
    axis.trajectory.duration_s = motion.duration_s
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
            *joint_lines(report),
            f"approach   to {middle:+.4f} rad in {approach_s:.1f} s",
            f"sweep      {len(self.points)} points from {speeds[0]:.4g} to {speeds[-1]:.4g} rad/s, "
            "both directions together",
            f"motion     {middle + motion.low_rad:+.3f} .. {middle + motion.high_rad:+.3f} rad, back and forth, "
            f"about {_duration_text(total_s)}; points that do not settle are visited once more",
            f"limits     {limits.position_min_rad:+.3f} .. {limits.position_max_rad:+.3f} rad, "
            f"{limits.velocity_max_radps:.2f} rad/s, {limits.torque_max_Nm:.1f} Nm",
            *remark_lines((*own, *constant_remarks(config), *report.remarks)),
        ]


def _duration_text(time_s: float) -> str:
    return f"{time_s:.0f} s" if time_s < 100.0 else f"{round(time_s / 60.0)} min"


def sweep_run(swept: SweepPass, *, allow_low_margin: bool = False) -> RunPlan:
    """The plan of a session along it."""
    return RunPlan(swept.config, swept, log_path(swept.config), allow_low_margin, LOG_EVERY, LOG_FULL_RATE_S)


class MeterDisplay(OnlyShows):
    """Gives the records of a pass to the meter, and its progress to the terminal."""

    def __init__(self, meter: SweepMeter, output: Output, title: str, duration_s: float) -> None:
        self._meter, self._output, self._title, self._duration_s = meter, output, title, duration_s
        self._stack = contextlib.ExitStack()
        self._advance: Advance | None = None

    def note(self, text: str) -> None:
        """The lines of the run say it."""

    phase = note

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`; `DataError` or `OSError` where the data cannot be written: the run is over."""
        self._meter.temperature_degC = snapshot.temperature_degC
        self._meter.feed(snapshot.records)
        with contextlib.suppress(OSError):  # the terminal may have been closed
            if self._advance is None:  # not before: it would paint over what the loop says while it starts
                self._advance = self._stack.enter_context(self._output.progress(self._title, self._duration_s))
            self._advance(max(0.0, float(snapshot.record.trajectory_s)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._stack.__exit__(*exception)


def carried_out(plan: RunPlan, output: Output, what: str, *, assume_yes: bool, dry_run: bool) -> RunResult | int:
    """One run of `plan`, its motion shown and agreed to before: its result, or the exit code without one.

    `what` it is for ("map"); `MotionFault` where a fault has ended it.
    """
    consent = TerminalConsent(output, assume_yes=assume_yes, dry_run=dry_run)

    def display(_: CommissioningReport) -> Display:
        return run_display(output, f"{plan.config.path.stem}: {what}")()

    with in_control(plan.config, output) as control:
        session = Session(plan, consent, output, control, display)
        try:
            result = session.run()
        except KeyboardInterrupt:
            return broken_off(session.drive_state, output, control.signals.by_command)
    if result is None:
        return never_begun(session.drive_state, output, dry_run=dry_run)
    require_off(session.drive_state)
    if result.fault_text is not None:
        text = result.fault_text
        raise MotionFault(f"{result.fault.name} ({int(result.fault)}): {text.happened}; no {what}", text.advice)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; no {what}")
        return INTERRUPTED
    return result


def lockstep_log(config: Config, motion: Motion, consent: Consent) -> Path | None:
    """A run log of the motion on the virtual joint in simulated time; None after a dry run."""
    joint = _virtual_joint(config)
    placed = motion.placed(joint.report)
    consent.show(placed.lines)
    if consent.dry_run:
        return None
    run = joint.run_as_configured(placed.constants, placed.table)
    if run.fault:
        raise MotionFault(f"{run.fault.name} ({int(run.fault)}); no log")
    path = log_path(config)
    with RunLogWriter(path, run_metadata(config, joint.report)) as log:
        log.write_records(run.log)
        if run.thermometer:
            for at in range(0, len(run.log), round(config.loop.rate_Hz)):
                log.write_temperature(int(run.log.time_ns[at]), float(run.truth[at, TRUE_WARMTH_degC]))
    return path


def _virtual_joint(config: Config) -> LockstepJoint:
    if not config.drive.simulated:
        raise UsageError('--lockstep is for drive.kind = "canopen": the serial joint runs in real time only')
    return LockstepJoint(config)


def sweep_in_lockstep(
    swept: SweepPass, meter: SweepMeter, consent: Consent, begin: Begin
) -> tuple[Fault, float] | None:
    """The whole motion on the virtual joint in simulated time; the fault and its value, None after a dry run."""
    config = swept.config
    joint = _virtual_joint(config)
    placed = swept.placed(joint.report)
    consent.show(placed.lines)
    if consent.dry_run:
        return None
    begin(joint.report)
    cycles = (swept.motion.duration_s + float(placed.constants[0].sequence.approach_s)) * config.loop.rate_Hz
    run = joint.run_as_configured(placed.constants, placed.table, max(1, math.ceil(cycles / LOCKSTEP_RECORDS)))
    if run.thermometer:
        meter.warmth = run.log.trajectory_s[run.tracking], run.truth[run.tracking, TRUE_WARMTH_degC]
    meter.feed(run.log)
    return run.fault, float(run.state.fault_value)
