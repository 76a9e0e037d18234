"""What the loop reports without ending the run: each once, with its numbers and what to do about it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.firmware_py.records import AxisState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault, Notice
from jointctl.tools.recording.run_log import ERROR, WARNING
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.fault_words import FAULT_TEXTS, NoticeFinder, fault_text
from jointctl.tools.session.run_watch import RunWatch


def state_with(notices: int) -> Any:
    state = new(AxisState)[0]
    state.notices, state.swing.noise_told_Nm, state.law.learning.error_rad = notices, 12.04, 3.21e-5
    return state


@pytest.mark.parametrize(
    ("notice", "words"),
    [
        (Notice.TORQUE_NOISE, ("12.0 Nm", "encoder", "velocity_cutoff_Hz", "observer_radps")),
        (Notice.LEARNING_OFF, ("0.032 mrad", "control.learning.gain", "loop delay", "off")),
    ],
)
def test_each_notice_is_told_once_in_a_run(notice: Notice, words: tuple[str, ...]) -> None:
    finder = NoticeFinder()
    assert finder.take(state_with(0), 5) == []
    (event,) = finder.take(state_with(notice), 7)
    assert (event.time_ns, event.level, event.source) == (7, WARNING, "loop")
    assert all(word in event.text for word in words)
    assert finder.take(state_with(notice), 8) == []
    both = Notice.TORQUE_NOISE | Notice.LEARNING_OFF
    assert len(finder.take(state_with(both), 9)) == 1  # the other one
    assert finder.take(state_with(both), 10) == []


def test_both_at_once_are_two_events() -> None:
    texts = [event.text for event in NoticeFinder().take(state_with(3), 0)]
    assert len(texts) == 2
    assert texts[0].startswith("torque noise")


def test_a_run_tells_them_to_log_display_and_viewers_before_the_fault() -> None:
    """They may explain it."""
    told: list[Any] = []
    noted: list[str] = []
    fault = SimpleNamespace(text="LIMIT_CYCLE", time_ns=1, level=ERROR)
    watch: Any = RunWatch.__new__(RunWatch)

    class Records(list[Any]):
        pass

    records: Any = Records([SimpleNamespace(time_ns=41)])
    block = SimpleNamespace(
        state=[state_with(Notice.LEARNING_OFF)], words=[0] * 64, histograms=None,
        constants=[SimpleNamespace(trajectory=SimpleNamespace(duration_s=1.0))],
    )  # fmt: skip
    watch.loop = SimpleNamespace(block=block, new_records=lambda: records)
    watch.around = SimpleNamespace(recorder=None, signals=StopSignals())
    watch._keep, watch._decimated = lambda _: None, SimpleNamespace(take=lambda new: new)
    watch._orders = SimpleNamespace(keep=lambda _: None)
    watch._notices, watch._events = NoticeFinder(), SimpleNamespace(take=lambda _: [fault])
    watch._tell = lambda event, shown=True: told.append(event)
    watch.config, watch.temperature = SimpleNamespace(is_serial=False), SimpleNamespace(newest_degC=None)
    watch.display = SimpleNamespace(show=lambda _: None, note=noted.append)
    watch.take_records()
    assert [event.text.split()[0] for event in told] == ["iterative", "LIMIT_CYCLE"]
    assert told[0].time_ns == 41
    assert noted == [told[0].text]


def test_the_advice_of_a_limit_cycle_names_delay_gains_learning_and_resolution() -> None:
    text = fault_text(Fault.LIMIT_CYCLE, 13.94, 0)
    assert "13.9 Hz" in text.happened
    for word in ("loop delay", "gains", "learning", "resolution"):
        assert word in FAULT_TEXTS[Fault.LIMIT_CYCLE].advice
