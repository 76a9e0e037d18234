"""Changes that a viewer asks for while the joint moves: gains and motions, from the request to the loop's answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError, DataError, JointctlError, MarginError, MotionFault
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.live_change import gains_of
from jointctl.firmware_py.motion_records import ChangeAnswer, ChangeKind, Gains, MotionChange, TrajectoryConstants
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.states import AxisPhase, CommandKind, TrajectoryKind, in_words
from jointctl.firmware_py.trajectory import peak_of
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.analysis.margins import phase_margin_deg
from jointctl.tools.configuration.checks import extremes_problems, problems_between_sections
from jointctl.tools.configuration.config import Config, problem_line
from jointctl.tools.configuration.records import fill_trajectory
from jointctl.tools.configuration.sections import Section, Trajectory
from jointctl.tools.recording.run_log import INFO, WARNING, Event, RunLogWriter
from jointctl.tools.session.display import Display, PreparedMotion, ViewerRequest
from jointctl.tools.session.loop_memory import SharedBlock
from jointctl.tools.session.plan import require_braking

# --- Gains: the same gate as before enabling, on the whole way from the old ones to the new ---


STEPS = 8  # of the straight line from the gains in force to the new ones


def with_gains(config: Config, gains: Mapping[str, float]) -> Config:
    """The configuration as if it had these numbers in [control]."""
    return config.changed(control=dict(gains))


def require_change(
    config: Config, before: Mapping[str, float], after: Mapping[str, float], delay_s: float, *, allow_low_margin: bool
) -> float:
    """Phase margin [deg] with the new gains; `ConfigurationError` or `MarginError` tells why they are refused.

    The gains change along a straight line, slowly against the loop, so that its points are looked at one by one.
    """
    end = with_gains(config, after)
    problems = problems_between_sections(end)
    if problems:
        raise ConfigurationError(problems[0])
    found = require_margin(end, delay_s, allow_low_margin=allow_low_margin)
    least_deg = 1e-6 if allow_low_margin else config.margin.min_phase_margin_deg
    for step in range(1, STEPS):
        share = step / STEPS
        between = {name: value + share * (after[name] - value) for name, value in before.items()}
        margin_deg = phase_margin_deg(loop_settings(with_gains(config, between), delay_s)[0])
        if not margin_deg >= least_deg:
            raise MarginError(
                f"on the way to these gains the phase margin would be {margin_deg:.1f} deg, below {least_deg:g} deg",
                "change one gain at a time",
            )
    return found.phase_margin_deg


def checked_gains(
    given: Mapping[str, Any], now: Mapping[str, float], low: Mapping[str, float], high: Mapping[str, float]
) -> dict[str, float]:
    """All gains, the given ones replaced; `ConfigurationError` for a name, type or value that is not allowed."""
    after = dict(now)
    for name, value in given.items():
        if name not in after:
            raise ConfigurationError(f"{str(name)[:40]!r} is no gain that can be changed: {', '.join(after)}")
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not number or not low[name] <= value <= high[name]:
            shown = f"{value:g}" if isinstance(value, float) else str(value)[:40]
            what = "is empty:" if value is None else f"(={shown})"
            raise ConfigurationError(
                f"control.{name} {what} must be in [{low[name]:g}..{high[name]:g}], from live.gain_factor"
            )
        after[name] = float(value)
    return after


# --- A new motion while the joint moves: checked against the limits, and made to begin at rest ---


CONFIGURED = "configured"


class _Chosen(Section):
    trajectory: Trajectory


def new_motion(config: Config, table: np.ndarray, values: Mapping[str, Any]) -> tuple[Any, str]:
    """(a record array of one `TrajectoryConstants`, the motion in words) of {"kind": ..., ...}.

    The keys are those of [trajectory]; kind "configured" is that section itself.  A sine begins at its crest, where it
    is at rest, and has no switch.  `ConfigurationError` for what is not allowed.
    """
    trajectory = _trajectory(config, values)
    constants = new(TrajectoryConstants)
    record: Any = constants[0]
    fill_trajectory(record, config.changed(trajectory=trajectory), table)
    if record.kind == TrajectoryKind.SINE:
        record.shift_s, record.switch_s = 0.5 * math.pi / record.omega_radps, 0.0
    return constants, checked_motion(config, record, table)


def checked_motion(config: Config, record: TrajectoryConstants, table: np.ndarray) -> str:
    """A `TrajectoryConstants` in words; `ConfigurationError` where position, speed or torque leave the limits.

    Or where it could not be braked within them.
    """
    peak = peak_of(record, table)
    ends = peak.position_min_rad, peak.position_max_rad
    moves = record.kind in (TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID)
    start_rad = float(record.start_rad) if moves else None  # where the joint stands
    problems = extremes_problems(config, *ends, peak.velocity_radps, start_rad)
    torque_Nm = config.joint.inertia_kgm2 * peak.acceleration_radps2
    if not torque_Nm <= config.limits.torque_max_Nm:
        problems.append(
            f"trajectory: acceleration (={peak.acceleration_radps2:g} rad/s2) takes {torque_Nm:g} Nm, must be in "
            f"[0..{config.limits.torque_max_Nm:g}], up to limits.torque_max_Nm"
        )
    if problems:
        raise ConfigurationError(problems[0])
    try:
        require_braking(config, record, table)
    except MotionFault as error:
        raise ConfigurationError(error.message, error.hint) from None
    return motion_in_words(record, peak.velocity_radps)


def _trajectory(config: Config, values: Mapping[str, Any]) -> Any:
    kind = values.get("kind")
    if kind == CONFIGURED:
        return config.trajectory
    if kind == "table":
        raise ConfigurationError('trajectory.kind (=table) can only be chosen as "configured"')
    data = {"trajectory": dict(values)}
    try:
        return _Chosen.model_validate(data).trajectory
    except ValidationError as error:
        raise ConfigurationError(problem_line(error.errors(include_url=False)[0], data, ())) from None


def motion_in_words(record: TrajectoryConstants, speed_radps: float) -> str:
    """`sine -0.350 .. +0.350 rad, up to 0.22 rad/s`; without a duration `, until stopped`."""
    return _what(record, speed_radps) + ("" if record.duration_s > 0.0 else ", until stopped")


def _what(record: TrajectoryConstants, speed_radps: float) -> str:
    kind = TrajectoryKind(int(record.kind))
    if kind is TrajectoryKind.HOLD:
        return f"set-point {record.start_rad:+.4f} rad"
    name = in_words(kind)
    if kind is TrajectoryKind.STREAM:
        return f"set-points as they come, from {record.start_rad:+.4f} rad"
    if kind is TrajectoryKind.SINE:
        ends = record.offset_rad - abs(record.amplitude_rad), record.offset_rad + abs(record.amplitude_rad)
    elif kind is TrajectoryKind.TABLE:
        return f"table, up to {speed_radps:.3g} rad/s"
    else:
        ends = record.start_rad, record.target_rad
    return f"{name} {ends[0]:+.4f} .. {ends[1]:+.4f} rad, up to {speed_radps:.3g} rad/s"


# --- Changes that a viewer asks for, from the request to the loop and its answer; each one is reported as an event ---
# One at a time.  Gains go through the stability gate in a thread of their own, since the supervisor must keep its
# sign of life; the loop has the last word (`firmware_py.live_change`).


NAMES = tuple(dtype_of(Gains).names or ())
# the plain function: nothing is to be compiled or loaded while the supervisor watches
_gains_of = plain(gains_of)
_WHY = {
    ChangeAnswer.WRONG_KIND: "the loop does not know this kind of change",
    ChangeAnswer.WRONG_PHASE: "the joint is not under way, or it is being stopped",
    ChangeAnswer.GAIN_LIMIT: "a gain is outside of its limits",
    ChangeAnswer.MOTION_LIMIT: "the motion leaves the limits of position or velocity",
    ChangeAnswer.NOT_FROM_REST: "the motion does not begin at rest",
}


def post_change(box: np.recarray, kind: ChangeKind, payload: Any, move_s: float = 0.0) -> int:
    """Into the letter box of `ChangeConstants`, the request first, its number last; the loop has answered the others.

    `payload`: gains as a mapping, or a record array of one `TrajectoryConstants`; `move_s`: that the way to its
    beginning takes at least.  In an arm the loop waits for a request to every joint.
    """
    number, request = int(box.order[0]) + 1, box.request
    request.kind = kind
    if kind is ChangeKind.GAINS:
        for name in NAMES:
            request.gains[name] = payload[name]
    else:
        request.trajectory, request.move_s = payload[0], move_s
    request.first = request.last = number
    box.order[0] = number
    return number


@dataclass
class _Change:
    text: str  # old and new
    who: str
    kind: ChangeKind
    payload: Any  # Gains as a mapping, or TrajectoryConstants
    gate: Future[float] | None = None
    request: str = ""  # kind of the request
    number: int = 0  # 0: not yet with the loop
    move_s: float = 0.0
    answered: Callable[[str], None] = lambda _: None


class LiveChanges:
    """`tell(level, text)` is given every event; `delay_s()` the measured loop delay, None until it is known."""

    def __init__(
        self,
        config: Config,
        block: SharedBlock,
        tell: Callable[[int, str], None],
        delay_s: Callable[[], float | None],
        *,
        allow_low_margin: bool = False,
    ) -> None:
        self._config, self._block, self.tell, self._delay_s = config, block, tell, delay_s
        self._allow_low_margin = allow_low_margin
        self._open: _Change | None = None
        self.refused: dict[str, Any] | None = None  # the last one: what a page shows at its field
        self._pool = ThreadPoolExecutor(1, "stability gate")

    @property
    def _axis(self) -> Any:
        return self._block.constants[0]

    def gains(self) -> dict[str, float]:
        """Those in force."""
        record = new(Gains)[0]
        _gains_of(self._axis.law, record)
        return {name: float(record[name]) for name in NAMES}

    def limits(self) -> dict[str, tuple[float, float]]:
        """Of the gains that can be changed in this run."""
        low, high = self._axis.change.low, self._axis.change.high
        if self._axis.command_kind != CommandKind.TORQUE:
            return {}  # the drive closes the loop with gains of its own
        return {name: (float(low[name]), float(high[name])) for name in NAMES if low[name] < high[name]}

    def motion(self) -> str:
        """The motion in force, in words."""
        trajectory = self._axis.trajectory
        speed = peak_of(trajectory, self._block.table).velocity_radps
        return motion_in_words(trajectory, speed)

    @property
    def reference_rad(self) -> float:
        """Where the joint is to be now."""
        return float(self._block.state[0].reference.position_rad)

    @property
    def under_way(self) -> bool:
        """Whether a change has not yet come to its end."""
        state = self._block.state[0]
        following = AxisPhase.APPROACH <= int(state.phase) <= AxisPhase.TRACKING
        moving = bool(state.change.ramping) or int(state.change.motion) != MotionChange.NONE
        return self._open is not None or (following and moving)

    def take(self, request: ViewerRequest) -> None:
        """Begin a change, or refuse it."""
        try:
            if self._open is not None:
                raise ConfigurationError("the change before is still being checked")
            if int(self._block.state[0].phase) not in (AxisPhase.APPROACH, AxisPhase.TRACKING):
                raise ConfigurationError(_WHY[ChangeAnswer.WRONG_PHASE])
            self._open = self._gains(request) if request.kind == "gains" else self._motion(request)
            return
        except JointctlError as error:
            self._refuse(request.who, request.kind, error)
        except Exception as error:  # whatever a page sends, the joint's run goes on
            words = JointctlError(f"not understood: {type(error).__name__}: {error}")
            self._refuse(request.who, request.kind, words)
        if isinstance(request, PreparedMotion):
            request.answered("refused")

    def _gains(self, request: ViewerRequest) -> _Change | None:
        delay_s = self._delay_s()
        if delay_s is None or bool(self._block.state[0].change.ramping):
            raise ConfigurationError("the gains are still changing, or the loop delay has not been measured yet")
        before, limits = self.gains(), self.limits()
        now = {name: before[name] for name in limits}
        low, high = ({name: pair[i] for name, pair in limits.items()} for i in (0, 1))
        after = checked_gains(request.values, now, low, high)
        changed = [name for name in after if after[name] != now[name]]
        if not changed:
            return None
        text = ", ".join(f"control.{name} {now[name]:g} -> {after[name]:g}" for name in changed)
        gate = self._pool.submit(
            require_change, self._config, now, after, delay_s, allow_low_margin=self._allow_low_margin
        )
        return _Change(text, request.who, ChangeKind.GAINS, {**before, **after}, gate, request.kind)

    def _motion(self, request: ViewerRequest) -> _Change:
        values: Mapping[str, Any] = request.values
        if request.kind == "set_point":
            values = {"kind": "hold", "duration_s": 0.0, "position_rad": request.values.get("position_rad")}
        if isinstance(request, PreparedMotion):
            trajectory, words = request.trajectory, request.words
        else:
            trajectory, words = new_motion(self._config, self._block.table, values)
        text = f"motion {self.motion()} -> {words}"
        change = _Change(text, request.who, ChangeKind.MOTION, trajectory, request=request.kind)
        if isinstance(request, PreparedMotion):
            change.answered, change.move_s = request.answered, request.move_s
        self._post(change)
        return change

    def _post(self, change: _Change) -> None:
        change.number = post_change(self._axis.change, change.kind, change.payload, change.move_s)

    def poll(self) -> None:
        """Go on with the open change: the gate's word, then the loop's."""
        change = self._open
        if change is None:
            return
        if change.number == 0:
            if change.gate is None or not change.gate.done():
                return
            error = change.gate.exception()
            if error is not None:
                words = error if isinstance(error, JointctlError) else JointctlError(f"the gate failed: {error}")
                self._refuse(change.who, change.request, words)
                self._open = None
                return
            margin_deg = change.gate.result()
            change.text += f" (phase margin {margin_deg:.0f} deg)"
            self._post(change)
            return
        state = self._block.state[0].change
        if int(state.answered) != change.number:
            return
        self._open = None
        answer = ChangeAnswer(int(state.answer))
        change.answered("" if answer is ChangeAnswer.TAKEN else _WHY.get(answer, answer.name))
        if answer is ChangeAnswer.TAKEN:
            self.tell(INFO, f"parameter change: {change.text}, by {change.who}")
        else:
            self._refuse(change.who, change.request, JointctlError(_WHY.get(answer, answer.name)))

    def _refuse(self, who: str, kind: str, error: JointctlError) -> None:
        text = error.message + (f" ({error.hint})" if error.hint else "")
        count = 1 if self.refused is None else self.refused["count"] + 1
        self.refused = {"count": count, "who": who, "kind": kind, "text": text}
        self.tell(WARNING, f"parameter change refused: {text}; asked for by {who}")

    def settings(self) -> dict[str, Any]:
        """What a page needs to offer changes."""
        now, limits = self.gains(), self._config.limits
        return {
            "gains": {name: (low, now[name], high) for name, (low, high) in self.limits().items()},
            "motion": self.motion(),
            "range": (limits.position_min_rad, limits.position_max_rad),
            "velocity_max_radps": limits.velocity_max_radps,
            "brake_radps2": self._config.sequence.brake_radps2,
            "reference_rad": self.reference_rad,
            "under_way": self.under_way,
            "refused": self.refused,
        }

    def close(self) -> None:
        """Nothing more is checked."""
        self._pool.shutdown(wait=False, cancel_futures=True)


# --- What viewers may do with a run besides stopping it: change it, and have a stretch of it recorded on its own ---


SETTINGS_s = 0.5  # how often the page gets the state
UNWATCHED = "no page is open any more; the joint goes on, Ctrl-C or `jointctl stop` brakes it"


class ViewerOrders(AbstractContextManager["ViewerOrders"]):
    """One run.  The run log has everything in any case.

    A recording is a log of its own beside the run log: NAME.recording-1.mcap.
    """

    def __init__(self, changes: LiveChanges, log_path: Path, metadata: Mapping[str, Mapping[str, str]]) -> None:
        self._changes, self._log_path, self._metadata, self._tell = changes, log_path, metadata, changes.tell
        self._recording: RunLogWriter | None = None
        self._count = 0
        self._told_s = 0.0

    def serve(self, display: Display) -> None:
        """Take what was asked for since the last call, go on with what is open, tell the page."""
        for request in display.requests():
            if request.kind in ("gains", "set_point", "trajectory", "motion"):
                self._changes.take(request)
            elif request.kind == "record":
                self._record(bool(request.values.get("on")), request.who)
            elif request.kind == "viewers":
                self._count_viewers(request, display)
        self._changes.poll()
        now_s = time.monotonic()
        if now_s - self._told_s >= SETTINGS_s:
            self._told_s = now_s
            recording = self._recording.path.name if self._recording is not None else ""
            display.settings({"stage": "running", **self._changes.settings(), "recording": recording})

    def _count_viewers(self, request: ViewerRequest, display: Display) -> None:
        """Whether anybody can see the joint move: reported in the terminal and in the log."""
        watched = bool(request.values.get("count"))
        text = "a page is open again" if watched else str(request.values.get("text") or UNWATCHED)
        self._tell(INFO if watched else WARNING, text)
        display.note(text)

    def _record(self, on: bool, who: str) -> None:
        if on == (self._recording is not None):
            return
        if not on:
            self._end_recording(f"by {who}")
            return
        self._count += 1
        path = self._log_path.with_name(f"{self._log_path.stem}.recording-{self._count}.mcap")
        try:
            self._recording = RunLogWriter(path, self._metadata)
        except DataError as error:
            self._tell(WARNING, f"no recording: {error}")
            return
        self._tell(INFO, f"recording {path.name} begun by {who}")

    def _end_recording(self, how: str) -> None:
        if self._recording is None:
            return
        recording, self._recording = self._recording, None
        try:
            recording.close()
        except DataError as error:
            how += f", incomplete: {error}"
        self._tell(INFO, f"recording {recording.path.name} ended {how}")

    def keep(self, new: np.recarray | Event) -> None:
        """New records or an event, as in the run log; a recording that cannot be written does not end the run."""
        if self._recording is None:
            return
        try:
            if isinstance(new, Event):
                self._recording.write_event(new.level, new.source, new.text, new.time_ns)
            else:
                self._recording.write_records(new)
        except DataError as error:
            self._end_recording(f"because of {error}")

    def __exit__(self, *_: object) -> None:
        self._end_recording("with the run")
        self._changes.close()
