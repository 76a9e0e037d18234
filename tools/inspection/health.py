"""What `jointctl doctor` finds of computer and bus: findings, each with a remedy where something is amiss."""

from __future__ import annotations

import contextlib
import ctypes
import getpass
import grp
import os
import platform
import resource
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import can
import numpy as np

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz
from jointctl.drivers.can.open import CYCLIC_INTERFACES, open_python_can
from jointctl.drivers.can.socketcan import SHORT_QUEUE, link_problem, link_state, up_command
from jointctl.drivers.canopen.cia import SDO_ANSWER_ID, SDO_REQUEST_ID
from jointctl.drivers.canopen.watchdog import quick_stop_of
from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.canopen import HIGHEST_LOAD, canopen_section, canopen_settings, cycle_bytes
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.subject import Refusal, SdoReader, canopen_network, subject_of_config
from jointctl.tools.session.loop_handle import RECEIVE_SHARE
from jointctl.tools.session.portable_loop import HIGHEST_RATE_HZ
from jointctl.tools.wake_up import cores_awake, fifo, wake_up_lateness_ns

OK, NOTE, PROBLEM = "ok", "note", "problem"
PROBE_TIMEOUT_S = 600.0  # of starting a loop, which may compile


@dataclass(frozen=True)
class Finding:
    """One line of the report; `remedy` tells what to do about it, `numbers` has figures for --json."""

    topic: str
    status: str  # ok, note (works, could be better), problem (a run will fail or be unsafe)
    text: str
    remedy: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)


def file_text(path: Path) -> str | None:
    """What a file of /sys or /proc says; None if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return None


# --- the computer: versions, kernel, real-time rights, wake-up times, kernel cache ---

DEFAULT_PRIORITY = 60
_GOOD_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "riscv_clocksource")
_PR_GET_TIMERSLACK = 30
_MCL_CURRENT = 1
_MUCH_SLACK_NS = 50_000
_LATE_US = 500.0
_FULL = "preempt=full"  # an option of kernels built with PREEMPT_DYNAMIC
_RIGHTS = "in /etc/security/limits.d/jointctl.conf: '{user} - rtprio 90' and '{user} - memlock unlimited'; log in again"
_LATENCY_RIGHT = (
    """a udev rule gives the right: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660", and you in that group"""
)


def _rights() -> str:
    return _RIGHTS.format(user=getpass.getuser())


def software() -> Iterator[Finding]:
    """Python, numba, kernel, cores."""
    python = platform.python_version()
    good = sys.version_info >= (3, 11)
    yield Finding("Python", OK if good else PROBLEM, python, "" if good else "install Python 3.11 or newer")
    yield Finding("numba", OK, f"{version('numba')}, numpy {version('numpy')}, python-can {version('python-can')}")
    cores = len(os.sched_getaffinity(0))
    few = "one core for the loop and one for the rest are the least; close other programs"
    yield Finding("cores", OK if cores >= 2 else NOTE, str(cores), "" if cores >= 2 else few, {"cores": cores})


def _preemption(root: Path) -> Finding:
    """How long the kernel itself may hold a woken loop up: without preemption, to the end of what it is doing."""
    kernel, version = platform.release(), platform.version()
    if file_text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", OK, f"{kernel}, PREEMPT_RT")
    remedy = "a real-time kernel bounds the worst wake-up; install one if the measured max is too late"
    if _FULL in (file_text(root / "proc/cmdline") or "").split():
        return Finding("kernel", NOTE, f"{kernel}, not PREEMPT_RT, {_FULL}", remedy)
    if "PREEMPT_DYNAMIC" in version:
        remedy += f"; the kernel option {_FULL} goes half the way"
    return Finding("kernel", NOTE, f"{kernel}, not PREEMPT_RT", remedy)


