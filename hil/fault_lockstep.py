"""The lockstep simulation with faults: as `hil.lockstep`, but every frame goes through the wire of `hil.frame_faults`.

Without a fault it does bit for bit what `hil.lockstep` does.  Late frames arrive at the beginning of a cycle.  After
the axis has finished, the controller is silent and drive and joint go on for a while: nobody sends a heartbeat then.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_py.axis import step_axis
from firmware_py.kernel import kernel
from firmware_py.realtime import write_log
from firmware_py.states import AxisPhase, StopRequest
from hil.device_core import accept_frame, advance
from hil.device_records import int64
from hil.faults import FaultKind, kind_active
from hil.frame_faults import pass_frame, take_due
from hil.frames import FRAME_SIZE
from hil.lockstep import RECEIVED_SLOT, RPDO_SLOT
from hil.plant_faults import step_faults

# columns of the array of true values, one row a period
TRUE_POSITION_rad, TRUE_VELOCITY_radps, TRUE_ACTUATOR_Nm, TRUE_POWER_STATE = range(4)
TRUTHS = 4


@kernel
def _collect(faults: Any, memory: Any, device: Any, outgoing: Any, now_ns: int) -> None:
    """What the drive sent goes through the wire into the controller's mailbox."""
    for index in range(outgoing.count):
        pass_frame(faults, memory, outgoing.frames[index], False, device.node_id, now_ns, memory.to_controller)
    outgoing.count = 0


@kernel
def _hand_over(faults: Any, memory: Any, device: Any, plant_c: Any, plant_s: Any, outgoing: Any, now_ns: int) -> None:
    """What came out of the wire at the drive's end is handled, and its answers are sent."""
    ready = memory.ready
    for index in range(ready.count):
        accept_frame(device, plant_c, plant_s, ready.frames[index], now_ns, outgoing)
    ready.count = 0
    _collect(faults, memory, device, outgoing, now_ns)


@kernel
def _to_drive(
    faults: Any,
    memory: Any,
    frame: np.ndarray,
    device: Any,
    plant_c: Any,
    plant_s: Any,
    outgoing: Any,
    now_ns: int,
) -> None:
    pass_frame(faults, memory, frame, True, device.node_id, now_ns, memory.ready)
    _hand_over(faults, memory, device, plant_c, plant_s, outgoing, now_ns)


@kernel
def _clock_step_cycles(faults: Any, memory: Any, now_ns: int, period_ns: int) -> int:
    """By how many periods the controller's clock jumps in this cycle."""
    for i in range(len(faults)):
        fault = faults[i]
        if fault.kind == FaultKind.CLOCK_STEP and memory.epoch_ns != 0:
            at_ns = memory.epoch_ns + int64(fault.start_s * 1e9)
            if at_ns <= now_ns < at_ns + period_ns:
                return int64(fault.magnitude * 1e9) // period_ns
    return 0


@kernel
def run_with_faults(
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
    truth: np.ndarray,
    faults: np.ndarray,
    memories: np.ndarray,
    start_ns: int,
    period_ns: int,
    cycles: int,
    stop_cycle: int,
    tail_cycles: int,
) -> tuple[int, int]:
    """Run up to `cycles` cycles, then `tail_cycles` more without a controller; (log records, rows of `truth`) written.

    Arguments as `hil.lockstep.run_lockstep`; every executed cycle is logged.  `truth` float64[cycles + tail_cycles,
    TRUTHS] takes what the joint truly did in every period; `faults` FaultConstants[N], `memories` FaultMemory[1].
    """
    outgoing, memory, drive, joint_c, joint = queue[0], memories[0], device[0], plant_constants[0], plant[0]
    if memory.epoch_ns < 0:
        memory.epoch_ns = start_ns
    written, rows, missed, silent = 0, 0, 0, 0
    finished_at = cycles
    for cycle in range(cycles + tail_cycles):
        if cycle >= finished_at + tail_cycles:
            break
        now_ns = start_ns + cycle * period_ns
        outgoing.count = 0
        step_faults(faults, memory, drive, joint_c, joint, now_ns)
        advance(drive, joint_c, joint, now_ns, outgoing)
        _collect(faults, memory, drive, outgoing, now_ns)
        take_due(memory, False, now_ns, False, memory.to_controller)
        take_due(memory, True, now_ns, False, memory.ready)
        _hand_over(faults, memory, drive, joint_c, joint, outgoing, now_ns)
        truth[rows, TRUE_POSITION_rad] = joint.joint_position_rad
        truth[rows, TRUE_VELOCITY_radps] = joint.joint_velocity_radps
        truth[rows, TRUE_ACTUATOR_Nm] = joint.actuator_torque_Nm
        truth[rows, TRUE_POWER_STATE] = drive.state
        rows += 1
        if cycle >= finished_at:
            continue
        silent = silent + 1 if kind_active(faults, memory, FaultKind.SUPERVISOR_SILENT, now_ns) else 0
        if kind_active(faults, memory, FaultKind.LOOP_HELD_UP, now_ns):
            missed += 1
            continue
        elapsed = 1 + missed + _clock_step_cycles(faults, memory, now_ns, period_ns)
        missed = 0
        off_bus = kind_active(faults, memory, FaultKind.BUS_OFF, now_ns)
        count = begin(port, frames)
        for slot in range(count):
            _to_drive(faults, memory, frame_bytes[slot], drive, joint_c, joint, outgoing, now_ns)
            sample[0].bus_errors = sample[0].bus_errors + 1 if off_bus else 0
        mailbox = memory.to_controller
        for index in range(mailbox.count):
            for byte in range(FRAME_SIZE):
                frame_bytes[RECEIVED_SLOT, byte] = mailbox.frames[index, byte]
            accept(port, frames, np.int64(RECEIVED_SLOT), sample, np.int64(now_ns))
        mailbox.count = 0
        stop = StopRequest.RAMP if 0 <= stop_cycle <= cycle else StopRequest.NONE
        step_axis(constants[0], state[0], table, sample[0], command[0], elapsed, stop, silent)
        end(port, frames, sample, command)
        _to_drive(faults, memory, frame_bytes[RPDO_SLOT], drive, joint_c, joint, outgoing, now_ns)
        sample[0].bus_errors = sample[0].bus_errors + 1 if off_bus else 0
        if written < len(log):
            write_log(log[written], state[0], sample[0], command[0])
            log[written].time_ns = now_ns
            log[written].skipped = elapsed - 1
            written += 1
        if state[0].phase == AxisPhase.FINISHED:
            finished_at = cycle + 1
    return written, rows
