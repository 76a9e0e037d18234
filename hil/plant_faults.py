"""Faults of drive, encoder, motor and load, on purpose: `step_faults` puts them into the records of device and plant.

The encoder's faults are those of the position that the controller reads.  The virtual drive brakes by the plant's own
velocity, as a drive does that has a second, healthy encoder on the motor.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.device_core import restart
from jointctl.hil.canopen.records import Device, PowerState, int64
from jointctl.hil.fault_kinds import FaultConstants, FaultKind, FaultMemory, is_active
from jointctl.hil.plant import shaft_position_rad
from jointctl.hil.plant_records import PlantConstants, PlantState


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
