"""One joint from a program of one's own: `Joint`, its `State`, and set-points that are refused.

    with Joint("my_joint.toml") as joint:
        joint.enable()
        joint.move_to(0.35, duration_s=2.0)

Units: rad, rad/s, rad/s^2, Nm, s, at the joint.  Every error is a `JointctlError`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from jointctl.drivers.errors import ConfigurationError, JointctlError, UsageError
from jointctl.firmware_py.records import MotionChange
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.tools.session.set_points import SetPointError, SetPointStream, finite

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config

__all__ = ["Joint", "SetPointError", "State"]

POLL_S = 0.005
TABLE_ROWS = 1 << 16  # of `Joint.follow`, at most


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


class Motor(Protocol):
    """What `Joint` needs of a run, in real time or at simulated time."""

    config: Config
    log_path: Path | None
    constants: Any  # record array of one AxisConstants, that of the loop
    axis: Any  # record array of one AxisState, that of the loop
    table: np.ndarray  # float64 (TABLE_ROWS, 5)

    def begin(self) -> None:
        """Commission: returns with the drive ready and disabled, or raises why not."""

    def state(self) -> State:
        """As of now."""

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        """Returns when the joint follows set-points."""

    def require(self) -> None:
        """`JointctlError` if the joint follows nothing, with the cause."""

    def now_ns(self) -> int:
        """The loop's clock."""

    def wait(self, seconds: float) -> None:
        """Time passes; `JointctlError` if the run has ended in the meantime."""

    def post(self, trajectory: Any, words: str) -> None:
        """Hand over a record array of one TrajectoryConstants; `MotionFault` where the loop does not take it."""

    def stop(self) -> None:
        """Brake, release, power off: returns when that is done."""

    def close(self) -> None:
        """As `stop`; nothing is left behind.  `JointctlError` with what went wrong."""


