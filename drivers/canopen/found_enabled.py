"""A CANopen drive that is under power before anything was sent to it: braked only at rest, and when the user agrees."""

from __future__ import annotations

from collections.abc import Callable

from jointctl.drivers.at_rest import STOP_HINT, refuse_unless_at_rest
from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.canopen.switch_off import POWERED_STATES, brake, state_of
from jointctl.drivers.drive import Approval
from jointctl.drivers.errors import BusError
from jointctl.firmware_py.states import in_words

QUESTION = "The drive is enabled, at rest, and no one else is on the bus. Brake it and switch it off?"


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
