"""A word to whoever waits for a start that compiles."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SLOW_START_S = 4.0


@contextmanager
def slow_start(tell: Callable[[str], object], who: str, after_s: float = SLOW_START_S) -> Iterator[Callable[[], None]]:
    """Tells after `after_s` that `who` compiles, unless what this gives has been called, or the block has ended."""
    timer = threading.Timer(
        after_s, tell, [f"{who}: compiling, which only the first start does; it takes a minute or two"]
    )
    timer.daemon = True
    timer.start()
    try:
        yield timer.cancel
    finally:
        timer.cancel()
