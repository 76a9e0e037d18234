"""Faults on purpose: of the wire between controller and drive, of drive, encoder, motor and load.

`pass_frame` takes each frame and appends what arrives to a queue: nothing, the frame, the frame twice, a damaged one;
frames that are late wait in the memory until `take_due`.  CAN's own checksum finds nearly every damaged frame: the
corrupted and shortened ones stand for a faulty gateway, adapter or drive.
Not modelled: error frames, the error counters of CAN."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.device_core import accept_frame, restart
from jointctl.hil.canopen.records import Device, PowerState, int64
from jointctl.hil.fault_kinds import LATE_FRAMES, FaultConstants, FaultKind, FaultMemory, draw, is_active
from jointctl.hil.plant import shaft_position_rad
from jointctl.hil.plant_records import PlantConstants, PlantState
from jointctl.hil.virtual_bus import FRAME_SIZE, QUEUE_LENGTH, FrameQueue

# --- Controller and drive in lockstep, with the wire between them ---


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


@kernel
def clock_step_cycles(faults: np.ndarray, memory: FaultMemory, now_ns: int, period_ns: int) -> int:
    """By how many periods the controller's clock jumps in this cycle."""
    for i in range(len(faults)):
        fault = faults[i]
        if fault.kind == FaultKind.CLOCK_STEP and memory.epoch_ns != 0:
            at_ns = memory.epoch_ns + int64(fault.start_s * 1e9)
            if at_ns <= now_ns < at_ns + period_ns:
                return int64(fault.magnitude * 1e9) // period_ns
    return 0


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
        queue.overflowed += 1
        return -1
    for i in range(FRAME_SIZE):
        queue.frames[slot, i] = frame[i]
    queue.count = slot + 1
    return slot


@kernel
def _unstamp(frame: np.ndarray) -> None:
    """A frame that the wire makes late or doubles shall count when it comes: see `hil.frame_stamps`."""
    for i in range(5, 8):
        frame[i] = 0


@kernel
def _keep(memory: FaultMemory, frame: np.ndarray, to_drive: bool, due_ns: int) -> None:
    slot = int64(memory.late_count)
    if slot >= LATE_FRAMES:
        memory.late_lost += 1
        return
    memory.late_due_ns[slot] = due_ns
    memory.late_to_drive[slot] = 1 if to_drive else 0
    for i in range(FRAME_SIZE):
        memory.late_frames[slot, i] = frame[i]
    _unstamp(memory.late_frames[slot])
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
        other = 1 + int64(draw(memory) * 126.0)
        if other == node_id:
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
    if lost or twice or overtaken or corrupted or length >= 0 or late_ns > 0:
        memory.affected += 1
    if lost:
        return
    if late_ns > 0:
        _keep(memory, frame, to_drive, now_ns + late_ns)
        return
    if overtaken and not _one_waits(memory, to_drive):
        _keep(memory, frame, to_drive, 0)
        return
    slot = append_frame(queue, frame)
    if slot >= 0 and corrupted:
        for i in range(int64(frame[4])):
            queue.frames[slot, 8 + i] = int64(draw(memory) * 256.0)
    if slot >= 0 and length >= 0:
        queue.frames[slot, 4] = length
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
