"""Taking the power from a CiA 402 drive over SDO, and resetting its fault: the driver after a run, `jointctl stop`.

`stop_node` needs neither a configuration that holds nor an EDS: the few objects have the types that CiA 301 and 402
give them.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import can
import canopen
from canopen.objectdictionary import ODVariable

from jointctl.drivers.canopen.cia import ControlWord, NmtCommand, State, state_of_word
from jointctl.drivers.canopen.eds import standard_type
from jointctl.drivers.canopen.network import new_network, send_nmt
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.drive import STOP_HINT, Approval, refuse_unless_at_rest
from jointctl.drivers.errors import BusError, DeviceError, JointctlError
from jointctl.firmware_py.states import in_words

SDO_TIMEOUT_S = 0.3
QUICK_STOP_S = 1.0  # how long a moving joint may brake before its power is taken
OFF_S = 1.0  # how long a drive may take to be off; some run through a brake delay of their own first
POLL_S = 0.02
RESET_ATTEMPTS = 3
SETTLE_S = 0.1  # for the fault to come back if its cause is still there
QUESTION = "The drive is enabled, at rest, and no one else is on the bus. Brake it and switch it off?"
OFF_STATES = (State.SWITCH_ON_DISABLED, State.FAULT)
POWERED_STATES = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
_OBJECTS = (0x6040, 0x6041, 0x6071, 0x60FF)


def state_of(objects: ObjectAccess) -> State:
    """By the statusword."""
    return state_of_word(objects.read(0x6041, what="statusword"))


def brake(objects: ObjectAccess, sleep: Callable[[float], None], longest_s: float = QUICK_STOP_S) -> None:
    """If the drive is powered, its quick stop, until it is off or QUICK_STOP_S is over, `longest_s` if it brakes."""
    for attempt in range(round(max(longest_s, QUICK_STOP_S) / POLL_S)):
        state = state_of(objects)
        obeys = state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
        if not obeys and (state is not State.OPERATION_ENABLED or attempt >= round(QUICK_STOP_S / POLL_S)):
            return
        if attempt == 0 and state is State.OPERATION_ENABLED:
            objects.write(0x6040, 0, ControlWord.QUICK_STOP, what="controlword")
        sleep(POLL_S)


class SwitchOff:
    """Takes the power from one drive; `encoder_node` is brought to pre-operational with it.

    It never changes what watches the drive's controller (1016, 1400:5): another program may be about to enable it.
    """

    def __init__(
        self, network: canopen.Network, node: int, objects: ObjectAccess, encoder_node: int | None,
        sleep: Callable[[float], None], braking_s: float = QUICK_STOP_S, off_s: float = OFF_S,
    ) -> None:  # fmt: skip
        """`braking_s`: how long a drive that brakes already may go on, QUICK_STOP_S at least; then its power goes.

        `off_s`: how long it may take until it is off, OFF_S at least.
        """
        self._braking_s, self._off_s = max(braking_s, QUICK_STOP_S), max(off_s, OFF_S)
        self._network, self._node, self._objects, self._encoder_node = network, node, objects, encoder_node
        self._sleep = sleep

    def _send_nmt(self, command: NmtCommand, node: int | None) -> None:
        if node is not None:
            send_nmt(self._network, command, node)

    def make_safe(self, *, brake_first: bool = False) -> str:
        """Pre-operational, quick stop if it is enabled, then controlword 0 until the statusword says disabled.

        NMT stop if SDO does not answer, or if the drive stays enabled.  The controlword is also in an RPDO, so leave
        operational first: two writers would fight over it.  The state in words, "unknown: ..." if there is none.
        `brake_first`: of a drive that is another's, which may take its power when it leaves operational (6007): first
        the quick stop over SDO, for as long as no one enables it again.
        """
        if brake_first:
            with contextlib.suppress(JointctlError, can.CanError):
                self._brake_undisturbed()
        try:
            # once more: the watchdog may have put the node into "stopped" in this very moment, where it answers no SDO
            with contextlib.suppress(JointctlError):
                return self._attempt()
            try:
                return self._attempt()
            except JointctlError as failure:
                reason = str(failure)
        except can.CanError as error:
            return f"unknown: the bus does not take frames any more ({error})"
        try:
            self._send_nmt(NmtCommand.STOP, self._node)
        except can.CanError:
            return f"unknown: {reason}; the bus does not take frames any more"
        return f"unknown: {reason}; NMT stop was sent"

    def _brake_undisturbed(self) -> None:
        """The quick stop, ours or its controller's, in the NMT state that the node has; not longer than it is obeyed.

        That the drive is off goes to the controller with the node's next TPDOs, of which there are none once it has
        left operational: without them the controller's loop would wait for its time-outs.  A drive that was off already
        gets no such time: a loop that is about to enable it would.
        """
        state = state_of(self._objects)
        if state is State.OPERATION_ENABLED:
            self._objects.write(0x6040, 0, ControlWord.QUICK_STOP, what="controlword")
        if state in POWERED_STATES and self._braked() in OFF_STATES:
            self._sleep(POLL_S)

    def _braked(self) -> State:
        """The state after the quick stop, or the one that is left when its time is over."""
        for _ in range(round(self._braking_s / POLL_S)):
            state = state_of(self._objects)
            if state is not State.QUICK_STOP_ACTIVE:
                break
            self._sleep(POLL_S)
        return state

    def _attempt(self) -> str:
        self._send_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, self._encoder_node)
        self._send_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, self._node)
        brake(self._objects, self._sleep, self._braking_s)
        for _ in range(round(self._off_s / POLL_S)):
            self._objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
            state = state_of(self._objects)
            if state in OFF_STATES:
                break
            self._sleep(POLL_S)
        for index, what in ((0x6071, "target torque"), (0x60FF, "target velocity")):
            with contextlib.suppress(DeviceError):  # a drive that has no such target refuses it
                self._objects.write_if_present(index, 0, 0, what=what)
        words = in_words(state)
        if state in POWERED_STATES:
            self._send_nmt(NmtCommand.STOP, self._node)
            return f"{words}, it did not obey; NMT stop was sent"
        return words


def _standard_objects() -> canopen.ObjectDictionary:
    """What `SwitchOff` uses, as the standard has it."""
    new_dictionary: Any = canopen.ObjectDictionary
    dictionary = new_dictionary()

    def variable(index: int, sub: int) -> Any:
        found: Any = ODVariable(f"{index:04X}:{sub}", index, sub)
        found.data_type = standard_type(index, sub)
        return found

    for index in _OBJECTS:
        dictionary.add_object(variable(index, 0))
    return dictionary


def stop_node(
    bus: can.BusABC,
    node: int,
    *,
    encoder_node: int | None = None,
    sdo_timeout_s: float | None = None,
    braking_s: float | None = None,
    off_s: float | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> str:
    """Stop and disable the drive at `node`, another controller's as well; closes `bus`.  See `SwitchOff.make_safe`."""
    network = new_network(bus, sleep)
    network.connect()
    try:
        remote = network.add_node(node, _standard_objects())
        remote.sdo.RESPONSE_TIMEOUT = sdo_timeout_s or SDO_TIMEOUT_S
        objects = ObjectAccess(remote, "CiA 402")
        switch_off = SwitchOff(network, node, objects, encoder_node, sleep, braking_s or 0.0, off_s or 0.0)
        return switch_off.make_safe(brake_first=True)
    finally:
        with contextlib.suppress(Exception):  # what went wrong on it has been reported
            network.disconnect()


