"""The cyclic protocol of one CANopen drive without any input or output: frames to send, frames received.

The real loop, the portable loop and the lockstep simulation all use these three functions on the same record:

    begin_cycle  ->  SYNC, and the heartbeat when it is due
    accept_frame <-  TPDO (statusword, position, torque), EMCY, heartbeat and boot-up of the drive
    end_cycle    ->  RPDO (controlword, target torque, velocity or position; torque offset), RPDO with velocity offset

A target position follows the joint while it is not enabled, so that it does not jump when it is.

Two encoders on one joint: a sample counts once both have answered the same SYNC.  So the loss of either ends the run as
a stale sample.  An encoder node that reports an error (EMCY) or that has restarted is not believed: no sample counts
any more.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.drivers.can.frames import ERROR_FLAG, Frame, worst_frame_bits
from jointctl.drivers.canopen import cia
from jointctl.drivers.canopen.cia import NmtState, State
from jointctl.drivers.drive import HALF_WRAP, WRAP, saturated, take_counts
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import ENCODER_RESTARTED, Command, Sample
from jointctl.firmware_py.schema import INT32_MAX, array_of, f8, i4, i8, record, u1, u4
from jointctl.firmware_py.states import DriveRequest

# slots of the frame array that goes with a port
SLOT_SYNC = 0
SLOT_HEARTBEAT = 1
SLOT_RPDO = 2
SLOT_RECEIVED = 3
SLOT_OFFSET = 4  # the RPDO with the velocity offset; its identifier is 0 where there is none
FRAME_SLOTS = 5
SCRATCH_WORDS = 8
SEEN_FIRST, SEEN_SECOND = 1, 2
_BOTH = SEEN_FIRST | SEEN_SECOND
# A drive that was commanded to stop and does not report that it does so, or reports nothing, does not receive us (SYNC
# or RPDO lost).  Its watchdog is what is left: after so many cycles the heartbeat is withheld for the rest of the run.
# One report may be damaged, or older than the enabling that the drive has carried out.  Two alike count that say "off"
# or "in fault", after a quick stop "braking" as well.  Others without torque, such as of a drive that waits for its
# brake to close, count as long as they come.
IGNORED_MAX_CYCLES = 20
STILL_REPORTS_CYCLES = 2
# an error code stays for so long although the drive has reset it: it may be why the joint stops
ERROR_SHOWN_CYCLES = 20
_MOST_COUNTS = 2.0**62
_WORST_BITS = np.array([worst_frame_bits(length) for length in range(9)])
decode_state, drive_state = kernel(cia.state_of_word), kernel(cia.drive_state)
control_word = kernel(cia.control_word)


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

    fd: i4  # of the bus, in the record of its first drive
    bus: i4  # axis of the first drive on the same bus
    node: i4
    sync_id: u4
    tpdo_id: u4
    rpdo_id: u4
    emergency_id: u4
    heartbeat_id: u4  # of the drive
    own_heartbeat_id: u4
    heartbeat_cycles: i4  # own heartbeat every so many cycles; 0 = none
    period_ns: i8  # of the loop; 0: an answer of any age is a sample
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
    velocity_radpspunit: f8  # of 60FF and 60B1
    target_is_position: i4  # the target is 607A (32 bit)
    has_torque_offset: i4  # 1: the RPDO holds 60B2 as well
    torque_offset_at: i4
    offset_rpdo_id: u4  # of the RPDO that holds 60B1 alone; 0 = there is none
    offset_share: f8  # of the target's velocity that goes into 60B1
    second: SecondPosition
    # state
    first_rad: f8  # position by 6064
    first_offset_rad: f8
    primed: i4
    last_counts: i8  # as received, 32 bit
    counts: i8  # unwrapped
    cycle: i8
    state: i4  # cia.State
    repeated: i4  # 1: the last two reports were of this state, or a boot-up was
    heard_cycle: i8  # of the last report
    nmt_state: i4
    wake_ns: i8  # when the last cycle began
    stale: i4  # 1: what waits before SYNC answers one that is too long ago
    in_cycle: i4  # 1 from SYNC to RPDO
    seen: i4  # TPDOs since the last SYNC: 1 the drive's, 2 the second encoder's
    answered: i4  # those of them that came before the RPDO
    surplus: i8  # TPDOs after those: doubled or late
    heartbeat_watched: i4  # the drive was set to send its own
    heartbeat_heard_cycle: i8
    error_cycle: i8  # in which the last EMCY came
    error_reset: i4  # the drive has said since that the error is gone
    asked: i4  # 1: the drive was asked to enable, or to prepare for it
    ignored_cycles: i4  # in a row in which the drive was asked to stop, and did not report that it does
    malformed: i8  # TPDOs that were too short
    error_frames: i8
    of_others: i8  # RPDOs to the drive that differ from the newest of ours: another controller's
    of_another_sync: i8  # SYNC between our own cycles
    of_another_heart: i8  # our own heartbeats that the loop has not sent: they would feed the drive's watchdog for us
    send_failures: i8
    consecutive_failures: i4
    last_errno: i4
    bits_sent: i8  # both directions, worst-case stuffing


@kernel
def get_u16(data: np.ndarray, at: int) -> int:
    """Little-endian unsigned 16 bit at byte `at`."""
    low, high = np.int64(data[at]), np.int64(data[at + 1])  # uint8 would overflow in the shift
    return low | high << 8  # type: ignore[return-value]


@kernel
def get_i16(data: np.ndarray, at: int) -> int:
    value = get_u16(data, at)
    return value - 0x10000 if value >= 0x8000 else value


@kernel
def get_i32(data: np.ndarray, at: int) -> int:
    value = get_u16(data, at) | get_u16(data, at + 2) << 16
    return value - WRAP if value >= HALF_WRAP else value


@kernel
def put_u16(data: np.ndarray, at: int, value: int) -> None:
    """Little-endian 16 bit; negative values as two's complement."""
    data[at] = value & 0xFF
    data[at + 1] = value >> 8 & 0xFF


