"""What `Joint` and `Arm` have in common: the axes of one run, commanded by a program of one's own.

A joint is an arm of one.  `Motor` is what carries the run out, in real time (`live_joint`) or at simulated time
(`lockstep_joint`); `Program` makes motions and set-points of what the program asks for, the same for both.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count
from numbers import Integral
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from jointctl.drivers.errors import ConfigurationError, JointctlError, UsageError, blamed, one_line
from jointctl.drivers.stop_note import now_ns
from jointctl.firmware_py.motion_records import MotionChange, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, TrajectoryKind, in_words
from jointctl.tools.configuration.config import Config
from jointctl.tools.scoping.remote_options import FOXGLOVE_AT, RemoteOptions, usual_domain
from jointctl.tools.session.set_points import Numbers, SetPointError, SetPointStream, finite
from jointctl.tools.verbs.start import require_descriptors

if TYPE_CHECKING:
    from jointctl.tools.child_process import OwnVirtualJoint
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.session.session_drive import SessionDrive

POLL_S = 0.005
TABLE_ROWS = 1 << 16  # of `follow`, at most
PHASES = tuple(in_words(phase) for phase in AxisPhase)
LONGEST_S = 1e9  # of a wait: its end in nanoseconds is a number of 64 bits
COMMISSIONED = "commissioned"  # the phase before the first cycle
OFF = "switch on disabled"
SetPointValues = tuple[Numbers, Numbers | None, Numbers | None, Numbers | None]  # position to torque
_NUMBERS = count(1)  # of the virtual joints of this process
SHIPPED_NAME = "virtual"  # what `Arm` calls the shipped arm
_WORDS = {"Joint": "a joint", "Arm": "an arm"}
Place = tuple[str | None, str | None, int | None, str | None, int | None]  # interface, channel, bitrate, port, node


class Axes(NamedTuple):
    """Which joints a run has."""

    joints: tuple[Config, ...]
    names: tuple[str, ...]  # of an arm; ("",) for a joint alone
    arm: ArmConfig | None = None


def axes_of(config: Config | ArmConfig) -> Axes:
    """Those of a joint's file, or of an arm's."""
    if isinstance(config, Config):
        return Axes((config,), ("",))
    return Axes(config.joints, config.names, config)


class Newest(NamedTuple):
    """The newest cycle."""

    records: tuple[Any, ...]  # a LogRecord of each axis; () before the first cycle
    starts_rad: tuple[float, ...]  # where commissioning found the joints
    now_ns: int
    since_ns: int  # when that was

    @property
    def phase(self) -> str:
        """Of all axes: the least advanced one's, and not `tracking` once one is being stopped."""
        if not self.records:
            return COMMISSIONED
        phases = [int(record["phase"]) for record in self.records]
        stopping = min(phases) <= AxisPhase.TRACKING < max(phases)
        return PHASES[max(phases) if stopping else min(phases)]

    @property
    def age_s(self) -> float:
        return max(0.0, (self.now_ns - self.since_ns) * 1e-9)


class Motor(Protocol):
    """What `Program` needs of a run, in real time or at simulated time; all arrays have one element an axis."""

    axes: Axes
    drive: SessionDrive
    log_paths: tuple[Path, ...]
    constants: Any  # record array of AxisConstants, those of the loop
    axis: Any  # record array of AxisState, those of the loop
    tables: np.ndarray  # float64 (axes, TABLE_ROWS, 5)

    def begin(self) -> None:
        """Commission: returns with the drives ready and disabled, or raises why not."""

    def newest(self) -> Newest:
        """As of now."""

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        """Returns when the joints follow set-points."""

    def require(self) -> None:
        """`JointctlError` if the joints follow nothing, with the cause."""

    def now_ns(self) -> int:
        """The loop's clock."""

    def wait(self, seconds: float) -> None:
        """Time passes; `JointctlError` if the run has ended in the meantime."""

    def post(self, motions: Sequence[NewMotion], move_s: float) -> None:
        """Hand over a motion for each joint; all begin together, `MotionFault` where the loop does not take them.

        `move_s`: that the way to their beginning takes at least.
        """

    def stop(self) -> None:
        """Brake, release, power off: returns when that is done."""

    def close(self) -> None:
        """As `stop`; nothing is left behind.  `JointctlError` with what went wrong."""


