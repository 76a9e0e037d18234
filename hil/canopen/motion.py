"""What the virtual drive does by itself: ramps, profiles, set-points and homing of CiA 402."""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.records import Device, DriveObjects, HomingState, Mode, PowerState, int64

# --- Torque demand of the virtual drive in every mode of operation, at the plant's substep rate ---
# CST and TQ set the torque; CSV and PV run a PI velocity loop; CSP and PP a P position loop around it.  60B1 is added
# to the velocity that the loop of CSP or CSV gets, 60B2 to its torque.  With `loop_period_s` those modes are computed
# at that rate, as in a drive, and held in between.  A stop ramp (quick stop, fault reaction, disable) uses the velocity
# loop in every mode.  Result in per mille of the rated motor torque, limited by 6072 and by 6073 through the torque
# constant.  Positive = positive joint motion. Not modelled: velocity estimation inside the drive (the loop sees the
# plant's velocity), jerk limits, 60B0.


_HALT = 0x0100
_STANDSTILL_RADPS = 0.01
_BRAKE_SPARE_S = 1.0  # a stop ramp that is this much late ends all the same
_UNLIMITED_WINDOW = 0xFFFFFFFF


@kernel
def rated_torque_mNm(device: Device) -> float:
    """6076 in its unit."""
    return int64(device.drive.rated_torque) * device.rated_torque_unit_mNm


@kernel
def torque_limit(device: Device) -> float:
    """The least of 6072, what current 6073 yields and the maker's own limit [per mille of rated motor torque]."""
    drive = device.drive
    per_current = device.motor_torque_constant_NmpA * int64(drive.rated_current_mA) / rated_torque_mNm(device)
    bound = min(float(drive.max_torque), float(drive.max_current) * per_current)
    if device.makers_limit_rated_counts > 0.0:
        bound = min(bound, 1000.0 * int64(drive.makers_limit) / device.makers_limit_rated_counts)
    return bound


@kernel
def permille_torque_Nm(device: Device) -> float:
    """Joint torque of one per mille of the rated motor torque [Nm]."""
    return 1e-6 * rated_torque_mNm(device) * device.reduction_ratio


