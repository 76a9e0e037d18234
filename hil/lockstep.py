"""Deterministic simulation of controller, codec, drive and joint in one compiled function, faster than real time.

The controller's tick, the driver's frame codec and the virtual drive are the very functions of the real-time run;
only the bus is replaced: a frame arrives in the instant in which it was sent, in order, and none is lost.  The
computer's own delay is not modelled either: with a synchronous RPDO (transmission type 1) a command takes effect one
period after the sample it was computed from, as on a real bus whose round trip fits into the period.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_py.axis import step_axis
from firmware_py.kernel import kernel
from firmware_py.realtime import write_log
from firmware_py.states import AxisPhase, StopRequest
from hil.device_core import accept_frame, advance
from hil.frames import FRAME_SIZE

# slots of the frame memory, agreed with whoever passes the codec: sent in begin (up to two), RPDO, received
RPDO_SLOT = 2
RECEIVED_SLOT = 3


@kernel
def _deliver_to_drive(
    device: Any, plant_constants: Any, plant: Any, frame_bytes: np.ndarray, slot: int, now_ns: int, queue: Any
) -> None:
    accept_frame(device, plant_constants, plant, frame_bytes[slot], now_ns, queue)


@kernel
def run_lockstep(
    begin: Any,
    accept: Any,
    end: Any,
    port: np.ndarray,
    frames: np.ndarray,
    frame_bytes: np.ndarray,
    constants: np.ndarray,
    state: np.ndarray,
    table: np.ndarray,
    sample: np.ndarray,
    command: np.ndarray,
    device: np.ndarray,
    plant_constants: np.ndarray,
    plant: np.ndarray,
    queue: np.ndarray,
    log: np.ndarray,
    log_every: int,
    start_ns: int,
    period_ns: int,
    cycles: int,
    stop_cycle: int,
) -> int:
    """Run up to `cycles` cycles or until the axis is FINISHED; returns the number of log records written.

    `begin(port, frames) -> n`, `accept(port, frames, slot, sample, now_ns) -> bool` and
    `end(port, frames, sample, command)` are the driver's codec; `frame_bytes` uint8[slots, 16] is the memory of
    `frames`.  The device has been commissioned and is operational.  Every `log_every`-th cycle goes to `log` while
    there is room (0: none).  A controlled stop is requested at `stop_cycle` (negative: never).
    """
    written = 0
    outgoing = queue[0]
    for cycle in range(cycles):
        now_ns = start_ns + cycle * period_ns
        outgoing.count = 0
        advance(device[0], plant_constants[0], plant[0], now_ns, outgoing)
        count = begin(port, frames)
        for slot in range(count):
            _deliver_to_drive(device[0], plant_constants[0], plant[0], frame_bytes, slot, now_ns, outgoing)
        for index in range(outgoing.count):
            for byte in range(FRAME_SIZE):
                frame_bytes[RECEIVED_SLOT, byte] = outgoing.frames[index, byte]
            accept(port, frames, np.int64(RECEIVED_SLOT), sample, np.int64(now_ns))
        stop = StopRequest.RAMP if 0 <= stop_cycle <= cycle else StopRequest.NONE
        step_axis(constants[0], state[0], table, sample[0], command[0], 1, stop, 0)
        end(port, frames, sample, command)
        outgoing.count = 0
        _deliver_to_drive(device[0], plant_constants[0], plant[0], frame_bytes, RPDO_SLOT, now_ns, outgoing)
        if log_every > 0 and cycle % log_every == 0 and written < len(log):
            write_log(log[written], state[0], sample[0], command[0])
            log[written].time_ns = now_ns
            written += 1
        if state[0].phase == AxisPhase.FINISHED:
            break
    return written