def kernel_findings(root: Path = Path("/")) -> Iterator[Finding]:
    """Kernel, clock, governor, timer slack; `root` is replaced in tests."""
    yield _preemption(root)
    clock = file_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    good = clock in _GOOD_CLOCKS
    remedy = "" if good else "a slow clock costs microseconds a reading: try the kernel option clocksource=tsc"
    yield Finding("clock source", OK if good else NOTE, clock or "not reported by this system", remedy if clock else "")
    paths = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({text for path in paths if (text := file_text(path))})
    good = governors in ([], ["performance"])
    remedy = "" if good else "cores that clock down wake up late: sudo cpupower frequency-set -g performance"
    yield Finding("CPU governor", OK if good else NOTE, ", ".join(governors) or "not reported by this system", remedy)


def scheduling() -> Iterator[Finding]:
    """Real-time priority, locked memory, timer slack."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    with fifo(1) as refused:
        good = not refused
    shown = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    text = f"{'permitted' if good else 'refused'}; rtprio limit {shown}"
    yield Finding("SCHED_FIFO", OK if good else NOTE, text, "" if good else _rights())
    libc = ctypes.CDLL(None)
    good = libc.mlockall(_MCL_CURRENT) == 0
    libc.munlockall()
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    shown = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit // 1024} KiB"
    text = f"{'permitted' if good else 'refused'}; limit {shown}"
    yield Finding("memory lock", OK if good else NOTE, text, "" if good else _rights())
    with cores_awake() as refused:
        good = not refused
    text = "cores stay awake during a run" if good else f"cores may sleep deeply: {refused}"
    yield Finding("idle states", OK if good else NOTE, text, "" if good else _LATENCY_RIGHT)
    slack_ns = int(libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0))
    good = 0 < slack_ns <= _MUCH_SLACK_NS
    remedy = "" if good else "without SCHED_FIFO every sleep is that much longer: start jointctl from an ordinary shell"
    yield Finding("timer slack", OK if good else NOTE, f"{slack_ns / 1000:g} us", remedy, {"timer_slack_ns": slack_ns})


def wake_up(config: Config, cycles: int) -> Iterator[Finding]:
    """Measured lateness of a compiled sleep loop at the configured rate, with SCHED_FIFO where it is permitted."""
    rate_Hz = config.loop.rate_Hz
    priority = config.loop.priority or DEFAULT_PRIORITY
    for name, wanted in (("wake-up, ordinary", 0), (f"wake-up, SCHED_FIFO {priority}", priority)):
        with fifo(wanted) if wanted else contextlib.nullcontext("") as refused:
            if refused:
                yield Finding(name, NOTE, f"not measured: {refused}", _rights())
                continue
            with cores_awake():
                late_us = wake_up_lateness_ns(rate_Hz, cycles) / 1000.0
        p50, p99 = np.percentile(late_us, (50.0, 99.0))
        worst = float(late_us.max())
        numbers = {"rate_Hz": rate_Hz, "p50_us": float(p50), "p99_us": float(p99), "max_us": worst}
        good = worst <= min(_LATE_US, 0.5e6 / rate_Hz)
        text = f"late by {p50:.0f} / {p99:.0f} / {worst:.0f} us (p50/p99/max of {cycles} at {rate_Hz:g} Hz)"
        remedy = "" if good else "give loop.cpu a core of its own (isolcpus), set loop.priority, close other programs"
        yield Finding(name, OK if good else NOTE, text, remedy, numbers)


def kernel_cache(folder: Path | None, cold: bool) -> Iterator[Finding]:
    """Where it is, whether the loop is in it, and how long a start takes."""
    if folder is None:
        remedy = "set JOINTCTL_CACHE_DIR to a folder that can be written; else every start compiles"
        yield Finding("kernel cache", PROBLEM, "no folder can be written", remedy)
        return
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    warm = any(path.name.startswith("run_loop-") and path.suffix == ".entry" for path in files)
    text = f"{folder}, {len(files)} files, {size / 1e6:.1f} MB, {'warm' if warm else 'cold'}"
    remedy = "" if warm else "the first start compiles for about a minute: run `jointctl demo` once"
    yield Finding(
        "kernel cache", OK if warm else NOTE, text, remedy, {"files": len(files), "bytes": size, "warm": warm}
    )
    if warm:
        yield _start("warm start", None)
    if cold:
        with tempfile.TemporaryDirectory() as empty:
            yield _start("cold start", Path(empty))
            if not warm:
                yield _start("warm start", Path(empty))


def _start(topic: str, cache: Path | None) -> Finding:
    try:
        seconds = start_time_s(cache)
    except (subprocess.SubprocessError, OSError) as error:
        lines = str(getattr(error, "stderr", b"").decode(errors="replace") or error).strip().splitlines()
        return Finding(topic, PROBLEM, f"the loop cannot be started: {lines[-1]}", "reinstall jointctl")
    return Finding(topic, OK, f"{seconds:.2f} s until the loop is ready", "", {"start_s": seconds})


# --- the bus: interfaces and their state, its budget, how fast the drive answers ---

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
        remedy = "sudo modprobe can_raw"
        yield Finding("SocketCAN", PROBLEM if needed else NOTE, f"not available: {error}", remedy)
    found = [
        f"{path.name} ({file_text(path / 'operstate') or 'state unknown'})"
        for path in sorted((root / "sys/class/net").glob("*"))
        if file_text(path / "type") == _CAN_LINK
    ]
    remedy = "" if found else "plug in the adapter; slcan adapters need slcand"
    status = OK if found else PROBLEM if needed else NOTE
    yield Finding("CAN interfaces", status, ", ".join(found) or "none", remedy)
    try:
        member = os.geteuid() == 0 or grp.getgrnam("dialout").gr_gid in os.getgroups()
    except KeyError:
        yield Finding("serial ports", NOTE, "this system has no group dialout", "see who owns the adapter's /dev/tty*")
        return
    remedy = "" if member else f"for serial adapters: sudo usermod -aG dialout {getpass.getuser()}; log in again"
    yield Finding("serial ports", OK if member else NOTE, "may be used" if member else "not in group dialout", remedy)


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
            remedy = f"plug it in, then: {up_command(name, config.bus.bitrate_bitps)}"
            yield Finding("interface", PROBLEM, f"there is no CAN interface {name}", remedy)
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
    remedy = "frames have been failing: wiring, termination (60 ohm between H and L), bit rate" if bad else ""
    yield Finding("interface", NOTE if bad else OK, text, remedy, numbers)
    queue = link.queue_frames
    if queue is not None and queue < SHORT_QUEUE:
        remedy = f"sudo ip link set {name} txqueuelen 1000"
        yield Finding("transmit queue", NOTE, f"{queue} frames: overflows when several programs send", remedy)


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


def sdo_round_trips_us(bus: can.BusABC, node: int) -> list[float]:
    """Times [us] to read 1000h of `node`, fewer than SDO_READS where answers stay away; writes nothing."""
    request = can.Message(
        arbitration_id=SDO_REQUEST_ID + node, is_extended_id=False, data=struct.pack("<BHB4x", 0x40, 0x1000, 0)
    )
    times: list[float] = []
    for _ in range(SDO_READS):
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
        times = sdo_round_trips_us(bus, canopen_section(config).node)
    except (can.CanError, OSError) as error:
        return Finding("drive", PROBLEM, f"{bus_name} failed: {error}", "wiring, termination, bit rate")
    finally:
        bus.shutdown()
    name = f"node {canopen_section(config).node} on {bus_name}"
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
        remedy = (
            "drives may answer SDO later than SYNC: look at the round trip that a run reports, or lower loop.rate_Hz"
        )
        return Finding("drive", NOTE, text, remedy, numbers)
    return Finding("drive", OK if good else NOTE, text, "" if good else "SDO is being lost: wiring, bus load", numbers)


def quick_stop_finding(config: Config) -> Iterator[Finding]:
    """How fast the drive's own quick stop brakes, by its objects; nothing where it gives none."""
    subject, settings = subject_of_config(config), canopen_settings(config)
    try:
        with canopen_network(subject) as network:
            reader = SdoReader(network, subject.required_node(), subject.objects())
            if isinstance(reader.upload(0x1000), Refusal):
                return

            def unsigned(index: int, sub: int) -> int | None:
                data = reader.upload(index, sub)
                return None if isinstance(data, Refusal) else int.from_bytes(data, "little")

            found = quick_stop_of(unsigned, settings)
    except BusError:  # has been reported of the drive
        return
    numbers = {} if found.radps2 is None else {"radps2": found.radps2}
    remedy = "see the drive's manual, or try it with a joint that cannot hurt or be hurt"
    if problem := found.problem(settings):
        remedy = f"set {found.index:04X} in the drive, by the maker's software, and store it there"
    yield Finding(
        "quick stop", OK if numbers and not problem else NOTE, problem or found.words,
        "" if numbers and not problem else remedy, numbers,
    )  # fmt: skip


