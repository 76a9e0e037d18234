"""The compiled loop on a serial port: `firmware_py.realtime.run_loop` with the exchange of `drivers.elmo`.

Compiled, and not plain Python as for CAN adapters without a descriptor: a serial port is a descriptor that the C
library reads and writes.  Wake-up late p50 / p99 / max at 150 Hz on a noisy 2-core virtual machine, SCHED_FIFO: this
loop 27 / 56 / 178 us, a bare Python sleep 43 / 84 / 221 us, and 123 / 155 / 3168 us without SCHED_FIFO.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers.elmo.serial_port import open_descriptor
from drivers.elmo.switch_off import SWITCH_OFF

_FOREVER = 1 << 62


def serial_call(block: Any, period_ns: int, receive_ns: int) -> Callable[[int], int]:
    """`run_loop` on this memory as a function of the greatest number of cycles; 0 only compiles."""
    from drivers.elmo.exchange import exchange_memory, receive, send
    from firmware_py.realtime import run_loop

    data, scratch = exchange_memory()

    def call(max_cycles: int) -> int:
        return int(
            run_loop(
                receive, send, block.port, data, scratch, block.constants, block.state, block.table, block.sample,
                block.command, block.words, block.ring, block.histograms, period_ns, receive_ns, max_cycles,
            )
        )  # fmt: skip

    return call


@contextmanager
def serial_loop(order: Any, block: Any) -> Iterator[Callable[[], object]]:
    """The loop, warm, as a function that runs it to its end.

    The port is opened when the loop is let go: by then the supervisor has locked and configured it.  However the
    loop ends, the drive is told to switch off: it would keep its last torque command for ever.
    """
    call = serial_call(block, order.period_ns, order.receive_ns)
    call(0)  # compiles, or loads from the cache

    def go() -> None:
        fd = open_descriptor(order.channel)
        try:
            block.port[0].fd = fd
            call(_FOREVER)
        finally:
            with contextlib.suppress(OSError):
                os.write(fd, SWITCH_OFF)
            os.close(fd)

    yield go
