"""Faults on purpose: of the wire between controller and drive, of drive, encoder, motor and load.

`pass_frame` takes each frame and appends what arrives to a queue: nothing, the frame, the frame twice, a damaged one;
frames that are late wait in the memory until `take_due`.  CAN's own checksum finds nearly every damaged frame: the
corrupted and shortened ones stand for a faulty gateway, adapter or drive.
Not modelled: error frames, the error counters of CAN.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, Any

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import array_of, dtype_of, f8, i4, i8, new, record, u1
from jointctl.hil.canopen.device_core import accept_frame, restart
from jointctl.hil.canopen.records import Device, PowerState, int64
from jointctl.hil.plant import next_state, shaft_position_rad, unit_number
from jointctl.hil.plant_records import PlantConstants, PlantState, u8
from jointctl.hil.virtual_bus import FRAME_SIZE, QUEUE_LENGTH, FrameQueue

# --- Which fault, when, for how long, how much ---
#
# A fault is a record `FaultConstants`; the faults of a joint are an array of them, and `FaultMemory` is what they
# share.  Times count from `FaultMemory.epoch_ns`: the start of a run, or, while that is 0, the first time that the
# power stage is on.  Chance comes from a xorshift64 generator in the memory, so that a run repeats bit by bit.

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
    STOP_REQUESTED = 34  # no fault: the supervisor passes it on; lockstep only [StopRequest]
    LOOP_KILLED = 35  # it does nothing more; lockstep only


LOCKSTEP_ONLY = tuple(kind for kind in FaultKind if kind >= FaultKind.LOOP_HELD_UP)


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
    late_due_ns: Annotated[np.ndarray, array_of(i8, LATE_FRAMES)]  # 0 = after the next frame of this direction
    late_to_drive: Annotated[np.ndarray, array_of(i4, LATE_FRAMES)]
    late_frames: Annotated[np.ndarray, array_of(u1, LATE_FRAMES, FRAME_SIZE)]
    ready: FrameQueue
    to_controller: FrameQueue  # lockstep: the controller's mailbox


def fault_memory(faults: np.ndarray, epoch_ns: int = 0, axis: int = 0) -> Any:
    """A record array of one `FaultMemory` for these faults of this axis; at most MAX_FAULTS of them.

    Seed and axis are hashed: states of xorshift64 that differ in few bits yield numbers that differ little at first.
    """
    if len(faults) > MAX_FAULTS:
        raise ValueError(f"number of faults (={len(faults)}) must be in [0..{MAX_FAULTS}]")
    memory = new(FaultMemory)
    memory[0].epoch_ns = epoch_ns
    seed = int(faults[0].seed) if len(faults) else 0
    memory[0].random = np.random.SeedSequence((seed, axis)).generate_state(1, np.uint64)[0] or 1
    return memory


def no_faults() -> Any:
    """An empty record array of `FaultConstants`."""
    return np.zeros(0, dtype_of(FaultConstants)).view(np.recarray)


def fault_rows(of_axes: Sequence[np.ndarray], epoch_ns: int = 0) -> tuple[Any, Any]:
    """The faults of each axis as FaultConstants[axes, M], filled up with none, and its FaultMemory[axes]."""
    rows = np.zeros((len(of_axes), max(map(len, of_axes))), dtype_of(FaultConstants)).view(np.recarray)
    memories = new(FaultMemory, len(of_axes))
    for axis, faults in enumerate(of_axes):
        rows[axis, : len(faults)] = faults
        memories[axis] = fault_memory(faults, epoch_ns, axis)[0]
    return rows, memories


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


# --- Controller and drives in lockstep, with the wires between them; rows and memories have one element an axis ---


@kernel
def any_active(rows: np.ndarray, memories: np.ndarray, kind: int, now_ns: int) -> bool:
    """Whether a fault of this kind is present at any axis."""
    found = False
    for axis in range(len(rows)):
        found = found or kind_active(rows[axis], memories[axis], kind, now_ns)
    return found


@kernel
def stop_requested(rows: np.ndarray, memories: np.ndarray, now_ns: int) -> int:
    """The strongest `StopRequest` so far."""
    request = 0
    for axis in range(len(rows)):
        for i in range(rows.shape[1]):
            fault = rows[axis, i]
            if fault.kind == FaultKind.STOP_REQUESTED and is_active(fault, memories[axis], now_ns):
                request = max(request, int64(fault.magnitude))
    return request


@kernel
def clock_step_cycles(rows: np.ndarray, memories: np.ndarray, now_ns: int, period_ns: int) -> int:
    """By how many periods the controller's clock jumps in this cycle."""
    cycles = 0
    for axis in range(len(rows)):
        epoch_ns = int64(memories[axis].epoch_ns)
        for i in range(rows.shape[1]):
            fault = rows[axis, i]
            if fault.kind == FaultKind.CLOCK_STEP and epoch_ns != 0:
                at_ns = epoch_ns + int64(fault.start_s * 1e9)
                if at_ns <= now_ns < at_ns + period_ns:
                    cycles += int64(fault.magnitude * 1e9) // period_ns
    return cycles


