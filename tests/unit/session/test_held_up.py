"""A pause of the loop just before a fault is told with it, and only then."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault
from jointctl.tools.session.fault_words import FaultText, held_up_text, longest_pause_s

RATE_Hz = 125.0
TEXT = FaultText("it happened", "the cable", "check it")
FAULTY = 180


def run_records(fault: Fault = Fault.STALE_SAMPLE, **at: tuple[int, int]) -> np.recarray[Any, Any]:
    """200 cycles of 8 ms, the fault in the 181st and after; `at`: field = (index, value)."""
    records = new(LogRecord, 200)
    records.time_ns = 10**15 + np.arange(200) * 8_000_000
    records.fault[FAULTY:] = fault
    records.round_trip_ns = 1_200_000
    for field, (index, value) in at.items():
        records[field][index] = value
    return records


def told(fault: Fault, value: float, records: Any) -> bool:
    text = held_up_text(fault, value, TEXT, records, RATE_Hz)
    assert ("held up" in text.happened) == (text != TEXT)
    return text != TEXT


@pytest.mark.parametrize(("skipped", "expected"), [(19, True), (10, True), (9, False)])
def test_a_pause_of_half_the_time_without_samples_is_told(skipped: int, expected: bool) -> None:
    assert told(Fault.STALE_SAMPLE, 20.0, run_records(skipped=(FAULTY, skipped))) is expected


@pytest.mark.parametrize("field", ["round_trip_ns", "wake_late_ns", "work_ns"])
@pytest.mark.parametrize(("pause_ns", "expected"), [(24_100_000, True), (23_900_000, False)])
def test_a_long_cycle_before_a_leap_is_told(field: str, pause_ns: int, expected: bool) -> None:
    assert told(Fault.VELOCITY_LIMIT, 1.9, run_records(Fault.VELOCITY_LIMIT, **{field: (178, pause_ns)})) is expected


def test_at_a_high_rate_three_cycles_are_no_pause() -> None:
    records = run_records(Fault.VELOCITY_LIMIT, skipped=(FAULTY, 4))
    assert held_up_text(Fault.VELOCITY_LIMIT, 1.9, TEXT, records, 1000.0) == TEXT
    records = run_records(Fault.VELOCITY_LIMIT, skipped=(FAULTY, 5))
    assert "for 5 ms" in held_up_text(Fault.VELOCITY_LIMIT, 1.9, TEXT, records, 1000.0).happened


@pytest.mark.parametrize(("index", "expected"), [(117, False), (118, True), (FAULTY, True), (FAULTY + 1, False)])
def test_only_a_pause_just_before_counts(index: int, expected: bool) -> None:
    assert told(Fault.VELOCITY_LIMIT, 1.9, run_records(Fault.VELOCITY_LIMIT, skipped=(index, 40))) is expected


def test_the_text_keeps_the_other_cause_and_what_to_do() -> None:
    text = held_up_text(Fault.STALE_SAMPLE, 20.0, TEXT, run_records(skipped=(FAULTY, 19)), RATE_Hz)
    assert text.happened == "it happened, after the loop had been held up for 152 ms"
    assert text.cause.endswith("if that pause was not the cause, the cable")
    assert text.next_step == "run `jointctl doctor`; check it"


def test_faults_that_no_pause_causes_are_left_alone() -> None:
    assert not told(Fault.POSITION_DISAGREEMENT, 0.1, run_records(Fault.POSITION_DISAGREEMENT, skipped=(FAULTY, 90)))
    assert longest_pause_s(run_records(Fault.NONE, skipped=(FAULTY, 90)), 0.008) == 0.0
