"""A fault that follows a pause of the loop: the text says so, or its reader looks for a fault of cable or drive."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.states import Fault
from jointctl.tools.running.events.fault_text import FaultText

BEFORE_s = 0.5  # a pause longer ago has shown what it could do
LEAST_s = 0.005
LEAST_CYCLES = 3
SHARE_OF_AGE = 0.5  # of the time without a sample that a pause must have taken to be its cause
# a loop that stands still commands its last torque, and hears nothing meanwhile
FAULTS = frozenset({
    Fault.STALE_SAMPLE, Fault.VELOCITY_LIMIT, Fault.POSITION_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_JUMP,
    Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.SAMPLES_MISSING,
})  # fmt: skip


def longest_pause_s(records: Any, period_s: float) -> float:
    """Longest pause of the loop up to the first record with a fault [s]: slots left out, or a cycle that took longer.

    `records`: array of LogRecord, shape (N,), the cycles before the fault among them.
    """
    faults = np.flatnonzero(records["fault"])
    if not len(faults):
        return 0.0
    until_ns = int(records["time_ns"][faults[0]])
    near = records[: faults[0] + 1]
    near = near[near["time_ns"] >= until_ns - BEFORE_s * 1e9]
    taken_ns = np.maximum.reduce([near["wake_late_ns"], near["work_ns"], near["round_trip_ns"]])
    return float(max(1e-9 * taken_ns.max(), period_s * near["skipped"].max()))


def held_up_text(fault: Fault, value: float, text: FaultText, records: Any, rate_Hz: float) -> FaultText:
    """`text`, with the pause that came before the fault, if there was one that can have caused it."""
    if fault not in FAULTS:
        return text
    pause_s = longest_pause_s(records, 1.0 / rate_Hz)
    age_s = value / rate_Hz if fault is Fault.STALE_SAMPLE else 0.0
    if pause_s < max(LEAST_s, LEAST_CYCLES / rate_Hz, SHARE_OF_AGE * age_s):
        return text
    return FaultText(
        f"{text.happened}, after the loop had been held up for {1e3 * pause_s:.0f} ms",
        f"the computer was busy: no real-time priority, power saving, a debugger; if that pause was not the cause, "
        f"{text.cause}",
        f"run `jointctl doctor`; {text.next_step}",
    )
