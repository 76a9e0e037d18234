"""Carrying out the motion of a sweep: on the drive through the same loop and supervisor as `run`, or in lockstep.

The drive is in a velocity mode if it has one (CSV, else PV; UM=2 on a serial line); else our own law closes the
velocity loop on torque.  In every mode the torque is the one that the drive measures.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.drive import Approval, CommissioningReport
from jointctl.drivers.elmo.commissioning import SPEED_MODE
from jointctl.drivers.errors import ConfigurationError, DeviceError, UsageError
from jointctl.firmware_py.records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import CommandKind, Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import approach_duration_s
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSerial, UnitModeChoice
from jointctl.tools.configuration.records import APPROACH_MIN_S, APPROACH_SPEED, axis_constants
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import THINNING
from jointctl.tools.recording.thinned_records import ThinnedRecords
from jointctl.tools.running.control import Control
from jointctl.tools.running.loop.loop_handle import LoopHandle
from jointctl.tools.running.run_watch import RunParts, RunWatch
from jointctl.tools.running.supervisor import Supervisor
from jointctl.tools.simulation.lockstep import LockstepJoint
from jointctl.tools.sweeping.meter import SweepMeter
from jointctl.tools.sweeping.plan import SweepMotion, shifted

DRIVE_MODES = {"auto": "velocity or torque", "csv": "csv", "pv": "pv"}  # option: `CanopenSettings.mode`
SERIAL_MODES: dict[str, UnitModeChoice] = {"auto": "auto", "speed": "speed", "torque": "torque"}
VELOCITY_MODES = ("cyclic_sync_velocity", "profile_velocity", SPEED_MODE)  # as commissioning reports them
POSITION_GAIN_ps = 5.0  # slow: far below any drive's velocity loop, fast enough to keep the joint on the plan
OBSERVER_radps = 30.0  # of the law that takes the place of one without an integral action
ACCELERATION_SPARE = 3.0  # limit of the velocity command's slope over sequence.brake_radps2
LOG_EVERY = 20  # records of the run log: a sweep takes minutes, and its data are in its own file
LOG_WHOLE_S = 2.0  # the last ones are in it whole
LOCKSTEP_RECORDS = 250_000


def with_mode(config: Config, mode: str) -> Config:
    """The configuration in the wanted mode: auto, csv, pv, speed (serial drive), or torque (as [drive] says)."""
    if mode not in (*DRIVE_MODES, "speed", "torque"):
        raise UsageError(f"--mode (={mode}) must be one of auto, csv, pv, speed, torque")
    if isinstance(config.drive, ElmoSerial):
        if mode not in SERIAL_MODES:
            raise DeviceError(f"--mode (={mode}) must be auto, speed or torque: it is a serial drive")
        return config.model_copy(update={"drive": config.drive.in_unit_mode(SERIAL_MODES[mode])})
    if mode == "speed":
        raise DeviceError("--mode (=speed) must be auto, csv, pv or torque: it is a CANopen drive")
    if mode == "torque":
        return config
    drive = config.drive.model_copy(update={"mode": DRIVE_MODES[mode]})
    return config.model_copy(update={"drive": drive})


def with_tracking_law(config: Config) -> Config:
    """For torque mode: a law that holds a speed against unknown friction; one with integral action is kept."""
    control = config.control
    if control.kind in ("pid", "computed_torque_observer"):
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


def position_margin_rad(config: Config) -> float:
    """Kept free at both ends of the travel: the joint may be so far from its reference."""
    return config.limits.following_error_max_rad


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
    constants = axis_constants(config, start_position_rad=report.start_position_rad)
    axis = constants[0]
    axis.trajectory.kind = TrajectoryKind.TABLE
    axis.trajectory.repeats = 0
    axis.trajectory.table_rows = len(motion.table)
    axis.trajectory.duration_s = motion.duration_s
    axis.sequence.approach_s = approach_time_s(config, report.start_position_rad, float(motion.table[0, 1]))
    if report.mode in VELOCITY_MODES:
        axis.command_kind = CommandKind.VELOCITY
        axis.velocity_command.position_gain_ps = POSITION_GAIN_ps
        axis.velocity_command.acceleration_max_radps2 = ACCELERATION_SPARE * config.sequence.brake_radps2
    return constants


class SweepWatch(RunWatch):
    """Gives the records of a sweep to its meter, and thinned to the run log; `prepare` it first."""

    def prepare(self, meter: SweepMeter, progress: Callable[[float], None], *, velocity_mode: bool) -> None:
        """`progress` is told the time on the motion [s]."""
        self._meter, self._progress, self._velocity_mode = meter, progress, velocity_mode
        self._thinned = ThinnedRecords(LOG_EVERY, round(LOG_WHOLE_S * self.config.loop.rate_Hz))

    def margin_text(self, delay_s: float) -> str:
        """In a velocity mode the drive closes its loop itself; ours is the slow position correction."""
        if not self._velocity_mode:
            return super().margin_text(delay_s)
        margin_deg = math.degrees(0.5 * math.pi - POSITION_GAIN_ps * delay_s)
        return f"position correction with {margin_deg:.0f} deg phase margin"

    def take_records(self) -> None:
        """As for any run; at the end also those that the thinning still holds."""
        super().take_records()
        if not self.loop.running():
            self._write(self._thinned.last())

    def keep(self, records: Any) -> None:
        """See `RunWatch`."""
        self._write(self._thinned.take(records))
        self._meter.temperature_degC = self.temperature.newest_degC
        self._meter.feed(records)
        with contextlib.suppress(OSError):  # the terminal may have been closed
            self._progress(float(records[-1].trajectory_s))

    def _write(self, records: Any) -> None:
        if len(records):
            super().keep(records)


class SweepSupervisor(Supervisor):
    """A supervised run along the motion of a sweep."""

    def __init__(
        self,
        config: Config,
        output: Output,
        log_path: Path,
        confirm: Callable[[CommissioningReport], bool],
        motion: SweepMotion,
        meter: SweepMeter,
        progress: Callable[[float], None],
        control: Control,
        approve: Approval | None = None,
        *,
        allow_low_margin: bool = False,
    ) -> None:
        super().__init__(config, output, log_path, confirm, control, approve=approve, allow_low_margin=allow_low_margin)
        self._motion = motion
        self._meter = meter
        self._progress = progress
        self._velocity_mode = False

    def _table(self) -> np.ndarray:
        return self._motion.table

    def _constants(self, loop: LoopHandle, report: CommissioningReport) -> Any:
        self._velocity_mode = report.mode in VELOCITY_MODES
        if not self._velocity_mode:
            self._config = with_tracking_law(self._config)
        motion = shifted(self._motion, middle_rad(self._config, self._motion, report.start_position_rad))
        loop.block.table[:] = motion.table
        return sweep_constants(self._config, report, motion)

    def _metadata(self, report: CommissioningReport) -> dict[str, dict[str, str]]:
        return {**super()._metadata(report), THINNING: {"every": str(LOG_EVERY), "whole_s": f"{LOG_WHOLE_S:g}"}}

    def _make_watch(self, parts: RunParts) -> RunWatch:
        watch = SweepWatch(self._config, parts, allow_low_margin=self._allow_low_margin)
        watch.prepare(self._meter, self._progress, velocity_mode=self._velocity_mode)
        return watch


def sweep_in_lockstep(
    config: Config, motion: SweepMotion, meter: SweepMeter, confirm: Callable[[CommissioningReport], bool]
) -> tuple[Fault, float] | None:
    """The whole motion on the virtual joint in simulated time; the fault and its value, None if `confirm` declined."""
    if config.is_serial:
        raise UsageError('--lockstep is for drive.kind = "canopen": the serial joint runs in real time only')
    joint = LockstepJoint(config)
    if not confirm(joint.report):
        return None
    if joint.report.mode not in VELOCITY_MODES:
        joint.config = config = with_tracking_law(config)
    placed = shifted(motion, middle_rad(config, motion, joint.report.start_position_rad))
    joint.table = placed.table
    constants = sweep_constants(config, joint.report, placed)
    constants[0].sequence.supervisor_max_cycles = 0
    cycles = (placed.duration_s + float(constants[0].sequence.approach_s)) * config.loop.rate_Hz
    run = joint.run(constants, log_every=max(1, math.ceil(cycles / LOCKSTEP_RECORDS)))
    meter.feed(run.log)
    return run.fault, float(run.state.fault_value)
