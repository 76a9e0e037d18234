"""An arm from a program of one's own: `Arm` and its `ArmState`, as `Joint` and `State` with arrays of all joints.

with Arm("my_arm/arm.toml") as arm:
    arm.enable()
    arm.move_to([0.3, -0.5, 0.2], duration_s=2.0)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from jointctl.drivers.errors import ConfigurationError, one_line
from jointctl.joint import state_of
from jointctl.program import Newest, Program, Wanted, motor_of
from jointctl.tools.session.set_points import finite

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig

__all__ = ["Arm", "ArmState"]


@dataclass(frozen=True)
class ArmState:
    """What is known of the arm; arrays have one element a joint, in the order of `Arm.names`."""

    position_rad: np.ndarray
    velocity_radps: np.ndarray
    torque_Nm: np.ndarray  # as the drives measure it
    desired_position_rad: np.ndarray
    phase: str  # as of `State`; `tracking` if all joints are
    fault: str  # that ends the run, with the joint: "elbow: FOLLOWING_ERROR"; "" without one
    drive_state: tuple[str, ...]  # of each drive, in the words of CiA 402
    age_s: float  # of all this
    time_s: float  # CLOCK_MONOTONIC, or simulated time


class Arm(Program):
    """An arm that is commissioned when the `with` block begins; all its drives are switched off however it is left.

    `config` is an arm file or an `ArmConfig`; "virtual" is the shipped arm of three joints, with virtual drives of its
    own, as `virtual=True` gives them to a file.  All that `Joint` says of its program, of real and of simulated time
    holds for the arm as a whole: its joints are enabled together, begin each motion in the same cycle, stop together.
    """

    def __init__(
        self,
        config: str | Path | ArmConfig = "virtual",
        *,
        virtual: bool = False,
        lockstep: bool = False,
        interface: str | None = None,
        channel: str | None = None,
        bitrate: int | None = None,
        allow_low_margin: bool = False,
        foxglove: bool | str = False,
        ros2: bool | int = False,
    ) -> None:
        place = interface, channel, bitrate, None, None
        wanted = Wanted(place, virtual, allow_low_margin, foxglove, ros2)
        super().__init__(motor_of(config, "Arm", wanted, lockstep=lockstep))

    @property
    def config(self) -> ArmConfig:
        """The configuration in force."""
        arm = self._axes.arm
        assert arm is not None
        return arm

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints in the URDF, in the order of all arrays."""
        return self._axes.names

    @property
    def log_paths(self) -> tuple[Path, ...]:
        """The run log of each joint; () at simulated time."""
        return self._motor.log_paths

    @property
    def state(self) -> ArmState:
        """As of the newest cycle of the loop.  A sign of life."""
        return self._state(self._newest())

    def move_to(self, position_rad: npt.ArrayLike, duration_s: float | None = None, *, wait: bool = True) -> None:
        """From rest to rest along quintics of least jerk that begin and end together; `position_rad`: one a joint.

        `duration_s`: by default the longest that one of the joints takes for a move as `Joint.move_to` does it.
        Returns there, or at once without `wait`.  `ConfigurationError` where position, speed or torque of a joint would
        leave its limits, the torque also by the arm's model; `MotionFault` where the run ends on the way.
        """
        duration_s = None if duration_s is None else finite("duration_s", duration_s)
        self._move(self._numbers("position_rad", position_rad), duration_s, wait)

    def follow(self, times_s: npt.ArrayLike, positions_rad: npt.ArrayLike, *, wait: bool = True) -> None:
        """A table of ascending times (n,) and positions (n, N), n from 2 to 65536, with cubic splines through them.

        At rest at both ends.  The whole of it is checked against the limits first; then all joints move to its
        beginning, where they arrive together, and follow it.  Errors as those of `move_to`.
        """
        self._follow(times_s, positions_rad, wait)

    def command(
        self,
        position_rad: Sequence[float] | np.ndarray,
        velocity_radps: Sequence[float] | np.ndarray | None = None,
        acceleration_radps2: Sequence[float] | np.ndarray | None = None,
        torque_Nm: Sequence[float] | np.ndarray | None = None,
        *,
        time_s: float | None = None,
    ) -> None:
        """The next set-point of all joints, arrays of N; as `Joint.command` for each of them, with one time.

        What is wrong with one joint's part refuses the whole: `SetPointError` names the joint, its value and the limit,
        and all joints go on to the last valid set-point and rest there.
        """
        self._command((position_rad, velocity_radps, acceleration_radps2, torque_Nm), time_s)

    def step_torque(self, torque_Nm: npt.ArrayLike) -> ArmState:
        """At simulated time only: one cycle with these torques [Nm] instead of the laws'; the state after it.

        For laws in Python, which have to carry the arm's weight as well.  Limits as those of `Joint.step_torque`.
        """
        motor = self._simulated("step_torque")
        motor.step_torque(self._numbers("torque_Nm", torque_Nm))
        return self._state(motor.newest())

    @property
    def records(self) -> Any:
        """At simulated time only: the log records of each cycle so far, a structured array (n, N)."""
        return self._simulated("records").records.reshape(-1, len(self.names))

    def _numbers(self, name: str, given: npt.ArrayLike) -> tuple[float, ...]:
        try:
            values: np.ndarray = np.atleast_1d(np.ma.asarray(given, object).filled(np.nan))
        except ValueError:  # of arrays that make none together
            values = np.zeros((0, 0))
        if values.shape != (len(self.names),):
            shown = one_line(str(given))[:40]
            raise ConfigurationError(f"{name} (={shown}) must be {len(self.names)} numbers: {', '.join(self.names)}")
        return tuple(finite(f"{name} of {joint}", value) for joint, value in zip(self.names, values, strict=True))

    def _state(self, newest: Newest) -> ArmState:
        joints = [state_of(newest, self._motor, axis) for axis in range(len(self.names))]
        faults = [
            (int(axis.fault_slot_ns), f"{name}: {one.fault}")
            for name, one, axis in zip(self.names, joints, self._motor.axis if newest.records else (), strict=False)
            if one.fault
        ]
        return ArmState(
            position_rad=np.array([one.position_rad for one in joints]),
            velocity_radps=np.array([one.velocity_radps for one in joints]),
            torque_Nm=np.array([one.torque_Nm for one in joints]),
            desired_position_rad=np.array([one.desired_position_rad for one in joints]),
            phase=newest.phase,
            fault=min(faults, default=(0, ""))[1],
            drive_state=tuple(one.drive_state for one in joints),
            age_s=newest.age_s,
            time_s=newest.now_ns * 1e-9,
        )
