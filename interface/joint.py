"""One joint from a program of one's own: `Joint` and its `State`.

    with Joint("my_joint.toml") as joint:
        joint.enable()
        joint.move_to(0.35, duration_s=2.0)

Units: rad, rad/s, rad/s^2, Nm, s, at the joint.  Every error is a `JointctlError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from jointctl.firmware_py.states import fault_name
from jointctl.program import OFF, PHASES, Motor, Newest, Program, Wanted, motor_of
from jointctl.tools.session.session_drive import drive_state_name
from jointctl.tools.session.set_points import SetPointError, finite

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config

__all__ = ["Joint", "SetPointError", "State"]


@dataclass(frozen=True)
class State:
    """What is known of the joint; before `enable` what commissioning found."""

    position_rad: float
    velocity_radps: float
    torque_Nm: float  # as the drive measures it
    desired_position_rad: float
    phase: str  # commissioned, waiting, enabling, approach, tracking, ramping, ...
    fault: str  # name of the fault that ends the run, "" without one
    drive_state: str  # in the words of CiA 402
    age_s: float  # of all this
    time_s: float  # CLOCK_MONOTONIC, or simulated time


class Joint(Program):
    """A joint that is commissioned when the `with` block begins, and switched off however it is left.

    `config` is a file, the name of a shipped configuration or a `Config`.  The name of a shipped one, or
    `virtual=True`, starts a virtual joint of its own.  `lockstep=True` is simulated time: deterministic, nothing moves
    but by `step`, `wait` and the motions; nothing is logged to a file and no margin is asked for.

    While the joint is enabled, the program must call it at least every `stream.client_timeout_s`: `command` with a
    set-point that is accepted, `state`, or one of the calls that wait.  A program that is silent for longer, an
    exception, Ctrl-C and the death of the interpreter brake the joint and disable it.

    `foxglove` (True, or "HOST:PORT") and `ros2` (True, or the domain) let others look on and stop; `allow_remote` lets
    them change gains as well.  Set-points are this program's alone.

    Several threads may call it in real time; simulated time is for one.
    """

    def __init__(
        self,
        config: str | Path | Config = "virtual",
        *,
        virtual: bool = False,
        lockstep: bool = False,
        interface: str | None = None,
        channel: str | None = None,
        bitrate: int | None = None,
        port: str | None = None,
        target: int | None = None,
        allow_low_margin: bool = False,
        foxglove: bool | str = False,
        ros2: bool | int = False,
        allow_remote: bool = False,
    ) -> None:
        place = interface, channel, bitrate, port, target
        wanted = Wanted(place, virtual, allow_low_margin, foxglove, ros2, allow_remote)
        super().__init__(motor_of(config, "Joint", wanted, lockstep=lockstep))

    @property
    def config(self) -> Config:
        """The configuration in force."""
        return self._axes.joints[0]

    @property
    def log_path(self) -> Path | None:
        """The run log; None at simulated time."""
        return next(iter(self._motor.log_paths), None)

    @property
    def state(self) -> State:
        """As of the newest cycle of the loop.  A sign of life."""
        return state_of(self._newest(), self._motor)

    def move_to(self, position_rad: float, duration_s: float | None = None, *, wait: bool = True) -> None:
        """From rest to rest along the quintic of least jerk; returns there, or at once without `wait`.

        `duration_s`: by default as quick as the moves of the live page.  `ConfigurationError` where position, speed or
        torque would leave the limits; `MotionFault` where the run ends on the way.
        """
        duration_s = None if duration_s is None else finite("duration_s", duration_s)
        self._move((finite("position_rad", position_rad),), duration_s, wait)

    def follow(self, times_s: npt.ArrayLike, positions_rad: npt.ArrayLike, *, wait: bool = True) -> None:
        """A table of ascending times (N,) and positions (N,), N from 2 to 65536, with a cubic spline through them.

        At rest at both ends.  The whole of it is checked against the limits first; then the joint moves to its
        beginning and follows it.  Errors as those of `move_to`.
        """
        self._follow(times_s, positions_rad, wait)

    def command(
        self,
        position_rad: float,
        velocity_radps: float | None = None,
        acceleration_radps2: float | None = None,
        torque_Nm: float = 0.0,
        *,
        time_s: float | None = None,
    ) -> None:
        """The next set-point: the joint is there `stream.delay_s` later, along the cubic from the one before.

        Without a velocity it is that from the set-point before to this one.  Without an acceleration it is that between
        the two velocities.  `torque_Nm` comes on top of the law's.  `time_s` is any clock of the program that runs at
        the rate of real time; without it set-points count as evenly spaced.  Returns at once.

        `SetPointError` names what is wrong, with value and limit: the joint goes on to the last valid set-point and
        rests there.  A set-point that is refused is no sign of life.
        """
        self._command((position_rad, velocity_radps, acceleration_radps2, torque_Nm), time_s)

    def step_torque(self, torque_Nm: float) -> State:
        """At simulated time only: one cycle with this torque [Nm] instead of the law's; the state after it.

        For laws in Python.  Limits of torque, rate, position and velocity hold as ever; there is no set-point, so that
        nothing else is watched, and from then on motions and set-points are refused.
        """
        motor = self._simulated("step_torque")
        motor.step_torque((finite("torque_Nm", torque_Nm),))
        return state_of(motor.newest(), motor)

    @property
    def records(self) -> Any:
        """At simulated time only: one log record each cycle so far, a structured array (N,)."""
        return self._simulated("records").records


def state_of(newest: Newest, motor: Motor, axis: int = 0) -> State:
    """The newest cycle of an axis in words and numbers."""
    if not newest.records:
        at_rad = newest.starts_rad[axis]
        return State(at_rad, 0.0, 0.0, at_rad, newest.phase, "", OFF, newest.age_s, newest.now_ns * 1e-9)
    record = newest.records[axis]
    fault = int(record["fault"])
    return State(
        position_rad=float(record["position_rad"]),
        velocity_radps=float(record["velocity_radps"]),
        torque_Nm=float(record["measured_torque_Nm"]),
        desired_position_rad=float(record["desired_position_rad"]),
        phase=PHASES[record["phase"]],
        fault=fault_name(fault) if fault else "",
        drive_state=drive_state_name(motor.drive, int(record["status_word"]), int(record["drive_state"])),
        age_s=newest.age_s,
        time_s=newest.now_ns * 1e-9,
    )