def start_time_s(cache: Path | None = None) -> float:
    """Seconds from starting a process until the loop is ready in it; `cache` another cache folder than the present.

    Raises subprocess.SubprocessError if the process fails.
    """
    environment = dict(os.environ, **({"JOINTCTL_CACHE_DIR": str(cache)} if cache else {}))
    command = [sys.executable, "-P", "-m", "jointctl.tools.session.loops"]
    started_s = time.monotonic()
    subprocess.run(command, env=environment, check=True, timeout=PROBE_TIMEOUT_S, capture_output=True)
    return time.monotonic() - started_s


# CAN adapters on USB that are plugged in but not up, and the command that brings each one up; reads /sys only.
#
# Sources of the USB numbers: Linux drivers/net/can/usb (gs_usb.c, peak_usb, kvaser_usb), firmware of the CANable.
# docs/adapters.md has the same table in words.

ANY_PRODUCT = ""
_IFF_UP = 1
SLCAN_CODES = {
    10_000: 0, 20_000: 1, 50_000: 2, 100_000: 3, 125_000: 4, 250_000: 5, 500_000: 6, 1_000_000: 8,
}  # fmt: skip


@dataclass(frozen=True)
class AdapterKind:
    """What a USB number stands for; `module` is Linux' driver, None for one that has none and is no slcan adapter."""

    name: str
    module: str | None
    instead: str = ""  # without a driver: the interface of python-can


