"""One axis on a stub joint, cycle by cycle, with phases that are short."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jointctl.firmware_py.axis import command_axis, move_axis, sense_axis
from jointctl.firmware_py.friction import paper_friction
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import solve_lyapunov_p
from jointctl.firmware_py.observers import low_pass_gain
from jointctl.firmware_py.records import NEURONS, AxisConstants, AxisState, Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import (
    AxisPhase,
    CommandKind,
    ControllerKind,
    DriveRequest,
    DriveState,
    Fault,
    Reaction,
    StopRequest,
    TrajectoryKind,
)

PERIOD_s = 1e-3
INERTIA_kgm2 = 2.1


@kernel
def step_axis(
    constants: AxisConstants,
    state: AxisState,
    table: np.ndarray,
    sample: Sample,
    command: Command,
    elapsed_cycles: int,
    stop_request: int,
    supervisor_age_cycles: int,
) -> None:
    """One cycle of an axis that is alone, its parts in the order in which `step_cycle` does them for all axes.

    `table` float64[N, 5], the rows of a table trajectory; `elapsed_cycles` >= 1 periods since the last call (more
    than 1 after an overrun); `stop_request` a `StopRequest`; `supervisor_age_cycles` periods since the supervisor's
    last sign of life.
    """
    sense_axis(constants, state, sample, elapsed_cycles, stop_request, supervisor_age_cycles)
    move_axis(constants, state, table, sample, elapsed_cycles, True, True)
    command_axis(constants, state, table, sample, command, elapsed_cycles)


def small_axis_constants() -> Any:
    """`AxisConstants` whose phases are short: 0.35 sin(0.2 pi t), approach 0.2 s, limits of a few cycles."""
    constants = new(AxisConstants)
    axis = constants[0]
    law, network = axis.law, axis.law.network
    law.kind = ControllerKind.COMPUTED_TORQUE_RBF
    law.period_s, law.inertia_kgm2, law.kp, law.kv, law.reduction_ratio = PERIOD_s, INERTIA_kgm2, 784.0, 56.0, 121.0
    law.friction = paper_friction()[0]
    law.lugre.stiffness_Nmprad, law.lugre.damping_Nmspr = 8e4, 200.0
    _, p12, p22 = solve_lyapunov_p(784.0, 56.0, 1800.0, 1800.0)
    network.p_b[0], network.p_b[1] = p12 / INERTIA_kgm2, p22 / INERTIA_kgm2
    half = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
    for i, centre in enumerate((*(-c for c in half), 0.0, *half)):
        network.centres[i, 0] = network.centres[i, 1] = centre
    for i in range(NEURONS):
        network.inverse_width[i] = 1.0 / (2.0 * 5.0**2)
    network.learning_rate, network.initial_weight = 80.0, 0.01
    axis.velocity.period_s, axis.velocity.cutoff_Hz = PERIOD_s, 100.0
    axis.velocity.period_gain = low_pass_gain(100.0, PERIOD_s)
    trajectory = axis.trajectory
    trajectory.kind, trajectory.amplitude_rad, trajectory.omega_radps = TrajectoryKind.SINE, 0.35, 0.2 * np.pi
    limits = axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -1.0, 1.0, 10.0
    limits.torque_max_Nm, limits.torque_rate_max_Nmps = 60.0, 20000.0
    limits.following_error_max_rad, limits.position_jump_max_rad = 0.2, 0.02
    limits.sample_age_max_cycles, limits.saturation_max_cycles, limits.skipped_max_cycles = 5, 20, 8
    limits.standstill_radps = 0.02
    sequence = axis.sequence
    sequence.approach_s, sequence.brake_radps2, sequence.release_s = 0.2, 20.0, 0.01
    sequence.settle_cycles, sequence.wait_max_cycles, sequence.enable_max_cycles = 4, 40, 30
    sequence.begin_max_cycles = 30
    sequence.stop_max_cycles, sequence.off_max_cycles, sequence.supervisor_max_cycles = 100, 20, 10
    sequence.may_enable = 1
    return constants


class StubJoint:
    """A frictionless inertia behind a drive that takes `delay_cycles` a step of its state machine."""

    def __init__(self, position_rad: float = 0.0, delay_cycles: int = 2) -> None:
        self.position_rad = position_rad
        self.velocity_radps = 0.0
        self.drive_state = DriveState.OFF
        self.delay_cycles = delay_cycles
        self._waited = 0
        self.load_Nm = 0.0

    def step(self, request: int, torque_Nm: float, cycles: int) -> None:
        """Move on by `cycles` periods with the command of the last cycle."""
        for _ in range(cycles):
            self._step_drive(request)
            force_Nm = self.load_Nm + (torque_Nm if self.drive_state == DriveState.ENABLED else 0.0)
            before_radps = self.velocity_radps
            self.velocity_radps += force_Nm / INERTIA_kgm2 * PERIOD_s
            if self.drive_state != DriveState.ENABLED:
                self.velocity_radps = 0.0  # friction and brake hold an unpowered joint
            self.position_rad += 0.5 * (before_radps + self.velocity_radps) * PERIOD_s

    def _step_drive(self, request: int) -> None:
        targets = {
            (DriveRequest.ENABLE, DriveState.OFF): DriveState.STARTING,
            (DriveRequest.ENABLE, DriveState.STARTING): DriveState.ENABLED,
            (DriveRequest.QUICK_STOP, DriveState.ENABLED): DriveState.STOPPING,
            (DriveRequest.QUICK_STOP, DriveState.STOPPING): DriveState.OFF,
            (DriveRequest.OFF, DriveState.STARTING): DriveState.OFF,
            (DriveRequest.OFF, DriveState.ENABLED): DriveState.OFF,
            (DriveRequest.OFF, DriveState.STOPPING): DriveState.OFF,
        }
        target = targets.get((DriveRequest(request), self.drive_state))
        self._waited += 1
        if target is None:
            self._waited = 0
        elif self._waited >= self.delay_cycles:
            self.drive_state, self._waited = target, 0


class Rig:
    """One axis on a stub joint, cycle by cycle; the records may be changed between cycles."""

    def __init__(self, position_rad: float = 0.0) -> None:
        self.joint = StubJoint(position_rad)
        self.constants = small_axis_constants()
        self.axis = self.constants[0]
        self.state = new(AxisState)[0]
        self.sample = new(Sample)[0]
        self.command = new(Command)[0]
        self.table = np.zeros((1, 5))
        self.twin_rad = 0.0  # by how much a second encoder is off the one that feeds the law
        self.stop = StopRequest.NONE
        self.supervisor_age_cycles = 0
        self.phases: list[AxisPhase] = []
        self.torques_Nm: list[float] = []
        self.requests: list[DriveRequest] = []
        reset_axis(self.axis, self.state)

    @property
    def phase(self) -> AxisPhase:
        return AxisPhase(int(self.state.phase))

    def tick(self, elapsed_cycles: int = 1, *, fresh: bool = True, offset_rad: float = 0.0) -> None:
        """One cycle: the joint moves on, its sample comes (or not), the axis answers."""
        self.joint.step(int(self.command.request), float(self.command.torque_Nm), elapsed_cycles)
        if fresh:
            self.sample.position_rad = self.joint.position_rad + offset_rad
            self.sample.second_position_rad = self.sample.position_rad + self.twin_rad
            self.sample.drive_state = self.joint.drive_state
            self.sample.count += 1
        self.state.slot_ns += round(elapsed_cycles * PERIOD_s * 1e9)
        step_axis(
            self.axis,
            self.state,
            self.table,
            self.sample,
            self.command,
            elapsed_cycles,
            int(self.stop),
            self.supervisor_age_cycles,
        )
        self.phases.append(self.phase)
        self.torques_Nm.append(float(self.command.torque_Nm))
        self.requests.append(DriveRequest(int(self.command.request)))

    def run(self, cycles: int) -> Rig:
        for _ in range(cycles):
            self.tick()
        return self

    def until(self, phase: AxisPhase, at_most: int = 2000) -> Rig:
        """Tick until the phase is reached."""
        tick_until(self, self.tick, phase, at_most)
        return self

    def reach(self, phase: AxisPhase) -> Rig:
        """The same, by a stop where it takes one."""
        if AxisPhase.RAMPING <= phase <= AxisPhase.QUICK_STOPPING:
            self.until(AxisPhase.TRACKING).run(5)
            self.stop = StopRequest.QUICK_STOP if phase is AxisPhase.QUICK_STOPPING else StopRequest.RAMP
        return self.until(phase)


def tick_until(rig: Rig, tick: Callable[[], None], phase: AxisPhase, at_most: int) -> None:
    """Until the rig is in the phase, which it must reach."""
    for _ in range(at_most):
        if rig.phase >= phase:
            break
        tick()
    assert rig.phase == phase, rig.state.fault


class OwnLoopRig:
    """A rig with an ideal drive: the joint is where the target of two cycles ago was, or as fast as is commanded.

    `command`: values of its `VelocityCommandConstants`.
    """

    def __init__(self, rig: Any, kind: CommandKind, **command: float) -> None:
        self.rig, self.kind = rig, kind
        rig.axis.command_kind, rig.axis.trajectory.kind = kind, TrajectoryKind.SINE
        for name, value in command.items():
            setattr(rig.axis.velocity_command, name, value)
        self.targets: list[float] = []
        self.commands: list[float] = []
        self.enabled: list[bool] = []

    def tick(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            joint, command = self.rig.joint, self.rig.command
            if joint.drive_state == DriveState.ENABLED:
                if self.kind is CommandKind.VELOCITY:
                    joint.position_rad += float(command.velocity_radps) * PERIOD_s
                elif len(self.targets) > 2 and self.enabled[-2]:
                    joint.position_rad = self.targets[-2]
            joint.velocity_radps = 0.0
            self.rig.tick()
            self.targets.append(float(self.rig.command.position_rad))
            self.commands.append(float(self.rig.command.velocity_radps))
            self.enabled.append(joint.drive_state == DriveState.ENABLED)

    def until(self, phase: AxisPhase, at_most: int = 3000) -> None:
        tick_until(self.rig, self.tick, phase, at_most)


NewRig = Callable[..., Any]
POWERED = (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING)


def assert_safe_history(run: Any) -> None:
    """Forward only, never enabled again, torque only while powered."""
    assert run.phases == sorted(run.phases)
    first_other = next((i for i, r in enumerate(run.requests) if r is not DriveRequest.OFF), len(run.requests))
    enabled = [r is DriveRequest.ENABLE for r in run.requests[first_other:]]
    assert enabled == sorted(enabled, reverse=True)
    assert all(torque == 0.0 for phase, torque in zip(run.phases, run.torques_Nm, strict=True) if phase not in POWERED)


def finish(run: Any) -> Any:
    run.until(AxisPhase.FINISHED)
    assert_safe_history(run)
    return run


def assert_fault(run: Any, fault: Fault, reaction: Reaction) -> None:
    assert (Fault(int(run.state.fault)), Reaction(int(run.state.reaction))) == (fault, reaction)
    assert run.state.fault_drive_error in (0, run.sample.drive_error)
    run.joint.load_Nm = 0.0
    finish(run)
    assert run.state.fault == fault


def assert_well(run: Any) -> None:
    assert run.state.fault == Fault.NONE
    assert run.phase == AxisPhase.TRACKING
