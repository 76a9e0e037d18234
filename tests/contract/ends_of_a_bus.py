"""Ends of a bus behind one face: the raw end of the control loop, and python-can."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Protocol

import can
import numpy as np

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.can.open import open_cyclic_end
from jointctl.drivers.canopen.exchange import receive_frame, send_frame
from jointctl.firmware_py.libc import WAIT_SCRATCH_WORDS, wait_readable_ns
from jointctl.firmware_py.schema import new
from tests.python_process import eventually

LONG_S = 60.0  # far more than is ever needed: a limit against hanging, not a measure of speed
SHORT_S = 0.05
EXTENDED, REMOTE = 0x80000000, 0x40000000


class End(Protocol):
    def send(self, identifier: int, data: bytes = b"") -> bool: ...
    def receive(self, timeout_s: float = LONG_S) -> tuple[int, bytes] | None: ...
    def close(self) -> None: ...


class RawEnd:
    """The socket and the kernels of the compiled loop."""

    def __init__(self, path: Path) -> None:
        self.socket = open_cyclic_end("jointctl", str(path))
        self.frames, self.scratch = new(Frame, 2), np.zeros(WAIT_SCRATCH_WORDS, np.int64)

    def send(self, identifier: int, data: bytes = b"") -> bool:
        self.frames["can_id"][0] = identifier
        self.frames["length"][0] = len(data)
        self.frames["payload"][0, : len(data)] = list(data)
        code = send_frame(self.socket.fileno(), self.frames, 0)
        assert code in (0, errno.EAGAIN)
        return code == 0

    def receive(self, timeout_s: float = LONG_S) -> tuple[int, bytes] | None:
        wait_readable_ns(self.socket.fileno(), round(timeout_s * 1e9), self.scratch)
        got = receive_frame(self.socket.fileno(), self.frames, 1)
        if got < 0:
            raise OSError(-got, "receive_frame")
        length = int(self.frames["length"][1])
        return (int(self.frames["can_id"][1]), self.frames["payload"][1, :length].tobytes()) if got else None

    def close(self) -> None:
        self.socket.close()


class PythonCanEnd:
    """Any python-can bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus

    def send(self, identifier: int, data: bytes = b"") -> bool:
        message = can.Message(
            arbitration_id=identifier & 0x1FFFFFFF,
            is_extended_id=bool(identifier & EXTENDED),
            is_remote_frame=bool(identifier & REMOTE),
            data=data,
        )
        try:
            self.bus.send(message)
        except can.CanOperationError as error:
            if "full" not in str(error):
                raise
            return False
        return True

    def receive(self, timeout_s: float = LONG_S) -> tuple[int, bytes] | None:
        message = self.bus.recv(timeout_s)
        if message is None:
            return None
        flags = (EXTENDED if message.is_extended_id else 0) | (REMOTE if message.is_remote_frame else 0)
        return message.arbitration_id | flags, bytes(message.data)

    def close(self) -> None:
        self.bus.shutdown()


def send_surely(end: End, identifier: int, data: bytes = b"") -> None:
    eventually(lambda: end.send(identifier, data), LONG_S)