@kernel
def collect(faults: np.ndarray, memory: FaultMemory, device: Device, outgoing: FrameQueue, now_ns: int) -> None:
    """What the drive sent goes through the wire into the controller's mailbox."""
    for index in range(outgoing.count):
        pass_frame(faults, memory, outgoing.frames[index], False, device.node_id, now_ns, memory.to_controller)
    outgoing.count = 0


@kernel
def hand_over(
    faults: np.ndarray,
    memory: FaultMemory,
    device: Device,
    plant_c: PlantConstants,
    plant_s: PlantState,
    outgoing: FrameQueue,
    now_ns: int,
) -> None:
    """What came out of the wire at the drive's end is handled, and its answers are sent."""
    ready = memory.ready
    for index in range(ready.count):
        accept_frame(device, plant_c, plant_s, ready.frames[index], now_ns, outgoing)
    ready.count = 0
    collect(faults, memory, device, outgoing, now_ns)


@kernel
def to_drive(
    faults: np.ndarray,
    memory: FaultMemory,
    frame: np.ndarray,
    device: Device,
    plant_c: PlantConstants,
    plant_s: PlantState,
    outgoing: FrameQueue,
    now_ns: int,
) -> None:
    """One frame of the controller goes through the wire."""
    pass_frame(faults, memory, frame, True, device.node_id, now_ns, memory.ready)
    hand_over(faults, memory, device, plant_c, plant_s, outgoing, now_ns)


# --- What becomes of a frame between controller and drive while faults of the wire are present ---


class FrameClass(IntEnum):
    """What a frame is, between this drive and its controller."""

    OTHER = 0
    SYNC = 1
    RPDO = 2
    TPDO = 3
    CONTROLLER_HEARTBEAT = 4
    DRIVE_HEARTBEAT = 5


@kernel
def frame_class(frame: np.ndarray, to_drive: bool, node_id: int) -> FrameClass:
    """By identifier and direction; the predefined connection set of CiA 301."""
    identifier = int64(frame[0]) | int64(frame[1]) << 8
    if to_drive:
        if identifier == 0x80:
            return FrameClass.SYNC
        if identifier == 0x200 + node_id or identifier == 0x300 + node_id:
            return FrameClass.RPDO
        if identifier > 0x700 and identifier <= 0x77F:
            return FrameClass.CONTROLLER_HEARTBEAT
        return FrameClass.OTHER
    if identifier == 0x180 + node_id:
        return FrameClass.TPDO
    if identifier == 0x700 + node_id:
        return FrameClass.DRIVE_HEARTBEAT
    return FrameClass.OTHER


@kernel
def append_frame(queue: FrameQueue, frame: np.ndarray) -> int:
    """Copy a frame to the end of a queue; its slot, or -1 when full."""
    slot = int64(queue.count)
    if slot >= QUEUE_LENGTH:
        return -1
    for i in range(FRAME_SIZE):
        queue.frames[slot, i] = frame[i]
    queue.count = slot + 1
    return slot


@kernel
def _unstamp(frame: np.ndarray) -> None:
    """A frame that the wire makes late or doubles shall count when it comes: see `hil.bus_timing`."""
    for i in range(5, 8):
        frame[i] = 0


@kernel
def _damage(memory: FaultMemory, frame: np.ndarray, corrupted: bool, length: int) -> None:
    """Change what arrives: every byte drawn anew, another length (negative: its own)."""
    if corrupted:
        for i in range(int64(frame[4])):
            frame[8 + i] = int64(draw(memory) * 256.0)
    if length >= 0:
        frame[4] = length


@kernel
def _keep(memory: FaultMemory, frame: np.ndarray, to_drive: bool, due_ns: int, corrupted: bool, length: int) -> None:
    slot = int64(memory.late_count)
    if slot >= LATE_FRAMES:
        return
    memory.late_due_ns[slot] = due_ns
    memory.late_to_drive[slot] = 1 if to_drive else 0
    for i in range(FRAME_SIZE):
        memory.late_frames[slot, i] = frame[i]
    _unstamp(memory.late_frames[slot])
    _damage(memory, memory.late_frames[slot], corrupted, length)
    memory.late_count = slot + 1


