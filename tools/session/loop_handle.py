"""The loop process as seen by its supervisor: start it, let it go, listen to it, ask it to stop."""

from __future__ import annotations

import contextlib
import copy
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.drivers.errors import MotionFault
from jointctl.drivers.port_users import keep_from_forks
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.child_process import Starting, keep_off, let_run
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.session.loop_memory import LoopOrder, new_block

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmModel

KILL_S = 1.0  # how long a killed process may take to go
SILENT_S = 2.0  # without a cycle for so long, the loop hangs
LOOK_S = 0.5  # between two looks; beyond it this process or the computer stood still, which is forgiven once a cycle
OPENING_S = 6.0  # before its first cycle it may have to open an adapter; the drive is disabled in the meantime
RECEIVE_SHARE = 0.6  # of a period: how long a cycle waits for its sample


class LoopHandle(contextlib.AbstractContextManager["LoopHandle"]):
    """Owns the process and the shared memory; a context manager that never leaves the process behind.

    `port`: record of the drive's exchange.  `tail_paths`: where the loop itself saves the ring of each axis if this
    process has gone when it ends.  `marker_fds` show whose loop it is (`drivers.bus_lock`).
    """

    _processor: int | None = None  # that the loop has for itself from `go` on
    _allowed: Mapping[int, set[int]] = {}  # where the threads of this process could run before
    _cycle_ns = _looked_ns = _stood_ns = 0  # of `_hung_ns`

    def __init__(
        self, config: Config, table: np.ndarray, port: type, tail_paths: Sequence[Path] = (),
        marker_fds: Sequence[int] = (), arm: ArmModel | None = None, joints: Sequence[Config] = (),
    ) -> None:  # fmt: skip
        """`table` (rows, 5), of an arm (axes, rows, 5), with its `arm` model and its `joints`, `config` the first."""
        self.block = new_block(table, port, arm)
        self._tail = 0
        self.lost_records = 0
        self._after_end = config.drive.when_the_loop_ends
        self._processor = config.loop.cpu
        self._period_ns = period_ns = round(NANOSECONDS / config.loop.rate_Hz)
        theirs, ours = os.pipe()
        self._alive = keep_from_forks(os.fdopen(ours, "wb"))  # closed with this process, and by exec
        order = LoopOrder(
            supervisor_pid=os.getpid(),
            supervisor_fd=theirs,
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
            tail_paths=tuple(str(path.absolute()) for path in tail_paths),
            more_buses=tuple(
                (axis, joints[axis].bus.interface, joints[axis].bus.channel)
                for axis in sorted(set(first_on_bus(joints)) - {0})
            ),
        )
        with open(theirs, "rb"):
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "jointctl.tools.session.loop_process", order.argument()],
                pass_fds=(theirs, self.block.fd, *marker_fds),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # keys that a terminal turns into signals are not for the loop
            )

    def __exit__(self, *_: object) -> None:
        """A loop that still runs gets the word to switch off, and is killed only if it does not listen."""
        if self._process.poll() is None:
            self.request_stop(StopRequest.OFF)
            try:
                self._process.wait(1.0 if self.started else 0.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._alive.close()
        let_run(self._allowed)  # not before: until then the processor is the loop's

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

    def bus_is_there(self) -> None:
        """The loop may open the bus, once it is compiled."""
        self.block.words[Word.BUS] = 1

    def wait_ready(
        self, alive: Callable[[], object] = lambda: None, tell: Callable[[str], None] = lambda _: None
    ) -> None:
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

    def go(self, constants: np.recarray, port: np.recarray) -> None:
        """Hand over the constants and the driver's memory, and let the loop begin, alone on `loop.cpu`."""
        self._allowed = keep_off(self._processor)
        self.block.constants[:] = constants
        self.block.port[:] = port
        for axis in range(self.block.axes):
            plain(reset_axis)(self.block.constants[axis], self.block.state[axis])
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
        """Let all axes leave WAITING (see `SequenceConstants.may_enable`) once each of them may.

        From then on they count the time in which not all stand; what the supervisor takes for another one is none.
        """
        block = self.block
        block.allowed.add(block.axis)
        if len(block.allowed) == block.axes:
            block.whole.constants.sequence.may_enable[:] = 1

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

    def _hung_ns(self) -> int:
        """How long the loop has finished no cycle, less the longest standstill between two looks at it.

        For a cycle it needs a processor, as the looks do.
        """
        now_ns, cycle_ns = time.monotonic_ns(), int(self.block.words[Word.LOOP_NS])
        if cycle_ns != self._cycle_ns:
            self._cycle_ns = self._looked_ns = cycle_ns
            self._stood_ns = 0
        self._stood_ns = max(self._stood_ns, now_ns - self._looked_ns - round(LOOK_S * NANOSECONDS))
        self._looked_ns = now_ns
        return now_ns - cycle_ns - self._stood_ns

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
            if self._hung_ns() <= NANOSECONDS * (SILENT_S if self.block.words[Word.HEAD] else OPENING_S):
                return True
            silent_s = (time.monotonic_ns() - self._cycle_ns) / NANOSECONDS
            self._process.kill()  # whatever it would do next, it must not wake up beside a new run
            with contextlib.suppress(subprocess.TimeoutExpired):  # stuck in the system: the drive must not wait for it
                self._process.wait(KILL_S)
            raise MotionFault(f"the loop process did nothing for {silent_s:.1f} s and was ended", self._after_end)
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        raise MotionFault(f"the loop process {how}", self._after_end)