# --- a second encoder ---


@kernel
def centred(counts: int, range_counts: int) -> int:
    """`counts` modulo the range, in [-range/2, range/2)."""
    half = range_counts // 2
    return (counts + half) % range_counts - half


@kernel
def take_second_counts(second: SecondPosition, reading: int) -> None:
    """Unwrap the reading: the joint moves less than half the range between two samples.

    The first one is taken as the angle nearest to zero, so that a range of one turn may run over beside it.
    """
    if second.primed == 0:
        second.primed = 1
        second.counts = centred(reading - second.zero_counts, second.range_counts)
    else:
        second.counts += centred(reading - second.last_counts, second.range_counts)
    second.last_counts = reading


@kernel
def watch_second(second: SecondPosition, frame: Frame, sample: Sample) -> None:
    """EMCY and heartbeat of an encoder node."""
    if frame.can_id == second.emergency_id:
        if frame.length >= 2:
            second.error = get_u16(frame.payload, 0)
            if second.lost == 0:
                sample.encoder_error = second.error
    elif frame.length >= 1 and frame.payload[0] & 0x7F == 0:
        second.lost = 1
        sample.encoder_error = ENCODER_RESTARTED


@kernel
def publish_sample(port: CanopenPort, sample: Sample, now_ns: int) -> bool:
    """The sample, if it is complete: with a second encoder, both positions of this cycle."""
    second = port.second
    if port.stale != 0:
        port.surplus += 1
        return False
    if second.tpdo_id == 0:
        sample.position_rad = port.first_rad
        sample.time_ns = now_ns
        sample.count += 1
        return True
    if port.seen != _BOTH or second.error != 0 or second.lost != 0:
        return False
    second_rad = second.counts * second.radpcount
    if second.aligned == 0:
        second.aligned = 1
        if second.align == AlignTo.FIRST:
            second.offset_rad = port.first_rad - second_rad
        elif second.align == AlignTo.SECOND:
            port.first_offset_rad = second_rad - port.first_rad
    first_rad = port.first_rad + port.first_offset_rad
    second_rad += second.offset_rad
    sample.position_rad = second_rad if second.feeds_law != 0 else first_rad
    sample.second_position_rad = first_rad if second.feeds_law != 0 else second_rad
    sample.time_ns = now_ns
    sample.count += 1
    return True


# --- a cycle ---


@kernel
def note_wake(port: CanopenPort, now_ns: int) -> None:
    """A cycle begins, before the frames that wait are taken: is an answer among them too old for this slot?

    A drive may answer in the next cycle, each time; what waits for longer than that has waited through a pause of the
    computer, and as the position of this slot it would be a leap.  It is left out, and the age of the sample counts on.
    """
    port.stale = 1 if 2 * (now_ns - port.wake_ns) > 3 * port.period_ns > 0 else 0
    port.wake_ns = now_ns


@kernel
def begin_cycle(port: CanopenPort, frames: np.ndarray) -> int:
    """Write SYNC (slot 0) and, when due, the heartbeat (slot 1); returns how many frames to send."""
    frames[SLOT_SYNC].can_id = port.sync_id
    frames[SLOT_SYNC].length = 0
    port.bits_sent += _WORST_BITS[0]
    port.in_cycle = 1
    port.stale = 0
    port.answered = 0
    due = port.heartbeat_cycles > 0 and port.cycle % port.heartbeat_cycles == 0
    port.cycle += 1
    port.seen = 0
    if not due or port.ignored_cycles > IGNORED_MAX_CYCLES:
        return 1
    frames[SLOT_HEARTBEAT].can_id = port.own_heartbeat_id
    frames[SLOT_HEARTBEAT].length = 1
    frames[SLOT_HEARTBEAT].payload[0] = NmtState.OPERATIONAL
    port.bits_sent += _WORST_BITS[1]
    return 2


