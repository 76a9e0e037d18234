"""Faults on purpose: which fault, when, for how long, how much.

A fault is a record `FaultConstants`; the faults of a joint are an array of them, and `FaultMemory` is what they share.
Times count from `FaultMemory.epoch_ns`: the start of a run, or, while that is 0, the first time that the power stage
is on.  Chance comes from a xorshift64 generator in the memory, so that a run repeats bit by bit.

They are carried out by `hil.faults`.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Any

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import array_of, dtype_of, f8, i4, i8, new, record, u1
from jointctl.hil.plant import next_state, unit_number
from jointctl.hil.plant_records import u8
from jointctl.hil.virtual_bus import FRAME_SIZE, FrameQueue

MAX_FAULTS = 8
LATE_FRAMES = 256  # that wait in the delay line; more are lost


class FaultKind(IntEnum):
    """What goes wrong.  In brackets: the meaning of the magnitude."""

    NONE = 0
    FRAMES_LOST = 1  # both ways, whatever they are [share of the frames]
    SYNC_LOST = 2  # [share]
    RPDO_LOST = 3  # [share]
    TPDO_LOST = 4  # [share]
    CONTROLLER_HEARTBEAT_LOST = 5  # [share]
    DRIVE_HEARTBEAT_LOST = 6  # [share]
    RPDO_DELAYED = 7  # [s]
    TPDO_DELAYED = 8  # [s]
    RPDO_DUPLICATED = 9  # [share]
    TPDO_DUPLICATED = 10  # [share]
    RPDO_REORDERED = 11  # each with the next one [share]
    TPDO_REORDERED = 12  # [share]
    RPDO_CORRUPTED = 13  # every byte drawn anew [share]
    TPDO_CORRUPTED = 14  # [share]
    RPDO_LENGTH = 15  # another length [bytes]
    TPDO_LENGTH = 16  # [bytes]
    FOREIGN_FRAMES = 17  # of other nodes, in the controller's mailbox [frames before each TPDO]
    BUS_OFF = 18  # of the controller: nothing leaves, nothing arrives
    DRIVE_REBOOT = 19  # once, at the beginning
    DRIVE_FAULT = 20  # [EMCY error code]
    ENCODER_STUCK = 21
    ENCODER_JUMP = 22  # [rad at the joint]
    ENCODER_DRIFT = 23  # [rad/s at the joint]
    ENCODER_REVERSED = 24  # the direction of counting, from the present angle on
    TORQUE_REVERSED = 25  # the sign of the target torque
    TORQUE_SATURATED = 26  # the motor yields no more than this [Nm at the joint]
    CURRENT_LOOP_DEAD = 27  # no current whatever is asked for
    LOAD_JUMP = 28  # added load, positive against positive motion [Nm at the joint]
    LOOP_HELD_UP = 29  # the controller gets no processor; lockstep only
    CLOCK_STEP = 30  # the controller's clock jumps ahead, once; lockstep only [s]
    SUPERVISOR_SILENT = 31  # lockstep only
    PROGRAM_SILENT = 32  # that sends set-points; lockstep only
    PROGRAM_WILD = 33  # its set-points are that far off; lockstep only [rad, or NaN]


LOCKSTEP_ONLY = (
    FaultKind.LOOP_HELD_UP, FaultKind.CLOCK_STEP, FaultKind.SUPERVISOR_SILENT, FaultKind.PROGRAM_SILENT,
    FaultKind.PROGRAM_WILD,
)  # fmt: skip


@record
class FaultConstants:
    kind: i4  # FaultKind
    start_s: f8
    duration_s: f8
    magnitude: f8
    seed: i8


@record
class FaultMemory:
    """State of all faults of one joint; `ready` is the queue for what comes out of the wire."""

    epoch_ns: i8  # 0 = not yet: the first cycle with the power stage on sets it
    last_ns: i8  # of the last `step_faults`
    random: u8  # xorshift64, never 0
    was_active: Annotated[np.ndarray, array_of(i4, MAX_FAULTS)]
    late_count: i4
    late_lost: i8
    late_due_ns: Annotated[np.ndarray, array_of(i8, LATE_FRAMES)]  # 0 = after the next frame of this direction
    late_to_drive: Annotated[np.ndarray, array_of(i4, LATE_FRAMES)]
    late_frames: Annotated[np.ndarray, array_of(u1, LATE_FRAMES, FRAME_SIZE)]
    affected: i8  # frames that were lost, late, doubled or changed
    ready: FrameQueue
    to_controller: FrameQueue  # lockstep: the controller's mailbox


def fault_memory(faults: np.ndarray, epoch_ns: int = 0) -> Any:
    """A record array of one `FaultMemory` for these faults; at most MAX_FAULTS of them."""
    if len(faults) > MAX_FAULTS:
        raise ValueError(f"number of faults (={len(faults)}) must be in [0..{MAX_FAULTS}]")
    memory = new(FaultMemory)
    memory[0].epoch_ns = epoch_ns
    memory[0].random = 0x9E3779B97F4A7C15 ^ (int(faults[0].seed) if len(faults) else 0) or 1
    return memory


def no_faults() -> Any:
    """An empty record array of `FaultConstants`."""
    return np.zeros(0, dtype_of(FaultConstants)).view(np.recarray)


@kernel
def draw(memory: FaultMemory) -> float:
    """The next number in [0, 1)."""
    x = next_state(memory.random)
    memory.random = x  # type: ignore[assignment]
    return unit_number(x)


@kernel
def is_active(fault: FaultConstants, memory: FaultMemory, now_ns: int) -> bool:
    """Whether the fault is present: start_s <= time since the epoch < start_s + duration_s."""
    if memory.epoch_ns == 0:
        return False
    time_s = (now_ns - memory.epoch_ns) * 1e-9
    return fault.start_s <= time_s and time_s < fault.start_s + fault.duration_s


@kernel
def kind_active(faults: np.ndarray, memory: FaultMemory, kind: int, now_ns: int) -> bool:
    """Whether any fault of this kind is present."""
    found = False
    for i in range(len(faults)):  # numba knows no any() over a generator
        if faults[i].kind == kind and is_active(faults[i], memory, now_ns):
            found = True
    return found
