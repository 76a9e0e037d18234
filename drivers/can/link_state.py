"""The state of a SocketCAN interface as `ip -details link` tells it, and the command that mends what is wrong.

Source: iproute2's JSON output; states and counters of Linux include/uapi/linux/can/netlink.h.
"""

from __future__ import annotations

import errno
import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from jointctl.drivers.can.socketcan import up_command
from jointctl.drivers.errors import BusError, NoDeviceError

_TIMEOUT_S = 2.0
SHORT_QUEUE = 50  # frames; Linux' default of 10 overflows when two programs send
_HEALTHY = ("ERROR-ACTIVE", "ERROR-WARNING")


@dataclass(frozen=True)
class LinkState:
    """None where the interface does not tell: a virtual one has neither bit rate nor state."""

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
    """What is wrong with an interface and what mends it; None if nothing is.  `bitrate_bitps` is the wanted one."""
    name = link.name
    rate = bitrate_bitps or link.bitrate_bitps or 1_000_000
    restart = f"sudo ip link set {name} down; sudo ip link set {name} up type can bitrate {rate} restart-ms 100"
    counters = ""
    if link.transmit_errors is not None:
        counters = f" (transmit errors {link.transmit_errors}, receive errors {link.receive_errors})"
    if not link.up:
        return f"CAN interface {name} is down", up_command(name)
    if link.state == "BUS-OFF":
        return (
            f"CAN interface {name} is bus-off{counters}: too many of its frames failed",
            f"a short, missing termination or a wrong bit rate; mend it, then: {restart}",
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
    """A failure of the bus, or the silence of everybody on it, inside also tells what is wrong with a SocketCAN
    interface, if something is, and the command that mends it."""
    try:
        yield
    except (BusError, NoDeviceError) as error:
        link = link_state(channel) if interface == "socketcan" else None
        problem = link_problem(link, bitrate_bitps) if link is not None else None
        if problem is None or problem[0] in error.message:
            raise
        hint = f"{problem[1]}; {error.hint}" if error.hint else problem[1]
        raise type(error)(f"{error.message}; {problem[0]}", hint=hint) from error
