"""The cyclic protocol on file descriptors, for all drives of one or several buses: what the compiled loop calls each
cycle.

`receive` and `send` are exported with a fixed C signature, so that the loop in firmware_py can take them as arguments.
"""

from __future__ import annotations

import errno as errno_codes
from typing import Any, NamedTuple

import numpy as np

from jointctl.drivers.can.frames import FRAME_BYTES, Frame
from jointctl.drivers.canopen.cyclic import (
    FRAME_SLOTS,
    SCRATCH_WORDS,
    SLOT_OFFSET,
    SLOT_RECEIVED,
    SLOT_RPDO,
    SLOT_SYNC,
    CanopenPort,
    accept_frame,
    answer_owed,
    begin_cycle,
    end_cycle,
    note_wake,
)
from jointctl.drivers.drive import LOOK_LATE_NS
from jointctl.firmware_py.cycle import Near, fetch, nothing_near
from jointctl.firmware_py.kernel import exported, kernel
from jointctl.firmware_py.libc import (
    EINTR,
    MSG_DONTWAIT,
    MSG_NOSIGNAL,
    errno,
    monotonic_ns,
    sendmmsg,
    wait_watched_ns,
    watch,
)
from jointctl.firmware_py.libc import recv as receive_bytes
from jointctl.firmware_py.libc import send as send_bytes
from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.schema import INT32_MAX, new

# --- 16-byte CAN frames on a file descriptor, from inside the control loop ---
# The same code serves an AF_CAN raw socket and an AF_UNIX SEQPACKET socket of the virtual bus: on both, one datagram
# is one `struct can_frame`.  Nothing here allocates, blocks or raises.  The frames live in an array of `Frame` records
# owned by the caller.  Not for CAN FD (72-byte frames).


# On AF_UNIX, the length of the whole datagram is returned even where it is longer than the buffer.
MSG_TRUNC = 0x20
_CLOSED = errno_codes.ECONNRESET
_WRONG_SIZE = errno_codes.EBADMSG


@kernel
def send_frame(fd: int, frames: np.ndarray, index: int) -> int:
    """Hand `frames[index]` to the bus; 0 if it was taken, else the errno.

    A full queue is EAGAIN on the virtual bus and ENOBUFS or EAGAIN on AF_CAN: the frame was not sent.
    """
    address = np.uintp(frames.ctypes.data + index * FRAME_BYTES)
    while True:
        sent = send_bytes(np.int32(fd), address, np.uintp(FRAME_BYTES), np.int32(MSG_DONTWAIT | MSG_NOSIGNAL))
        if sent == FRAME_BYTES:
            return 0
        if sent >= 0:
            return _WRONG_SIZE
        code = errno()
        if code != EINTR:
            return int(code)


@kernel
def receive_frame(fd: int, frames: np.ndarray, index: int) -> int:
    """Take one waiting frame into `frames[index]`: 1 got one, 0 nothing is waiting, negative: -errno.

    -ECONNRESET: the virtual bus ended.  -EBADMSG: a datagram of a wrong size was thrown away (the record is then
    undefined).  -ENETDOWN: the CAN interface went down.  Error frames of AF_CAN arrive as frames with ERROR_FLAG.
    """
    address = np.uintp(frames.ctypes.data + index * FRAME_BYTES)
    while True:
        got = receive_bytes(np.int32(fd), address, np.uintp(FRAME_BYTES), np.int32(MSG_DONTWAIT | MSG_TRUNC))
        if got == FRAME_BYTES:
            return 1
        if got == 0:
            return -_CLOSED
        if got > 0:
            return -_WRONG_SIZE
        code = errno()
        if code == errno_codes.EAGAIN:
            return 0
        if code != EINTR:
            return -int(code)


class Batch(NamedTuple):
    """The last frame of each drive in a cycle, so that those of a bus go to the system in one call (sendmmsg(2))."""

    frames: Any  # Frame[axes]
    headers: np.ndarray  # int64[axes, 8]: struct mmsghdr of a 64-bit system, each with one part
    parts: np.ndarray  # int64[axes, 2]: struct iovec, each the frame


def batch_of(count: int) -> Batch:
    batch = Batch(new(Frame, count), np.zeros((count, 8), np.int64), np.zeros((count, 2), np.int64))
    batch.parts[:, 0] = batch.frames.ctypes.data + FRAME_BYTES * np.arange(count)
    batch.parts[:, 1] = FRAME_BYTES
    batch.headers[:, 2] = batch.parts.ctypes.data + batch.parts.strides[0] * np.arange(count)
    batch.headers[:, 3] = 1
    return batch