class NewMotion(NamedTuple):
    """Of one joint."""

    trajectory: Any  # record array of one TrajectoryConstants
    words: str


def motor_of(config: Config | ArmConfig | str | Path, kind: str, wanted: Wanted, *, lockstep: bool) -> Motor:
    """The motor for what `Joint` or `Arm` (`kind`) was given; stops of its own count from here on."""
    asked_ns = now_ns()  # what is loaded below takes seconds
    require_descriptors()
    source, options = wanted_source(config, kind, wanted)
    if lockstep:
        if options.foxglove is not None or options.ros2 is not None:
            raise UsageError("lockstep=True is simulated time: nothing of it can be watched with foxglove or ros2")
        from jointctl.firmware_py.slow_start import slow_start
        from jointctl.lockstep_joint import LockstepMotor
        from jointctl.tools.output import Output

        with slow_start(Output().note, kind):
            return LockstepMotor(axes_of(source.config))
    from jointctl.live_joint import LiveMotor

    return LiveMotor(source, asked_ns, options, allow_low_margin=wanted.allow_low_margin)


class Program:
    """See `Joint` and `Arm`."""

    def __init__(self, motor: Motor) -> None:
        self._motor, self._axes = motor, motor.axes
        self._stream: SetPointStream | None = None
        self._begun = self._enabled = False
        self._commands = threading.RLock()  # from rest until the loop has taken a motion: one thread at a time

    def __enter__(self) -> Self:
        if self._begun:
            what = type(self).__name__
            raise UsageError(f"a {what} is for one `with` block, and this one has had it; begin a new {what}")
        self._begun = True
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

    def enable(self, approve: Callable[[Sequence[str]], bool] | None = None) -> None:
        """Check stability margin and limits, then power on: it holds where it stands.  Once for each object.

        `approve` is shown the lines of the motion envelope and has the last word; without it this call is the consent.
        It returns True or False: an answer in words, or one that is still awaited, is none (`UsageError`).
        `MarginError`, `MotionFault` or another `JointctlError` tells why it is not enabled.
        """
        if self._enabled:
            what = type(self).__name__
            raise UsageError(f"it was enabled before; after a stop or a fault a new {what} is needed")
        self._enabled = True
        self._motor.enable(None if approve is None else partial(_answer, approve))
        self._stream = SetPointStream(self._motor, self._axes.names)

    def wait(self, seconds: float) -> None:
        """Wait, and say that the program is alive.  At simulated time the motion goes on for so long."""
        end_ns = self._motor.now_ns() + round(min(finite("seconds", seconds), LONGEST_S) * 1e9)
        while (left_ns := end_ns - self._motor.now_ns()) > 0:
            self._alive()
            self._motor.wait(min(left_ns * 1e-9, 0.05))

    def step(self, seconds: float) -> None:
        """At simulated time only: the motion goes on for so long."""
        self._simulated("step").step(finite("seconds", seconds))

    def stop(self) -> None:
        """Brake along the ramp, release, power off.  Nothing enables it again."""
        self._motor.stop()

    # --- inside ---

    def _simulated(self, what: str) -> Any:
        if not hasattr(self._motor, "step"):
            raise UsageError(f"{what} is for simulated time: {type(self).__name__}(..., lockstep=True)")
        return self._motor

    def _following(self) -> SetPointStream:
        if self._stream is None:
            raise UsageError("it is not enabled: call enable() first")
        return self._stream

    def _alive(self) -> None:
        if self._stream is not None:
            self._stream.alive()

    def _newest(self) -> Newest:
        self._alive()
        return self._motor.newest()

    def _move(self, targets_rad: Sequence[float], duration_s: float | None, wait: bool) -> None:
        """Of all joints along quintics that begin and end together."""
        from jointctl.firmware_py.kernel import plain
        from jointctl.firmware_py.live_change import move_duration_s

        if duration_s is not None and not 0.001 <= duration_s <= 1e5:
            raise ConfigurationError(f"duration_s (={duration_s:g}) must be in [0.001..100000] s")
        with self._commands:
            starts_rad = self._at_rest()
            if duration_s is None:
                ways = zip(self._motor.constants, starts_rad, targets_rad, strict=True)
                duration_s = max(float(plain(move_duration_s)(axis.change, end - start)) for axis, start, end in ways)
                if duration_s == 0.0:
                    return
            motions = self._moves(starts_rad, targets_rad, duration_s)
            self._require_torques(motions, self._motor.tables, duration_s)
            self._go(motions)
        self._end_of_motion(wait)

    def _moves(self, starts_rad: Sequence[float], targets_rad: Sequence[float], duration_s: float) -> list[NewMotion]:
        from jointctl.tools.session.live_changes import new_motion

        motions = []
        for number, (name, config) in enumerate(zip(self._axes.names, self._axes.joints, strict=True)):
            values = {
                "kind": "min_jerk", "duration_s": 0.0, "start_rad": starts_rad[number],
                "target_rad": targets_rad[number], "move_s": duration_s, "dwell_s": 0.0, "repeat": False,
            }  # fmt: skip
            with blamed(name):
                motions.append(NewMotion(*new_motion(config, self._motor.tables[number], values)))
        return motions

    def _follow(self, times_s: npt.ArrayLike, positions_rad: npt.ArrayLike, wait: bool) -> None:
        """Of all joints along splines through the rows of `positions_rad`, shape (n, axes)."""
        from jointctl.firmware_py.kernel import plain
        from jointctl.firmware_py.live_change import move_duration_s
        from jointctl.tools.session.live_changes import checked_motion

        tables = spline_tables(times_s, positions_rad, len(self._axes.names))
        motions = []
        for name, config, table in zip(self._axes.names, self._axes.joints, tables, strict=True):
            trajectory = new(TrajectoryConstants)
            trajectory[0].kind, trajectory[0].table_rows = TrajectoryKind.TABLE, len(table)
            with blamed(name):
                motions.append(NewMotion(trajectory, checked_motion(config, trajectory[0], table)))
        self._require_torques(motions, tables, float(tables[0, -1, 0]))
        with self._commands:
            starts_rad = self._at_rest()
            ways = zip(self._motor.constants, tables[:, 0, 1] - starts_rad, strict=True)
            move_s = max(float(plain(move_duration_s)(axis.change, way)) for axis, way in ways)
            if move_s > 0.0 and self._axes.arm is not None:
                way = self._moves(starts_rad, tables[:, 0, 1].tolist(), move_s)
                self._require_torques(way, tables, move_s, "the way to the beginning of the table")
            self._motor.tables[:, : tables.shape[1]] = tables
            self._go(motions, move_s)
        self._end_of_motion(wait)

    def _require_torques(
        self, motions: Sequence[NewMotion], tables: np.ndarray, duration_s: float, what: str = "the motion"
    ) -> None:
        """`ConfigurationError` where the arm's model asks more of a joint than its limit on the way."""
        if self._axes.arm is not None:
            from jointctl.tools.analysis.arm_check import require_torques

            trajectories = [motion.trajectory[0] for motion in motions]
            require_torques(self._axes.arm, trajectories, tables, duration_s, self._alive, what)

    def _command(self, values: SetPointValues, time_s: float | None) -> None:
        stream = self._following()
        with self._commands:
            if self._under_way:
                raise SetPointError("a motion is under way: set-points are followed from rest", "wait for its end")
            stream.take(*values, time_s)

    def _at_rest(self) -> list[float]:
        """Where the references rest; a motion that is under way comes to its end first."""
        self._following()
        self._motor.require()
        references = self._motor.axis["reference"]
        while self._under_way or references["velocity_radps"].any():
            self._alive()
            self._motor.wait(POLL_S)
        rest_rad = [float(position) for position in references["position_rad"]]
        if self._motor.constants[0].trajectory.kind == TrajectoryKind.TABLE:  # its rows may be written again
            holds = self._motor.constants["trajectory"].copy()
            holds["kind"], holds["start_rad"] = TrajectoryKind.STREAM, rest_rad
            self._go([NewMotion(holds[[number]], "rest") for number in range(len(holds))])
            self._end_of_motion(True)
        return rest_rad

    @property
    def _under_way(self) -> bool:
        """Whether a motion that was asked for has not come to its end."""
        motor = self._motor
        for constants, state, table in zip(motor.constants, motor.axis, motor.tables, strict=True):
            if state.change.motion != MotionChange.NONE:
                return True
            trajectory = constants.trajectory  # the loop's own, also where an exception has ended the call
            lasts_s = (
                table[trajectory.table_rows - 1, 0] if trajectory.kind == TrajectoryKind.TABLE else trajectory.move_s
            )
            if trajectory.kind != TrajectoryKind.STREAM and state.trajectory_s < lasts_s:
                return True
        return False

    def _go(self, motions: Sequence[NewMotion], move_s: float = 0.0) -> None:
        self._alive()
        self._motor.post(motions, move_s)

    def _end_of_motion(self, wait: bool) -> None:
        while wait and self._under_way:
            self._alive()
            self._motor.wait(POLL_S)


