"""The virtual drive without any I/O: frames in, frames out, time given by the caller (`now_ns`).

The real-time process and the lockstep simulation call the same three functions: `power_on`, `accept_frame` for
every frame but the SDO requests, `advance` up to the present time.  Time must not run backwards; all times [ns] are
those of the caller's clock and greater than 0.  Plant and drive advance in substeps of the plant.
Not modelled: TIME, LSS, bus-off; the only remote request that is answered is node guarding.
"""

from __future__ import annotations

import math

import numpy as np

from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.hil.arm_plant import ArmPlant, step_arm
from jointctl.hil.canopen.cia402_core import (
    FOLLOWING_ERROR,
    HEARTBEAT_ERRORS,
    HEARTBEAT_LOST,
    LIFE_GUARD_ERROR,
    NMT_LEFT,
    POSITION_LIMIT,
    RPDO_ERROR,
    RPDO_TIMEOUT,
    SYNC_ERROR,
    SYNC_LENGTH,
    SYNC_LENGTH_ERROR,
    SYNC_LOST,
    abort_connection,
    apply_controlword,
    clear_error,
    error_register,
    outside_position_limit,
    power_off,
    push_frame,
    raise_error,
    raise_fault,
    report_error,
    send_emergency,
    send_waiting_emergencies,
    status_word,
)
from jointctl.hil.canopen.encoder_node import accept_encoder_frame, step_encoder
from jointctl.hil.canopen.motion import (
    demand_is_held,
    demand_torque_Nm,
    following_error_tripped,
    follows_velocity,
    is_powered,
    rated_torque_mNm,
)
from jointctl.hil.canopen.pdo import mark_events, receive_rpdo, receive_sync, send_due_tpdos, start_pdos
from jointctl.hil.canopen.records import CONSUMERS, PDOS, Device, HomingState, Mode, NmtState, PowerState, int64
from jointctl.hil.plant import encoder_counts, link_reading_rad, shaft_velocity_radps, step_plant
from jointctl.hil.plant_records import PlantConstants, PlantState
from jointctl.hil.virtual_bus import FrameQueue

# --- By the clock: its heartbeat, the heartbeats and frames that it watches, NMT changes ---
# Each returns when it wants to be called next [ns].


_FAR_NS = 1_000_000_000
_MS = 1_000_000


@kernel
def enter_nmt(device: Device, state: int, queue: FrameQueue) -> None:
    """Change the NMT state; leaving operational while the power stage is on is a lost connection (6007).

    Its fault is reported before the state changes: a node that is stopped sends no emergency.
    """
    if device.nmt == NmtState.OPERATIONAL and state != NmtState.OPERATIONAL:
        if abort_connection(device, NMT_LEFT):
            report_error(device, NMT_LEFT, queue)
        device.communication_errors &= HEARTBEAT_ERRORS | LIFE_GUARD_ERROR  # SYNC and RPDOs: in operational only
        device.communication.error_register = error_register(device)
    if state == NmtState.OPERATIONAL and device.nmt != NmtState.OPERATIONAL:
        start_pdos(device)
    device.nmt = state


@kernel
def _connection_lost(device: Device, code: int, cause: int, whole: bool, queue: FrameQueue) -> None:
    """Report the error, react as 6007 says, and, when the `whole` connection is gone, change NMT as 1029 says."""
    device.communication_errors |= cause
    abort_connection(device, code)
    report_error(device, code, queue)
    behaviour = device.communication.error_behaviour
    if whole and behaviour == 2:
        enter_nmt(device, NmtState.STOPPED, queue)
    elif whole and behaviour == 0 and device.nmt == NmtState.OPERATIONAL:
        enter_nmt(device, NmtState.PRE_OPERATIONAL, queue)


@kernel
def _producer_heartbeat(device: Device, now_ns: int, next_ns: int, queue: FrameQueue) -> int:
    period_ms = int64(device.communication.producer_heartbeat_ms)
    if period_ms != device.heartbeat_period_ms:
        device.heartbeat_period_ms = period_ms
        device.heartbeat_due_ns = now_ns  # a new period starts with a heartbeat at once
    if period_ms == 0:
        return next_ns
    device.guard_heard_ns = 0  # heartbeat and node guarding exclude each other; heartbeat has precedence
    clear_error(device, LIFE_GUARD_ERROR, queue)
    if now_ns >= device.heartbeat_due_ns:
        slot = push_frame(queue, 0x700 + device.node_id, 1)
        if slot >= 0:
            queue.frames[slot, 8] = device.nmt
        device.heartbeat_due_ns += period_ms * _MS
        if device.heartbeat_due_ns <= now_ns:  # far behind: keep no backlog
            device.heartbeat_due_ns = now_ns + period_ms * _MS
    return min(next_ns, device.heartbeat_due_ns)


