"""What a program without a compiler does: a python-can loop, and the SYNC producer of the canopen library.

Both run in this process, as they would in a user's script, with the drive disabled and zero torque.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

import can
import canopen
import numpy as np

from jointctl.drivers.can.virtual_bus import VirtualBus
from jointctl.drivers.canopen.identifiers import RPDO1_ID, SYNC_ID, TPDO1_ID
from jointctl.tools.benchmarks.compiled_loops import commissioned
from jointctl.tools.benchmarks.load import load
from jointctl.tools.benchmarks.loop_times import NO_VALUES, LoopTimes, times_from_ns
from jointctl.tools.configuration.config import Config
from jointctl.tools.running.loop.loop_handle import RECEIVE_SHARE


def _frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def run_python_can(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """Absolute deadlines, SYNC, wait for the TPDO, RPDO, with python-can's send and recv; no law is computed."""
    period_ns = round(1e9 / config.loop.rate_Hz)
    node = config.canopen.node
    sync, rpdo = _frame(SYNC_ID), _frame(RPDO1_ID + node, bytes(4))
    cycles = round(seconds * config.loop.rate_Hz)
    rows, done = np.zeros((cycles, 3), np.int64), 0
    with commissioned(config) as (drive, _), VirtualBus(config.bus.channel) as bus, ExitStack() as stack:
        drive.start_cyclic()
        stack.enter_context(load(load_name))
        deadline_ns = time.monotonic_ns() + period_ns
        ended_ns = deadline_ns + round(seconds * 1e9)
        while done < cycles and deadline_ns < ended_ns:  # under load a cycle takes many periods
            row = rows[done]
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
            wake_ns = time.monotonic_ns()
            row[0] = wake_ns - deadline_ns
            deadline_ns += row[0] // period_ns * period_ns
            bus.send(sync)
            started_ns = time.monotonic_ns()
            end_ns = deadline_ns + int(RECEIVE_SHARE * period_ns)
            answer = None
            while (left_ns := end_ns - time.monotonic_ns()) > 0:
                answer = bus.recv(left_ns * 1e-9)
                if answer is None or answer.arbitration_id == TPDO1_ID + node:
                    break
            waited_ns = time.monotonic_ns() - started_ns
            bus.send(rpdo)
            row[1] = waited_ns if answer is not None else -1
            row[2] = time.monotonic_ns() - wake_ns - waited_ns
            deadline_ns += period_ns
            done += 1
    return times_from_ns(rows[:done])


class _StampedBus(VirtualBus):
    """Remembers when each frame was sent."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self.sent_ns: list[int] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent_ns.append(time.monotonic_ns())
        super().send(msg, timeout)


def run_canopen_sync(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """`network.sync.start(period)`: how far each interval between two SYNC frames is off, as the wake-up time."""
    period_s = 1.0 / config.loop.rate_Hz
    bus: Any = _StampedBus(config.bus.channel)
    network: Any = canopen.Network(bus)
    network.connect()
    try:
        network.sync.start(period_s)
        with load(load_name):
            time.sleep(seconds)
        network.sync.stop()
    finally:
        network.disconnect()
        bus.shutdown()
    off_us = np.abs(np.diff(bus.sent_ns) * 1e-3 - period_s * 1e6)
    return LoopTimes(off_us, NO_VALUES, NO_VALUES)
