"""What the standards number: the CiA 402 power state machine as an IntEnum and pure functions, and what CiA 301 fixes.

States are recognised by mask and value, never by equality of the whole statusword.  The controlword for a request is
a function of the present state alone, so that a lost frame is simply sent again.  A fault is never reset here and a
quick stop is never left towards Operation Enabled: enabling again is a new run.

Plain Python: `jointctl stop` must not wait for numba.  `cyclic` compiles what the loop needs.  The virtual drive states
all of these numbers by itself.
"""

from __future__ import annotations

from enum import IntEnum

from jointctl.firmware_py.states import DriveRequest, DriveState, in_words


class State(IntEnum):
    """Power states of CiA 402 part 2."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7
    UNDEFINED = 8


class ControlWord(IntEnum):
    """Commands of object 6040h."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class Mode(IntEnum):
    """Modes of operation, objects 6060h and 6061h."""

    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    TORQUE = 4
    HOMING = 6
    CYCLIC_SYNC_POSITION = 8
    CYCLIC_SYNC_VELOCITY = 9
    CYCLIC_SYNC_TORQUE = 10


MODE_SHOWN = "modes of operation display"  # 6061, in messages

# bit of object 6502h (supported drive modes) for each mode
SUPPORTED_MODE_BIT = {
    Mode.PROFILE_POSITION: 0,
    Mode.PROFILE_VELOCITY: 2,
    Mode.TORQUE: 3,
    Mode.HOMING: 5,
    Mode.CYCLIC_SYNC_POSITION: 7,
    Mode.CYCLIC_SYNC_VELOCITY: 8,
    Mode.CYCLIC_SYNC_TORQUE: 9,
}


def state_of_word(status_word: int) -> State:
    """State of a statusword (6041h); Fault Reaction Active is looked for before Fault."""
    low = status_word & 0x4F
    if low == 0x0F:
        return State.FAULT_REACTION_ACTIVE
    if low == 0x08:
        return State.FAULT
    if low == 0x40:
        return State.SWITCH_ON_DISABLED
    if low == 0x00:
        return State.NOT_READY_TO_SWITCH_ON
    bits = status_word & 0x6F
    if bits == 0x21:
        return State.READY_TO_SWITCH_ON
    if bits == 0x23:
        return State.SWITCHED_ON
    if bits == 0x27:
        return State.OPERATION_ENABLED
    if bits == 0x07:
        return State.QUICK_STOP_ACTIVE
    return State.UNDEFINED


def state_text(status_word: int) -> str:
    """State of a statusword in words, as `operation enabled`."""
    return in_words(state_of_word(status_word))


def drive_state(state: int) -> DriveState:
    """The loop's view of a CiA 402 state."""
    if state == State.OPERATION_ENABLED:
        return DriveState.ENABLED
    if state == State.SWITCH_ON_DISABLED:
        return DriveState.OFF
    if state == State.READY_TO_SWITCH_ON:
        return DriveState.STARTING
    if state == State.SWITCHED_ON:
        return DriveState.PREPARED
    if state == State.QUICK_STOP_ACTIVE:
        return DriveState.STOPPING
    if state == State.FAULT:
        return DriveState.FAULT
    if state == State.FAULT_REACTION_ACTIVE:
        return DriveState.FAULT_BRAKING
    return DriveState.UNKNOWN


def control_word(state: int, request: int) -> ControlWord:
    """The command that leads from `state` towards what the loop wants."""
    if request == DriveRequest.ENABLE or request == DriveRequest.PREPARE:
        if state == State.SWITCH_ON_DISABLED:
            return ControlWord.SHUTDOWN
        if state == State.READY_TO_SWITCH_ON:
            return ControlWord.SWITCH_ON
        if state == State.SWITCHED_ON or state == State.OPERATION_ENABLED:
            return ControlWord.ENABLE_OPERATION if request == DriveRequest.ENABLE else ControlWord.SWITCH_ON
        return ControlWord.DISABLE_VOLTAGE
    if request == DriveRequest.QUICK_STOP and (state == State.OPERATION_ENABLED or state == State.QUICK_STOP_ACTIVE):
        return ControlWord.QUICK_STOP
    return ControlWord.DISABLE_VOLTAGE


# --- CiA 301: identifiers of the predefined connection set (7.3.5), NMT ---
# An NMT command and the state that it leads to are different numbers.

# of all nodes
NMT_ID = 0x000
SYNC_ID = 0x080
# to be added to the node number
EMERGENCY_ID = 0x080
TPDO1_ID, TPDO2_ID = 0x180, 0x280
TPDO_IDS = (TPDO1_ID, TPDO2_ID, 0x380, 0x480)
RPDO1_ID, RPDO2_ID = 0x200, 0x300
RPDO_IDS = (RPDO1_ID, RPDO2_ID, 0x400, 0x500)
SDO_ANSWER_ID, SDO_REQUEST_ID = 0x580, 0x600
HEARTBEAT_ID = 0x700
# of an identifier of 11 bits
FUNCTION_MASK, NODE_MASK = 0x780, 0x07F
HIGHEST_NODE = 127
# transmission types of PDOs (7.5.2.35): up to the first at SYNC, from the second on at an event or on receipt
LAST_SYNCHRONOUS, EVENT_DRIVEN = 240, 254


class NmtCommand(IntEnum):
    """First byte of an NMT message; the second is the node, 0 for all (7.2.8.3.1)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """The byte of a heartbeat without its highest bit (7.2.8.3.2.2)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127
