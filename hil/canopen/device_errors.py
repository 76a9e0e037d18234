"""Errors of the virtual drive: queueing frames, emergency messages, error register and history (CiA 301).

Error register 1001: bit 0 generic (any error), 1 current, 2 voltage, 3 temperature, 4 communication, 5 device
profile, 7 manufacturer.  An emergency message is [code lo, code hi, register, 0 x 5]; code 0000 = all clear.
Messages that the inhibit time 1015 holds back wait in a list of 8; one more replaces the last of them.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.records import HISTORY, Device, NmtState, int64
from jointctl.hil.virtual_bus import QUEUE_LENGTH, FrameQueue

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
    """Append a frame with `size` zero bytes of data; its slot, or -1 (and `overflowed` counts) when full."""
    slot = int64(queue.count)
    if slot >= QUEUE_LENGTH:
        queue.overflowed += 1
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
