"""A small drive that is the bus itself, and a clock that only moves when it is asked."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from typing import Any

import can

from jointctl.tools.session.loop_handle import SharedBlock
from jointctl.tools.session.portable_loop import run_portable_loop

PERIOD_NS = 1_000_000
RECEIVE_NS = 600_000
SYNC, RPDO, TPDO, OWN_HEARTBEAT = 0x80, 0x201, 0x181, 0x77E
LIMIT = 8  # failed cycles in a row that are allowed
NEXT_STATUS = {(0x40, 6): 0x21, (0x21, 7): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x0F): 0x27, (0x27, 2): 0x40}


class DriveBus:
    """A bus with one drive at rest: RPDOs take effect at the SYNC, which it answers with its TPDO."""

    def __init__(self, echo: bool = False) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.waiting: deque[can.Message] = deque()
        self.status = 0x40
        self.control = 0
        self.syncs = 0
        self.powered_syncs = 0
        self.echo = echo
        self.on_send: Callable[[DriveBus, int], None] = lambda bus, identifier: None
        self.on_recv: Callable[[DriveBus], None] = lambda bus: None

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        identifier, data = message.arbitration_id, bytes(message.data)
        if identifier == SYNC:
            self.syncs += 1
            self.powered_syncs += self.status == 0x27
        self.on_send(self, identifier)
        self.sent.append((identifier, data))
        if self.echo:
            self.waiting.append(message)
        if identifier == RPDO:
            self.control = struct.unpack_from("<H", data)[0]
        elif identifier == SYNC:
            self.status = NEXT_STATUS.get((self.status, self.control), 0x40 if self.control == 0 else self.status)
            self.waiting.append(frame(TPDO, struct.pack("<Hih", self.status, 0, 0)))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.on_recv(self)
        return self.waiting.popleft() if self.waiting else None

    def count(self, identifier: int) -> int:
        return sum(sent == identifier for sent, _ in self.sent)


def frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)


class Clock:
    """Time that passes while the loop sleeps, and a little with every look at it: a busy computer changes nothing."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)

    def sleep_until_ns(self, deadline_ns: int, _: Any) -> None:
        self.now_ns = max(self.now_ns, deadline_ns)


def run(bus: DriveBus, block: SharedBlock, max_cycles: int = 5000) -> int:
    return run_portable_loop(bus, block, PERIOD_NS, RECEIVE_NS, max_cycles)
