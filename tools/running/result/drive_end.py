"""How a run leaves the drive: whoever tells the user that it is disabled asks here first."""

from __future__ import annotations

import contextlib

from jointctl.drivers.drive import UNTOUCHED, is_safe
from jointctl.drivers.errors import DeviceError
from jointctl.tools.output import Output

ADVICE = "use the emergency stop"


def _off(state: str) -> bool:
    """Also a drive that this program has not taken over ("": not even opened)."""
    return state in ("", UNTOUCHED) or is_safe(state)


def warn_unless_off(state: str, output: Output) -> None:
    """One line where the power stage may be on."""
    if not _off(state):
        with contextlib.suppress(OSError):  # the terminal may have been closed
            output.warning(f"the drive did not confirm that it is off: {state}; {ADVICE}")


def require_off(state: str) -> None:
    """`DeviceError` with the true state where the power stage may be on."""
    if not _off(state):
        raise DeviceError(f"the drive did not confirm that it is off (={state})", ADVICE)


def words(state: str, *, interrupted: bool = False) -> str:
    """For a run that was not begun: how the drive is; `DeviceError` as above.

    `interrupted`: by the user, which is why the drive was not taken over, if it was not.
    """
    require_off(state)
    if state == UNTOUCHED and interrupted:
        return "the drive was left as it is"
    if state == UNTOUCHED:
        return "the drive was left alone: another controller has it"
    return "the drive is disabled" if state else "no drive was used"
