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

# columns of the array of true values that a run may leave beside its log
TRUE_POSITION_rad, TRUE_VELOCITY_radps, TRUE_FRICTION_Nm, TRUE_ACTUATOR_Nm = range(4)
TRUTHS = 4

# slots of the frame memory, agreed with whoever passes the codec: sent in begin (up to two), RPDO, received
RPDO_SLOT = 2
RECEIVED_SLOT = 3


@kernel
def _deliver_to_drive(
    device: Any, plant_constants: Any, plant: Any, frame_bytes: np.ndarray, slot: int, now_ns: int, queue: Any
) -> None:
    accept_frame(device, plant_constants, plant, frame_bytes[slot], now_ns, queue)


@kernel
def _write_truth(row: np.ndarray, plant: Any) -> None:
    row[TRUE_POSITION_rad] = plant.joint_position_rad
    row[TRUE_VELOCITY_radps] = plant.joint_velocity_radps
    row[TRUE_FRICTION_Nm] = plant.friction_torque_Nm
    row[TRUE_ACTUATOR_Nm] = plant.actuator_torque_Nm


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
    start_ns: int,
    period_ns: int,
    cycles: int,
    stop_cycle: int,
    truth: np.ndarray,
    ideal_velocity: bool,
) -> int:
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
        if ideal_velocity and state[0].velocity.primed != 0:
            _perfect_measurement(state[0], sample[0], plant[0], constants[0].law.period_s)
        step_axis(constants[0], state[0], table, sample[0], command[0], 1, stop, 0)
        end(port, frames, sample, command)
        outgoing.count = 0
        _deliver_to_drive(device[0], plant_constants[0], plant[0], frame_bytes, RPDO_SLOT, now_ns, outgoing)
        if log_every > 0 and cycle % log_every == 0 and written < len(log):
            write_log(log[written], state[0], sample[0], command[0])
            log[written].time_ns = now_ns
            if written < len(truth):
                _write_truth(truth[written], plant[0])
            written += 1
        if state[0].phase == AxisPhase.FINISHED:
            break
    return written


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
) -> int:
    """Run up to `cycles` cycles or until the axis is FINISHED; returns the number of log records written.

    `begin(port, frames) -> n`, `accept(port, frames, slot, sample, now_ns) -> bool` and
    `end(port, frames, sample, command)` are the driver's codec; `frame_bytes` uint8[slots, 16] is the memory of
    `frames`.  The device has been commissioned and is operational.  Every `log_every`-th cycle goes to `log` while
    there is room (0: none).  A controlled stop is requested at `stop_cycle` (negative: never).
    `truth` float64[len(log), TRUTHS], or None, takes what the joint truly did at each logged sample (columns
    TRUE_*).  `ideal_velocity` bypasses encoder and velocity filter: for textbook experiments only.
    """
    if truth is None:
        truth = np.zeros((0, TRUTHS))
    return _run(
        begin, accept, end, port, frames, frame_bytes, constants, state, table, sample, command, device,
        plant_constants, plant, queue, log, log_every, start_ns, period_ns, cycles, stop_cycle, truth, ideal_velocity,
    )  # fmt: skip
