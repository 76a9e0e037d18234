"""Iterative learning for trajectories that repeat: the torque that feedback had to add is fed forward next time.

The period is divided into as many bins as it has cycles (at most LEARNING_BINS).  In each bin

    u_next = smooth(u + gain (correction, `lead_cycles` later))

where `correction` is what feedback and observer added in this period, plus a term in the error itself: without it an
error that decays at kp / kv would go unnoticed, because its parts cancel in the feedback.  The lead makes up for the
delay from command to measured effect.  The smoothing over neighbouring bins has no phase shift: that stretch is over.
What was learned belongs to the positions of one trajectory: a change of trajectory starts anew.

A loop that learning makes worse gets worse by and by: where the error grows in GROWN repetitions in a row, learning
fades out over `blend_s` and stays off for the rest of the run.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import LEARNING_BINS, LearningConstants, LearningState

GROWN = 3  # repetitions in a row with a greater error than before end the learning


@kernel
def reset_learning(state: LearningState) -> None:
    """Forget what was learned; the next call begins a new epoch.  What was switched off stays off."""
    state.epoch = -1
    state.bins = 0
    state.torque_Nm = 0.0


@kernel
def _begin_epoch(state: LearningState, epoch: int, bins: int) -> None:
    state.epoch = epoch
    state.bins = bins
    state.filled = 0
    state.last_bin = -1
    state.weight = 0.0
    state.squares_rad2 = 0.0
    state.samples = 0
    state.error_rad = 0.0
    state.grown = 0


@kernel
def learning_torque_Nm(
    constants: LearningConstants, state: LearningState, epoch: int, period_s: float, local_s: float, cycle_s: float
) -> float:
    """Feed-forward torque [Nm] at the present place in the period; 0 until one whole period has been learned.

    `epoch` changes with the trajectory; `period_s` 0 means that it does not repeat; `local_s` in [0, period_s) is the
    time in the period; `cycle_s` the loop's.  What has been learned comes in over `blend_s`.
    """
    if constants.gain <= 0.0 or period_s <= 0.0:
        state.torque_Nm = 0.0
        state.bins = 0
        return 0.0
    if epoch != state.epoch:
        _begin_epoch(state, epoch, int(min(period_s / cycle_s + 0.5, float(LEARNING_BINS))))
    state.present_bin = min(int(local_s / period_s * state.bins), state.bins - 1)
    if state.stopped != 0:
        state.weight = max(0.0, state.weight - cycle_s / constants.blend_s)
    elif state.filled > state.bins + 2 * constants.half_width + constants.lead_cycles:
        state.weight = min(1.0, state.weight + cycle_s / constants.blend_s)
    state.torque_Nm = state.weight * state.learned_Nm[state.present_bin]
    return state.torque_Nm


@kernel
def watch_learning(constants: LearningConstants, state: LearningState, error_rad: float) -> None:
    """Compare the error of each repetition with that of the one before; call it after `learning_torque_Nm`."""
    if constants.growth <= 0.0 or state.bins == 0 or state.stopped != 0:
        return
    if state.present_bin < state.last_bin:  # a repetition is over
        mean_rad = math.sqrt(state.squares_rad2 / state.samples)
        grows = state.error_rad > 0.0 and state.error_rad * constants.growth < mean_rad
        state.grown = state.grown + 1 if grows else 0
        state.error_rad = mean_rad
        state.squares_rad2 = 0.0
        state.samples = 0
        if state.grown >= GROWN:
            state.stopped = 1
    state.squares_rad2 += error_rad * error_rad
    state.samples += 1


@kernel
def _smooth(state: LearningState, index: int, half_width: int) -> None:
    """Mean of the recorded torque over bins index - half_width .. index + half_width, around the period."""
    total = 0.0
    for offset in range(-half_width, half_width + 1):
        total += state.recorded_Nm[(index + offset + state.bins) % state.bins]
    state.learned_Nm[index] = total / (2 * half_width + 1)


@kernel
def record_correction(constants: LearningConstants, state: LearningState, correction_Nm: float) -> None:
    """Note what feedback and observer added in this cycle; call it after `learning_torque_Nm`."""
    bins = state.bins
    half_width = constants.half_width
    if state.stopped != 0 or bins <= 2 * half_width + constants.lead_cycles + 2:
        return
    index = state.present_bin if state.last_bin < 0 else (state.last_bin + 1) % bins
    state.last_bin = state.present_bin
    # usually one bin; after an overrun the ones in between as well, as far as the smoothing reaches
    for _ in range(half_width + 1):
        target = (index - constants.lead_cycles + bins) % bins
        state.recorded_Nm[target] = state.weight * state.learned_Nm[target] + constants.gain * correction_Nm
        state.filled += 1
        if state.filled > 2 * half_width:
            _smooth(state, (target - half_width + bins) % bins, half_width)
        if index == state.present_bin:
            break
        index = (index + 1) % bins
