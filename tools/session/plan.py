"""What a run is, resolved before anything is opened: configuration in force, motion, log; and who says yes to it.

Every file is read here, once.  What a session does beyond this plan depends on the joint alone, as commissioning finds
it (`Motion.placed`); what is shown of it, and asked, is below.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from jointctl.drivers.drive import Approval, CommissioningReport
from jointctl.drivers.errors import (
    ConfigurationError,
    MotionFault,
    UsageError,
    blamed,
    decimals_of,
    text_Nm,
    text_radps,
)
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.records import AxisConstants
from jointctl.firmware_py.safety import ROUNDING_rad
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import approach_peak, approach_start, peak_of, reference_at
from jointctl.tools.analysis.margin_gate import require_loop, require_margin
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import (
    axis_constants,
    expect_client,
    fill_trajectory,
    free_constants,
    stacked_tables,
    trajectory_constants,
    trajectory_table,
)
from jointctl.tools.configuration.sections import Limits
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import log_path, remove_oldest, require_room
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.written_file import file_stems

if TYPE_CHECKING:
    from jointctl.tools.analysis.arm_check import PoseRange
    from jointctl.tools.analysis.margins import Margins
    from jointctl.tools.configuration.arm import ArmConfig

UNTIL_STOPPED_s = 60.0  # of a motion without an end that are looked at
ON_THE_WAY = 300  # places of a motion that are looked at
BEYOND_rad = 1e-4  # that a place of rest may be: less may be rounding, and what is allowed for the jerk
START_SHARE = 0.1  # of the following error: how far from the trajectory a run without an approach may begin


@dataclass(frozen=True)
class Placed:
    """A motion from where the joint stands: what the loop gets, and the same in words."""

    constants: Any  # array of one AxisConstants
    table: np.ndarray  # rows of the reference, float64 (N, 5)
    lines: tuple[str, ...]  # the motion envelope


class Motion(Protocol):
    """What a session moves: a configured trajectory, the plateaus of a sweep, the spring of the motion check."""

    @property
    def table(self) -> np.ndarray:
        """Rows of the reference, float64 (N, 5), before the joint is known; their number is final."""

    def placed(self, report: CommissioningReport) -> Placed:
        """From where commissioning found the joint; `JointctlError` where that cannot be."""

    def require_start(self, start_position_rad: float) -> None:
        """`JointctlError` where the motion must not begin from there; asked when the envelope was shown."""


@dataclass(frozen=True)
class JointPlan:
    """What one joint does in a run, and its own log; `name` is "" where it is alone."""

    config: Config
    motion: Motion
    log_path: Path
    name: str = ""
    poses: PoseRange | None = None  # of a joint of an arm: what its loop must bear

    def require_margin(self, delay_s: float, *, allow_low_margin: bool) -> Margins:
        """See `margin_gate.require_margin`; of a joint of an arm over its poses."""
        if self.poses is None:
            return require_margin(self.config, delay_s, allow_low_margin=allow_low_margin)
        from jointctl.tools.analysis.arm_check import joint_loop

        loop = joint_loop(self.name, self.config, self.poses, delay_s)
        return require_loop(loop.config, loop.settings, loop.margins, allow_low_margin=allow_low_margin)

    def lines(self, lines: Iterable[str]) -> list[str]:
        """Of its envelope, below its name where it is one of several."""
        return [f"--- {self.name} ({self.config.path.name})", *lines] if self.name else list(lines)


@dataclass(frozen=True)
class RunPlan:
    """One run, whichever verb it is for.  `log_every` above 1: only so many records go into the log, the last
    `log_full_rate_s` seconds all of them.

    Of an arm, configuration, motion and log are those of its first joint, and `arm` has all of them.
    """

    config: Config
    motion: Motion
    log_path: Path
    allow_low_margin: bool = False
    log_every: int = 1
    log_full_rate_s: float = 0.0
    arm: ArmPlan | None = None

    @property
    def joints(self) -> tuple[JointPlan, ...]:
        """One for each axis, in their order."""
        return self.arm.joints if self.arm is not None else (JointPlan(self.config, self.motion, self.log_path),)

    @property
    def configs(self) -> tuple[Config, ...]:
        """Of the joints."""
        return tuple(joint.config for joint in self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints of an arm; ("",) of one that is alone."""
        return tuple(joint.name for joint in self.joints)

    @property
    def tables(self) -> np.ndarray:
        """The tables of all motions, see `stacked_tables`."""
        return stacked_tables([joint.motion.table for joint in self.joints])

    def placed(self, reports: Sequence[CommissioningReport]) -> Placed:
        """The motion of all joints from where they stand: constants of all, the lines of all."""
        if self.arm is None:
            return self.motion.placed(reports[0])
        joints = self.arm.joints
        placed = []
        for joint, report in zip(joints, reports, strict=True):
            with blamed(joint.name):
                placed.append(joint.motion.placed(report))
        constants = self.arm.config.connected([each.constants for each in placed])
        lines: list[str] = []
        for axis, joint, report in zip(constants, joints, reports, strict=True):
            with blamed(joint.name):
                lines += joint.lines(joint.motion.envelope(axis, report))
        return Placed(constants, placed[0].table, tuple(lines))


