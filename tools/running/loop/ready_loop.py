"""What every kind of loop is once it is warm, and the compiled one as a call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

FOREVER = 1 << 62


def _nothing() -> None:
    """For a loop that does not listen before it goes."""


@dataclass(frozen=True)
class ReadyLoop:
    """A loop that is warm: `go` runs it to its end, `flush` throws away what the bus has said so far."""

    go: Callable[[], object]
    flush: Callable[[], None] = _nothing


def loop_call(exchange: Any, block: Any, period_ns: int, receive_ns: int) -> Callable[[int], int]:
    """`run_loop` on this memory with this module's exchange, as a function of the greatest number of cycles.

    0 only compiles, or loads from the cache.
    """
    from jointctl.firmware_py.realtime import run_loop

    frames, scratch = exchange.exchange_memory()
    timespec = np.zeros(2, np.int64)

    def call(max_cycles: int) -> int:
        return int(
            run_loop(
                exchange.receive, exchange.send, block.port, frames, scratch, block.constants, block.state, block.table,
                block.sample, block.command, block.words, block.ring, block.histograms, timespec, period_ns,
                receive_ns, max_cycles,
            )
        )  # fmt: skip

    return call
