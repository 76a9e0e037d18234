"""Reset a drive's fault, because the user asked for it; nothing else in jointctl does.

The reset is the rising edge of controlword bit 7, so the bit is cleared first.  If the cause is still there the fault
comes back: a few attempts, then the user is told.  The drive stays disabled throughout.
"""

from __future__ import annotations

from collections.abc import Callable

from jointctl.drivers.canopen.cia402 import ControlWord, State, state_of_word
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.errors import DeviceError
from jointctl.firmware_py.states import in_words

ATTEMPTS = 3
SETTLE_S = 0.1  # for the fault to come back if its cause is still there


def reset_fault(objects: ObjectAccess, pause: Callable[[float], None]) -> str:
    """What was reset, in words; `DeviceError` if the drive remains in fault."""
    code = 0
    for _ in range(ATTEMPTS):
        objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
        pause(SETTLE_S)
        state = state_of_word(objects.read(0x6041, what="statusword"))
        if state not in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            words = in_words(state)
            return f"fault {code:04X}h was reset, the drive is {words}" if code else f"no fault: the drive is {words}"
        code = objects.read_if_present(0x603F, what="error code") or code
        objects.write(0x6040, 0, ControlWord.FAULT_RESET, what="controlword")
        pause(SETTLE_S)
    state = state_of_word(objects.read(0x6041, what="statusword"))
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        raise DeviceError(
            f"the drive stays in fault (error code {code:04X}h) after {ATTEMPTS} resets",
            "its cause is still there: supply, temperature, encoder, heartbeat; see the drive's manual for the code",
        )
    return f"fault {code:04X}h was reset, the drive is {in_words(state)}"