@kernel
def _limit(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@kernel
def _max_speed_radps(device: Device) -> float:
    drive = device.drive
    motor = int64(drive.max_motor_speed_rpm) * (2.0 * math.pi / 60.0) / device.reduction_ratio
    return min(int64(drive.max_profile_velocity) / abs(device.velocity_units_prad), motor)


@kernel
def _velocity_loop(device: Device, velocity_radps: float, dt_s: float) -> float:
    """PI on the reference velocity; the integral stands still while the output is limited in its direction."""
    error = device.reference_velocity_radps - velocity_radps
    scale = permille_torque_Nm(device)
    bound = torque_limit(device) * scale
    torque = device.velocity_gain_Nmspr * error + device.integral_Nm
    if abs(torque) < bound or torque * error < 0.0:
        device.integral_Nm = _limit(device.integral_Nm + device.velocity_integral_Nmprad * error * dt_s, bound)
    return torque / scale


@kernel
def halted_quickly(drive: DriveObjects) -> bool:
    """Halt with the ramp of the quick stop (605D = 2) instead of the mode's own."""
    return drive.controlword & _HALT != 0 and drive.halt_option == 2


@kernel
def _ramp_velocity(device: Device, target_radps: float, dt_s: float) -> None:
    """Move the reference velocity towards the target with 6083 away from zero and 6084 towards it; halt: 605D."""
    reference = device.reference_velocity_radps
    rate = int64(device.drive.profile_acceleration)
    if halted_quickly(device.drive):
        rate = int64(device.drive.quick_stop_deceleration)
    elif abs(target_radps) < abs(reference) or target_radps * reference < 0.0:
        rate = int64(device.drive.profile_deceleration)
    step = rate / abs(device.counts_per_rad) * dt_s
    device.reference_velocity_radps = reference + _limit(target_radps - reference, step)


@kernel
def _position_loop(device: Device, position_rad: float, velocity_radps: float, feed_radps: float, dt_s: float) -> float:
    """P on the reference position plus the velocity of the reference."""
    speed = feed_radps + device.position_gain_ps * (device.reference_position_rad - position_rad)
    device.reference_velocity_radps = _limit(speed, _max_speed_radps(device))
    return _velocity_loop(device, velocity_radps, dt_s)


@kernel
def _cyclic_position(device: Device, position_rad: float, velocity_radps: float, dt_s: float) -> float:
    """CSP: straight line from the last reference to the new target within 60C2."""
    target = int64(device.drive.target_position)
    if target != device.segment_target:
        period_s = float(device.drive.interpolation_time) * 10.0 ** float(device.drive.interpolation_exponent)
        period_s = max(period_s, dt_s)
        device.segment_target = target
        device.segment_left_s = period_s
        device.segment_velocity_radps = (target / device.counts_per_rad - device.reference_position_rad) / period_s
    feed_radps = int64(device.drive.velocity_offset) / device.velocity_units_prad
    if device.segment_left_s > 0.5 * dt_s:
        feed_radps += device.velocity_feed * device.segment_velocity_radps
        device.reference_position_rad += device.segment_velocity_radps * dt_s
        device.segment_left_s -= dt_s
    return _position_loop(device, position_rad, velocity_radps, feed_radps, dt_s)


@kernel
def _profile_position(device: Device, position_rad: float, velocity_radps: float, dt_s: float) -> float:
    """PP: trapezoidal reference towards the last set-point; its velocity is kept in segment_velocity_radps."""
    drive = device.drive
    target_radps = 0.0
    if device.setpoint_active and not drive.controlword & _HALT:
        left = device.setpoint_position_rad - device.reference_position_rad
        deceleration = int64(drive.profile_deceleration) / abs(device.counts_per_rad)
        speed = min(int64(drive.profile_velocity) / abs(device.counts_per_rad), _max_speed_radps(device))
        speed = min(speed, math.sqrt(2.0 * deceleration * abs(left)))
        target_radps = math.copysign(speed, left)
        if abs(left) <= abs(device.segment_velocity_radps) * dt_s + 0.5 / abs(device.counts_per_rad):
            device.reference_position_rad = device.setpoint_position_rad
            device.segment_velocity_radps = 0.0
            device.setpoint_active = device.setpoint_waiting
            device.setpoint_position_rad = (
                device.setpoint_next_rad if device.setpoint_waiting else device.setpoint_position_rad
            )
            device.setpoint_waiting = 0
            target_radps = 0.0
    device.reference_velocity_radps = device.segment_velocity_radps
    _ramp_velocity(device, target_radps, dt_s)
    device.segment_velocity_radps = device.reference_velocity_radps
    device.reference_position_rad += device.segment_velocity_radps * dt_s
    return _position_loop(device, position_rad, velocity_radps, device.segment_velocity_radps, dt_s)


@kernel
def _mode_demand(device: Device, position: int, velocity_radps: float, dt_s: float) -> float:
    drive = device.drive
    mode = drive.mode_display
    position_rad = position / device.counts_per_rad
    if mode == Mode.CYCLIC_TORQUE:
        torque = device.torque_sign * (float(drive.target_torque) + float(drive.torque_offset))
        return -torque if device.torque_reversed else torque
    if mode == Mode.TORQUE:
        target = 0.0 if drive.controlword & _HALT else device.torque_sign * float(drive.target_torque)
        return device.demand + _limit(target - device.demand, int64(drive.torque_slope) * dt_s)
    if mode == Mode.CYCLIC_VELOCITY:
        target_radps = (int64(drive.target_velocity) + int64(drive.velocity_offset)) / device.velocity_units_prad
        device.reference_velocity_radps = _limit(target_radps, _max_speed_radps(device))
        return _velocity_loop(device, velocity_radps, dt_s) + device.torque_sign * float(drive.torque_offset)
    if mode == Mode.PROFILE_VELOCITY:
        target_radps = 0.0 if drive.controlword & _HALT else int64(drive.target_velocity) / device.velocity_units_prad
        _ramp_velocity(device, _limit(target_radps, _max_speed_radps(device)), dt_s)
        return _velocity_loop(device, velocity_radps, dt_s)
    if mode == Mode.CYCLIC_POSITION:
        offset = device.torque_sign * float(drive.torque_offset)
        return _cyclic_position(device, position_rad, velocity_radps, dt_s) + offset
    if mode == Mode.PROFILE_POSITION:
        return _profile_position(device, position_rad, velocity_radps, dt_s)
    if mode == Mode.HOMING:
        target_radps = _limit(homing_target_radps(device, position, dt_s), _max_speed_radps(device))
        rate = int64(drive.quick_stop_deceleration if halted_quickly(drive) else drive.homing_acceleration)
        step_radps = rate / abs(device.counts_per_rad) * dt_s
        device.reference_velocity_radps += _limit(target_radps - device.reference_velocity_radps, step_radps)
        return _velocity_loop(device, velocity_radps, dt_s)
    return 0.0


@kernel
def _sampled_demand(device: Device, position: int, velocity_radps: float, dt_s: float) -> float:
    """The demand of the mode; in CSP and CSV computed once in `loop_period_s`, and held in between."""
    mode, period_s = device.drive.mode_display, device.loop_period_s
    if period_s <= 0.0 or (mode != Mode.CYCLIC_POSITION and mode != Mode.CYCLIC_VELOCITY):
        return _mode_demand(device, position, velocity_radps, dt_s)
    device.loop_due_s -= dt_s
    if device.loop_due_s > 0.0:
        return device.demand
    device.loop_due_s += period_s
    return _mode_demand(device, position, velocity_radps, period_s)


@kernel
def _brake(device: Device, velocity_radps: float, dt_s: float) -> float:
    """One substep of a stop ramp; enters `after_brake` at standstill."""
    if device.braking == 2:
        device.braking = 1
        device.integral_Nm = 0.0
        device.reference_velocity_radps = velocity_radps
        device.brake_time_left_s = abs(velocity_radps) / device.brake_deceleration_radps2 + _BRAKE_SPARE_S
    reference = device.reference_velocity_radps
    device.reference_velocity_radps = reference - _limit(reference, device.brake_deceleration_radps2 * dt_s)
    device.brake_time_left_s -= dt_s
    demand = _velocity_loop(device, velocity_radps, dt_s)
    stopped = device.reference_velocity_radps == 0.0 and abs(velocity_radps) < _STANDSTILL_RADPS
    if stopped or device.brake_time_left_s <= 0.0:
        device.braking = 0
        device.state = device.after_brake
    return demand


@kernel
def following_error_tripped(device: Device, position: int, dt_s: float) -> bool:
    """60F4 outside 6065 for longer than 6066, in the position modes of Operation Enabled."""
    drive = device.drive
    mode = drive.mode_display
    positioning = mode == Mode.CYCLIC_POSITION or mode == Mode.PROFILE_POSITION
    if not positioning or device.state != PowerState.OPERATION_ENABLED or device.braking != 0 or device.resync:
        device.following_time_s = 0.0
        return False
    error = device.reference_position_rad * device.counts_per_rad - position
    window = int64(drive.following_window)
    if window == _UNLIMITED_WINDOW or abs(error) <= window:
        device.following_time_s = 0.0
        return False
    device.following_time_s += dt_s
    return device.following_time_s > 1e-3 * int64(drive.following_timeout_ms)


@kernel
def follows_velocity(device: Device) -> bool:
    """Whether the velocity loop sets the torque: in its modes and in those above it, and in a stop ramp of any mode."""
    if device.resync != 0 or device.braking == 2:  # not before its next substep
        return False
    if device.state == PowerState.OPERATION_ENABLED and device.braking == 0:
        mode = device.drive.mode_display
        return mode != Mode.NONE and mode != Mode.TORQUE and mode != Mode.CYCLIC_TORQUE
    return device.braking == 1 or device.state == PowerState.QUICK_STOP_ACTIVE


@kernel
def demand_is_held(device: Device) -> bool:
    """Whether the demand depends on nothing but the objects: with the power stage off, and in CST while enabled."""
    state = device.state
    if state == PowerState.OPERATION_ENABLED:
        return device.drive.mode_display == Mode.CYCLIC_TORQUE and device.braking == 0
    return state != PowerState.QUICK_STOP_ACTIVE and state != PowerState.FAULT_REACTION_ACTIVE


@kernel
def is_powered(device: Device) -> bool:
    """Whether the motor may have current; where not, a joint's brake is closed."""
    state = device.state
    return (
        state == PowerState.OPERATION_ENABLED
        or state == PowerState.QUICK_STOP_ACTIVE
        or state == PowerState.FAULT_REACTION_ACTIVE
    )


@kernel
def demand_torque_Nm(device: Device, position: int, velocity_radps: float, dt_s: float) -> float:
    """Limited joint torque [Nm] for the next substep; `position` [counts] and velocity at the joint; 0 when off."""
    state = device.state
    device.saturated = 0
    if not is_powered(device):
        device.demand = 0.0
        return 0.0
    position_rad = position / device.counts_per_rad
    if device.resync:
        device.resync = 0
        device.reference_position_rad = position_rad
        device.reference_velocity_radps = velocity_radps
        device.segment_velocity_radps = velocity_radps
        device.segment_target = position
        device.segment_left_s = 0.0
        if not device.setpoint_active:
            device.setpoint_position_rad = position_rad
        device.integral_Nm = 0.0
        device.loop_due_s = 0.0
        device.demand = 0.0
    if device.braking != 0:
        demand = _brake(device, velocity_radps, dt_s)
    elif state == PowerState.OPERATION_ENABLED:
        demand = _sampled_demand(device, position, velocity_radps, dt_s)
    else:
        device.reference_velocity_radps = 0.0
        demand = _velocity_loop(device, velocity_radps, dt_s)
    bound = torque_limit(device)
    if abs(demand) > bound:
        device.saturated = 1
        demand = _limit(demand, bound)
    device.demand = demand
    return demand * permille_torque_Nm(device)


# --- Homing mode of the virtual drive (CiA 402, mode 6): what moves the origin of 6064 ---
# Methods 35 and 37 take the present position for home; 33 and 34 search the next index pulse in negative or positive
# direction with the speed 6099:2 and the acceleration 609A.  The index pulse comes once a turn of the motor.  At home
# 6064 is 607C.  The shift lasts until the drive restarts.  A search that lasts much longer than a turn needs has
# failed (a blocked joint), and so has method 0. Not modelled: limit and home switches (methods 1 to 30), and hence
# the speed 6099:1.


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
