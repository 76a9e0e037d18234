"""`jointctl monitor` on a serial line: asks the drive again and again, because it never speaks by itself.

The line has one user at a time, so this is for a drive that no run has: turn the joint by hand, open the inhibit
input, look at a fault.  Nothing is written to the drive.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

from jointctl.drivers.elmo.codes import CURRENT_LIMITED, FAULT_LATCHED, SERVO_ON, motor_off_cause, status_text
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import elmo_section
from jointctl.tools.inspection.serial_health import inspected_drive
from jointctl.tools.output import Output
from jointctl.tools.session.control import stop_signals

INTERVAL_S = 0.1


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


def read_once(drive: ElmoDrive) -> Reading:
    """Ask for everything."""
    status, fault = drive.status()
    return Reading(time.time(), *drive.motion(), status, fault)


def monitor_serial(
    config: Config, output: Output, *, count: int | None = None, duration_s: float | None = None, changes: bool = False
) -> int:
    """Until `count` lines, `duration_s` or a stop signal; `changes` shows only another position or status."""
    section = elmo_section(config)
    until_s = None if duration_s is None else time.monotonic() + duration_s
    shown, asked = 0, 0
    last: tuple[float, int, int] | None = None
    with inspected_drive(config) as (drive, identity), stop_signals() as signals:
        output.note(f"{identity.name} on {section.port}: asked every {INTERVAL_S:g} s; Ctrl-C ends it")
        next_s = started_s = time.monotonic()
        while not signals.count and (count is None or shown < count):
            if until_s is not None and time.monotonic() >= until_s:
                break
            reading = read_once(drive)
            asked += 1
            now = (reading.position_rad, reading.status, reading.motor_fault)
            if not (changes and now == last):
                shown += 1
                if not output.line(reading.json() if output.json else reading.line()):
                    break
            last = now
            next_s = max(next_s + INTERVAL_S, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
        output.note(f"asked {asked} times in {time.monotonic() - started_s:.1f} s")
    return 0
