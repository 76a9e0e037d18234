"""Records of a run whose summary, or whose events, are known in advance, and records whose every value differs."""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveState

START_NS = 5_000_000_000  # of `eventful_records`
WORDS = {DriveState.OFF: 0x0250, DriveState.STARTING: 0x0233, DriveState.ENABLED: 0x1237, DriveState.FAULT: 0x0218}


def run_records(tracking: int = 1000) -> np.recarray:
    """100 cycles of approach with a great error, then tracking: e = 2 mrad in the first tenth, then +-0.5 mrad."""
    records = new(LogRecord, 100 + tracking)
    records.time_ns = 10**15 + np.arange(len(records)) * 1_000_000
    records.phase = AxisPhase.TRACKING
    records.phase[:100] = AxisPhase.APPROACH
    records.trajectory_s = (np.arange(len(records)) - 100) * 1e-3
    records.error_rad[:100] = 0.1
    records.error_rad[100:] = 0.5e-3 * (-1.0) ** np.arange(tracking)
    records.error_rad[100 : 100 + tracking // 10] = 2e-3
    records.command_torque_Nm[100:] = np.linspace(-10.0, 20.0, tracking)
    records.command_torque_Nm[50] = 55.0
    records.network_torque_Nm[100:] = 1.5
    records.wake_late_ns = np.arange(len(records)) * 1000
    records.round_trip_ns[::2] = 300_000
    return records


def eventful_records(count: int = 400, first: int = 0) -> np.recarray:
    """A run of 1 kHz that waits, enables, tracks, and is switched off in its last 50 cycles.

    With another `first`, a part of its motion.
    """
    records = new(LogRecord, count)
    index = np.arange(first, first + count)
    records.cycle = index + 1
    records.time_ns = START_NS + index * 1_000_000
    records.phase = AxisPhase.TRACKING
    records.drive_state = DriveState.ENABLED
    records.trajectory_s = index * 1e-3
    records.position_rad = np.sin(index / 50.0)
    records.error_rad = 1e-3 / (1 + index)
    records.weights = np.arange(15) + index[:, None] / 7.0
    if first == 0:
        records.phase[:20], records.drive_state[:20] = AxisPhase.WAITING, DriveState.OFF
        records.phase[20:30], records.drive_state[20:30] = AxisPhase.ENABLING, DriveState.STARTING
        records.phase[-50:], records.drive_state[-50:] = AxisPhase.FINISHED, DriveState.OFF
    records.status_word = [WORDS[DriveState(state)] for state in records.drive_state]
    return records


def sample_records(count: int, first: int = 0) -> np.recarray:
    """Records whose every field and array element differs."""
    records = new(LogRecord, count)
    for i, name in enumerate(records.dtype.names):
        base = 1000 * (i + 1) + np.arange(first, first + count)
        if name == "weights":
            records[name] = base[:, None] + np.arange(15) / 16.0
        elif records.dtype[name].kind == "f":
            records[name] = -base / 8.0
        else:
            records[name] = base
    return records
