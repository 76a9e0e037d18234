"""`jointctl stop`: from a second terminal, whatever the first one is doing."""

from __future__ import annotations

from pathlib import Path

from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.canopen.switch_off import stop_node
from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.tools.configuration.stop_target import CanTarget, GivenTarget, SerialTarget, stop_target
from jointctl.tools.output import Output
from jointctl.tools.session.result import require_off
from jointctl.tools.session.stop_call import StopCall
from jointctl.tools.verbs.stop_serial import stop_serial


def stop(path: Path, output: Output, given: GivenTarget | None = None) -> int:
    """Stop and disable the drive, and end the program that controls it; `DeviceError` if it does not confirm.

    Nothing but the address is taken from the configuration, which need not hold; what is wrong with it is told after.
    The drive is stopped at once, and once more when that program has ended: it cannot enable it any more then.
    """
    target = stop_target(path, given)

    def switch_off() -> str:
        return stop_serial(target, output) if isinstance(target, SerialTarget) else _stop_canopen(target)

    with StopCall(*target.place) as call:
        failure: JointctlError | None = None
        try:
            state = switch_off()
        except JointctlError as error:
            failure = error
        if call.end(output.note):
            state = switch_off()
        elif failure is not None:
            raise failure
    try:
        output.result(f"the drive is {state}", {"drive_state": state})
    finally:  # a result that cannot be written must not hide that the drive is not off
        _warn_of(path, output)
        require_off(state)
    return 0


def _stop_canopen(target: CanTarget) -> str:
    bus = open_python_can(target.interface, target.channel, target.bitrate_bitps, exclusive=False)
    return stop_node(bus, target.node, encoder_node=target.encoder_node, sdo_timeout_s=target.sdo_timeout_s)


def _warn_of(path: Path, output: Output) -> None:
    from jointctl.tools.configuration.load import load_config  # the stop itself does not wait for its modules

    try:
        load_config(path)
    except ConfigurationError as error:
        for line in error.message.splitlines():
            output.warning(f"the stop was sent, but the configuration does not hold: {line}")