@kernel
def answer_owed(port: CanopenPort) -> bool:
    """Before `begin_cycle`: whether the last SYNC still lacks a TPDO, so that the next one may belong to it."""
    wanted = SEEN_FIRST if port.second.tpdo_id == 0 else _BOTH
    return port.cycle > 0 and port.seen & wanted != wanted


@kernel
def _answers(port: CanopenPort, frame: Frame, tpdo_length: int, encoder: int) -> bool:
    """Whether the TPDO of an `encoder`, SEEN_FIRST or SEEN_SECOND, is long enough, and neither doubled nor late.

    One is sent for each SYNC.  One that comes between the cycles although the SYNC was answered repeats or delays an
    old value: it must not look like a new sample.
    """
    if frame.length < tpdo_length:
        port.malformed += 1
        return False
    if port.in_cycle == 0 and port.answered & encoder != 0:
        port.surplus += 1
        return False
    if port.in_cycle != 0:
        port.answered |= encoder
    return True


@kernel
def _accept_tpdo(port: CanopenPort, frame: Frame, sample: Sample, now_ns: int) -> bool:
    """Take statusword, position and torque; True if that makes a new sample."""
    if not _answers(port, frame, port.tpdo_length, SEEN_FIRST):
        return False
    sample.status_word = get_u16(frame.payload, port.status_at)
    state = decode_state(sample.status_word)
    port.repeated = 1 if state == port.state else 0
    port.state, port.heard_cycle = state, port.cycle
    sample.drive_state = drive_state(port.state)
    take_counts(port, get_i32(frame.payload, port.position_at))
    port.first_rad = (port.counts - port.zero_counts) * port.position_radpcount
    if port.torque_at >= 0:
        sample.torque_Nm = get_i16(frame.payload, port.torque_at) * port.torque_Nmppermille
    if port.error_reset != 0 and port.cycle - port.error_cycle > ERROR_SHOWN_CYCLES:
        port.error_reset = 0
        sample.drive_error = 0
    port.seen |= SEEN_FIRST
    sample.sends_none = 0  # a TPDO is sent in operational only
    return publish_sample(port, sample, now_ns)


@kernel
def _accept_second(port: CanopenPort, frame: Frame, sample: Sample, now_ns: int) -> bool:
    """Take the position of a second encoder; True if that makes a new sample."""
    if not _answers(port, frame, port.second.tpdo_length, SEEN_SECOND):
        return False
    take_second_counts(port.second, get_i32(frame.payload, port.second.position_at))
    port.seen |= SEEN_SECOND
    return publish_sample(port, sample, now_ns)


@kernel
def accept_frame(port: CanopenPort, frame: Frame, sample: Sample, now_ns: int) -> bool:
    """Take one received frame; True if it was the TPDO with a new sample.  Others are only counted."""
    port.bits_sent += _WORST_BITS[min(frame.length, 8)]
    if frame.can_id & ERROR_FLAG != 0:
        port.error_frames += 1
    elif frame.can_id == port.tpdo_id:
        return _accept_tpdo(port, frame, sample, now_ns)
    elif port.second.tpdo_id != 0 and frame.can_id == port.second.tpdo_id:
        return _accept_second(port, frame, sample, now_ns)
    elif port.second.emergency_id != 0 and (
        frame.can_id == port.second.emergency_id or frame.can_id == port.second.heartbeat_id
    ):
        watch_second(port.second, frame, sample)
    elif frame.can_id == port.emergency_id:
        if frame.length >= 2:
            code = get_u16(frame.payload, 0)
            if code != 0:
                sample.drive_error = code
                port.error_cycle = port.cycle
            port.error_reset = 1 if code == 0 else 0
    elif frame.can_id == port.heartbeat_id:
        if frame.length >= 1:
            port.nmt_state = frame.payload[0] & 0x7F
            port.heartbeat_heard_cycle = port.cycle
            left = port.nmt_state == NmtState.STOPPED or port.nmt_state == NmtState.PRE_OPERATIONAL
            sample.sends_none = 1 if left else 0
            if port.nmt_state == NmtState.BOOT_UP:
                sample.restarts += 1
                # a drive that has just booted has no power (CiA 402-2), and sends no TPDO that would say so; one whose
                # communication alone was reset stops as 6007 says
                port.state, port.repeated = State.SWITCH_ON_DISABLED, 1
                sample.drive_state = drive_state(port.state)
    return False


