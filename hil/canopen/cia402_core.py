"""CiA 402 power state machine of the virtual drive: controlword in, statusword out, stops, faults and their messages.

Transitions 0 and 1 (power on to Switch On Disabled) need no time here.  Commands with bit 7 set are ignored except
for its rising edge in Fault.  Stop ramps are carried out by `motion`; here they are only started.
Halt (bit 8) acts in modes 1, 3, 4 and 6, along the ramp that 605D names; in torque mode that is always 6087.
Not modelled: a missing power supply (bit 4 is always set, 6079 is constant);
bit 9 follows the NMT state (0 while stopped).
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.motion import begin_homing, interrupt_homing
from jointctl.hil.canopen.records import HISTORY, Device, DriveObjects, HomingState, Mode, NmtState, PowerState, int64
from jointctl.hil.virtual_bus import QUEUE_LENGTH, FrameQueue

# --- Errors: emergency messages, error register and history (CiA 301) ---
# Error register 1001: bit 0 generic (any error), 1 current, 2 voltage, 3 temperature, 4 communication, 5 device
# profile, 7 manufacturer.  An emergency message is [code lo, code hi, register, 0 x 5]; code 0000 = all clear.
# Messages that the inhibit time 1015 holds back wait in a list of 8; one more replaces the last of them.


COB_ID_INVALID = 0x80000000
HEARTBEAT_LOST = 0x8130
RPDO_TOO_SHORT = 0x8210
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250
SYNC_LOST = 0x8700
NMT_LEFT = 0x8100
FOLLOWING_ERROR = 0x8611
POSITION_LIMIT = 0x8680

# bits of `Device.communication_errors`: causes that are present; those of SYNC and RPDOs in NMT operational only
HEARTBEAT_ERRORS = 0x03  # one a consumer
SYNC_ERROR = 0x04
LIFE_GUARD_ERROR = 0x08
RPDO_ERROR = 0x10  # shifted by the number of the PDO, 0 to 3; so is the next
RPDO_LENGTH_ERROR = 0x100
SYNC_LENGTH_ERROR = 0x1000
LENGTH_ERRORS = 0x1F00  # reported, but no reason to keep a fault


@kernel
def push_frame(queue: FrameQueue, identifier: int, size: int) -> int:
    """Append a frame with `size` zero bytes of data; its slot, or -1 when full."""
    slot = int64(queue.count)
    if slot >= QUEUE_LENGTH:
        return -1
    for i in range(16):
        queue.frames[slot, i] = 0
    queue.frames[slot, 0] = identifier & 0xFF
    queue.frames[slot, 1] = (identifier >> 8) & 0x07
    queue.frames[slot, 4] = size
    queue.count = slot + 1
    return slot


@kernel
def error_register(device: Device) -> int:
    """Value of 1001 for the errors that are present."""
    fault = int64(device.fault_code)
    register = 0
    if device.communication_errors != 0:
        register |= 0x11
    if fault != 0:
        register |= 0x01
        group = fault >> 12
        if group == 2:
            register |= 0x02
        elif group == 3:
            register |= 0x04
        elif group == 4:
            register |= 0x08
        elif group == 8 and (fault >> 8) <= 0x82:
            register |= 0x10
        elif group == 15:
            register |= 0x80
        else:
            register |= 0x20
    return register


@kernel
def _push_emergency(device: Device, word: int, queue: FrameQueue) -> None:
    slot = push_frame(queue, int64(device.communication.emcy_cob_id) & 0x7FF, 8)
    if slot >= 0:
        queue.frames[slot, 8] = word & 0xFF
        queue.frames[slot, 9] = (word >> 8) & 0xFF
        queue.frames[slot, 10] = (word >> 16) & 0xFF
    device.emcy_sent_ns = device.time_ns


@kernel
def _emergencies_off(device: Device) -> bool:
    return (
        int64(device.communication.emcy_cob_id) & COB_ID_INVALID != 0
        or device.nmt == NmtState.STOPPED
        or device.nmt == NmtState.BOOT_UP
    )


@kernel
def send_emergency(device: Device, code: int, queue: FrameQueue) -> None:
    """Queue the emergency message, or keep it for later; none while stopped, booting, or when 1014 is invalid."""
    if _emergencies_off(device):
        return
    word = code | int64(device.communication.error_register) << 16
    inhibit_ns = int64(device.communication.emcy_inhibit_100us) * 100_000
    early = inhibit_ns and device.emcy_sent_ns and device.time_ns - device.emcy_sent_ns < inhibit_ns
    if device.emcy_waiting or early:
        slot = min(int64(device.emcy_waiting), HISTORY - 1)
        device.emcy_waiting_words[slot] = word
        device.emcy_waiting = slot + 1
        device.next_due_ns = 0
    else:
        _push_emergency(device, word, queue)


@kernel
def send_waiting_emergencies(device: Device, next_ns: int, queue: FrameQueue) -> int:
    """Send what the inhibit time no longer holds back; the earlier of `next_ns` and the next time to look."""
    if _emergencies_off(device):
        device.emcy_waiting = 0
    while device.emcy_waiting:
        due_ns = device.emcy_sent_ns + int64(device.communication.emcy_inhibit_100us) * 100_000
        if device.time_ns < due_ns:
            return min(next_ns, due_ns)
        _push_emergency(device, int64(device.emcy_waiting_words[0]), queue)
        for i in range(1, HISTORY):
            device.emcy_waiting_words[i - 1] = device.emcy_waiting_words[i]
        device.emcy_waiting -= 1
    return next_ns


@kernel
def report_error(device: Device, code: int, queue: FrameQueue) -> None:
    """Enter an error that was just latched into 603F, 1001 and 1003 and send it."""
    group = device.communication
    device.drive.error_code = code
    group.error_register = error_register(device)
    for i in range(HISTORY - 1, 0, -1):
        group.error_history[i] = group.error_history[i - 1]
    group.error_history[0] = code
    if group.error_count < HISTORY:
        group.error_count += 1
    send_emergency(device, code, queue)


@kernel
def raise_error(device: Device, cause: int, code: int, queue: FrameQueue) -> None:
    """A communication error: reported when it begins, not again with every frame that shows it."""
    if not device.communication_errors & cause:
        device.communication_errors |= cause
        report_error(device, code, queue)


@kernel
def report_cleared(device: Device, queue: FrameQueue) -> None:
    """After a cause has gone: update 1001, and send 0000 when it was the last one."""
    register = error_register(device)
    device.communication.error_register = register
    if register == 0:
        device.drive.error_code = 0
        send_emergency(device, 0, queue)


@kernel
def clear_error(device: Device, cause: int, queue: FrameQueue) -> None:
    """What `raise_error` reported, or a lost connection, has gone."""
    if device.communication_errors & cause:
        device.communication_errors &= ~cause
        report_cleared(device, queue)


# --- The power state machine ---


_HALT = 0x0100


@kernel
def mode_supported(mode: int) -> bool:
    """True for the modes that 6502 claims."""
    return mode == 1 or mode == 3 or mode == 4 or mode == 6 or mode == 8 or mode == 9 or mode == 10


@kernel
def outside_position_limit(drive: DriveObjects, position: int) -> bool:
    """Software position limit 607D [counts]; both limits 0 = off."""
    low = drive.position_limit[0]
    high = drive.position_limit[1]
    return (low != 0 or high != 0) and (position < low or position > high)


@kernel
def begin_stop(device: Device, option: int, after: int) -> None:
    """Brake along 6084 (option 1, 5) or 6085 (2, 6), then enter `after`; option 0 enters it at once (coasting)."""
    if option == 0:
        device.braking = 0
        device.state = after
        return
    drive = device.drive
    deceleration = int64(drive.profile_deceleration)
    if option == 2 or option == 6:
        deceleration = int64(drive.quick_stop_deceleration)
    device.brake_deceleration_radps2 = deceleration / abs(device.counts_per_rad)
    device.after_brake = after
    device.braking = 2


@kernel
def quick_stop(device: Device) -> None:
    """Transition 11 with the reaction of 605A; 5 and 6 stay in Quick Stop Active and hold standstill."""
    option = int64(device.drive.quick_stop_option)
    device.state = PowerState.QUICK_STOP_ACTIVE
    if option >= 5:
        begin_stop(device, option, PowerState.QUICK_STOP_ACTIVE)
    else:
        begin_stop(device, option, PowerState.SWITCH_ON_DISABLED)


@kernel
def power_off(device: Device) -> None:
    """Torque off at once (transitions 7, 9, 10, 12)."""
    device.braking = 0
    device.state = PowerState.SWITCH_ON_DISABLED


@kernel
def latch_fault(device: Device, code: int) -> bool:
    """Transition 13 with the reaction of 605E (14 follows at its end); False while an earlier fault is latched."""
    if device.fault_code != 0:
        return False
    device.fault_code = code
    if device.state == PowerState.OPERATION_ENABLED or device.state == PowerState.QUICK_STOP_ACTIVE:
        device.state = PowerState.FAULT_REACTION_ACTIVE
        begin_stop(device, int64(device.drive.fault_reaction_option), PowerState.FAULT)
    else:
        device.braking = 0
        device.state = PowerState.FAULT
    return True


@kernel
def raise_fault(device: Device, code: int, queue: FrameQueue) -> None:
    """A drive fault: latch, react, report.  Nothing while an earlier fault is latched."""
    if latch_fault(device, code):
        report_error(device, code, queue)


@kernel
def abort_connection(device: Device, code: int) -> bool:
    """Reaction 6007 to a lost connection, power stage on: 0 none, 1 fault, 2 disable voltage, 3 quick stop.

    True if it has latched a fault, which the caller reports.
    """
    option = device.drive.abort_option
    enabled = device.state == PowerState.OPERATION_ENABLED
    if not (enabled or device.state == PowerState.QUICK_STOP_ACTIVE):
        return False
    if option == 1:
        return latch_fault(device, code)
    if option == 2:
        power_off(device)
    elif option == 3 and enabled:
        quick_stop(device)
    return False


@kernel
def fault_cause_present(device: Device) -> bool:
    """True while a fault reset must be refused."""
    return (
        device.inject_fault_code != 0
        or device.communication_errors & ~LENGTH_ERRORS != 0
        or outside_position_limit(device.drive, device.drive.position)
    )


@kernel
def _start_afresh(device: Device) -> None:
    """Another mode, or enabled: references start from where the joint is (at the next substep), nothing is under way.

    What a master commands from now on counts, even if it comes before that substep.
    """
    device.resync = 1
    device.setpoint_active = 0
    device.setpoint_waiting = 0
    device.setpoint_acknowledged = 0
    interrupt_homing(device)


@kernel
def _take_setpoint(device: Device, word: int, last: int) -> None:
    """Profile position handshake: bit 4 rising takes the target (bit 6: relative), falling ends the acknowledge.

    With bit 5 the target replaces the one that is under way; without, it waits until that one is reached, and the
    acknowledge lasts as long as it waits.  A third one is not taken.
    """
    if word & 0x10 and not last & 0x10:
        if device.setpoint_waiting and not word & 0x20:
            return
        target = int64(device.drive.target_position) / device.counts_per_rad
        if word & 0x40:
            present = int64(device.drive.position) / device.counts_per_rad
            resting = present if device.resync else device.reference_position_rad
            target += device.setpoint_position_rad if device.setpoint_active else resting
        if device.setpoint_active and not word & 0x20:
            device.setpoint_next_rad = target
            device.setpoint_waiting = 1
        else:
            device.setpoint_position_rad = target
            device.setpoint_active = 1
            device.setpoint_waiting = 0
        device.setpoint_acknowledged = 1
    elif not word & 0x10 and not device.setpoint_waiting:
        device.setpoint_acknowledged = 0


@kernel
def _command_homing(device: Device, word: int, last: int) -> None:
    """Homing: bit 4 rising starts, falling or halt interrupts."""
    if word & 0x10 and not last & 0x10 and not word & _HALT:
        begin_homing(device)
    elif not word & 0x10 or word & _HALT:
        interrupt_homing(device)


@kernel
def _command_enabled(device: Device, command: int) -> None:
    """Operation Enabled: the ways out of it, and its resumption while a stop ramp of 605B or 605C runs."""
    if command == 0x07 and device.braking == 0:
        begin_stop(device, int64(device.drive.disable_option), PowerState.SWITCHED_ON)
    elif command & 0x07 == 0x06 and device.braking == 0:
        begin_stop(device, int64(device.drive.shutdown_option), PowerState.READY_TO_SWITCH_ON)
    elif command == 0x0F and device.braking != 0:
        device.braking = 0
        _start_afresh(device)


@kernel
def apply_controlword(device: Device, queue: FrameQueue) -> None:
    """Carry out the present controlword and mode request; call after every write of 6040 or 6060."""
    drive = device.drive
    mode = int64(drive.mode)
    if mode != drive.mode_display and (mode == 0 or mode_supported(mode)):
        drive.mode_display = mode
        _start_afresh(device)
    word = int64(drive.controlword)
    last = int64(device.last_controlword)
    device.last_controlword = word
    state = int64(device.state)
    if state == PowerState.FAULT:
        if word & 0x80 and not last & 0x80 and not fault_cause_present(device):
            device.fault_code = 0
            device.state = PowerState.SWITCH_ON_DISABLED
            report_cleared(device, queue)
        return
    if word & 0x80 or state == PowerState.FAULT_REACTION_ACTIVE or state == PowerState.NOT_READY:
        return
    command = word & 0x0F
    if not command & 0x02:
        power_off(device)
    elif not command & 0x04:
        if state == PowerState.OPERATION_ENABLED:
            quick_stop(device)
        elif state != PowerState.QUICK_STOP_ACTIVE:
            power_off(device)
    elif state == PowerState.SWITCH_ON_DISABLED:
        if command & 0x07 == 0x06:
            device.state = PowerState.READY_TO_SWITCH_ON
    elif state == PowerState.READY_TO_SWITCH_ON or state == PowerState.SWITCHED_ON:
        if command == 0x0F:
            device.state = PowerState.OPERATION_ENABLED
            device.braking = 0
            _start_afresh(device)
        elif command == 0x07:
            device.state = PowerState.SWITCHED_ON
        else:
            device.state = PowerState.READY_TO_SWITCH_ON
    elif state == PowerState.OPERATION_ENABLED:
        _command_enabled(device, command)
        if drive.mode_display == Mode.PROFILE_POSITION and command == 0x0F:
            _take_setpoint(device, word, last)
        elif drive.mode_display == Mode.HOMING and command == 0x0F:
            _command_homing(device, word, last)
    elif state == PowerState.QUICK_STOP_ACTIVE and command == 0x0F and drive.quick_stop_option >= 5:
        device.state = PowerState.OPERATION_ENABLED
        device.braking = 0
        _start_afresh(device)


@kernel
def _target_reached(device: Device) -> bool:
    drive = device.drive
    if device.state == PowerState.QUICK_STOP_ACTIVE:
        return device.braking == 0
    if device.state != PowerState.OPERATION_ENABLED:
        return False
    mode = drive.mode_display
    moving = abs(int64(drive.velocity)) > int64(drive.velocity_window)
    if drive.controlword & _HALT and (mode == Mode.PROFILE_POSITION or mode == Mode.PROFILE_VELOCITY):
        return not moving
    if mode == Mode.PROFILE_POSITION:
        error = int64(drive.position) - int64(round(device.setpoint_position_rad * device.counts_per_rad))
        idle = device.setpoint_active == 0 and device.setpoint_waiting == 0
        return idle and abs(error) <= int64(drive.position_window)
    if mode == Mode.PROFILE_VELOCITY:
        return abs(int64(drive.velocity) - int64(drive.target_velocity)) <= int64(drive.velocity_window)
    if mode == Mode.HOMING:
        return device.homing != HomingState.SEARCHING and not moving
    if mode == Mode.TORQUE:
        target = 0.0 if drive.controlword & _HALT else device.torque_sign * float(drive.target_torque)
        return device.demand == target
    return False


@kernel
def status_word(device: Device) -> int:
    """6041 of the present state."""
    state = device.state
    drive = device.drive
    word = 0x10
    enabled = state == PowerState.OPERATION_ENABLED
    if state == PowerState.SWITCH_ON_DISABLED:
        word |= 0x40
    elif state == PowerState.READY_TO_SWITCH_ON:
        word |= 0x21
    elif state == PowerState.SWITCHED_ON:
        word |= 0x23
    elif enabled:
        word |= 0x27
    elif state == PowerState.QUICK_STOP_ACTIVE:
        word |= 0x07
    elif state == PowerState.FAULT_REACTION_ACTIVE:
        word |= 0x0F
    elif state == PowerState.FAULT:
        word |= 0x08
    if device.communication_errors != 0:
        word |= 0x80
    if device.nmt != NmtState.STOPPED:
        word |= 0x200
    if _target_reached(device):
        word |= 0x400
    if device.saturated or outside_position_limit(drive, drive.position):
        word |= 0x800
    mode = drive.mode_display
    if (
        (mode >= Mode.CYCLIC_POSITION and enabled and device.braking == 0)
        or (mode == Mode.PROFILE_VELOCITY and abs(int64(drive.velocity)) <= int64(drive.velocity_window))
        or (mode == Mode.PROFILE_POSITION and device.setpoint_acknowledged)
        or (mode == Mode.HOMING and device.homing == HomingState.ATTAINED)
    ):
        word |= 0x1000
    if device.following_time_s > 0.0 or (mode == Mode.HOMING and device.homing == HomingState.FAILED):
        word |= 0x2000
    return word
