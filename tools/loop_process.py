"""The process that runs the compiled loop and nothing else: `python -m tools.loop_process JSON`.

Signals that a terminal sends are blocked here: stopping is the supervisor's word, and if the supervisor dies the
loop sees its silence and stops the joint.  If this process dies, its heartbeat on the bus ends and the drive stops
the joint.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import sys
import time
from dataclasses import asdict, dataclass

from firmware_py.realtime import Word

_MLOCK_CURRENT_AND_FUTURE = 3
_POLL_S = 0.001
_FOREVER = 1 << 62


@dataclass(frozen=True)
class LoopOrder:
    """What the loop process is told."""

    block_fd: int
    table_rows: int
    interface: str
    channel: str
    period_ns: int
    receive_ns: int
    cpu: int | None
    priority: int | None

    def argument(self) -> str:
        """As one command line argument."""
        return json.dumps(asdict(self))


def _block_signals() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP})


def become_realtime(cpu: int | None, priority: int | None) -> list[str]:
    """Affinity, SCHED_FIFO and locked memory as far as the system allows; returns what it refused."""
    refused = []
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except (OSError, AttributeError) as error:
            refused.append(f"loop.cpu (={cpu}): {error}")
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, AttributeError) as error:
            refused.append(f"loop.priority (={priority}): {error}; see `jointctl doctor`")
    if ctypes.CDLL(None).mlockall(_MLOCK_CURRENT_AND_FUTURE) != 0:
        refused.append("memory could not be locked: a page fault may delay a cycle")
    return refused


def run(order: LoopOrder) -> int:
    """Warm up, wait for GO, run the loop; returns the exit code."""
    from drivers.can.open import open_cyclic_end
    from drivers.canopen.exchange import exchange_memory, receive, send
    from firmware_py.realtime import run_loop
    from tools.shared_block import SharedBlock

    supervisor = os.getppid()
    block = SharedBlock(order.block_fd, order.table_rows)
    frames, scratch = exchange_memory()

    def call(max_cycles: int) -> int:
        return int(
            run_loop(
                receive, send, block.port, frames, scratch, block.constants, block.state, block.table, block.sample,
                block.command, block.words, block.ring, block.histograms, order.period_ns, order.receive_ns, max_cycles,
            )
        )  # fmt: skip

    call(0)  # compiles, or loads from the cache
    with open_cyclic_end(order.interface, order.channel) as end:
        gc.collect()
        gc.freeze()
        gc.disable()
        for line in become_realtime(order.cpu, order.priority):
            print(f"loop: {line}", file=sys.stderr, flush=True)
        block.words[Word.READY] = 1
        while block.words[Word.GO] == 0:
            if os.getppid() != supervisor:
                return 1
            time.sleep(_POLL_S)
        block.port[0].fd = end.fileno()
        call(_FOREVER)
        block.words[Word.ENDED] = 1
    return 0


def main() -> int:
    """Entry point of the process."""
    _block_signals()
    return run(LoopOrder(**json.loads(sys.argv[1])))


if __name__ == "__main__":
    sys.exit(main())
