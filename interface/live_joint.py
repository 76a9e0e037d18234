"""A joint in real time for a program: the Session in a thread of its own, and the loop's memory between both."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import JointctlError, MotionFault
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.states import AxisPhase, Fault, fault_name, in_words
from jointctl.joint import POLL_S, TABLE_ROWS, State
from jointctl.joint_source import JointSource
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, Event, log_path
from jointctl.tools.scoping.remote import remote
from jointctl.tools.scoping.remote_options import NOBODY_REMOTE, RemoteOptions
from jointctl.tools.session import result as drive_end
from jointctl.tools.session.control import Control, in_program
from jointctl.tools.session.display import OnlyShows, PreparedMotion, Snapshot, ViewerRequest
from jointctl.tools.session.loop_handle import RING_RECORDS, LoopHandle
from jointctl.tools.session.plan import FreeMotion, RunPlan
from jointctl.tools.session.result import RunResult
from jointctl.tools.session.session import Session
from jointctl.tools.session.session_drive import drive_state_name, session_drive
from jointctl.tools.session.set_points import load_check

WHO = "the program"
ENDED = "the run has ended"
# what takes its time to load, and is needed while the joint waits for its program
_NEEDED = ("scipy.interpolate", "jointctl.tools.session.live_changes", "jointctl.tools.configuration.checks")
_PHASES = tuple(in_words(phase) for phase in AxisPhase)
ANSWER_S = 2.0  # of the loop to a new motion


class _Approval:
    """`Consent` in the session's thread: waits for what the program says in its own."""

    dry_run = False
    brake = None  # a drive that is found enabled is left alone

    def __init__(self, leave_if_asked: Callable[[], None]) -> None:
        self._leave_if_asked = leave_if_asked
        self.lines: tuple[str, ...] = ()
        self.asked, self.answered = threading.Event(), threading.Event()
        self.answer = False

    def show(self, lines: Sequence[str]) -> None:
        """See `Consent`."""

    def agreed(self, lines: Sequence[str]) -> bool:
        self.lines = tuple(lines)
        self.asked.set()
        while not self.answered.wait(POLL_S):
            self._leave_if_asked()
        return self.answer


class _ProgramDisplay(OnlyShows):
    """What the run says is kept for the program; motions of the program go to the session."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.motions: list[PreparedMotion] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def phase(self, text: str) -> None:
        """See `Display`."""

    def show(self, snapshot: Snapshot) -> None:
        """See `Display`."""

    def event(self, event: Event) -> None:
        if event.level >= ERROR:
            self.notes.append(event.text)

    def requests(self) -> Sequence[ViewerRequest]:
        taken, self.motions = self.motions, []
        return taken

    def __enter__(self) -> _ProgramDisplay:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to take away."""


