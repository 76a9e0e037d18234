"""`jointctl doctor --motion`: is torque and encoder the right way round, before the first run?"""

from __future__ import annotations

from drivers.can.bus_claim import BusClaim
from drivers.drive import CommissioningReport
from drivers.errors import INTERRUPTED
from firmware_py.states import Fault
from tools.configuration.config import Config
from tools.inspection.drive_scale import scale_finding
from tools.inspection.findings import Finding
from tools.motion_check.carry_out import CheckSupervisor
from tools.motion_check.plan import CheckPlan, make_plan, require_room
from tools.motion_check.verdict import ended_finding, motion_findings
from tools.output import Output
from tools.recording.log_folder import log_path
from tools.running.permission.consent import agreed, require_terminal
from tools.running.permission.envelope import remark_lines, where_lines
from tools.running.permission.readiness import prepare_log, require_ready
from tools.running.result import drive_end
from tools.running.result.drive_end import require_off
from tools.verbs.doctor import report_findings


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


def _scale_of_the_drive(config: Config) -> list[Finding]:
    """Asked before the run has the bus; `BusError` where another program has it: its transfers are not disturbed."""
    if config.is_serial:
        return []
    with BusClaim(config.bus.interface, config.bus.channel):
        finding = scale_finding(config)
    return [] if finding is None else [finding]


def doctor_motion(config: Config, output: Output, *, assume_yes: bool, torque_Nm: float | None = None) -> int:
    """Commission, tell, ask, pull, judge; 0, or 1 if something is wrong, 130 after an interruption."""
    if not assume_yes:
        require_terminal()
    plan = make_plan(config, torque_Nm)
    path = log_path(config)
    found = _scale_of_the_drive(config)

    def confirm(report: CommissioningReport) -> bool:
        for line in check_envelope(config, plan, report):
            output.fact(line)
        require_ready(config, report, path)
        require_room(config, plan, report.start_position_rad)
        if not (assume_yes or agreed(output)):
            return False
        prepare_log(config, path, output)
        return True

    supervisor = CheckSupervisor(config, output, path, confirm, plan)
    try:
        result = supervisor.run()
    except KeyboardInterrupt:
        output.note("interrupted; nothing moved")
        require_off(supervisor.drive_state)
        return INTERRUPTED
    if result is None:
        output.note(f"nothing moved; {drive_end.words(supervisor.drive_state)}")
        return 0
    require_off(result.drive_state)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; the joint is {result.drive_state}; nothing was judged")
        if result.fault is Fault.NONE:
            return INTERRUPTED
        return report_findings([ended_finding(result.records, result.fault, result.fault_text)], output, "Motion")
    found += motion_findings(config, plan, result.records, result.fault, result.fault_text)
    output.note(f"  drive afterwards: {result.drive_state}; log: {result.log_path}")
    return report_findings(found, output, "Motion")
