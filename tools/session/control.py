"""A program's control of a joint: the lock of its bus, and the stops that reach it."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import FrameType

from jointctl.drivers.bus_lock import STOP_WITHIN_S, BusLock, lock_name, stop_is_noted
from jointctl.drivers.canopen.switch_off import OFF_S, QUICK_STOP_S
from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.errors import DeviceError, MotionFault, UsageError
from jointctl.drivers.stop_note import now_ns
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output

# --- Ctrl-C, SIGTERM, a closed terminal and `jointctl stop` as stop requests; asking again asks for more ---


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STOP_COMMAND = "jointctl stop"
AGAIN_S = 0.05
STOOD_S = 30.0  # between two looks after a yes: this program was stopped (Ctrl-Z), or the computer slept
LOOK_S = 1.0  # how often it is looked, whatever is computed between two motions
_ESCALATION = (StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF)


class StopSignals:
    """Counts stop signals; `request` is what they ask for by now.  Nothing takes a stop back.

    While `raising`, a signal also raises KeyboardInterrupt: it does so wherever nothing has to come to its end first.
    """

    def __init__(self, *, raising: bool = False, wake: Callable[[], None] | None = None) -> None:
        self._wake = wake or _wake_main
        self.count = 0
        self.name = ""  # of the first signal, or STOP_COMMAND
        self.raising = raising
        self.commanded_ns = 0  # CLOCK_MONOTONIC of `jointctl stop`; 0 = it has not come
        # a stop reaches a loop that runs at once, and not with the supervisor's next look
        self.on_command: Callable[[StopRequest], None] = lambda _: None
        self._again = False  # the next signal is no new one
        self.looked_ns: int | None = None  # by `now_ns`; from the user's yes on, which may be for several motions
        self.stood_s = 0.0  # since then, if it was long
        self.agreed_ns = 0  # to the motion that is about to begin
        self.drives: list[str] = []  # those that answered first, `DriveIdentity.text` of each
        self._command = threading.Lock()

    @property
    def request(self) -> StopRequest:
        """NONE, then RAMP, QUICK_STOP and OFF with each further signal; `jointctl stop` is a quick stop at least."""
        asked = _ESCALATION[min(self.count, len(_ESCALATION)) - 1] if self.count else StopRequest.NONE
        return max(asked, StopRequest.QUICK_STOP) if self.commanded_ns else asked

    @property
    def by_command(self) -> str:
        """` by jointctl stop` where that has ended it, for messages."""
        return f" by {STOP_COMMAND}" if self.commanded_ns else ""

    @property
    def stopped_by(self) -> str:
        """Name of the signal that has interrupted it, or that it was interrupted."""
        return self.name or "interruption"

    def on_signal(self, number: int, _: FrameType | None) -> None:
        if self._again:
            self._again = False
        else:
            self.count += 1
            self.name = self.name or signal.Signals(number).name
            self.on_command(self.request)
        if self.raising:
            raise KeyboardInterrupt

    def raise_again(self) -> threading.Timer:
        """Soon, in the main thread: what was raised there has not got through."""
        self._again = True
        timer = threading.Timer(AGAIN_S, _wake_main)
        timer.daemon = True
        timer.start()
        return timer

    def on_stop_command(self) -> None:
        """`jointctl stop` has come; in another thread than the run, of an arm by the lock of each of its buses."""
        with self._command:
            if self.commanded_ns:
                return
            self.commanded_ns = time.monotonic_ns()
        self.name = STOP_COMMAND
        self.on_command(self.request)
        self._wake()  # from whatever the run waits for

    def leave_if_asked(self) -> None:
        """`KeyboardInterrupt` once a stop was asked for: between two steps before the joint may move."""
        if self.count or self.commanded_ns:
            raise KeyboardInterrupt
        self.look()

    def agreed(self) -> None:
        """The user has said yes to this motion, or before to all of a command."""
        self.agreed_ns = now_ns()
        self.looked_ns = self.looked_ns or self.agreed_ns

    def begin(self) -> None:
        """As `look`, before a loop is let go, and before it may enable: also where this program has waited since.

        As for a disk, or for margins that take a slow computer long.
        """
        if (waited_s := (now_ns() - self.agreed_ns) * 1e-9) > STOOD_S:
            self.stood_s = waited_s
        self.look()

    def look(self) -> None:
        """`MotionFault` where a yes is out of date: who goes on after a standstill moves when no one expects it."""
        self.note_standstill()
        if self.stood_s:
            raise MotionFault(
                f"this program or the computer stood still, or was too slow, for {self.stood_s:.0f} s after the motion "
                "was agreed to",
                "nothing moves: start again",
            )

    def require_same(self, drives: Sequence[DriveIdentity]) -> None:
        """`DeviceError` where another drive answers than at a motion before: one yes is for one joint."""
        found = [drive.text for drive in drives]
        if self.drives and found != self.drives:
            before = ", ".join(self.drives)
            raise DeviceError(
                f"another drive answers than before: {', '.join(found)}; it was {before}", "nothing moves: start anew"
            )
        self.drives = found

    def note_standstill(self) -> None:
        """In any thread."""
        if self.looked_ns is None:
            return
        looked_ns = now_ns()
        if (stood_s := (looked_ns - self.looked_ns) * 1e-9) > STOOD_S:
            self.stood_s = stood_s
        self.looked_ns = looked_ns

    @contextmanager
    def held(self) -> Iterator[None]:
        """A signal raises nothing inside: what is begun there must come to its end."""
        before, self.raising = self.raising, False
        try:
            yield
        finally:
            self.raising = before


def _wake_main() -> None:
    main = threading.main_thread().ident
    if main is not None:
        with contextlib.suppress(ProcessLookupError):
            signal.pthread_kill(main, signal.SIGTERM)


@contextmanager
def stop_signals(*, raising: bool = False) -> Iterator[StopSignals]:
    """Collect stop signals while the block runs instead of ending the program; `UsageError` in another thread."""
    if threading.current_thread() is not threading.main_thread():
        raise UsageError(
            "this takes over Ctrl-C, which Python allows in the main thread only", "call it there; a Joint may have any"
        )
    signals = StopSignals(raising=raising)
    before = {number: signal.signal(number, signals.on_signal) for number in STOP_SIGNALS}
    try:
        if any(getattr(handler, "seen", False) for handler in before.values()):
            raise KeyboardInterrupt  # one that Python has dropped (verbs/start.py)
        with _nothing_lost(signals):
            yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _nothing_lost(signals: StopSignals) -> Iterator[None]:
    """A KeyboardInterrupt that comes up in a callback of a library, as of the compiler, or in `__del__`, ends there.

    Python would only print it, and go on: it is raised again instead.
    """
    show = sys.unraisablehook
    timers: list[threading.Timer] = []

    def on_lost(lost: sys.UnraisableHookArgs) -> None:
        if lost.exc_type is KeyboardInterrupt:
            timers.append(signals.raise_again())
        else:
            show(lost)

    sys.unraisablehook = on_lost
    try:
        yield
    finally:
        sys.unraisablehook, signals.raising = show, False
        for timer in timers:  # none may come when the signals have their old meaning again
            timer.cancel()
            timer.join()


# --- A program's control of a joint, from before anything is sent to the drive until the program ends ---
# It holds the lock of the bus, of an arm those of all its buses, collects the user's stops, and passes `jointctl stop`
# on to whatever it is doing.  One for each verb that moves a joint or changes its drive, around all that it does: a
# stop between two motions counts too.


FILES_S = 4.0  # for log and messages, after the drive is off


@dataclass(frozen=True)
class Control:
    """`signals` raise KeyboardInterrupt except while the joint may have torque; child processes get `marker_fds`.

    `bus_is_there`: to be called when a virtual bus of the program's own has come, whose lock has another name then.
    """

    signals: StopSignals
    marker_fds: tuple[int, ...] = ()
    bus_is_there: Callable[[], None] = lambda: None


def stop_within_s(config: Config) -> float:
    """How long the program may take to end after `jointctl stop`: quick stop, switching off, read back, files."""
    sequence = config.sequence
    braking_s = max(QUICK_STOP_S, sequence.stop_timeout_s)  # once more, of a drive that the loop does not reach
    off_s = max(OFF_S, sequence.off_timeout_s)
    return sequence.stop_timeout_s + sequence.off_timeout_s + braking_s + off_s + FILES_S


@contextmanager
def in_control(config: Config, output: Output, others: Sequence[Config] = ()) -> Iterator[Control]:
    """`BusError` names the program that has the bus; `others`: joints of an arm besides."""
    joints = (config, *others)
    with (
        stop_signals(raising=True) as signals,
        _locked(_places(joints), output, _within_s(joints), signals) as control,
        _looked_on(signals),
    ):
        yield control


@contextmanager
def _looked_on(signals: StopSignals) -> Iterator[None]:
    """A command of several motions computes for minutes between two of them: that is no standstill."""
    ended = threading.Event()

    def look_on() -> None:
        while not ended.wait(LOOK_S):
            signals.note_standstill()

    threading.Thread(target=look_on, name="standstill", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


@contextmanager
def in_program(config: Config, output: Output, others: Sequence[Config] = ()) -> Iterator[Control]:
    """As `in_control`, for a run in another thread than the main one: Python's signals stay the program's own.

    A stop that has come before it is in `Control.signals`.
    """
    joints, signals = (config, *others), StopSignals(wake=lambda: None)
    with _locked(_places(joints), output, _within_s(joints), signals) as control:
        yield control


def stop_has_come(signals: StopSignals, joints: Sequence[Config]) -> bool:
    """Whether `jointctl stop` has: its frames may be seen before its word is heard, but its note is older than both."""
    if any(stop_is_noted(*place) for place in _places(joints)):
        signals.on_stop_command()
    return signals.commanded_ns != 0


def _places(joints: Sequence[Config]) -> list[tuple[str, str]]:
    """Interface and channel of each bus."""
    return list(dict.fromkeys((config.bus.interface, config.bus.channel) for config in joints))


def _within_s(joints: Sequence[Config]) -> float:
    return max(stop_within_s(config) for config in joints)


@contextmanager
def control_of(interface: str, channel: str, output: Output, within_s: float = STOP_WITHIN_S) -> Iterator[Control]:
    """Of a bus; `within_s`: how long the program may take to end after `jointctl stop`."""
    places = [(interface, channel)]
    with stop_signals(raising=True) as signals, _locked(places, output, within_s, signals) as control:
        yield control


def _require_no_copy() -> None:
    """`UsageError` while multiprocessing, to start a process, runs the file of a program again: it would move twice."""
    process = sys.modules.get("multiprocessing.process")
    if process is not None and getattr(process.current_process(), "_inheriting", False):
        raise UsageError(
            "a process that multiprocessing starts runs this file again from its first line; it controls no drive",
            'put what moves a joint below `if __name__ == "__main__":`',
        )


@contextmanager
def _locked(
    places: Sequence[tuple[str, str]], output: Output, within_s: float, signals: StopSignals
) -> Iterator[Control]:
    """The locks of all buses: a stop by any of them is one of the whole program.

    A `KeyboardInterrupt` that no one below has put into words leaves with `StopSignals.by_command` as its text.  Before
    the locks are there, a stop may have ended the program by signal, since it did not answer yet.
    """
    _require_no_copy()
    words = "; nothing moved"  # until the program has its locks
    try:
        with ExitStack() as stack:
            locks: list[BusLock] = []

            def take() -> None:
                names = [lock.name for lock in locks]
                new = [place for place in places if lock_name(*place) not in names]
                taken = [stack.enter_context(BusLock(*place, signals.on_stop_command, within_s)) for place in new]
                locks.extend(taken)
                for remark in (remark for lock in taken for remark in lock.remarks):
                    output.warning(remark)
                for lock in taken:
                    lock.deliver()
                if signals.commanded_ns or any(lock.stopped for lock in locks):
                    for lock in locks:
                        lock.settle()
                    signals.on_stop_command()
                    if signals.raising:
                        signals.leave_if_asked()

            take()
            words = ""
            yield Control(signals, tuple(lock.marker_fd for lock in locks if lock.marker_fd is not None), take)
    except KeyboardInterrupt:
        if words and any(stop_is_noted(*place) for place in places):
            signals.commanded_ns = signals.commanded_ns or time.monotonic_ns()
        raise KeyboardInterrupt(f"{signals.by_command}{words}") from None
