"""The margins of a loop are computed while its drives are off: no one waits for them but the user's yes."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import MarginError, MotionFault
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram
from jointctl.tools.output import Output
from jointctl.tools.session import control
from jointctl.tools.session import plan as run_plan
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import PhaseLines
from jointctl.tools.session.plan import resolve
from jointctl.tools.session.run_watch import Around, BusWatch, RunParts, RunWatch
from tests.configurations import shipped

AT_MOST_s = 30.0


class Loop:
    """One that has had its first cycles, with the drive off."""

    def __init__(self) -> None:
        histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
        histograms[:, 100] = 300
        self.block = SimpleNamespace(histograms=histograms, state=SimpleNamespace(sample_age_cycles=np.zeros(1)))
        self.block.whole = self.block
        self.cycles, self.may_enable = 300, False

    def allow_enable(self) -> None:
        self.may_enable = True


class Slow:
    """In the place of `require_margin`: takes until it is released."""

    def __init__(self) -> None:
        self.released, self.error = threading.Event(), False
        self.begun: list[int] = []  # threads

    def __call__(self, *_: Any, **__: Any) -> Any:
        self.begun.append(threading.get_ident())
        assert self.released.wait(AT_MOST_s)
        if self.error:
            raise MarginError("too little")
        return SimpleNamespace(phase_margin_deg=40.0)


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Slow:
    margins = Slow()
    monkeypatch.setattr(run_plan, "require_margin", margins)
    return margins


def watch_of(tmp_path: Path, loop: Any, said: list[str]) -> RunWatch:
    config = shipped()
    log: Any = SimpleNamespace(path=tmp_path / "log.mcap", write_event=lambda _, __, text: said.append(text))
    signals = StopSignals()
    signals.agreed()
    around, plan = Around(signals, BusWatch(config, None)), resolve(config)
    kept: Any = None
    axis: Any = SimpleNamespace(command_kind=0)
    return RunWatch(plan, axis, RunParts(loop, around, log, kept, PhaseLines(Output(quiet=True)), {}))


def look(watch: RunWatch) -> None:
    """What one look of the supervisor does about the delay."""
    watch.check_delay()
    watch._may_enable()


def test_the_supervisor_does_not_wait_for_the_margins_of_seven_joints(tmp_path: Path, slow: Slow) -> None:
    said: list[str] = []
    loops = [Loop() for _ in range(7)]
    watches = [watch_of(tmp_path, loop, said) for loop in loops]
    for _ in range(3):  # it comes back each time, with its sign of life and with a stop
        for watch in watches:
            look(watch)
    assert all(watch.delay_s is not None for watch in watches)  # so the drives' objects are read in the meantime
    assert not said
    assert not any(loop.may_enable for loop in loops)
    slow.released.set()
    for watch in watches:
        watch._margins.result(AT_MOST_s)
        look(watch)
    assert len(slow.begun) == 7
    assert threading.get_ident() not in slow.begun
    assert [text.partition(", ")[2] for text in said] == ["phase margin 40 deg"] * 7
    assert all(loop.may_enable for loop in loops)


def test_margins_that_are_refused_end_the_run(tmp_path: Path, slow: Slow) -> None:
    """The twin: nothing is enabled."""
    slow.error, said, loop = True, list[str](), Loop()
    watch = watch_of(tmp_path, loop, said)
    look(watch)
    slow.released.set()
    watch._margins.exception(AT_MOST_s)
    with pytest.raises(MarginError, match="too little"):
        look(watch)
    assert not loop.may_enable
    assert not said


@pytest.mark.parametrize(("took_s", "refused"), [(31, True), (29, False)])
def test_a_yes_does_not_outlast_margins_that_take_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: Slow, took_s: int, refused: bool
) -> None:
    """The supervisor went on looking, so it was no standstill: the joint moved as long after the yes as they took."""
    loop, now_ns, late = Loop(), control.now_ns, [0]
    monkeypatch.setattr(control, "now_ns", lambda: now_ns() + late[0])
    watch = watch_of(tmp_path, loop, [])
    look(watch)
    for _ in range(took_s):
        late[0] += 10**9
        watch.around.signals.note_standstill()  # as its thread does once a second
    slow.released.set()
    watch._margins.result(AT_MOST_s)
    with pytest.raises(MotionFault, match="too slow, for 31 s") if refused else nullcontext():
        look(watch)
    assert loop.may_enable is not refused


def test_a_wait_for_a_drive_that_is_silent_is_no_loop_delay_of_its_neighbours(tmp_path: Path, slow: Slow) -> None:
    """The loop waits for it to the end of each slot, and ends the run if it stays away."""
    loop, said = Loop(), list[str]()
    age_cycles = loop.block.state.sample_age_cycles = np.array([0, 3])
    watch = watch_of(tmp_path, loop, said)
    look(watch)
    assert watch.delay_s is None
    age_cycles[:] = 0
    look(watch)
    assert watch.delay_s is not None
    slow.released.set()
