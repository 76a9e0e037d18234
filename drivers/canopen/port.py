"""The memory of the cyclic exchange with one CANopen drive."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u1, u4

# slots of the frame array that goes with a port
SLOT_SYNC = 0
SLOT_HEARTBEAT = 1
SLOT_RPDO = 2
SLOT_RECEIVED = 3
FRAME_SLOTS = 4
SCRATCH_WORDS = 8


class AlignTo(IntEnum):
    """What to do about an encoder that does not know its angle when it is switched on."""

    NOTHING = 0  # both are absolute
    FIRST = 1  # the second one takes the angle of the first
    SECOND = 2


@record
class SecondPosition:
    """A second encoder of the joint: a node of its own (CiA 406), or another object of the drive."""

    tpdo_id: u4  # 0 = there is none
    tpdo_length: i4
    position_at: i4  # byte position of 32 bits
    emergency_id: u4  # of an encoder node; 0 = none
    heartbeat_id: u4
    range_counts: i8  # the reading runs over at this many counts
    zero_counts: i8
    radpcount: f8  # direction included, at the joint
    align: i4  # AlignTo
    feeds_law: i4
    # state
    primed: i4
    aligned: i4
    last_counts: i8  # as received
    counts: i8  # since zero_counts, unwrapped
    offset_rad: f8
    error: i4  # EMCY error code that is present
    lost: i4  # it has restarted: what it counts from is not known any more


@record
class CanopenPort:
    """Identifiers, layout and scaling (set by commissioning), and what has been seen on the bus."""

    fd: i4
    stamped: i4  # frames carry the time they were sent: virtual bus only
    node: i4
    sync_id: u4
    tpdo_id: u4
    rpdo_id: u4
    emergency_id: u4
    heartbeat_id: u4  # of the drive
    own_heartbeat_id: u4
    heartbeat_cycles: i4  # own heartbeat every so many cycles; 0 = none
    tpdo_length: i4
    rpdo_length: i4
    # byte positions inside the PDOs; -1 = not mapped
    status_at: i4
    position_at: i4
    torque_at: i4
    control_at: i4
    target_at: i4
    rpdo_filler: Annotated[np.ndarray, array_of(u1, 8)]  # of the RPDO where nothing is written
    # scaling, directions included: all at the joint
    position_radpcount: f8
    zero_counts: i8
    torque_Nmppermille: f8
    max_permille: i4
    target_is_velocity: i4  # the target is 60FF (32 bit) instead of 6071 (16 bit)
    velocity_radpspunit: f8  # of 60FF
    clock: Annotated[np.ndarray, array_of(i8, 2)]  # scratch of the stamps
    second: SecondPosition
    # state
    first_rad: f8  # position by 6064
    first_offset_rad: f8
    primed: i4
    last_counts: i8  # as received, 32 bit
    counts: i8  # unwrapped
    cycle: i8
    state: i4  # cia402.State
    nmt_state: i4
    in_cycle: i4  # 1 from SYNC to RPDO
    seen: i4  # TPDOs since the last SYNC: 1 the drive's, 2 the second encoder's
    answered: i4  # those of them that came before the RPDO
    surplus: i8  # TPDOs after those: doubled or late
    heartbeat_watched: i4  # the drive has been told to send its own
    heartbeat_heard_cycle: i8
    error_cycle: i8  # in which the last EMCY came
    error_reset: i4  # the drive has said since that the error is gone
    unheeded_cycles: i4  # in a row in which the drive stayed enabled although it was asked to stop
    malformed: i8  # TPDOs that were too short
    error_frames: i8
    send_failures: i8
    consecutive_failures: i4
    last_errno: i4
    bits_sent: i8  # both directions, worst-case stuffing
