"""Listeners of the driver on its bus: one that outlives a bus that fails, and one for another controller."""

from __future__ import annotations

from collections.abc import Callable

import can
import canopen

from drivers.canopen.identifiers import SYNC_ID
from drivers.errors import BusError

LISTEN_S = 0.05  # five SYNC periods of the slowest loop
FAILURE_PAUSE_S = 0.05


class BusFailure(can.Listener):
    """Keeps a bus that fails from ending the receiving thread with a traceback; whoever sends next is told."""

    def __init__(self, sleep: Callable[[float], None]) -> None:
        self._sleep = sleep

    def on_message_received(self, msg: can.Message) -> None:
        """Messages are for the other listeners."""

    def on_error(self, exc: Exception) -> None:
        """The thread receives again at once: a dead bus must not make it spin."""
        self._sleep(FAILURE_PAUSE_S)


def refuse_second_controller(network: canopen.Network, sleep: Callable[[float], None]) -> None:
    """Who sends SYNC controls a joint on this bus: two of them would fight over the same drive (`BusError`)."""
    seen: list[float] = []

    def on_sync(_: int, data: bytearray, timestamp_s: float) -> None:
        seen.append(timestamp_s)

    network.subscribe(SYNC_ID, on_sync)
    sleep(LISTEN_S)
    network.unsubscribe(SYNC_ID, on_sync)
    if seen:
        raise BusError(
            f"another controller is active on this bus: {len(seen)} SYNC frames (080h) in {LISTEN_S:g} s",
            hint="end it first; only one controller may use the bus",
        )
