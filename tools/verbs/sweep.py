"""`jointctl sweep CONFIG -o DATA.csv`: measure friction at plateaus of constant speed, in both directions."""

from __future__ import annotations

import contextlib
import math
import sys
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from jointctl.drivers.errors import DECLINED, INTERRUPTED, UsageError
from jointctl.tools.output import Output
from jointctl.tools.scoping.remote_options import NOBODY, ObserveOptions
from jointctl.tools.sweeping.options import AS_IT_FITS, SweepOptions, check_files
from jointctl.tools.verbs.verb_options import JointOnBus, VerbOutput

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointctl.drivers.drive import CommissioningReport
    from jointctl.firmware_py.states import Fault
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.scoping.remote import Remote
    from jointctl.tools.session.control import Control
    from jointctl.tools.session.display import Display
    from jointctl.tools.session.fault_words import FaultText
    from jointctl.tools.sweeping.carry_out import JointModel, MeasuredPoint
    from jointctl.tools.sweeping.data_file import SweepFile
    from jointctl.tools.sweeping.options import Condition, SweepPoint
    from jointctl.tools.sweeping.plan import PlanSettings

RELATIVE_TOLERANCE = 0.01
SHORT_TOLERANCE = 0.03  # where the travel is shorter than a ripple period of the joint, which cannot be averaged out
REVISITS = 1  # of points that did not settle, with REVISIT_DWELL times the dwell
REVISIT_DWELL = 3.0


def joint_model(config: Config, settings: PlanSettings) -> JointModel:
    from jointctl.tools.configuration.conversions import joint_rad_per_count
    from jointctl.tools.sweeping.carry_out import JointModel

    return JointModel(
        config.joint.reduction_ratio, config.joint.gravity_Nm, config.joint.gravity_zero_rad,
        abs(joint_rad_per_count(config)),
        (settings.ripple_per_joint_turn / math.tau,
         settings.ripple_per_motor_turn * config.joint.reduction_ratio / math.tau,
         2.0 * settings.ripple_per_motor_turn * config.joint.reduction_ratio / math.tau),
    )  # fmt: skip


def _speeds(points: Sequence[SweepPoint]) -> str:
    """The first eight, and how many there are besides."""
    shown = ", ".join(f"{point.velocity_radps:+.4g}" for point in points[:8])
    return f"{shown} rad/s" + (f" and {len(points) - 8} more" if len(points) > 8 else "")


@dataclass(frozen=True)
class SweepResult:
    """What a sweep measured: plateaus, in a file that `identify` reads."""

    points: int
    planned: int
    unsettled: int
    stopped_by: str | None  # name of the signal
    data: str  # the file
    plan: str  # hash


