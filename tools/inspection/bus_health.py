"""What the bus and its adapter allow: interfaces and their state, the bus budget, how fast the drive answers."""

from __future__ import annotations

import getpass
import grp
import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz
from jointctl.drivers.can.open import CYCLIC_INTERFACES, open_python_can
from jointctl.drivers.can.socketcan import SHORT_QUEUE, link_problem, link_state, up_command
from jointctl.drivers.canopen.identifiers import SDO_ANSWER_ID, SDO_REQUEST_ID
from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_settings import HIGHEST_LOAD, cycle_bytes
from jointctl.tools.inspection.findings import NOTE, OK, PROBLEM, Finding, file_text
from jointctl.tools.session.loop_handle import RECEIVE_SHARE
from jointctl.tools.session.portable_loop import HIGHEST_RATE_HZ

SDO_READS = 20
_SDO_TIMEOUT_S = 0.3
_CAN_LINK = "280"  # ARPHRD_CAN


def adapters(config: Config, root: Path = Path("/")) -> Iterator[Finding]:
    """SocketCAN, its interfaces, and the right to use serial adapters."""
    needed = config.bus.interface == "socketcan"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        yield Finding("SocketCAN", OK, "available")
    except (OSError, AttributeError) as error:
        cure = "sudo modprobe can_raw"
        yield Finding("SocketCAN", PROBLEM if needed else NOTE, f"not available: {error}", cure)
    found = [
        f"{path.name} ({file_text(path / 'operstate') or 'state unknown'})"
        for path in sorted((root / "sys/class/net").glob("*"))
        if file_text(path / "type") == _CAN_LINK
    ]
    cure = "" if found else "plug in the adapter; slcan adapters need slcand"
    status = OK if found else PROBLEM if needed else NOTE
    yield Finding("CAN interfaces", status, ", ".join(found) or "none", cure)
    try:
        member = os.geteuid() == 0 or grp.getgrnam("dialout").gr_gid in os.getgroups()
    except KeyError:
        yield Finding("serial ports", NOTE, "this system has no group dialout", "see who owns the adapter's /dev/tty*")
        return
    cure = "" if member else f"for serial adapters: sudo usermod -aG dialout {getpass.getuser()}; log in again"
    yield Finding("serial ports", OK if member else NOTE, "may be used" if member else "not in group dialout", cure)


def interface_state(config: Config) -> Iterator[Finding]:
    """State, error counters, bit rate and queue of a SocketCAN interface; nothing for other kinds of bus."""
    if config.bus.interface != "socketcan":
        return
    name = config.bus.channel
    link = link_state(name)
    if link is None:
        if (Path("/sys/class/net") / name).exists():
            yield Finding(
                "interface", NOTE, f"{name} exists, its state is unknown", "install iproute2 (the program ip)"
            )
        else:
            cure = f"plug it in, then: {up_command(name)}"
            yield Finding("interface", PROBLEM, f"there is no CAN interface {name}", cure)
        return
    problem = link_problem(link, config.bus.bitrate_bitps)
    text = f"{name} is {'up' if link.up else 'down'}"
    text += f", {link.state}" if link.state else ""
    if link.transmit_errors is not None:
        text += f", transmit errors {link.transmit_errors}, receive errors {link.receive_errors}"
    text += f", {link.bitrate_bitps} bit/s" if link.bitrate_bitps else ""
    past = {key: value for key, value in link.counts.items() if value}
    if past:
        text += ", since it is up: " + ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in past.items())
    numbers: dict[str, Any] = {"counts": link.counts, "transmit_errors": link.transmit_errors}
    if problem is not None:
        yield Finding("interface", PROBLEM, problem[0], problem[1], numbers)
        return
    bad = link.state == "ERROR-WARNING" or any(past.get(key) for key in ("error_passive", "bus_off"))
    cure = "frames have been failing: wiring, termination (60 ohm between H and L), bit rate" if bad else ""
    yield Finding("interface", NOTE if bad else OK, text, cure, numbers)
    queue = link.queue_frames
    if queue is not None and queue < SHORT_QUEUE:
        cure = f"sudo ip link set {name} txqueuelen 1000"
        yield Finding("transmit queue", NOTE, f"{queue} frames: overflows when several programs send", cure)