@kernel
def take_due(memory: FaultMemory, to_drive: bool, now_ns: int, after_next: bool, queue: FrameQueue) -> None:
    """Move late frames of one direction to `queue`: those due by now, or (`after_next`) those that were overtaken."""
    kept = 0
    wanted = 1 if to_drive else 0
    for slot in range(memory.late_count):
        due_ns = int64(memory.late_due_ns[slot])
        ready = due_ns == 0 if after_next else (due_ns != 0 and due_ns <= now_ns)
        if ready and memory.late_to_drive[slot] == wanted:
            append_frame(queue, memory.late_frames[slot])
            continue
        memory.late_due_ns[kept] = due_ns
        memory.late_to_drive[kept] = memory.late_to_drive[slot]
        for i in range(FRAME_SIZE):
            memory.late_frames[kept, i] = memory.late_frames[slot, i]
        kept += 1
    memory.late_count = kept


@kernel
def _one_waits(memory: FaultMemory, to_drive: bool) -> bool:
    """Whether a frame of this direction waits to be overtaken by the next."""
    wanted = 1 if to_drive else 0
    for slot in range(memory.late_count):
        if memory.late_due_ns[slot] == 0 and memory.late_to_drive[slot] == wanted:
            return True
    return False


@kernel
def _concerned(kind: int, of: int) -> bool:
    """Whether a fault of this kind acts on frames of this class."""
    if kind == FaultKind.FRAMES_LOST or kind == FaultKind.BUS_OFF:
        return True
    if kind == FaultKind.SYNC_LOST:
        return of == FrameClass.SYNC
    if kind == FaultKind.CONTROLLER_HEARTBEAT_LOST:
        return of == FrameClass.CONTROLLER_HEARTBEAT
    if kind == FaultKind.DRIVE_HEARTBEAT_LOST:
        return of == FrameClass.DRIVE_HEARTBEAT
    if kind == FaultKind.FOREIGN_FRAMES:
        return of == FrameClass.TPDO
    if kind == FaultKind.RPDO_LOST:
        return of == FrameClass.RPDO
    if kind == FaultKind.TPDO_LOST:
        return of == FrameClass.TPDO
    if kind >= FaultKind.RPDO_DELAYED and kind <= FaultKind.TPDO_LENGTH:
        return of == (FrameClass.RPDO if (kind - FaultKind.RPDO_DELAYED) % 2 == 0 else FrameClass.TPDO)
    return False


@kernel
def _foreign(memory: FaultMemory, count: int, node_id: int, queue: FrameQueue) -> None:
    """Frames of other nodes, with every data byte at random: PDOs, EMCY, heartbeats and boot-ups."""
    for _ in range(count):
        slot = int64(queue.count)
        if slot >= QUEUE_LENGTH:
            return
        other = 1 + int64(draw(memory) * 124.0)  # not 126, the controller's own by default (drive.master_node)
        if other >= node_id:
            other += 1
        base = (0x80, 0x180, 0x200, 0x280, 0x380, 0x580, 0x700)[int64(draw(memory) * 7.0)]
        for i in range(FRAME_SIZE):
            queue.frames[slot, i] = 0
        identifier = base + other
        queue.frames[slot, 0] = identifier & 0xFF
        queue.frames[slot, 1] = identifier >> 8
        length = int64(draw(memory) * 9.0)
        queue.frames[slot, 4] = length
        for i in range(length):
            queue.frames[slot, 8 + i] = int64(draw(memory) * 256.0)
        queue.count = slot + 1


@kernel
def pass_frame(
    faults: np.ndarray,
    memory: FaultMemory,
    frame: np.ndarray,
    to_drive: bool,
    node_id: int,
    now_ns: int,
    queue: FrameQueue,
) -> None:
    """Send one frame (uint8[16]) through the wire; what arrives now is appended to `queue`."""
    of = frame_class(frame, to_drive, node_id)
    lost, twice, overtaken, corrupted, length, late_ns = False, False, False, False, -1, 0
    for i in range(len(faults)):
        fault = faults[i]
        kind = fault.kind
        if not _concerned(kind, of) or not is_active(fault, memory, now_ns):
            continue
        if kind == FaultKind.BUS_OFF:
            lost = True
        elif kind == FaultKind.FOREIGN_FRAMES:
            _foreign(memory, int64(fault.magnitude), node_id, queue)
        elif kind == FaultKind.RPDO_DELAYED or kind == FaultKind.TPDO_DELAYED:
            late_ns = int64(fault.magnitude * 1e9)
        elif kind == FaultKind.RPDO_LENGTH or kind == FaultKind.TPDO_LENGTH:
            length = int64(fault.magnitude)
        elif draw(memory) < fault.magnitude:
            if kind <= FaultKind.DRIVE_HEARTBEAT_LOST:
                lost = True
            elif kind <= FaultKind.TPDO_DUPLICATED:
                twice = True
            elif kind <= FaultKind.TPDO_REORDERED:
                overtaken = True
            else:
                corrupted = True
    if lost:
        return
    if late_ns > 0:
        _keep(memory, frame, to_drive, now_ns + late_ns, corrupted, length)
        return
    if overtaken and not _one_waits(memory, to_drive):
        _keep(memory, frame, to_drive, 0, corrupted, length)
        return
    slot = append_frame(queue, frame)
    if slot >= 0:
        _damage(memory, queue.frames[slot], corrupted, length)
    if twice and slot >= 0:
        slot = append_frame(queue, queue.frames[slot])
        if slot >= 0:
            _unstamp(queue.frames[slot])
    if memory.late_count > 0:
        take_due(memory, to_drive, now_ns, True, queue)


