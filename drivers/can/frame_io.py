"""Send and receive 16-byte CAN frames on a file descriptor, from inside the control loop.

The same code serves an AF_CAN raw socket and an AF_UNIX SEQPACKET socket of the virtual bus: on both, one datagram
is one `struct can_frame`.  Nothing here allocates, blocks or raises.  The frames live in an array of `Frame` records
owned by the caller.  Not for CAN FD (72-byte frames).
"""

from __future__ import annotations

import errno as errno_codes

import numpy as np

from jointctl.drivers.can.frames import FRAME_BYTES
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import EINTR, MSG_DONTWAIT, MSG_NOSIGNAL, errno, recv, send

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
        sent = send(np.int32(fd), address, np.uintp(FRAME_BYTES), np.int32(MSG_DONTWAIT | MSG_NOSIGNAL))
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
        got = recv(np.int32(fd), address, np.uintp(FRAME_BYTES), np.int32(MSG_DONTWAIT | MSG_TRUNC))
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
