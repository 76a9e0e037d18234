"""`jointctl doctor`: what this computer, its CAN adapter and the configuration allow, with a remedy for what is amiss.

Without --motion it reads and measures only: nothing moves, no object of the drive is written; all that is sent on the
bus is SDO requests to read: the device type (1000h), and what says how the drive's own quick stop brakes.  With it: is
torque and encoder the right way round, before the first run?
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from jointctl.drivers.errors import INTERRUPTED, MarginError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import JointOrVirtual, VerbOutput, Yes

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.inspection.health import Finding
    from jointctl.tools.session.control import Control


def findings(config: Config, *, cold: bool = False, wake_cycles: int | None = None) -> Iterator[Finding]:
    """All of them, each as soon as it is known; the wake-up is measured for a second each."""
    from jointctl.firmware_py.kernel import cache_folder
    from jointctl.tools.inspection.health import kernel_cache, kernel_findings, scheduling, software, wake_up
    from jointctl.tools.verbs.bench_drive import bench_of

    yield from software()
    yield from kernel_findings()
    yield from scheduling()
    yield from wake_up(config, wake_cycles or max(1, round(config.loop.rate_Hz)))
    yield from kernel_cache(cache_folder, cold)
    yield from bench_of(config).findings(config)


def doctor(
    config: JointOrVirtual,
    output: VerbOutput,
    *,
    cold: Annotated[bool, typer.Option("--cold", help="measure the cold start as well (about a minute)")] = False,
    motion: Annotated[
        bool, typer.Option("--motion", help="instead: pull the joint a little; are torque and encoders right?")
    ] = False,
    torque_Nm: Annotated[
        float | None, typer.Option("--torque", help="Nm at the joint at most, with --motion", min=0.0)
    ] = None,
    assume_yes: Yes = False,
) -> int:
    """What this computer and bus allow: real-time rights, wake-up times, kernel cache, bus budget, quick stop.

    Moves nothing; with --motion it asks first, then checks the directions of torque and encoders and their counts.
    """
    if motion:
        return doctor_motion(config, output, assume_yes=assume_yes, torque_Nm=torque_Nm)
    found = []
    for finding in findings(config, cold=cold):
        output.note(f"  {finding.topic}")
        found.append(finding)
    return report_findings(found, output, "Doctor")


def report_findings(found: list[Finding], output: Output, title: str) -> int:
    """The table, and 0, or 1 if a run would fail."""
    from jointctl.tools.inspection.health import NOTE, OK, PROBLEM

    table = Table("", "finding", "remedy", title=title, title_justify="left")
    colours = {OK: "green", NOTE: "yellow", PROBLEM: "red"}
    for finding in found:
        topic = Text.assemble((finding.status, colours[finding.status]), " ", finding.topic)
        table.add_row(topic, finding.text, finding.remedy)
    bad = any(finding.status == PROBLEM for finding in found)
    output.result(table, {"healthy": not bad, "findings": [asdict(finding) for finding in found]}, found)
    return 1 if bad else 0


def doctor_motion(config: Config, output: Output, *, assume_yes: bool, torque_Nm: float | None = None) -> int:
    """Commission, tell, ask, pull, judge; 0, 1 if something is wrong, 12 if declined, 130 after an interruption."""
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.plan import require_terminal

    if not assume_yes:
        require_terminal()
    with in_control(config, output) as control:
        return _pull(config, output, control, assume_yes=assume_yes, torque_Nm=torque_Nm)


def _pull(config: Config, output: Output, control: Control, *, assume_yes: bool, torque_Nm: float | None) -> int:
    from jointctl.firmware_py.states import Fault
    from jointctl.tools.inspection.motion_check import check_run, ended_finding, judged, make_plan, motion_findings
    from jointctl.tools.session.plan import TerminalConsent
    from jointctl.tools.session.result import broken_off, never_begun, require_off
    from jointctl.tools.session.session import Session
    from jointctl.tools.tuning.frequency_response import motor_fed

    config = motor_fed(config)  # the spring over a soft reducer would be unstable
    plan = make_plan(config, torque_Nm)
    session = Session(check_run(config, plan), TerminalConsent(output, assume_yes=assume_yes), output, control)
    try:
        result = session.run()
    except KeyboardInterrupt:
        return broken_off(session.drive_state, output, control.signals.by_command)
    except MarginError as error:  # gains of the file are none of the check
        softer = (
            f"the check pulls with a law of its own: its spring is softer with less --torque (now {plan.torque_Nm:g})"
        )
        raise MarginError(error.message, f"{softer}, or with wider limits.position_*") from None
    if result is None:
        return never_begun(session.drive_state, output)
    require_off(result.drive_state)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; the joint is {result.drive_state}; nothing was judged")
        if result.fault is Fault.NONE:
            return INTERRUPTED
        return report_findings([ended_finding(result.records, result.fault, result.fault_text)], output, "Motion")
    counts = result.report.counts_per_motor_turn
    found = [judged(config, counts)] if counts else []
    found += motion_findings(config, plan, result.records, result.fault, result.fault_text)
    output.note(f"  drive afterwards: {result.drive_state}; log: {result.log_place}")
    return report_findings(found, output, "Motion")
