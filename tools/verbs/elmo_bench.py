"""An Elmo drive on its serial line at the bench.

The line has one user at a time.  `stop` goes through the run that has it, or past its user:

1. The guard of a run of ours answers: it passes the word on, and enforces it if the run does not obey.
2. Nobody has the port: it is opened and locked, and the drive is switched off.
3. Another program has it, or a run whose guard is mute: the drive is stopped on the same line without asking.  The
   other program is left alone; it may take some of the replies, so the confirmation may fail although the drive obeys.

`monitor` is for a drive that no run has: it asks again and again, because the drive never speaks by itself.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from rich.table import Column, Table

from jointctl.drivers.elmo.dialogue import (
    CURRENT_LIMITED,
    FAULT_LATCHED,
    SERVO_ON,
    Dialogue,
    SerialPort,
    motor_off_cause,
    status_text,
    switch_off,
)
from jointctl.drivers.elmo.settings import LARGEST_SHARE, SERIAL, highest_rate_Hz
from jointctl.drivers.errors import BusError, ConfigurationError, JointctlError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import BAUD_RATES_TEXT, BAUD_RATES_bitps, elmo_section, serial_line_share
from jointctl.tools.output import Output
from jointctl.tools.session.elmo_guard import GuardCall
from jointctl.tools.verbs.bench_drive import Asked, BenchDrive, ReadableKeys, ServeOptions, is_text

if TYPE_CHECKING:
    from jointctl.tools.analysis.linear_loop import LoopSettings
    from jointctl.tools.inspection.health import Finding
    from jointctl.tools.verbs.monitor import MonitorOptions

SHARED_ATTEMPTS = 10  # the other user of the line takes some replies
REPLY_TIMEOUT_S = 0.2
HIGHEST_CUTOFF = 0.48  # of the rate; the configuration allows less than half
INTERVAL_S = 0.1  # between two questions of `monitor`


@dataclass(frozen=True)
class Reading:
    """One round of questions, in the units of the joint."""

    time_s: float  # calendar
    position_rad: float
    velocity_radps: float
    torque_Nm: float
    status: int  # SR
    motor_fault: int  # MF

    @property
    def text(self) -> str:
        """SR in words, and why the motor went off."""
        words = status_text(self.status)
        if self.status & FAULT_LATCHED:
            words += f", {motor_off_cause(self.status, self.motor_fault)}"
        return words

    def line(self) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(self.time_s)) + f"{self.time_s % 1:.3f}"[1:]
        return (
            f"{clock}  {self.position_rad:+.6f} rad  {self.velocity_radps:+.5f} rad/s  {self.torque_Nm:+.2f} Nm  "
            f"SR {self.status:X}h: {self.text}"
        )

    def json(self) -> str:
        return json.dumps(
            {
                "time_s": self.time_s, "position_rad": self.position_rad, "velocity_radps": self.velocity_radps,
                "torque_Nm": self.torque_Nm, "status": self.status, "motor_fault": self.motor_fault,
                "servo_on": bool(self.status & SERVO_ON), "current_limited": bool(self.status & CURRENT_LIMITED),
                "text": self.text,
            }
        )  # fmt: skip


@dataclass(frozen=True)
class PortTarget:
    """See `StopTarget`."""

    port: str
    baud_rate_bitps: int
    reply_timeout_s: float = REPLY_TIMEOUT_S

    @property
    def place(self) -> tuple[str, str]:
        return SERIAL, self.port

    def switch_off(self, output: Output) -> str:
        """After zero, stop, MO=0; raises `BusError` where the port cannot be opened at all."""
        with GuardCall(self.port, "stop") as call:
            if call.supervisor_pid is not None:
                output.note(f"stopping the run that has {self.port} (pid {call.supervisor_pid})")
                state = call.outcome()
                if state is not None and not state.startswith("unknown"):
                    return state
                output.note("the run did not say that the drive is off: telling the drive itself")
        port, shared = _opened(self, output)
        try:
            return self._told(port, shared)
        except JointctlError as error:
            return f"unknown: it was commanded to switch off, but {error.message}"
        finally:
            port.close()

    def _told(self, port: SerialPort, shared: bool) -> str:
        """The state of the drive, from its own answers."""
        line = Dialogue(port, self.reply_timeout_s)
        if shared:
            return switch_off(port, line, SHARED_ATTEMPTS)
        try:
            return switch_off(port, line)
        except BusError:  # garbled: another `stop` has come to the same line
            return switch_off(port, line, SHARED_ATTEMPTS)


def _opened(target: PortTarget, output: Output) -> tuple[SerialPort, bool]:
    """The port, and whether another program has it as well."""
    try:
        return SerialPort(target.port, target.baud_rate_bitps), False
    except BusError as error:
        port = SerialPort(target.port, target.baud_rate_bitps, exclusive=False)
        output.note(f"{error.message}: telling the drive on the same line")
        return port, True


class ElmoBench(BenchDrive):
    """See `BenchDrive`."""

    def claims(self, keys: ReadableKeys) -> bool:
        return keys.given.bus is None and (keys.given.port is not None or "port" in keys.section("drive"))

    def stop_target(self, keys: ReadableKeys) -> PortTarget:
        drive = keys.section("drive")
        if keys.given.bus is not None:
            raise ConfigurationError(
                "command line: -i, -c and -b name a CAN bus, the drive is on a serial port: use -p"
            )
        port = keys.required("drive.port", [keys.given.port, drive.get("port")], is_text, "a text in quotes")
        rates = [drive.get("baud_rate_bitps")]
        rate = keys.required("drive.baud_rate_bitps", rates, BAUD_RATES_bitps.__contains__, BAUD_RATES_TEXT)
        return PortTarget(port, rate, keys.seconds("drive", "reply_timeout_s") or REPLY_TIMEOUT_S)

    def info(self, asked: Asked, output: Output) -> int:
        """See `BenchDrive`: every answer as it came, and what it means at the joint."""
        from jointctl.tools.inspection.elmo_health import inspected_drive

        config = _configured(asked)
        section = elmo_section(config)
        place = f"{section.port} at {section.baud_rate_bitps} baud"
        output.note(f"reading the drive on {place}")
        with inspected_drive(config) as (drive, identity):
            facts = drive.facts()
        columns = ("name", "label", Column("value", justify="right"), "meaning")
        table = Table(*columns, title=f"{identity.name} on {place}", title_justify="left", show_header=False, box=None)
        for fact in facts:
            table.add_row(fact.name, fact.label, fact.value, fact.meaning)
        data = {"port": section.port, "baud_rate_bitps": section.baud_rate_bitps, "version": identity.name}
        output.result(table, {**data, "facts": [asdict(fact) for fact in facts]})
        return 0

    def monitor(self, asked: Asked, output: Output, options: MonitorOptions) -> int:
        """See `BenchDrive`; `changes` shows only another position or status."""
        from jointctl.tools.inspection.elmo_health import inspected_drive
        from jointctl.tools.session.control import stop_signals

        config = _configured(asked)
        section = elmo_section(config)
        until_s = None if options.duration_s is None else time.monotonic() + options.duration_s
        shown, rounds = 0, 0
        last: tuple[float, int, int] | None = None
        with inspected_drive(config) as (drive, identity), stop_signals() as signals:
            output.note(f"{identity.name} on {section.port}: asked every {INTERVAL_S:g} s; Ctrl-C ends it")
            next_s = started_s = time.monotonic()
            while not signals.count and (options.count is None or shown < options.count):
                if until_s is not None and time.monotonic() >= until_s:
                    break
                status, fault = drive.status()
                reading = Reading(time.time(), *drive.motion(), status, fault)
                rounds += 1
                now = (reading.position_rad, reading.status, reading.motor_fault)
                if not (options.changes and now == last):
                    shown += 1
                    if not output.line(reading.json() if output.json else reading.line()):
                        break
                last = now
                next_s = max(next_s + INTERVAL_S, time.monotonic())
                time.sleep(max(0.0, next_s - time.monotonic()))
            output.note(f"asked {rounds} times in {time.monotonic() - started_s:.1f} s")
        return 0

    def findings(self, config: Config) -> Iterator[Finding]:
        from jointctl.tools.inspection.elmo_health import serial_findings

        yield from serial_findings(config)

    def serve(self, config: Config, output: Output, options: ServeOptions) -> int:
        """See `BenchDrive`; prints the port on stdout."""
        from jointctl.tools.session.control import stop_signals
        from jointctl.tools.verbs.hil import make_realtime, wait_for_end, watched
        from jointctl.tools.virtual_joint import serve_virtual_elmo

        if options.port is not None:
            raise ConfigurationError(
                f"--port (={options.port}) must be absent for hil: the system names its port",
                "--link PATH makes a name of yours for it",
            )
        if options.timing:
            raise ConfigurationError("--timing is for a CAN bus: a serial line always takes the time of its baud rate")
        with stop_signals() as signals, serve_virtual_elmo(config, options.link) as device:
            make_realtime(config, output)
            path = options.link or device.path
            output.result(path, {"port": path, "baud_rate_bitps": device.baud_rate_bitps})
            output.note(f"virtual drive: {path} at {device.baud_rate_bitps} baud; Ctrl-C ends it")
            with watched(config, options.live, output, device.interpreter.state):
                wait_for_end(signals, options.ready_fd)
        return 0

    def require_rate(self, config: Config) -> None:
        """See `BenchDrive`; the hint names a rate, and gains, that the line does carry."""
        try:
            serial_line_share(config)
        except ConfigurationError as error:
            raise ConfigurationError(error.message, _advice(config)) from None

    def check_rows(self, config: Config) -> tuple[tuple[str, str, str], ...]:
        drive = elmo_section(config)
        highest = highest_rate_Hz(drive.baud_rate_bitps, drive.echo)
        text = f"{serial_line_share(config):.0%} of the line; up to {highest:.0f} Hz at {drive.baud_rate_bitps} baud"
        return (("serial line", text, "characters of a cycle; measured before a run enables"),)


def _configured(asked: Asked) -> Config:
    """A serial drive is always that of a configuration: it tells the baud rate."""
    assert asked.config is not None
    return asked.config


def _advice(config: Config) -> str:
    """The rate with the reserve that is kept for the measured line, the cut-off that it allows, and gains."""
    from jointctl.tools.analysis.linear_loop import loop_settings

    drive = elmo_section(config)
    rate_Hz = math.floor(LARGEST_SHARE * highest_rate_Hz(drive.baud_rate_bitps, drive.echo))
    minimum_deg = config.margin.min_phase_margin_deg
    settings, _ = loop_settings(config, 1.0 / rate_Hz)
    cutoff_Hz = min(settings.cutoff_Hz, float(f"{HIGHEST_CUTOFF * rate_Hz:.2g}"))
    settings = replace(settings, period_s=1.0 / rate_Hz, cutoff_Hz=cutoff_Hz)
    changed = f"loop.rate_Hz = {rate_Hz}" if cutoff_Hz == config.control.velocity_cutoff_Hz else (
        f"loop.rate_Hz = {rate_Hz} and control.velocity_cutoff_Hz = {cutoff_Hz:g}"
    )  # fmt: skip
    return f"with {changed} {_gains(settings, minimum_deg)}; or a higher baud rate, or drive.echo = false"


def _gains(settings: LoopSettings, minimum_deg: float) -> str:
    from jointctl.tools.analysis.margin_gate import meets, remedies
    from jointctl.tools.analysis.margins import margins

    found = margins(settings)
    if meets(found, minimum_deg):
        return f"the gains keep {found.phase_margin_deg:.0f} deg"
    changes = remedies(settings, minimum_deg)
    if not changes:
        return "the gains must be lowered: kp, kv and q together"
    return f"the gains need {changes[-1].text}"
