"""The inside of the virtual Elmo drive: unit modes, current limiting, the drive's own limits, around the plant.

Every 50 us substep: speed and position loops (UM 2 and 5), then peak and continuous current limit, then the joint.

Speeds and positions are in encoder counts as the drive counts them, currents in amperes.
Current limiting: the demand may be above CL[1] for PL[2] seconds, then it is held at CL[1] until it has been below for
as long.  Not modelled: the heating model behind it, commutation, the bus voltage, the limits of jerk (SF).
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import f8, i4, i8, record
from jointctl.hil.plant import encoder_counts, shaft_velocity_radps, step_plant
from jointctl.hil.plant_records import PlantConstants, PlantState

UM_TORQUE, UM_SPEED, UM_POSITION = 1, 2, 5
MF_SPEED_ERROR = 0x80
MF_OVERSPEED, MF_POSITION_LIMIT = 0x20000, 0x400000
SPEED_BANDWIDTH_RADPS = 95.0  # tuned as the virtual CANopen drive is
INTEGRAL_SHARE = 0.5  # of that bandwidth: damping 0.7
POSITION_BANDWIDTH_PS = 10.0
SETTLED_COUNTS = 2.0


@record
class ElmoMotor:
    """What the commands set, and what the drive does about it."""

    unit_mode: i4
    motor_on: i4
    motor_fault: i8
    current_sign: i4  # -1: positive current drives the counts down
    torque_A: f8  # TC
    jog_cps: f8  # JV as the last BG took it over
    acceleration_cps2: f8
    deceleration_cps2: f8
    stop_deceleration_cps2: f8  # SD, from ST on until the next BG
    profile_cps: f8  # SP
    target_counts: f8  # PA as the last BG took it over
    continuous_A: f8
    peak_A: f8
    peak_s: f8
    speed_high_cps: f8
    speed_low_cps: f8
    position_high_counts: f8
    position_low_counts: f8
    speed_error_cps: f8
    position_error_counts: f8
    # state
    reference_cps: f8
    integral_A: f8
    over_s: f8  # time above CL[1], at most PL[2]
    limited: i4
    demand_A: f8
    moving: i4
    stopping: i4
    gain_Apcps: f8


@kernel
def switch_off(m: ElmoMotor, fault: int) -> None:
    """Power stage off; the first fault stays."""
    m.motor_on = 0
    m.torque_A = 0.0
    m.demand_A = 0.0
    m.moving = 0
    if m.motor_fault == 0:
        m.motor_fault = fault


@kernel
def _approach(value: float, target: float, up: float, down: float) -> float:
    """One step of `value` towards `target`; `up` when the size grows, `down` when it falls."""
    step = up if abs(target) > abs(value) else down
    return min(max(target, value - step), value + step)


@kernel
def _speed_demand_A(m: ElmoMotor, target_cps: float, speed_cps: float, step_s: float) -> float:
    down_cps2 = m.stop_deceleration_cps2 if m.stopping != 0 else m.deceleration_cps2
    m.reference_cps = _approach(m.reference_cps, target_cps, m.acceleration_cps2 * step_s, down_cps2 * step_s)
    error_cps = m.reference_cps - speed_cps
    if abs(error_cps) > m.speed_error_cps:
        switch_off(m, MF_SPEED_ERROR)
        return 0.0
    rate = m.gain_Apcps * INTEGRAL_SHARE * SPEED_BANDWIDTH_RADPS
    m.integral_A = min(max(m.integral_A + rate * error_cps * step_s, -m.peak_A), m.peak_A)
    return m.gain_Apcps * error_cps + m.integral_A


@kernel
def _profile_cps(m: ElmoMotor, counts: float) -> float:
    """Speed of a trapezoid towards the target, from where the joint is."""
    distance = m.target_counts - counts
    if abs(distance) <= SETTLED_COUNTS and abs(m.reference_cps) < 0.01 * m.profile_cps:
        m.moving = 0
    speed = min(m.profile_cps, math.sqrt(m.deceleration_cps2 * abs(distance)))
    speed = min(speed, POSITION_BANDWIDTH_PS * abs(distance))
    return speed if distance > 0.0 else -speed


@kernel
def _limited_A(m: ElmoMotor, demand_A: float, step_s: float) -> float:
    """Peak limit, and the continuous limit once the peak time is used up."""
    if m.limited == 0:
        m.over_s = min(m.over_s + step_s, m.peak_s) if abs(demand_A) > m.continuous_A else max(m.over_s - step_s, 0.0)
        if m.over_s >= m.peak_s and abs(demand_A) > m.continuous_A:
            m.limited = 1
    elif abs(demand_A) <= m.continuous_A:
        m.over_s -= step_s
        if m.over_s <= 0.0:
            m.limited = 0
    limit = m.continuous_A if m.limited != 0 else m.peak_A
    return min(max(demand_A, -limit), limit)


@kernel
def advance_motor(m: ElmoMotor, c: PlantConstants, s: PlantState, substeps: int) -> None:
    """Drive and joint together, `substeps` of `c.step_s`."""
    for _ in range(substeps):
        speed_cps = shaft_velocity_radps(c, s) * c.counts_prad
        position_rad = s.motor_position_rad if c.encoder_motor_side != 0 else s.joint_position_rad
        counts = position_rad * c.counts_prad + c.encoder_offset_counts
        demand_A = 0.0
        if m.motor_on != 0:
            if speed_cps > m.speed_high_cps or speed_cps < m.speed_low_cps:
                switch_off(m, MF_OVERSPEED)
            elif counts > m.position_high_counts or counts < m.position_low_counts:
                switch_off(m, MF_POSITION_LIMIT)
            elif m.unit_mode == UM_TORQUE:
                demand_A = m.torque_A
            elif m.unit_mode == UM_SPEED:
                demand_A = m.current_sign * _speed_demand_A(m, m.jog_cps, speed_cps, c.step_s)
                m.moving = int(m.reference_cps != 0.0)
            elif m.unit_mode == UM_POSITION:
                target_cps = _profile_cps(m, counts)
                demand_A = m.current_sign * _speed_demand_A(m, target_cps, speed_cps, c.step_s)
        m.demand_A = _limited_A(m, demand_A, c.step_s)
        step_plant(c, s, m.demand_A * c.torque_per_current_NmpA)


@kernel
def position_counts(c: PlantConstants, s: PlantState) -> int:
    """PX."""
    return encoder_counts(c, s)


def status_register(m: ElmoMotor, amplifier: int) -> int:
    """SR: amplifier in bits 0-3, servo on, fault latched, unit mode, current limited, motion status."""
    moving = int(m.moving) if m.motor_on else 0
    on, fault = int(m.motor_on), int(m.motor_fault != 0)
    return amplifier | on << 4 | fault << 6 | int(m.unit_mode) << 7 | int(m.limited) << 13 | moving * 2 << 14
