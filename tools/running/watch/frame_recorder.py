"""Listens to the bus while a run goes on, for the raw frames in its log (`log.frames`).

It has an end of the bus of its own, so that it sees everybody's frames, ours as well.  A thread receives into a queue
that is bounded: when the supervisor does not fetch, frames are dropped and counted, nothing grows and nothing waits.

Time stamps are those of the adapter or kernel where they are of this computer's calendar clock, else the moment at
which the thread saw the frame: then a burst may look later than it was, and frames closer than they were.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can

from jointctl.drivers.can.open import SHARED_INTERFACES, open_python_can
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config

QUEUE_FRAMES = 1 << 16  # more than 20 s at 1 kHz
RECEIVE_S = 0.1  # how long the thread waits before it looks whether it is to end
FAILURE_PAUSE_S = 0.05
SAME_CLOCK_S = 5.0


class FrameRecorder:
    """Receives from `bus` until `close`, which also closes the bus."""

    def __init__(self, bus: can.BusABC, queue_frames: int = QUEUE_FRAMES) -> None:
        self._bus = bus
        self._queue: deque[tuple[int, can.Message]] = deque()
        self._queue_frames = queue_frames
        self.dropped = 0
        self._calendar_ns = time.time_ns() - time.monotonic_ns()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="frame recorder", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        while not self._ended.is_set():
            try:
                message = self._bus.recv(RECEIVE_S)
            except (can.CanError, OSError, ValueError):
                # the bus is down: the loop sees it as well and stops the joint, there is nothing to add
                self._ended.wait(FAILURE_PAUSE_S)
                continue
            if message is None:
                continue
            if len(self._queue) >= self._queue_frames:
                self.dropped += 1
                continue
            self._queue.append((self._time_ns(message), message))

    def _time_ns(self, message: can.Message) -> int:
        """CLOCK_MONOTONIC of a message."""
        now_ns = time.monotonic_ns()
        stamp_ns = int(message.timestamp * 1e9) - self._calendar_ns
        return stamp_ns if abs(stamp_ns - now_ns) < SAME_CLOCK_S * 1e9 else now_ns

    def new_frames(self) -> list[tuple[int, Any]]:
        """(CLOCK_MONOTONIC in nanoseconds, message) of every frame since the last call."""
        return [self._queue.popleft() for _ in range(len(self._queue))]

    def close(self) -> None:
        """End the thread and leave the bus; what was received can still be fetched."""
        self._ended.set()
        self._thread.join(2.0)
        self._bus.shutdown()


@contextmanager
def recording(config: Config) -> Iterator[FrameRecorder | None]:
    """A recorder on the configured bus if `log.frames` asks for one; closed at the end."""
    if not config.log.frames:
        yield None
        return
    bus = config.bus
    if config.is_serial:
        raise ConfigurationError(f"{config.path}: log.frames (=true) must be false on a serial line, it has no frames")
    if bus.interface not in SHARED_INTERFACES:
        raise ConfigurationError(
            f"{config.path}: log.frames (=true) must be false over bus.interface (={bus.interface}): "
            "the loop needs the adapter for itself",
            f"these can be shared: {', '.join(SHARED_INTERFACES)}",
        )
    recorder = FrameRecorder(open_python_can(bus.interface, bus.channel, bus.bitrate_bitps))
    try:
        yield recorder
    finally:
        recorder.close()
