"""Errors of the virtual drive: queueing frames, emergency messages, error register and history (CiA 301).

Error register 1001: bit 0 generic (any error), 1 current, 2 voltage, 3 temperature, 4 communication, 5 device
profile, 7 manufacturer.  An emergency message is [code lo, code hi, register, 0 x 5]; code 0000 = all clear.
Not modelled: the inhibit time of emergency messages (1015).
"""

from __future__ import annotations

from firmware_py.kernel import kernel
from hil.device_records import HISTORY, Device, NmtState, int64
from hil.frames import QUEUE_LENGTH, FrameQueue

COB_ID_INVALID = 0x80000000
HEARTBEAT_LOST = 0x8130
RPDO_TOO_SHORT = 0x8210
RPDO_TIMEOUT = 0x8250
SYNC_LOST = 0x8700
NMT_LEFT = 0x8100
FOLLOWING_ERROR = 0x8611
POSITION_LIMIT = 0x8680


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
def send_emergency(device: Device, code: int, queue: FrameQueue) -> None:
    """Queue the emergency message; none while stopped, booting, or when 1014 is invalid."""
    cob_id = int64(device.communication.emcy_cob_id)
    if cob_id & COB_ID_INVALID or device.nmt == NmtState.STOPPED or device.nmt == NmtState.BOOT_UP:
        return
    slot = push_frame(queue, cob_id & 0x7FF, 8)
    if slot >= 0:
        queue.frames[slot, 8] = code & 0xFF
        queue.frames[slot, 9] = (code >> 8) & 0xFF
        queue.frames[slot, 10] = device.communication.error_register


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
def report_cleared(device: Device, queue: FrameQueue) -> None:
    """After a cause has gone: update 1001, and send 0000 when it was the last one."""
    register = error_register(device)
    device.communication.error_register = register
    if register == 0:
        device.drive.error_code = 0
        send_emergency(device, 0, queue)