_KINDS = {
    ("1d50", "606f"): AdapterKind("candleLight, CANable (candleLight firmware) or other gs_usb adapter", "gs_usb"),
    ("1209", "2323"): AdapterKind("candleLight", "gs_usb"),
    ("1209", "ca01"): AdapterKind("CANnectivity", "gs_usb"),
    ("1cd2", "606f"): AdapterKind("CES CANext FD", "gs_usb"),
    ("16d0", "10b8"): AdapterKind("ABE CAN Debugger FD", "gs_usb"),
    ("0c72", "000c"): AdapterKind("PCAN-USB", "peak_usb"),
    ("0c72", "000d"): AdapterKind("PCAN-USB Pro", "peak_usb"),
    ("0c72", "0011"): AdapterKind("PCAN-USB Pro FD", "peak_usb"),
    ("0c72", "0012"): AdapterKind("PCAN-USB FD", "peak_usb"),
    ("0c72", "0013"): AdapterKind("PCAN-Chip USB", "peak_usb"),
    ("0c72", "0014"): AdapterKind("PCAN-USB X6", "peak_usb"),
    ("0bfd", ANY_PRODUCT): AdapterKind("Kvaser", "kvaser_usb"),
    ("ad50", "60c4"): AdapterKind("CANable (slcan firmware)", "slcan"),
    ("16d0", "117e"): AdapterKind("CANable 2 (slcan firmware)", "slcan"),
    ("04d8", "0053"): AdapterKind("CANalyst-II, Waveshare USB-CAN-B", None, "canalystii"),
}


