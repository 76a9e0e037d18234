"""The cyclic protocol on a file descriptor: what the compiled loop calls each cycle.

`receive` and `send` are exported with a fixed C signature, so that the loop in firmware_py can take them as arguments.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types

from jointctl.drivers.can.frame_io import receive_frame, send_frame, stamp_frame, stamp_of
from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import (
    FRAME_SLOTS,
    SCRATCH_WORDS,
    SLOT_RECEIVED,
    SLOT_RPDO,
    SLOT_SYNC,
    CanopenPort,
    accept_frame,
    answer_owed,
    begin_cycle,
    end_cycle,
)
from jointctl.drivers.drive import LOOK_LATE_NS
from jointctl.firmware_py.kernel import exported, kernel, record_array_type
from jointctl.firmware_py.libc import monotonic_ns, wait_readable_ns
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import dtype_of, new

_PORT = record_array_type(dtype_of(CanopenPort))
_FRAMES = record_array_type(dtype_of(Frame))
_SAMPLE = record_array_type(dtype_of(Sample))
_COMMAND = record_array_type(dtype_of(Command))
_SCRATCH = types.Array(types.int64, 1, "C")


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
def _send(port: CanopenPort, frames: np.ndarray, slot: int) -> int:
    """`send_frame`, stamped where the bus is the virtual one."""
    if port.stamped:
        stamp_frame(frames, slot, monotonic_ns(port.clock))
    return send_frame(port.fd, frames, slot)


@kernel
def _belated(port: CanopenPort, frame: Frame, sync_stamp: int) -> bool:
    """Whether a TPDO bears the stamp of another SYNC: a busy computer held the virtual bus up, as no real one is."""
    of_ours = frame.can_id == port.tpdo_id or (port.second.tpdo_id != 0 and frame.can_id == port.second.tpdo_id)
    return of_ours and stamp_of(frame) != 0 and stamp_of(frame) != sync_stamp


@kernel
def _drain(port: CanopenPort, frames: np.ndarray, sample: Sample, now_ns: int, sync_stamp: int) -> bool:
    """Take every frame that is waiting; True if a sample was among them (of several, the last one counts)."""
    found = False
    while receive_frame(port.fd, frames, SLOT_RECEIVED) == 1:
        if port.stamped and _belated(port, frames[SLOT_RECEIVED], sync_stamp):
            port.surplus += 1
            continue
        found |= accept_frame(port, frames[SLOT_RECEIVED], sample, now_ns)
    return found


@exported(types.int64(_PORT, _FRAMES, _SCRATCH, _SAMPLE, types.int64, types.int64))
def receive(ports: Any, frames: np.ndarray, scratch: np.ndarray, samples: Any, now_ns: int, deadline_ns: int) -> int:
    """Send SYNC and wait for the answering TPDO until `deadline_ns`; returns the time waited [ns].

    Frames that came since the last cycle are taken first, so that a late TPDO is not mistaken for the answer.  One
    that is later still comes after this SYNC: where the last one has no answer yet, the whole time is waited and the
    last TPDO counts.

    A cycle that was held up past its window does not look any more.  What waits then may have been sampled at any
    time since, when SYNC was late as well; as a sample of this slot it would be a leap.  The next cycle takes it.
    """
    port = ports[0]
    sample = samples[0]
    _drain(port, frames, sample, now_ns, 0)
    owed = answer_owed(port)
    count = begin_cycle(port, frames)
    for slot in range(count):
        _note_sent(port, sample, _send(port, frames, slot), False)
    sync_stamp = stamp_of(frames[SLOT_SYNC])
    started_ns = monotonic_ns(scratch)
    arrived_ns = started_ns
    while arrived_ns <= deadline_ns + LOOK_LATE_NS:
        if _drain(port, frames, sample, arrived_ns, sync_stamp) and not owed:
            return monotonic_ns(scratch) - started_ns
        if arrived_ns >= deadline_ns:
            return arrived_ns - started_ns
        wait_readable_ns(port.fd, deadline_ns - arrived_ns, scratch)
        arrived_ns = monotonic_ns(scratch)
    return arrived_ns - started_ns


@exported(types.int32(_PORT, _FRAMES, _SAMPLE, _COMMAND))
def send(ports: Any, frames: np.ndarray, samples: Any, commands: Any) -> int:
    """Send the RPDO; returns 0 or the errno."""
    port = ports[0]
    end_cycle(port, frames, samples[0], commands[0])
    error = _send(port, frames, SLOT_RPDO)
    _note_sent(port, samples[0], error, True)
    return np.int32(error)  # type: ignore[return-value]


@exported(types.int64(_PORT, _FRAMES))
def begin(ports: Any, frames: np.ndarray) -> int:
    """`cyclic.begin_cycle`, for a caller that moves the frames itself (lockstep simulation)."""
    return begin_cycle(ports[0], frames)


@exported(types.boolean(_PORT, _FRAMES, types.int64, _SAMPLE, types.int64))
def accept(ports: Any, frames: np.ndarray, slot: int, samples: Any, now_ns: int) -> bool:
    """`cyclic.accept_frame` on one slot of the frame memory."""
    return accept_frame(ports[0], frames[slot], samples[0], now_ns)


@exported(types.void(_PORT, _FRAMES, _SAMPLE, _COMMAND))
def end(ports: Any, frames: np.ndarray, samples: Any, commands: Any) -> None:
    """`cyclic.end_cycle`: the RPDO is in slot SLOT_RPDO."""
    end_cycle(ports[0], frames, samples[0], commands[0])


def exchange_memory() -> tuple[Any, np.ndarray]:
    """(frames, scratch) that go with a port."""
    return new(Frame, FRAME_SLOTS), np.zeros(SCRATCH_WORDS, np.int64)
