"""Records of the virtual drive and of the encoder node: their objects, and what the compiled core keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any

import numpy as np

from jointctl.firmware_py.schema import array_of, dtype_of, f8, i1, i2, i4, i8, marks_of, record, u1, u2, u4


@dataclass(frozen=True)
class At:
    """Index and sub-index of the object that a field holds; of an array, those of its first element."""

    index: int
    sub: int = 0


def object_fields(*records: type) -> dict[tuple[int, int], str]:
    """(index, sub) -> "field", or "field[element]" of an array, of every field with an `At`."""
    found: dict[tuple[int, int], str] = {}
    for cls in records:
        for name, at in marks_of(cls, At).items():
            shape = dtype_of(cls)[name].shape
            elements = [f"{name}[{i}]" for i in range(shape[0])] if shape else [name]
            found |= {(at.index, at.sub + i): element for i, element in enumerate(elements)}
    return found


# --- Memory of the virtual encoder node (CiA 406): its objects as typed fields, and the state of the compiled core ---


ENCODER_MAPPED = 2


@record
class EncoderObjects:
    error_register: Annotated[u1, At(0x1001)]
    sync_cob_id: Annotated[u4, At(0x1005)]
    emcy_cob_id: Annotated[u4, At(0x1014)]
    heartbeat_ms: Annotated[u2, At(0x1017)]
    tpdo_cob_id: Annotated[u4, At(0x1800, 1)]
    tpdo_type: Annotated[u1, At(0x1800, 2)]
    tpdo_inhibit_100us: Annotated[u2, At(0x1800, 3)]
    tpdo_timer_ms: Annotated[u2, At(0x1800, 5)]
    tpdo_count: Annotated[u1, At(0x1A00)]
    tpdo_mapping: Annotated[np.ndarray, array_of(u4, ENCODER_MAPPED), At(0x1A00, 1)]
    units_per_turn: Annotated[u4, At(0x6001)]
    range_counts: Annotated[u4, At(0x6002)]
    position: Annotated[u4, At(0x6004)]
    cyclic_timer_ms: Annotated[u2, At(0x6200)]
    alarms: Annotated[u2, At(0x6503)]
    warnings: Annotated[u2, At(0x6505)]


@record
class EncoderNode:
    """One element inside `Device`: it sits on the joint of that drive and on its bus.  node_id 0 = there is none."""

    objects: EncoderObjects
    default_objects: EncoderObjects
    node_id: i4
    counts_prad: f8  # with the sign of its direction
    offset_counts: f8
    nmt: i4  # NmtState
    boot_pending: i4
    heartbeat_due_ns: i8
    tpdo_due_ns: i8
    syncs: i4
    sent_error: i4  # EMCY error code that the bus knows of
    # faults
    error_code: i4  # EMCY error code of what is wrong; 0 = nothing
    stuck: i4
    stuck_counts: i8
    error_rad: f8  # added to the true angle


ENCODER_FIELDS = object_fields(EncoderObjects)


# --- Memory of the virtual drive: its CANopen objects as typed fields, and the state of the compiled core ---
# `CommunicationObjects` holds what CiA 301 defines (1000..1FFF), `DriveObjects` what CiA 402 and the maker define.
# They are separate because "reset communication" restores only the first one.  Units are those of the objects
# (counts, per mille of the rated value, ms, ...), as in the EDS; the rest of the device is in SI units.


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
    error_register: Annotated[u1, At(0x1001)]
    error_count: Annotated[u1, At(0x1003)]
    error_history: Annotated[np.ndarray, array_of(u4, HISTORY), At(0x1003, 1)]
    sync_cob_id: Annotated[u4, At(0x1005)]
    sync_period_us: Annotated[u4, At(0x1006)]
    guard_time_ms: Annotated[u2, At(0x100C)]
    life_time_factor: Annotated[u1, At(0x100D)]
    emcy_cob_id: Annotated[u4, At(0x1014)]
    emcy_inhibit_100us: Annotated[u2, At(0x1015)]
    consumer_heartbeat: Annotated[np.ndarray, array_of(u4, CONSUMERS), At(0x1016, 1)]  # node << 16 | ms
    producer_heartbeat_ms: Annotated[u2, At(0x1017)]
    sync_overflow: Annotated[u1, At(0x1019)]  # highest value of the SYNC counter, 0 = none
    error_behaviour: Annotated[u1, At(0x1029, 1)]
    identity: Annotated[np.ndarray, array_of(u4, 4), At(0x1018, 1)]
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
    sync_timeout_ms: Annotated[u2, At(0x2102)]
    motor_temperature_ddegC: Annotated[i2, At(0x2103)]  # tenths of a degree
    abort_option: Annotated[i2, At(0x6007)]
    error_code: Annotated[u2, At(0x603F)]
    controlword: Annotated[u2, At(0x6040)]
    statusword: Annotated[u2, At(0x6041)]
    quick_stop_option: Annotated[i2, At(0x605A)]
    shutdown_option: Annotated[i2, At(0x605B)]
    disable_option: Annotated[i2, At(0x605C)]
    halt_option: Annotated[i2, At(0x605D)]
    fault_reaction_option: Annotated[i2, At(0x605E)]
    mode: Annotated[i1, At(0x6060)]
    mode_display: Annotated[i1, At(0x6061)]
    demand_position: Annotated[i4, At(0x6062)]
    position: Annotated[i4, At(0x6064)]
    second_position: Annotated[i4, At(0x60E4, 1)]
    following_window: Annotated[u4, At(0x6065)]
    following_timeout_ms: Annotated[u2, At(0x6066)]
    position_window: Annotated[u4, At(0x6067)]
    demand_velocity: Annotated[i4, At(0x606B)]
    velocity: Annotated[i4, At(0x606C)]
    velocity_window: Annotated[u2, At(0x606D)]
    target_torque: Annotated[i2, At(0x6071)]
    max_torque: Annotated[u2, At(0x6072)]
    max_current: Annotated[u2, At(0x6073)]
    demand_torque: Annotated[i2, At(0x6074)]
    rated_current_mA: Annotated[u4, At(0x6075)]
    rated_torque: Annotated[u4, At(0x6076)]
    torque: Annotated[i2, At(0x6077)]
    current: Annotated[i2, At(0x6078)]
    dc_link_mV: Annotated[u4, At(0x6079)]
    target_position: Annotated[i4, At(0x607A)]
    home_offset: Annotated[i4, At(0x607C)]
    position_limit: Annotated[np.ndarray, array_of(i4, 2), At(0x607D, 1)]
    max_profile_velocity: Annotated[u4, At(0x607F)]
    max_motor_speed_rpm: Annotated[u4, At(0x6080)]
    profile_velocity: Annotated[u4, At(0x6081)]
    profile_acceleration: Annotated[u4, At(0x6083)]
    profile_deceleration: Annotated[u4, At(0x6084)]
    quick_stop_deceleration: Annotated[u4, At(0x6085)]
    motion_profile: Annotated[i2, At(0x6086)]
    torque_slope: Annotated[u4, At(0x6087)]
    torque_profile: Annotated[i2, At(0x6088)]
    encoder_resolution: Annotated[np.ndarray, array_of(u4, 2), At(0x608F, 1)]
    homing_method: Annotated[i1, At(0x6098)]
    homing_speed: Annotated[np.ndarray, array_of(u4, 2), At(0x6099, 1)]
    homing_acceleration: Annotated[u4, At(0x609A)]
    velocity_offset: Annotated[i4, At(0x60B1)]
    torque_offset: Annotated[i2, At(0x60B2)]
    interpolation_time: Annotated[u1, At(0x60C2, 1)]
    interpolation_exponent: Annotated[i1, At(0x60C2, 2)]
    following_error: Annotated[i4, At(0x60F4)]
    target_velocity: Annotated[i4, At(0x60FF)]
    supported_modes: Annotated[u4, At(0x6502)]
    makers_limit: u4  # the maker's own limit, at whatever index the drive that is shown has it


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
    velocity_units_prad: f8  # of 60FF, 60B1, 606B, 606C and 607F in a rad/s of the joint, with the same sign
    makers_limit_rated_counts: f8  # what `makers_limit` holds at rated torque; 0 = there is no such object
    rated_torque_unit_mNm: f8  # of 6076
    motor_torque_constant_NmpA: f8  # turns the current limit 6073 into a torque limit
    velocity_gain_Nmspr: f8
    velocity_integral_Nmprad: f8
    position_gain_ps: f8  # 1/s
    velocity_feed: f8  # share of the set-point's velocity that CSP feeds forward by itself
    loop_period_s: f8  # of its loops in CSP and CSV; 0 = each substep of the plant
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
    loop_due_s: f8  # until the loops of CSP and CSV are computed again
    demand: f8  # torque demand before limits [per mille of rated]
    saturated: i4
    following_time_s: f8


# the objects of the PDOs have an index for each of them; objects without a field are constants of the EDS or strings
def _fields() -> dict[tuple[int, int], str]:
    fields = object_fields(CommunicationObjects, DriveObjects)
    for pdo in range(PDOS):
        for way, base in (("rpdo", 0x1400), ("tpdo", 0x1800)):
            fields[base + pdo, 1] = f"{way}_cob_id[{pdo}]"
            fields[base + pdo, 2] = f"{way}_type[{pdo}]"
            fields[base + pdo, 5] = f"{way}_timer_ms[{pdo}]"
            fields[base + 0x200 + pdo, 0] = f"{way}_count[{pdo}]"
            for entry in range(MAPPED):
                fields[base + 0x200 + pdo, 1 + entry] = f"{way}_mapping[{pdo * MAPPED + entry}]"
        fields[0x1800 + pdo, 3] = f"tpdo_inhibit_100us[{pdo}]"
        fields[0x1800 + pdo, 6] = f"tpdo_sync_start[{pdo}]"
    return fields


FIELDS = _fields()  # (index, sub) -> "field" or "field[flat element]" of the group that the index belongs to
