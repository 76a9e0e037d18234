"""The virtual drive on any python-can interface: a Python thread carries frames between the bus and the device.

For the two buses that are file descriptors there is the compiled `hil.device_loop`, which answers within microseconds.
This one answers within about a millisecond on an idle computer and within tens of them on a busy one.
"""

from __future__ import annotations

import struct
import threading
import time
from typing import Any

import can
import numpy as np

from jointctl.drivers.can.virtual_bus import decode, encode
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.device_loop import ENDED_WORD, SEND_ERRORS_WORD, STOP_WORD, WORDS

_LONGEST_WAIT_NS = 2_000_000  # timers and the plant move on at least this often
_FRAMES_AT_ONCE = 64  # received before timers are looked at again
_SEND_TIMEOUT_S = 0.01
_ERRORS_IN_A_ROW = 100
_FOREIGN_FRAME = struct.pack("<IB3x8s", 0x7FF, 0, b"")  # means nothing to a drive, but compiles what takes frames
_PAUSE_S = 0.001  # after a failed receive, so that a dead bus does not take a whole core


class PumpedDevice:
    """Runs a device on a python-can bus: `start`, `stop`, or a `with` block, as `RealtimeDevice`; the bus stays the
    caller's.  `words` int64[WORDS]: SEND_ERRORS_WORD counts lost frames, ENDED_WORD is 1 = stopped, 2 = bus gone."""

    def __init__(self, device: Cia402Device, bus: Any) -> None:
        self._device = device
        self._bus = bus
        self.words = np.zeros(WORDS, np.int64)
        self._thread: threading.Thread | None = None

    def _send(self, frames: list[bytes]) -> None:
        for frame in frames:
            message = decode(frame, 0.0, "")
            try:
                self._bus.send(message, _SEND_TIMEOUT_S)
            except (can.CanError, OSError):
                self.words[SEND_ERRORS_WORD] += 1

    def _take(self, message: can.Message) -> None:
        try:
            frame = encode(message)
        except ValueError:  # error frames and CAN FD are nothing to the device
            return
        self._send(self._device.handle(frame, time.monotonic_ns()))

    def _run(self) -> None:
        errors = 0
        while self.words[STOP_WORD] == 0:
            now_ns = time.monotonic_ns()
            self._send(self._device.advance(now_ns))
            wait_ns = min(max(int(self._device.device[0].next_due_ns) - now_ns, 0), _LONGEST_WAIT_NS)
            try:
                message = self._bus.recv(wait_ns * 1e-9)
                for _ in range(_FRAMES_AT_ONCE):
                    if message is None:
                        break
                    self._take(message)
                    message = self._bus.recv(0.0)
                else:
                    if message is not None:
                        self._take(message)
                errors = 0
            except (can.CanError, OSError):
                errors += 1
                if errors >= _ERRORS_IN_A_ROW:
                    self.words[ENDED_WORD] = 2
                    return
                time.sleep(_PAUSE_S)
        self.words[ENDED_WORD] = 1

    def start(self) -> None:
        """Compile if need be, then boot: the boot-up message is sent."""
        if self._thread is not None:
            raise RuntimeError("the device is running already")
        self.words[:] = 0
        self._send(self._device.handle(_FOREIGN_FRAME, time.monotonic_ns()))
        self._thread = threading.Thread(target=self._run, name="device", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the plant stays where it is.  Harmless when not running."""
        if self._thread is None:
            return
        self.words[STOP_WORD] = 1
        self._thread.join()
        self._thread = None

    def __enter__(self) -> PumpedDevice:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
