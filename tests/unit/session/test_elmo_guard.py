"""The guard of a serial line in one process: its own clock, a pseudo-terminal as the line, pipes as the two processes.

The same with real processes, some of them killed or hung: tests/hil/test_line_guard.py.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import signal
import socket
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers.elmo.dialogue import SWITCH_OFF
from jointctl.drivers.errors import BusError, NoDeviceError
from jointctl.firmware_py.cycle import WORDS, Word
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.child_process import say
from jointctl.tools.session import elmo_guard
from jointctl.tools.session.elmo_drive import SPARE_S
from jointctl.tools.session.elmo_guard import (
    ENDED_S,
    LATE_S,
    OBEY_S,
    POLL_S,
    QUICK_POLL_S,
    REACH_S,
    REPEAT_S,
    GuardCall,
    GuardOrder,
    LineGuard,
    guard_address,
    running_supervisor,
)
from jointctl.tools.session.loop_handle import SILENT_S

SECOND_ns = 1_000_000_000
MICROSECOND_ns = 1000
GUARD_SILENT_S = SILENT_S + SPARE_S
SUPERVISOR_PID = 4711


class Guarded:
    """What a guard has around it; all of it but the sockets is simulated.

    Attributes: `now_ns` the clock, `reached` what each try to reach the drive does (a state, or an error; the last one
    for ever), `signals` what the guard sent to whom, `polls_s` how long it meant to wait.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 1000 * SECOND_ns
        block = os.memfd_create("words")
        os.ftruncate(block, 8 * WORDS)
        self.words = memoryview(mmap.mmap(block, 8 * WORDS)).cast("q")
        self.words[Word.LOOP_NS] = self.now_ns
        self._leader, follower = os.openpty()
        tty.setraw(follower)
        os.set_blocking(self._leader, False)
        self._follower = follower
        self.ours, theirs = socket.socketpair()
        self._alive = {"supervisor": os.pipe(), "loop": os.pipe()}
        self.order = GuardOrder(
            port=os.ttyname(follower), baud_rate_bitps=115_200, reply_timeout_s=0.125, silent_s=GUARD_SILENT_S,
            control_fd=theirs.detach(), block_fd=block, supervisor_pidfd=self._alive["supervisor"][0],
            loop_pidfd=self._alive["loop"][0], supervisor_pid=SUPERVISOR_PID, go_word=Word.GO, stop_word=Word.STOP,
            loop_word=Word.LOOP_NS, ended_word=Word.ENDED, held_up_word=Word.HELD_UP_NS, words=WORDS,
            stop_value=StopRequest.OFF,
        )  # fmt: skip
        self.reached: list[str | Exception] = ["off"]
        self.signals: list[tuple[str, int]] = []
        self.polls_s: list[float] = []
        self.slept_s: list[float] = []
        self.opened: list[tuple[str, int]] = []
        self.closed = 0
        self.callers: list[socket.socket] = []
        self._due: list[tuple[int, Callable[[], None]]] = []
        self.guard: Any = None
        clock = SimpleNamespace(
            monotonic=lambda: self.now_ns / 1e9, monotonic_ns=lambda: self.now_ns, sleep=self._sleep
        )
        monkeypatch.setattr(elmo_guard, "time", clock)
        monkeypatch.setattr(elmo_guard, "select", SimpleNamespace(poll=lambda: Poll(self), POLLIN=select.POLLIN))
        monkeypatch.setattr(elmo_guard, "SerialPort", self._open)
        monkeypatch.setattr(elmo_guard, "Dialogue", lambda port, timeout_s: (port, timeout_s))
        monkeypatch.setattr(elmo_guard, "switch_off", self._switch_off)
        monkeypatch.setattr(signal, "pidfd_send_signal", self._signal)

    # --- what the test does ---

    def started(self, **changes: Any) -> LineGuard:
        self.guard = LineGuard(replace(self.order, **changes))
        return self.guard  # type: ignore[no-any-return]

    def run(self, **changes: Any) -> int:
        if self.guard is None:
            self.started(**changes)
        return self.guard.run()  # type: ignore[no-any-return]

    def run_until_off(self, seconds: float) -> int:
        """The supervisor's word that the drive is off comes after that time."""
        self.after(seconds, lambda: self.say({"state": "off"}))
        return self.run()

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        self._due.append((self.now_ns + round(seconds * SECOND_ns), action))  # type: ignore[arg-type]
        self._due.sort(key=lambda entry: entry[0])

    def let_go(self) -> None:
        """The loop runs from now on, and has cycles as long as it lives."""
        self.words[Word.GO] = 1

    def cycles_until(self, seconds: float) -> None:
        for k in range(round(seconds * 10) + 1):
            self.after(k / 10, self.cycle)

    def cycle(self) -> None:
        self.words[Word.LOOP_NS] = self.now_ns

    def dies(self, who: str) -> None:
        os.close(self._alive[who][1])
        self._alive[who] = (self._alive[who][0], -1)

    def say(self, message: object) -> None:
        self.ours.sendall(json.dumps(message).encode() + b"\n")

    def call(self, said: bytes) -> socket.socket:
        """A caller who has said this already when the guard looks."""
        if self.guard is None:
            self.started()
        caller = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        caller.settimeout(1.0)
        caller.connect(guard_address(self.order.port))
        caller.sendall(said)
        self.callers.append(caller)
        return caller

    def told(self) -> bytes:
        """What was said on the line since the last look."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._leader, 1000)
        return b""

    def says(self, text: bytes) -> None:
        """The drive does, on the line."""
        os.write(self._leader, text)

    def unplug(self) -> None:
        os.close(self._follower)
        os.close(self._leader)
        self._leader = self._follower = -1

    def since_s(self) -> float:
        return self.now_ns / 1e9 - 1000.0

    # --- what the guard meets ---

    def wait(self, seconds: float) -> None:
        """The clock goes on, at most to the next thing that is due."""
        until_ns = self.now_ns + round(seconds * SECOND_ns)
        if self._due and self._due[0][0] <= until_ns:
            self.now_ns, action = self._due.pop(0)
            action()
        else:
            self.now_ns = until_ns
        assert self.since_s() < 200.0, "the guard does not end"

    def _sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_ns += round(seconds * SECOND_ns)
        assert self.since_s() < 200.0, "the guard does not end"

    def _open(self, path: str, baud_rate_bitps: int) -> SimpleNamespace:
        self.opened.append((path, baud_rate_bitps))
        return SimpleNamespace(close=lambda: setattr(self, "closed", self.closed + 1))

    def _switch_off(self, port: object, line: tuple[object, float]) -> str:
        assert line == (port, 0.125)
        found = self.reached.pop(0) if len(self.reached) > 1 else self.reached[0]
        if isinstance(found, Exception):
            raise found
        return found

    def _signal(self, pidfd: int, number: int) -> None:
        who = next(name for name, ends in self._alive.items() if ends[0] == pidfd)
        if self._alive[who][1] == -1:
            raise ProcessLookupError
        self.signals.append((who, number))
        if number == signal.SIGKILL:
            self.dies(who)

    def close(self) -> None:
        guard = self.guard
        ends = [
            self.ours,
            *self.callers,
            *([guard._control, guard._server, *guard._callers] if guard is not None else []),
        ]
        for end in ends:
            if end is not None:
                end.close()
        if guard is not None:
            guard._close_tty()
        else:
            os.close(self.order.control_fd)
        for fd in (self._leader, self._follower, self.order.block_fd, *sum(self._alive.values(), ())):
            with contextlib.suppress(OSError):
                os.close(fd)


class Poll:
    """select.poll, which does not wait but lets the clock go on."""

    def __init__(self, world: Guarded) -> None:
        self._world, self._poll = world, select.poll()
        self.register, self.unregister = self._poll.register, self._poll.unregister
        self._at_once = 0

    def poll(self, timeout_ms: float) -> list[tuple[int, int]]:
        self._world.polls_s.append(timeout_ms / 1000)
        ready = self._poll.poll(0)
        self._at_once = self._at_once + 1 if ready else 0
        assert self._at_once < 50, "the guard does not take what has come"
        if not ready:
            self._world.wait(timeout_ms / 1000)
        return ready or self._poll.poll(0)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[Guarded]:
    world = Guarded(monkeypatch)
    yield world
    world.close()


# --- its end ---


def test_it_says_that_it_is_there_and_ends_with_the_supervisors_word(world: Guarded) -> None:
    world.say({"state": "off"})
    assert world.run() == 0
    assert world.ours.recv(10) == b"+"
    assert (world.told(), world.opened, world.signals, world.since_s()) == (b"", [], [], 0.0)
    assert list(world.words)[Word.STOP] == StopRequest.NONE


def test_a_supervisor_that_has_left_already_is_no_reason_to_stay(world: Guarded) -> None:
    world.ours.close()
    world.after(1.0, lambda: (world.dies("supervisor"), world.dies("loop")))
    assert world.run() == 0
    assert world.since_s() == 1.0


@pytest.mark.parametrize("ends", ["by its word", "by its death"])
def test_a_loop_that_was_let_go_is_guarded_until_it_has_ended(world: Guarded, ends: str) -> None:
    world.let_go()
    world.cycles_until(1.5)
    world.after(0.125, lambda: world.say({"state": "off"}))
    world.after(1.5, lambda: world.words.__setitem__(Word.ENDED, 1) if ends == "by its word" else world.dies("loop"))
    assert world.run() == 0
    assert 1.5 <= world.since_s() <= 1.5 + POLL_S
    assert world.opened == []
    assert max(world.polls_s) == POLL_S


@pytest.mark.parametrize("first", ["supervisor", "loop"])
def test_one_of_both_may_die_the_other_is_at_work(world: Guarded, first: str) -> None:
    other = "loop" if first == "supervisor" else "supervisor"
    world.after(0.5, lambda: world.dies(first))
    world.after(2.0, lambda: world.dies(other))
    world.after(1.9, lambda: world.opened and pytest.fail("it reached for the line before both were dead"))
    assert world.run() == 0
    assert world.since_s() == 2.0
    assert world.opened == [(world.order.port, 115_200)]
    assert world.told() == SWITCH_OFF


def test_a_supervisor_whose_process_has_become_another_program_counts_as_dead(world: Guarded) -> None:
    """`os.execv` in a program with a `Joint`: the number of its process lives on, and no one is at work there."""
    world.after(0.5, world.ours.close)
    world.after(1.0, lambda: world.dies("loop"))
    assert world.run() == 0
    assert world.since_s() == 1.0
    assert world.opened == [(world.order.port, 115_200)]


def test_a_drive_that_was_not_reached_is_tried_until_it_is_off(
    world: Guarded, capsys: pytest.CaptureFixture[str]
) -> None:
    world.reached = [BusError("gone"), NoDeviceError("silent"), "off, fault: overcurrent"]
    world.after(0.0, lambda: world.say({"state": "unknown: the line is garbled"}))
    assert world.run() == 0
    assert world.told() == SWITCH_OFF  # at once, on the descriptor that was open
    assert (len(world.opened), world.closed, world.slept_s) == (3, 3, [REPEAT_S, REPEAT_S])
    assert world.guard._tty == -1
    assert capsys.readouterr().err == f"line guard: the drive on {world.order.port} is off, fault: overcurrent\n"


def test_a_drive_that_is_never_reached_is_named_after_a_minute(
    world: Guarded, capsys: pytest.CaptureFixture[str]
) -> None:
    world.reached = [BusError("gone")]
    world.say({"state": "unknown: gone"})
    caller = world.call(b'{"ask": "stop"}\n')
    assert world.run() == 0
    assert world.since_s() == REACH_S + REPEAT_S
    assert capsys.readouterr().err == f"line guard: the drive on {world.order.port} could not be switched off: gone\n"
    assert caller.makefile().read().splitlines() == [
        json.dumps({"supervisor_pid": SUPERVISOR_PID}), json.dumps({"state": "unknown: gone"})
    ]  # fmt: skip


def test_it_reaches_for_the_line_at_once_also_when_it_has_just_told_it(world: Guarded) -> None:
    guard = world.started()
    guard._tell()
    assert world.told() == SWITCH_OFF
    guard._reach()
    assert world.told() == SWITCH_OFF


def test_the_first_command_is_said_on_a_computer_that_was_just_started(world: Guarded) -> None:
    world.now_ns = 0
    world.started()._tell()
    assert world.told() == SWITCH_OFF
    world.now_ns = SECOND_ns // 4
    world.guard._reach()
    assert world.told() == SWITCH_OFF


def test_only_another_adapter_is_left_alone(world: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    for known, found, same in (("A1", "A1", True), ("A1", "B2", False), ("A1", None, True), (None, "B2", True)):
        monkeypatch.setattr(elmo_guard, "usb_serial_number", lambda port, found=found: found)
        guard = LineGuard.__new__(LineGuard)
        guard._order = replace(world.order, usb_serial_number=known)
        with contextlib.nullcontext() if same else pytest.raises(BusError, match=r"B2 instead of A1"):
            guard._require_same_device()


def test_nothing_is_reached_behind_another_adapter(
    world: Guarded, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(elmo_guard, "usb_serial_number", lambda port: "B2")
    world.say({"state": "unknown: gone"})
    assert world.run(usb_serial_number="A1") == 0
    assert world.opened == []
    assert "could not be switched off: another adapter has this name now" in capsys.readouterr().err


def test_a_port_that_was_unplugged_keeps_no_name(world: Guarded) -> None:
    tty = world.started()._tty
    world.after(0.5, world.unplug)
    assert world.run_until_off(1.0) == 0
    assert world.guard._tty == -1
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(tty)
    world.guard._tell()  # nobody is there to hear it, and nothing is raised
    world.guard._close_tty()


def test_what_a_drive_says_is_for_others_to_read(world: Guarded) -> None:
    world.after(0.5, lambda: world.says(b"MO=0;"))
    assert world.run_until_off(1.0) == 0
    assert world.guard._tty >= 0


def test_a_port_that_cannot_be_opened_is_told_by_the_program(
    world: Guarded, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(signal, "pthread_sigmask", lambda how, which: asked.append((how, which)))
    asked: list[Any] = []
    monkeypatch.setattr(sys, "argv", ["", replace(world.order, port="/dev/ttyNONE").argument()])
    assert elmo_guard.main() == BusError("").exit_code
    assert capsys.readouterr().err.startswith("line guard: no such serial port: /dev/ttyNONE")
    assert asked == [(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP})]


def test_the_program_takes_its_order_as_it_was_given(world: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    text = world.order.argument()
    assert GuardOrder(**json.loads(text)) == world.order
    assert json.loads(text) == asdict(world.order)
    monkeypatch.setattr(signal, "pthread_sigmask", lambda how, which: None)
    monkeypatch.setattr(sys, "argv", ["", text])
    monkeypatch.setattr(LineGuard, "run", lambda guard: setattr(world, "guard", guard) or 17)
    assert elmo_guard.main() == 17
    assert world.guard._order == world.order


def test_words_that_nobody_can_read_any_more_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", open(os.devnull, "w"))  # noqa: SIM115
    sys.stderr.close()
    say("nobody")


def test_words_are_out_before_the_process_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    flushed = []
    stream = SimpleNamespace(write=lambda text: None, flush=lambda: flushed.append(True))
    monkeypatch.setattr(sys, "stderr", stream)
    say("now")
    assert flushed == [True]


# --- a loop that hangs ---


@pytest.mark.trips("serial guard: a loop that hangs", "(MICROSECOND_ns, True)")
@pytest.mark.stays("serial guard: a loop that hangs", "(-MICROSECOND_ns, False)")
@pytest.mark.parametrize(("past_ns", "hangs"), [(-MICROSECOND_ns, False), (0, False), (MICROSECOND_ns, True)])
@pytest.mark.parametrize("over", [None, Word.ENDED, Word.GO])
def test_it_switches_off_behind_a_loop_that_hangs_and_behind_no_other(
    world: Guarded, past_ns: int, hangs: bool, over: Word | None
) -> None:
    silent_ns = round(GUARD_SILENT_S * SECOND_ns) + past_ns
    world.words[Word.GO], world.words[Word.LOOP_NS] = 1, world.now_ns - silent_ns
    if over is not None:
        world.words[over] = int(over is Word.ENDED)
    hangs = hangs and over is None
    assert world.started()._outcome() is None
    assert world.told() == (SWITCH_OFF if hangs else b"")
    assert world.words[Word.STOP] == (StopRequest.OFF if hangs else StopRequest.NONE)
    assert world.words[Word.HELD_UP_NS] == (silent_ns if hangs else 0)


def test_a_line_is_told_again_every_half_second(world: Guarded) -> None:
    guard = world.started()
    for past_ns, told in ((0, True), (1, False), (SECOND_ns // 2 - 1000, False), (SECOND_ns // 2, True)):
        world.now_ns = 1000 * SECOND_ns + past_ns
        guard._tell()
        assert (world.told() == SWITCH_OFF) is told, past_ns
    assert REPEAT_S == 0.5


# --- callers ---


@pytest.mark.parametrize(("past_ns", "late"), [(-MICROSECOND_ns, False), (0, False), (MICROSECOND_ns, True)])
@pytest.mark.parametrize("asked", [True, False])
def test_after_a_stop_was_asked_for_it_waits_less_for_the_loop(
    world: Guarded, past_ns: int, late: bool, asked: bool
) -> None:
    world.words[Word.GO], world.words[Word.LOOP_NS] = 1, world.now_ns - round(LATE_S * SECOND_ns) - past_ns
    guard = world.started()
    guard._asked_s = world.now_ns / 1e9 if asked else None
    assert guard._outcome() is None
    assert world.told() == (SWITCH_OFF if late and asked else b"")


def test_a_loop_that_has_ended_is_not_late(world: Guarded) -> None:
    """The line is the supervisor's, who switches off."""
    world.words[Word.GO], world.words[Word.LOOP_NS], world.words[Word.ENDED] = 1, world.now_ns - SECOND_ns, 1
    guard = world.started()
    guard._asked_s = world.now_ns / 1e9
    assert guard._outcome() is None
    assert world.told() == b""