# --- Faults of drive, encoder, motor and load: `step_faults` puts them into the records of device and plant ---
# The encoder's faults are those of the position that the controller reads.  The virtual drive brakes by the plant's own
# velocity, as a drive does that has a second, healthy encoder on the motor.


@kernel
def _begin(fault: FaultConstants, device: Device, plant_c: PlantConstants, plant_s: PlantState) -> None:
    kind = fault.kind
    if kind == FaultKind.DRIVE_REBOOT:
        restart(device, True)
    elif kind == FaultKind.DRIVE_FAULT:
        device.inject_fault_code = int64(fault.magnitude)
    elif kind == FaultKind.ENCODER_STUCK:
        plant_s.encoder_stuck_rad = shaft_position_rad(plant_c, plant_s)
        plant_s.encoder_stuck = 1
    elif kind == FaultKind.ENCODER_JUMP:
        plant_s.encoder_error_rad += fault.magnitude
    elif kind == FaultKind.ENCODER_REVERSED:
        plant_s.encoder_pivot_rad = shaft_position_rad(plant_c, plant_s)
        plant_s.encoder_reversed = 1
    elif kind == FaultKind.TORQUE_REVERSED:
        device.torque_reversed = 1
    elif kind == FaultKind.TORQUE_SATURATED:
        plant_s.current_capped = 1
        plant_s.current_cap_A = fault.magnitude * plant_c.current_per_torque_ApNm
    elif kind == FaultKind.CURRENT_LOOP_DEAD:
        plant_s.current_capped = 1
        plant_s.current_cap_A = 0.0
    elif kind == FaultKind.LOAD_JUMP:
        plant_s.added_load_torque_Nm += fault.magnitude


@kernel
def _end(fault: FaultConstants, device: Device, plant_s: PlantState) -> None:
    kind = fault.kind
    if kind == FaultKind.DRIVE_FAULT:
        device.inject_fault_code = 0
    elif kind == FaultKind.ENCODER_STUCK:
        plant_s.encoder_stuck = 0
    elif kind == FaultKind.ENCODER_JUMP:
        plant_s.encoder_error_rad -= fault.magnitude
    elif kind == FaultKind.ENCODER_REVERSED:
        plant_s.encoder_reversed = 0
    elif kind == FaultKind.TORQUE_REVERSED:
        device.torque_reversed = 0
    elif kind == FaultKind.TORQUE_SATURATED or kind == FaultKind.CURRENT_LOOP_DEAD:
        plant_s.current_capped = 0
    elif kind == FaultKind.LOAD_JUMP:
        plant_s.added_load_torque_Nm -= fault.magnitude


@kernel
def step_faults(
    faults: np.ndarray, memory: FaultMemory, device: Device, plant_c: PlantConstants, plant_s: PlantState, now_ns: int
) -> None:
    """Begin and end the faults of drive and plant that are due; call it before the device advances to `now_ns`.

    An earlier time than the last one is taken for that: time does not go back.
    """
    now_ns = max(now_ns, int64(memory.last_ns))
    if memory.epoch_ns == 0 and device.state == PowerState.OPERATION_ENABLED:
        memory.epoch_ns = now_ns
    for i in range(len(faults)):
        fault = faults[i]
        active = is_active(fault, memory, now_ns)
        if active and memory.was_active[i] == 0:
            memory.was_active[i] = 1
            memory.last_ns = now_ns
            _begin(fault, device, plant_c, plant_s)
        elif active and fault.kind == FaultKind.ENCODER_DRIFT:
            plant_s.encoder_error_rad += fault.magnitude * (now_ns - memory.last_ns) * 1e-9
        elif not active and memory.was_active[i] != 0:
            memory.was_active[i] = 0
            _end(fault, device, plant_s)
    memory.last_ns = now_ns
