"""Ctrl-C, SIGTERM and a closed terminal as stop requests; asking again asks for more."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from firmware_py.states import StopRequest

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ESCALATION = (StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF)


class StopSignals:
    """Counts stop signals; `request` is what they ask for by now."""

    def __init__(self) -> None:
        self.count = 0
        self.name = ""
        self.raising = False  # a signal also raises KeyboardInterrupt, as a question to the user needs it

    @property
    def request(self) -> StopRequest:
        """NONE, then RAMP, QUICK_STOP and OFF with each further signal."""
        if self.count == 0:
            return StopRequest.NONE
        return _ESCALATION[min(self.count, len(_ESCALATION)) - 1]

    def on_signal(self, number: int, _: FrameType | None) -> None:
        """Signal handler."""
        self.count += 1
        self.name = signal.Signals(number).name
        if self.raising:
            raise KeyboardInterrupt


@contextmanager
def stop_signals() -> Iterator[StopSignals]:
    """Collect stop signals while the block runs instead of ending the program."""
    signals = StopSignals()
    before = {number: signal.signal(number, signals.on_signal) for number in STOP_SIGNALS}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
