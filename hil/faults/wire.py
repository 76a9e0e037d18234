"""Controller and drive in lockstep, with the wire of `hil.faults.frame_faults` between them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.device_core import accept_frame
from jointctl.hil.canopen.device_records import int64
from jointctl.hil.faults.frame_faults import pass_frame
from jointctl.hil.faults.kinds import FaultKind


@kernel
def collect(faults: Any, memory: Any, device: Any, outgoing: Any, now_ns: int) -> None:
    """What the drive sent goes through the wire into the controller's mailbox."""
    for index in range(outgoing.count):
        pass_frame(faults, memory, outgoing.frames[index], False, device.node_id, now_ns, memory.to_controller)
    outgoing.count = 0


@kernel
def hand_over(faults: Any, memory: Any, device: Any, plant_c: Any, plant_s: Any, outgoing: Any, now_ns: int) -> None:
    """What came out of the wire at the drive's end is handled, and its answers are sent."""
    ready = memory.ready
    for index in range(ready.count):
        accept_frame(device, plant_c, plant_s, ready.frames[index], now_ns, outgoing)
    ready.count = 0
    collect(faults, memory, device, outgoing, now_ns)


@kernel
def to_drive(
    faults: Any,
    memory: Any,
    frame: np.ndarray,
    device: Any,
    plant_c: Any,
    plant_s: Any,
    outgoing: Any,
    now_ns: int,
) -> None:
    """One frame of the controller goes through the wire."""
    pass_frame(faults, memory, frame, True, device.node_id, now_ns, memory.ready)
    hand_over(faults, memory, device, plant_c, plant_s, outgoing, now_ns)


@kernel
def clock_step_cycles(faults: Any, memory: Any, now_ns: int, period_ns: int) -> int:
    """By how many periods the controller's clock jumps in this cycle."""
    for i in range(len(faults)):
        fault = faults[i]
        if fault.kind == FaultKind.CLOCK_STEP and memory.epoch_ns != 0:
            at_ns = memory.epoch_ns + int64(fault.start_s * 1e9)
            if at_ns <= now_ns < at_ns + period_ns:
                return int64(fault.magnitude * 1e9) // period_ns
    return 0
