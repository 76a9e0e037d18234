"""One scenario run and judged: the invariants that hold whatever happens, as lines that tell what was violated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jointctl.firmware_py.records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault, Reaction
from jointctl.firmware_py.trajectory import reference_at
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults.kinds import FaultKind
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_POSITION_rad, TRUE_VELOCITY_radps
from jointctl.tools.campaign.envelope import STANDSTILL_RADPS, Envelope, envelope
from jointctl.tools.campaign.fault_classes import FAULT_CLASSES, LATE_CAUSES
from jointctl.tools.campaign.scenario import BEFORE_s, Scenario, fitted, plant_of
from jointctl.tools.campaign.sweep_motion import LONGEST_s, SweepStrokes, placed_sweep
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants
from jointctl.tools.simulation.lockstep import LockstepJoint, LockstepRun

APPROACH_s = 1.0
SPARE_s = 14.0  # for waiting, enabling and stopping
TAIL_s = 2.5  # watched after the controller has ended
NOTICED_s = 0.35  # a certain fault that begins so long before the end of the trajectory must be noticed
POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)


@dataclass(frozen=True)
class Verdict:
    """What one scenario showed; plain values, for other processes and for JSON."""

    number: int
    kind: str
    harmless: bool
    fault: str
    reaction: str
    violations: tuple[str, ...]
    peak_radps: float
    beyond_rad: float  # how far the joint got beyond its position limits
    allowed_rad: float  # how far it may
    off_s: float | None  # from the latched fault to power off and standstill; None without a fault


def run_scenario(config: Config, joint: LockstepJoint, scenario: Scenario) -> tuple[LockstepRun, Any]:
    """The run, and the AxisConstants record array that it used; the joint's table is the scenario's afterwards."""
    if isinstance(scenario.trajectory, SweepStrokes):
        placed = placed_sweep(config, joint, scenario.trajectory, scenario.start_offset_rad)
        joint.table = placed.table
        return _carry_out(config, joint, scenario, placed.constants, placed.start_rad, placed.duration_s)
    sequence = config.sequence.model_copy(update={"approach_s": APPROACH_s})
    shown = config.model_copy(update={"trajectory": scenario.trajectory, "sequence": sequence})
    first = new(Reference)
    reference_at(axis_constants(shown, joint.table)[0].trajectory, joint.table, 0, 0.0, first[0])
    limits = config.limits
    start = float(first[0].position_rad) + scenario.start_offset_rad
    start = min(max(start, limits.position_min_rad + 0.05), limits.position_max_rad - 0.05)
    constants = axis_constants(shown, joint.table, start_position_rad=start)
    return _carry_out(shown, joint, scenario, constants, start, scenario.trajectory.duration_s)


def in_time(config: Config, joint: LockstepJoint, scenario: Scenario) -> Scenario:
    """A sweep's fault, drawn for the longest one, begins as early in this one: after its end it would prove nothing."""
    if not isinstance(scenario.trajectory, SweepStrokes):
        return scenario
    duration_s = placed_sweep(config, joint, scenario.trajectory, scenario.start_offset_rad).duration_s
    return replace(scenario, at_s=scenario.at_s * (BEFORE_s + duration_s) / (BEFORE_s + LONGEST_s))


def _carry_out(
    config: Config, joint: LockstepJoint, scenario: Scenario, constants: Any, start_rad: float, duration_s: float
) -> tuple[LockstepRun, Any]:
    plant_constants, plant_state = plant_of(config, scenario, start_rad)
    run = joint.run_with_faults(
        scenario.fault(), constants,
        plant_constants=plant_constants, plant_state=plant_state, epoch_at_start=True,
        longest_s=float(constants[0].sequence.approach_s) + duration_s + SPARE_s, tail_s=TAIL_s,
    )  # fmt: skip
    return run, constants