@kernel
def answer_node_guard(device: Device, now_ns: int, queue: FrameQueue) -> None:
    """A remote request for 700 + node (CiA 301, 7.2.8.2.2.1): NMT state and toggle bit, unless a heartbeat is set."""
    if device.communication.producer_heartbeat_ms:
        return
    slot = push_frame(queue, 0x700 + device.node_id, 1)
    if slot >= 0:
        queue.frames[slot, 8] = int64(device.nmt) | int64(device.guard_toggle) << 7
    device.guard_toggle ^= 1
    device.guard_heard_ns = now_ns
    device.next_due_ns = 0
    clear_error(device, LIFE_GUARD_ERROR, queue)


@kernel
def _watch_guarding(device: Device, now_ns: int, next_ns: int, queue: FrameQueue) -> int:
    """Life guarding: the master's requests must not stay away for 100C times 100D."""
    group = device.communication
    time_ns = int64(group.guard_time_ms) * int64(group.life_time_factor) * _MS
    heard_ns = device.guard_heard_ns
    if time_ns == 0 or heard_ns == 0 or device.communication_errors & LIFE_GUARD_ERROR:
        return next_ns
    if now_ns - heard_ns < time_ns:
        return min(next_ns, heard_ns + time_ns)
    _connection_lost(device, HEARTBEAT_LOST, LIFE_GUARD_ERROR, True, queue)
    return next_ns


@kernel
def _watch(device: Device, now_ns: int, next_ns: int, queue: FrameQueue) -> int:
    """Heartbeats, SYNC and RPDOs that must not stay away; each is watched once it was heard."""
    group = device.communication
    errors = int64(device.communication_errors)
    for i in range(CONSUMERS):
        entry = int64(group.consumer_heartbeat[i])
        if entry != device.consumer_entry[i]:
            device.consumer_entry[i] = entry
            device.consumer_heard_ns[i] = 0
            clear_error(device, 1 << i, queue)
            continue
        time_ns = (entry & 0xFFFF) * _MS
        heard_ns = device.consumer_heard_ns[i]
        if time_ns and entry >> 16 and heard_ns and not errors & (1 << i):
            if now_ns - heard_ns >= time_ns:
                _connection_lost(device, HEARTBEAT_LOST, 1 << i, True, queue)
            else:
                next_ns = min(next_ns, heard_ns + time_ns)
    if device.nmt != NmtState.OPERATIONAL:
        return next_ns
    time_ns = int64(device.drive.sync_timeout_ms) * _MS
    if time_ns and device.sync_heard_ns and not errors & SYNC_ERROR:
        if now_ns - device.sync_heard_ns >= time_ns:
            _connection_lost(device, SYNC_LOST, SYNC_ERROR, True, queue)
        else:
            next_ns = min(next_ns, device.sync_heard_ns + time_ns)
    for pdo in range(PDOS):
        time_ns = int64(group.rpdo_timer_ms[pdo]) * _MS
        heard_ns = device.rpdo_heard_ns[pdo]
        if time_ns and heard_ns and not errors & (RPDO_ERROR << pdo):
            if now_ns - heard_ns >= time_ns:
                _connection_lost(device, RPDO_TIMEOUT, RPDO_ERROR << pdo, False, queue)
            else:
                next_ns = min(next_ns, heard_ns + time_ns)
    return next_ns


@kernel
def run_timers(device: Device, now_ns: int, queue: FrameQueue) -> None:
    next_ns = now_ns + _FAR_NS
    if device.boot_pending:
        device.boot_pending = 0
        push_frame(queue, 0x700 + device.node_id, 1)
        device.nmt = NmtState.PRE_OPERATIONAL
    next_ns = _watch(device, now_ns, next_ns, queue)
    next_ns = _watch_guarding(device, now_ns, next_ns, queue)
    next_ns = _producer_heartbeat(device, now_ns, next_ns, queue)
    if device.nmt == NmtState.OPERATIONAL:
        next_ns = send_due_tpdos(device, now_ns, next_ns, queue)
    next_ns = send_waiting_emergencies(device, next_ns, queue)
    device.next_due_ns = next_ns


