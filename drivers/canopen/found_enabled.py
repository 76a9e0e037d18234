"""A drive that is under power before anything was sent to it: whose is it, and may it be braked?

A silent bus does not prove that no one controls it: a drive may hold a position, or follow a profile, by itself.  So
one that turns is left alone; one at rest is braked only when the user has agreed.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.canopen.cia402 import State
from drivers.canopen.object_access import ObjectAccess
from drivers.canopen.switch_off import POWERED_STATES, brake, state_of
from drivers.drive import Approval, Declined
from drivers.errors import BusError, DeviceError
from firmware_py.states import in_words

WATCH_S = 0.5
WATCH_EACH_S = 0.05
REST_COUNTS, REST_rad = 2, 1e-4  # an enabled joint at rest may move by so much, whichever is more
STOP_HINT = "`jointctl stop` brakes it and switches it off"
QUESTION = "The drive is enabled, at rest, and no one else is on the bus. Brake it and switch it off?"


def turned_counts(objects: ObjectAccess, pause: Callable[[float], None]) -> int:
    """How far the position (6064) moves within WATCH_S, between its highest and its lowest reading."""
    readings = [objects.read(0x6064, what="position actual value")]
    for _ in range(round(WATCH_S / WATCH_EACH_S)):
        pause(WATCH_EACH_S)
        readings.append(objects.read(0x6064, what="position actual value"))
    return max(readings) - min(readings)


def brake_if_enabled(
    objects: ObjectAccess, node: int, rad_per_count: float, approve: Approval | None,
    pause: Callable[[float], None], refuse_others: Callable[[], None],
) -> str:  # fmt: skip
    """The quick stop of a drive that is enabled and at rest, once `approve` has agreed; a remark, "" where it is off.

    `approve` None: it must not be touched.  Raises `DeviceError` for a drive that turns or is not to be touched,
    `Declined` for a no, and what `refuse_others` raises.  Only SDO is used: NMT could end its motion without braking.
    """
    state = state_of(objects)
    if state not in POWERED_STATES:
        return ""

    def refuse_unless_at_rest() -> None:
        turned = turned_counts(objects, pause)
        refuse_others()
        if turned > max(REST_COUNTS, REST_rad / abs(rad_per_count)):
            raise DeviceError(
                f"node {node} is {in_words(state)} and turns ({turned} counts in {WATCH_S:g} s): another controller "
                "may have it; it was left as it is",
                STOP_HINT,
            )

    refuse_unless_at_rest()
    if approve is None:
        raise DeviceError(
            f"node {node} is {in_words(state)}: another controller may have it; it was left as it is", STOP_HINT
        )
    if not approve(QUESTION):
        raise Declined
    refuse_unless_at_rest()  # the answer may have taken minutes
    brake(objects, pause)
    if (state := state_of(objects)) is State.OPERATION_ENABLED:
        raise BusError(f"node {node} was enabled again after its quick stop: another controller has it", STOP_HINT)
    return "the drive was enabled, at rest: it has been braked by its quick stop and switched off"
