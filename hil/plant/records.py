"""Records of the virtual joint: what the plant is made of, before any of it moves.

Every torque is at the joint (low-velocity side) unless the name says otherwise.  What a person writes is
`plant_settings.PlantSettings`; `PlantConstants` is what the kernels read (reciprocals and factors worked out once).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.firmware_py.records import FrictionConstants
from jointctl.firmware_py.schema import array_of, f8, i4, i8, record

RIPPLES = 4
DELAY_SLOTS = 1024  # the command delay is below this many substeps

u8 = Annotated[int, np.dtype("<u8")]


class FrictionKind(IntEnum):
    """How the sliding curve (11) becomes a friction torque."""

    NONE = 0
    SIGN = 1  # the curve at the present velocity, zero at exactly zero velocity
    STICK_SLIP = 2  # set-valued at zero velocity: holds up to the static friction
    LUGRE = 3  # bristle deflection


class EncoderSide(IntEnum):
    """Which shaft the encoder sits on."""

    JOINT = 0
    MOTOR = 1


@record
class PlantConstants:
    """Fixed during a run; built by `hil.plant.joint.plant`."""

    step_s: f8
    inverse_step_Hz: f8
    # inertia: the mass that friction acts on is the whole joint, or the motor side of a flexible one
    driven_inertia_kgm2: f8
    inverse_driven_inertia: f8
    inverse_link_inertia: f8
    flexible: i4
    reducer_stiffness_Nmprad: f8
    reducer_damping_Nmspr: f8
    # actuator
    current_per_torque_ApNm: f8  # 1 / (n K_m)
    torque_per_current_NmpA: f8  # n K_m
    current_limit_A: f8
    current_decay: f8  # exp(-step / lag), 0 without lag
    delay_substeps: i4
    torque_ripples: i4  # how many of the following are in use
    torque_ripple_Nm: Annotated[np.ndarray, array_of(f8, RIPPLES)]
    torque_ripple_turns_prad: Annotated[np.ndarray, array_of(f8, RIPPLES)]  # order per joint turn / 2 pi
    torque_ripple_phase_turns: Annotated[np.ndarray, array_of(f8, RIPPLES)]
    # friction
    friction_kind: i4  # FrictionKind
    friction_modulated: i4  # friction ripple or temperature in use
    friction: FrictionConstants
    positive_factor: f8  # n times the scale of the direction: motor-side curve to joint torque
    negative_factor: f8
    friction_ripple: f8
    friction_ripple_turns_prad: f8
    bristle_stiffness_Nmprad: f8
    bristle_damping_Nmspr: f8
    # heating
    thermal: i4
    ambient_degC: f8
    heating_KpA2: f8  # steady temperature rise per squared ampere
    thermal_gain: f8  # 1 - exp(-step / time constant)
    friction_per_kelvin: f8  # relative change of friction
    # load
    load_torque_Nm: f8
    load_step_Nm: f8
    load_step_substep: i8
    gravity_Nm: f8  # m g l
    end_stops: i4
    end_stop_min_rad: f8
    end_stop_max_rad: f8
    end_stop_stiffness_Nmprad: f8
    end_stop_damping_Nmspr: f8
    # encoder
    encoder_motor_side: i4
    counts_prad: f8  # per joint radian, with the sign of the direction
    encoder_offset_counts: f8
    encoder_noise_counts: f8


@record
class PlantState:
    """Where the joint is; `added_load_torque_Nm` may be written from outside (a hand on the joint, a jam)."""

    substep: i8
    time_s: f8
    joint_position_rad: f8
    joint_velocity_radps: f8
    motor_position_rad: f8  # motor angle / n: equals the joint's unless it is flexible
    motor_velocity_radps: f8
    current_A: f8
    actuator_torque_Nm: f8  # delivered, ripple included
    friction_torque_Nm: f8  # positive against positive motion
    load_torque_Nm: f8  # constant, step and added load; positive against positive motion
    gravity_torque_Nm: f8
    reducer_torque_Nm: f8  # through the flexible element; 0 for a rigid joint
    bristle_deflection_rad: f8
    motor_temperature_degC: f8
    added_load_torque_Nm: f8
    # faults, written by `hil.faults.plant_faults`; all zero = none
    encoder_stuck: i4
    encoder_reversed: i4
    current_capped: i4
    encoder_stuck_rad: f8
    encoder_pivot_rad: f8  # a reversed encoder counts backwards from here
    encoder_error_rad: f8  # jump and drift
    current_cap_A: f8
    noise_state: u8  # xorshift64, never 0
    delay_slot: i4
    delayed_current_A: Annotated[np.ndarray, array_of(f8, DELAY_SLOTS)]
