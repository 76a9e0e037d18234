"""A loop that hangs, just within the time that it has and just beyond; for the line guard: test_elmo_guard.py."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.cycle import WORDS, Word
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.session import loop_handle
from jointctl.tools.session.elmo_drive import SPARE_S
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