def _answer(approve: Callable[[Sequence[str]], bool], lines: Sequence[str]) -> bool:
    """What `approve` says; what only counts as true, as the text "n" does, is no consent."""
    answer = approve(lines)
    if not isinstance(answer, (bool, np.bool_)):
        raise UsageError(f"approve (={one_line(repr(answer))[:40]}) must return True or False; nothing has moved")
    return bool(answer)


def spline_tables(times_s: npt.ArrayLike, positions_rad: npt.ArrayLike, axes: int) -> np.ndarray:
    """Rows of the cubic splines, float64 (axes, n, 5); `ConfigurationError` for what makes none.

    `positions_rad`: (n,) of one joint, (n, axes) of an arm.
    """
    from jointctl.firmware_py.trajectory import spline_table
    from jointctl.tools.configuration.arm import LONGEST_MOVE_s

    given = times_s, positions_rad
    try:
        if any(np.asarray(array).dtype.kind in "bcmMSU" for array in given):  # times of a calendar count nanoseconds
            raise TypeError
        times, positions = (np.ma.asarray(array, np.float64).filled(np.nan) for array in given)
    except (TypeError, ValueError):
        raise ConfigurationError("times_s and positions_rad must be arrays of numbers") from None
    wanted = (len(times),) if positions.ndim == 1 and axes == 1 else (len(times), axes) if times.ndim else ()
    if times.ndim != 1 or positions.shape != wanted or not 2 <= len(times) <= TABLE_ROWS:
        shapes = "both be (N,)" if axes == 1 else f"be (N,) and (N, {axes})"
        raise ConfigurationError(
            f"times_s {times.shape} and positions_rad {positions.shape} must {shapes}, N in [2..{TABLE_ROWS}]"
        )
    for name, values in (("times_s", times), ("positions_rad", positions)):
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            place = tuple(wrong[0])
            shown = ", ".join(str(index) for index in place)
            raise ConfigurationError(f"{name}[{shown}] (={values[place]:g}) must be finite")
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        row = int(late[0]) + 1
        raise ConfigurationError(f"times_s[{row}] (={times[row]:g}) must be above the one before ({times[row - 1]:g})")
    if not times[-1] - times[0] <= LONGEST_MOVE_s:
        raise ConfigurationError(f"times_s lasts {times[-1] - times[0]:g} s, must be at most {LONGEST_MOVE_s:g} s")
    try:
        return np.stack([spline_table(times - times[0], column) for column in positions.reshape(len(times), -1).T])
    except ValueError as error:
        raise ConfigurationError(f"times_s: {error}") from None