@pytest.mark.trips("serial user: everything", "(OBEY_S + 0.01, True, True)")
@pytest.mark.stays("serial user: everything", "(OBEY_S - 0.01, True, False)")
@pytest.mark.parametrize(("asked_for_s", "told", "ended"), [
    (0.99, False, False), (1.0, False, False), (1.01, True, False), (OBEY_S - 0.01, True, False),
    (OBEY_S, True, False), (OBEY_S + 0.01, True, True),
])  # fmt: skip
def test_a_run_that_does_not_obey_a_stop_is_ended_by_force_and_not_before(
    world: Guarded, asked_for_s: float, told: bool, ended: bool
) -> None:
    world.let_go()
    guard = world.started()
    guard._asked_s = world.now_ns / 1e9 - asked_for_s
    assert guard._outcome() is None
    assert world.told() == (SWITCH_OFF if told else b"")
    assert world.signals == ([("loop", signal.SIGKILL), ("supervisor", signal.SIGKILL)] if ended else [])


def test_a_process_that_has_gone_cannot_be_ended_and_the_other_is(world: Guarded) -> None:
    world.dies("loop")
    world.started()._end_both()
    assert world.signals == [("supervisor", signal.SIGKILL)]


def test_a_stop_of_a_run_that_obeys(world: Guarded) -> None:
    world.let_go()
    world.cycles_until(0.8)
    caller = world.call(b'{"ask": "stop"}\n')
    second = []
    world.after(0.4, lambda: second.append(world.call(b'{"ask": "stop"}\n')))
    world.after(0.8, lambda: (world.words.__setitem__(Word.ENDED, 1), world.say({"state": "off, fault: x"})))
    assert world.run() == 0
    assert world.words[Word.STOP] == StopRequest.OFF
    assert (world.told(), world.signals, world.opened) == (b"", [], [])
    for peer in (caller, second[0]):
        assert peer.makefile().read().splitlines() == [
            json.dumps({"supervisor_pid": SUPERVISOR_PID}), json.dumps({"state": "off, fault: x"})
        ]  # fmt: skip
    assert set(world.polls_s) == {POLL_S, QUICK_POLL_S}


