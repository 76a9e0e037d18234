"""A joint at simulated time for a program: the lockstep simulation, as far as the program lets it go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import MotionFault, UsageError
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.records import ChangeAnswer, ChangeKind
from jointctl.firmware_py.states import AxisPhase, ControllerKind, Fault, StopRequest, in_words
from jointctl.joint import TABLE_ROWS, State
from jointctl.live_joint import state_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import require_torque
from jointctl.tools.configuration.records import free_constants
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.session.live_changes import post_change
from jointctl.tools.session.session_drive import session_drive

STOP_S = 30.0  # of simulated time, for enabling or stopping


class LockstepMotor:
    """See `Motor`.  Nothing watches the program: between two of its calls no time passes."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.log_path: Path | None = None
        self._joint = LockstepJoint(config)
        self._drive = session_drive(config.drive.kind)
        constants = free_constants(config, self._joint.report.start_position_rad)
        constants[0].sequence.supervisor_max_cycles = 0  # nobody watches
        self._run = self._joint.stepped(constants, np.zeros((TABLE_ROWS, 5)))
        self._period_s = float(constants[0].law.period_s)
        self._left_s = 0.0  # of time asked for, less than a cycle
        memory = self._run.memory
        self._outside, self._outside_Nm = False, memory.state["law"]["outside_torque_Nm"]
        self.constants, self.axis, self.table = memory.constants, memory.state, memory.tables[0]

    def begin(self) -> None:
        """See `Motor`: done already."""

    def state(self) -> State:
        now_ns = self.now_ns()
        if not int(self._run.memory.words[Word.HEAD]):
            at_rad = self._joint.report.start_position_rad
            return State(at_rad, 0.0, 0.0, at_rad, "commissioned", "", "switch on disabled", 0.0, now_ns * 1e-9)
        return state_of(self._run.newest(), self._drive, now_ns)

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        if approve is not None and not approve((f"simulated: {self.config.path.name}",)):
            raise MotionFault("the motion was not approved; nothing has moved")
        self._until(AxisPhase.TRACKING)

    def _until(self, phase: AxisPhase) -> None:
        for _ in range(round(STOP_S / self._period_s)):
            if self.axis[0].phase >= phase:
                break
            self._run.step(1)
        if phase is AxisPhase.TRACKING:
            self.require()

    def require(self) -> None:
        axis = self.axis[0]
        phase, fault = AxisPhase(int(axis.phase)), Fault(int(axis.fault))
        if fault is not Fault.NONE:
            text = self._drive.fault_text(self.config, fault, float(axis.fault_value), int(axis.fault_drive_error))
            raise MotionFault(f"{fault.name} ({int(fault)}): {text.happened}", text.advice)
        if phase is not AxisPhase.TRACKING:
            raise MotionFault(
                f"the joint follows nothing ({in_words(phase)})", "enable() once; after a stop a new Joint"
            )

    def now_ns(self) -> int:
        """See `Motor`: simulated time."""
        return self._run.now_ns

    def step(self, seconds: float) -> None:
        """The joint moves on; what is less than a cycle is kept for the next call."""
        if not 0.0 <= seconds <= 86_400.0:
            raise UsageError(f"seconds (={seconds:g}) must be in [0..86400]")
        self._left_s += seconds
        cycles = math.floor(self._left_s / self._period_s + 1e-6)
        self._left_s = max(0.0, self._left_s - cycles * self._period_s)
        self._run.step(cycles)

    def wait(self, seconds: float) -> None:
        self._run.step(max(1, round(seconds / self._period_s)))
        self.require()

    def step_torque(self, torque_Nm: float) -> None:
        if not self._outside:
            self.require()
            require_torque(self.config, "step_torque")
            self._outside, axis = True, self.constants[0]
            axis.law.kind = ControllerKind.OUTSIDE
            limits = axis.limits
            limits.following_error_max_rad = math.inf
            limits.swing.torque_Nm = limits.swing.error_rad = limits.swing.noise_Nm = 0.0
            limits.frozen_max_rad = limits.frozen_torque_Nm = 0.0
        self._outside_Nm[0] = torque_Nm
        self._run.step(1)

    @property
    def records(self) -> Any:
        """Every log record so far, (N,)."""
        return self._run.records()

    def post(self, trajectory: Any, words: str) -> None:
        self.require()
        post_change(self.constants[0].change, ChangeKind.MOTION, trajectory)
        self._run.step(1)
        answer = ChangeAnswer(int(self.axis[0].change.answer))
        if answer is not ChangeAnswer.TAKEN:
            raise MotionFault(f"the loop did not take the motion {words}: {in_words(answer)}")

    def stop(self) -> None:
        if int(self._run.memory.words[Word.HEAD]) and self.axis[0].phase < AxisPhase.FINISHED:
            self._outside_Nm[0] = 0.0
            self._run.memory.words[Word.STOP] = StopRequest.RAMP
            self._until(AxisPhase.FINISHED)

    def close(self) -> None:
        self.stop()
        if self.axis[0].fault:
            self.require()
