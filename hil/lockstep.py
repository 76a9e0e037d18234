"""Deterministic simulation of controller, codec, drive and joint in one compiled function, faster than real time.

The controller's tick, the driver's frame codec and the virtual drive are the very functions of the real-time run;
only the bus is replaced: a frame arrives in the instant in which it was sent, in order, and none is lost.  The
computer's own delay is not modelled either: with a synchronous RPDO (transmission type 1) a command takes effect one
period after the sample it was computed from, as on a real bus whose round trip fits into the period.

With faults (`hil.faults.kinds`) every frame goes through the wire of `hil.faults.frame_faults`; late frames arrive at
the beginning of a cycle.
After the axis has finished, the controller is silent, and drive and joint may go on for a while: nobody sends a
heartbeat then.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.axis import step_axis
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.realtime import write_log
from jointctl.firmware_py.states import AxisPhase, StopRequest
from jointctl.hil.bus.virtual_bus import FRAME_SIZE
from jointctl.hil.canopen.device_core import accept_frame, advance
from jointctl.hil.faults.frame_faults import clock_step_cycles, collect, hand_over, take_due, to_drive
from jointctl.hil.faults.kinds import FaultKind, fault_memory, kind_active, no_faults
from jointctl.hil.faults.plant_faults import step_faults

# columns of the array of true values that a run may leave
TRUE_POSITION_rad, TRUE_VELOCITY_radps, TRUE_FRICTION_Nm, TRUE_ACTUATOR_Nm, TRUE_POWER_STATE = range(5)
TRUTHS = 5

# slots of the frame memory, agreed with whoever passes the codec: sent in begin (up to two), RPDO, received
RPDO_SLOT = 2
RECEIVED_SLOT = 3


@kernel
def _write_truth(row: np.ndarray, device: Any, plant: Any) -> None:
    row[TRUE_POSITION_rad] = plant.joint_position_rad
    row[TRUE_VELOCITY_radps] = plant.joint_velocity_radps
    row[TRUE_FRICTION_Nm] = plant.friction_torque_Nm
    row[TRUE_ACTUATOR_Nm] = plant.actuator_torque_Nm
    row[TRUE_POWER_STATE] = device.state


@kernel
def _perfect_measurement(state: Any, sample: Any, plant: Any, period_s: float) -> None:
    """Replace the reading by the true position, and prepare the velocity filter so that it gives the true velocity.

    With v = the true velocity and the last position one period of v back, v + gain ((q - q_last) / T - v) is v
    whatever the gain.  The matched filter of e' has no such preparation: it is for `matched_filter` = 0.
    """
    sample.position_rad = plant.joint_position_rad
    state.velocity.velocity_radps = plant.joint_velocity_radps
    state.velocity.last_position_rad = plant.joint_position_rad - plant.joint_velocity_radps * period_s


@kernel
def _empty_mailbox(
    mailbox: Any, accept: Any, port: np.ndarray, frames: np.ndarray, frame_bytes: np.ndarray, sample: Any, now_ns: int
) -> None:
    """Everything that has arrived goes to the driver's codec."""
    for index in range(mailbox.count):
        for byte in range(FRAME_SIZE):
            frame_bytes[RECEIVED_SLOT, byte] = mailbox.frames[index, byte]
        accept(port, frames, np.int64(RECEIVED_SLOT), sample, np.int64(now_ns))
    mailbox.count = 0


