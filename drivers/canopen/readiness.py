"""Drives that need time: Not Ready to Switch On for a while, or without a statusword until they are told something."""

from __future__ import annotations

from collections.abc import Callable

from jointctl.drivers.canopen.cia402 import ControlWord, State, state_of_word
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.errors import DeviceError
from jointctl.firmware_py.states import in_words

POLL_S = 0.05


def wait_until_ready(objects: ObjectAccess, node: int, timeout_s: float, pause: Callable[[float], None]) -> None:
    """Until the statusword is that of a drive which can be switched on; `DeviceError` after `timeout_s`.

    Transition 1 is the drive's own, but some leave Not Ready only after a first controlword.  They get Shutdown and
    Disable Voltage in turn: neither applies power.
    """
    looks = max(1, round(timeout_s / POLL_S))
    for look in range(looks):
        status_word = objects.read(0x6041, what="statusword")
        state = state_of_word(status_word)
        if state not in (State.NOT_READY_TO_SWITCH_ON, State.UNDEFINED):
            if state is State.READY_TO_SWITCH_ON:
                objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
            return
        if look == looks - 1:
            break
        word = ControlWord.DISABLE_VOLTAGE if look % 2 else ControlWord.SHUTDOWN
        objects.write(0x6040, 0, word, what="controlword")
        pause(POLL_S)
    raise DeviceError(
        f"node {node} is {in_words(state)} (statusword {status_word:04X}h) after {timeout_s:g} s",
        hint="motor supply, safe torque off (STO) and enable inputs; a drive that takes longer: drive.boot_timeout_s",
    )
