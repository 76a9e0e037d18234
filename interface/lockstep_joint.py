"""Joints at simulated time for a program: the lockstep simulation, as far as the program lets it go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import MotionFault, UsageError
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.motion_records import ChangeAnswer, ChangeKind
from jointctl.firmware_py.states import AxisPhase, ControllerKind, Fault, StopRequest, in_words
from jointctl.program import TABLE_ROWS, Axes, Newest, NewMotion
from jointctl.tools.configuration.drive_section import require_torque
from jointctl.tools.configuration.records import free_constants
from jointctl.tools.lockstep import LockstepArm, LockstepJoint
from jointctl.tools.session.live_changes import post_change
from jointctl.tools.session.session_drive import latched_text, session_drive

STOP_S = 30.0  # of simulated time, for enabling or stopping


class LockstepMotor:
    """See `Motor`.  Nothing watches the program: between two of its calls no time passes."""

    def __init__(self, axes: Axes) -> None:
        self.axes, self.log_paths = axes, tuple[Path, ...]()
        self.drive = session_drive(axes.joints[0].drive.kind)
        tables = np.zeros((len(axes.joints), TABLE_ROWS, 5))
        if axes.arm is None:
            joint = LockstepJoint(axes.joints[0])
            constants, reports = free_constants(joint.config, joint.report.start_position_rad), [joint.report]
            self._run = joint.stepped(_unwatched(constants), tables[0])
        else:
            arm = LockstepArm(axes.arm)
            reports = arm.reports
            starts = zip(axes.joints, reports, strict=True)
            parts = [free_constants(config, report.start_position_rad) for config, report in starts]
            self._run = arm.stepped(_unwatched(axes.arm.connected(parts)), tables)
        self._starts_rad = tuple(report.start_position_rad for report in reports)
        memory = self._run.memory
        self._period_s = float(memory.constants[0].law.period_s)
        self._left_s = 0.0  # of time asked for, less than a cycle
        self._outside, self._outside_Nm = False, memory.state["law"]["outside_torque_Nm"]
        self.constants, self.axis, self.tables = memory.constants, memory.state, memory.tables
        self._phases = memory.state["phase"]

    def begin(self) -> None:
        """See `Motor`: done already."""

    def newest(self) -> Newest:
        now_ns, run = self._run.now_ns, self._run
        if not int(run.memory.words[Word.HEAD]):
            return Newest((), self._starts_rad, now_ns, now_ns)
        records = tuple(run.newest(axis) for axis in range(len(self._phases)))
        return Newest(records, self._starts_rad, now_ns, int(records[0]["time_ns"]))

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        name = self.axes.joints[0].path.name if self.axes.arm is None else self.axes.arm.path.name
        if approve is not None and not approve((f"simulated: {name}",)):
            raise MotionFault("the motion was not approved; nothing has moved")
        self.constants["sequence"]["may_enable"] = 1
        self._until(AxisPhase.TRACKING)

    def _until(self, phase: AxisPhase) -> None:
        for _ in range(round(STOP_S / self._period_s)):
            if self._phases.min() >= phase:
                break
            self._run.step(1)
        if phase is AxisPhase.TRACKING:
            self._require_tracking()

    def require(self) -> None:
        """See `Motor`."""
        self._require_tracking()
        if self._outside:
            raise UsageError("the torque is the program's since step_torque: no motion or set-point would be followed")

    def _require_tracking(self) -> None:
        joints = zip(self.axes.joints, self.axes.names, self.axis, strict=True)
        for config, name, axis in sorted(joints, key=lambda joint: int(joint[2].fault_slot_ns)):
            if (text := latched_text(config, axis)) is not None:
                fault, named = Fault(int(axis.fault)), f"{name}: " if name else ""
                raise MotionFault(f"{named}{fault.name} ({int(fault)}): {text.happened}", text.advice)
        for phase in self._phases:
            if phase != AxisPhase.TRACKING:
                raise MotionFault(
                    f"the joint follows nothing ({in_words(AxisPhase(int(phase)))})",
                    "enable() once; after a stop a new Joint",
                )

    def now_ns(self) -> int:
        """See `Motor`: simulated time."""
        return self._run.now_ns

    def step(self, seconds: float) -> None:
        """The motion goes on; what is less than a cycle is kept for the next call."""
        if not 0.0 <= seconds <= 86_400.0:
            raise UsageError(f"seconds (={seconds:g}) must be in [0..86400]")
        self._left_s += seconds
        cycles = math.floor(self._left_s / self._period_s + 1e-6)
        self._left_s = max(0.0, self._left_s - cycles * self._period_s)
        self._run.step(cycles)

    def wait(self, seconds: float) -> None:
        self._run.step(max(1, round(seconds / self._period_s)))
        self._require_tracking()

    def step_torque(self, torques_Nm: Sequence[float]) -> None:
        if not self._outside:
            self.require()
            for config in self.axes.joints:
                require_torque(config, "step_torque")
            self._outside = True
            for axis in self.constants:
                axis.law.kind = ControllerKind.OUTSIDE
                limits = axis.limits
                limits.following_error_max_rad = math.inf
                limits.swing.torque_Nm = limits.swing.error_rad = limits.swing.noise_Nm = 0.0
                limits.frozen_max_rad = limits.frozen_torque_Nm = 0.0
        self._outside_Nm[:] = torques_Nm
        self._run.step(1)

    @property
    def records(self) -> Any:
        """Every log record so far, one for each axis and cycle."""
        return self._run.records()

    def post(self, motions: Sequence[NewMotion], move_s: float) -> None:
        self.require()
        for axis, motion in zip(self.constants, motions, strict=True):
            post_change(axis.change, ChangeKind.MOTION, motion.trajectory, move_s)
        self._run.step(1)
        for axis, motion, name in zip(self.axis, motions, self.axes.names, strict=True):
            answer = ChangeAnswer(int(axis.change.answer))
            if answer is not ChangeAnswer.TAKEN:
                named = f"{name}: " if name else ""
                raise MotionFault(f"{named}the loop did not take the motion {motion.words}: {in_words(answer)}")

    def stop(self) -> None:
        if int(self._run.memory.words[Word.HEAD]) and self._phases.min() < AxisPhase.FINISHED:
            self._outside_Nm[:] = 0.0
            self._run.memory.words[Word.STOP] = StopRequest.RAMP
            self._until(AxisPhase.FINISHED)

    def close(self) -> None:
        self.stop()
        if self.axis["fault"].any():
            self.require()


def _unwatched(constants: Any) -> Any:
    constants["sequence"]["supervisor_max_cycles"] = 0
    constants["sequence"]["may_enable"] = 0  # until `enable`
    return constants
