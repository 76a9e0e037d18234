"""The memory that the supervisor and the loop process share: one anonymous file, passed on as a file descriptor.

It has no name, so that nothing is left behind whatever dies; it lives as long as either process has it.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Any

import numpy as np

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.elmo.cyclic import ElmoPort
from jointctl.drivers.elmo.settings import SERIAL
from jointctl.firmware_py.realtime import HISTOGRAM_BINS, WORDS, Histogram, Word
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of

RING_RECORDS = 1 << 14  # 16 s at 1 kHz
_LINE = 64  # bytes; nothing of one array shares a cache line with another


class SharedBlock:
    """Arrays over the shared memory; `words`, `histograms`, `table` plain, the others record arrays."""

    def __init__(self, fd: int, table_rows: int, interface: str = "") -> None:
        """Map an existing block; every process gives the same `table_rows` and `interface`, which decides the port."""
        self.fd = fd
        self.table_rows = table_rows
        self._offset = 0
        os.ftruncate(fd, max(os.fstat(fd).st_size, self._size(table_rows)))
        self._memory = mmap.mmap(fd, self._size(table_rows))
        self.words = self._take(np.dtype(np.int64), WORDS)
        self.histograms = self._take(np.dtype(np.int64), len(Histogram) * HISTOGRAM_BINS).reshape(len(Histogram), -1)
        self.table = self._take(np.dtype(np.float64), table_rows * 5).reshape(table_rows, 5)
        self.constants = self._records(AxisConstants, 1)
        self.state = self._records(AxisState, 1)
        self.sample = self._records(Sample, 1)
        self.command = self._records(Command, 1)
        self.port = self._records(ElmoPort if interface == SERIAL else CanopenPort, 1)
        self.ring = self._records(LogRecord, RING_RECORDS)

    @classmethod
    def create(cls, table_rows: int, interface: str = "") -> SharedBlock:
        """A new zeroed block."""
        if hasattr(os, "memfd_create"):
            fd = os.memfd_create("jointctl-loop")
        else:
            with tempfile.TemporaryFile() as file:
                fd = os.dup(file.fileno())
        return cls(fd, table_rows, interface)

    @staticmethod
    def _size(table_rows: int) -> int:
        records = (AxisConstants, AxisState, Sample, Command, CanopenPort, ElmoPort)
        words = WORDS + len(Histogram) * HISTOGRAM_BINS + table_rows * 5
        ring = RING_RECORDS * dtype_of(LogRecord).itemsize
        return 8 * words + sum(dtype_of(r).itemsize for r in records) + ring + 16 * _LINE

    def _take(self, dtype: np.dtype[Any], count: int) -> Any:
        array = np.frombuffer(self._memory, dtype, count, self._offset)
        self._offset += -(-array.nbytes // _LINE) * _LINE
        return array

    def _records(self, cls: type, count: int) -> Any:
        return self._take(dtype_of(cls), count).view(np.recarray)

    def new_records(self, tail: int, head: int) -> tuple[Any, int]:
        """(copy of the log records from `tail` to `head`, how many of them had been overwritten before).

        The loop goes on meanwhile: what it has written over while this was copying, and may be writing over now, counts
        as lost too.
        """
        lost = max(0, head - RING_RECORDS - tail)
        records = self.ring[np.arange(tail + lost, head) % RING_RECORDS]
        now = int(self.words[Word.HEAD])
        late = min(len(records), max(0, now + 1 - RING_RECORDS - tail - lost)) if now > head else 0
        return records[late:], lost + late
