"""`jointctl stop` and `jointctl clear-fault`: from a second terminal, whatever the first one is doing."""

from __future__ import annotations

from pathlib import Path

from drivers.can.link_state import interface_blamed
from drivers.can.open import open_python_can
from drivers.canopen.switch_off import stop_node
from drivers.errors import ConfigurationError
from tools.configuration.config import Config
from tools.configuration.elmo import ElmoSerial
from tools.configuration.stop_target import CanTarget, GivenTarget, SerialTarget, stop_target
from tools.output import Output
from tools.running.open_drive import open_drive
from tools.running.result.drive_end import require_off
from tools.verbs.stop_serial import refuse_while_running, stop_serial


def stop(path: Path, output: Output, given: GivenTarget | None = None) -> int:
    """Stop and disable the drive, even while another program controls it; `DeviceError` if it does not confirm.

    Nothing but the address is taken from the configuration, which need not hold; what is wrong with it is told after.
    """
    target = stop_target(path, given)
    state = stop_serial(target, output) if isinstance(target, SerialTarget) else _stop_canopen(target)
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
    from tools.configuration.load import load_config  # the stop itself does not wait for its modules

    try:
        load_config(path)
    except ConfigurationError as error:
        for line in error.message.splitlines():
            output.warning(f"the stop was sent, but the configuration does not hold: {line}")


def clear_fault(config: Config, output: Output) -> int:
    """Reset the drive's fault; it stays disabled."""
    if isinstance(config.drive, ElmoSerial):
        refuse_while_running(config.drive)
    drive = open_drive(config)
    try:
        with interface_blamed(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps):
            done = drive.clear_fault()
    finally:
        drive.close()
    output.result(done, {"result": done})
    return 0
