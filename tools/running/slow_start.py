"""A word to whoever waits for a start that compiles."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SLOW_START_S = 4.0


@contextmanager
def slow_start(tell: Callable[[], object], after_s: float = SLOW_START_S) -> Iterator[Callable[[], None]]:
    """Calls `tell` after `after_s`, unless what this gives has been called, or the block has ended, before."""
    timer = threading.Timer(after_s, tell)
    timer.daemon = True
    timer.start()
    try:
        yield timer.cancel
    finally:
        timer.cancel()
