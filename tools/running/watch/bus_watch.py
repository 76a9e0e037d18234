"""Looks after a SocketCAN interface while a run goes on: what its controller complains about, and why sending failed.

A socket of its own receives error frames and nothing else, so that it costs nothing on a healthy bus.  The program `ip`
is asked only when the run is over: it may take longer than the supervisor may be silent.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from jointctl.drivers.can import socketcan
from jointctl.drivers.can.frames import FRAME_STRUCT
from jointctl.drivers.can.socketcan import error_frame_text, link_problem, link_state, send_problem, trouble
from jointctl.drivers.errors import BusError
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.running.events.fault_text import FaultText

_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_FRAMES_AT_ONCE = 200
# faults that a sick bus explains
BUS_FAULTS = frozenset({
    Fault.BUS_ERROR, Fault.STALE_SAMPLE, Fault.NO_SAMPLES, Fault.SAMPLES_MISSING, Fault.DRIVE_FAULT,
    Fault.ENABLE_TIMEOUT,
})  # fmt: skip
_CURES = {
    "bus-off": "a short, missing termination or a wrong bit rate",
    "error passive": "nobody acknowledges, or the bit rate is wrong: power of the drive, wiring, termination",
    "no acknowledge": "nobody else is on the bus: power of the drive, wiring, bit rate",
    "transmit time-out": "the bus is blocked: wiring, termination",
    "buffer overflow": "the adapter is too slow for this bus load",
    "bus error": "wiring, termination (60 ohm between H and L), bit rate",
}


class BusWatch:
    """`end` is a raw CAN socket, non-blocking; None on any other bus, where there is nothing to watch."""

    def __init__(self, config: Config, end: socket.socket | None) -> None:
        self._channel = config.bus.channel
        self._bitrate_bitps = config.bus.bitrate_bitps
        self._end = end
        self._told: set[str] = set()

    def news(self) -> list[str]:
        """Troubles that the controller has reported since the last call, each kind once in a run."""
        if self._end is None:
            return []
        news = []
        for _ in range(_FRAMES_AT_ONCE):
            try:
                identifier, _, data = FRAME_STRUCT.unpack(self._end.recv(FRAME_STRUCT.size))
            except (OSError, struct.error):  # nothing waits, or the interface has gone, which the loop sees as well
                break
            kind = trouble(identifier, data)
            if kind and kind not in self._told:
                self._told.add(kind)
                news.append(f"{self._channel}: {error_frame_text(identifier, data)} ({_CURES[kind]})")
        return news

    def explained(self, fault: Fault, text: FaultText | None, last_errno: int) -> FaultText | None:
        """The text of a fault with the interface's own trouble as its cause, if it has any."""
        if self._end is None or text is None:
            return text
        link = link_state(self._channel)
        problem = link_problem(link, self._bitrate_bitps) if link is not None else None
        if problem is None and last_errno:
            problem = send_problem(self._channel, last_errno)
        if problem is None:
            return text
        # late or missing samples also look like a fast or a jumping joint
        cause = problem[0] if fault in BUS_FAULTS else f"{problem[0]}, so that samples were late; or {text.cause}"
        return replace(text, cause=cause, next_step=problem[1])


@contextmanager
def bus_watch(config: Config) -> Iterator[BusWatch]:
    """On SocketCAN a listening end; elsewhere, or where it cannot be opened, one that sees nothing."""
    with contextlib.ExitStack() as stack:
        end = None
        if config.bus.interface == "socketcan":
            with contextlib.suppress(BusError, OSError):  # the drive's own end is about to tell why
                end = stack.enter_context(socketcan.open_socket(config.bus.channel))
                end.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")
        yield BusWatch(config, end)
