"""`jointctl clear-fault`: reset the drive's own fault; nothing else of jointctl ever does."""

from __future__ import annotations

from jointctl.drivers.errors import INTERRUPTED
from jointctl.tools.verbs.verb_options import JointOnBus, ResultOutput


def clear_fault(config: JointOnBus, output: ResultOutput) -> int:
    """Reset the drive's fault; it stays disabled."""
    from jointctl.drivers.can.socketcan import interface_blamed
    from jointctl.tools.session import result as drive_end
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.result import warn_unless_off
    from jointctl.tools.session.session_drive import session_drive

    kind = session_drive(config.drive.kind)
    kind.refuse_beside_run(config)
    with in_control(config, output) as control, control.signals.held():
        try:
            drive = kind.open(config, control.signals.leave_if_asked)
        except KeyboardInterrupt:
            output.note(f"interrupted{control.signals.by_command}; nothing was sent to the drive")
            return INTERRUPTED
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
    output.result(done, {"result": done}, done)
    return 0
