"""What those faults mean that have another cause on a serial line than on a CAN bus."""

from __future__ import annotations

import math
from dataclasses import replace

from jointctl.drivers.elmo.codes import SERVO_ON
from jointctl.firmware_py.states import Fault
from jointctl.tools.running.events.fault_text import FAULT_TEXTS, FaultText

# {value}: the number that tripped the limit; {word}: the same as a hexadecimal status register (SR)
SERIAL_FAULT_TEXTS: dict[Fault, FaultText] = {
    Fault.STALE_SAMPLE: FaultText(
        "no usable position reply came for {value:.0f} cycles",
        # Linux hands over what a serial port received by a worker of ordinary priority, however urgent the loop is
        "cable or drive went silent, noise garbles the replies, or a busy computer hands them over late",
        "check the cable and its ground, and what else the computer does; the drive's own limits watched the joint "
        "meanwhile",
    ),
    Fault.BUS_ERROR: FaultText(
        "the serial port is gone or takes no characters any more",
        "adapter or cable unplugged",
        "make sure that the joint stands: nothing could be said to the drive; then plug it in again",
    ),
    Fault.NO_SAMPLES: FaultText(
        "not one position reply came from the drive",
        "the drive went silent after commissioning",
        "check the cable; run again",
    ),
    Fault.SAMPLES_MISSING: replace(
        FAULT_TEXTS[Fault.SAMPLES_MISSING],
        cause="noise garbles replies, or a busy computer hands them over late",
        next_step="check the cable and its ground, and what else the computer does; or lower loop.rate_Hz",
    ),
    Fault.DRIVE_RESTARTED: FaultText(
        "the drive restarted while the loop was running: its unit mode is another one (SR {word})",
        "its supply dropped, or somebody reset it",
        "check the supply; the drive has lost its limits, start again",
    ),
    Fault.SUSPENDED: FaultText(
        "the computer slept for {value:.1f} s while the loop was running; the drive held its last command meanwhile",
        "standby or hibernation: lid, power button, energy saving",
        "make sure that the joint stands; switch standby off, or try systemd-inhibit --what=sleep jointctl ...",
    ),
    Fault.DRIVE_FAULT: FaultText(
        "the drive switched its motor off because of a fault (SR {word})",
        "see the drive's motor fault",
        "remove the cause; jointctl resets nothing by itself",
    ),
    Fault.DRIVE_NOT_ENABLED: FaultText(
        "the motor was switched off without being asked (SR {word})",
        "inhibit input or STO was opened, another program on the line, or a restart of the drive",
        "check the inhibit and STO wiring and the supply",
    ),
    Fault.DRIVE_STAYS_ENABLED: FaultText(
        "the motor is on although nobody asked for it, and does not switch off (SR {word})",
        "another program on the line, or a drive that ignores MO=0",
        "use the emergency stop; check who else uses the port",
    ),
    Fault.ENABLE_TIMEOUT: FaultText(
        "the drive did not switch its motor on in time (SR {word})",
        "no motor supply, STO open, or inhibit input active",
        "check voltage, STO and inhibit; MO=1 is refused until they are right",
    ),
    Fault.OFF_TIMEOUT: FaultText(
        "the drive did not confirm that its motor is off (SR {word})",
        "the line is cut or the drive is silent",
        "use the emergency stop; then check the line",
    ),
}

# with the servo on in the last SR nothing says that the drive has switched off: the loop has given up believing it
STATUS_LOST_TEXT = FaultText(
    "the drive's status stayed away although positions came; the last one said that its motor is on (SR {word})",
    "replies lost to noise, or a busy computer that hands them over late",
    "check the cable and its ground, and what else the computer does",
)


def serial_fault_text(fault: Fault, value: float) -> FaultText | None:
    """The text of a fault on a serial line; None where it is that of a bus.  `value` is SR where there is one."""
    if fault is Fault.DRIVE_NOT_ENABLED and math.isfinite(value) and round(value) & SERVO_ON:
        return STATUS_LOST_TEXT
    return SERIAL_FAULT_TEXTS.get(fault)