class Sweep:
    """One `sweep` command: plan, ask, measure, report."""

    def __init__(
        self, config: Config, output: Output, out: Path, options: SweepOptions, others: Remote | None = None
    ) -> None:
        from jointctl.tools.session.plan import TerminalConsent
        from jointctl.tools.sweeping.carry_out import config_of_sweep
        from jointctl.tools.sweeping.plan import make_plan, refuse_constants

        refuse_constants(config)
        self.config = config_of_sweep(config, options.mode)
        self.output = output
        self.out = out
        self.options = options
        self._others = others
        self.control: Control | None = None  # of the joint; in lockstep there is none
        self.plan = make_plan(config, options)
        self.file: SweepFile | None = None
        self.drive_state = ""
        self._attached_Nm = math.nan  # the load that the user has confirmed
        self._time_offset_s = 0.0
        self._unsettled: dict[int, SweepPoint] = {}
        self.consent = TerminalConsent(
            output, assume_yes=options.assume_yes or options.lockstep, dry_run=options.dry_run
        )

    def run(self) -> int:
        """The exit code: 0, 12 if declined, 130 after an interruption; raises `MotionFault` and the other errors."""
        from jointctl.tools.configuration.conversions import torque_constant_NmpA
        from jointctl.tools.recording.report_page import check_target
        from jointctl.tools.sweeping.data_file import SweepFile

        options = self.options
        check_files(self.out, options.resume)
        if options.report is not None:
            check_target(options.report)
        todo = list(self.plan.points)
        try:
            if options.resume:
                self.file = SweepFile.resume(self.out, torque_constant_NmpA(self.config), self.plan.hash)
                if self.control is not None:
                    self.control.signals.drives = self.file.drives  # data of two drives would be one curve
                done = self.file.done
                todo = [p for p in todo if p.index not in done]
                self._unsettled = {p.index: p for p in self.plan.points if p.index in self.file.unsettled}
                self.output.note(f"{self.out}: {len(done)} of {len(self.plan.points)} points are there already")
                if not todo and not self._to_revisit():
                    self.output.note("nothing is left to measure")
                    self._write_page()
                    return 0
            stopped: str | None = ""
            for condition in options.conditions:
                stopped = self._under(condition, [p for p in todo if p.condition == condition])
                if stopped != "":
                    break
            return self._report(stopped)
        finally:
            if self.file is not None:
                self.file.close()

    def _under(self, condition: Condition, points: list[SweepPoint]) -> str | None:
        """Measure under one load, at one place, and once more what did not settle; as `_measure`."""
        from jointctl.tools.session.plan import agreed

        again = [p for p in self._to_revisit() if p.condition == condition]
        if not (points or again):
            return ""
        if self.options.loads_Nm and not (self.options.lockstep or self.options.dry_run or self.options.assume_yes):
            load = f"A load of {condition.load_Nm:g} Nm at the joint: is it attached?"
            if condition.load_Nm != self._attached_Nm and not agreed(self.output, load):
                return "the user" if self.file is not None else None
            self._attached_Nm = condition.load_Nm
        stopped: str | None = ""
        if points:
            stopped = self._measure(points, self.options.warm_up_turns, 1.0)
        again = [p for p in self._to_revisit() if p.condition == condition]
        if stopped == "" and again:
            text = "1 point" if len(again) == 1 else f"{len(again)} points"
            self.output.note(f"{text} did not settle: once more, with more time")
            stopped = self._measure(again, 0.0, REVISIT_DWELL)
        return stopped

    def _to_revisit(self) -> list[SweepPoint]:
        """Points that did not settle and were not visited more than REVISITS times yet."""
        if self.file is None:
            return []
        visits = self.file.visits
        return [p for p in self.plan.points if p.index in self._unsettled and visits[p.index] <= REVISITS]

    def _measure(self, points: list[SweepPoint], warm_up_turns: float, dwell_factor: float) -> str | None:
        """Visit the points; the name of the signal that stopped it or "", None if it was declined or a dry run."""
        from jointctl.tools.configuration.conversions import torque_constant_NmpA
        from jointctl.tools.session.display import Displays, PhaseLines
        from jointctl.tools.session.session import Session
        from jointctl.tools.sweeping.carry_out import (
            MeterDisplay,
            SweepMeter,
            SweepPass,
            Tolerance,
            sweep_in_lockstep,
            sweep_run,
        )
        from jointctl.tools.sweeping.data_file import SweepFile

        config, options = self.config, self.options
        motion = self.plan.motion(points, warm_up_turns, dwell_factor)
        self._time_offset_s = self.file.elapsed_s if self.file is not None else 0.0
        meter = SweepMeter(motion.windows, joint_model(config, self.plan.settings), self._on_point)
        load_Nm = points[0].condition.load_Nm
        if options.lockstep and load_Nm and config.virtual is not None:
            carried = {"load_torque_Nm": config.virtual.load_torque_Nm + load_Nm}
            config = config.changed(virtual=carried)
        swept = SweepPass(config, motion, points)

        def begin(report: CommissioningReport) -> None:
            resolution_Nm = report.torque_resolution_Nm / config.joint.reduction_ratio
            settings = self.plan.settings
            short = settings.width_rad < settings.joint_period_rad
            meter.tolerance = Tolerance(SHORT_TOLERANCE if short else RELATIVE_TOLERANCE, 0.5 * resolution_Nm)
            if self.file is None:
                constant, ratio = torque_constant_NmpA(config), config.joint.reduction_ratio
                self.file = SweepFile.create(self.out, ratio, constant, self.plan.hash, self._about(report))

        if options.lockstep:
            ended = sweep_in_lockstep(swept, meter, self.consent, begin, allow_low_margin=options.allow_low_margin)
            if ended is None:
                return None
            self._raise_fault(*ended)
            return ""

        def display(report: CommissioningReport) -> Display:
            begin(report)
            title = "1 point" if len(points) == 1 else f"{len(points)} points"
            return Displays([PhaseLines(self.output), MeterDisplay(meter, self.output, title, motion.duration_s)])

        assert self.control is not None
        plan = sweep_run(swept, allow_low_margin=options.allow_low_margin)
        beside = display if self._others is None else self._others.beside(display)
        session = Session(plan, self.consent, self.output, self.control, beside)
        try:
            result = session.run()
        finally:
            self.drive_state = session.drive_state
        if result is None:
            return None
        if meter.lost_points:
            shown = _speeds(meter.lost_points)
            self.output.warning(f"too few samples came for {len(meter.lost_points)} points: {shown}; --resume")
        if result.lost_records:
            self.output.warning(f"{result.lost_records} log records were lost: the supervisor was too slow")
        self._raise_fault(result.fault, result.fault_text)
        return result.stopped_by

    def _about(self, report: CommissioningReport) -> dict[str, Any]:
        """What the sidecar tells besides the constants."""
        from importlib.metadata import version

        from jointctl.tools.sweeping.plan import recorded_limits

        options = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(self.options).items()}
        return {
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": {"jointctl": version("jointctl"), "python": sys.version.split()[0]},
            "drive": {**vars(report.identity), "mode": report.mode, **report.settings},
            "limits": recorded_limits(self.config),
            "torque_source": self.config.drive.torque_source,
            "gravity_subtracted_Nm": self.config.joint.gravity_Nm,
            "loaded": self.options.conditioned,
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
        from jointctl.tools.session.fault_words import ended_by

        if text is None:
            return
        done = len(self.file.done) if self.file is not None else 0
        points = "1 point is" if done == 1 else f"{done} points are"
        kept = f"{points} in {self.out}" if done else "nothing was measured"
        raise ended_by(fault, text, after=f"; {kept}", then="; then --resume" if done else "")

    def _report(self, stopped: str | None) -> int:
        from jointctl.tools.session import result as drive_end

        if stopped is None:
            left = "nothing moved; " + drive_end.words(self.drive_state)
            self.output.note(f"dry run: {left}" if self.options.dry_run else left)
            return 0 if self.options.dry_run else DECLINED
        drive_end.require_off(self.drive_state)
        assert self.file is not None
        done = len(self.file.done)
        found = SweepResult(
            done, len(self.plan.points), len(self._unsettled), stopped or None, str(self.out), self.plan.hash
        )
        self.output.result(self._table(), vars(found), found)
        self._write_page()
        if self._unsettled:
            shown = _speeds(list(self._unsettled.values()))
            problem = self.file.unsettled.get([*self._unsettled][-1])
            why = f"; the last one: {problem}; a longer --dwell may help" if problem else ""
            self.output.warning(f"{len(self._unsettled)} points never settled (settled = 0 in the file): {shown}{why}")
        if stopped:
            kept = f"what was measured is in {self.out}, --resume goes on" if done else "no plateau was measured"
            self.output.note(f"stopped by {stopped}; {kept}")
            return INTERRUPTED
        return 0

    def _write_page(self) -> None:
        from jointctl.tools.sweeping.data_file import write_sweep_page

        if self.options.report is not None and self.file is not None and self.file.done:
            write_sweep_page(self.options.report, self.out, self._table(), self.output)

    def _table(self) -> Table:
        done = len(self.file.done) if self.file is not None else 0
        table = Table(title="Sweep", title_justify="left", show_header=False)
        files = [("data", str(self.out)), ("sidecar", str(self.out.with_suffix(".json")))]
        for name, value in (
            ("points", f"{done} of {len(self.plan.points)}"),
            ("not settled", str(len(self._unsettled))),
            ("drive afterwards", self.drive_state or "none, it was simulated"),
            *(files if done else []),  # without one row they are removed
        ):
            table.add_row(name, value)
        return table


def sweep(
    config: JointOnBus,
    output: VerbOutput,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="CSV file to write; its sidecar is the same name with .json")
    ],
    options: SweepOptions = AS_IT_FITS,
    live: ObserveOptions = NOBODY,
) -> int:
    """Measure friction: plateaus of constant speed in both directions, into a CSV file for `identify`."""
    from jointctl.tools.scoping.remote import remote
    from jointctl.tools.session import result as drive_end
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.plan import require_terminal

    if options.lockstep and live != NOBODY:
        raise UsageError("--lockstep is simulated time: nothing of it can be watched with --foxglove or --ros2")
    if not (options.assume_yes or options.dry_run or options.lockstep):
        require_terminal()
    with contextlib.ExitStack() as stack:
        command = Sweep(config, output, out, options, stack.enter_context(remote(live, config, output, motion="sweep")))
        if not options.lockstep:
            command.control = stack.enter_context(in_control(command.config, output))
        try:
            return command.run()
        except KeyboardInterrupt:
            by = command.control.signals.by_command if command.control is not None else ""
            output.note(f"interrupted{by}; nothing moved" + ("" if command.file is None else " any more"))
            drive_end.require_off(command.drive_state)
            return INTERRUPTED
