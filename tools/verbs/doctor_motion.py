"""`jointctl doctor --motion`: is torque and encoder the right way round, before the first run?"""

from __future__ import annotations

from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.motion_check.plan import check_run, make_plan
from jointctl.tools.motion_check.verdict import ended_finding, judged, motion_findings
from jointctl.tools.output import Output
from jointctl.tools.session import result as drive_end
from jointctl.tools.session.consent import TerminalConsent, require_terminal
from jointctl.tools.session.control import Control, in_control
from jointctl.tools.session.result import require_off
from jointctl.tools.session.session import Session
from jointctl.tools.verbs.doctor import report_findings


def doctor_motion(config: Config, output: Output, *, assume_yes: bool, torque_Nm: float | None = None) -> int:
    """Commission, tell, ask, pull, judge; 0, 1 if something is wrong, 12 if declined, 130 after an interruption."""
    if not assume_yes:
        require_terminal()
    with in_control(config, output) as control:
        try:
            return _check(config, output, control, assume_yes=assume_yes, torque_Nm=torque_Nm)
        except KeyboardInterrupt:
            output.note(f"interrupted{control.signals.by_command}; nothing moved")
            return INTERRUPTED


def _check(config: Config, output: Output, control: Control, *, assume_yes: bool, torque_Nm: float | None) -> int:
    plan = make_plan(config, torque_Nm)
    session = Session(check_run(config, plan), TerminalConsent(output, assume_yes=assume_yes), output, control)
    try:
        result = session.run()
    except KeyboardInterrupt:
        require_off(session.drive_state)
        raise
    if result is None:
        output.note(f"nothing moved; {drive_end.words(session.drive_state)}")
        return DECLINED
    require_off(result.drive_state)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; the joint is {result.drive_state}; nothing was judged")
        if result.fault is Fault.NONE:
            return INTERRUPTED
        return report_findings([ended_finding(result.records, result.fault, result.fault_text)], output, "Motion")
    counts = result.report.counts_per_motor_turn
    found = [judged(config, counts)] if counts else []
    found += motion_findings(config, plan, result.records, result.fault, result.fault_text)
    output.note(f"  drive afterwards: {result.drive_state}; log: {result.log_path}")
    return report_findings(found, output, "Motion")
