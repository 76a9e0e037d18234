"""Set-points of a program on their way into the ring of the loop: checked as the loop does, refused in words.

`SetPointStream` is one source.  `SetPointSources` holds the sources of a run apart that have processes of their own:
the first whose set-point is accepted has the joint until the run ends, every other one is refused by its name.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.live_change import CLOSE_SHARE
from jointctl.firmware_py.motion_records import MotionChange, SetPoint
from jointctl.firmware_py.records import AxisConstants
from jointctl.firmware_py.safety import set_point_problem
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, SetPointProblem, TrajectoryKind, in_words
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import expect_client
from jointctl.tools.recording.run_log import INFO, WARNING
from jointctl.tools.session.loop_memory import SharedBlock
from jointctl.tools.session.plan import Placed

TELL_S = 1.0  # how often refusals are reported, at most
LATEST_S = 4e9  # of a program's clock, either way: the loop counts nanoseconds in 64 bits
MOST_SOURCES = 16  # whose refusals are counted one by one in a report


class SetPointError(JointctlError):
    """A set-point was refused: the joint does not follow it."""

    exit_code = 7


class StreamedLoop(Protocol):
    """What a source needs of the loop, in real time or at simulated time."""

    @property
    def constants(self) -> Any:
        """Record array of AxisConstants, those of the loop."""

    @property
    def axis(self) -> Any:
        """Record array of AxisState, those of the loop."""

    def now_ns(self) -> int:
        """The loop's clock."""

    def require(self) -> None:
        """`JointctlError` if the joint follows nothing, with the cause."""


def _number(value: Any) -> float:
    """As `float`, but no text, no answer to a question, and nothing that has an imaginary part to lose."""
    if isinstance(value, (str, bytes, bool, np.bool_, np.complexfloating)):
        raise TypeError
    try:
        return float(value)
    except OverflowError:  # a whole number beyond all others
        return math.inf


def finite(name: str, value: float) -> float:
    """`ConfigurationError` for what is no finite number."""
    try:
        number = _number(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} (={str(value)[:40]}) must be a number") from None
    if not math.isfinite(number):
        raise ConfigurationError(f"{name} (={number:g}) must be finite")
    return number


def vector(name: str, given: object, names: Sequence[str]) -> tuple[float, ...]:
    """One number for each joint, finite or not; `SetPointError` for what is none."""
    try:
        values: Any = given if isinstance(given, (Sequence, np.ndarray)) and np.ndim(given) else (given,)
        numbers = tuple(map(_number, values))
    except (TypeError, ValueError):
        what = "a number" if len(names) == 1 else f"{len(names)} numbers, one a joint"
        raise SetPointError(f"{name} (={str(given)[:40]}) must be {what}") from None
    if len(numbers) != len(names):
        raise SetPointError(f"{name} (={len(numbers)} numbers) must have {len(names)}, one a joint")
    return numbers


def load_check() -> None:
    """Compile or load the loop's check before the loop watches its client: that may take seconds."""
    axis, point = new(AxisConstants)[0], new(SetPoint)[0]
    set_point_problem(axis.limits, axis.stream, 0.0, point, point)


_Point = tuple[int, float, float, float]  # time [ns], position, velocity, torque
_Given = tuple[float, float | None, float, float]  # position, velocity, acceleration, torque
Numbers = float | Sequence[float] | np.ndarray  # one a joint


