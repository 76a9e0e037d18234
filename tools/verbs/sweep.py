"""`jointctl sweep CONFIG -o DATA.csv`: measure friction at plateaus of constant speed, in both directions."""

from __future__ import annotations

import contextlib
import math
import sys
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.table import Table

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DECLINED, INTERRUPTED, MotionFault
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_rad_per_count, torque_constant_NmpA
from jointctl.tools.output import Advance, Output
from jointctl.tools.recording.log_folder import log_path
from jointctl.tools.reporting.page import check_target
from jointctl.tools.running.control import Control, in_control
from jointctl.tools.running.events.fault_text import FaultText, fault_text
from jointctl.tools.running.permission.consent import agreed, approval, require_terminal
from jointctl.tools.running.permission.envelope import remark_lines, where_lines
from jointctl.tools.running.permission.readiness import require_ready
from jointctl.tools.running.result import drive_end
from jointctl.tools.sweeping.carry_out import SweepSupervisor, approach_time_s, middle_rad, sweep_in_lockstep, with_mode
from jointctl.tools.sweeping.checks import (
    constant_remarks,
    recorded_limits,
    refuse_constants,
    require_torque,
    torque_source,
)
from jointctl.tools.sweeping.data_file import SweepFile
from jointctl.tools.sweeping.grid import SweepPoint
from jointctl.tools.sweeping.meter import JointModel, MeasuredPoint, SweepMeter
from jointctl.tools.sweeping.options import SweepOptions, check_files, make_plan
from jointctl.tools.sweeping.plan import PlanSettings, SweepMotion
from jointctl.tools.sweeping.statistics import Tolerance
from jointctl.tools.sweeping.sweep_page import write_sweep_page

RELATIVE_TOLERANCE = 0.01
OVERHEAD_S = 3.0  # commissioning, enabling, release
REVISITS = 1  # of points that did not settle, with REVISIT_DWELL times the dwell
REVISIT_DWELL = 3.0


def joint_model(config: Config, settings: PlanSettings) -> JointModel:
    return JointModel(
        config.joint.reduction_ratio, config.joint.gravity_Nm, config.joint.gravity_zero_rad,
        abs(joint_rad_per_count(config)),
        (settings.ripple_per_joint_turn / math.tau,
         settings.ripple_per_motor_turn * config.joint.reduction_ratio / math.tau,
         2.0 * settings.ripple_per_motor_turn * config.joint.reduction_ratio / math.tau),
    )  # fmt: skip


def duration_text(time_s: float) -> str:
    minutes = round(time_s / 60.0)
    return f"{time_s:.0f} s" if time_s < 100.0 else f"{minutes} min"


def envelope(config: Config, report: CommissioningReport, motion: SweepMotion, points: list[SweepPoint]) -> list[str]:
    """What is about to happen, in lines."""
    limits = config.limits
    start = report.start_position_rad
    middle = middle_rad(config, motion, start)
    approach_s = approach_time_s(config, start, middle)
    speeds = sorted(abs(p.velocity_radps) for p in points)
    total_s = motion.duration_s + approach_s + OVERHEAD_S
    lines = [
        *where_lines(report),
        f"approach   to {middle:+.4f} rad in {approach_s:.1f} s",
        f"sweep      {len(points)} points from {speeds[0]:.4g} to {speeds[-1]:.4g} rad/s, both directions together",
        f"motion     {middle + motion.low_rad:+.3f} .. {middle + motion.high_rad:+.3f} rad, back and forth, "
        f"about {duration_text(total_s)}; points that do not settle are visited once more",
        f"limits     {limits.position_min_rad:+.3f} .. {limits.position_max_rad:+.3f} rad, "
        f"{limits.velocity_max_radps:.2f} rad/s, {limits.torque_max_Nm:.1f} Nm",
    ]
    gravity_Nm = config.joint.gravity_Nm
    own = [f"joint.gravity_Nm (={gravity_Nm:g}) is subtracted from what is measured"] if gravity_Nm else []
    return lines + remark_lines((*own, *constant_remarks(config), *report.remarks))


