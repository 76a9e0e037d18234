"""The client side of the virtual CAN bus: the raw end for the control loop, and a python-can interface for tools.

The bus itself is a process of its own (`jointctl hil CONFIG`).  One AF_UNIX SEQPACKET datagram is one 16-byte
`struct can_frame`.  As on a real bus, a client sees the frames of all others and not its own.  With the package
installed, any python-can program reaches the bus by ``can.Bus(interface="jointctl", channel="vcan")``.

Not modelled by the bus: acknowledge, error frames, bit errors, bus-off.  Not supported: CAN FD.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import select
import socket
import stat
import struct
import time
from pathlib import Path
from typing import Any

import can

from jointctl.drivers.can.frames import ERROR_FLAG, EXTENDED_FLAG, FRAME_BYTES, FRAME_STRUCT, REMOTE_FLAG
from jointctl.drivers.errors import BusError

_EXTENDED_MASK = 0x1FFFFFFF
_STANDARD_MASK = 0x7FF
_LONGEST_DATA = 8
_RECEIVE_SIZE = 64  # more than a frame, so that a datagram that is too long is seen to be so
_CHANNEL_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
START_HINT = "start one with `jointctl hil CONFIG`"


def default_socket_path(channel: str) -> Path:
    """Where the bus of this name listens, for this user: $XDG_RUNTIME_DIR/jointctl, else a folder per user in /tmp."""
    if not _CHANNEL_NAME.fullmatch(channel):
        raise BusError(
            f"channel (={channel!r}) must consist of letters, digits, '_', '-' and '.', or be a path with '/'"
        )
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = Path(runtime) / "jointctl" if os.path.isdir(runtime) else Path(f"/tmp/jointctl-{os.getuid()}")
    return folder / f"{channel}.sock"


def socket_path(channel: str) -> Path:
    """A channel with a '/' is a path, else a name in this user's own folder, which no one else may have made."""
    if "/" in channel:
        return Path(channel)
    path = default_socket_path(channel)
    try:
        status = os.lstat(path.parent)
    except FileNotFoundError:
        return path
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise BusError(f"folder of the virtual bus (={path.parent}) must be a folder of this user with mode 0700")
    return path


def connect(channel: str) -> socket.socket:
    """A non-blocking end of the virtual bus, as the control loop uses it; BusError if no bus listens there."""
    path = socket_path(channel)
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        end.connect(str(path))
        end.setblocking(False)
    except OSError as error:
        end.close()
        if error.errno in (errno.ENOENT, errno.ECONNREFUSED, errno.ENOTDIR):
            raise BusError(f"no virtual bus at {path}", START_HINT) from None
        if error.errno == errno.EPROTOTYPE:
            raise BusError(f"{path} is a socket, but not a virtual bus", START_HINT) from None
        raise BusError(f"cannot reach a virtual bus at {path}: {error.strerror or error}") from None
    return end


def encode(message: can.Message) -> bytes:
    """The 16 bytes of a python-can message; ValueError for what the virtual bus does not carry."""
    if message.is_fd:
        raise ValueError("CAN FD frames are not supported by the virtual bus, only classic CAN")
    if message.is_error_frame:
        raise ValueError("an error frame cannot be sent")
    highest = _EXTENDED_MASK if message.is_extended_id else _STANDARD_MASK
    if not 0 <= message.arbitration_id <= highest:
        raise ValueError(f"identifier (={message.arbitration_id:#x}) must be in [0..{highest:#x}]")
    if not 0 <= message.dlc <= _LONGEST_DATA:
        raise ValueError(f"data length (={message.dlc}) must be in [0..{_LONGEST_DATA}] bytes")
    flags = (EXTENDED_FLAG if message.is_extended_id else 0) | (REMOTE_FLAG if message.is_remote_frame else 0)
    return FRAME_STRUCT.pack(message.arbitration_id | flags, message.dlc, bytes(message.data or b""))


def decode(datagram: bytes, timestamp_s: float, channel: str) -> can.Message | None:
    """The message in a datagram; None if it is no frame."""
    if len(datagram) != FRAME_BYTES:
        return None
    can_id, length, data = FRAME_STRUCT.unpack(datagram)
    if length > _LONGEST_DATA:
        return None
    extended, remote = bool(can_id & EXTENDED_FLAG), bool(can_id & REMOTE_FLAG)
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=can_id & (_EXTENDED_MASK if extended else _STANDARD_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(can_id & ERROR_FLAG),
        channel=channel,
        dlc=length,
        data=None if remote else data[:length],
        is_rx=True,
    )


# --- Frames that nobody wants are dropped by the system (Linux, Documentation/networking/filter.rst) ---
# It asks a socket's filter when a frame is sent to it: what the filter drops wakes nobody up.


