"""The loop process as seen by its supervisor, and the memory that both share."""

from __future__ import annotations

import contextlib
import copy
import json
import math
import mmap
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.arm_model import Arm, ArmConstants, ArmLink, ArmMotion
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Histogram, Word
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.child_process import Starting
from jointctl.tools.configuration.config import Config

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmModel

# --- The memory that the supervisor and the loop process share: one anonymous file, passed on as a file descriptor ---
# It has no name, so that nothing is left behind whatever dies; it lives as long as either process has it.


RING_RECORDS = 1 << 14  # 16 s at 1 kHz
_LINE = 64  # bytes; nothing of one array shares a cache line with another


class SharedBlock:
    """Arrays over the shared memory; `words`, `histograms`, `tables` plain, the others record arrays.

    Of an arm they have one element a joint, and its model is there too (`links`); `table` is that of the first joint.
    """

    def __init__(self, fd: int, table_rows: int, port: type, axes: int = 1, links: int = 0) -> None:
        """Map an existing block; every process gives the same numbers and record of the drive's exchange."""
        self.fd = fd
        self.table_rows, self.axes, self.axis = table_rows, axes, 0
        self.whole = self  # also seen from one axis
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
        records = (AxisConstants, AxisState, Sample, Command, port, ArmLink)
        words = WORDS + len(Histogram) * HISTOGRAM_BINS + axes * table_rows * 5
        rest = RING_RECORDS * dtype_of(LogRecord).itemsize + dtype_of(ArmConstants).itemsize
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
            Arm(self.arm_constants, self.links, new(ArmMotion, len(self.links) + 1)),
        )  # fmt: skip

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


def new_block(table: Any, port: type, arm: ArmModel | None) -> SharedBlock:
    """With the motion's table (rows, 5), of an arm (axes, rows, 5) with its model."""
    tables = np.reshape(table, (-1, *np.shape(table)[-2:]))
    axes, rows = tables.shape[:2]
    block = SharedBlock.create(rows, port, axes, 0 if arm is None else axes)
    block.tables[:] = tables
    if arm is not None:
        block.arm_constants[:], block.links[:] = arm.constants, arm.links
    return block


QUANTILE = 0.99  # of the times that a loop delay is made of


def quantile_s(histogram: np.ndarray, quantile: float) -> float:
    """Upper edge [s] of the bin that holds the quantile of one histogram row; nan when it is empty."""
    total = int(histogram.sum())
    if total == 0:
        return math.nan
    bin_us = int(np.searchsorted(np.cumsum(histogram), quantile * total))
    return (bin_us + 1) * 1e-6


# --- The loop process as seen by its supervisor: start it, let it go, listen to it, ask it to stop ---


KILL_S = 1.0  # how long a killed process may take to go
SILENT_S = 2.0  # without a cycle for so long, the loop hangs
OPENING_S = 6.0  # before its first cycle it may have to open an adapter; the drive is disabled in the meantime
RECEIVE_SHARE = 0.6  # of a period: how long a cycle waits for its sample


@dataclass(frozen=True)
class LoopOrder:
    supervisor_pid: int
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
    tail_path: str | None = None  # where the ring is saved if the supervisor has gone
    axes: int = 1
    links: int = 0  # of an arm whose model is in the block

    def argument(self) -> str:
        return json.dumps(asdict(self))


