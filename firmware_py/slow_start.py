"""That compiling takes its time: noticed where a kernel is compiled, reported by the command that waits for it.

Apart from `kernel`, which takes a tenth of a second to load: not every command has kernels.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

SLOW_START_S = 2.0  # compiling for so long is reported
_waiting: list[Callable[[], AbstractContextManager[None]]] = []


@contextlib.contextmanager
def slow_start(tell: Callable[[str], object], who: str, after_s: float = SLOW_START_S) -> Iterator[None]:
    """Tells once that `who` compiles, as soon as it has for `after_s` within; loading from the cache does not count."""
    left_s, said = after_s, False

    def say() -> None:
        nonlocal said
        said = True
        tell(f"{who}: compiling, which only the first start does")

    @contextlib.contextmanager
    def one() -> Iterator[None]:
        nonlocal left_s
        timer, began_s = threading.Timer(max(left_s, 0.0), say), time.monotonic()
        timer.daemon = True
        if not said:
            timer.start()
        try:
            yield
        finally:
            timer.cancel()
            left_s -= time.monotonic() - began_s

    _waiting.append(one)
    try:
        yield
    finally:
        _waiting.remove(one)


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Around the compilation of one kernel."""
    with contextlib.ExitStack() as stack:
        for one in tuple(_waiting):
            stack.enter_context(one())
        yield
