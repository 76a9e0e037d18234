"""Torque and speed zero, motor off on a serial line: sent by drive, loop, guard and `jointctl stop`."""

from __future__ import annotations

from jointctl.drivers.elmo.codes import AMPLIFIER_MASK, FAULT_LATCHED, MOTOR_MUST_BE_ON, motor_off_cause
from jointctl.drivers.elmo.dialogue import Dialogue, RefusedError
from jointctl.drivers.elmo.serial_port import BytePort
from jointctl.drivers.errors import DeviceError, JointctlError

SAFE_ATTEMPTS = 5
# TC and ST before MO: where the drive takes no MO=0 it is without torque, or its jog has ended, all the same.  JV=0, so
# that no later BG jogs on; without a BG, which in a unit mode that another program has chosen would begin a motion.
# The first CR ends a half command.
COMMANDS = (b"TC=0", b"JV=0", b"ST", b"MO=0")
SWITCH_OFF = b"\r" + b"".join(command + b"\r" for command in COMMANDS)


def switch_off(port: BytePort, line: Dialogue, attempts: int = SAFE_ATTEMPTS) -> str:
    """TC=0, JV=0, ST, MO=0 until MO reads 0; returns `off`, or `off, fault: ...`.

    Raises the last error where the drive did not confirm; all commands were sent, as far as the port took them.
    """
    line.interpreter.echo = None  # a drive that restarted has its own setting again
    error: JointctlError | None = None
    # at once and unheard, before any time is spent on a line that may be in disorder
    port.write(SWITCH_OFF)
    for _ in range(attempts):
        try:
            line.resynchronise()
            for command in COMMANDS:
                try:
                    line.ask(command + b"\r", 1)
                except RefusedError as refusal:
                    if command == b"MO=0" and refusal.code != MOTOR_MUST_BE_ON:
                        raise
            if line.integer("MO") == 0:
                status = line.integer("SR")
                cause = motor_off_cause(status, line.integer("MF"))
                return "off" if not status & (FAULT_LATCHED | AMPLIFIER_MASK) else f"off, fault: {cause}"
        except JointctlError as failure:
            error = failure
    raise error or DeviceError("MO of the drive does not become 0")
