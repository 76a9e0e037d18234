"""Records of a long run for its log: every n-th one, and the last seconds, where a fault shows its cause, whole."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of


class ThinnedRecords:
    """Holds the last `whole` records back; of what is older it gives every `every`-th one."""

    def __init__(self, every: int, whole: int) -> None:
        self._every, self._whole = every, whole
        self._held: Any = np.zeros(0, dtype_of(LogRecord)).view(np.recarray)
        self._seen = 0  # records that are no longer held

    def take(self, records: Any) -> Any:
        """New `records` (array of LogRecord, shape (N,)) in order of time; returns those to be written now."""
        held = np.concatenate((self._held, records)).view(np.recarray)
        old = held[: max(0, len(held) - self._whole)]
        self._held = held[len(old) :]
        chosen = old[-self._seen % self._every :: self._every]
        self._seen += len(old)
        return chosen

    def last(self) -> Any:
        """Those held back, all of them; nothing is held afterwards."""
        held, self._held = self._held, self._held[:0]
        self._seen += len(held)
        return held
