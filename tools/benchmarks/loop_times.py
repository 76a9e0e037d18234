"""What a loop of any kind leaves: three durations a cycle, and the quantiles of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LoopTimes:
    """Durations [us], one a cycle, arrays (N,): wake-up after the deadline, SYNC to TPDO, work without waiting."""

    wake_us: np.ndarray
    round_trip_us: np.ndarray
    work_us: np.ndarray

    def quantile(self, name: str, share: float) -> float:
        """Of `wake`, `round_trip` or `work` [us]; nan where nothing was measured."""
        values = getattr(self, f"{name}_us")
        return float(np.quantile(values, share)) if len(values) else float("nan")


NO_VALUES: np.ndarray = np.zeros(0)


def times_from_ns(rows: np.ndarray) -> LoopTimes:
    """From int64[N, 3] of wake-up, wait (not positive: no sample came) and work [ns]."""
    wake, wait, work = (rows[:, column] * 1e-3 for column in range(3))
    return LoopTimes(wake, wait[wait > 0.0], work)
