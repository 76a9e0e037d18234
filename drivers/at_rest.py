"""A drive that is under power before anything was sent to it: may it be braked?

A silent line does not prove that no one controls it: a drive may hold a position, or follow a profile, by itself.  So
one that turns is left alone; one at rest is braked only when the user has agreed.
"""

from __future__ import annotations

from collections.abc import Callable

from jointctl.drivers.drive import Approval, Declined
from jointctl.drivers.errors import DeviceError

WATCH_S = 0.5
WATCH_EACH_S = 0.05
REST_COUNTS, REST_rad = 2, 1e-4  # an enabled joint at rest may move by so much, whichever is more
STOP_HINT = "`jointctl stop` brakes it and switches it off"


def refuse_unless_at_rest(
    place: str, read_counts: Callable[[], int], rad_per_count: float, approve: Approval | None, question: str,
    pause: Callable[[float], None], refuse_others: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Returns when the joint is at rest and `approve` has agreed to the question.

    `place` names the drive and its state; `approve` None: it must not be touched.  Raises `DeviceError` for a drive
    that turns or is not to be touched, `Declined` for a no, and what `refuse_others` raises.
    """

    def watch() -> None:
        readings = [read_counts()]
        for _ in range(round(WATCH_S / WATCH_EACH_S)):
            pause(WATCH_EACH_S)
            readings.append(read_counts())
        refuse_others()
        turned = max(readings) - min(readings)
        if turned > max(REST_COUNTS, REST_rad / abs(rad_per_count)):
            text = f"{place} and turns ({turned} counts in {WATCH_S:g} s): {left_alone}"
            raise DeviceError(text, STOP_HINT)

    left_alone = "another controller may have it, and it was left as it is"
    watch()
    if approve is None:
        raise DeviceError(f"{place}: {left_alone}", STOP_HINT)
    if not approve(question):
        raise Declined
    watch()  # the answer may have taken minutes
