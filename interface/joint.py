"""One joint from a program of one's own: `Joint`, its `State`, and set-points that are refused.

    with Joint("my_joint.toml") as joint:
        joint.enable()
        joint.move_to(0.35, duration_s=2.0)

Units: rad, rad/s, rad/s^2, Nm, s, at the joint.  Every error is a `JointctlError`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from jointctl.drivers.errors import ConfigurationError, JointctlError, UsageError
from jointctl.firmware_py.records import MotionChange, SetPoint
from jointctl.firmware_py.safety import set_point_problem
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import SetPointProblem, TrajectoryKind
from jointctl.firmware_py.stream import CLOSE_SHARE

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config

POLL_S = 0.005
TABLE_ROWS = 1 << 16  # of `Joint.follow`, at most


class SetPointError(JointctlError):
    """A set-point was refused: the joint does not follow it."""

    exit_code = 7


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
        ...

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        """Returns when the joint follows set-points."""

    def require(self) -> None:
        """`JointctlError` if the joint follows nothing, with the cause."""

    def now_ns(self) -> int:
        """The loop's clock."""
        ...

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
    ) -> None:
        from jointctl.joint_source import joint_source

        place = interface, channel, bitrate, port, target
        source = joint_source(config, place, virtual=virtual)
        if lockstep:
            from jointctl.lockstep_joint import LockstepMotor

            self._motor: Motor = LockstepMotor(source.config)
        else:
            from jointctl.live_joint import LiveMotor

            self._motor = LiveMotor(source, allow_low_margin=allow_low_margin)
        self._stream: _Stream | None = None
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
        self._stream = _Stream(self._motor)

    def move_to(self, position_rad: float, duration_s: float | None = None, *, wait: bool = True) -> None:
        """From rest to rest along the quintic of least jerk; returns there, or at once without `wait`.

        `duration_s`: by default as quick as the moves of the live page.  `ConfigurationError` where position, speed or
        torque would leave the limits; `MotionFault` where the run ends on the way.
        """
        from jointctl.firmware_py.kernel import plain
        from jointctl.firmware_py.live_change import move_duration_s
        from jointctl.tools.session.live_changes import new_motion

        start_rad = self._at_rest()
        position_rad = _number("position_rad", position_rad)
        if duration_s is None:
            duration_s = float(plain(move_duration_s)(self._axis.change, position_rad - start_rad))
            if duration_s == 0.0:
                return
        values = {
            "kind": "min_jerk", "duration_s": 0.0, "start_rad": start_rad, "target_rad": position_rad,
            "move_s": _number("duration_s", duration_s), "dwell_s": 0.0, "repeat": False,
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
        end_ns = self._motor.now_ns() + round(_number("seconds", seconds) * 1e9)
        while (left_ns := end_ns - self._motor.now_ns()) > 0:
            self._alive()
            self._motor.wait(min(left_ns * 1e-9, 0.05))

    def step(self, seconds: float) -> None:
        """At simulated time only: the joint moves on for so long."""
        self._simulated("step").step(_number("seconds", seconds))

    def step_torque(self, torque_Nm: float) -> State:
        """At simulated time only: one cycle with this torque [Nm] instead of the law's; the state after it.

        For laws in Python.  Limits of torque, rate, position and velocity hold as ever; there is no set-point, so that
        nothing else is watched.
        """
        motor = self._simulated("step_torque")
        motor.step_torque(_number("torque_Nm", torque_Nm))
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

    def _following(self) -> _Stream:
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


def _number(name: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} (={str(value)[:40]}) must be a number") from None
    if not math.isfinite(number):
        raise ConfigurationError(f"{name} (={number:g}) must be finite")
    return number


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


_Point = tuple[int, float, float, float]  # time [ns], position, velocity, torque


class _Stream:
    """Writes set-points into the loop's ring, after the checks that the loop makes as well."""

    _TIME_GAIN, _CALLS = 0.05, 65  # of the clock recovered from calls without a time

    def __init__(self, motor: Motor) -> None:
        axis, state = motor.constants[0], motor.axis[0]
        self._motor, self._limits, self._constants = motor, axis.limits, axis.stream
        self._brake_radps2 = float(axis.sequence.brake_radps2)
        self._by_velocity = int(axis.command_kind) != 0
        stream = motor.constants["stream"]
        self._times, self._values = stream["time_ns"][0], stream["values"][0]
        self._written, self._alive_ns = stream["written"][0], stream["alive_ns"][0]
        self._delay_ns, self._timeout_ns = int(axis.stream.delay_ns), int(axis.stream.timeout_ns)
        self._close_ns = self._delay_ns // CLOSE_SHARE
        self._state, self._reference = state.stream, state.reference
        self._before, self._point = new(SetPoint), new(SetPoint)
        self._accepted: deque[_Point] = deque()
        self._calls_ns: deque[int] = deque(maxlen=self._CALLS)
        self._offset_ns: int | None = None  # of the program's own clock
        self._refused = int(self._state.refused)
        self.alive()

    def alive(self) -> None:
        """The program's sign of life."""
        self._alive_ns[0] = self._motor.now_ns()

    def take(
        self, position_rad: float, velocity_radps: float | None, acceleration_radps2: float | None, torque_Nm: float,
        time_s: float | None,
    ) -> None:  # fmt: skip
        """One set-point; `SetPointError` if it is refused."""
        self._motor.require()
        self._check_loop()
        try:
            position_rad, torque_Nm = float(position_rad), float(torque_Nm)
            velocity = None if velocity_radps is None else float(velocity_radps)
            acceleration = math.nan if acceleration_radps2 is None else float(acceleration_radps2)
        except (TypeError, ValueError):
            raise SetPointError("a set-point must be made of numbers") from None
        if acceleration_radps2 is not None and not math.isfinite(acceleration):
            raise SetPointError(f"acceleration_radps2 (={acceleration:g}) must be finite")
        if torque_Nm and self._by_velocity:
            raise SetPointError(f"torque_Nm (={torque_Nm:g}) must be 0: the drive closes the velocity loop by itself")
        now_ns, accepted = self._motor.now_ns(), self._accepted
        if accepted and accepted[-1][0] <= now_ns - self._delay_ns:  # the loop has come to the end of them
            accepted.clear()
        time_ns = self._time_of(time_s, now_ns, accepted[-1][0] if accepted else None)
        if accepted and time_ns <= accepted[-1][0]:
            self._refuse(SetPointProblem.TIME, (time_ns, position_rad, velocity or 0.0, torque_Nm), accepted[-1])
        if velocity is None:
            velocity = (position_rad - accepted[-1][1]) / ((time_ns - accepted[-1][0]) * 1e-9) if accepted else 0.0
        if not accepted:
            reference = self._reference
            rest_ns = now_ns - self._delay_ns
            start = float(reference.position_rad), float(reference.velocity_radps), float(self._state.torque_Nm)
            accepted.append((rest_ns, *start))
        before = accepted[0]
        for point in accepted:
            if time_ns - point[0] < self._close_ns:
                break
            before = point
        found = (time_ns, position_rad, velocity, torque_Nm)
        self._before[0], self._point[0] = (*before[:3], math.nan, before[3]), (*found[:3], acceleration, torque_Nm)
        problem = int(
            set_point_problem(self._limits, self._constants, self._brake_radps2, self._before[0], self._point[0])
        )
        if problem:
            self._refuse(problem, found, before)
        self._put(time_ns, (position_rad, velocity, acceleration, torque_Nm))
        while len(accepted) > 1 and time_ns - accepted[1][0] >= self._close_ns:
            accepted.popleft()
        accepted.append(found)
        self._alive_ns[0] = now_ns

    def _refuse(self, problem: int, point: _Point, before: _Point) -> None:
        if len(self._accepted) == 1:
            self._accepted.clear()  # that was only where the reference rests
        raise SetPointError(*self._words(SetPointProblem(problem), point, before))

    def _put(self, time_ns: int, values: tuple[float, ...]) -> None:
        number, slots = int(self._written[0]), len(self._times)
        if number - int(self._state.taken) >= slots:
            raise SetPointError(f"{slots} set-points wait for the loop already", "send them as the joint moves on")
        slot = number % slots
        self._times[slot], self._values[slot] = time_ns, values
        self._written[0] = number + 1  # last

    def _check_loop(self) -> None:
        refused = int(self._state.refused)
        if refused != self._refused:
            count, self._refused = refused - self._refused, refused
            self._accepted.clear()
            raise SetPointError(
                f"{count} set-points were not followed: they came after their time, or during another motion",
                "begin again from where the joint is to rest",
            )

    def _time_of(self, time_s: float | None, now_ns: int, last_ns: int | None) -> int:
        """Time of the set-point [ns]; calls without a time are taken as even, at the rate of the last ones."""
        if time_s is not None:
            given_ns = round(_number("time_s", time_s) * 1e9)
            if self._offset_ns is None or last_ns is None:
                self._offset_ns = now_ns - given_ns
            return given_ns + self._offset_ns
        self._offset_ns = None
        calls = self._calls_ns
        if last_ns is None or now_ns - calls[-1] > self._delay_ns:  # a beginning, or after a pause
            calls.clear()
        calls.append(now_ns)
        if last_ns is None or len(calls) == 1:
            return max(now_ns, (last_ns or 0) + 1)
        interval_ns = (now_ns - calls[0]) / (len(calls) - 1)
        off_ns = now_ns - (last_ns + interval_ns)
        return last_ns + max(round(interval_ns + self._TIME_GAIN * off_ns), round(0.5 * interval_ns), 1)

    def _words(self, problem: SetPointProblem, point: _Point, before: _Point) -> tuple[str, str]:
        """Message and hint: the value and what is allowed, and the key that it comes from."""
        limits, stream = self._limits, self._constants
        low, high, top = (float(limits[key]) for key in ("position_min_rad", "position_max_rad", "velocity_max_radps"))
        at, speed, torque = (
            f"position_rad (={point[1]:g})",
            f"velocity_radps (={point[2]:g})",
            f"torque_Nm (={point[3]:g})",
        )
        way, more = f"{point[1] - before[1]:+g} rad", f"{point[3] - before[3]:+g} Nm"
        later_s, longest_s = (point[0] - before[0]) * 1e-9, (self._timeout_ns + self._delay_ns) * 1e-9
        jump, steepest = float(stream.jump_max_rad), float(stream.acceleration_max_radps2)
        most, rate = float(stream.torque_max_Nm), float(stream.torque_rate_max_Nmps)
        start = f"{before[1]:g} rad at {before[2]:g} rad/s"
        texts = {
            SetPointProblem.TIME: (
                f"time_s is {later_s:g} s after the set-point before, must be in (0..{longest_s:g}]",
                "stream.timeout_s and stream.delay_s",
            ),
            SetPointProblem.POSITION: (f"{at} must be in [{low:g}..{high:g}]", "limits.position_*"),
            SetPointProblem.VELOCITY: (
                f"{speed}, or that on the way there, must be in [{-top:g}..{top:g}]", "limits.velocity_max_radps"
            ),
            SetPointProblem.JUMP: (
                f"{at} is {way} from the set-point before, must be within {jump:g} rad", "stream.jump_max_rad"
            ),
            SetPointProblem.ACCELERATION: (
                f"the way from {start} to {at} with {speed} in {later_s:g} s takes more than {steepest:g} rad/s2",
                "stream.acceleration_max_radps2",
            ),
            SetPointProblem.TORQUE: (f"{torque} must be in [{-most:g}..{most:g}]", "stream.torque_max_Nm"),
            SetPointProblem.TORQUE_RATE: (
                f"{torque} is {more} from the one before, must change by {rate:g} Nm/s at most",
                "stream.torque_rate_max_Nmps",
            ),
            SetPointProblem.STOPPING_WAY: (
                f"braked from {at} with {speed}, the joint would leave [{low:g}..{high:g}]",
                "limits.position_*, sequence.brake_radps2",
            ),
        }  # fmt: skip
        return texts[problem]
