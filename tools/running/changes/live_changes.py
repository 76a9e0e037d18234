"""Changes that a viewer asks for, from the request to the loop and its answer; each one is told as an event.

One at a time.  Gains go through the stability gate in a thread of their own, since the supervisor must keep its sign
of life; the loop has the last word (`firmware_py.live_change`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.live_change import gains_of
from jointctl.firmware_py.records import ChangeAnswer, ChangeKind, Gains, MotionChange
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.states import AxisPhase, CommandKind
from jointctl.firmware_py.trajectory import peak_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.run_log import INFO, WARNING
from jointctl.tools.running.changes.change_gate import checked_gains, require_change
from jointctl.tools.running.changes.new_motion import motion_in_words, new_motion
from jointctl.tools.running.display.viewer_request import ViewerRequest

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


@dataclass
class _Change:
    text: str  # old and new
    who: str
    kind: ChangeKind
    payload: Any  # Gains as a mapping, or TrajectoryConstants
    gate: Future[float] | None = None
    number: int = 0  # 0: not yet with the loop


class LiveChanges:
    """`tell(level, text)` is given every event; `delay_s()` the measured loop delay, None until it is known."""

    def __init__(
        self,
        config: Config,
        block: Any,
        tell: Callable[[int, str], None],
        delay_s: Callable[[], float | None],
        *,
        allow_low_margin: bool = False,
    ) -> None:
        self._config, self._block, self._tell, self._delay_s = config, block, tell, delay_s
        self._allow_low_margin = allow_low_margin
        self._open: _Change | None = None
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
        if self._axis.command_kind == CommandKind.VELOCITY:
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
        except JointctlError as error:
            self._refuse(request.who, error)
        except Exception as error:  # whatever a page sends, the joint's run goes on
            self._refuse(request.who, JointctlError(f"not understood: {type(error).__name__}: {error}"))

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
        return _Change(text, request.who, ChangeKind.GAINS, {**before, **after}, gate)

    def _motion(self, request: ViewerRequest) -> _Change:
        values: Mapping[str, Any] = request.values
        if request.kind == "set_point":
            values = {"kind": "hold", "duration_s": 0.0, "position_rad": request.values.get("position_rad")}
        trajectory, words = new_motion(self._config, self._block.table, values)
        change = _Change(f"motion {self.motion()} -> {words}", request.who, ChangeKind.MOTION, trajectory)
        self._post(change)
        return change

    def _post(self, change: _Change) -> None:
        """The request first, its number last; the loop has answered every earlier one."""
        box = self._axis.change
        change.number = int(box.order[0]) + 1
        request = box.request
        request.kind = change.kind
        if change.kind is ChangeKind.GAINS:
            for name in NAMES:
                request.gains[name] = change.payload[name]
        else:
            request.trajectory = change.payload[0]
        request.first = request.last = change.number
        box.order[0] = change.number

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
                self._refuse(change.who, words)
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
        if answer is ChangeAnswer.TAKEN:
            self._tell(INFO, f"parameter change: {change.text}, by {change.who}")
        else:
            self._tell(WARNING, f"parameter change refused: {_WHY.get(answer, answer.name)}; asked for by {change.who}")

    def _refuse(self, who: str, error: JointctlError) -> None:
        hint = f" ({error.hint})" if error.hint else ""
        self._tell(WARNING, f"parameter change refused: {error.message}{hint}; asked for by {who}")

    def close(self) -> None:
        """Nothing more is checked."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def settings_of(changes: LiveChanges, config: Config) -> dict[str, Any]:
    """What a page needs to offer changes."""
    now = changes.gains()
    return {
        "gains": {name: (low, now[name], high) for name, (low, high) in changes.limits().items()},
        "motion": changes.motion(),
        "range": (config.limits.position_min_rad, config.limits.position_max_rad),
        "reference_rad": changes.reference_rad,
        "under_way": changes.under_way,
    }