# --- Frames in, frames out, and one substep after the other ---


@kernel
def restart(device: Device, application: bool) -> None:
    """Restore the defaults (communication only, or all of them) and boot again with the power stage off."""
    device.communication = device.default_communication
    if application:
        device.drive = device.default_drive
        device.fault_code = 0
        device.last_controlword = 0
        device.state = PowerState.SWITCH_ON_DISABLED
        device.application_resets += 1
        device.homing = HomingState.IDLE
        device.home_shift_counts = 0
    if device.fault_code == 0:
        power_off(device)
    device.communication_errors = 0
    device.communication.error_register = error_register(device)
    device.following_time_s = 0.0
    device.demand = 0.0
    device.heartbeat_period_ms = 0
    for i in range(CONSUMERS):
        device.consumer_heard_ns[i] = 0
    device.guard_heard_ns = 0
    device.guard_toggle = 0
    device.emcy_sent_ns = 0
    device.emcy_waiting = 0
    device.nmt = NmtState.BOOT_UP
    device.boot_pending = 1
    device.next_due_ns = 0


@kernel
def power_on(device: Device) -> None:
    """Start the device from its defaults; the first `advance` sends the boot-up message."""
    device.primed = 0
    device.inject_fault_code = 0
    restart(device, True)


@kernel
def _int16(value: float) -> int:
    """Rounded and saturated: a plain cast would wrap; not-a-number gives 0."""
    if not np.isfinite(value):
        return 0
    return int64(np.rint(min(max(value, -32768.0), 32767.0)))


@kernel
def _int32(value: float) -> int:
    if not np.isfinite(value):
        return 0
    return int64(np.rint(min(max(value, -2147483648.0), 2147483647.0)))


@kernel
def _position_counts(device: Device, plant_c: PlantConstants, plant_s: PlantState) -> int:
    """6064: the encoder, counted from the home position."""
    return int64(encoder_counts(plant_c, plant_s)) - int64(device.home_shift_counts)


@kernel
def sample_objects(device: Device, plant_c: PlantConstants, plant_s: PlantState) -> None:
    """Measured values of the plant into the objects, in their units; statusword last.

    A drive measures current: 6077 is the torque constant times current, without cogging and the reducer's ripple.
    """
    drive = device.drive
    drive.position = _position_counts(device, plant_c, plant_s)
    drive.second_position = _int32(
        math.floor(link_reading_rad(plant_c, plant_s) * device.second_counts_prad + device.second_offset_counts + 0.5)
    )
    drive.velocity = _int32(shaft_velocity_radps(plant_c, plant_s) * device.velocity_units_prad)
    current_A = device.torque_sign * plant_s.current_A
    motor_torque_mNm = 1e3 * plant_c.torque_per_current_NmpA * current_A / device.reduction_ratio
    drive.torque = _int16(1e3 * motor_torque_mNm / rated_torque_mNm(device))
    drive.current = _int16(1e6 * current_A / int64(drive.rated_current_mA))
    drive.motor_temperature_ddegC = _int16(10.0 * plant_s.motor_temperature_degC)
    drive.demand_torque = _int16(device.torque_sign * device.demand)
    mode = drive.mode_display
    if (
        (mode == Mode.PROFILE_POSITION or mode == Mode.CYCLIC_POSITION)
        and device.state == PowerState.OPERATION_ENABLED
        and not device.resync
    ):
        reference = device.reference_position_rad * device.counts_per_rad
        drive.demand_position = _int32(reference)
        drive.following_error = _int32(reference - drive.position)
    else:
        drive.demand_position = drive.position
        drive.following_error = 0
    demand_radps = device.reference_velocity_radps if follows_velocity(device) else 0.0
    drive.demand_velocity = _int32(demand_radps * device.velocity_units_prad)
    drive.statusword = status_word(device)


