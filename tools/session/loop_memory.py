"""What supervisor and loop process share: the order by which the loop is started, and memory without a name.

The memory is one anonymous file, passed on as a file descriptor: nothing is left behind whatever dies, and it lives as
long as either process has it.  The loop process loads nothing else of this package but its loop.
"""

from __future__ import annotations

import copy
import json
import math
import mmap
import os
import select
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.firmware_py.arm_model import Arm, ArmConstants, ArmLink, ArmMotion
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Histogram, Near, Word
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmModel

FOREVER = 1 << 62  # cycles
RING_RECORDS = 1 << 14  # 16 s at 1 kHz
_LINE = 64  # bytes; nothing of one array shares a cache line with another
_LONG = 2048  # bytes of an array of which a cycle reads little


class SharedBlock:
    """Arrays over the shared memory; `words`, `histograms`, `tables` plain, the others record arrays.

    Of an arm they have one element a joint, and its model is there too (`links`); `table` is that of the first joint.
    """

    def __init__(self, fd: int, table_rows: int, port: type, axes: int = 1, links: int = 0) -> None:
        """Map an existing block; every process gives the same numbers and record of the drive's exchange."""
        self.fd = fd
        self.axes, self.axis = axes, 0
        self.whole = self  # also seen from one axis
        self.allowed = set[int]()  # axes that may enable, so says their supervisor, who alone knows it
        self._offset = 0
        size = self._size(table_rows, port, axes)
        os.ftruncate(fd, max(os.fstat(fd).st_size, size))
        self._memory = mmap.mmap(fd, size)
        self.words = self._take(np.dtype(np.int64), WORDS)
        self.histograms = self._take(np.dtype(np.int64), len(Histogram) * HISTOGRAM_BINS).reshape(len(Histogram), -1)
        self.tables = self._take(np.dtype(np.float64), axes * table_rows * 5).reshape(axes, table_rows, 5)
        self.table = self.tables[0]
        self.constants = self._records(AxisConstants, axes)
        self.state = self._records(AxisState, axes)
        self.sample = self._records(Sample, axes)
        self.command = self._records(Command, axes)
        self.port = self._records(port, axes)
        self.arm_constants, self.links = self._records(ArmConstants, 1), self._records(ArmLink, axes)[:links]
        self.motion = self._records(ArmMotion, axes + 1)[: links + 1]
        self.ring = self._records(LogRecord, RING_RECORDS)

    @classmethod
    def create(cls, table_rows: int, port: type, axes: int = 1, links: int = 0) -> SharedBlock:
        """A new zeroed block."""
        if hasattr(os, "memfd_create"):
            fd = os.memfd_create("jointctl-loop")
        else:
            with tempfile.TemporaryFile() as file:
                fd = os.dup(file.fileno())
        return cls(fd, table_rows, port, axes, links)

    @staticmethod
    def _size(table_rows: int, port: type, axes: int) -> int:
        records = (AxisConstants, AxisState, Sample, Command, port, ArmLink, ArmMotion)
        words = WORDS + len(Histogram) * HISTOGRAM_BINS + axes * table_rows * 5
        rest = (
            sum(dtype_of(r).itemsize for r in (ArmConstants, ArmMotion)) + RING_RECORDS * dtype_of(LogRecord).itemsize
        )
        return 8 * words + axes * sum(dtype_of(r).itemsize for r in records) + rest + 20 * _LINE

    def of_axis(self, axis: int) -> SharedBlock:
        """The same memory as that of a single joint sees it."""
        part = copy.copy(self)
        part.axis, part.table = axis, self.tables[axis]
        for name in ("constants", "state", "sample", "command", "port"):
            setattr(part, name, getattr(self, name)[axis : axis + 1])
        return part

    def _take(self, dtype: np.dtype[Any], count: int) -> Any:
        array = np.frombuffer(self._memory, dtype, count, self._offset)
        self._offset += -(-array.nbytes // _LINE) * _LINE
        return array

    def _records(self, cls: type, count: int) -> Any:
        return self._take(dtype_of(cls), count).view(np.recarray)

    def memory(self) -> CycleMemory:
        return CycleMemory(
            self.constants, self.state, self.tables, self.sample, self.command, self.words, self.ring,
            self.histograms, np.zeros(2, np.int64),
            Arm(self.arm_constants, self.links, self.motion) if len(self.links) else None,
        )  # fmt: skip

    def near(self) -> Near:
        """What each cycle reads of every axis."""
        words = np.frombuffer(self._memory, np.int64, len(self._memory) // 8)
        parts = []
        for array in (self.constants, self.state, self.sample, self.command, self.port, self.links, self.motion):
            first = array.ctypes.data - words.ctypes.data
            for at in range(first, first + array.nbytes, array.itemsize):
                parts += [((at + begin) // 8, (at + end) // 8) for begin, end in _small_parts(array.dtype)]
        return Near(words, np.array(parts, np.int64))

    def new_records(self, tail: int, head: int) -> tuple[Any, int]:
        """(copy of this axis' log records from `tail` to `head`, how many of them had been overwritten before).

        Both are multiples of the number of axes: each cycle writes one record for each of them.

        The loop goes on: what it has written over while this was copying, and may be writing over now, counts as lost
        too.
        """
        axes = self.axes
        lost = -(-max(0, head - RING_RECORDS - tail) // axes)
        records = self.ring[np.arange(tail + lost * axes + self.axis, head, axes) % RING_RECORDS]
        now = int(self.words[Word.HEAD])
        written_over = -(-max(0, now + axes - RING_RECORDS - tail - lost * axes) // axes)
        late = min(len(records), written_over) if now > head else 0
        return records[late:], lost + late


def _small_parts(dtype: np.dtype[Any]) -> list[tuple[int, int]]:
    """First byte and the one after the last of what lies between the long arrays of a record: histories, tables."""

    def long_arrays(of: np.dtype[Any], base: int) -> Iterator[tuple[int, int]]:
        for field, offset, *_ in (of.fields or {}).values():
            if field.names is not None:
                yield from long_arrays(field, base + offset)
            elif field.itemsize >= _LONG:
                yield base + offset, base + offset + field.itemsize

    taken = sorted(long_arrays(dtype, 0))
    begins, ends = [0, *(end for _, end in taken)], [*(begin for begin, _ in taken), dtype.itemsize]
    return [(begin, end) for begin, end in zip(begins, ends, strict=True) if end > begin]


def new_block(table: np.ndarray, port: type, arm: ArmModel | None) -> SharedBlock:
    """With the motion's table (rows, 5), of an arm (axes, rows, 5) with its model."""
    tables = np.reshape(table, (-1, *np.shape(table)[-2:]))
    axes, rows = tables.shape[:2]
    block = SharedBlock.create(rows, port, axes, 0 if arm is None else axes)
    block.tables[:] = tables
    if arm is not None:
        block.arm_constants[:], block.links[:] = arm.constants, arm.links
    return block


QUANTILE = 0.99  # of the times that a loop delay is made of


def quantile_s(histogram: np.ndarray) -> float:
    """Upper edge [s] of the bin that holds QUANTILE of one histogram row; nan when it is empty."""
    total = int(histogram.sum())
    if total == 0:
        return math.nan
    bin_us = int(np.searchsorted(np.cumsum(histogram), QUANTILE * total))
    return (bin_us + 1) * 1e-6


@dataclass(frozen=True)
class LoopOrder:
    supervisor_pid: int
    supervisor_fd: int  # of a pipe, whose other end the supervisor has
    block_fd: int
    table_rows: int
    kind: str  # drive.kind
    interface: str
    channel: str
    period_ns: int
    receive_ns: int
    cpu: int | None
    priority: int | None
    bitrate_bitps: int | None = None  # for interfaces that set it when they are opened
    tail_paths: tuple[str, ...] = ()  # of each axis: where its ring is saved if the supervisor has gone
    axes: int = 1
    links: int = 0  # of an arm whose model is in the block
    more_buses: tuple[tuple[int, str, str], ...] = ()  # of an arm: axis of the first drive on it, interface, channel

    def argument(self) -> str:
        return json.dumps(asdict(self))

    def supervisor_gone(self) -> bool:
        """It has ended, or its process has become another program's (exec), which keeps the number."""
        return os.getppid() != self.supervisor_pid or bool(self._end().poll(0))

    def until_supervisor_gone(self) -> None:
        """Returns when it has; where a process that it has forked lives on with its end of the pipe, when that ends."""
        self._end().poll()

    def _end(self) -> select.poll:
        """Of the pipe: it has news when no one has the other one."""
        poll = select.poll()
        poll.register(self.supervisor_fd, 0)
        return poll
