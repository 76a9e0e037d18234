"""`jointctl doctor --motion`: is torque and encoder the right way round, before the first run?"""

from __future__ import annotations

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import Finding
from jointctl.tools.motion_check.plan import CheckPlan, CheckSupervisor, make_plan, require_room
from jointctl.tools.motion_check.verdict import ended_finding, judged, motion_findings
from jointctl.tools.output import Output
from jointctl.tools.recording.log_folder import log_path
from jointctl.tools.running.control import Control, in_control
from jointctl.tools.running.permission.consent import agreed, approval, require_terminal
from jointctl.tools.running.permission.envelope import remark_lines, where_lines
from jointctl.tools.running.permission.readiness import prepare_log, require_ready
from jointctl.tools.running.result import drive_end
from jointctl.tools.running.result.drive_end import require_off
from jointctl.tools.verbs.doctor import report_findings


def check_envelope(config: Config, plan: CheckPlan, report: CommissioningReport) -> list[str]:
    """What is about to happen, in lines."""
    start = report.start_position_rad
    lines = [
        *where_lines(report),
        f"motion     a soft spring pulls the joint towards {start + plan.travel_rad:+.3f}, then "
        f"{start - plan.travel_rad:+.3f} rad, {plan.duration_s:.0f} s",
        f"limits     {plan.torque_Nm:.1f} Nm, {plan.velocity_radps:.2f} rad/s; it is braked beyond "
        f"{plan.reach_rad:.2g} rad to either side: keep it free and unloaded, a hand on the emergency stop",
        "watch      which way it turns first: it must be the one that you call positive",
    ]
    return lines + remark_lines(report.remarks)


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
    path = log_path(config)
    found: list[Finding] = []

    def confirm(report: CommissioningReport) -> bool:
        if report.counts_per_motor_turn:
            found.append(judged(config, report.counts_per_motor_turn))
        for line in check_envelope(config, plan, report):
            output.fact(line)
        require_ready(config, report, path)
        require_room(config, plan, report.start_position_rad)
        if not (assume_yes or agreed(output)):
            return False
        prepare_log(config, path, output)
        return True

    approve = approval(output, assume_yes=assume_yes)
    supervisor = CheckSupervisor(config, output, path, confirm, plan, control, approve)
    try:
        result = supervisor.run()
    except KeyboardInterrupt:
        require_off(supervisor.drive_state)
        raise
    if result is None:
        output.note(f"nothing moved; {drive_end.words(supervisor.drive_state)}")
        return DECLINED
    require_off(result.drive_state)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; the joint is {result.drive_state}; nothing was judged")
        if result.fault is Fault.NONE:
            return INTERRUPTED
        return report_findings([ended_finding(result.records, result.fault, result.fault_text)], output, "Motion")
    found += motion_findings(config, plan, result.records, result.fault, result.fault_text)
    output.note(f"  drive afterwards: {result.drive_state}; log: {result.log_path}")
    return report_findings(found, output, "Motion")
