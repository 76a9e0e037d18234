"""Carrying out the motions of one command, one after the other: on the drive, each as a session, or in lockstep.

One yes is for all of them, and one control of the joint.  The margin gate judges every loop before it is closed, in
simulated time as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import MotionFault, UsageError
from jointctl.firmware_py.states import Fault
from jointctl.hil.canopen.records import PowerState
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.configuration.config import Config
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import log_path
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.session.control import Control
from jointctl.tools.session.display import Display
from jointctl.tools.session.fault_words import FaultText, fault_text
from jointctl.tools.session.live_panel import run_display
from jointctl.tools.session.plan import Motion, RunPlan, TerminalConsent
from jointctl.tools.session.result import require_off
from jointctl.tools.session.session import Session


class NotCarriedOut(Exception):
    """A motion that was declined or only shown (`stopped_by` ""), or stopped by the user; the drive is off."""

    def __init__(self, drive_state: str, stopped_by: str = "") -> None:
        super().__init__(stopped_by)
        self.drive_state, self.stopped_by = drive_state, stopped_by


@dataclass(frozen=True)
class Carried:
    """What a motion left."""

    records: Any  # of the whole log
    fault: Fault
    text: FaultText | None
    log: str  # "" in simulated time


@dataclass
class Carrier:
    """For all motions of one command; `control` is None in lockstep."""

    output: Output
    consent: TerminalConsent
    control: Control | None
    allow_low_margin: bool = False
    drive_state: str = ""

    def quietly(self) -> Output:
        """For a part whose result is not that of the command."""
        return replace(self.output, quiet=True, json=False, taken=lambda _: None)

    def run(self, config: Config, motion: Motion, title: str, *, also_faults: bool = False) -> Carried:
        """The records; `MotionFault` after a fault unless `also_faults`, `NotCarriedOut` where it was not begun."""
        carried = self._simulated(config, motion) if self.control is None else self._moved(config, motion, title)
        if carried.text is not None and not also_faults:
            raise MotionFault(
                f"{title}: {carried.fault.name} ({int(carried.fault)}): {carried.text.happened}", carried.text.advice
            )
        return carried

    def _simulated(self, config: Config, motion: Motion) -> Carried:
        if not config.drive.simulated or config.drive.kind != "canopen":
            raise UsageError('--lockstep is for the virtual joint with drive.kind = "canopen"')
        require_margin(config, allow_low_margin=self.allow_low_margin)
        joint = LockstepJoint(config)
        placed = motion.placed(joint.report)
        if self.consent.dry_run:
            self.consent.show(placed.lines)
            raise NotCarriedOut("")
        motion.require_start(joint.report.start_position_rad)
        run = joint.run_as_configured(placed.constants, placed.table)
        self.drive_state = PowerState(int(run.device.state)).name.lower().replace("_", " ")
        text = fault_text(run.fault, float(run.state.fault_value), 0) if run.fault is not Fault.NONE else None
        return Carried(run.log, run.fault, text, "")

    def _moved(self, config: Config, motion: Motion, title: str) -> Carried:
        assert self.control is not None
        plan = RunPlan(config, motion, log_path(config), self.allow_low_margin)

        def display(_: CommissioningReport) -> Display:
            return run_display(self.output, title)()

        session = Session(plan, self.consent, self.output, self.control, display)
        try:
            result = session.run()
        except KeyboardInterrupt:
            raise NotCarriedOut(session.drive_state, self.control.signals.stopped_by) from None
        finally:
            self.drive_state = session.drive_state
        if result is None:
            raise NotCarriedOut(session.drive_state)
        require_off(session.drive_state)
        if result.stopped_by:
            raise NotCarriedOut(session.drive_state, result.stopped_by)
        if result.lost_records:
            self.output.warning(f"{result.lost_records} log records were lost: the supervisor was too slow")
        return Carried(read_run_log(result.log_path).records, result.fault, result.fault_text, str(result.log_path))


class ShownConsent(TerminalConsent):
    """One yes for all motions of a command; the envelope of each is shown all the same."""

    def show(self, lines: Sequence[str]) -> None:
        for line in lines:
            self._output.note(f"  {line}") if self._given else self._output.fact(line)