@inlined
def _torque_Nm(
    device: Device, plant_c: PlantConstants, plant_s: PlantState, dt_s: float, queue: FrameQueue
) -> tuple[float, bool]:
    """Joint torque [Nm] of the next substep, and whether it stays so until a frame, a timer or a fault changes it."""
    limits = device.drive.position_limit
    mode = device.drive.mode_display
    counts = int64(device.drive.position)
    positioning = mode == Mode.PROFILE_POSITION or mode == Mode.CYCLIC_POSITION or mode == Mode.HOMING
    sampled = limits[0] != 0 or limits[1] != 0 or positioning or device.resync != 0  # the encoder costs time
    if sampled:
        counts = _position_counts(device, plant_c, plant_s)
    if device.fault_code == 0:
        code = int64(device.inject_fault_code)
        if code != 0:
            raise_fault(device, code, queue)
        elif outside_position_limit(device.drive, counts):
            raise_fault(device, POSITION_LIMIT, queue)
        elif following_error_tripped(device, counts, dt_s):
            raise_fault(device, FOLLOWING_ERROR, queue)
    held = not sampled and demand_is_held(device)
    return demand_torque_Nm(device, counts, shaft_velocity_radps(plant_c, plant_s), dt_s), held


@kernel
def _notice_status(device: Device) -> None:
    """A changed status is a TPDO event."""
    state = int64(device.state) | int64(device.drive.mode_display) << 8 | int64(device.fault_code) << 16
    state = state << 16 | int64(device.drive.statusword)
    if state != device.event_status:
        device.event_status = state
        mark_events(device)
        device.next_due_ns = 0


@inlined
def _begin_advance(device: Device, until_ns: int, queue: FrameQueue) -> None:
    if not device.primed:
        device.primed = 1
        device.time_ns = until_ns
    apply_controlword(device, queue)  # SDO may have written 6040 or 6060


@inlined
def _end_substep(device: Device, plant_c: PlantConstants, plant_s: PlantState, step_ns: int, queue: FrameQueue) -> bool:
    """The drive's part of a substep whose plant has moved; whether its timers ran, which may change the torque."""
    device.time_ns += step_ns
    before = int64(device.event_status) >> 16
    if int64(device.state) != before & 0xFF or device.time_ns >= device.next_due_ns:
        sample_objects(device, plant_c, plant_s)
        _notice_status(device)
        run_timers(device, device.time_ns, queue)
        return True
    return False


@inlined
def _end_advance(
    device: Device, plant_c: PlantConstants, plant_s: PlantState, until_ns: int, queue: FrameQueue
) -> None:
    sample_objects(device, plant_c, plant_s)
    _notice_status(device)
    if until_ns >= device.next_due_ns:
        run_timers(device, until_ns, queue)
    step_encoder(device.encoder, link_reading_rad(plant_c, plant_s), until_ns, queue)


@kernel
def advance(device: Device, plant_c: PlantConstants, plant_s: PlantState, until_ns: int, queue: FrameQueue) -> None:
    """Integrate drive and plant up to `until_ns` and append the frames that became due in the meantime to `queue`."""
    step_ns = int64(np.rint(plant_c.step_s * 1e9))
    _begin_advance(device, until_ns, queue)
    torque_Nm, held = 0.0, False
    while device.time_ns + step_ns <= until_ns:
        if not held:
            torque_Nm, held = _torque_Nm(device, plant_c, plant_s, plant_c.step_s, queue)
        step_plant(plant_c, plant_s, torque_Nm)
        if _end_substep(device, plant_c, plant_s, step_ns, queue):
            held = False
    _end_advance(device, plant_c, plant_s, until_ns, queue)


@kernel
def advance_together(
    devices: np.ndarray, plant_constants: np.ndarray, plant_states: np.ndarray, until_ns: int, queues: np.ndarray,
    arm: ArmPlant,
) -> None:  # fmt: skip
    """`advance` for the drives of an arm, one substep after the other; all arrays have one record a drive.

    The one place where the plants of an arm move on; `arm` couples them, or is `no_arm_plant`.  All have the same step,
    and the same time, as no one else advances them.  In an arm a drive without power holds its joint with its brake.
    """
    if len(devices) == 1 and len(arm.links) == 0:
        advance(devices[0], plant_constants[0], plant_states[0], until_ns, queues[0])
        return
    step_ns = int64(np.rint(plant_constants[0].step_s * 1e9))
    for index in range(len(devices)):
        _begin_advance(devices[index], until_ns, queues[index])
        arm.joints[index].held = 0
    while devices[0].time_ns + step_ns <= until_ns:
        for index in range(len(devices)):
            joint, device = arm.joints[index], devices[index]
            plant_c, plant_s = plant_constants[index], plant_states[index]
            if joint.held == 0:
                torque_Nm, held = _torque_Nm(device, plant_c, plant_s, plant_c.step_s, queues[index])
                joint.target_Nm = torque_Nm
                joint.held = 1 if held else 0
                joint.braked = 0 if is_powered(device) else joint.has_brake
            if len(arm.links) == 0:
                step_plant(plant_c, plant_s, joint.target_Nm)
        if len(arm.links) > 0:
            step_arm(plant_constants, plant_states, arm)
        for index in range(len(devices)):
            if _end_substep(devices[index], plant_constants[index], plant_states[index], step_ns, queues[index]):
                arm.joints[index].held = 0
    for index in range(len(devices)):
        _end_advance(devices[index], plant_constants[index], plant_states[index], until_ns, queues[index])


