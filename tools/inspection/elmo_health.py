"""What a serial line and its drive allow: port, rights, adapter latency, rate by baud rate and as measured, limits."""

from __future__ import annotations

import getpass
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.elmo.dialogue import AMPLIFIER_MASK, FAULT_LATCHED, motor_off_cause, status_text
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import cycle_characters, highest_rate_Hz
from jointctl.drivers.errors import BusError, JointctlError
from jointctl.drivers.port_users import users_text
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import elmo_section, elmo_settings
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM, Finding, file_text
from jointctl.tools.session.elmo_guard import running_supervisor


@contextmanager
def inspected_drive(config: Config) -> Iterator[tuple[ElmoDrive, DriveIdentity]]:
    """The drive and its identity; nothing is written.  `BusError` if another program has the line, named if a run."""
    port = elmo_section(config).port
    pid = running_supervisor(port)
    if pid is not None:
        raise BusError(
            f"a run has {port} (pid {pid}), and a serial line has one user at a time",
            "its live values: `jointctl run --scope`; its log has every cycle",
        )
    drive = ElmoDrive(elmo_settings(config))
    try:
        yield drive, drive.identify()
    finally:
        drive.close()


SLOW_LATENCY_MS = 1  # an FTDI adapter holds received characters back for up to 16 ms as it comes


def port_finding(path: str) -> Finding:
    """Whether the port exists, is a terminal, may be used, and by whom it is."""
    try:
        found = os.stat(path)
    except OSError as error:
        ports = sorted(str(p) for pattern in ("ttyUSB*", "ttyACM*", "ttyS[0-9]") for p in Path("/dev").glob(pattern))
        remedy = "plug in the adapter; -p names the port" + (f"; there are {', '.join(ports)}" if ports else "")
        return Finding("serial port", PROBLEM, f"{path}: {error.strerror}", remedy)
    if not stat.S_ISCHR(found.st_mode):
        return Finding("serial port", PROBLEM, f"{path} is no device", "-p names the port")
    if not os.access(path, os.R_OK | os.W_OK):
        remedy = f"sudo usermod -aG dialout {getpass.getuser()}; log in again"
        return Finding("serial port", PROBLEM, f"{path}: no permission to read and write", remedy)
    users = users_text(path)
    real = os.path.realpath(path)
    text = path if real == path else f"{path} ({real})"
    if users:
        return Finding("serial port", NOTE, f"{text} is in use: {users}", "the line has one user at a time")
    return Finding("serial port", OK, f"{text}, may be used")


def latency_finding(path: str, root: Path = Path("/")) -> Finding:
    """The latency timer of an FTDI adapter: it decides the round trip more than the baud rate does."""
    name = os.path.basename(os.path.realpath(path))
    text = file_text(root / f"sys/bus/usb-serial/devices/{name}/latency_timer")
    if text is None or not text.isdigit():
        return Finding("adapter latency", OK, "no latency timer: not an FTDI adapter, or its driver does not tell")
    latency_ms = int(text)
    good = latency_ms <= SLOW_LATENCY_MS
    remedy = f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer (again after each plugging in)"
    numbers = {"latency_timer_ms": latency_ms}
    return Finding("adapter latency", OK if good else PROBLEM, f"{latency_ms} ms", "" if good else remedy, numbers)


def line_budget(config: Config) -> Finding:
    """The rate that the characters of a cycle allow."""
    drive, rate_Hz = elmo_section(config), config.loop.rate_Hz
    highest = highest_rate_Hz(drive.baud_rate_bitps, drive.echo)
    text = (
        f"{cycle_characters(drive.echo)} characters a cycle {'with' if drive.echo else 'without'} echo at "
        f"{drive.baud_rate_bitps} baud: up to {highest:.0f} Hz; loop.rate_Hz is {rate_Hz:g}"
    )
    good = rate_Hz <= highest
    remedy = "" if good else "lower loop.rate_Hz, raise the baud rate here and in the drive, or drive.echo = false"
    return Finding("line budget", OK if good else PROBLEM, text, remedy, {"highest_rate_Hz": highest})


def drive_findings(config: Config) -> Iterator[Finding]:
    """Who answers, how fast, in which state and with which limits; nothing is written."""
    try:
        with inspected_drive(config) as (drive, identity):
            section = elmo_section(config)
            yield Finding("drive", OK, f"{identity.name} on {section.port} at {section.baud_rate_bitps} baud")
            yield _round_trip(config, drive)
            yield _state(drive)
            yield _limits(config, drive)
    except BusError as error:
        yield Finding("drive", PROBLEM, f"not asked: {error.message}", error.hint)
    except JointctlError as error:
        yield Finding("drive", PROBLEM, error.message, error.hint)


def _round_trip(config: Config, drive: ElmoDrive) -> Finding:
    measured = drive.measure()
    rate_Hz = config.loop.rate_Hz
    text = (
        f"one exchange takes {measured.cycle_s * 1e3:.2f} ms, worst {measured.worst_cycle_s * 1e3:.2f} ms: up to "
        f"{measured.highest_rate_Hz:.0f} Hz"
    )
    good = rate_Hz <= measured.highest_rate_Hz
    remedy = "" if good else f"lower loop.rate_Hz (={rate_Hz:g}), raise the baud rate, reduce the adapter's latency"
    numbers = {
        "cycle_s": measured.cycle_s,
        "worst_cycle_s": measured.worst_cycle_s,
        "highest_rate_Hz": measured.highest_rate_Hz,
        "loop_delay_s": measured.loop_delay_s,
    }
    return Finding("round trip", OK if good else PROBLEM, text, remedy, numbers)


def _state(drive: ElmoDrive) -> Finding:
    status, fault = drive.status()
    text = status_text(status)
    if status & (FAULT_LATCHED | AMPLIFIER_MASK):
        remedy = "remove the cause, then `jointctl clear-fault`"
        return Finding("drive state", PROBLEM, f"{text}; {motor_off_cause(status, fault)}", remedy)
    return Finding("drive state", OK, text)


def _limits(config: Config, drive: ElmoDrive) -> Finding:
    """The drive's present limits; a run writes those of the configuration."""
    facts = {fact.name: fact for fact in drive.facts()}
    echo = facts.get("EO")
    shown = [f"{name} {facts[name].meaning or facts[name].value}" for name in
             ("CL[1]", "PL[1]", "PL[2]", "HL[2]", "LL[2]", "HL[3]", "LL[3]", "ER[2]", "ER[3]")]  # fmt: skip
    text = f"echo {echo.meaning if echo else 'unknown'}; {', '.join(shown)}"
    maximum = facts["MC"].value
    wanted_A = elmo_section(config).peak_current_A
    if maximum and wanted_A > float(maximum):
        return Finding("drive limits", PROBLEM, text, f"drive.peak_current_A (={wanted_A:g}) is above MC (={maximum})")
    return Finding("drive limits", OK, text)


def serial_findings(config: Config) -> Iterator[Finding]:
    """All of them, in place of those of a CAN bus."""
    path = elmo_section(config).port
    port = port_finding(path)
    yield port
    if port.status != PROBLEM:
        yield latency_finding(path)
    yield line_budget(config)
    if port.status != PROBLEM:
        yield from drive_findings(config)