@kernel
def torque_permille(port: CanopenPort, torque_Nm: float) -> int:
    """Joint torque [Nm] in 1/1000 of the drive's rated value."""
    return saturated(torque_Nm / port.torque_Nmppermille, float(port.max_permille))


@kernel
def velocity_units(port: CanopenPort, velocity_radps: float) -> int:
    """Joint velocity [rad/s] in units of 60FF."""
    return saturated(velocity_radps / port.velocity_radpspunit, float(INT32_MAX))


@kernel
def position_counts(port: CanopenPort, position_rad: float) -> int:
    """Joint position [rad] in counts of 607A, to be cut to 32 bits; where the joint is if it is not finite."""
    value = (position_rad - port.first_offset_rad) / port.position_radpcount + port.zero_counts
    if not abs(value) < _MOST_COUNTS:
        return np.int64(port.last_counts)  # type: ignore[return-value]
    return round(value)


@kernel
def put_u32(data: np.ndarray, at: int, value: int) -> None:
    put_u16(data, at, value)
    put_u16(data, at + 2, value >> 16)


@kernel
def _put_target(port: CanopenPort, data: np.ndarray, command: Command, enabled: bool) -> None:
    """Target and torque offset; with power off, zero and where the joint is."""
    if port.target_is_position != 0:
        here = np.int64(port.last_counts)
        put_u32(data, port.target_at, position_counts(port, command.position_rad) if enabled else here)  # type: ignore[arg-type]
    elif port.target_is_velocity != 0:
        put_u32(data, port.target_at, velocity_units(port, command.velocity_radps) if enabled else 0)
    else:
        put_u16(data, port.target_at, torque_permille(port, command.torque_Nm) if enabled else 0)
    if port.has_torque_offset != 0:
        put_u16(data, port.torque_offset_at, torque_permille(port, command.torque_Nm) if enabled else 0)


@kernel
def _put_velocity_offset(port: CanopenPort, frame: Frame, command: Command, enabled: bool) -> None:
    frame.can_id = port.offset_rpdo_id
    if port.offset_rpdo_id == 0:
        return
    frame.length = 4
    put_u32(frame.payload, 0, velocity_units(port, port.offset_share * command.velocity_radps) if enabled else 0)
    port.bits_sent += _WORST_BITS[4]


@kernel
def _ignores(port: CanopenPort, request: int) -> bool:
    """Whether the drive's last reports are not those of one that stops as it is asked to."""
    state = port.state
    if request == DriveRequest.ENABLE:
        return False
    if request == DriveRequest.PREPARE or port.asked == 0:
        return state == State.OPERATION_ENABLED
    if port.repeated == 0 or state == State.OPERATION_ENABLED:
        return True
    if state == State.QUICK_STOP_ACTIVE:
        return request == DriveRequest.OFF
    if state == State.SWITCH_ON_DISABLED or state == State.FAULT or state == State.FAULT_REACTION_ACTIVE:
        return False
    return port.cycle - port.heard_cycle > STILL_REPORTS_CYCLES


@kernel
def end_cycle(port: CanopenPort, frames: np.ndarray, sample: Sample, command: Command) -> None:
    """Write the RPDO (slot 2) and the one with the velocity offset.

    The target is zero, or where the joint is, unless the drive is asked to be, and is, enabled.

    Once the heartbeat is withheld the drive's watchdog is dead: from then on enabling is refused.
    """
    port.in_cycle = 0
    if port.heartbeat_watched != 0:
        sample.heartbeat_age_cycles = min(port.cycle - port.heartbeat_heard_cycle, INT32_MAX)
    request = np.int64(command.request)
    if request != DriveRequest.QUICK_STOP and port.ignored_cycles > IGNORED_MAX_CYCLES:
        request = np.int64(DriveRequest.OFF)
    frame = frames[SLOT_RPDO]
    frame.can_id = port.rpdo_id
    frame.length = port.rpdo_length
    for i in range(8):
        frame.payload[i] = port.rpdo_filler[i]
    put_u16(frame.payload, port.control_at, control_word(port.state, request))  # type: ignore[arg-type]
    enabled = request == DriveRequest.ENABLE and port.state == State.OPERATION_ENABLED
    if request == DriveRequest.ENABLE or request == DriveRequest.PREPARE:
        port.asked = 1
    if _ignores(port, request):  # type: ignore[arg-type]
        port.ignored_cycles += 1
    elif port.ignored_cycles <= IGNORED_MAX_CYCLES:
        port.ignored_cycles = 0
    _put_target(port, frame.payload, command, enabled)
    _put_velocity_offset(port, frames[SLOT_OFFSET], command, enabled)
    port.bits_sent += _WORST_BITS[min(frame.length, 8)]
