"""Records of a run for the scope."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase


def records(count: int, first: int = 0) -> Any:
    found = new(LogRecord, count)
    found.cycle = np.arange(first, first + count)
    found.time_ns = 10**12 + found.cycle * 1_000_000
    found.error_rad = np.sin(found.cycle / 100.0) * 1e-3
    found.phase = AxisPhase.TRACKING
    return found