class Sweep:
    """One `sweep` command: plan, ask, measure, report."""

    def __init__(self, config: Config, output: Output, out: Path, options: SweepOptions) -> None:
        refuse_constants(config)
        self.config = with_mode(config, options.mode)
        self.output = output
        self.out = out
        self.options = options
        self.control: Control | None = None  # of the joint; in lockstep there is none
        self.plan = make_plan(config, options)
        self.file: SweepFile | None = None
        self.drive_state = ""
        self._time_offset_s = 0.0
        self._unsettled: dict[int, SweepPoint] = {}
        self._confirmed = self._declined = False

    def run(self) -> int:
        """The exit code: 0, 12 if declined, 130 after an interruption; raises `MotionFault` and the other errors."""
        options = self.options
        check_files(self.out, options.resume)
        if options.report is not None:
            check_target(options.report)
        todo = list(self.plan.points)
        try:
            if options.resume:
                self.file = SweepFile.resume(self.out, torque_constant_NmpA(self.config), self.plan.hash)
                done = self.file.done
                todo = [p for p in todo if p.index not in done]
                self._unsettled = {p.index: p for p in self.plan.points if p.index in self.file.unsettled}
                self.output.note(f"{self.out}: {len(done)} of {len(self.plan.points)} points are there already")
                if not todo and not self._to_revisit():
                    self.output.note("nothing is left to measure")
                    self._write_page()
                    return 0
            stopped: str | None = ""
            if todo:
                stopped = self._measure(todo, self.options.warm_up_turns, 1.0)
            if stopped == "":
                again = self._to_revisit()
                if again:
                    points = "1 point" if len(again) == 1 else f"{len(again)} points"
                    self.output.note(f"{points} did not settle: once more, with more time")
                    stopped = self._measure(again, 0.0, REVISIT_DWELL)
            return self._report(stopped)
        finally:
            if self.file is not None:
                self.file.close()

    def _to_revisit(self) -> list[SweepPoint]:
        """Points that did not settle and were not visited more than REVISITS times yet."""
        if self.file is None:
            return []
        visits = self.file.visits
        return [p for p in self.plan.points if p.index in self._unsettled and visits[p.index] <= REVISITS]

    def _measure(self, points: list[SweepPoint], warm_up_turns: float, dwell_factor: float) -> str | None:
        """Visit the points; the name of the signal that stopped it or "", None if it was declined or a dry run."""
        config, options = self.config, self.options
        motion = self.plan.motion(points, warm_up_turns, dwell_factor)
        self._time_offset_s = self.file.elapsed_s if self.file is not None else 0.0
        meter = SweepMeter(motion.windows, joint_model(config, self.plan.settings), self._on_point)

        def confirm(report: CommissioningReport) -> bool:
            resolution_Nm = report.torque_resolution_Nm / config.joint.reduction_ratio
            require_torque(report)
            meter.tolerance = Tolerance(RELATIVE_TOLERANCE, 0.5 * resolution_Nm)
            return self._confirm(report, motion, points)

        if options.lockstep:
            ended = sweep_in_lockstep(config, motion, meter, confirm)
            if ended is None:
                return None
            fault, value = ended
            self._raise_fault(fault, fault_text(fault, value, 0) if fault is not Fault.NONE else None)
            return ""
        with contextlib.ExitStack() as stack:
            bars: list[Advance] = []

            def progress(done_s: float) -> None:
                if not bars:  # not before: it would paint over the question, and what the loop says while it starts
                    title = "1 point" if len(points) == 1 else f"{len(points)} points"
                    bars.append(stack.enter_context(self.output.progress(title, motion.duration_s)))
                bars[0](max(0.0, done_s))

            assert self.control is not None
            approve = None if options.dry_run else self._approve
            supervisor = SweepSupervisor(
                config, self.output, log_path(config), confirm, motion, meter, progress, self.control, approve,
                allow_low_margin=options.allow_low_margin,
            )  # fmt: skip
            try:
                result = supervisor.run()
            finally:
                self.drive_state = supervisor.drive_state
        if result is None:
            return None
        if meter.lost_points:
            shown = ", ".join(f"{p.velocity_radps:+.4g}" for p in meter.lost_points[:8])
            self.output.warning(f"too few samples came for {len(meter.lost_points)} points: {shown} rad/s; --resume")
        if result.lost_records:
            self.output.warning(f"{result.lost_records} log records were lost: the supervisor was too slow")
        self._raise_fault(result.fault, result.fault_text)
        return result.stopped_by

    def _approve(self, question: str) -> bool:
        agreed_to = approval(self.output, assume_yes=self.options.assume_yes)(question)
        self._declined = self._declined or not agreed_to
        return agreed_to

    def _confirm(self, report: CommissioningReport, motion: SweepMotion, points: list[SweepPoint]) -> bool:
        if not self._confirmed:
            for line in envelope(self.config, report, motion, points):
                self.output.fact(line)
            if self.options.dry_run:
                return False
            if not self.options.lockstep:
                require_ready(self.config, report, log_path(self.config))
            if not (self.options.assume_yes or self.options.lockstep or agreed(self.output)):
                self._declined = True
                return False
            self._confirmed = True
        if self.file is None:
            constant = torque_constant_NmpA(self.config)
            ratio = self.config.joint.reduction_ratio
            self.file = SweepFile.create(self.out, ratio, constant, self.plan.hash, self._about(report))
        return True

    def _about(self, report: CommissioningReport) -> dict[str, Any]:
        """What the sidecar tells besides the constants."""
        options = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(self.options).items()}
        return {
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": {"jointctl": version("jointctl"), "python": sys.version.split()[0]},
            "drive": {**vars(report.identity), "mode": report.mode, **report.settings},
            "limits": recorded_limits(self.config),
            "torque_source": torque_source(self.config),
            "gravity_subtracted_Nm": self.config.joint.gravity_Nm,
            "points": len(self.plan.points),
            "options": options,
            "configuration": self.config.text,
        }

    def _on_point(self, measured: MeasuredPoint) -> None:
        assert self.file is not None
        self.file.add(replace(measured, time_s=measured.time_s + self._time_offset_s))
        result = measured.result
        if result.problem:
            self._unsettled[measured.point.index] = measured.point
        else:
            self._unsettled.pop(measured.point.index, None)
        if self.output.stderr.isatty():
            text = "" if result.settled else f"  not settled: {result.problem}"
            with contextlib.suppress(OSError):
                self.output.note(
                    f"  {len(self.file.done):4d}/{len(self.plan.points)}  {result.velocity_radps:+9.4f} rad/s  "
                    f"{result.motor_torque_Nm:+.5f} +- {result.half_interval_Nm:.5f} Nm{text}"
                )

    def _raise_fault(self, fault: Fault, text: FaultText | None) -> None:
        if text is None:
            return
        done = len(self.file.done) if self.file is not None else 0
        points = "1 point is" if done == 1 else f"{done} points are"
        kept = f"{points} in {self.out}" if done else "nothing was measured"
        raise MotionFault(
            f"{fault.name} ({int(fault)}): {text.happened}; {kept}",
            text.advice + ("; then --resume" if done else ""),
        )

    def _report(self, stopped: str | None) -> int:
        if stopped is None:
            left = "nothing moved; " + drive_end.words(self.drive_state)
            self.output.note(f"dry run: {left}" if self.options.dry_run else left)
            return DECLINED if self._declined else 0
        drive_end.require_off(self.drive_state)
        assert self.file is not None
        done = len(self.file.done)
        data = {"points": done, "planned": len(self.plan.points), "unsettled": len(self._unsettled),
                "stopped_by": stopped or None, "data": str(self.out), "plan": self.plan.hash}  # fmt: skip
        self.output.result(self._table(), data)
        self._write_page()
        if self._unsettled:
            shown = ", ".join(f"{p.velocity_radps:+.4g}" for p in list(self._unsettled.values())[:8])
            self.output.warning(f"{len(self._unsettled)} points never settled (settled = 0 in the file): {shown} rad/s")
        if stopped:
            self.output.note(f"stopped by {stopped}; what was measured is in {self.out}, --resume goes on")
            return INTERRUPTED
        return 0

    def _write_page(self) -> None:
        if self.options.report is not None and self.file is not None and self.file.done:
            write_sweep_page(self.options.report, self.out, self._table(), self.output)

    def _table(self) -> Table:
        done = len(self.file.done) if self.file is not None else 0
        table = Table(title="Sweep", title_justify="left", show_header=False)
        for name, value in (
            ("points", f"{done} of {len(self.plan.points)}"),
            ("not settled", str(len(self._unsettled))),
            ("drive afterwards", self.drive_state or "none, it was simulated"),
            ("data", str(self.out)),
            ("sidecar", str(self.out.with_suffix(".json"))),
        ):
            table.add_row(name, value)
        return table


def sweep(config: Config, output: Output, out: Path, options: SweepOptions | None = None) -> int:
    """The whole command; returns the exit code."""
    options = options or SweepOptions()
    if not (options.assume_yes or options.dry_run or options.lockstep):
        require_terminal()
    command = Sweep(config, output, out, options)
    with contextlib.ExitStack() as stack:
        try:
            if not options.lockstep:
                command.control = stack.enter_context(in_control(command.config, output))
            return command.run()
        except KeyboardInterrupt:
            by = command.control.signals.by_command if command.control is not None else ""
            output.note(f"interrupted{by}; nothing moved" + ("" if command.file is None else " any more"))
            drive_end.require_off(command.drive_state)
            return INTERRUPTED
