"""Does a quantity swing: turns in a row and how they grow, for `safety.check_swing`; readings at rest; torque noise."""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import Swing, SwingConstants, SwingState

GROWTH = 1.05  # from one half swing to the next
REVERSAL_SWINGS = 3  # that friction alone makes of one reversal of the reference: they do not count


@kernel
def _reset_one(swing: Swing) -> None:
    swing.direction = 0
    swing.low = 0.0
    swing.high = 0.0
    swing.amplitude = 0.0
    swing.count = 0
    swing.growing = 0
    swing.last_cycle = 0
    swing.half_cycles = 0


@kernel
def reset_swing(state: SwingState) -> None:
    """Begin a run: nothing swings, nothing is known of the reading at rest."""
    _reset_one(state.torque)
    _reset_one(state.error)
    _reset_one(state.faint_error)
    state.reference_direction = 0
    state.rest_rad = 0.0
    state.rest_position_rad = 0.0
    state.noise_Nm = 0.0
    state.noise_told_Nm = 0.0


@kernel
def step_swing(swing: Swing, value: float, least: float, slowest_cycles: int, cycle: int) -> None:
    """Follow a quantity and count how often in a row it turns, each time by more than `least` from peak to peak.

    It has turned when it has come back by more than `least` from where it was farthest; `amplitude` is the way between
    the two turns before.  Where half a swing takes more than `slowest_cycles`, the count begins anew.
    """
    if swing.direction >= 0:
        swing.high = max(swing.high, value)
    if swing.direction <= 0:
        swing.low = min(swing.low, value)
    fell = swing.direction >= 0 and swing.high - value > least
    rose = swing.direction <= 0 and value - swing.low > least
    if not fell and not rose:
        return
    amplitude = swing.high - swing.low
    swing.half_cycles = cycle - swing.last_cycle
    if swing.half_cycles > slowest_cycles:
        swing.count = 0
        swing.growing = 0
    elif not amplitude >= GROWTH * swing.amplitude:
        swing.growing = 0
    swing.count += 1
    swing.growing += 1
    swing.amplitude = amplitude
    swing.last_cycle = cycle
    if fell:
        swing.direction = -1
        swing.low = value
    else:
        swing.direction = 1
        swing.high = value


@kernel
def allow_reversal(swing: Swing) -> None:
    """The reference has turned: friction does, and the torque with it."""
    swing.count = max(swing.count - REVERSAL_SWINGS, 0)
    swing.growing = max(swing.growing - REVERSAL_SWINGS, 0)


@kernel
def note_rest(state: SwingState, position_rad: float, moving: bool) -> None:
    """A new sample with the power off: by how much the reading of a joint that stands changes."""
    if moving:
        state.rest_rad = 0.0
    else:
        state.rest_rad = max(state.rest_rad, abs(position_rad - state.rest_position_rad))
    state.rest_position_rad = position_rad


@kernel
def torque_noise(constants: SwingConstants, state: SwingState, change_Nm: float) -> bool:
    """Take the change of the command in this cycle; whether their mean is more than is worth a warning."""
    state.noise_Nm += constants.noise_gain * (abs(change_Nm) - state.noise_Nm)
    return 0.0 < constants.noise_Nm < state.noise_Nm