class _AxisPoints:
    """Set-points of one axis: those that the loop follows, what is wrong with the next one, and the loop's ring."""

    def __init__(self, loop: StreamedLoop, number: int, name: str) -> None:
        axis, state, stream = loop.constants[number], loop.axis[number], loop.constants["stream"]
        self.name, self._limits, self._constants = name, axis.limits, axis.stream
        self._brake_radps2 = float(axis.sequence.brake_radps2)
        self._takes_torque = int(axis.command_kind) == 0 or int(axis.velocity_command.feeds_torque) != 0
        self._times, self._values = stream["time_ns"][number], stream["values"][number]
        self.written, self.alive_ns = stream["written"][number], stream["alive_ns"][number]
        self.delay_ns, self._timeout_ns = int(axis.stream.delay_ns), int(axis.stream.timeout_ns)
        self._close_ns = self.delay_ns // CLOSE_SHARE
        self.state, self._reference = state.stream, state.reference
        self._before, self._point = new(SetPoint), new(SetPoint)
        self.accepted: deque[_Point] = deque()

    def begin(self, now_ns: int) -> None:
        """The way to the first set-point is from where the reference is."""
        reference = self._reference
        start = float(reference.position_rad), float(reference.velocity_radps), float(self.state.torque_Nm)
        self.accepted.append((now_ns - self.delay_ns, *start))

    def checked(self, time_ns: int, given: _Given) -> _Point:
        """The set-point, without a velocity with that on the way to it; `SetPointError` if it must not be followed."""
        accepted, (position_rad, velocity, acceleration, torque_Nm) = self.accepted, given
        last = accepted[-1]
        if time_ns <= last[0]:
            raise self._refusal(SetPointProblem.TIME, (time_ns, position_rad, velocity or 0.0, torque_Nm), last)
        if torque_Nm and not self._takes_torque:
            raise self.error(f"torque_Nm (={torque_Nm:g}) must be 0: the drive closes its own loop, without 60B2")
        if velocity is None:
            velocity = (position_rad - last[1]) / ((time_ns - last[0]) * 1e-9)
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
            raise self._refusal(SetPointProblem(problem), found, before)
        return found

    def put(self, point: _Point, acceleration: float) -> None:
        """Into the ring; the loop takes it once it is counted."""
        slot = int(self.written[0]) % len(self._times)
        self._times[slot], self._values[slot] = point[0], (*point[1:3], acceleration, point[3])
        accepted = self.accepted
        while len(accepted) > 1 and point[0] - accepted[1][0] >= self._close_ns:
            accepted.popleft()
        accepted.append(point)

    def require_room(self) -> None:
        slots = len(self._times)
        if int(self.written[0]) - int(self.state.taken) >= slots:
            raise SetPointError(f"{slots} set-points wait for the loop already", "send them as the joint moves on")

    def error(self, text: str, hint: str = "") -> SetPointError:
        """With the joint's name in front where it is one of several."""
        return SetPointError(f"{self.name}: {text}" if self.name else text, hint)

    def _refusal(self, problem: SetPointProblem, point: _Point, before: _Point) -> SetPointError:
        """Message and hint: the value and what is allowed, and the key that it comes from."""
        limits, stream = self._limits, self._constants
        low, high, top = (float(limits[key]) for key in ("position_min_rad", "position_max_rad", "velocity_max_radps"))
        at, speed, torque = (
            f"position_rad (={point[1]:g})",
            f"velocity_radps (={point[2]:g})",
            f"torque_Nm (={point[3]:g})",
        )
        way, more = f"{point[1] - before[1]:+g} rad", f"{point[3] - before[3]:+g} Nm"
        later_s, longest_s = (point[0] - before[0]) * 1e-9, (self._timeout_ns + self.delay_ns) * 1e-9
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
        return self.error(*texts[problem])


