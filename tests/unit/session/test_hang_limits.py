"""A loop that hangs, just within the time that it has and just beyond; for the line guard: test_elmo_guard.py."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.cycle import WORDS, Word
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.session import loop_handle
from jointctl.tools.session.elmo_drive import SPARE_S
from jointctl.tools.session.loop_handle import LOOK_S, OPENING_S, SILENT_S, LoopHandle
from jointctl.tools.session.loop_memory import SharedBlock

NOW_ns = 10_000_000_000_000
MICROSECOND_ns = 1000
SECOND_ns = 1_000_000_000
LOOK_ns = 20_000_000
GUARD_SILENT_S = SILENT_S + SPARE_S


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


class Clock:
    """The only clock that the handle sees."""

    def __init__(self) -> None:
        self.now_ns = NOW_ns

    def monotonic_ns(self) -> int:
        return self.now_ns


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(loop_handle, "time", clock)
    return clock


def handle_after(cycles: int) -> tuple[Any, list[int], LivingProcess]:
    """A handle whose loop has just finished its last one of these cycles; its words and its process."""
    words, process = [0] * WORDS, LivingProcess()
    words[Word.GO], words[Word.HEAD], words[Word.LOOP_NS] = 1, cycles, NOW_ns
    handle: Any = LoopHandle.__new__(LoopHandle)
    handle.block, handle._process, handle._after_end = SimpleNamespace(words=words), process, "what follows"
    return handle, words, process


@pytest.mark.trips("supervisor: the loop process", "(MICROSECOND_ns, True)")
@pytest.mark.stays("supervisor: the loop process", "(0, False)")
@pytest.mark.stays("serial supervisor: the loop process", "(0, False)")
@pytest.mark.parametrize(("cycles", "limit_s"), [(0, OPENING_S), (1, SILENT_S), (100_000, SILENT_S)])
@pytest.mark.parametrize(("past_ns", "hangs"), [(-MICROSECOND_ns, False), (0, False), (MICROSECOND_ns, True)])
def test_the_supervisor_ends_a_loop_that_hangs_and_no_other(
    clock: Clock, cycles: int, limit_s: float, past_ns: int, hangs: bool
) -> None:
    handle, _, process = handle_after(cycles)
    end_ns = NOW_ns + round(limit_s * SECOND_ns)
    while clock.now_ns < end_ns - LOOK_ns:
        clock.now_ns += LOOK_ns
        assert handle.running()
    clock.now_ns = end_ns + past_ns
    if hangs:
        with pytest.raises(MotionFault, match=f"the loop process did nothing for {limit_s:.1f} s and was ended"):
            handle.running()
    else:
        assert handle.running()
    assert process.killed is hangs


def test_a_computer_that_stood_still_is_no_loop_that_hangs(clock: Clock) -> None:
    """Nobody had a processor for 10 s: the loop gets its chance to finish a cycle, and most of its time is left."""
    handle, words, process = handle_after(1)
    clock.now_ns += 10 * SECOND_ns
    assert handle.running()
    words[Word.LOOP_NS] = clock.now_ns
    clock.now_ns += round(SILENT_S * SECOND_ns) + MICROSECOND_ns
    assert handle.running()
    for _ in range(round((SILENT_S - LOOK_S) * SECOND_ns) // LOOK_ns):
        clock.now_ns += LOOK_ns
        assert handle.running()
    clock.now_ns += LOOK_ns
    with pytest.raises(MotionFault, match=r"did nothing for 3\.5 s"):
        handle.running()
    assert process.killed


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


@pytest.mark.parametrize(("look_s", "after_s"), [(0.1, 2.1), (0.6, 2.4), (1.0, 3.0), (1.5, 4.5)])
def test_one_standstill_is_forgiven_and_not_a_slow_supervisor(clock: Clock, look_s: float, after_s: float) -> None:
    handle, _, _ = handle_after(1)
    while clock.now_ns < NOW_ns + round((after_s - look_s) * SECOND_ns) - LOOK_ns:
        clock.now_ns += round(look_s * SECOND_ns)
        assert handle.running()
    clock.now_ns += round(look_s * SECOND_ns)
    with pytest.raises(MotionFault, match=f"did nothing for {after_s:.1f} s"):
        handle.running()


def test_no_joint_of_an_arm_may_enable_before_all_of_them_may() -> None:
    """An early one would count the time that the supervisor takes for the others as one in which not all stand."""
    handle: Any = LoopHandle.__new__(LoopHandle)
    handle.block = SharedBlock.create(2, CanopenPort, axes=3)
    for axis in (2, 0):
        handle.of_axis(axis).allow_enable()
        handle.of_axis(axis).allow_enable()
        assert not handle.block.constants.sequence.may_enable.any()
    handle.of_axis(1).allow_enable()
    assert handle.block.constants.sequence.may_enable.all()