@kernel
def send_batch(fd: int, batch: Batch, first: int, count: int) -> int:
    """How many of these frames the bus has taken, from the first one on; why not the next one, `send_frame` tells."""
    address = np.uintp(batch.headers.ctypes.data + first * batch.headers.strides[0])
    return max(int(sendmmsg(np.int32(fd), address, np.int32(count), np.int32(MSG_DONTWAIT | MSG_NOSIGNAL))), 0)


# --- The exchange ---


class CanopenLink(NamedTuple):
    """The memory of the exchange: a record of each drive, the frames that are sent and received, scratch.

    The drives of a bus answer its SYNC.  Each bus gets its own, one right after the other, and all the same heartbeats.
    """

    port: Any  # CanopenPort[axes]
    frames: Any  # Frame[FRAME_SLOTS]
    scratch: np.ndarray  # int64[SCRATCH_WORDS or more]
    batch: Batch
    near: Near = nothing_near()


def link_of(port: np.recarray, near: Near | None = None) -> CanopenLink:
    """`port` CanopenPort[axes] with the other memory of the exchange."""
    scratch = np.zeros(max(SCRATCH_WORDS, len(port) + 3), np.int64)
    return CanopenLink(port, new(Frame, FRAME_SLOTS), scratch, batch_of(len(port)), near or nothing_near())


@kernel
def _note_sent(port: CanopenPort, sample: Sample, error: int, last: bool) -> None:
    """Count failed sends in a row: one full transmit queue is bad luck, many are a dead bus.

    Only the `last` frame of a cycle, the RPDO, ends the count: while SYNC gets through and it does not, the drive
    keeps its last torque.
    """
    if error == 0:
        if last:
            port.consecutive_failures = 0
    else:
        port.consecutive_failures += 1
        port.send_failures += 1
        port.last_errno = error
    sample.bus_errors = port.consecutive_failures


@kernel
def differs(frame: Frame, sent: Frame) -> bool:
    """Whether a frame has other data than one that was sent."""
    for i in range(min(frame.length, 8)):
        if frame.payload[i] != sent.payload[i]:
            return True
    return frame.length != sent.length


@kernel
def _note_others(port: CanopenPort, frame: Frame, own_rpdo: Frame, own_offset: Frame) -> None:
    """Count set-points, SYNC and heartbeats that this loop has not sent.  The system hands nobody its own frames; one
    that is repeated to us all the same is like ours, SYNC until the drive has answered and the RPDO is sent, and a
    heartbeat for half of the time until the next one."""
    if frame.can_id == port.rpdo_id:
        port.of_others += 1 if differs(frame, own_rpdo) else 0
    elif port.offset_rpdo_id != 0 and frame.can_id == port.offset_rpdo_id:
        port.of_others += 1 if differs(frame, own_offset) else 0
    elif frame.can_id == port.sync_id:
        port.of_another_sync += 1 if port.in_cycle == 0 and port.answered != 0 else 0
    elif frame.can_id == port.own_heartbeat_id and port.heartbeat_cycles > 0:
        since = (port.cycle - 1) % port.heartbeat_cycles
        port.of_another_heart += 1 if port.cycle > 0 and 2 * since > port.heartbeat_cycles else 0


@kernel
def _drain(link: CanopenLink, samples: np.ndarray, now_ns: int) -> bool:
    """Take every frame that is waiting; True if a sample was among them (of several, the last one counts)."""
    ports, frames, found = link.port, link.frames, False
    for bus in range(len(ports)):
        while ports[bus].bus == bus and receive_frame(ports[bus].fd, frames, SLOT_RECEIVED) == 1:
            for axis in range(bus, len(ports)):
                if ports[axis].bus == bus:
                    found |= accept_frame(ports[axis], frames[SLOT_RECEIVED], samples[axis], now_ns)
                    _note_others(ports[axis], frames[SLOT_RECEIVED], link.batch.frames[axis], frames[SLOT_OFFSET])
    return found


@kernel
def _on_several_buses(ports: np.ndarray) -> bool:
    for axis in range(1, len(ports)):
        if ports[axis].bus != 0:
            return True
    return False


@kernel
def _request(link: CanopenLink, samples: np.ndarray, to_send: int) -> None:
    """Send SYNC to every bus, one right after the other, and then the heartbeat to every bus when it is due."""
    ports, frames, first_ns = link.port, link.frames, 0
    several = _on_several_buses(ports)
    for slot in range(to_send):
        for bus in range(len(ports)):
            if ports[bus].bus != bus:
                continue
            error, late_ns = send_frame(ports[bus].fd, frames, slot), 0
            if several and slot == SLOT_SYNC:
                now_ns = monotonic_ns(link.scratch)
                first_ns = now_ns if bus == 0 else first_ns
                late_ns = min(now_ns - first_ns, INT32_MAX)
            for axis in range(bus, len(ports)):
                if ports[axis].bus == bus:
                    _note_sent(ports[axis], samples[axis], error, False)
                    if slot == SLOT_SYNC:
                        samples[axis].sync_late_ns = late_ns