def test_a_stop_before_the_loop_runs_ends_the_supervisors_question(world: Guarded) -> None:
    world.after(0.5, lambda: world.call(b'{"ask": "stop"}\n'))
    world.after(0.7, lambda: world.call(b'{"ask": "stop"}\n'))
    assert world.run_until_off(0.9) == 0
    assert world.signals == [("supervisor", signal.SIGTERM)]  # once
    assert world.told() == SWITCH_OFF
    assert world.words[Word.STOP] == StopRequest.OFF


def test_a_supervisor_that_died_before_the_stop_cannot_be_asked(world: Guarded) -> None:
    world.dies("supervisor")
    world.after(0.5, lambda: world.call(b'{"ask": "stop"}\n'))
    world.after(1.0, lambda: world.dies("loop"))
    assert world.run() == 0
    assert (world.signals, len(world.opened)) == ([], 1)


def test_a_run_that_hangs_altogether_is_ended_and_its_drive_reached(world: Guarded) -> None:
    world.let_go()
    caller = world.call(b'{"ask": "stop"}\n')
    world.after(3.0, lambda: world.call(b'{"ask": "stop"}\n'))  # asking again does not prolong it
    assert world.run() == 0
    assert world.signals == [("loop", signal.SIGKILL), ("supervisor", signal.SIGKILL)]
    assert OBEY_S < world.since_s() <= OBEY_S + 2 * QUICK_POLL_S
    assert world.told().startswith(SWITCH_OFF)
    assert world.opened == [(world.order.port, 115_200)]
    assert caller.makefile().read().splitlines()[-1] == json.dumps({"state": "off"})