class JointMotion(Motion, Protocol):
    """That of one joint of an arm."""

    def envelope(self, axis: AxisConstants, report: CommissioningReport) -> list[str]:
        """Lines that say where the joint will go; `axis`: its `AxisConstants` in the arm."""


@dataclass(frozen=True)
class JointOfArmPlan(JointPlan):
    """See `JointPlan`."""

    motion: JointMotion


@dataclass(frozen=True)
class ArmPlan:
    """The joints of an arm in a run, and what connects them."""

    config: ArmConfig
    joints: tuple[JointOfArmPlan, ...]


def joint_lines(report: CommissioningReport, limits: Limits) -> list[str]:
    """Of every envelope: which drive it is, and where the joint stands."""
    identity, start_rad = report.identity, report.start_position_rad
    inside = limits.position_min_rad <= start_rad <= limits.position_max_rad
    return [
        f"drive      {identity.name or 'unnamed'}, vendor {identity.vendor}, serial {identity.serial or 'unknown'}, "
        f"{report.mode}",
        f"now at     {start_rad:+.4f} rad{'' if inside else ', outside limits.position_*: not enabled there'}",
    ]


def limits_line(limits: Limits) -> str:
    """Of the envelope of a motion that is followed under all of them."""
    return (
        f"limits     {limits.position_min_rad:+.3f} .. {limits.position_max_rad:+.3f} rad, "
        f"{text_radps(limits.velocity_max_radps)}, {text_Nm(limits.torque_max_Nm)}, "
        f"following error {limits.following_error_max_rad:.3f} rad"
    )


def remark_lines(remarks: Iterable[str]) -> list[str]:
    """The last lines of every envelope."""
    return [f"remark     {remark}" for remark in remarks]


def configured(config: Config) -> ConfiguredMotion:
    """Its section [trajectory]."""
    return ConfiguredMotion(config, trajectory_table(config))


def free(config: Config) -> FreeMotion:
    """It stays where it stands, ready for set-points; its section [trajectory] must be good all the same."""
    return FreeMotion(config, trajectory_table(config))


def resolve(
    config: Config | ArmConfig, motion: Callable[[Config], JointMotion] = configured, *, allow_low_margin: bool = False
) -> RunPlan:
    """The plan of a run of a joint or an arm; `motion` is made for each joint.

    `ConfigurationError` for a table that leaves the limits or cannot be read.
    """
    if isinstance(config, Config):
        return RunPlan(config, motion(config), log_path(config), allow_low_margin)
    return resolve_arm(config, motion, allow_low_margin=allow_low_margin)


def resolve_arm(
    arm: ArmConfig, motion: Callable[[Config], JointMotion] = configured, *, allow_low_margin: bool = False
) -> RunPlan:
    """The plan of a run of an arm: each joint has its part of the motion, and a log of its own.

    `ConfigurationError` also where a bus cannot carry the joints on it, or a joint not the arm in its poses and motion.
    """
    from jointctl.tools.analysis.arm_check import require_budgets, require_held  # a single joint does not wait for it

    require_budgets(arm)
    ranges = require_held(arm)
    named = arm.joints[0].model_copy()
    named._path = arm.path
    path = log_path(named)
    joints = []
    for config, name, stem, poses in zip(arm.joints, arm.names, file_stems(arm.names), ranges, strict=True):
        try:
            own = motion(config)
        except ConfigurationError as error:  # its [trajectory] is not that of its file
            error.message = "\n".join(f"{arm.path}: with [motion], {line}" for line in error.message.splitlines())
            raise
        joints.append(JointOfArmPlan(config, own, path.with_name(f"{path.stem}.{stem}.mcap"), name, poses))
    if motion is configured:
        _require_torques(arm, joints)
    first = joints[0]
    plan = ArmPlan(arm, tuple(joints))
    return RunPlan(first.config, first.motion, first.log_path, allow_low_margin, arm=plan)


