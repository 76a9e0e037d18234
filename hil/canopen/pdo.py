"""PDOs of the virtual drive (CiA 301): packing by the mapping objects, SYNC, events, inhibit times and time-outs.

Transmission types: TPDO 0 (at the SYNC after an event), 1-240 (every n-th SYNC), 254 and 255 (at an event, and
every event timer); RPDO 0-240 (applied at the next SYNC), 254 and 255 (applied at once).  The event is a change of
the statusword, 6061 or 603F in a TPDO that maps one of them, and entering NMT operational.  Positions and torques
are no events: they change all the time.  At a SYNC the TPDOs are sampled before the RPDOs are applied.
With a SYNC counter (1019), a synchronous TPDO with a start value (sub 6) begins at the SYNC that carries it.
Not modelled: remote requests of PDOs (types 252, 253), MPDO, dummy mapping.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.cia402_core import (
    COB_ID_INVALID,
    RPDO_ERROR,
    RPDO_LENGTH_ERROR,
    RPDO_TOO_SHORT,
    apply_controlword,
    clear_error,
    push_frame,
    raise_error,
)
from jointctl.hil.canopen.records import (
    EVENT_DRIVEN,
    LAST_SYNCHRONOUS,
    PDOS,
    CommunicationObjects,
    Device,
    DriveObjects,
    int64,
)
from jointctl.hil.virtual_bus import FrameQueue


@kernel
def read_object(drive: DriveObjects, entry: int) -> int:
    """Value of a mappable object; `entry` is index << 16 | sub << 8 | bits as in 1A00."""
    key = entry >> 8
    value = 0
    if key == 0x604100:
        value = int64(drive.statusword)
    elif key == 0x606400:
        value = int64(drive.position)
    elif key == 0x60E401:
        value = int64(drive.second_position)
    elif key == 0x607700:
        value = int64(drive.torque)
    elif key == 0x606C00:
        value = int64(drive.velocity)
    elif key == 0x606B00:
        value = int64(drive.demand_velocity)
    elif key == 0x607900:
        value = int64(drive.dc_link_mV)
    elif key == 0x607800:
        value = int64(drive.current)
    elif key == 0x606100:
        value = int64(drive.mode_display)
    elif key == 0x603F00:
        value = int64(drive.error_code)
    elif key == 0x607400:
        value = int64(drive.demand_torque)
    elif key == 0x60F400:
        value = int64(drive.following_error)
    elif key == 0x606200:
        value = int64(drive.demand_position)
    elif key == 0x604000:
        value = int64(drive.controlword)
    elif key == 0x606000:
        value = int64(drive.mode)
    elif key == 0x607100:
        value = int64(drive.target_torque)
    elif key == 0x607200:
        value = int64(drive.max_torque)
    elif key == 0x607A00:
        value = int64(drive.target_position)
    elif key == 0x60FF00:
        value = int64(drive.target_velocity)
    elif key == 0x60B200:
        value = int64(drive.torque_offset)
    elif key == 0x60B100:
        value = int64(drive.velocity_offset)
    return value


@kernel
def write_object(drive: DriveObjects, entry: int, raw: int) -> None:
    """Store the bits `raw` (unsigned) in a mappable object of 1600; the sign is that of the object."""
    key = entry >> 8
    bits = entry & 0xFF
    signed = raw - (1 << bits) if raw >> (bits - 1) else raw
    if key == 0x604000:
        drive.controlword = raw
    elif key == 0x607100:
        drive.target_torque = signed
    elif key == 0x60B200:
        drive.torque_offset = signed
    elif key == 0x60B100:
        drive.velocity_offset = signed
    elif key == 0x60FF00:
        drive.target_velocity = signed
    elif key == 0x607A00:
        drive.target_position = signed
    elif key == 0x606000:
        drive.mode = signed
    elif key == 0x607200:
        drive.max_torque = raw


@kernel
def _mapped_bytes(group: CommunicationObjects, pdo: int) -> int:
    size = 0
    for i in range(group.rpdo_count[pdo]):
        size += (int64(group.rpdo_mapping[pdo, i]) & 0xFF) // 8
    return size


@kernel
def _send_tpdo(device: Device, pdo: int, now_ns: int, queue: FrameQueue) -> None:
    group = device.communication
    slot = push_frame(queue, int64(group.tpdo_cob_id[pdo]) & 0x7FF, 0)
    device.tpdo_sent_ns[pdo] = now_ns
    device.tpdo_event[pdo] = 0
    if slot < 0:
        return
    size = 0
    for i in range(group.tpdo_count[pdo]):
        entry = int64(group.tpdo_mapping[pdo, i])
        value = read_object(device.drive, entry)
        for _ in range((entry & 0xFF) // 8):
            if size < 8:
                queue.frames[slot, 8 + size] = value & 0xFF
                size += 1
            value >>= 8
    queue.frames[slot, 4] = size


@kernel
def _apply_rpdo(device: Device, pdo: int, queue: FrameQueue) -> None:
    group = device.communication
    position = 0
    for i in range(group.rpdo_count[pdo]):
        entry = int64(group.rpdo_mapping[pdo, i])
        raw = 0
        for k in range((entry & 0xFF) // 8):
            if position < 8:
                raw |= int64(device.rpdo_data[pdo, position]) << (8 * k)
                position += 1
        if entry & 0xFF:
            write_object(device.drive, entry, raw)
    device.rpdo_waiting[pdo] = 0
    apply_controlword(device, queue)


@kernel
def receive_rpdo(device: Device, identifier: int, frame: np.ndarray, now_ns: int, queue: FrameQueue) -> None:
    """Take a frame (16 bytes) into every enabled RPDO of its identifier; call in NMT operational only."""
    group = device.communication
    for pdo in range(PDOS):
        cob_id = int64(group.rpdo_cob_id[pdo])
        if cob_id & COB_ID_INVALID or cob_id & 0x7FF != identifier or group.rpdo_count[pdo] == 0:
            continue
        if int64(frame[4]) < _mapped_bytes(group, pdo):
            raise_error(device, RPDO_LENGTH_ERROR << pdo, RPDO_TOO_SHORT, queue)
            continue
        device.rpdo_heard_ns[pdo] = now_ns
        timer_ns = int64(group.rpdo_timer_ms[pdo]) * 1_000_000
        if timer_ns:
            device.next_due_ns = min(device.next_due_ns, now_ns + timer_ns)
        clear_error(device, (RPDO_ERROR | RPDO_LENGTH_ERROR) << pdo, queue)
        for i in range(8):
            device.rpdo_data[pdo, i] = frame[8 + i]
        if group.rpdo_type[pdo] >= EVENT_DRIVEN:
            _apply_rpdo(device, pdo, queue)
        else:
            device.rpdo_waiting[pdo] = 1


@kernel
def receive_sync(device: Device, now_ns: int, counter: int, queue: FrameQueue) -> None:
    """SYNC in NMT operational: send the synchronous TPDOs, then apply the RPDOs that wait for it.

    `counter` is the value that the SYNC carries, 0 without one.
    """
    group = device.communication
    for pdo in range(PDOS):
        kind = int64(group.tpdo_type[pdo])
        if int64(group.tpdo_cob_id[pdo]) & COB_ID_INVALID or group.tpdo_count[pdo] == 0 or kind > LAST_SYNCHRONOUS:
            continue
        if counter and kind and not device.tpdo_started[pdo]:
            start = int64(group.tpdo_sync_start[pdo])
            if start and start != counter:
                continue
            device.tpdo_started[pdo] = 1
        device.tpdo_syncs[pdo] += 1
        if (kind == 0 and device.tpdo_event[pdo]) or (kind > 0 and device.tpdo_syncs[pdo] >= kind):
            device.tpdo_syncs[pdo] = 0
            _send_tpdo(device, pdo, now_ns, queue)
    for pdo in range(PDOS):
        if device.rpdo_waiting[pdo]:
            _apply_rpdo(device, pdo, queue)


@kernel
def mark_events(device: Device) -> None:
    """The status changed: an event for the TPDOs that map 6041, 6061 or 603F."""
    group = device.communication
    for pdo in range(PDOS):
        for i in range(group.tpdo_count[pdo]):
            index = int64(group.tpdo_mapping[pdo, i]) >> 16
            if index == 0x6041 or index == 0x6061 or index == 0x603F:
                device.tpdo_event[pdo] = 1


@kernel
def start_pdos(device: Device) -> None:
    """NMT operational is entered: forget what was received, every event-driven TPDO is due once."""
    for pdo in range(PDOS):
        device.rpdo_heard_ns[pdo] = 0
        device.rpdo_waiting[pdo] = 0
        device.tpdo_sent_ns[pdo] = 0
        device.tpdo_syncs[pdo] = 0
        device.tpdo_started[pdo] = 0
        device.tpdo_event[pdo] = 1
    device.sync_heard_ns = 0


@kernel
def send_due_tpdos(device: Device, now_ns: int, next_ns: int, queue: FrameQueue) -> int:
    """Send the event-driven TPDOs that are due; the earlier of `next_ns` and the next time to look."""
    group = device.communication
    for pdo in range(PDOS):
        disabled = int64(group.tpdo_cob_id[pdo]) & COB_ID_INVALID or group.tpdo_count[pdo] == 0
        if disabled or group.tpdo_type[pdo] < EVENT_DRIVEN:
            continue
        sent_ns = device.tpdo_sent_ns[pdo]
        timer_ns = int64(group.tpdo_timer_ms[pdo]) * 1_000_000
        due_ns = next_ns
        if device.tpdo_event[pdo]:
            due_ns = sent_ns + int64(group.tpdo_inhibit_100us[pdo]) * 100_000 if sent_ns else now_ns
        elif timer_ns:
            due_ns = sent_ns + timer_ns
        if due_ns <= now_ns:
            _send_tpdo(device, pdo, now_ns, queue)
            due_ns = now_ns + timer_ns if timer_ns else next_ns
        next_ns = min(next_ns, due_ns)
    return next_ns