@pytest.mark.parametrize(
    ("said", "may_ask"),
    [(b"nonsense\n", True), (b"[1]\n", True), (b'"stop"\n', True), (b"", True), (b'{"ask": "stop"' + 5000 * b" ", True),
     (b'{"ask": "stop"}\n', False)],
)  # fmt: skip
def test_nonsense_and_another_user_are_not_answered_and_stop_nothing(
    world: Guarded, monkeypatch: pytest.MonkeyPatch, said: bytes, may_ask: bool
) -> None:
    monkeypatch.setattr(elmo_guard, "HEARD_S", 0.02)
    if not may_ask:
        monkeypatch.setattr(elmo_guard, "may_ask", lambda peer: False)
    caller = world.call(said)
    assert world.run_until_off(1.0) == 0
    assert world.words[Word.STOP] == StopRequest.NONE
    with contextlib.suppress(ConnectionResetError):
        assert caller.recv(100) == b""


@pytest.mark.parametrize("ask", ["who", "dance"])
def test_who_asks_anything_else_is_told_whose_the_line_is(world: Guarded, ask: str) -> None:
    caller = world.call(json.dumps({"ask": ask}).encode() + b"\n")
    answered = []
    world.after(0.5, lambda: answered.append(caller.makefile().read()))  # the connection is closed: read to its end
    assert world.run_until_off(1.0) == 0
    assert answered == [json.dumps({"supervisor_pid": SUPERVISOR_PID}) + "\n"]
    assert (world.words[Word.STOP], world.signals) == (StopRequest.NONE, [])
    assert world.guard._callers == []


