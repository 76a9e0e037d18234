"""The cyclic exchange on the descriptor of a serial port: what the compiled loop calls each cycle.

Same signatures as `drivers.canopen.exchange`, with bytes in place of frames.  Wake-up late p50 / p99 / max at 150 Hz
on a noisy 2-core virtual machine, SCHED_FIFO: the compiled loop 27 / 56 / 178 us, a bare Python sleep 43 / 84 / 221 us,
and 123 / 155 / 3168 us without SCHED_FIFO.
"""

from __future__ import annotations

import errno as errno_codes
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np

from jointctl.drivers.drive import LOOK_LATE_NS
from jointctl.drivers.elmo.cyclic import (
    READ_MAX,
    SCRATCH_WORDS,
    ElmoPort,
    begin_cycle,
    end_cycle,
    note_written,
    take_byte,
)
from jointctl.drivers.elmo.dialogue import SWITCH_OFF, open_descriptor
from jointctl.firmware_py.kernel import exported, kernel
from jointctl.firmware_py.libc import EAGAIN, EINTR, errno, external, monotonic_ns, poll_events, wait_readable_ns
from jointctl.firmware_py.records import Sample

_read = external("read", "intp", "int32", "uintp", "uintp")
_write = external("write", "intp", "int32", "uintp", "uintp")


class ElmoLink(NamedTuple):
    """The memory of the exchange: a drive's record, the bytes received, scratch."""

    port: Any  # ElmoPort[1]
    data: np.ndarray  # uint8[READ_MAX]
    scratch: np.ndarray  # int64[SCRATCH_WORDS]


_GONE_EVENTS = 0x008 | 0x010 | 0x020  # POLLERR, POLLHUP, POLLNVAL
_EIO = errno_codes.EIO


def link_of(port: np.recarray) -> ElmoLink:
    """`port` ElmoPort[1] with the other memory of the exchange."""
    return ElmoLink(port, np.zeros(READ_MAX, np.uint8), np.zeros(SCRATCH_WORDS, np.int64))


@contextmanager
def attached(port: np.recarray, device: str) -> Iterator[None]:
    """The port of the loop's own; however the loop ends, the drive is commanded to switch off.

    It would keep its last torque command for ever.
    """
    fd = open_descriptor(device)
    try:
        port[0].fd = fd
        yield
    finally:
        with suppress(OSError):
            os.write(fd, SWITCH_OFF)
        os.close(fd)


@kernel
def _lose_port(port: ElmoPort, code: int) -> None:
    port.gone = 1
    port.last_errno = code


@kernel
def _wait_ns(port: ElmoPort, timeout_ns: int, scratch: np.ndarray) -> None:
    """Sleep until bytes came, the port has gone, or the time is over; `scratch` as in `wait_readable_ns`."""
    if wait_readable_ns(port.fd, timeout_ns, scratch) and poll_events(scratch) & _GONE_EVENTS != 0:
        _lose_port(port, _EIO)


@kernel
def _drain(port: ElmoPort, data: np.ndarray, sample: Sample, now_ns: int) -> bool:
    """Take every byte that has come; True if there was a position among them.

    At most two buffers full: a line that talks without end must not keep a cycle from its end.
    """
    found = False
    for _ in range(2):
        got = _read(np.int32(port.fd), np.uintp(data.ctypes.data), np.uintp(READ_MAX))
        if got < 0:
            code = errno()
            if code != EAGAIN and code != EINTR:
                _lose_port(port, code)
            return found
        for i in range(got):
            if take_byte(port, data[i], sample, now_ns):
                found = True
        if got < READ_MAX:  # 0 = nothing there, as a port with VMIN = 0 says it
            return found
    return found


@kernel
def _flush(port: ElmoPort, sample: Sample) -> int:
    """Write what the cycle has to say; 0 or the errno.  A part of a command is as bad as none."""
    if port.out_length == 0:
        return 0
    code = 0
    sent = _write(np.int32(port.fd), np.uintp(port.out.ctypes.data), np.uintp(port.out_length))
    if sent < 0:
        code = int(errno())
        if code != EAGAIN and code != EINTR:
            _lose_port(port, code)
    elif sent != port.out_length:
        code = EAGAIN
    port.out_length = 0
    note_written(port, sample, code)
    return code


@exported
def receive(link: ElmoLink, samples: np.ndarray, now_ns: int, until_ns: int) -> int:
    """Ask for the position and wait for it until `until_ns`; returns the time waited [ns].

    The late replies of the last cycle are taken first, older ones are not believed.  A cycle that was held up past its
    window does not look any more: PX may have gone out late as well, and as the position of this slot its answer would
    be a leap.  The next cycle takes it.
    """
    port, data, scratch, sample = link.port[0], link.data, link.scratch, samples[0]
    port.window_ns = until_ns
    port.window_over = now_ns > until_ns
    port.asked_ns = now_ns
    _drain(port, data, sample, now_ns)
    begin_cycle(port, sample)
    _flush(port, sample)
    started_ns = monotonic_ns(scratch)
    arrived_ns = started_ns
    while arrived_ns <= until_ns + LOOK_LATE_NS:
        _drain(port, data, sample, arrived_ns)
        if port.answered_window_ns == until_ns:
            return monotonic_ns(scratch) - started_ns
        if arrived_ns >= until_ns or port.gone != 0:
            return arrived_ns - started_ns
        _wait_ns(port, until_ns - arrived_ns, scratch)
        arrived_ns = monotonic_ns(scratch)
    return arrived_ns - started_ns


@exported
def send(link: ElmoLink, samples: np.ndarray, commands: np.ndarray) -> int:
    """Send torque or velocity and the slower questions; returns 0 or the errno."""
    port = link.port[0]
    end_cycle(port, samples[0], commands[0])
    return np.int32(_flush(port, samples[0]))  # type: ignore[return-value]
