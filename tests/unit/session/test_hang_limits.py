"""A loop that hangs, just within the time that it has and just beyond: for its supervisor and for the line guard."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers.elmo.dialogue import SWITCH_OFF
from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.cycle import WORDS, Word
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.session import elmo_guard, loop_handle
from jointctl.tools.session.elmo_drive import SPARE_S
from jointctl.tools.session.elmo_guard import LATE_S, OBEY_S, GuardOrder, LineGuard
from jointctl.tools.session.loop_handle import OPENING_S, SILENT_S, LoopHandle

NOW_ns = 10_000_000_000_000
MICROSECOND_ns = 1000
GUARD_SILENT_S = SILENT_S + SPARE_S


def ago_ns(seconds: float, past_ns: int) -> int:
    """The time of a last cycle that lies `seconds` and `past_ns` back."""
    return NOW_ns - round(seconds * 1e9) - past_ns


class LivingProcess:
    """A loop process that has not ended."""

    def __init__(self) -> None:
        self.killed = False

    def poll(self) -> None:
        return None

    def kill(self) -> None:
        self.killed = True

    def wait(self, timeout: float) -> int:
        return -9


@pytest.mark.trips("supervisor: the loop process", "(MICROSECOND_ns, True)")
@pytest.mark.stays("supervisor: the loop process", "(0, False)")
@pytest.mark.stays("serial supervisor: the loop process", "(0, False)")
@pytest.mark.parametrize(("cycles", "limit_s"), [(0, OPENING_S), (1, SILENT_S), (100_000, SILENT_S)])
@pytest.mark.parametrize(("past_ns", "hangs"), [(-MICROSECOND_ns, False), (0, False), (MICROSECOND_ns, True)])
def test_the_supervisor_ends_a_loop_that_hangs_and_no_other(
    monkeypatch: pytest.MonkeyPatch, cycles: int, limit_s: float, past_ns: int, hangs: bool
) -> None:
    monkeypatch.setattr(loop_handle, "time", SimpleNamespace(monotonic_ns=lambda: NOW_ns))
    words, process = [0] * WORDS, LivingProcess()
    words[Word.GO], words[Word.HEAD], words[Word.LOOP_NS] = 1, cycles, ago_ns(limit_s, past_ns)
    handle: Any = LoopHandle.__new__(LoopHandle)
    handle.block, handle._process, handle._after_end = SimpleNamespace(words=words), process, "what follows"
    if hangs:
        with pytest.raises(MotionFault, match=f"the loop process did nothing for {limit_s:.1f} s and was ended"):
            handle.running()
    else:
        assert handle.running()
    assert process.killed is hangs


class Guard:
    """A guard of a line that is a pipe; nobody is dead, and the loop has been let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        clock = SimpleNamespace(monotonic_ns=lambda: NOW_ns, monotonic=lambda: NOW_ns * 1e-9)
        monkeypatch.setattr(elmo_guard, "time", clock)
        monkeypatch.setattr(LineGuard, "_end_both", lambda _: setattr(self, "ended_both", True))
        self.ended_both = False
        self.read_fd, write_fd = os.pipe()
        os.set_blocking(self.read_fd, False)
        self.words = [0] * WORDS
        self.words[Word.GO], self.words[Word.LOOP_NS] = 1, NOW_ns
        self.guard: Any = LineGuard.__new__(LineGuard)
        self.guard._words, self.guard._tty = self.words, write_fd
        self.guard._asked_s, self.guard._told_s, self.guard._dead, self.guard._state = None, 0.0, set(), None
        self.guard._order = GuardOrder(
            port="", baud_rate_bitps=115_200, reply_timeout_s=0.1, silent_s=GUARD_SILENT_S, control_fd=-1, block_fd=-1,
            supervisor_pidfd=-1, loop_pidfd=-2, supervisor_pid=0, go_word=Word.GO, stop_word=Word.STOP,
            loop_word=Word.LOOP_NS, ended_word=Word.ENDED, held_up_word=Word.HELD_UP_NS, words=WORDS,
            stop_value=StopRequest.OFF,
        )  # fmt: skip

    def looks(self) -> bytes:
        """One look of the guard; what it has said on the line."""
        assert self.guard._outcome() is None
        try:
            return os.read(self.read_fd, 1000)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        os.close(self.read_fd)
        self.guard._close_tty()