def _commands(run: LockstepRun, allowed: Envelope) -> list[str]:
    log, found = run.log, []
    torque = np.asarray(log.command_torque_Nm)
    powered = (log.phase >= AxisPhase.APPROACH) & (log.phase <= AxisPhase.RELEASING)
    if not np.isfinite(torque).all() or np.abs(torque).max() > allowed.command_max_Nm:
        found.append(f"torque command {np.abs(torque).max():.2f} Nm exceeds {allowed.command_max_Nm:g}")
    steps = np.abs(np.diff(torque))[powered[1:]]
    if len(steps) and steps.max() > allowed.command_step_Nm * (1.0 + 1e-9):
        found.append(f"torque command steps by {steps.max():.2f} Nm, allowed {allowed.command_step_Nm:g}")
    if torque[~powered].any():
        found.append("torque commanded in a phase without power")
    speed = np.asarray(log.command_velocity_radps)
    if not np.isfinite(speed).all() or np.abs(speed).max() > allowed.command_max_radps:
        found.append(f"velocity command {np.abs(speed).max():.3f} rad/s exceeds {allowed.command_max_radps:g}")
    steps = (np.abs(np.diff(speed)) / (1.0 + np.asarray(log.skipped)[1:]))[powered[1:]]
    if len(steps) and steps.max() > allowed.command_step_radps * (1.0 + 1e-9):
        found.append(f"velocity command steps by {steps.max():.4f} rad/s, allowed {allowed.command_step_radps:g}")
    if speed[~powered].any():
        found.append("a velocity commanded in a phase without power")
    return found


def _motion(run: LockstepRun, allowed: Envelope) -> list[str]:
    found = []
    position, velocity = run.truth[:, TRUE_POSITION_rad], run.truth[:, TRUE_VELOCITY_radps]
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        return ["the plant's state is not finite"]
    if position.min() < allowed.position_min_rad or position.max() > allowed.position_max_rad:
        found.append(
            f"position {position.min():.3f}..{position.max():.3f} rad leaves "
            f"{allowed.position_min_rad:.3f}..{allowed.position_max_rad:.3f}"
        )
    peak = np.abs(velocity).max()
    if peak > allowed.velocity_max_radps:
        found.append(f"speed {peak:.2f} rad/s exceeds {allowed.velocity_max_radps:.2f}")
    return found


def _off_row(run: LockstepRun) -> int:
    """The first row from which on the power stage is off and the joint stands."""
    busy = np.isin(run.truth[:, TRUE_POWER_STATE], POWERED)
    busy |= np.abs(run.truth[:, TRUE_VELOCITY_radps]) > STANDSTILL_RADPS
    rows = np.flatnonzero(busy)
    return int(rows[-1]) + 1 if len(rows) else 0


def _ending(run: LockstepRun, allowed: Envelope, fault_row: int, period_s: float) -> tuple[list[str], float | None]:
    found = []
    if run.state.phase != AxisPhase.FINISHED:
        found.append(f"the axis did not finish, phase {AxisPhase(int(run.state.phase)).name}")
    off_row = _off_row(run)
    if off_row >= len(run.truth):
        found.append("the joint is not off and at rest in the end")
    off_s = None
    if fault_row >= 0:
        off_s = max(off_row - fault_row, 0) * period_s
        longest = allowed.ramp_s if (run.log.phase == AxisPhase.RAMPING).any() else allowed.stop_s
        if off_s > longest:
            found.append(f"off and at rest {off_s:.3f} s after the fault, allowed {longest:.3f}")
    requests = np.asarray(run.log.request)
    asked = np.flatnonzero(requests == DriveRequest.ENABLE)
    if len(asked) and (np.diff(asked) != 1).any():
        found.append("the loop asked to enable again after it had asked to stop")
    return found, off_s