@dataclass(frozen=True)
class Adapter:
    """One that is plugged in: its CAN interfaces and its serial ports, by the names that Linux gave them."""

    kind: AdapterKind
    links: tuple[str, ...]
    ports: tuple[str, ...]


def plugged_in(root: Path = Path("/")) -> list[Adapter]:
    """The USB devices that are known as CAN adapters."""
    found = []
    for device in sorted((root / "sys/bus/usb/devices").glob("*")):
        vendor, product = file_text(device / "idVendor") or "", file_text(device / "idProduct") or ""
        kind = _KINDS.get((vendor.lower(), product.lower())) or _KINDS.get((vendor.lower(), ANY_PRODUCT))
        if kind is None:
            continue
        links = tuple(sorted(path.name for path in device.glob("*/net/*")))
        ports = {path.name for path in [*device.glob("*/tty/tty*"), *device.glob("*/ttyUSB*")]}
        found.append(Adapter(kind, links, tuple(sorted(ports))))
    return found


def _links(root: Path) -> Iterator[tuple[str, bool]]:
    """Every CAN interface and whether it is up."""
    for path in sorted((root / "sys/class/net").glob("*")):
        if file_text(path / "type") == _CAN_LINK:
            flags = file_text(path / "flags") or "0"
            yield path.name, bool(int(flags, 16) & _IFF_UP)


def _attach_command(port: str, bitrate_bitps: int) -> str | None:
    """What makes a serial port a CAN interface; None for a bit rate that slcan has no code for."""
    code = SLCAN_CODES.get(bitrate_bitps)
    if code is None:
        return None
    return f"sudo slcand -o -s{code} -t hw /dev/{port} slcan0 && sudo ip link set slcan0 up txqueuelen 1000"


def _down_finding(name: str, owner: str, bitrate_bitps: int) -> Finding:
    """An interface that has only to be set up; slcan and virtual ones have no bit rate there."""
    own_rate = not name.startswith(("slcan", "vcan"))
    remedy = up_command(name, bitrate_bitps) if own_rate else f"sudo ip link set {name} up"
    return Finding("adapter", NOTE, f"{name}{f' ({owner})' if owner else ''} is plugged in but down", remedy)


def adapters_not_up(config: Config, root: Path = Path("/")) -> Iterator[Finding]:
    """One finding for each interface or adapter that could be used after one command.

    The configured interface is left out: `health.interface_state` has its state.
    """
    bus, links = config.bus, dict(_links(root))
    adapters = plugged_in(root)
    owners = {name: adapter.kind.name for adapter in adapters for name in adapter.links}
    for name, up in links.items():
        if not up and not (bus.interface == "socketcan" and name == bus.channel):
            yield _down_finding(name, owners.get(name, ""), bus.bitrate_bitps)
    attached = any(name.startswith("slcan") for name in links)
    for adapter in adapters:
        finding = _without_link(adapter, bus.bitrate_bitps, attached)
        if finding is not None:
            yield finding


def _without_link(adapter: Adapter, bitrate_bitps: int, attached: bool) -> Finding | None:
    """An adapter that is no CAN interface yet, or never will be."""
    kind = adapter.kind
    if adapter.links:
        return None
    text = f"{kind.name} is plugged in but is no CAN interface"
    if kind.module is None:
        remedy = f"Linux has no driver for it: interface {kind.instead} of python-can, in the plain Python loop"
        return Finding("adapter", NOTE, text, remedy)
    if kind.module != "slcan":
        return Finding("adapter", NOTE, text, f"sudo modprobe {kind.module}; a driver of the maker may hold it instead")
    if attached:
        return None
    if not adapter.ports:
        return Finding("adapter", NOTE, text, "it has no serial port: sudo modprobe cdc_acm, or plug it in again")
    command = _attach_command(adapter.ports[0], bitrate_bitps)
    return Finding("adapter", NOTE, text, command or f"slcan has no code for {bitrate_bitps} bit/s")
