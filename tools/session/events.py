"""What happened in a run, in words, found by comparing each log record with the one before.

Drive states, emergency codes, faults, phases and long overruns all show in the records, so the loop need not tell
them. Between two records a state may have come and gone unseen: the events are as fine as the cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, fault_name, in_words
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, Event
from jointctl.tools.session.fault_words import FAULT_TEXTS
from jointctl.tools.session.session_drive import SessionDrive, drive_state_name

OVERRUN_CYCLES = 10  # so many skipped slots in one go are worth a line


def phase_name(phase: int) -> str:
    """`quick stopping` and so on."""
    return in_words(AxisPhase(phase))


def fault_words(code: int) -> str:
    """`position limit` and so on; `fault 99` for a number that this version does not know."""
    return fault_name(code).replace("_", " ").lower()


def _likely_cause(fault: Fault, _drive_error: int) -> str:
    """Without the value that tripped it, which is not in the records."""
    return f"likely cause: {FAULT_TEXTS[fault].cause}" if fault in FAULT_TEXTS else ""


class EventFinder:
    """Feed it the records of a run in order, in pieces of any size.

    `drive` has the words for its states and errors.  `fault_words(fault, drive_error)` says more about a fault than its
    name.
    """

    def __init__(self, drive: SessionDrive, fault_words: Callable[[Fault, int], str] = _likely_cause) -> None:
        self._drive = drive
        self._fault_words = fault_words
        self._last: tuple[int, ...] | None = None

    def take(self, records: Any) -> list[Event]:
        """Events in the new records (array of LogRecord, shape (N,)), in order of time."""
        if not len(records):
            return []
        fields = ("phase", "fault", "drive_state", "status_word", "drive_error")
        columns = np.stack([np.asarray(records[name], np.int64) for name in fields], axis=1)
        changed = np.ones(len(records), bool)
        changed[1:] = np.any(columns[1:] != columns[:-1], axis=1)
        events = []
        for i in np.flatnonzero(changed | (records["skipped"] >= OVERRUN_CYCLES)).tolist():
            now = tuple(columns[i].tolist())
            events += self._compare(int(records["time_ns"][i]), now, int(records["skipped"][i]))
            self._last = now
        return events

    def _compare(self, time_ns: int, now: tuple[int, ...], skipped: int) -> list[Event]:
        phase, fault, drive, word, error = now
        before = self._last if self._last is not None else (-1, 0, -1, 0, 0)
        events = []
        if skipped >= OVERRUN_CYCLES:
            events.append(Event(time_ns, WARNING, "loop", f"held up: {skipped} cycles skipped"))
        state = drive_state_name(self._drive, word, drive)
        state_before = drive_state_name(self._drive, before[3], before[2]) if before[2] >= 0 else ""
        if error != before[4]:
            events.append(self._error_event(time_ns, error))
        if state != state_before:
            bad = drive in (DriveState.FAULT, DriveState.FAULT_BRAKING) or (
                drive != DriveState.UNKNOWN and self._drive.in_fault(word)
            )
            shown = drive != DriveState.UNKNOWN and self._drive.state_text(word) is not None
            word_text = f" (statusword {word:04X}h)" if shown else ""
            events.append(Event(time_ns, WARNING if bad else INFO, "drive", state + word_text))
        if fault != before[1] and fault:
            events.append(Event(time_ns, ERROR, "loop", self._fault_text(fault, error)))
        if phase != before[0]:
            events.append(Event(time_ns, INFO, "loop", phase_name(phase)))
        return events

    def _error_event(self, time_ns: int, error: int) -> Event:
        if not error:
            return Event(time_ns, INFO, "drive", "error code cleared")
        return Event(time_ns, ERROR, "drive", self._drive.error_text(error))

    def _fault_text(self, code: int, drive_error: int) -> str:
        if code not in list(Fault):
            return f"fault {code}"
        words = self._fault_words(Fault(code), drive_error)
        return f"{Fault(code).name} ({code})" + (f": {words}" if words else "")