def _require_torques(arm: ArmConfig, joints: Sequence[JointPlan]) -> None:
    """`ConfigurationError` where the arm's model asks more of a joint than its limit in the configured motion."""
    from jointctl.tools.analysis.arm_check import require_torques

    trajectories = new(TrajectoryConstants, len(joints))
    for trajectory, joint in zip(trajectories, joints, strict=True):
        fill_trajectory(trajectory, joint.config, joint.motion.table)
    duration_s = joints[0].config.trajectory.duration_s or UNTIL_STOPPED_s
    tables = stacked_tables([joint.motion.table for joint in joints])
    require_torques(arm, trajectories, tables, duration_s, lambda: None)


class FreeMotion:
    """Hold where the joint stands, then go where set-points and motions say; see `Motion`.

    `by_program`: they come from the program that has started the run, which must not be silent from the beginning.
    """

    def __init__(self, config: Config, table: np.ndarray, *, by_program: bool = False) -> None:
        self._config, self.table, self._by_program = config, table, by_program
        self.start_rad = math.nan  # where commissioning found the joint

    def placed(self, report: CommissioningReport) -> Placed:
        config, start_rad = self._config, report.start_position_rad
        self.start_rad = start_rad
        constants = free_constants(config, start_rad)
        if self._by_program:
            expect_client(constants, config)
        return Placed(constants, self.table, tuple(self.envelope(constants[0], report)))

    def envelope(self, axis: AxisConstants, report: CommissioningReport) -> list[str]:
        """Lines that say where the joint stands, and who may move it."""
        what = "none: the joint holds its place"
        if axis.stream.client_timeout_ns:
            what = f"as the program says; it may be silent for {axis.stream.client_timeout_ns * 1e-9:g} s"
        return [
            *joint_lines(report, self._config.limits),
            f"motion     from {self.start_rad:+.4f} rad, {what}",
            limits_line(self._config.limits),
            *remark_lines(report.remarks),
        ]

    def require_start(self, start_position_rad: float) -> None:
        """It begins where the joint stands."""


@dataclass(frozen=True)
class ConfiguredMotion:
    """Section [trajectory]; see `Motion`."""

    config: Config
    table: np.ndarray

    def placed(self, report: CommissioningReport) -> Placed:
        constants = axis_constants(self.config, self.table, start_position_rad=report.start_position_rad)
        return Placed(constants, self.table, tuple(self.envelope(constants[0], report)))

    def require_start(self, start_position_rad: float) -> None:
        """`MotionFault` if there is no approach and the trajectory begins elsewhere: it would be pulled there."""
        if self.config.sequence.approach_s != 0.0:
            return
        first_rad = float(approach_start(trajectory_constants(self.config, self.table), self.table).position_rad)
        allowed_rad = START_SHARE * self.config.limits.following_error_max_rad
        if not abs(first_rad - start_position_rad) <= allowed_rad:
            raise MotionFault(
                f"the joint stands at {start_position_rad:.4f} rad, and with sequence.approach_s (=0) it must stand "
                f"within {allowed_rad:g} rad of the beginning of the trajectory, {first_rad:.4f} rad",
                'give it time, sequence.approach_s = "auto"; without, it would be pulled there with all its torque',
            )

    def envelope(self, axis: AxisConstants, report: CommissioningReport) -> list[str]:
        """Lines that say where the joint will go, how fast, with how much torque, for how long.

        `MotionFault` as of `require_approach` and `require_braking`.
        """
        config = self.config
        low, high, speed, acceleration = peak_of(axis.trajectory, self.table)
        first = approach_start(axis.trajectory, self.table)
        approach = float(axis.sequence.approach_s)
        require_approach(config.limits, axis, self.table, report.start_position_rad)
        require_braking(config, axis.trajectory, self.table)
        duration = config.trajectory.duration_s
        time_text = f"{approach + duration:.0f} s" if duration else "until stopped"
        rounding_s = float(axis.trajectory.rounding_s)
        jerk = f", {acceleration / rounding_s:.3g} rad/s3" if rounding_s else ""
        return [
            *joint_lines(report, config.limits),
            f"approach   to {first.position_rad:+.4f} rad in {approach:.1f} s"
            if approach
            else f"approach   none: at once to {first.position_rad:+.4f} rad",
            f"trajectory {config.trajectory.kind}: {low:+.4f} .. {high:+.4f} rad, up to {text_radps(speed, 3)} "
            f"and {acceleration:.{decimals_of(acceleration, 3)}f} rad/s2{jerk}, {time_text}",
            limits_line(config.limits),
            *remark_lines(report.remarks),
        ]