class Joint:
    """A joint that is commissioned when the `with` block begins, and switched off however it is left.

    `config` is a file, the name of a shipped configuration or a `Config`.  The name of a shipped one, or
    `virtual=True`, starts a virtual joint of its own.  `lockstep=True` is simulated time: deterministic, nothing moves
    but by `step`, `wait` and the motions; nothing is logged to a file and no margin is asked for.

    While the joint is enabled, the program must call it at least every `stream.client_timeout_s`: `command` with a
    set-point that is accepted, `state`, or one of the calls that wait.  A program that is silent for longer, an
    exception, Ctrl-C and the death of the interpreter brake the joint and disable it.

    `foxglove` (True, or "HOST:PORT") and `ros2` (True, or the domain) let others look on and stop; `allow_remote` lets
    them change gains as well.  Set-points are this program's alone.

    Not for several threads.
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
        from jointctl.joint_source import joint_source, observers

        place = interface, channel, bitrate, port, target
        source = joint_source(config, place, virtual=virtual)
        options = observers(foxglove, ros2, allow_remote=allow_remote)
        if lockstep:
            if options.foxglove is not None or options.ros2 is not None:
                raise UsageError("lockstep=True is simulated time: nothing of it can be watched with foxglove or ros2")
            from jointctl.lockstep_joint import LockstepMotor

            self._motor: Motor = LockstepMotor(source.config)
        else:
            from jointctl.live_joint import LiveMotor

            self._motor = LiveMotor(source, options, allow_low_margin=allow_low_margin)
        self._stream: SetPointStream | None = None
        self._enabled = False
        self._lasts_s = 0.0  # of the newest motion

    @property
    def config(self) -> Config:
        """The configuration in force."""
        return self._motor.config

    @property
    def log_path(self) -> Path | None:
        """The run log; None at simulated time."""
        return self._motor.log_path

    def __enter__(self) -> Self:
        self._motor.begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Brake and disable; what went wrong in the run is raised, unless the block has raised already."""
        try:
            self._motor.close()
        except JointctlError:
            if kind is None:
                raise

    @property
    def state(self) -> State:
        """As of the newest cycle of the loop.  A sign of life."""
        self._alive()
        return self._motor.state()

    def enable(self, approve: Callable[[Sequence[str]], bool] | None = None) -> None:
        """Check stability margin and limits, then power on: the joint holds where it stands.  Once for each Joint.

        `approve` is shown the lines of the motion envelope and has the last word; without it this call is the consent.
        `MarginError`, `MotionFault` or another `JointctlError` tells why it is not enabled.
        """
        if self._enabled:
            raise UsageError("the joint was enabled before; after a stop or a fault a new Joint is needed")
        self._enabled = True
        self._motor.enable(approve)
        self._stream = SetPointStream(self._motor)

    def move_to(self, position_rad: float, duration_s: float | None = None, *, wait: bool = True) -> None:
        """From rest to rest along the quintic of least jerk; returns there, or at once without `wait`.

        `duration_s`: by default as quick as the moves of the live page.  `ConfigurationError` where position, speed or
        torque would leave the limits; `MotionFault` where the run ends on the way.
        """
        from jointctl.firmware_py.kernel import plain
        from jointctl.firmware_py.live_change import move_duration_s
        from jointctl.tools.session.live_changes import new_motion

        start_rad = self._at_rest()
        position_rad = finite("position_rad", position_rad)
        if duration_s is None:
            duration_s = float(plain(move_duration_s)(self._axis.change, position_rad - start_rad))
            if duration_s == 0.0:
                return
        values = {
            "kind": "min_jerk", "duration_s": 0.0, "start_rad": start_rad, "target_rad": position_rad,
            "move_s": finite("duration_s", duration_s), "dwell_s": 0.0, "repeat": False,
        }  # fmt: skip
        self._go(*new_motion(self.config, self._motor.table, values), float(duration_s), wait)

    def follow(self, times_s: npt.ArrayLike, positions_rad: npt.ArrayLike, *, wait: bool = True) -> None:
        """A table of ascending times (N,) and positions (N,), N from 2 to 65536, with a cubic spline through them.

        At rest at both ends.  The whole of it is checked against the limits first; then the joint moves to its
        beginning and follows it.  Errors as those of `move_to`.
        """
        from jointctl.firmware_py.records import TrajectoryConstants
        from jointctl.tools.session.live_changes import checked_motion

        table = _table(times_s, positions_rad)
        trajectory = new(TrajectoryConstants)
        trajectory[0].kind, trajectory[0].table_rows = TrajectoryKind.TABLE, len(table)
        words = checked_motion(self.config, trajectory[0], table)
        self._at_rest()
        self._motor.table[: len(table)] = table
        self._go(trajectory, words, float(table[-1, 0]), wait)

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
        stream = self._following()
        if self._under_way:
            raise SetPointError("a motion is under way: set-points are followed from rest", "wait for its end")
        stream.take(position_rad, velocity_radps, acceleration_radps2, torque_Nm, time_s)

    def wait(self, seconds: float) -> None:
        """Wait, and say that the program is alive.  At simulated time the joint moves on for so long."""
        end_ns = self._motor.now_ns() + round(finite("seconds", seconds) * 1e9)
        while (left_ns := end_ns - self._motor.now_ns()) > 0:
            self._alive()
            self._motor.wait(min(left_ns * 1e-9, 0.05))

    def step(self, seconds: float) -> None:
        """At simulated time only: the joint moves on for so long."""
        self._simulated("step").step(finite("seconds", seconds))

    def step_torque(self, torque_Nm: float) -> State:
        """At simulated time only: one cycle with this torque [Nm] instead of the law's; the state after it.

        For laws in Python.  Limits of torque, rate, position and velocity hold as ever; there is no set-point, so that
        nothing else is watched.
        """
        motor = self._simulated("step_torque")
        motor.step_torque(finite("torque_Nm", torque_Nm))
        return motor.state()

    @property
    def records(self) -> Any:
        """At simulated time only: one log record each cycle so far, a structured array (N,)."""
        return self._simulated("records").records

    def stop(self) -> None:
        """Brake along the ramp, release, power off.  Nothing enables this Joint again."""
        self._motor.stop()

    # --- inside ---

    def _simulated(self, what: str) -> Any:
        if not hasattr(self._motor, "step"):
            raise UsageError(f"{what} is for simulated time: Joint(..., lockstep=True)")
        return self._motor

    @property
    def _axis(self) -> Any:
        return self._motor.constants[0]

    def _following(self) -> SetPointStream:
        if self._stream is None:
            raise UsageError("the joint is not enabled: call enable() first")
        return self._stream

    def _alive(self) -> None:
        if self._stream is not None:
            self._stream.alive()

    def _at_rest(self) -> float:
        """Where the reference rests; a motion that is under way comes to its end first."""
        self._following()
        self._motor.require()
        reference = self._motor.axis[0].reference
        while self._under_way or reference.velocity_radps != 0.0:
            self._alive()
            self._motor.wait(POLL_S)
        if self._axis.trajectory.kind == TrajectoryKind.TABLE:  # its rows may be written again
            hold = self._axis.trajectory.copy()
            hold.kind, hold.start_rad = TrajectoryKind.STREAM, reference.position_rad
            self._go([hold], "rest", 0.0, True)
        return float(reference.position_rad)

    @property
    def _under_way(self) -> bool:
        """Whether a motion that was asked for has not come to its end."""
        state = self._motor.axis[0]
        if state.change.motion != MotionChange.NONE:
            return True
        return self._axis.trajectory.kind != TrajectoryKind.STREAM and bool(state.trajectory_s < self._lasts_s)

    def _go(self, trajectory: Any, words: str, duration_s: float, wait: bool) -> None:
        self._alive()
        self._motor.post(trajectory, words)
        self._lasts_s = duration_s
        while wait and self._under_way:
            self._alive()
            self._motor.wait(POLL_S)


def _table(times_s: npt.ArrayLike, positions_rad: npt.ArrayLike) -> np.ndarray:
    from jointctl.firmware_py.trajectory import spline_table

    try:
        times, positions = np.asarray(times_s, np.float64), np.asarray(positions_rad, np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError("times_s and positions_rad must be arrays of numbers") from None
    if times.ndim != 1 or times.shape != positions.shape or not 2 <= len(times) <= TABLE_ROWS:
        raise ConfigurationError(
            f"times_s {times.shape} and positions_rad {positions.shape} must both be (N,), N in [2..{TABLE_ROWS}]"
        )
    for name, values in (("times_s", times), ("positions_rad", positions)):
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            raise ConfigurationError(f"{name}[{wrong[0]}] (={values[wrong[0]]:g}) must be finite")
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        row = int(late[0]) + 1
        raise ConfigurationError(f"times_s[{row}] (={times[row]:g}) must be above the one before ({times[row - 1]:g})")
    try:
        return spline_table(times - times[0], positions)
    except ValueError as error:
        raise ConfigurationError(f"times_s: {error}") from None