@kernel
def _run(
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
    truth: np.ndarray,
    faults: np.ndarray,
    memories: np.ndarray,
    start_ns: int,
    period_ns: int,
    cycles: int,
    stop_cycle: int,
    tail_cycles: int,
    ideal_velocity: bool,
    stop_request: int,
    silent_cycles: int,
    lost_to_drive: bool,
    lost_from_drive: bool,
) -> tuple[int, int]:
    """See `run_lockstep`; (log records, rows of `truth`) written.

    Without faults the drive's own queue is the controller's mailbox; with them it is that of the wire.
    """
    outgoing, memory, drive, joint_c, joint = queue[0], memories[0], device[0], plant_constants[0], plant[0]
    faulty = len(faults) > 0
    if memory.epoch_ns < 0:
        memory.epoch_ns = start_ns
    outgoing.count = 0
    written, rows, missed, silent, elapsed = 0, 0, 0, 0, 1
    off_bus = False
    finished_at = cycles
    for cycle in range(cycles + tail_cycles):
        if cycle >= finished_at + tail_cycles:
            break
        now_ns = start_ns + cycle * period_ns
        if faulty:
            step_faults(faults, memory, drive, joint_c, joint, now_ns)
        advance(drive, joint_c, joint, now_ns, outgoing)
        if faulty:
            collect(faults, memory, drive, outgoing, now_ns)
            take_due(memory, False, now_ns, False, memory.to_controller)
            take_due(memory, True, now_ns, False, memory.ready)
            hand_over(faults, memory, drive, joint_c, joint, outgoing, now_ns)
        logged = log_every > 0 and cycle % log_every == 0
        if logged and rows < len(truth):
            _write_truth(truth[rows], drive, joint)
            rows += 1
        if cycle >= finished_at:
            outgoing.count = 0
            continue
        if faulty:
            silent = silent + 1 if kind_active(faults, memory, FaultKind.SUPERVISOR_SILENT, now_ns) else 0
            if kind_active(faults, memory, FaultKind.LOOP_HELD_UP, now_ns):
                missed += 1
                continue
            elapsed = 1 + missed + clock_step_cycles(faults, memory, now_ns, period_ns)
            missed = 0
            off_bus = kind_active(faults, memory, FaultKind.BUS_OFF, now_ns)
        count = begin(port, frames)
        for slot in range(count):
            if faulty:
                to_drive(faults, memory, frame_bytes[slot], drive, joint_c, joint, outgoing, now_ns)
                sample[0].bus_errors = sample[0].bus_errors + 1 if off_bus else 0
            elif not lost_to_drive:
                accept_frame(drive, joint_c, joint, frame_bytes[slot], now_ns, outgoing)
        if lost_from_drive:
            outgoing.count = 0
        if silent_cycles >= 0:
            silent = silent_cycles + cycle
        if faulty:
            _empty_mailbox(memory.to_controller, accept, port, frames, frame_bytes, sample, now_ns)
        else:
            _empty_mailbox(outgoing, accept, port, frames, frame_bytes, sample, now_ns)
        stop = stop_request if 0 <= stop_cycle <= cycle else StopRequest.NONE
        if ideal_velocity and state[0].velocity.primed != 0:
            _perfect_measurement(state[0], sample[0], joint, constants[0].law.period_s)
        step_axis(constants[0], state[0], table, sample[0], command[0], elapsed, stop, silent)
        end(port, frames, sample, command)
        if faulty:
            to_drive(faults, memory, frame_bytes[RPDO_SLOT], drive, joint_c, joint, outgoing, now_ns)
            sample[0].bus_errors = sample[0].bus_errors + 1 if off_bus else 0
        elif not lost_to_drive:
            accept_frame(drive, joint_c, joint, frame_bytes[RPDO_SLOT], now_ns, outgoing)
        if logged and written < len(log):
            write_log(log[written], state[0], sample[0], command[0])
            log[written].time_ns = now_ns
            log[written].skipped = elapsed - 1
            written += 1
        if state[0].phase == AxisPhase.FINISHED:
            finished_at = cycle + 1
    return written, rows


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
    truth: np.ndarray | None = None,
    ideal_velocity: bool = False,
    faults: Any = None,
    memories: Any = None,
    tail_cycles: int = 0,
    stop_request: int = StopRequest.RAMP,
    silent_cycles: int = -1,
    lost_to_drive: bool = False,
    lost_from_drive: bool = False,
) -> tuple[int, int]:
    """Run until the axis is FINISHED, `cycles` at most, then `tail_cycles` without a controller.

    Returns the numbers of log records and of rows of `truth` written.

    `begin(port, frames) -> n`, `accept(port, frames, slot, sample, now_ns) -> bool` and
    `end(port, frames, sample, command)` are the driver's codec; `frame_bytes` uint8[slots, 16] is the memory of
    `frames`.  The device has been commissioned and is operational.  Every `log_every`-th cycle goes to `log` while
    there is room (0: none).  `stop_request` is made at `stop_cycle` (negative: never).  `silent_cycles`: the age of the
    supervisor's sign of life at the beginning (negative: not watched).  `lost_*`: no frame arrives there.
    `truth` float64[N, TRUTHS], or None, takes what the joint truly did in the same periods (columns TRUE_*), and in
    those in which the controller was held up or silent.  `ideal_velocity` bypasses encoder and velocity filter: for
    textbook experiments only.  `faults` FaultConstants[N], `memories` FaultMemory[1].
    """
    if truth is None:
        truth = np.zeros((0, TRUTHS))
    faults = no_faults() if faults is None else faults
    written, rows = _run(
        begin, accept, end, port, frames, frame_bytes, constants, state, table, sample, command, device,
        plant_constants, plant, queue, log, log_every, truth, faults,
        fault_memory(faults) if memories is None else memories, start_ns, period_ns, cycles, stop_cycle, tail_cycles,
        ideal_velocity, int(stop_request), silent_cycles, lost_to_drive, lost_from_drive,
    )  # fmt: skip
    return int(written), int(rows)
