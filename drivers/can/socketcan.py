"""The raw end of a real CAN interface of Linux (AF_CAN), as the control loop uses it.

Source: Linux Documentation/networking/can.rst.  Classic CAN only.  The bit rate belongs to the interface and is set
by the administrator with `ip link`, not here.
"""

from __future__ import annotations

import errno
import socket
import struct

from jointctl.drivers.errors import BusError

_RECEIVE_BUFFER_BYTES = 1 << 20
_ALL_ERRORS = 0x1FFFFFFF  # CAN_ERR_MASK
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_LOOPBACK = 3
_CAN_RAW_RECV_OWN_MSGS = 4
_SOL_CAN_RAW = 101
_LONGEST_NAME = 15


def up_command(channel: str) -> str:
    """The command that sets up an interface at 1 Mbit/s; a virtual one has no bit rate."""
    if channel.startswith("vcan"):
        return f"sudo ip link add {channel} type vcan; sudo ip link set {channel} up"
    return f"sudo ip link set {channel} up type can bitrate 1000000"


def open_socket(channel: str) -> socket.socket:
    """A non-blocking raw socket bound to the CAN interface `channel`; BusError with the curing command.

    Frames of this socket are looped back to other sockets of this computer (the commissioning side sees what the
    loop sends) and not to itself.  Error frames of the controller are received, as frames with ERROR_FLAG set.
    """
    if not channel or len(channel.encode()) > _LONGEST_NAME or "/" in channel or any(c.isspace() for c in channel):
        raise BusError(f"CAN interface (={channel!r}) must be a name of 1..{_LONGEST_NAME} characters, such as can0")
    try:
        end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except AttributeError:
        raise BusError("this system has no SocketCAN", "only Linux has: use another interface") from None
    except OSError as error:
        if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT):
            raise BusError("the kernel has no SocketCAN", "sudo modprobe can_raw") from None
        raise BusError(f"cannot open a CAN socket: {error.strerror or error}") from None
    try:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        end.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", _ALL_ERRORS))
        end.setsockopt(_SOL_CAN_RAW, _CAN_RAW_LOOPBACK, 1)
        end.setsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS, 0)
        end.bind((channel,))
        end.setblocking(False)
        # A bind to an interface that is down succeeds; the state is only told as a pending error.
        pending = end.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:
            raise OSError(pending, "interface is down")
    except OSError as error:
        end.close()
        raise _explained(channel, error) from None
    return end


def _explained(channel: str, error: OSError) -> BusError:
    if error.errno == errno.ENODEV:
        return BusError(f"there is no CAN interface {channel}", f"plug in the adapter, then: {up_command(channel)}")
    if error.errno == errno.ENETDOWN:
        return BusError(f"CAN interface {channel} is down", up_command(channel))
    if error.errno in (errno.EPERM, errno.EACCES):
        return BusError(f"no permission to use CAN interface {channel}", "ask the administrator for CAP_NET_RAW")
    return BusError(f"cannot use CAN interface {channel}: {error.strerror or error}", up_command(channel))
