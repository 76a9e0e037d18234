"""Objects that are read again and again while the loop runs, asked and answered without waiting.

One SDO upload at a time.  On the bus it costs two frames of the lowest priority but for the heartbeats, which delay a
cycle's frames by one frame at most (0.14 ms at 1 Mbit/s).
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import can
import canopen

from jointctl.drivers.canopen.object_access import ABORT_TEXT

ANSWER_S = 1.0  # how long an answer may take
QUIET_S = 0.05  # no one else may have used the SDO channel for so long: it is one for all masters
_UPLOAD, _ABORT = 0x40, 0x80  # command specifiers of CiA 301, 7.2.4.3
_ANSWERS = 16  # that may wait between two looks; others on the bus may use the same SDO channel


@dataclass
class SdoRead:
    """One object; `on_answer(time_ns, data, problem)` gets its bytes, or None and why."""

    index: int
    sub: int
    period_s: float
    on_answer: Callable[[int, bytes | None, str], None]
    next_ns: int = 0


class SdoReads:
    """Call `poll` often.  It never waits and never raises for what the drive or the bus does."""

    def __init__(
        self, network: canopen.Network, node: canopen.RemoteNode, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._network, self._clock_ns = network, clock_ns
        self._rx, self._tx = node.sdo.rx_cobid, node.sdo.tx_cobid
        self._reads: list[SdoRead] = []
        self._answers: deque[tuple[int, bytes]] = deque(maxlen=_ANSWERS)
        self._open: SdoRead | None = None  # whose answer is waited for
        self._asked_ns = 0
        self._quiet_ns = clock_ns()  # not before
        network.subscribe(self._tx, self._on_frame)

    def add(self, index: int, sub: int, period_s: float, on_answer: Callable[..., None]) -> None:
        """Read it from now on."""
        self._reads.append(SdoRead(index, sub, period_s, on_answer, self._clock_ns()))

    def _on_frame(self, _: int, data: bytearray, __: float) -> None:
        """In the receiving thread; judged in `poll`."""
        self._answers.append((self._clock_ns(), bytes(data)))

    def poll(self, *, may_ask: bool = True) -> None:
        """Take what has come, and ask for what is due."""
        while self._answers:
            came_ns, data = self._answers.popleft()
            if self._open is None or not self._take(self._open, came_ns, data):
                self._quiet_ns = came_ns + round(QUIET_S * 1e9)
        now_ns = self._clock_ns()
        if (read := self._open) is not None and now_ns - self._asked_ns >= ANSWER_S * 1e9:
            self._open = None
            read.on_answer(now_ns, None, f"no answer within {ANSWER_S:g} s")
        if not may_ask or self._open is not None or now_ns < self._quiet_ns:
            return
        due = [read for read in self._reads if read.next_ns <= now_ns]
        if due:
            self._ask(min(due, key=lambda read: read.next_ns), now_ns)

    def _ask(self, read: SdoRead, now_ns: int) -> None:
        read.next_ns = now_ns + round(read.period_s * 1e9)
        try:
            self._network.send_message(self._rx, struct.pack("<BHB4x", _UPLOAD, read.index, read.sub))
        except (can.CanError, OSError):  # the loop sees what is wrong with the bus, and reports it
            return
        self._open, self._asked_ns = read, now_ns

    def _take(self, read: SdoRead, came_ns: int, data: bytes) -> bool:
        """Whether these bytes are the answer of the SDO server to this request."""
        if len(data) != 8 or struct.unpack_from("<HB", data, 1) != (read.index, read.sub):
            return False
        value, problem = None, ""
        if data[0] == _ABORT:
            (code,) = struct.unpack_from("<I", data, 4)
            problem = f"{ABORT_TEXT.get(code, 'refused')} (SDO abort {code:08X}h)"
        elif data[0] & 0xE0 != _UPLOAD:
            return False
        elif data[0] & 2:
            value = data[4 : 4 + (4 - (data[0] >> 2 & 3) if data[0] & 1 else 4)]
        else:
            problem = f"{data.hex()} is no expedited answer"
        self._open = None
        read.on_answer(came_ns, value, problem)
        return True