class SetPointStream:
    """Writes set-points of all joints into the loop's rings, after the checks that the loop makes as well.

    One that is refused for one joint is refused for all: nothing of it is written.
    """

    _TIME_GAIN, _CALLS = 0.05, 65  # of the clock recovered from calls without a time

    def __init__(self, loop: StreamedLoop, names: Sequence[str] = ("",)) -> None:
        """`names` of the joints, for messages; "" where there is only one."""
        self._loop, self._names = loop, names
        self._axes = [_AxisPoints(loop, number, name) for number, name in enumerate(names)]
        self._zeros, self._none_given = (0.0,) * len(names), (math.nan,) * len(names)
        self._delay_ns = self._axes[0].delay_ns
        self._calls_ns: deque[int] = deque(maxlen=self._CALLS)
        self._offset_ns: int | None = None  # of the program's own clock
        self._refused = self._refused_by_loop()
        self.alive()

    def alive(self) -> None:
        """The program's sign of life."""
        now_ns = self._loop.now_ns()
        for axis in self._axes:
            axis.alive_ns[0] = now_ns

    def take(
        self, position_rad: Numbers, velocity_radps: Numbers | None, acceleration_radps2: Numbers | None,
        torque_Nm: Numbers | None, time_s: float | None,
    ) -> None:  # fmt: skip
        """One set-point, of each joint; `SetPointError` if it is refused."""
        self._loop.require()
        self._check_loop()
        axes, names = self._axes, self._names
        positions = vector("position_rad", position_rad, names)
        torques = self._zeros if torque_Nm is None else vector("torque_Nm", torque_Nm, names)
        velocities: Sequence[float | None] | None = None
        if velocity_radps is not None:
            velocities = vector("velocity_radps", velocity_radps, names)
        accelerations = self._none_given
        if acceleration_radps2 is not None:
            accelerations = vector("acceleration_radps2", acceleration_radps2, names)
            for axis, value in zip(axes, accelerations, strict=True):
                if not math.isfinite(value):
                    raise axis.error(f"acceleration_radps2 (={value:g}) must be finite")
        now_ns, accepted = self._loop.now_ns(), axes[0].accepted
        if accepted and accepted[-1][0] <= now_ns - self._delay_ns:  # the loop has come to the end of them
            self._forget()
        time_ns = self._time_of(time_s, now_ns, accepted[-1][0] if accepted else None)
        if not accepted:
            velocities = velocities or self._zeros
            for axis in axes:
                axis.begin(now_ns)
        given = zip(positions, velocities or (None,) * len(axes), accelerations, torques, strict=True)
        try:
            found = [axis.checked(time_ns, values) for axis, values in zip(axes, given, strict=True)]
        except SetPointError:
            if len(accepted) == 1:
                self._forget()  # that was only where the reference rests
            raise
        for axis in axes:
            axis.require_room()
        for axis, point, acceleration in zip(axes, found, accelerations, strict=True):
            axis.put(point, acceleration)
        for axis in axes:  # last
            axis.written[0] += 1
            axis.alive_ns[0] = now_ns

    def _forget(self) -> None:
        for axis in self._axes:
            axis.accepted.clear()

    def _refused_by_loop(self) -> int:
        return max(int(axis.state.refused) for axis in self._axes)

    def _check_loop(self) -> None:
        refused = self._refused_by_loop()
        if refused != self._refused:
            count, self._refused = refused - self._refused, refused
            self._forget()
            raise SetPointError(
                f"{count} set-points were not followed: they came after their time, or during another motion",
                "begin again from where the joint is to rest",
            )

    def _time_of(self, time_s: float | None, now_ns: int, last_ns: int | None) -> int:
        """Time of the set-point [ns]; calls without a time are taken as even, at the rate of the last ones."""
        if time_s is not None:
            (given_s,) = vector("time_s", time_s, ("",))
            if not abs(given_s) <= LATEST_S:
                raise SetPointError(f"time_s (={given_s:g}) must be in [{-LATEST_S:g}..{LATEST_S:g}]")
            given_ns = round(given_s * 1e9)
            if self._offset_ns is None or last_ns is None:
                self._offset_ns = now_ns - given_ns
            return given_ns + self._offset_ns
        self._offset_ns = None
        calls = self._calls_ns
        if last_ns is None or not calls or now_ns - calls[-1] > self._delay_ns:  # a beginning, or after a pause
            calls.clear()
        calls.append(now_ns)
        if last_ns is None or len(calls) == 1:
            return max(now_ns, (last_ns or 0) + 1)
        interval_ns = (now_ns - calls[0]) / (len(calls) - 1)
        off_ns = now_ns - (last_ns + interval_ns)
        return last_ns + max(round(interval_ns + self._TIME_GAIN * off_ns), round(0.5 * interval_ns), 1)


# --- Sources in processes of their own ---


@dataclass(frozen=True)
class RemoteSetPoint:
    """As the arguments of `Joint.command`, of an arm those of `Arm.command`, and who sends it."""

    who: str
    position_rad: Numbers
    velocity_radps: Numbers | None = None
    acceleration_radps2: Numbers | None = None
    torque_Nm: Numbers | None = None
    time_s: float | None = None


