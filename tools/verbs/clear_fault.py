"""`jointctl clear-fault`: reset the drive's own fault; nothing else of jointctl ever does."""

from __future__ import annotations

from jointctl.drivers.can.socketcan import interface_blamed
from jointctl.drivers.errors import INTERRUPTED
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.output import Output
from jointctl.tools.session import result as drive_end
from jointctl.tools.session.control import in_control
from jointctl.tools.session.open_drive import open_drive
from jointctl.tools.session.result import warn_unless_off
from jointctl.tools.verbs.stop_serial import refuse_while_running


def clear_fault(config: Config, output: Output) -> int:
    """Reset the drive's fault; it stays disabled."""
    if isinstance(config.drive, ElmoSerial):
        refuse_while_running(config.drive)
    with in_control(config, output) as control, control.signals.held():
        drive = open_drive(config, control.signals.leave_if_asked)
        try:
            with interface_blamed(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps):
                done = drive.clear_fault()
        except KeyboardInterrupt:
            state = drive.make_safe(asked=bool(control.signals.commanded_ns))
            warn_unless_off(state, output)
            output.note(f"interrupted{control.signals.by_command}; {drive_end.words(state, interrupted=True)}")
            return INTERRUPTED
        finally:
            drive.close()
    output.result(done, {"result": done})
    return 0