_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
_LOAD, _AND, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x54, 0x15, 0x06  # classic BPF; _LOAD takes four bytes, the highest first
_WHOLE_FRAME, _NOTHING = 0xFFFFFFFF, 0
_STEP_BYTES = 8


def _filter_program(filters: can.typechecking.CanFilters) -> bytes:
    """`struct sock_filter[]` that lets through what one of the filters matches, as python-can understands them."""
    program = []
    for wanted in filters:
        mask, identifier = wanted["can_mask"] & _EXTENDED_MASK, wanted["can_id"]
        if "extended" in wanted:
            mask |= EXTENDED_FLAG
            identifier = identifier & _EXTENDED_MASK | (EXTENDED_FLAG if wanted["extended"] else 0)
        in_frame = [int.from_bytes(struct.pack("=I", word)) for word in (mask, identifier & mask)]
        program += [(_LOAD, 0, 0, 0), (_AND, 0, 0, in_frame[0]), (_JUMP_IF_EQUAL, 0, 1, in_frame[1])]
        program += [(_RETURN, 0, 0, _WHOLE_FRAME)]
    return b"".join(struct.pack("=HBBI", *step) for step in [*program, (_RETURN, 0, 0, _NOTHING)])


class VirtualBus(can.BusABC):
    """python-can interface "jointctl".  `channel` is the name of a bus, or the path of its socket.

    The time stamp of a message is the wall clock at its reception by this process, not by the bus.  `bitrate` is
    accepted and ignored, as it belongs to the bus.
    """

    def __init__(
        self, channel: str = "", can_filters: can.typechecking.CanFilters | None = None, **kwargs: Any
    ) -> None:
        self._is_shutdown = True  # until opened: nothing to close if the lines below fail
        if kwargs.get("fd"):
            raise can.CanInitializationError("CAN FD is not supported by the virtual bus, only classic CAN")
        if kwargs.get("receive_own_messages"):
            raise can.CanInitializationError("receive_own_messages is not supported by the virtual bus")
        try:
            self._socket = connect(str(channel))
        except BusError as error:
            raise can.CanInitializationError(
                f"{error.message}: {error.hint}" if error.hint else error.message
            ) from error
        self._is_shutdown = False
        self.channel_info = f"jointctl virtual bus {channel}"
        self._channel = str(channel)
        self._can_protocol = can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                datagram = self._socket.recv(_RECEIVE_SIZE)
            except BlockingIOError:
                remaining_s = None if deadline_s is None else deadline_s - time.monotonic()
                if remaining_s is not None and remaining_s <= 0.0:
                    return None, False
                self._wait(select.POLLIN, remaining_s)
                continue
            except OSError as error:
                raise can.CanOperationError(f"virtual bus {self._channel}: {error.strerror or error}") from error
            if not datagram:
                raise can.CanOperationError(f"virtual bus {self._channel} was closed at the other end")
            message = decode(datagram, time.time(), self._channel)
            if message is not None:
                return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; waits up to `timeout` seconds (None: not at all) while the queue to the bus is full."""
        datagram = encode(msg)
        deadline_s = time.monotonic() + (timeout or 0.0)
        while True:
            try:
                self._socket.send(datagram)
                return
            except BlockingIOError:
                remaining_s = deadline_s - time.monotonic()
                if remaining_s <= 0.0:
                    raise can.CanOperationError(f"virtual bus {self._channel}: the transmit queue is full") from None
                self._wait(select.POLLOUT, remaining_s)
            except OSError as error:
                raise can.CanOperationError(f"virtual bus {self._channel}: {error.strerror or error}") from error

    def _apply_filters(self, filters: can.typechecking.CanFilters | None) -> None:
        """In the system; `recv` asks them again, as frames may have come before, and the system takes only so many."""
        with contextlib.suppress(OSError):  # there was none
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
        if filters:
            program = _filter_program(filters)
            steps = ctypes.create_string_buffer(program, len(program))
            whole = struct.pack("@HP", len(program) // _STEP_BYTES, ctypes.addressof(steps))  # struct sock_fprog
            with contextlib.suppress(OSError, struct.error):
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, whole)

    def _wait(self, events: int, seconds_s: float | None) -> None:
        poll = select.poll()  # select() fails on descriptors above 1023
        poll.register(self._socket, events)
        poll.poll(None if seconds_s is None else max(1, round(seconds_s * 1000.0)))

    def fileno(self) -> int:
        """The descriptor to wait on, for `can.Notifier`."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        if not self._is_shutdown:
            super().shutdown()
            self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        found: list[can.typechecking.AutoDetectedConfig] = []
        for path in sorted(default_socket_path("any").parent.glob("*.sock")):
            try:
                connect(path.stem).close()
            except BusError:
                continue
            found.append({"interface": "jointctl", "channel": path.stem})
        return found
