"""Memory of the virtual drive: its CANopen objects as typed fields, and the state of the compiled core.

`CommunicationObjects` holds what CiA 301 defines (1000..1FFF), `DriveObjects` what CiA 402 and the maker define.
They are separate because "reset communication" restores only the first one.  Units are those of the objects
(counts, per mille of the rated value, ms, ...), as in the EDS; the rest of the device is in SI units.

`device_fields` says which field holds which object.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Annotated, Any

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i1, i2, i4, i8, record, u1, u2, u4
from jointctl.hil.canopen.encoder_records import EncoderNode

# Widens an object's value before arithmetic (uint8 << 8 would overflow in plain Python); typed for mypy.
int64: Callable[[Any], int] = np.int64  # type: ignore[assignment]

PDOS = 4
# transmission types (CiA 301, 7.5.2.35): up to the first at SYNC, from the second on at an event or on receipt
LAST_SYNCHRONOUS, EVENT_DRIVEN = 240, 254
MAPPED = 8
HISTORY = 8
CONSUMERS = 2


class NmtState(IntEnum):
    """CiA 301 states as a heartbeat carries them."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class PowerState(IntEnum):
    """CiA 402 states of the power drive system."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class Mode(IntEnum):
    """Modes of operation (6060) that this drive has."""

    NONE = 0
    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    TORQUE = 4
    HOMING = 6
    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10


class HomingState(IntEnum):
    """What bits 10, 12 and 13 of the statusword tell in homing mode, apart from standstill."""

    IDLE = 0  # not started, or interrupted
    SEARCHING = 1
    ATTAINED = 2
    FAILED = 3


@record
class CommunicationObjects:
    error_register: u1
    error_count: u1
    error_history: Annotated[np.ndarray, array_of(u4, HISTORY)]
    sync_cob_id: u4
    sync_period_us: u4
    guard_time_ms: u2
    life_time_factor: u1
    emcy_cob_id: u4
    emcy_inhibit_100us: u2
    consumer_heartbeat: Annotated[np.ndarray, array_of(u4, CONSUMERS)]  # node << 16 | ms
    producer_heartbeat_ms: u2
    sync_overflow: u1  # highest value of the SYNC counter, 0 = none
    error_behaviour: u1
    identity: Annotated[np.ndarray, array_of(u4, 4)]
    rpdo_cob_id: Annotated[np.ndarray, array_of(u4, PDOS)]
    rpdo_type: Annotated[np.ndarray, array_of(u1, PDOS)]
    rpdo_timer_ms: Annotated[np.ndarray, array_of(u2, PDOS)]
    rpdo_count: Annotated[np.ndarray, array_of(u1, PDOS)]
    rpdo_mapping: Annotated[np.ndarray, array_of(u4, PDOS, MAPPED)]
    tpdo_cob_id: Annotated[np.ndarray, array_of(u4, PDOS)]
    tpdo_type: Annotated[np.ndarray, array_of(u1, PDOS)]
    tpdo_inhibit_100us: Annotated[np.ndarray, array_of(u2, PDOS)]
    tpdo_timer_ms: Annotated[np.ndarray, array_of(u2, PDOS)]
    tpdo_sync_start: Annotated[np.ndarray, array_of(u1, PDOS)]
    tpdo_count: Annotated[np.ndarray, array_of(u1, PDOS)]
    tpdo_mapping: Annotated[np.ndarray, array_of(u4, PDOS, MAPPED)]


@record
class DriveObjects:
    sync_timeout_ms: u2
    motor_temperature_ddegC: i2  # tenths of a degree
    abort_option: i2
    error_code: u2
    controlword: u2
    statusword: u2
    quick_stop_option: i2
    shutdown_option: i2
    disable_option: i2
    halt_option: i2
    fault_reaction_option: i2
    mode: i1
    mode_display: i1
    demand_position: i4
    position: i4
    second_position: i4
    following_window: u4
    following_timeout_ms: u2
    position_window: u4
    demand_velocity: i4
    velocity: i4
    velocity_window: u2
    target_torque: i2
    max_torque: u2
    max_current: u2
    demand_torque: i2
    rated_current_mA: u4
    rated_torque_mNm: u4
    torque: i2
    current: i2
    dc_link_mV: u4
    target_position: i4
    home_offset: i4
    position_limit: Annotated[np.ndarray, array_of(i4, 2)]
    max_profile_velocity: u4
    max_motor_speed_rpm: u4
    profile_velocity: u4
    profile_acceleration: u4
    profile_deceleration: u4
    quick_stop_deceleration: u4
    motion_profile: i2
    torque_slope: u4
    torque_profile: i2
    encoder_resolution: Annotated[np.ndarray, array_of(u4, 2)]
    homing_method: i1
    homing_speed: Annotated[np.ndarray, array_of(u4, 2)]
    homing_acceleration: u4
    torque_offset: i2
    interpolation_time: u1
    interpolation_exponent: i1
    following_error: i4
    target_velocity: i4
    supported_modes: u4


@record
class Device:
    """The whole drive apart from the plant; one element of a record array."""

    communication: CommunicationObjects
    drive: DriveObjects
    default_communication: CommunicationObjects
    default_drive: DriveObjects
    encoder: EncoderNode  # a second encoder on the same joint and bus
    second_counts_prad: f8  # of 60E4:1; 0 = there is none
    second_offset_counts: f8
    # settings, fixed after construction
    node_id: i4
    reduction_ratio: f8
    counts_per_rad: f8  # at the joint; negative when the encoder counts against the joint
    motor_torque_constant_NmpA: f8  # turns the current limit 6073 into a torque limit
    velocity_gain_Nmspr: f8
    velocity_integral_Nmprad: f8
    position_gain_ps: f8  # 1/s
    # test access: while not zero the cause of this fault (an EMCY code) is present
    inject_fault_code: u2
    torque_sign: f8  # -1.0: positive torque of the motor drives the joint to negative angles
    torque_reversed: i4  # test access: the target torque counts the other way
    # NMT and errors
    nmt: i4  # NmtState
    boot_pending: i4
    application_resets: i8  # how often the defaults were restored
    time_ns: i8  # plant time
    primed: i4  # 0 until the first call that carries a time
    next_due_ns: i8  # no timer runs out before; 0 = work it out again
    heartbeat_due_ns: i8
    heartbeat_period_ms: i4  # the value that heartbeat_due_ns was made from
    consumer_entry: Annotated[np.ndarray, array_of(u4, CONSUMERS)]
    consumer_heard_ns: Annotated[np.ndarray, array_of(i8, CONSUMERS)]  # 0 = not yet heard
    sync_heard_ns: i8  # 0 = not yet heard
    guard_heard_ns: i8  # 0 = not yet asked by a node-guarding master
    guard_toggle: i4
    emcy_sent_ns: i8  # 0 = none yet
    emcy_waiting: i4  # held back by the inhibit time, oldest first
    emcy_waiting_words: Annotated[np.ndarray, array_of(u4, HISTORY)]  # register << 16 | code
    rpdo_heard_ns: Annotated[np.ndarray, array_of(i8, PDOS)]
    rpdo_waiting: Annotated[np.ndarray, array_of(i4, PDOS)]  # received, applied at the next SYNC
    rpdo_data: Annotated[np.ndarray, array_of(u1, PDOS, 8)]
    tpdo_sent_ns: Annotated[np.ndarray, array_of(i8, PDOS)]
    tpdo_event: Annotated[np.ndarray, array_of(i4, PDOS)]
    tpdo_syncs: Annotated[np.ndarray, array_of(i4, PDOS)]
    tpdo_started: Annotated[np.ndarray, array_of(i4, PDOS)]  # the SYNC with the start value has been there
    event_status: i8  # status of which the event-driven TPDOs know
    communication_errors: i4  # bit mask of causes that are present
    fault_code: i4  # latched drive fault, 0 = none
    # CiA 402
    state: i4  # PowerState
    last_controlword: i4
    resync: i4  # 1 = the references start from where the joint is
    braking: i4  # 0 no, 2 a stop ramp is about to start, 1 it runs
    brake_deceleration_radps2: f8
    after_brake: i4  # PowerState to enter at standstill
    brake_time_left_s: f8
    reference_position_rad: f8  # position loop, encoder side
    reference_velocity_radps: f8
    segment_target: i4  # CSP: interpolated towards it [counts]
    segment_velocity_radps: f8
    segment_left_s: f8
    setpoint_active: i4
    setpoint_acknowledged: i4
    setpoint_position_rad: f8
    setpoint_waiting: i4  # a second one, taken when the first is reached
    setpoint_next_rad: f8
    homing: i4  # HomingState
    homing_cell: i8  # index pulses passed, at the start
    homing_time_left_s: f8
    home_shift_counts: i8  # encoder minus reported position
    integral_Nm: f8
    demand: f8  # torque demand before limits [per mille of rated]
    saturated: i4
    following_time_s: f8
