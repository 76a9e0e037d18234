"""The loop on a serial line.

It is compiled, and not plain Python as for CAN adapters without a descriptor: a serial port is a descriptor that the
C library reads and writes.  Wake-up late p50 / p99 / max at 150 Hz on a noisy 2-core virtual machine, SCHED_FIFO:
this loop 27 / 56 / 178 us, a bare Python sleep 43 / 84 / 221 us, and 123 / 155 / 3168 us without SCHED_FIFO.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager

from jointctl.tools.session.loop_memory import LoopOrder, SharedBlock
from jointctl.tools.session.loops import FOREVER, ReadyLoop, loop_call


@contextmanager
def serial_loop(order: LoopOrder, block: SharedBlock) -> Iterator[ReadyLoop]:
    """The compiled loop on a serial line, warm.

    The port is opened when the loop is let go: by then the supervisor has locked and configured it.  However the
    loop ends, the drive is commanded to switch off: it would keep its last torque command for ever.
    """
    from jointctl.drivers.elmo import exchange
    from jointctl.drivers.elmo.dialogue import SWITCH_OFF
    from jointctl.drivers.elmo.serial_port import open_descriptor

    call = loop_call(exchange, block, order.period_ns, order.receive_ns)
    call(0)  # compiles, or loads from the cache

    def go() -> None:
        fd = open_descriptor(order.channel)
        try:
            block.port[0].fd = fd
            call(FOREVER)
        finally:
            with contextlib.suppress(OSError):
                os.write(fd, SWITCH_OFF)
            os.close(fd)

    yield ReadyLoop(go)