def brake_if_enabled(
    objects: ObjectAccess, node: int, rad_per_count: float, approve: Approval | None,
    pause: Callable[[float], None], refuse_others: Callable[[], None],
) -> str:  # fmt: skip
    """The quick stop of a drive that is enabled and at rest, once `approve` has agreed; a remark, "" where it is off.

    Raises as `refuse_unless_at_rest`.  Only SDO is used: NMT could end its motion without braking.
    """
    state = state_of(objects)
    if state not in POWERED_STATES:
        return ""
    refuse_unless_at_rest(
        f"node {node} is {in_words(state)}", lambda: objects.read(0x6064, what="position actual value"),
        rad_per_count, approve, QUESTION, pause, refuse_others,
    )  # fmt: skip
    brake(objects, pause)
    if (state := state_of(objects)) is State.OPERATION_ENABLED:
        raise BusError(f"node {node} was enabled again after its quick stop: another controller has it", STOP_HINT)
    return "the drive was enabled, at rest: it has been braked by its quick stop and switched off"


def reset_fault(objects: ObjectAccess, pause: Callable[[float], None]) -> str:
    """Because the user asked for it: nothing else in jointctl resets a fault.  What was reset, in words.

    The reset is the rising edge of controlword bit 7, so the bit is cleared first.  If the cause is still there the
    fault comes back: a few attempts, then `DeviceError`.  The drive stays disabled throughout.
    """
    code = 0
    for _ in range(RESET_ATTEMPTS):
        objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
        pause(SETTLE_S)
        state = state_of(objects)
        if state not in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            words = in_words(state)
            return f"fault {code:04X}h was reset, the drive is {words}" if code else f"no fault: the drive is {words}"
        code = objects.read_if_present(0x603F, what="error code") or code
        objects.write(0x6040, 0, ControlWord.FAULT_RESET, what="controlword")
        pause(SETTLE_S)
    state = state_of(objects)
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        raise DeviceError(
            f"the drive stays in fault (error code {code:04X}h) after {RESET_ATTEMPTS} resets",
            "its cause is still there: supply, temperature, encoder, heartbeat; see the drive's manual for the code",
        )
    return f"fault {code:04X}h was reset, the drive is {in_words(state)}"