def require_approach(limits: Limits, axis: AxisConstants, table: np.ndarray, start_rad: float) -> None:
    """`MotionFault` where the approach, which may swing back for the speed of the beginning, would leave the limits.

    The longer the farther: in an arm it takes as long as that of the slowest joint.
    """
    approach = float(axis.sequence.approach_s)
    low_rad, high_rad = limits.position_min_rad - ROUNDING_rad, limits.position_max_rad + ROUNDING_rad
    if not approach or not low_rad <= start_rad <= high_rad:  # who stands outside is named by the loop
        return
    way = approach_peak(start_rad, approach_start(axis.trajectory, table), approach)
    for far_rad in (way.position_min_rad, way.position_max_rad):
        if not low_rad <= far_rad <= high_rad:
            raise MotionFault(
                f"the approach from {start_rad:+.4f} rad in {approach:.1f} s swings to "
                f"{far_rad:+.4f} rad, must be in [{limits.position_min_rad:g}..{limits.position_max_rad:g}], "
                "the limits.position_*_rad",
                "begin nearer to the beginning of the motion (of an arm with all joints), with a shorter "
                "sequence.approach_s where that is a number, or with a motion that begins at rest",
            )


def require_braking(config: Config, trajectory: TrajectoryConstants, table: np.ndarray) -> None:
    """`MotionFault` where the trajectory, braked on the way, would come to rest beyond the limits: REFERENCE_LIMIT."""
    limits, brake_radps2 = config.limits, config.sequence.brake_radps2
    low_rad, high_rad, speed_radps, _ = peak_of(trajectory, table)
    way_rad = 0.5 * speed_radps**2 / brake_radps2
    if limits.position_min_rad <= low_rad - way_rad and high_rad + way_rad <= limits.position_max_rad:
        return  # wherever it is: most motions need not be looked at
    position_rad, velocity_radps = _on_the_way(trajectory, table)
    rest_rad = position_rad + 0.5 * velocity_radps * np.abs(velocity_radps) / brake_radps2
    beyond_rad = np.maximum(rest_rad - limits.position_max_rad, limits.position_min_rad - rest_rad)
    worst = int(np.argmax(beyond_rad))
    if beyond_rad[worst] > BEYOND_rad:
        raise MotionFault(
            f"at {position_rad[worst]:+.4f} rad the trajectory has {velocity_radps[worst]:+.3f} rad/s, and would "
            f"come to rest at {rest_rad[worst]:+.4f} rad with sequence.brake_radps2 (={brake_radps2:g}), must be in "
            f"[{limits.position_min_rad:g}..{limits.position_max_rad:g}], the limits.position_*_rad",
            "a greater sequence.brake_radps2, a slower motion, or wider limits",
        )


