"""`jointctl stop` and `jointctl clear-fault`: from a second terminal, whatever the first one is doing."""

from __future__ import annotations

from drivers.errors import DeviceError
from tools.configuration.config import Config
from tools.configuration.elmo import ElmoSerial
from tools.output import Output
from tools.running.open_drive import open_drive
from tools.verbs.stop_serial import refuse_while_running, stop_serial

SAFE_STATES = ("switch on disabled", "fault", "off")


def is_safe(state: str) -> bool:
    """Whether the drive's words for its state mean that its power stage is off ("fault reaction active" does not)."""
    return state.partition(",")[0] in SAFE_STATES


def stop(config: Config, output: Output) -> int:
    """Stop and disable the drive, even while another program controls it; `DeviceError` if it does not confirm."""
    state = stop_serial(config.drive, output) if isinstance(config.drive, ElmoSerial) else _stop_canopen(config)
    output.result(f"the drive is {state}", {"drive_state": state})
    if not is_safe(state):
        raise DeviceError(f"the drive did not confirm that it is off (={state})", "use the emergency stop")
    return 0


def _stop_canopen(config: Config) -> str:
    drive = open_drive(config, exclusive=False)
    try:
        return drive.stop_now()
    finally:
        drive.close()


def clear_fault(config: Config, output: Output) -> int:
    """Reset the drive's fault; it stays disabled."""
    if isinstance(config.drive, ElmoSerial):
        refuse_while_running(config.drive)
    drive = open_drive(config)
    try:
        done = drive.clear_fault()
    finally:
        drive.close()
    output.result(done, {"result": done})
    return 0
