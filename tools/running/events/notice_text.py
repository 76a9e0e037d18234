"""What the loop reports without ending the run, in words: torque noise, learning that was switched off."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.states import Notice
from jointctl.tools.recording.run_log import WARNING, Event


def notice_text(notice: Notice, state: Any) -> str:
    """One line, with the numbers of `state`, an `AxisState`, and what to do about it."""
    if notice is Notice.TORQUE_NOISE:
        return (
            f"torque noise: the command changes by {float(state.swing.noise_told_Nm):.1f} Nm from cycle to cycle; "
            "an encoder with more counts, a lower control.velocity_cutoff_Hz or lower gains (kv, observer_radps) "
            "make it quieter"
        )
    return (
        "iterative learning is off for the rest of the run: its error grew in three repetitions, to "
        f"{1e3 * float(state.law.learning.error_rad):.3f} mrad (root mean square); lower control.learning.gain and "
        "error_gain_ps2, or the loop delay"
    )


class NoticeFinder:
    """Gives each notice of a run once."""

    def __init__(self) -> None:
        self._known = 0

    def take(self, state: Any, time_ns: int) -> list[Event]:
        """Events for what is new in `state`, an `AxisState` that the loop goes on writing to."""
        notices = int(state.notices)
        new = [notice for notice in Notice if notices & ~self._known & notice]
        self._known |= notices
        return [Event(time_ns, WARNING, "loop", notice_text(notice, state)) for notice in new]
