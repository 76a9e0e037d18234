"""Worker processes and Ctrl-C, which a terminal sends to all of them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupts_left_to_the_parent() -> Iterator[None]:
    """Processes that are started within hold Ctrl-C back from their first instruction on; here it comes afterwards.

    An initialiser of a worker would be too late: its imports take a second, and each would end with a traceback.
    """
    resource_tracker.ensure_running()  # with the first spawned process it would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
