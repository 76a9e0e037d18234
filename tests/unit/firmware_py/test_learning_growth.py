"""Iterative learning that makes the error grow is switched off; its twin goes on learning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from jointctl.firmware_py.law import (
    GROWN,
    learning_torque_Nm,
    record_correction,
    reset_learning,
    watch_learning,
)
from jointctl.firmware_py.records import LearningConstants, LearningState
from jointctl.firmware_py.schema import new

BINS = 40
CYCLE_s = 1e-3


def learning() -> tuple[Any, Any]:
    """(`LearningConstants`, `LearningState`) of a repetition of 40 cycles."""
    constants, state = new(LearningConstants)[0], new(LearningState)[0]
    constants.gain, constants.blend_s, constants.growth = 0.5, 0.01, 1.05
    constants.half_width, constants.lead_cycles = 1, 1
    reset_learning(state)
    return constants, state


def repeat(constants: Any, state: Any, errors_rad: Sequence[float], *, epoch: int = 0, more: int = 1) -> list[float]:
    """A repetition with each of these errors, of changing sign, and `more` cycles; the torques [Nm]."""
    torques = []
    for cycle in range(BINS * len(errors_rad) + more):
        place = cycle % BINS
        torques.append(learning_torque_Nm(constants, state, epoch, BINS * CYCLE_s, (place + 0.5) * CYCLE_s, CYCLE_s))
        error = errors_rad[min(cycle // BINS, len(errors_rad) - 1)] * (-1.0) ** cycle
        watch_learning(constants, state, error)
        record_correction(constants, state, 10.0)
    return torques


@pytest.mark.parametrize(("growth", "stops"), [(1.05 + 1e-9, True), (1.05 - 1e-9, False)])
def test_an_error_that_grows_in_three_repetitions_switches_learning_off(growth: float, stops: bool) -> None:
    constants, state = learning()
    errors = [1e-3 * growth**i for i in range(GROWN + 1)]
    repeat(constants, state, errors)
    assert bool(state.stopped) is stops
    assert state.error_rad == pytest.approx(errors[-1], rel=1e-12)
    assert state.grown == (GROWN if stops else 0)


def test_two_repetitions_that_grow_do_not_and_a_better_one_begins_anew() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3])
    assert (state.grown, state.stopped) == (GROWN - 1, 0)
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3, 3e-3, 5e-3, 9e-3])
    assert (state.grown, state.stopped) == (2, 0)


def test_the_first_repetition_is_compared_with_nothing() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3])
    assert (state.error_rad, state.grown, state.samples) == (pytest.approx(1e-3), 0, 1)
    constants, state = learning()
    repeat(constants, state, [0.0, 1e-3, 2e-3, 3e-3])  # and nothing has grown from no error at all
    assert (state.grown, state.stopped) == (2, 0)


def test_what_was_learned_fades_out_over_the_blend_time_and_stays_off() -> None:
    constants, state = learning()
    torques = repeat(constants, state, [1e-3, 1e-3, 1e-3, 1e-3])
    assert torques[-1] > 4.9
    before = float(state.torque_Nm)
    state.stopped = 1
    learned = state.learned_Nm[:BINS].copy()
    faded = repeat(constants, state, [1e-3, 1e-3], more=0)
    steps = [a - b for a, b in zip([before, *faded], faded, strict=False)]
    assert faded[0] < before
    assert max(abs(step) for step in steps) < 0.2 * before  # 10 cycles
    assert faded[12:] == [0.0] * (2 * BINS - 12)
    assert state.weight == 0.0
    assert (state.learned_Nm[:BINS] == learned).all()  # nothing is learned any more
    assert state.samples < BINS  # nor watched


def test_a_change_of_trajectory_does_not_switch_it_on_again() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3, 8e-3])
    assert state.stopped == 1
    reset_learning(state)
    torques = repeat(constants, state, [1e-3] * 4, epoch=1)
    assert (state.stopped, torques) == (1, [0.0] * len(torques))


def test_a_change_of_trajectory_begins_the_comparison_anew() -> None:
    constants, state = learning()
    repeat(constants, state, [1e-3, 2e-3, 4e-3])
    repeat(constants, state, [9e-3, 9e-3], epoch=1)
    assert (state.grown, state.stopped, state.error_rad) == (0, 0, pytest.approx(9e-3))


@pytest.mark.parametrize("watched", [True, False])
def test_without_a_limit_it_is_not_watched(watched: bool) -> None:
    constants, state = learning()
    constants.growth = 1.05 if watched else 0.0
    repeat(constants, state, [1e-3, 2e-3, 4e-3, 8e-3])
    assert bool(state.stopped) is watched
    assert bool(state.samples > 0) is watched


def test_what_does_not_repeat_is_not_watched() -> None:
    constants, state = learning()
    learning_torque_Nm(constants, state, 0, 0.0, 0.0, CYCLE_s)
    watch_learning(constants, state, 1.0)
    assert (state.samples, state.squares_rad2) == (0, 0.0)