@kernel
def _command_nmt(device: Device, command: int, queue: FrameQueue) -> None:
    errors = device.communication_errors
    if command == 0x01:
        enter_nmt(device, NmtState.OPERATIONAL, queue)
    elif command == 0x02:
        enter_nmt(device, NmtState.STOPPED, queue)
    elif command == 0x80:
        enter_nmt(device, NmtState.PRE_OPERATIONAL, queue)
        if errors != 0 and device.communication.error_register == 0:
            send_emergency(device, 0, queue)  # what is watched in operational only has gone
    elif command == 0x81:
        restart(device, True)
    elif command == 0x82:
        restart(device, False)


@kernel
def _accept_sync(device: Device, frame: np.ndarray, now_ns: int, queue: FrameQueue) -> None:
    """SYNC in NMT operational; one without its counter byte, or with one too many, is reported once and ignored."""
    counted = device.communication.sync_overflow != 0
    if int64(frame[4]) != (1 if counted else 0):
        raise_error(device, SYNC_LENGTH_ERROR, SYNC_LENGTH, queue)
        return
    device.sync_heard_ns = now_ns
    timeout_ns = int64(device.drive.sync_timeout_ms) * _MS
    if timeout_ns:
        device.next_due_ns = min(device.next_due_ns, now_ns + timeout_ns)
    clear_error(device, SYNC_ERROR | SYNC_LENGTH_ERROR, queue)
    receive_sync(device, now_ns, int64(frame[8]) if counted else 0, queue)


@kernel
def accept_frame(
    device: Device, plant_c: PlantConstants, plant_s: PlantState, frame: np.ndarray, now_ns: int, queue: FrameQueue
) -> None:
    """One frame (uint8[16]) from the bus; SDO requests and everything foreign are ignored; advances to `now_ns`."""
    advance(device, plant_c, plant_s, now_ns, queue)
    identifier = int64(frame[0]) | int64(frame[1]) << 8
    size = int64(frame[4])
    if not (frame[3] & 0xE0 or frame[2] or identifier > 0x7FF):
        accept_encoder_frame(device.encoder, link_reading_rad(plant_c, plant_s), identifier, frame, queue)
    if frame[3] & 0xA0 or frame[2] or identifier > 0x7FF or device.nmt == NmtState.BOOT_UP or size > 8:
        return  # extended and error frames are not for this device
    if frame[3] & 0x40:
        if identifier == 0x700 + device.node_id:
            answer_node_guard(device, now_ns, queue)
    elif identifier == 0:
        if size == 2 and (frame[9] == 0 or frame[9] == device.node_id):
            _command_nmt(device, int64(frame[8]), queue)
            device.next_due_ns = 0
    elif 0x700 < identifier <= 0x77F:
        for i in range(CONSUMERS):
            entry = int64(device.communication.consumer_heartbeat[i])
            if entry & 0xFFFF and entry >> 16 == identifier - 0x700:
                device.consumer_entry[i] = entry
                device.consumer_heard_ns[i] = now_ns
                clear_error(device, 1 << i, queue)
                device.next_due_ns = 0
    elif device.nmt == NmtState.OPERATIONAL:
        if identifier == int64(device.communication.sync_cob_id) & 0x7FF:
            _accept_sync(device, frame, now_ns, queue)
        else:
            receive_rpdo(device, identifier, frame, now_ns, queue)
    drive_status = status_word(device)
    device.drive.statusword = drive_status
    _notice_status(device)
    if now_ns >= device.next_due_ns:
        run_timers(device, now_ns, queue)