class LiveMotor:
    """See `Motor`.  The session supervises in a thread; the loop has its own process, as in `jointctl run`."""

    def __init__(
        self, source: JointSource, options: RemoteOptions = NOBODY_REMOTE, *, allow_low_margin: bool = False
    ) -> None:
        self._source, self._options, self._allow_low_margin = source, options, allow_low_margin
        self.config, self._drive = source.config, session_drive(source.config.drive.kind)
        self._motion = FreeMotion(self.config, np.zeros((TABLE_ROWS, 5)), by_program=True)
        self._display = _ProgramDisplay()
        self._stack = ExitStack()
        self._thread: threading.Thread | None = None
        self._session: Session | None = None
        self._control: Control | None = None
        self._approval: _Approval | None = None
        self._loop: LoopHandle | None = None
        self.result: RunResult | None = None
        self._error: BaseException | None = None
        self._told = False  # whether the program has got `_error`
        self._began_ns = 0
        self.log_path: Path | None = None
        self.constants: Any = None
        self.axis: Any = None
        self.table = np.zeros((0, 5))

    def begin(self) -> None:
        """Commission: returns with the drive ready and disabled, or raises why not."""
        try:
            self._stack.enter_context(self._source.served())
            load_check()  # not beside commissioning: compiling would hold up the heartbeat
            output = Output(quiet=True)
            others = self._stack.enter_context(remote(self._options, self.config, output, owner=WHO))
            control = self._control = self._stack.enter_context(in_program(self.config, output))
            self._approval = _Approval(control.signals.leave_if_asked)
            plan = RunPlan(self.config, self._motion, log_path(self.config), self._allow_low_margin)
            self.log_path = plan.log_path
            display = others.beside(lambda _: self._display)
            self._session = Session(plan, self._approval, output, control, display, others.set_points)
            self._thread = threading.Thread(target=self._run, name="jointctl session")
            self._thread.start()
            for name in _NEEDED:  # commissioning waits for the drive most of the time
                import_module(name)
            while not self._approval.asked.wait(POLL_S):
                self.require()
        except BaseException:
            self._end()
            self._stack.close()
            raise
        self._began_ns = time.monotonic_ns()

    def _run(self) -> None:
        assert self._session is not None
        try:
            self.result = self._session.run()
        except BaseException as error:  # for the program's own thread
            self._error = error

    def _raise(self) -> None:
        """What has ended the session, if it has."""
        if self._thread is None or self._thread.is_alive():
            return
        self._told = True
        error, result = self._error, self.result
        if isinstance(error, JointctlError):
            raise error.with_traceback(None)
        if error is not None and not isinstance(error, KeyboardInterrupt):
            raise error
        if result is not None and result.fault_text is not None:
            text = result.fault_text
            raise MotionFault(f"{result.fault.name} ({int(result.fault)}): {text.happened}", text.advice)
        control = self._control
        by = result.stopped_by if result is not None else control.signals.name if control is not None else ""
        raise MotionFault(f"{ENDED}{f', by {by}' if by else ''}; the joint is off", "begin a new Joint")

    def require(self) -> None:
        if self.axis is not None and self.axis[0].phase > AxisPhase.TRACKING:
            self._join()  # it is being stopped: the cause is known at the end
        self._raise()

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        approval, session = self._approval, self._session
        if approval is None or session is None:
            raise MotionFault("the joint is not commissioned", "use it in a `with` block")
        self._raise()
        approval.answer = True if approve is None else bool(approve(approval.lines))
        approval.answered.set()
        if not approval.answer:
            self._join()
            raise MotionFault("the motion was not approved; nothing has moved")
        while session.loop is None or not session.loop.started:
            self._raise()
            time.sleep(POLL_S)
        loop = self._loop = session.loop
        self.table = loop.block.table
        self.axis = loop.block.state
        constants = self.constants = loop.block.constants
        alive_ns = constants["stream"]["alive_ns"][0]
        while self.axis[0].phase != AxisPhase.TRACKING:
            alive_ns[0] = time.monotonic_ns()
            self.require()
            time.sleep(POLL_S)

    def state(self) -> State:
        now_ns = time.monotonic_ns()
        loop = self._loop
        head = 0 if loop is None else int(loop.block.words[Word.HEAD])
        if loop is None or head == 0:
            self._raise()
            at_rad, age_s = self._motion.start_rad, (now_ns - self._began_ns) * 1e-9
            return State(at_rad, 0.0, 0.0, at_rad, "commissioned", "", "switch on disabled", age_s, now_ns * 1e-9)
        record = loop.block.ring.view(np.ndarray)[(head - 1) % RING_RECORDS].copy()
        return state_of(record, self._drive, now_ns)

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        time.sleep(min(seconds, 0.05))
        self.require()

    def post(self, trajectory: Any, words: str) -> None:
        self.require()
        answers: list[str] = []
        self._display.motions.append(PreparedMotion("motion", WHO, {}, trajectory, words, answers.append))
        end_s = time.monotonic() + ANSWER_S
        while not answers:
            self.require()
            if time.monotonic() > end_s:
                raise MotionFault(f"the loop did not answer within {ANSWER_S:g} s")
            time.sleep(POLL_S)
        if answers[0]:
            raise MotionFault(f"the loop did not take the motion: {answers[0]}")

    def stop(self) -> None:
        self._end()

    def _end(self) -> None:
        """Ask for the end, and wait for it; Ctrl-C meanwhile asks for more, as in `jointctl run`."""
        control, thread = self._control, self._thread
        if control is None or thread is None:
            return
        signals = control.signals
        if not signals.count:
            signals.name, signals.count = signals.name or WHO, 1
        interrupted = False
        while thread.is_alive():
            try:
                self._join(0.1)
            except KeyboardInterrupt:
                signals.count, interrupted = signals.count + 1, True
        if interrupted:
            raise KeyboardInterrupt

    def _join(self, seconds: float | None = None) -> None:
        if self._thread is not None:
            self._thread.join(seconds)

    def close(self) -> None:
        try:
            self._end()
        finally:
            self._stack.close()
        error, result = self._error, self.result
        if self._told:
            return
        if isinstance(error, JointctlError) or (result is not None and result.fault is not Fault.NONE):
            self._raise()
        if error is not None and not isinstance(error, (JointctlError, KeyboardInterrupt)):
            raise error
        if self._session is not None:
            drive_end.require_off(self._session.drive_state)


def state_of(record: Any, drive: Any, now_ns: int) -> State:
    """A log record in words and numbers; `now_ns` on the clock of the record."""
    fault = int(record["fault"])
    return State(
        position_rad=float(record["position_rad"]),
        velocity_radps=float(record["velocity_radps"]),
        torque_Nm=float(record["measured_torque_Nm"]),
        desired_position_rad=float(record["desired_position_rad"]),
        phase=_PHASES[record["phase"]],
        fault=fault_name(fault) if fault else "",
        drive_state=drive_state_name(drive, int(record["status_word"]), int(record["drive_state"])),
        age_s=max(0.0, (now_ns - int(record["time_ns"])) * 1e-9),
        time_s=now_ns * 1e-9,
    )