def bus_budget(config: Config) -> Finding:
    """Worst-case share of the bus that the cyclic frames take, and the rate that the bus allows."""
    rate_Hz, bitrate = config.loop.rate_Hz, config.bus.bitrate_bitps
    lengths = cycle_bytes(config)
    load = bus_load(lengths, rate_Hz, bitrate)
    highest = highest_rate_Hz(lengths, bitrate, HIGHEST_LOAD)
    numbers = {"load": load, "highest_rate_Hz": highest}
    text = f"{load:.1%} at {rate_Hz:g} Hz and {bitrate} bit/s; up to {highest:.0f} Hz at {HIGHEST_LOAD:.0%}"
    if config.bus.interface not in CYCLIC_INTERFACES:
        text += f"; the plain Python loop of {config.bus.interface} up to {HIGHEST_RATE_HZ:g} Hz"
        numbers["portable_highest_rate_Hz"] = HIGHEST_RATE_HZ
        highest = min(highest, HIGHEST_RATE_HZ)
    good = rate_Hz <= highest
    return Finding("bus budget", OK if good else PROBLEM, text, "" if good else "lower loop.rate_Hz", numbers)


def sdo_round_trips_us(bus: Any, node: int, reads: int = SDO_READS) -> list[float]:
    """Times [us] to read 1000h of `node`, fewer than `reads` where answers stay away; writes nothing."""
    request = can.Message(
        arbitration_id=SDO_REQUEST_ID + node, is_extended_id=False, data=struct.pack("<BHB4x", 0x40, 0x1000, 0)
    )
    times: list[float] = []
    for _ in range(reads):
        started_s = time.monotonic()
        bus.send(request, _SDO_TIMEOUT_S)
        while (left_s := started_s + _SDO_TIMEOUT_S - time.monotonic()) > 0.0:
            answer = bus.recv(left_s)
            if (
                answer is not None
                and answer.arbitration_id == SDO_ANSWER_ID + node
                and answer.data[1:4] == request.data[1:4]
            ):
                times.append((time.monotonic() - started_s) * 1e6)
                break
        else:
            if not times:
                break  # nobody there: do not wait another 19 times
    return times


def drive_finding(config: Config) -> Finding:
    """Whether the configured node answers, and how fast."""
    bus_name = f"{config.bus.interface}:{config.bus.channel}"
    try:
        bus = open_python_can(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps)
    except BusError as error:
        return Finding("drive", NOTE, f"not asked: {error.message}", error.hint)
    try:
        times = sdo_round_trips_us(bus, config.canopen.node)
    except (can.CanError, OSError) as error:
        return Finding("drive", PROBLEM, f"{bus_name} failed: {error}", "wiring, termination, bit rate")
    finally:
        bus.shutdown()
    name = f"node {config.canopen.node} on {bus_name}"
    if not times:
        return Finding("drive", PROBLEM, f"{name} does not answer", "power, wiring, bit rate, drive.node")
    p50, worst = float(np.median(times)), max(times)
    numbers = {"answers": len(times), "asked": SDO_READS, "p50_us": p50, "max_us": worst}
    # a cycle waits for its sample for RECEIVE_SHARE of a period; drives answer SYNC no slower than SDO
    allowed_Hz = RECEIVE_SHARE * 1e6 / p50
    numbers["allowed_rate_Hz"] = allowed_Hz
    text = f"{name}: {len(times)} of {SDO_READS} reads answered in {p50:.0f} / {worst:.0f} us (p50/max)"
    text += f", which allows {allowed_Hz:.0f} Hz at least"
    good = len(times) == SDO_READS
    if good and config.loop.rate_Hz > allowed_Hz:
        cure = "drives may answer SDO later than SYNC: look at the round trip that a run reports, or lower loop.rate_Hz"
        return Finding("drive", NOTE, text, cure, numbers)
    return Finding("drive", OK if good else NOTE, text, "" if good else "SDO is being lost: wiring, bus load", numbers)