class LoopHandle:
    """Owns the process and the shared memory; a context manager that never leaves the process behind.

    `port`: record of the drive's exchange.  `tail_path`: where the loop itself saves the ring if this process has gone
    when it ends.  `marker_fd` shows whose loop it is (`drivers.bus_lock`).
    """

    def __init__(
        self, config: Config, table: np.ndarray, port: type, tail_path: Path | None = None,
        marker_fd: int | None = None, arm: ArmModel | None = None,
    ) -> None:  # fmt: skip
        """`table` (rows, 5), of an arm (axes, rows, 5), with its `arm` model."""
        self.block = new_block(table, port, arm)
        self._tail = 0
        self.lost_records = 0
        self._after_end = config.drive.when_the_loop_ends
        self._period_ns = period_ns = round(NANOSECONDS / config.loop.rate_Hz)
        order = LoopOrder(
            supervisor_pid=os.getpid(),
            block_fd=self.block.fd,
            table_rows=self.block.tables.shape[1],
            axes=self.block.axes,
            links=len(self.block.links),
            kind=config.drive.kind,
            interface=config.bus.interface,
            channel=config.bus.channel,
            period_ns=period_ns,
            receive_ns=int(RECEIVE_SHARE * period_ns),
            bitrate_bitps=config.bus.bitrate_bitps,
            cpu=config.loop.cpu,
            priority=config.loop.priority,
            tail_path=None if tail_path is None else str(tail_path.absolute()),
        )
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "jointctl.tools.session.loop_process", order.argument()],
            pass_fds=(self.block.fd,) if marker_fd is None else (self.block.fd, marker_fd),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # keys that a terminal turns into signals are not for the loop
        )

    def __enter__(self) -> LoopHandle:
        return self

    def __exit__(self, *_: object) -> None:
        """A loop that still runs gets the word to switch off, and is killed only if it does not listen."""
        if self._process.poll() is None:
            self.request_stop(StopRequest.OFF)
            try:
                self._process.wait(1.0 if self.started else 0.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def started(self) -> bool:
        """Whether the loop has been let go."""
        return bool(self.block.words[Word.GO])

    @property
    def phase(self) -> AxisPhase:
        """The axis' phase as of the last cycle."""
        return AxisPhase(int(self.block.state[0].phase))

    def of_axis(self, axis: int) -> LoopHandle:
        """The same loop as that of a single joint is seen; whatever is asked of it is asked of all joints."""
        part = copy.copy(self)
        part.block = self.block.of_axis(axis)
        return part

    def wait_ready(self, alive: Any = lambda: None, tell: Callable[[str], None] = lambda _: None) -> None:
        """Until the loop is compiled and warm; `alive` is called all the time and may raise; `tell` gets what it does.

        Raises `JointctlError` if it ends, or hangs, before that.
        """
        starting = Starting("the loop process", self._process, tell)
        while not self.block.words[Word.READY]:
            alive()
            starting.check()
            time.sleep(0.005)

    def listen(self) -> None:
        """What the bus says from now on is for the run: call it when commissioning and its proofs are over."""
        self.block.words[Word.LISTEN] = 1

    def go(self, constants: Any, port: Any) -> None:
        """Hand over the constants and the driver's memory, and let the loop begin."""
        self.block.constants[:] = constants
        self.block.port[:] = port
        for axis in range(self.block.axes):
            reset_axis(self.block.constants[axis], self.block.state[axis])
        self.beat()
        now_ns = time.monotonic_ns()
        self.block.words[Word.ASLEEP_NS] = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - now_ns
        self.listen()
        self.block.words[Word.LOOP_NS] = time.monotonic_ns()
        self.block.words[Word.GO] = 1

    @property
    def cycles(self) -> int:
        return int(self.block.words[Word.HEAD]) // self.block.axes

    def allow_enable(self) -> None:
        """Let the axis leave WAITING (see `SequenceConstants.may_enable`)."""
        self.block.constants[0].sequence.may_enable = 1

    def beat(self) -> None:
        """The supervisor's sign of life."""
        self.block.words[Word.SUPERVISOR_NS] = time.monotonic_ns()

    def request_stop(self, request: StopRequest) -> None:
        """Ask for a stop; a stronger request replaces a weaker one, never the other way round."""
        self.block.words[Word.STOP] = max(int(self.block.words[Word.STOP]), int(request))

    @property
    def stop_requested(self) -> bool:
        """Whether anybody has asked for a stop: this process, or the guard of a serial line."""
        return bool(self.block.words[Word.STOP])

    def verdict(self) -> tuple[Fault, float]:
        """The loop's fault and the value that tripped it.

        OVERRUN as well where a guard switched the drive off behind a loop that stood still and then obeyed: its own
        watch over skipped cycles ends with its power.
        """
        state, held_up_ns = self.block.state[0], int(self.block.words[Word.HELD_UP_NS])
        if state.fault == Fault.NONE and held_up_ns:
            return Fault.OVERRUN, held_up_ns / self._period_ns
        return Fault(int(state.fault)), float(state.fault_value)

    def new_records(self) -> Any:
        head = int(self.block.words[Word.HEAD])
        records, lost = self.block.new_records(self._tail, head)
        self._tail = head
        self.lost_records += lost
        return records

    def running(self) -> bool:
        """True while the loop runs, False after its regular end.

        Raises `MotionFault` if the process is gone, or hangs, without having ended regularly.
        """
        code = self._process.poll()
        if self.block.words[Word.ENDED]:
            return False
        if code is None:
            silent_s = (time.monotonic_ns() - int(self.block.words[Word.LOOP_NS])) * 1e-9
            if silent_s <= (SILENT_S if self.block.words[Word.HEAD] else OPENING_S):
                return True
            self._process.kill()  # whatever it would do next, it must not wake up beside a new run
            with contextlib.suppress(subprocess.TimeoutExpired):  # stuck in the system: the drive must not wait for it
                self._process.wait(KILL_S)
            raise MotionFault(
                f"the loop process did nothing for {silent_s:.1f} s and was ended",
                self._after_end,
            )
        if self.block.words[Word.ENDED]:
            return False
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        raise MotionFault(
            f"the loop process {how}",
            self._after_end,
        )