def _enabled_again(run: LockstepRun, scenario: Scenario, start_ns: int, period_ns: int) -> list[str]:
    """The power stage comes on at most once, but for what the wire does by itself.

    A frame may have been under way when the loop gave up; a corrupted one may say "enable", until a sound one comes.
    """
    enabled = run.truth[:, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED
    rises = np.flatnonzero(enabled[1:] & ~enabled[:-1]) + 1
    asked = np.flatnonzero(np.asarray(run.log.request) == DriveRequest.ENABLE)
    if not len(rises):
        return []
    if not len(asked):
        return [f"enabled although the loop never asked ({len(rises)} times)"]
    last_row = (int(run.log.time_ns[asked[-1]]) - start_ns) // period_ns
    wire_s = {FaultKind.RPDO_DELAYED: scenario.magnitude, FaultKind.RPDO_CORRUPTED: scenario.duration_s}
    late = 2 + int(wire_s.get(scenario.kind, 0.0) * 1e9 / period_ns)
    if rises[-1] > last_row + late:
        return [f"enabled again {(rises[-1] - last_row) * period_ns * 1e-6:.0f} ms after the loop had stopped asking"]
    return []


def _cause(run: LockstepRun, scenario: Scenario, period_s: float, start_ns: int) -> list[str]:
    fault, expected = run.fault, FAULT_CLASSES[scenario.kind]
    if scenario.harmless:
        return [] if fault is Fault.NONE else [f"a harmless fault tripped {fault.name} (={run.state.fault_value:.4f})"]
    if fault is Fault.NONE:
        times = (np.asarray(run.log.time_ns) - start_ns) * 1e-9
        moving = (run.log.phase >= AxisPhase.APPROACH) & (run.log.phase <= AxisPhase.TRACKING)
        tracked = times[moving]
        noticed_s = NOTICED_s + (scenario.duration_s if scenario.kind is FaultKind.LOOP_HELD_UP else 0.0)
        due = len(tracked) and tracked[0] < scenario.at_s - period_s and scenario.at_s + noticed_s < tracked[-1]
        return ["the fault was not noticed"] if expected.certain and due else []
    causes = expected.causes | LATE_CAUSES if expected.on_wire else expected.causes
    if fault not in causes:
        return [f"the cause is told as {fault.name} (={run.state.fault_value:.4f})"]
    code = int(run.state.fault_drive_error)
    if fault is Fault.DRIVE_NOT_ENABLED and expected.emergency not in (0, code):
        return [f"the drive's error code is told as {code:04X}h, not {expected.emergency:04X}h"]
    if scenario.kind is FaultKind.DRIVE_FAULT and run.state.fault_drive_error != scenario.magnitude:
        return [f"the drive's error code is told as {int(run.state.fault_drive_error):04X}h"]
    return []


def judge(config: Config, joint: LockstepJoint, scenario: Scenario) -> Verdict:
    """Run a scenario and check every invariant."""
    scenario = in_time(config, joint, fitted(config, scenario))
    run, constants = run_scenario(config, joint, scenario)
    axis = constants[0]
    period_s = float(axis.law.period_s)
    period_ns = round(period_s * 1e9)
    start_ns = int(joint.start_ns)
    allowed = envelope(config, scenario, axis)
    tripped = np.flatnonzero(run.log.fault != Fault.NONE)
    fault_row = (int(run.log.time_ns[tripped[0]]) - start_ns) // period_ns if len(tripped) else -1
    ending, off_s = _ending(run, allowed, fault_row, period_s)
    position = run.truth[:, TRUE_POSITION_rad]
    limits = axis.limits
    return Verdict(
        number=scenario.number,
        kind=scenario.kind.name.lower(),
        harmless=scenario.harmless,
        fault=run.fault.name,
        reaction=Reaction(int(run.state.reaction)).name,
        violations=tuple(
            _commands(run, allowed)
            + _motion(run, allowed)
            + ending
            + _enabled_again(run, scenario, start_ns, period_ns)
            + _cause(run, scenario, period_s, start_ns)
        ),
        peak_radps=float(np.abs(run.truth[:, TRUE_VELOCITY_radps]).max()),
        beyond_rad=float(max(position.max() - limits.position_max_rad, limits.position_min_rad - position.min(), 0.0)),
        allowed_rad=allowed.position_max_rad - float(limits.position_max_rad),
        off_s=off_s,
    )
