"""The loop process as seen by its supervisor, and the memory that both share."""

from __future__ import annotations

import contextlib
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
from typing import Any

import numpy as np

from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Histogram, Word
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.child_process import Starting
from jointctl.tools.configuration.config import Config

# --- The memory that the supervisor and the loop process share: one anonymous file, passed on as a file descriptor ---
# It has no name, so that nothing is left behind whatever dies; it lives as long as either process has it.


RING_RECORDS = 1 << 14  # 16 s at 1 kHz
_LINE = 64  # bytes; nothing of one array shares a cache line with another


class SharedBlock:
    """Arrays over the shared memory; `words`, `histograms`, `table` plain, the others record arrays."""

    def __init__(self, fd: int, table_rows: int, port: type) -> None:
        """Map an existing block; every process gives the same `table_rows` and record of the drive's exchange."""
        self.fd = fd
        self.table_rows = table_rows
        self._offset = 0
        size = self._size(table_rows, port)
        os.ftruncate(fd, max(os.fstat(fd).st_size, size))
        self._memory = mmap.mmap(fd, size)
        self.words = self._take(np.dtype(np.int64), WORDS)
        self.histograms = self._take(np.dtype(np.int64), len(Histogram) * HISTOGRAM_BINS).reshape(len(Histogram), -1)
        self.table = self._take(np.dtype(np.float64), table_rows * 5).reshape(table_rows, 5)
        self.constants = self._records(AxisConstants, 1)
        self.state = self._records(AxisState, 1)
        self.sample = self._records(Sample, 1)
        self.command = self._records(Command, 1)
        self.port = self._records(port, 1)
        self.ring = self._records(LogRecord, RING_RECORDS)

    @classmethod
    def create(cls, table_rows: int, port: type) -> SharedBlock:
        """A new zeroed block."""
        if hasattr(os, "memfd_create"):
            fd = os.memfd_create("jointctl-loop")
        else:
            with tempfile.TemporaryFile() as file:
                fd = os.dup(file.fileno())
        return cls(fd, table_rows, port)

    @staticmethod
    def _size(table_rows: int, port: type) -> int:
        records = (AxisConstants, AxisState, Sample, Command, port)
        words = WORDS + len(Histogram) * HISTOGRAM_BINS + table_rows * 5
        ring = RING_RECORDS * dtype_of(LogRecord).itemsize
        return 8 * words + sum(dtype_of(r).itemsize for r in records) + ring + 16 * _LINE

    def _take(self, dtype: np.dtype[Any], count: int) -> Any:
        array = np.frombuffer(self._memory, dtype, count, self._offset)
        self._offset += -(-array.nbytes // _LINE) * _LINE
        return array

    def _records(self, cls: type, count: int) -> Any:
        return self._take(dtype_of(cls), count).view(np.recarray)

    def memory(self) -> CycleMemory:
        return CycleMemory(
            self.constants, self.state, self.table[np.newaxis], self.sample, self.command, self.words, self.ring,
            self.histograms, np.zeros(2, np.int64),
        )  # fmt: skip

    def new_records(self, tail: int, head: int) -> tuple[Any, int]:
        """(copy of the log records from `tail` to `head`, how many of them had been overwritten before).

        The loop goes on: what it has written over while this was copying, and may be writing over now, counts as lost
        too.
        """
        lost = max(0, head - RING_RECORDS - tail)
        records = self.ring[np.arange(tail + lost, head) % RING_RECORDS]
        now = int(self.words[Word.HEAD])
        late = min(len(records), max(0, now + 1 - RING_RECORDS - tail - lost)) if now > head else 0
        return records[late:], lost + late


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

    def argument(self) -> str:
        return json.dumps(asdict(self))


class LoopHandle:
    """Owns the process and the shared memory; a context manager that never leaves the process behind.

    `port`: record of the drive's exchange.  `tail_path`: where the loop itself saves the ring if this process has gone
    when it ends.  `marker_fd` shows whose loop it is (`drivers.bus_lock`).
    """

    def __init__(
        self, config: Config, table: Any, port: type, tail_path: Path | None = None, marker_fd: int | None = None
    ) -> None:
        self.block = SharedBlock.create(len(table), port)
        self.block.table[:] = table
        self._tail = 0
        self.lost_records = 0
        self._after_end = config.drive.when_the_loop_ends
        self._period_ns = period_ns = round(NANOSECONDS / config.loop.rate_Hz)
        order = LoopOrder(
            supervisor_pid=os.getpid(),
            block_fd=self.block.fd,
            table_rows=len(table),
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
        reset_axis(self.block.constants[0], self.block.state[0])
        self.beat()
        now_ns = time.monotonic_ns()
        self.block.words[Word.ASLEEP_NS] = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - now_ns
        self.listen()
        self.block.words[Word.LOOP_NS] = time.monotonic_ns()
        self.block.words[Word.GO] = 1

    @property
    def cycles(self) -> int:
        return int(self.block.words[Word.HEAD])

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
            if silent_s <= (SILENT_S if self.cycles else OPENING_S):
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