def test_a_caller_who_has_gone_holds_nobody_up(world: Guarded) -> None:
    world.call(b'{"ask": "stop"}\n').close()
    assert world.run_until_off(1.0) == 0
    assert world.words[Word.STOP] == StopRequest.OFF


def test_four_callers_wait_for_their_turn(world: Guarded) -> None:
    world.started()
    callers = [world.call(b'{"ask": "who"}\n') for _ in range(4)]
    assert world.run_until_off(1.0) == 0
    assert [caller.recv(100) for caller in callers] == 4 * [b'{"supervisor_pid": 4711}\n']


def test_a_second_guard_on_the_same_line_does_without_a_name(world: Guarded) -> None:
    with LineGuard._bound(guard_address(world.order.port)) or pytest.fail("the name was not free"):
        world.say({"state": "off"})
        assert world.run() == 0
        assert world.guard._server is None


@pytest.mark.parametrize(("said", "state"), [({}, "unknown: no word"), ({"state": None}, "None"), ([], None)])
def test_a_word_of_the_supervisor_that_says_nothing(world: Guarded, said: object, state: str | None) -> None:
    guard = world.started()
    world.say(said)
    guard._take_word()
    assert guard._state == state


# --- the side of the caller ---


@contextlib.contextmanager
def answering(port: str, *answers: bytes) -> Iterator[list[bytes]]:
    """Somebody who has the guard's name of a port, and says this to the one who calls."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    server.bind(guard_address(port))
    server.listen(1)
    heard: list[bytes] = []

    def serve() -> None:
        with server, contextlib.suppress(OSError):
            peer, _ = server.accept()
            with peer:
                heard.append(peer.recv(100))
                peer.sendall(b"".join(answers))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield heard
    finally:
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_RDWR)
        thread.join()


def test_a_call_learns_whose_the_line_is_and_what_became_of_it(world: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[float] = []
    plain = elmo_guard.received_line
    monkeypatch.setattr(
        elmo_guard, "received_line", lambda peer, timeout_s=1.0: (waited.append(timeout_s), plain(peer, timeout_s))[1]
    )
    with answering(world.order.port, b'{"supervisor_pid": 12}\n', b'{"state": "off"}\n') as heard:
        with GuardCall(world.order.port, "stop") as call:
            assert call.supervisor_pid == 12
            assert call.outcome() == "off"
            assert call.outcome() is None  # nothing more comes
            open_socket = call._socket
        assert open_socket.fileno() == -1
    assert heard == [b'{"ask": "stop"}\n']
    assert waited == [1.0, ENDED_S, ENDED_S]


@pytest.mark.parametrize("answer", [b"", b"nonsense\n", b'{"supervisor_pid": "12"}\n', b"{}\n", b"[12]\n"])
def test_a_guard_that_answers_nonsense_has_no_supervisor(world: Guarded, answer: bytes) -> None:
    with answering(world.order.port, answer):
        assert running_supervisor(world.order.port) is None


def test_who_has_the_line(world: Guarded) -> None:
    assert running_supervisor(world.order.port) is None
    assert running_supervisor("/dev/ttyNONE") is None
    with answering(world.order.port, b'{"supervisor_pid": 13}\n') as heard:
        assert running_supervisor(world.order.port) == 13
    assert heard == [b'{"ask": "who"}\n']


def test_nothing_is_asked_of_another_users_guard(world: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elmo_guard, "may_ask", lambda peer: False)
    with answering(world.order.port, b'{"supervisor_pid": 13}\n') as heard:
        assert running_supervisor(world.order.port) is None
    assert heard == [b""]


def test_a_call_does_not_wait_for_a_guard_that_is_mute(world: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    class Socket(socket.socket):
        def settimeout(self, value: float | None) -> None:
            asked.append(value or 0.0)
            super().settimeout(0.02)

    monkeypatch.setattr(elmo_guard, "socket", SimpleNamespace(
        socket=Socket, AF_UNIX=socket.AF_UNIX, SOCK_STREAM=socket.SOCK_STREAM
    ))  # fmt: skip
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as mute:
        mute.bind(guard_address(world.order.port))
        mute.listen(1)
        assert running_supervisor(world.order.port) is None
    assert asked == [1.0, 1.0]


def test_a_message_ends_at_its_line_and_is_no_longer_than_a_line_may_be() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.sendall(b'{"a": 1}\n{"b": 2}\n' + 5000 * b"x")
        assert elmo_guard.received_line(theirs) == {"a": 1}
        assert elmo_guard.received_line(theirs) == {"b": 2}
        assert elmo_guard.received_line(theirs) is None
        assert len(theirs.recv(5000)) == 5000 - 4096
        assert elmo_guard.received_line(theirs, 0.01) is None
        ours.sendall(b'{"c": 3}')
        ours.shutdown(socket.SHUT_WR)
        assert elmo_guard.received_line(theirs) == {"c": 3}  # the end of the connection ends a line


def test_the_name_of_a_line_is_that_of_its_device_whatever_leads_to_it(world: Guarded, tmp_path: Any) -> None:
    (tmp_path / "arm").symlink_to(world.order.port)
    address = guard_address(str(tmp_path / "arm"))
    found = os.stat(world.order.port)
    assert address == guard_address(world.order.port)
    assert address == b"\0jointctl-line-%x-%x" % (found.st_dev, found.st_rdev)


def test_a_caller_that_drips_holds_the_guard_up_no_longer_than_one_that_says_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The guard sees no death in the meantime."""
    clock = SimpleNamespace(s=0.0)
    monkeypatch.setattr(elmo_guard, "time", SimpleNamespace(monotonic=lambda: clock.s))

    class Dripping:
        def settimeout(self, seconds: float) -> None:
            self.seconds = seconds

        def recv(self, _: int) -> bytes:
            if self.seconds < 0.1:
                raise TimeoutError
            clock.s += 0.1
            return b"x"

    dripping: Any = Dripping()
    assert elmo_guard.received_line(dripping, 0.5) is None
    assert clock.s <= 0.6