@pytest.fixture
def guard(monkeypatch: pytest.MonkeyPatch) -> Any:
    guard = Guard(monkeypatch)
    yield guard
    guard.close()


@pytest.mark.trips("serial guard: a loop that hangs", "(MICROSECOND_ns, True)")
@pytest.mark.stays("serial guard: a loop that hangs", "(-MICROSECOND_ns, False)")
@pytest.mark.parametrize(("past_ns", "hangs"), [(-MICROSECOND_ns, False), (MICROSECOND_ns, True)])
@pytest.mark.parametrize("over", [None, Word.ENDED, Word.GO])
def test_the_guard_switches_off_behind_a_loop_that_hangs_and_behind_no_other(
    guard: Guard, past_ns: int, hangs: bool, over: Word | None
) -> None:
    guard.words[Word.LOOP_NS] = ago_ns(GUARD_SILENT_S, past_ns)
    if over is Word.ENDED:
        guard.words[over] = 1
    elif over is Word.GO:
        guard.words[over] = 0
    hangs = hangs and over is None
    assert guard.looks() == (SWITCH_OFF if hangs else b"")
    assert guard.words[Word.STOP] == (StopRequest.OFF if hangs else StopRequest.NONE)
    assert (guard.words[Word.HELD_UP_NS] > GUARD_SILENT_S * 1e9) is hangs


@pytest.mark.parametrize(("past_ns", "late"), [(-MICROSECOND_ns, False), (MICROSECOND_ns, True)])
@pytest.mark.parametrize("asked", [True, False])
def test_after_a_stop_was_asked_for_the_guard_waits_less_for_the_loop(
    guard: Guard, past_ns: int, late: bool, asked: bool
) -> None:
    guard.words[Word.LOOP_NS] = ago_ns(LATE_S, past_ns)
    guard.guard._asked_s = NOW_ns * 1e-9 if asked else None
    assert guard.looks() == (SWITCH_OFF if late and asked else b"")


@pytest.mark.trips("serial user: everything", "(OBEY_S + 0.01, True, True)")
@pytest.mark.stays("serial user: everything", "(OBEY_S - 0.01, True, False)")
@pytest.mark.parametrize(("asked_for_s", "told", "ended"), [
    (0.99, False, False), (1.01, True, False), (OBEY_S - 0.01, True, False), (OBEY_S + 0.01, True, True),
])  # fmt: skip
def test_a_run_that_does_not_obey_a_stop_is_ended_by_force_and_not_before(
    guard: Guard, asked_for_s: float, told: bool, ended: bool
) -> None:
    guard.guard._asked_s = NOW_ns * 1e-9 - asked_for_s
    assert guard.looks() == (SWITCH_OFF if told else b"")
    assert guard.ended_both is ended


@pytest.mark.parametrize(("own", "held_up_s", "told"), [
    (Fault.NONE, 0.0, (Fault.NONE, 0.0)), (Fault.NONE, 3.5, (Fault.OVERRUN, 3500.0)),
    (Fault.STALE_SAMPLE, 3.5, (Fault.STALE_SAMPLE, 7.0)),
])  # fmt: skip
def test_a_loop_that_stood_still_and_then_obeyed_the_guard_was_not_stopped_by_its_user(
    own: Fault, held_up_s: float, told: tuple[Fault, float]
) -> None:
    words = [0] * WORDS
    words[Word.STOP], words[Word.HELD_UP_NS] = StopRequest.OFF, round(held_up_s * 1e9)
    handle: Any = LoopHandle.__new__(LoopHandle)
    state = SimpleNamespace(fault=own, fault_value=7.0 if own else 0.0)
    handle.block, handle._period_ns = SimpleNamespace(words=words, state=[state]), 1_000_000
    assert handle.verdict() == told