# --- Which joint or arm is meant: a file, a shipped configuration, virtual drives of its own ---


@dataclass(frozen=True)
class Wanted:
    """What a program asks for, as the arguments of `Joint`; `place`: instead of the configuration's."""

    place: Place = (None,) * 5
    virtual: bool = False
    allow_low_margin: bool = False
    foxglove: bool | str = False
    ros2: bool | int = False
    allow_remote: bool = False


@dataclass(frozen=True)
class Source:
    """A configuration, and whether its virtual drives are to be started."""

    config: Config | ArmConfig
    own_virtual: bool

    @contextmanager
    def served(self) -> Iterator[OwnVirtualJoint | None]:
        """With the virtual drives starting, in a process of their own, where they are one's own."""
        from jointctl.tools.child_process import own_virtual_joint

        if not self.own_virtual:
            yield None
            return
        first = self.config if isinstance(self.config, Config) else self.config.joints[0]
        with own_virtual_joint(self.config.path, first.bus.channel) as own:
            yield own


def observers(foxglove: bool | str, ros2: bool | int, *, allow_remote: bool) -> RemoteOptions:
    """Who may look on, as the options of `jointctl run` say it; `UsageError` for what they cannot be."""
    if not isinstance(foxglove, (bool, str)):
        raise UsageError(f"foxglove (={foxglove}) must be True, False or HOST:PORT")
    if not isinstance(ros2, Integral):
        raise UsageError(f"ros2 (={ros2}) must be True, False or the number of a domain")
    at = FOXGLOVE_AT if foxglove is True else foxglove or None
    domain = usual_domain() if ros2 is True else None if ros2 is False else ros2
    return RemoteOptions(at, domain, allow_remote=allow_remote)


