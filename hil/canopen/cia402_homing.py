"""Homing mode of the virtual drive (CiA 402, mode 6): what moves the origin of 6064.

Methods 35 and 37 take the present position for home; 33 and 34 search the next index pulse in negative or positive
direction with the speed 6099:2 and the acceleration 609A.  The index pulse comes once a turn of the motor.  At home
6064 is 607C.  The shift lasts until the drive restarts.  A search that lasts much longer than a turn needs has failed
(a blocked joint), and so has method 0.
Not modelled: limit and home switches (methods 1 to 30), and hence the speed 6099:1.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.device_records import Device, HomingState, int64

_SPARE_S = 1.0


@kernel
def index_spacing_counts(device: Device) -> float:
    """Encoder counts from one index pulse to the next: one turn of the motor."""
    return abs(device.counts_per_rad) * 2.0 * math.pi / device.reduction_ratio


@kernel
def begin_homing(device: Device) -> None:
    """Start as 6098 says; the search itself is `homing_target_radps`."""
    drive = device.drive
    method = drive.homing_method
    if method == 33 or method == 34 or method == 35 or method == 37:
        spacing = index_spacing_counts(device)
        speed = float(drive.homing_speed[1])
        encoder = int64(drive.position) + int64(device.home_shift_counts)
        device.homing_cell = int64(math.floor(encoder / spacing))
        device.homing_time_left_s = 2.0 * spacing / speed + 2.0 * speed / int64(drive.homing_acceleration) + _SPARE_S
        device.homing = HomingState.SEARCHING
    else:
        device.homing = HomingState.FAILED


@kernel
def interrupt_homing(device: Device) -> None:
    if device.homing == HomingState.SEARCHING:
        device.homing = HomingState.IDLE


@kernel
def homing_target_radps(device: Device, position: int, dt_s: float) -> float:
    """Speed of the joint that the search asks for, 0 when none runs; `position` as in 6064 [counts]."""
    if device.homing != HomingState.SEARCHING:
        return 0.0
    drive = device.drive
    encoder = position + int64(device.home_shift_counts)
    if drive.homing_method >= 35:
        device.home_shift_counts = encoder - int64(drive.home_offset)
        device.homing = HomingState.ATTAINED
        return 0.0
    spacing = index_spacing_counts(device)
    cell = int64(math.floor(encoder / spacing))
    forward = drive.homing_method == 34
    if (forward and cell > device.homing_cell) or (not forward and cell < device.homing_cell):
        pulse = device.homing_cell + 1 if forward else int64(device.homing_cell)
        device.home_shift_counts = int64(math.floor(pulse * spacing + 0.5)) - int64(drive.home_offset)
        device.homing = HomingState.ATTAINED
        return 0.0
    device.homing_time_left_s -= dt_s
    if device.homing_time_left_s <= 0.0:
        device.homing = HomingState.FAILED
        return 0.0
    speed = float(drive.homing_speed[1]) / device.counts_per_rad
    return speed if forward else -speed
