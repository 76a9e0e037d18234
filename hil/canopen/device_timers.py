"""What the virtual drive does by the clock: its heartbeat, the heartbeats and frames that it watches, NMT changes.

Every function takes the time of the caller's clock [ns] and returns when it wants to be called next.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.bus.virtual_bus import FrameQueue
from jointctl.hil.canopen.cia402_core import abort_connection
from jointctl.hil.canopen.device_errors import (
    HEARTBEAT_ERRORS,
    HEARTBEAT_LOST,
    LIFE_GUARD_ERROR,
    NMT_LEFT,
    RPDO_ERROR,
    RPDO_TIMEOUT,
    SYNC_ERROR,
    SYNC_LOST,
    clear_error,
    error_register,
    push_frame,
    report_error,
    send_waiting_emergencies,
)
from jointctl.hil.canopen.pdo import send_due_tpdos, start_pdos
from jointctl.hil.canopen.records import CONSUMERS, PDOS, Device, NmtState, int64

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
