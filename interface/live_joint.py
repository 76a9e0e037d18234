"""Joints in real time for a program: the Session in a thread of its own, and the loop's memory between both."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import JointctlError, MotionFault, UsageError
from jointctl.drivers.stop_note import asked
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.states import AxisPhase
from jointctl.program import POLL_S, TABLE_ROWS, Newest, NewMotion, Source, axes_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.scoping.remote import remote
from jointctl.tools.scoping.remote_options import NOBODY_REMOTE, RemoteOptions
from jointctl.tools.session import result as drive_end
from jointctl.tools.session.control import Control, in_program
from jointctl.tools.session.display import Display, PreparedMotion, ViewerRequest
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.loop_memory import RING_RECORDS
from jointctl.tools.session.plan import FreeMotion, resolve
from jointctl.tools.session.result import RunResult
from jointctl.tools.session.session import Session
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.session.set_points import load_check
from jointctl.tools.verbs.start import occupy_standard_streams

WHO = "the program"
ENDED, AGAIN = "the run has ended", "begin a new Joint"
FORKED = "this process was forked from the one that has the joint", "call it there; nothing here reaches it"
NOT_COMMISSIONED = "the joint is not commissioned", "use it in a `with` block"
# what takes its time to load, and is needed while the joint waits for its program
_NEEDED = ("scipy.interpolate", "jointctl.tools.session.live_changes", "jointctl.tools.configuration.checks")
ANSWER_S = 2.0  # of the loop to a new motion


class _Approval:
    """`Consent` in the session's thread: waits for what the program says in its own."""

    dry_run = False
    brake = None  # a drive that is found enabled is left alone

    def __init__(self, leave_if_asked: Callable[[], None], stop_if_over: Callable[[], None]) -> None:
        self._leave_if_asked, self._stop_if_over = leave_if_asked, stop_if_over
        self.lines: tuple[str, ...] = ()
        self.asked, self.answered = threading.Event(), threading.Event()
        self.answer = False

    def show(self, lines: Sequence[str]) -> None:
        """See `Consent`."""

    def agreed(self, lines: Sequence[str]) -> bool:
        self.lines = tuple(lines)
        self.asked.set()
        while not self.answered.wait(POLL_S):
            self._stop_if_over()
            self._leave_if_asked()
        return self.answer


class _ProgramDisplay(Display):
    """What the run says is kept for the program; motions of the program go to the session."""

    def __init__(self, stop_if_over: Callable[[], None]) -> None:
        self._stop_if_over = stop_if_over
        self.notes: list[str] = []
        self.motions: list[PreparedMotion] = []  # the program's thread adds, the session's takes away

    def note(self, text: str) -> None:
        self.notes.append(text)

    def requests(self) -> Sequence[ViewerRequest]:
        self._stop_if_over()
        taken = self.motions[:]
        del self.motions[: len(taken)]
        return taken


class _SessionThread(threading.Thread):
    """Which Python waits for when the program ends: the drive is off then."""


