"""`jointctl stop` on a serial line, which has one user at a time: through the run that has it, or past its user.

1. The guard of a run of ours answers: it passes the word on, and enforces it if the run does not obey.
2. Nobody has the port: it is opened and locked, and the drive is switched off.
3. Another program has it, or a run whose guard is mute: the drive is told on the same line without asking.  That other
   program is left alone; it may take some of the replies, so the confirmation may fail although the drive obeys.
"""

from __future__ import annotations

from jointctl.drivers.elmo.dialogue import Dialogue
from jointctl.drivers.elmo.serial_port import SerialPort
from jointctl.drivers.elmo.switch_off import switch_off
from jointctl.drivers.errors import BusError, JointctlError
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.configuration.stop_target import SerialTarget
from jointctl.tools.output import Output
from jointctl.tools.session.line_guard import GuardCall, running_supervisor

SHARED_ATTEMPTS = 10  # the other user of the line takes some replies


def stop_serial(drive: SerialTarget, output: Output) -> str:
    """The drive's state in words after zero, stop, MO=0; raises `BusError` where the port cannot be opened at all."""
    with GuardCall(drive.port, "stop") as call:
        if call.supervisor_pid is not None:
            output.note(f"stopping the run that has {drive.port} (pid {call.supervisor_pid})")
            state = call.outcome()
            if state is not None and not state.startswith("unknown"):
                return state
            output.note("the run did not say that the drive is off: telling the drive itself")
    port, shared = _opened(drive, output)
    try:
        line = Dialogue(port, drive.reply_timeout_s)
        return switch_off(port, line, SHARED_ATTEMPTS) if shared else switch_off(port, line)
    except JointctlError as error:
        return f"unknown: it was told to switch off, but {error.message}"
    finally:
        port.close()


def _opened(drive: SerialTarget, output: Output) -> tuple[SerialPort, bool]:
    """The port, and whether another program has it as well."""
    try:
        return SerialPort(drive.port, drive.baud_rate_bitps), False
    except BusError as error:
        port = SerialPort(drive.port, drive.baud_rate_bitps, exclusive=False)
        output.note(f"{error.message}: telling the drive on the same line")
        return port, True


def refuse_while_running(drive: ElmoSerial) -> None:
    """`BusError` while a run has the line."""
    pid = running_supervisor(drive.port)
    if pid is not None:
        raise BusError(
            f"a run is active on {drive.port} (pid {pid}): no fault is cleared meanwhile",
            "wait for its end, or end it with `jointctl stop`",
        )