@kernel
def _wait_for_frames(ports: np.ndarray, timeout_ns: int, scratch: np.ndarray) -> None:
    """Sleep until a frame waits on a bus; one of several that takes nothing any more would be an end at once."""
    count, several = 0, _on_several_buses(ports)
    for bus in range(len(ports)):
        if ports[bus].bus == bus and not (several and ports[bus].consecutive_failures > 0):
            watch(ports[bus].fd, count, scratch)
            count += 1
    wait_watched_ns(count, timeout_ns, scratch)


@kernel
def _any_owed(ports: np.ndarray) -> bool:
    for axis in range(len(ports)):
        if answer_owed(ports[axis]):
            return True
    return False


@exported
def receive(link: CanopenLink, samples: np.ndarray, now_ns: int, until_ns: int) -> int:
    """Send SYNC and wait for the answering TPDO of each drive until `until_ns`; returns the time waited [ns].

    Frames that came since the last cycle are taken first, so that a late TPDO is not mistaken for the answer.  One
    that is later still comes after this SYNC: where the last one has no answer yet, the whole time is waited and the
    last TPDO counts.

    A cycle that was held up past its window does not look any more.  What waits then may have been sampled at any
    time since, when SYNC was late as well; as a sample of this slot it would be a leap.  The next cycle takes it,
    unless that is more than a period and a half later (`note_wake`).
    """
    ports, frames = link.port, link.frames
    for axis in range(len(ports)):
        note_wake(ports[axis], now_ns)
    _drain(link, samples, now_ns)
    owed = _any_owed(ports)
    to_send = FRAME_SLOTS
    for axis in range(len(ports)):  # a drive that ignores a stop keeps the heartbeat from all, on every bus
        to_send = min(to_send, begin_cycle(ports[axis], frames))
    _request(link, samples, to_send)
    started_ns = monotonic_ns(link.scratch)
    arrived_ns = started_ns
    while arrived_ns <= until_ns + LOOK_LATE_NS:
        if _drain(link, samples, arrived_ns) and not owed and not _any_owed(ports):
            return monotonic_ns(link.scratch) - started_ns
        if arrived_ns >= until_ns:
            return arrived_ns - started_ns
        link.scratch[-1] = fetch(link.near)
        _wait_for_frames(ports, until_ns - arrived_ns, link.scratch)
        arrived_ns = monotonic_ns(link.scratch)
    return arrived_ns - started_ns


@exported
def send(link: CanopenLink, samples: np.ndarray, commands: np.ndarray) -> int:
    """Send the RPDO of each drive, those of neighbours on a bus in one call; returns 0 or the last errno."""
    ports, batch, failed = link.port, link.batch, 0
    for axis in range(len(ports)):
        end_cycle(ports[axis], link.frames, samples[axis], commands[axis])
        if ports[axis].offset_rpdo_id != 0:
            error = send_frame(ports[ports[axis].bus].fd, link.frames, SLOT_OFFSET)
            _note_sent(ports[axis], samples[axis], error, False)
        batch.frames[axis] = link.frames[SLOT_RPDO]
    first = 0
    while first < len(ports):
        bus, last = ports[first].bus, first + 1
        while last < len(ports) and ports[last].bus == bus:
            last += 1
        fd, taken = ports[bus].fd, 0
        if last - first > 1:
            taken = send_batch(fd, batch, first, last - first)
        for axis in range(first, last):
            error = 0 if axis < first + taken else send_frame(fd, batch.frames, axis)
            _note_sent(ports[axis], samples[axis], error, True)
            if error != 0:
                failed = error
        first = last
    return np.int32(failed)  # type: ignore[return-value]


# --- The same cycle for a caller that moves the frames itself (lockstep simulation) ---


@exported
def begin(link: CanopenLink) -> int:
    """`cyclic.begin_cycle`: so many frames are to be sent to every drive, from slot 0 on."""
    to_send = FRAME_SLOTS
    for axis in range(len(link.port)):
        to_send = min(to_send, begin_cycle(link.port[axis], link.frames))
    return to_send


@exported
def accept(link: CanopenLink, axis: int, slot: int, samples: np.ndarray, now_ns: int) -> bool:
    """`cyclic.accept_frame` of an axis on one slot of the frame memory."""
    return accept_frame(link.port[axis], link.frames[slot], samples[axis], now_ns)


@exported
def end(link: CanopenLink, axis: int, samples: np.ndarray, commands: np.ndarray) -> None:
    """`cyclic.end_cycle` of an axis: its RPDOs are in the slots SLOT_OFFSET (identifier 0: none) and SLOT_RPDO."""
    end_cycle(link.port[axis], link.frames, samples[axis], commands[axis])
