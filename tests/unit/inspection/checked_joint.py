"""The motion check on a virtual joint in simulated time."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import Finding
from jointctl.tools.motion_check.plan import CheckMotion, CheckPlan, config_of_check, make_plan, motion_table
from jointctl.tools.motion_check.verdict import motion_findings
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.simulation.lockstep import LockstepJoint


def check_in_lockstep(joint: LockstepJoint, config: Config, plan: CheckPlan, faults: Any = None) -> tuple[Any, Fault]:
    """The same motion on a virtual joint in simulated time: its records and the fault."""
    table = motion_table(plan, joint.report.start_position_rad)
    constants = CheckMotion(config_of_check(config, plan), plan).constants(joint.report, table)
    constants[0].sequence.supervisor_max_cycles = 0  # nobody watches in simulated time
    joint.table = table
    run = joint.run(constants) if faults is None else joint.run_with_faults(faults, constants)
    return run.log, run.fault


def checked(config: Config, change: Any = None, faults: Any = None) -> tuple[dict[str, Finding], Any, Fault]:
    """Findings by topic, records and fault; `change` may spoil the joint."""
    plan = make_plan(config, None)
    joint = LockstepJoint(config)
    if change is not None:
        change(joint)
    records, fault = check_in_lockstep(joint, config, plan, faults)
    text = fault_text(fault, 0.0, 0) if fault is not Fault.NONE else None
    return {f.topic: f for f in motion_findings(config, plan, records, fault, text)}, records, fault
