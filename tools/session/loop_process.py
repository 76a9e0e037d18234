"""The process that runs the loop and nothing else: `python -m jointctl.tools.session.loop_process JSON`.

The loop is the compiled one where the bus is a file descriptor, else the plain Python one of `portable_loop`.

Signals that a terminal sends are blocked here: stopping is the supervisor's word.  If the supervisor dies, the loop
stops the joint at once; if it hangs, when it has been silent for too long.  If this process dies, its heartbeat on the
bus ends and the drive stops the joint.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.slow_start import slow_start
from jointctl.tools.child_process import say
from jointctl.tools.session.loop_memory import LoopOrder, SharedBlock
from jointctl.tools.session.loops import loop_of
from jointctl.tools.wake_up import cores_awake

_MLOCK_CURRENT_AND_FUTURE = 3
_POLL_S = 0.001
LONG_AGO_NS = -(1 << 60)  # CLOCK_MONOTONIC


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
                with contextlib.suppress(ProcessLookupError):  # a thread that has ended in the meantime
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, AttributeError) as error:
            refused.append(f"loop.priority (={priority}): {error}; see `jointctl doctor`")
    if ctypes.CDLL(None).mlockall(_MLOCK_CURRENT_AND_FUTURE) != 0:
        refused.append("memory could not be locked: a page fault may delay a cycle")
    return refused


def _await_death(order: LoopOrder, block: SharedBlock) -> None:
    """A supervisor that has died is silent from then on: for the loop, since long ago."""
    order.until_supervisor_gone()
    block.words[Word.SUPERVISOR_NS] = LONG_AGO_NS


def run(order: LoopOrder) -> int:
    """Warm up, wait for GO, run the loop; returns the exit code."""
    port, loop = loop_of(order.kind)
    block = SharedBlock(order.block_fd, order.table_rows, port, order.axes, order.links)

    threading.Thread(target=_await_death, args=(order, block), name="death of the supervisor", daemon=True).start()
    gc.disable()
    with slow_start(say, "loop"), loop(order, block) as ready:
        gc.freeze()
        for line in become_realtime(order.cpu, order.priority):
            say(f"loop: {line}")
        with cores_awake():  # where that is refused, `doctor` says so
            block.words[Word.READY] = 1
            while block.words[Word.GO] == 0:
                if order.supervisor_gone():
                    return 1
                if block.words[Word.LISTEN] == 0:  # commissioning, its proof of the watchdog, the user's thinking time
                    ready.flush()
                time.sleep(_POLL_S)
            ready.go()
            block.words[Word.ENDED] = 1
    if order.supervisor_gone():
        save_tails(block, [Path(path) for path in order.tail_paths])
    return 0


def save_tails(block: SharedBlock, paths: Sequence[Path]) -> None:
    """Write what the ring holds of each axis: all are off by now, and nobody else is left to keep the last seconds."""
    from jointctl.tools.recording.run_log import ERROR, RunLogWriter

    for axis, path in enumerate(paths):
        records, lost = block.of_axis(axis).new_records(0, int(block.words[Word.HEAD]))
        metadata = {"tail": {"why": "the supervising process had gone", "records_before": str(lost)}}
        with RunLogWriter(path, metadata) as log:
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
        say(f"loop: {error}")
        return error.exit_code
    except BaseException as error:
        text = " ".join(str(error).split())
        say(f"loop: {type(error).__name__}{_place(error)}: {text}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
