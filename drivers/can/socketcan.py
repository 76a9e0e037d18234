"""A real CAN interface of Linux (SocketCAN): its raw end for the control loop, its state, its error frames in words.

Source: Linux Documentation/networking/can.rst, include/uapi/linux/can/netlink.h and error.h, iproute2's JSON output.
Classic CAN only.  The bit rate belongs to the interface and is set by the administrator with `ip link`, not here.
"""

from __future__ import annotations

import errno
import json
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from jointctl.drivers.errors import BusError, NoDeviceError

_RECEIVE_BUFFER_BYTES = 1 << 20
_ALL_ERRORS = 0x1FFFFFFF  # CAN_ERR_MASK
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_LOOPBACK = 3
_CAN_RAW_RECV_OWN_MSGS = 4
_SOL_CAN_RAW = 101
_LONGEST_NAME = 15


def up_command(channel: str, bitrate_bitps: int | None = None) -> str:
    """The command that sets up an interface, at 1 Mbit/s unless another rate is given; a virtual one has none."""
    if channel.startswith("vcan"):
        return f"sudo ip link add {channel} type vcan; sudo ip link set {channel} up"
    return f"sudo ip link set {channel} up type can bitrate {bitrate_bitps or 1_000_000}"


def open_socket(channel: str) -> socket.socket:
    """A non-blocking raw socket bound to the CAN interface `channel`; BusError with the command that fixes it.

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
        # A bind to an interface that is down succeeds; the state only comes as a pending error.
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


# --- the interface's state, as `ip -details link` reports it, and the command that fixes what is wrong ---


_TIMEOUT_S = 2.0
SHORT_QUEUE = 50  # frames; Linux' default of 10 overflows when two programs send
_HEALTHY = ("ERROR-ACTIVE", "ERROR-WARNING")


@dataclass(frozen=True)
class LinkState:
    """None where the interface does not report it: a virtual one has neither bit rate nor state."""

    name: str
    kind: str  # "can", "vcan", ...
    up: bool
    state: str | None  # ERROR-ACTIVE, ERROR-WARNING, ERROR-PASSIVE, BUS-OFF, STOPPED
    transmit_errors: int | None
    receive_errors: int | None
    bitrate_bitps: int | None
    queue_frames: int | None
    counts: dict[str, int]  # bus_error, error_passive, bus_off, restarts, ...


def link_state(channel: str) -> LinkState | None:
    """Of the interface; None if there is none of that name, or the program `ip` is missing."""
    command = ["ip", "-details", "-statistics", "-json", "link", "show", "dev", channel]
    try:
        done = subprocess.run(command, capture_output=True, check=True, timeout=_TIMEOUT_S)
        return parse_link(json.loads(done.stdout)[0])
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError):
        return None


def parse_link(link: dict[str, Any]) -> LinkState:
    """From one object of `ip -json`."""
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    counters = data.get("berr_counter", {})
    return LinkState(
        name=str(link["ifname"]),
        kind=str(info.get("info_kind", "")),
        up="UP" in link.get("flags", ()),
        state=data.get("state"),
        transmit_errors=counters.get("tx"),
        receive_errors=counters.get("rx"),
        bitrate_bitps=data.get("bittiming", {}).get("bitrate"),
        queue_frames=link.get("txqlen"),
        counts={key: value for key, value in info.get("info_xstats", {}).items() if isinstance(value, int)},
    )


def link_problem(link: LinkState, bitrate_bitps: int | None = None) -> tuple[str, str] | None:
    """What is wrong with an interface and what fixes it; None if nothing is.  `bitrate_bitps` is the wanted one."""
    name = link.name
    rate = bitrate_bitps or link.bitrate_bitps or 1_000_000
    restart = f"sudo ip link set {name} down; sudo ip link set {name} up type can bitrate {rate} restart-ms 100"
    counters = ""
    if link.transmit_errors is not None:
        counters = f" (transmit errors {link.transmit_errors}, receive errors {link.receive_errors})"
    if not link.up:
        return f"CAN interface {name} is down", up_command(name, bitrate_bitps)
    if link.state == "BUS-OFF":
        return (
            f"CAN interface {name} is bus-off{counters}: too many of its frames failed",
            f"a short, missing termination or a wrong bit rate; fix it, then: {restart}",
        )
    if link.state == "ERROR-PASSIVE":
        return (
            f"CAN interface {name} is error passive{counters}: nobody acknowledges, or the bit rate is wrong",
            f"power of the drive, wiring, termination (60 ohm between H and L), bit rate; then: {restart}",
        )
    if link.state is not None and link.state not in _HEALTHY:
        return f"CAN interface {name} is in state {link.state}{counters}", restart
    if bitrate_bitps and link.bitrate_bitps and bitrate_bitps != link.bitrate_bitps:
        return (
            f"CAN interface {name} runs at {link.bitrate_bitps} bit/s, the configuration says {bitrate_bitps}",
            f"sudo ip link set {name} down; sudo ip link set {name} up type can bitrate {bitrate_bitps}",
        )
    return None


def send_problem(channel: str, code: int) -> tuple[str, str] | None:
    """What an errno of a failed send means on SocketCAN; None for one that has no explanation here."""
    if code == errno.ENOBUFS:
        return (
            f"the transmit queue of {channel} is full: frames do not get out as fast as they are made",
            f"nobody acknowledges, or other programs send too much; if the queue is short: "
            f"sudo ip link set {channel} txqueuelen 1000",
        )
    if code == errno.ENETDOWN:
        return f"CAN interface {channel} went down", up_command(channel)
    if code in (errno.ENODEV, errno.ENXIO):
        return f"CAN interface {channel} has gone", f"plug the adapter in again, then: {up_command(channel)}"
    return None


@contextmanager
def interface_blamed(interface: str, channel: str, bitrate_bitps: int | None) -> Iterator[None]:
    """A failure of the bus, or the silence of everyone on it, inside also states what is wrong with a SocketCAN
    interface, if something is, and the command that fixes it."""
    try:
        yield
    except (BusError, NoDeviceError) as error:
        link = link_state(channel) if interface == "socketcan" else None
        problem = link_problem(link, bitrate_bitps) if link is not None else None
        if problem is None or problem[0] in error.message:
            raise
        hint = f"{problem[1]}; {error.hint}" if error.hint else problem[1]
        raise type(error)(f"{error.message}; {problem[0]}", hint=hint) from error


# --- error frames: messages of the local controller, not frames on the wire ---


# the error classes are bits of the identifier, details are in the data
TX_TIMEOUT, LOST_ARBITRATION, CONTROLLER, PROTOCOL, TRANSCEIVER, NO_ACK, BUS_OFF, BUS_ERROR, RESTARTED, COUNTERS = (
    1 << bit for bit in range(10)
)
_CLASSES = {
    TX_TIMEOUT: "transmit time-out",
    LOST_ARBITRATION: "arbitration lost",
    TRANSCEIVER: "transceiver",
    NO_ACK: "no acknowledge",
    BUS_OFF: "bus-off",
    BUS_ERROR: "bus error",
    RESTARTED: "restarted after bus-off",
}
_CONTROLLER = (
    "receive buffer overflow", "transmit buffer overflow", "error warning (receive)", "error warning (transmit)",
    "error passive (receive)", "error passive (transmit)", "error active again",
)  # fmt: skip
_PROTOCOL = (
    "single bit", "frame format", "bit stuffing", "dominant bit not sent", "recessive bit not sent", "bus overload",
    "active error announced", "on transmission",
)  # fmt: skip
_OVERFLOWS, _WARNINGS, _PASSIVES, _ACTIVE = 0x03, 0x0C, 0x30, 0x40


def _bits(names: tuple[str, ...], value: int) -> str:
    return ", ".join(name for bit, name in enumerate(names) if value >> bit & 1) or "unspecified"


def error_frame_text(identifier: int, data: bytes) -> str:
    """`error passive (transmit); transmit errors 128, receive errors 0`; `identifier` without or with its flags."""
    data = data.ljust(8, b"\0")
    texts = [name for bit, name in _CLASSES.items() if identifier & bit]
    if identifier & CONTROLLER:
        texts.append(_bits(_CONTROLLER, data[1]))
    if identifier & PROTOCOL:
        texts.append(f"protocol violation ({_bits(_PROTOCOL, data[2])})")
    if identifier & COUNTERS or data[6] or data[7]:
        texts.append(f"transmit errors {data[6]}, receive errors {data[7]}")
    return "; ".join(texts) or "unspecified error"


def trouble(identifier: int, data: bytes) -> str:
    """The worst state that an error frame reports: "bus-off", "error passive", "no acknowledge" and so on; "" if none.

    An error warning, a lost arbitration and a return to error active are no trouble.
    """
    details = data.ljust(8, b"\0")[1]
    if identifier & BUS_OFF:
        return "bus-off"
    if identifier & CONTROLLER and details & _PASSIVES:
        return "error passive"
    if identifier & NO_ACK:
        return "no acknowledge"
    if identifier & TX_TIMEOUT:
        return "transmit time-out"
    if identifier & CONTROLLER and details & _OVERFLOWS:
        return "buffer overflow"
    if identifier & (PROTOCOL | BUS_ERROR):
        return "bus error"
    return ""