def wanted_source(given: str | Path | Config | ArmConfig, kind: str, wanted: Wanted) -> tuple[Source, RemoteOptions]:
    """For a "Joint" or an "Arm" (`kind`); `ConfigurationError` for what cannot be read, or is of the other one.

    Also where virtual drives are asked for and the configuration has none.
    """
    from jointctl.tools.configuration.drive_section import GivenPlace, require_simulated
    from jointctl.tools.verbs.demo import each_joint, with_patience
    from jointctl.tools.verbs.verb_options import on_bus

    options = observers(wanted.foxglove, wanted.ros2, allow_remote=wanted.allow_remote)
    config, shipped = _loaded(given, kind)
    config = config.anchored()  # the program may go elsewhere
    found = "Joint" if isinstance(config, Config) else "Arm"
    if found != kind:
        raise ConfigurationError(f"{config.path}: is no file of {_WORDS[kind]}", f"jointctl.{found} moves it")
    joints = (config,) if isinstance(config, Config) else config.joints
    without = [joint.path for joint in joints if joint.virtual is None]
    own = wanted.virtual or (shipped and not without and set(wanted.place) == {None})
    for joint in joints if own else ():
        require_simulated(joint, "a virtual joint")
    if own and without:
        raise ConfigurationError(f"{without[0]}: has no [virtual] section, so there is no virtual joint to start")
    place = GivenPlace("jointctl", f"python-{os.getpid()}-{next(_NUMBERS)}") if own else GivenPlace(*wanted.place)
    config = on_bus(config, place, {} if own else None)
    return Source(each_joint(config, with_patience) if own else config, own), options


def _loaded(given: str | Path | Config | ArmConfig, kind: str) -> tuple[Config | ArmConfig, bool]:
    """The configuration, and whether it is a shipped one that was named."""
    from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_joint_or_arm
    from jointctl.tools.verbs.verb_options import config_path

    if isinstance(given, (Config, ArmConfig)):
        return given, False
    if not isinstance(given, (str, Path)):
        raise ConfigurationError(
            f"config (={str(given)[:40]}) must be a file, a name, or a configuration that was read"
        )
    shipped = not os.path.exists(given)
    its_own = shipped and kind == "Arm" and str(given) == SHIPPED_NAME
    return load_joint_or_arm(SHIPPED_ARM if its_own else config_path(Path(given))), shipped
