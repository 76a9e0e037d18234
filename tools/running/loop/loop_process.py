"""The process that runs the loop and nothing else: `python -m jointctl.tools.running.loop.loop_process JSON`.

The loop is the compiled one where the bus is a file descriptor, else the plain Python one of `portable_loop`.

Signals that a terminal sends are blocked here: stopping is the supervisor's word, and if the supervisor dies the
loop sees its silence and stops the joint.  If this process dies, its heartbeat on the bus ends and the drive stops
the joint.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.realtime import Word
from jointctl.tools.running.loop.ready_loop import FOREVER, ReadyLoop, loop_call
from jointctl.tools.running.loop.slow_start import slow_start
from jointctl.tools.wake_up import cores_awake

_MLOCK_CURRENT_AND_FUTURE = 3
_POLL_S = 0.001


@dataclass(frozen=True)
class LoopOrder:
    """What the loop process is told."""

    supervisor_pid: int
    block_fd: int
    table_rows: int
    interface: str
    channel: str
    period_ns: int
    receive_ns: int
    cpu: int | None
    priority: int | None
    bitrate_bitps: int | None = None  # for interfaces that set it when they are opened
    tail_path: str | None = None  # where the ring is saved if the supervisor has gone

    def argument(self) -> str:
        """As one command line argument."""
        return json.dumps(asdict(self))


def _block_signals() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP})


def become_realtime(cpu: int | None, priority: int | None, threads: Sequence[int] = (0,)) -> list[str]:
    """Affinity, SCHED_FIFO and locked memory as far as the system allows; returns what it refused.

    For the calling thread, or for those with the given numbers.  To be called when everything is compiled: a compiler
    at this priority takes a core from everybody, other loops too, until the kernel throttles all real-time threads.
    """
    refused = []
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except (OSError, AttributeError) as error:
            refused.append(f"loop.cpu (={cpu}): {error}")
    if priority is not None:
        try:
            for thread in threads:
                with contextlib.suppress(ProcessLookupError):  # a thread that has ended meanwhile
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, AttributeError) as error:
            refused.append(f"loop.priority (={priority}): {error}; see `jointctl doctor`")
    if ctypes.CDLL(None).mlockall(_MLOCK_CURRENT_AND_FUTURE) != 0:
        refused.append("memory could not be locked: a page fault may delay a cycle")
    return refused


def compiled_call(block: Any, period_ns: int, receive_ns: int) -> Callable[[int], int]:
    """`loop_call` on a CAN bus that is a descriptor."""
    from jointctl.drivers.canopen import exchange

    return loop_call(exchange, block, period_ns, receive_ns)


@contextmanager
def compiled_loop(order: LoopOrder, block: Any) -> Iterator[ReadyLoop]:
    """The compiled loop, warm and attached to the bus."""
    from jointctl.drivers.can.frames import FRAME_BYTES
    from jointctl.drivers.can.open import open_cyclic_end

    call = compiled_call(block, order.period_ns, order.receive_ns)
    call(0)  # compiles, or loads from the cache
    with open_cyclic_end(order.interface, order.channel) as end:

        def go() -> None:
            block.port[0].fd = end.fileno()
            block.port[0].stamped = order.interface == "jointctl"
            call(FOREVER)

        def flush() -> None:
            with contextlib.suppress(OSError):  # nothing waits, or the bus is down: the loop will tell
                while end.recv(FRAME_BYTES, socket.MSG_DONTWAIT):
                    pass

        yield ReadyLoop(go, flush)


def _leave(bus: Any) -> None:
    """Close it; of an adapter that is gone, what failed before counts."""
    with contextlib.suppress(Exception):
        bus.shutdown()


@contextmanager
def portable_loop(order: LoopOrder, block: Any) -> Iterator[ReadyLoop]:
    """The plain Python loop in the same way, and a line that tells what it can hold.

    An adapter that serves one program at a time belongs to commissioning until the loop is let go, which opens it then
    (see `CanopenDrive.start_cyclic`).
    """
    from jointctl.drivers.can.open import SHARED_INTERFACES, known_interface, open_python_can
    from jointctl.tools.running.loop.portable_loop import (
        check_portable_rate,
        held_rate_Hz,
        portable_note,
        run_portable_loop,
        throw_away,
        warm_up,
    )

    rate_Hz = NANOSECONDS / order.period_ns
    known_interface(order.interface)
    check_portable_rate(order.interface, rate_Hz)
    warm_up()
    held_Hz = held_rate_Hz(order.receive_ns / order.period_ns)
    print(f"loop: {portable_note(order.interface, rate_Hz, held_Hz)}", file=sys.stderr, flush=True)

    with contextlib.ExitStack() as stack:

        def opened() -> Any:
            bus = open_python_can(order.interface, order.channel, order.bitrate_bitps)
            stack.callback(_leave, bus)
            return bus

        if order.interface in SHARED_INTERFACES:
            bus = opened()
            yield ReadyLoop(
                lambda: run_portable_loop(bus, block, order.period_ns, order.receive_ns), lambda: throw_away(bus)
            )
        else:
            yield ReadyLoop(lambda: run_portable_loop(opened(), block, order.period_ns, order.receive_ns))


def run(order: LoopOrder) -> int:
    """Warm up, wait for GO, run the loop; returns the exit code."""
    from jointctl.drivers.can.open import CYCLIC_INTERFACES
    from jointctl.drivers.elmo.settings import SERIAL
    from jointctl.tools.running.loop.shared_block import SharedBlock

    block = SharedBlock(order.block_fd, order.table_rows, order.interface)
    if order.interface == SERIAL:
        from jointctl.tools.running.loop.serial_loop import serial_loop

        loop: Callable[[LoopOrder, Any], AbstractContextManager[ReadyLoop]] = serial_loop
    else:
        loop = compiled_loop if order.interface in CYCLIC_INTERFACES else portable_loop

    def tell(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    with slow_start(tell, "loop") as started, loop(order, block) as ready:
        started()
        gc.freeze()
        gc.disable()
        for line in become_realtime(order.cpu, order.priority):
            print(f"loop: {line}", file=sys.stderr, flush=True)
        with cores_awake():  # where that is refused, `doctor` says so
            block.words[Word.READY] = 1
            while block.words[Word.GO] == 0:
                if os.getppid() != order.supervisor_pid:
                    return 1
                if block.words[Word.LISTEN] == 0:  # commissioning, its proof of the watchdog, the user's thinking time
                    ready.flush()
                time.sleep(_POLL_S)
            ready.go()
            block.words[Word.ENDED] = 1
    if order.tail_path is not None and os.getppid() != order.supervisor_pid:
        save_tail(block, Path(order.tail_path))
    return 0


def save_tail(block: Any, path: Path) -> None:
    """Write what the ring holds: the joint is off by now, and nobody else is left to keep the last seconds."""
    from jointctl.tools.recording.run_log import ERROR, RunLogWriter

    records, lost = block.new_records(0, int(block.words[Word.HEAD]))
    with RunLogWriter(path, {"tail": {"why": "the supervising process had gone", "records_before": str(lost)}}) as log:
        log.write_records(records)
        log.write_event(ERROR, "loop", "the supervising process had gone; these are the last records of the loop")


def _place(error: BaseException) -> str:
    """File and line where it was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else f" at {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"


def main() -> int:
    """Entry point of the process.

    Whatever goes wrong is one line and an exit code: the end of this process ends the heartbeat, and with it the
    joint's torque, so there is nothing to wait for.
    """
    _block_signals()
    try:
        return run(LoopOrder(**json.loads(sys.argv[1])))
    except JointctlError as error:
        print(f"loop: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    except BaseException as error:
        text = " ".join(str(error).split())
        print(f"loop: {type(error).__name__}{_place(error)}: {text}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