class LiveMotor:
    """See `Motor`.  The session supervises in a thread; the loop has its own process, as in `jointctl run`."""

    def __init__(
        self, source: Source, asked_ns: int, options: RemoteOptions = NOBODY_REMOTE, *, allow_low_margin: bool = False
    ) -> None:
        self._asked_ns = asked_ns  # when the program asked for it
        self._source, self._options, self._allow_low_margin = source, options, allow_low_margin
        self.axes = axes_of(source.config)
        self.drive = session_drive(self.axes.joints[0].drive.kind)
        self._motions: list[FreeMotion] = []
        self._display = _ProgramDisplay(self._stop_if_over)
        self._stack, self._bus = ExitStack(), ExitStack()  # of the whole block; of the session
        self._thread: threading.Thread | None = None
        self._over = False  # its work is done; Python 3.11 takes a thread for ended whose `join` Ctrl-C interrupts
        self._session: Session | None = None
        self._control: Control | None = None
        self._approval: _Approval | None = None
        self._loop: LoopHandle | None = None
        self.result: RunResult | None = None
        self._error: BaseException | None = None
        self._told = False  # whether the program has got `_error`
        self._began_ns = 0
        self._process = os.getpid()  # the one that has it
        self.log_paths: tuple[Path, ...] = ()
        self.constants: Any = None
        self.axis: Any = None
        self.tables = np.zeros((0, 0, 5))

    def begin(self) -> None:
        """Commission: returns with the drive ready and disabled, or raises why not."""
        self._process = os.getpid()
        occupy_standard_streams()
        try:
            own = self._stack.enter_context(self._source.served())
            load_check()  # not beside commissioning: compiling would hold up the heartbeat
            if self.axes.arm is not None:
                from jointctl.tools.analysis.arm_check import load_torques

                load_torques(self.axes.arm)
            output = Output(quiet=True)
            others = self._stack.enter_context(
                remote(self._options, self._source.config, output, owner=WHO, motion="program")
            )
            self._stack.enter_context(self._bus)
            asked(self._asked_ns)
            control = self._control = self._bus.enter_context(
                in_program(self.axes.joints[0], output, self.axes.joints[1:])
            )
            if control.signals.commanded_ns:
                raise MotionFault(f"stopped by {control.signals.name} before it began; nothing has moved", AGAIN)
            self._approval = _Approval(control.signals.leave_if_asked, self._stop_if_over)
            plan = resolve(self._source.config, self._motion, allow_low_margin=self._allow_low_margin)
            self.log_paths = tuple(joint.log_path for joint in plan.joints)
            display = others.beside(lambda _: self._display)
            self._session = Session(plan, self._approval, output, control, display, others.set_points)
            self._session.own = own
            self._thread = _SessionThread(target=self._run, name="jointctl session")
            self._thread.start()
            for name in _NEEDED:  # commissioning waits for the drive most of the time
                import_module(name)
            while not self._approval.asked.wait(POLL_S):
                self.require()
            self._began_ns = time.monotonic_ns()  # the last call: an interrupt behind it finds the block entered
        except BaseException:
            self._end()
            self._stack.close()
            raise

    def _motion(self, config: Config) -> FreeMotion:
        self._motions.append(FreeMotion(config, np.zeros((TABLE_ROWS, 5)), by_program=True))
        return self._motions[-1]

    def _run(self) -> None:
        assert self._session is not None
        try:
            self.result = self._session.run()
        except BaseException as error:  # for the program's own thread
            self._error = error
        finally:
            try:
                self._bus.close()  # the drive is off for good: `jointctl stop` has no program to wait for any more
            finally:
                self._over = True

    def _stop_if_over(self) -> None:
        """Where the program has come to its end without leaving the block: what it leaves running moves nothing.

        Python waits for threads that are no daemons before it ends: for those of sessions, and of the program's own.
        """
        control = self._control
        if control is None or control.signals.count or threading.main_thread().is_alive():
            return
        left = [thread for thread in threading.enumerate() if thread.is_alive() and not thread.daemon]
        if all(isinstance(thread, _SessionThread) for thread in left):
            control.signals.name, control.signals.count = control.signals.name or "the end of the program", 1

    def _raise(self) -> None:
        """What has ended the session, if it has."""
        self._require_here()
        if not self._over:
            return
        self._told = True
        error, result = self._error, self.result
        if isinstance(error, JointctlError):
            raise error.with_traceback(None)
        if error is not None and not isinstance(error, KeyboardInterrupt):
            raise error
        if result is not None and result.faulty:
            fault = result.faulty[0].motion_fault()
            if result.stopped_by:  # a drive that a stop has switched off, say
                fault = MotionFault(f"{fault.message}; stopped by {result.stopped_by}", fault.hint)
            raise fault
        self._require_off()
        control = self._control
        by = result.stopped_by if result is not None else control.signals.name if control is not None else ""
        raise MotionFault(f"{ENDED}{f', by {by}' if by else ''}; the joint is off", AGAIN)

    def _require_here(self) -> None:
        """A process that is forked inherits the loop's memory; its calls must neither count nor seem to."""
        if os.getpid() != self._process:
            raise UsageError(*FORKED)

    def require(self) -> None:
        if self.axis is not None and self.axis["phase"].max() > AxisPhase.TRACKING:
            self._join()  # it is being stopped: the cause is known at the end
        self._raise()

    def enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        try:
            self._enable(approve)
        except BaseException:
            self._ask_end()  # behind an `enable` that was interrupted nothing may begin, whatever becomes of that
            raise

    def _enable(self, approve: Callable[[Sequence[str]], bool] | None) -> None:
        approval, session = self._approval, self._session
        if approval is None or session is None:
            raise MotionFault(*NOT_COMMISSIONED)
        self._raise()
        approval.answer = approve is None or approve(approval.lines)
        approval.answered.set()
        if not approval.answer:
            self._join()
            raise MotionFault("the motion was not approved; nothing has moved")
        while session.loop is None or not session.loop.started:
            self._raise()
            time.sleep(POLL_S)
        loop = self._loop = session.loop
        self.tables = loop.block.tables
        self.axis = loop.block.state
        constants = self.constants = loop.block.constants
        alive_ns = constants["stream"]["alive_ns"]
        while (self.axis["phase"] != AxisPhase.TRACKING).any():
            alive_ns[:] = time.monotonic_ns()
            self.require()
            time.sleep(POLL_S)

    def newest(self) -> Newest:
        now_ns = time.monotonic_ns()
        starts_rad = tuple(motion.start_rad for motion in self._motions)
        if not starts_rad:
            raise MotionFault(*NOT_COMMISSIONED)
        loop = self._loop
        head = 0 if loop is None else int(loop.block.words[Word.HEAD])
        if loop is None or head == 0:
            self._raise()
            return Newest((), starts_rad, now_ns, self._began_ns)
        if self._over and self.axis["phase"].min() < AxisPhase.FINISHED:
            self._raise()  # the loop has died: its last cycle is no state of the joint any more
        ring, axes = loop.block.ring.view(np.ndarray), loop.block.axes
        records = tuple(ring[(head - axes + axis) % RING_RECORDS].copy() for axis in range(axes))
        return Newest(records, starts_rad, now_ns, int(records[0]["time_ns"]))

    def now_ns(self) -> int:
        self._require_here()
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        time.sleep(min(seconds, 0.05))
        self.require()

    def post(self, motions: Sequence[NewMotion], move_s: float) -> None:
        self.require()
        answers: list[str] = []
        display = self._display
        display.motions.extend([
            PreparedMotion("motion", WHO, {}, *motion, answered=answers.append, joint=name, move_s=move_s)
            for motion, name in zip(motions, self.axes.names, strict=True)
        ])  # fmt: skip
        end_s = time.monotonic() + ANSWER_S
        try:
            while len(answers) < len(motions):
                self.require()
                if time.monotonic() > end_s:
                    raise MotionFault(f"the loop did not answer within {ANSWER_S:g} s")
                time.sleep(POLL_S)
        finally:
            display.motions.clear()  # what has not been taken must not begin after this call
        if refused := [answer for answer in answers if answer]:
            raise MotionFault(f"the loop did not take the motion: {refused[0]}")

    def stop(self) -> None:
        self._require_here()
        self._end()
        self._require_off()

    def _require_off(self) -> None:
        if self._session is not None:
            drive_end.require_off(self._session.drive_state)

    def _ask_end(self) -> None:
        if self._control is not None:
            signals = self._control.signals
            signals.name, signals.count = signals.name or WHO, max(signals.count, 1)

    def _end(self) -> None:
        """Ask for the end, and wait for it whatever is raised here in between: by a signal of the program's, say.

        Ctrl-C asks for more, as in `jointctl run`.
        """
        control, thread = self._control, self._thread
        if control is None or thread is None:
            return
        self._ask_end()  # also of a thread whose `start` was interrupted: it may have no number yet, and begin later
        if thread.ident is None:
            return
        signals = control.signals
        raised: BaseException | None = None
        while not self._over:
            try:
                self._ask_end()
                self._join()
            except KeyboardInterrupt as error:
                signals.count, raised = signals.count + 1, error
            except BaseException as error:
                raised = error
        if raised is not None:
            raise raised

    def _join(self) -> None:
        while not self._over:
            time.sleep(POLL_S)

    def close(self) -> None:
        if os.getpid() != self._process:
            return
        try:
            self._end()
        finally:
            self._stack.close()
        error, result = self._error, self.result
        if not self._told:
            if isinstance(error, JointctlError) or (result is not None and result.faulty):
                self._raise()
            if error is not None and not isinstance(error, (JointctlError, KeyboardInterrupt)):
                raise error
        self._require_off()  # whatever the program has made of a fault
