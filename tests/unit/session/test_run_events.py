"""Events: what happened in a run, found in its records; error codes in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault
from jointctl.tools.session.events import OVERRUN_CYCLES, EventFinder
from jointctl.tools.session.fault_words import emergency_text

START_NS = 5_000_000_000
WORDS = {DriveState.OFF: 0x0250, DriveState.STARTING: 0x0233, DriveState.ENABLED: 0x1237, DriveState.FAULT: 0x0218}


def run_records() -> Any:
    """A run of 1 kHz that waits, enables, tracks, and is switched off in its last 50 cycles."""
    records = new(LogRecord, 400)
    index = np.arange(400)
    records.cycle = index + 1
    records.time_ns = START_NS + index * 1_000_000
    records.phase = AxisPhase.TRACKING
    records.drive_state = DriveState.ENABLED
    records.phase[:20], records.drive_state[:20] = AxisPhase.WAITING, DriveState.OFF
    records.phase[20:30], records.drive_state[20:30] = AxisPhase.ENABLING, DriveState.STARTING
    records.phase[-50:], records.drive_state[-50:] = AxisPhase.FINISHED, DriveState.OFF
    records.status_word = [WORDS[DriveState(state)] for state in records.drive_state]
    return records


@pytest.mark.parametrize("size", [1, 7, 20, 400])
def test_events_are_the_same_whatever_the_pieces(size: int) -> None:
    finder, records = EventFinder(), run_records()
    found = [event for at in range(0, 400, size) for event in finder.take(records[at : at + size])]
    assert [(event.time_ns - START_NS, event.source, event.text) for event in found] == [
        (0, "drive", "switch on disabled (statusword 0250h)"),
        (0, "loop", "waiting"),
        (20_000_000, "drive", "switched on (statusword 0233h)"),
        (20_000_000, "loop", "enabling"),
        (30_000_000, "drive", "operation enabled (statusword 1237h)"),
        (30_000_000, "loop", "tracking"),
        (350_000_000, "drive", "switch on disabled (statusword 0250h)"),
        (350_000_000, "loop", "finished"),
    ]


def test_a_bit_that_changes_no_state_is_no_event() -> None:
    records = run_records()
    records.status_word[100:200] ^= 0x0400  # target reached
    assert len(EventFinder().take(records)) == 8


def test_a_fault_is_told_with_code_cause_and_state() -> None:
    records = run_records()
    records.fault[200:] = Fault.DRIVE_FAULT
    records.drive_error[200:] = 0x8130
    records.drive_state[200:] = DriveState.FAULT
    records.status_word[200:] = WORDS[DriveState.FAULT]
    finder = EventFinder(fault_words=lambda fault, error: f"{fault.name} and {error:x}")
    texts = [(event.level, event.text) for event in finder.take(records) if event.time_ns == START_NS + 200_000_000]
    assert texts == [
        (40, "EMCY 8130h, heartbeat lost"),
        (30, "fault (statusword 0218h)"),
        (40, "DRIVE_FAULT (8): DRIVE_FAULT and 8130"),
    ]


@pytest.mark.parametrize(("skipped", "told"), [(0, 0), (OVERRUN_CYCLES - 1, 0), (OVERRUN_CYCLES, 1), (500, 1)])
def test_a_long_overrun_is_an_event(skipped: int, told: int) -> None:
    records = run_records()
    records.skipped[100] = skipped
    assert sum("skipped" in event.text for event in EventFinder().take(records)) == told


@pytest.mark.parametrize(
    ("code", "name"),
    [(0x8130, "heartbeat lost"), (0x8199, "communication"), (0x2FFF, "current"), (0xFF77, "maker"), (0x00FF, "not in")],
)
def test_an_unknown_emergency_code_is_told_by_its_class(code: int, name: str) -> None:
    assert name in emergency_text(code)
    assert f"{code:04X}h" in emergency_text(code)