def _on_the_way(trajectory: TrajectoryConstants, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of one period of the trajectory, or of its whole table."""
    c: Any = trajectory
    if c.kind == TrajectoryKind.TABLE:
        rows = table[: int(c.table_rows)]
        since_s = np.diff(rows[:, 0])[:, None] * np.linspace(0.0, 1.0, 5)
        c0, c1, c2, c3 = (rows[:-1, k, None] for k in range(1, 5))
        position = c0 + since_s * (c1 + since_s * (c2 + since_s * c3))
        return position.ravel(), (c1 + since_s * (2.0 * c2 + since_s * 3.0 * c3)).ravel()
    run_s = float(c.duration_s) or math.inf
    switch_s = float(c.switch_s) or math.inf
    spans = [(0.0, float(c.move_s))]
    if c.kind == TrajectoryKind.SINE:
        spans = [(0.0, min(run_s, switch_s, math.tau / c.omega_radps))]
        if switch_s < run_s:
            spans.append((switch_s, min(run_s, switch_s + math.tau / c.omega2_radps)))
    elif c.kind == TrajectoryKind.TRAPEZOID:
        way_rad, speed_radps = abs(c.target_rad - c.start_rad), float(c.speed_radps)
        slopes_s = 2.0 * (speed_radps / c.acceleration_radps2 + c.rounding_s)
        spans = [(0.0, way_rad / speed_radps + slopes_s)]
    reference, at = new(Reference)[0], plain(reference_at)
    found = []
    for begin_s, end_s in spans:
        for t_s in np.linspace(begin_s, min(end_s, run_s), ON_THE_WAY):
            at(trajectory, table, 0, t_s, reference)
            found.append((reference.position_rad, reference.velocity_radps))
    position, velocity = np.array(found).T
    if c.repeats:  # the same way back
        ends_rad = c.start_rad + c.target_rad
        return np.concatenate([position, ends_rad - position]), np.concatenate([velocity, -velocity])
    return position, velocity


# --- The one conversation before something is done to a joint or its drive: what is shown, and who says yes ---


MOVE = "Move the joint?"


class Consent(Protocol):
    """Whose word lets a session move the joint."""

    @property
    def dry_run(self) -> bool:
        """The envelope is shown, and that is all."""

    @property
    def brake(self) -> Approval | None:
        """Asked before a drive that is found enabled is braked; None: it is left as it is."""

    def show(self, lines: Sequence[str]) -> None:
        """The motion envelope."""

    def agreed(self, lines: Sequence[str]) -> bool:
        """Whether the joint may move as these lines say."""


class TerminalConsent:
    """The user at the terminal, or the flag -y.  One yes is for one command: nothing is shown or asked twice."""

    def __init__(self, output: Output, *, assume_yes: bool, dry_run: bool = False) -> None:
        self._output, self._assume_yes, self.dry_run = output, assume_yes, dry_run
        self.brake: Approval | None = None if dry_run else self._may_brake
        self._given = False

    def show(self, lines: Sequence[str]) -> None:
        for line in () if self._given else lines:
            self._output.fact(line)

    def agreed(self, lines: Sequence[str]) -> bool:
        self._given = self._given or self._assume_yes or agreed(self._output)
        return self._given

    def _may_brake(self, question: str) -> bool:
        if self._assume_yes:
            self._output.note(f"{question} yes (-y)")
        return self._assume_yes or agreed(self._output, question)


def require_terminal(
    why: str = "this moves the joint and there is no terminal to ask on",
    hint: str = "give -y (in a program yes=True) to move without asking",
) -> None:
    """`UsageError` where nobody can be asked."""
    if not sys.stdin.isatty():
        raise UsageError(why, hint)


def agreed(output: Output, question: str = MOVE) -> bool:
    """Whether the user says yes; everything else is no, and what was typed before the question is no answer."""
    with contextlib.suppress(ImportError, OSError, ValueError):  # a system without them, or a stream of a program
        import termios

        if sys.stdin.isatty():
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
    output.note(f"{question} [y/N] ")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


# --- What must hold before the user is asked whether the joint may move: a yes must not be refused afterwards ---


def require_ready(config: Config, report: CommissioningReport, log_path: Path) -> None:
    """`MotionFault` if the joint stands outside its limits, `DataError` if the log could not be written."""
    limits, start_rad = config.limits, report.start_position_rad
    if not limits.position_min_rad <= start_rad <= limits.position_max_rad:
        text = fault_text(Fault.POSITION_LIMIT, start_rad, 0)
        raise MotionFault(
            f"{Fault.POSITION_LIMIT.name} ({int(Fault.POSITION_LIMIT)}): the joint stands at {start_rad:.4f} rad, "
            f"which must be in [{limits.position_min_rad:g}..{limits.position_max_rad:g}], the limits.position_*",
            text.advice,
        )
    require_room(config, log_path)


def prepare_log(config: Config, log_path: Path, output: Output) -> None:
    """Make way for a new log; one that cannot be removed is no reason not to run."""
    try:
        removed = remove_oldest(config, log_path)
    except OSError as error:
        output.warning(f"{log_path.parent}: an old log cannot be removed: {error.strerror or error}")
        return
    if removed:
        files = "1 file" if len(removed) == 1 else f"{len(removed)} files"
        output.note(f"{log_path.parent}: {files} of older runs removed (log.keep = {config.log.keep})")