class SetPointSources:
    """Which source has the joint; called from the thread of each source and from the supervisor.

    `owner`: the program that has it from the beginning.  Without one, the supervisor gives the sign of life that the
    loop expects, until a source has it: from then on that source's accepted set-points are the only one.
    """

    def __init__(self, owner: str = "") -> None:
        self.owner = owner
        self._program = owner
        self._block: SharedBlock | None = None
        self._names: Sequence[str] = ("",)
        self._stream: SetPointStream | None = None
        self._lock = threading.Lock()
        self._news: list[tuple[int, str]] = []
        self._refused: dict[str, tuple[int, str]] = {}  # how often since the last report, and why the last time
        self._told_s = -TELL_S

    def announced(self, placed: Placed, config: Config) -> Placed:
        """The motion that is about to begin, with what these sources may do; the loop watches them."""
        if self._program:
            return placed
        expect_client(placed.constants, config)
        load_check()
        line = (
            "remote     set-points from Foxglove or ROS 2 where the joint holds its place, by anyone who reaches them; "
            f"a source may be silent for {config.stream.client_timeout_s:g} s"
        )
        return replace(placed, lines=(*placed.lines, line))

    # what SetPointStream asks for

    @property
    def constants(self) -> Any:
        return self._running().constants

    @property
    def axis(self) -> Any:
        return self._running().state

    def _running(self) -> SharedBlock:
        if self._block is None or not int(self._block.words[Word.GO]):
            raise SetPointError("the joint is not enabled")
        return self._block

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def require(self) -> None:
        """See `StreamedLoop`: it tracks, and nothing but set-points or standing still."""
        for constants, axis in zip(self.constants, self.axis, strict=True):
            phase, change = AxisPhase(int(axis.phase)), int(axis.change.motion)
            if phase is not AxisPhase.TRACKING:
                raise SetPointError(f"the joint follows no set-points now ({in_words(phase)})")
            kind = TrajectoryKind(int(constants.trajectory.kind))
            if kind not in (TrajectoryKind.STREAM, TrajectoryKind.HOLD) or change != MotionChange.NONE:
                raise SetPointError(
                    f"a motion is under way ({in_words(kind)}): set-points are followed where the joint holds its place"
                )

    # the supervisor's side

    def begin(self, block: SharedBlock, names: Sequence[str] = ("",)) -> None:
        """The loop is let go, with this memory of all joints."""
        with self._lock:
            self._block, self._stream, self._names = block, None, names
            self.owner = self._program

    def end(self) -> None:
        with self._lock:
            self._block, self._stream = None, None

    def poll(self) -> list[tuple[int, str]]:
        """The sign of life while no source has the joint; events (level, text) since the last call."""
        with self._lock:
            if self._block is not None and not self.owner:
                self._block.constants["stream"]["alive_ns"][:] = time.monotonic_ns()
            now_s = time.monotonic()
            if self._refused and now_s - self._told_s >= TELL_S:
                for who, (count, words) in self._refused.items():
                    times = f" ({count} times)" if count > 1 else ""
                    self._news.append((WARNING, f"set-point of {who} refused{times}: {words}"))
                self._refused, self._told_s = {}, now_s
            news, self._news = self._news, []
        return news

    # a source's side

    def take(self, point: RemoteSetPoint) -> str:
        """Hand it to the loop; "" or why it is refused."""
        with self._lock:
            try:
                self._hand_over(point)
                return ""
            except JointctlError as error:
                return self._refusal(point.who, f"{error.message} ({error.hint})" if error.hint else error.message)

    def _hand_over(self, point: RemoteSetPoint) -> None:
        if self.owner and self.owner != point.who:
            raise SetPointError(f"the set-points of this run come from {self.owner}, not from {point.who}")
        self._running()
        self._stream = self._stream or SetPointStream(self, self._names)
        self._stream.take(
            point.position_rad, point.velocity_radps, point.acceleration_radps2, point.torque_Nm, point.time_s
        )
        if not self.owner:
            self.owner = point.who
            self._news.append((INFO, f"set-points come from {point.who}"))

    def _refusal(self, who: str, words: str) -> str:
        """Reported as an event too, at most every TELL_S of each source."""
        count = self._refused.pop(who, (0, ""))[0]
        if len(self._refused) < MOST_SOURCES:
            self._refused[who] = count + 1, words
        return words
