"""The limit-cycle monitor: torque or error that swings, a noisy command, learning that is off; with their twins."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import pytest

from jointctl.firmware_py.observers import GROWTH, REST_STEPS, REVERSAL_SWINGS, step_swing
from jointctl.firmware_py.records import LimitConstants, Swing, SwingState
from jointctl.firmware_py.safety import ERROR_SWINGS, GROWING_SWINGS, TORQUE_SWINGS, swing_fault, swing_Hz
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault

SLOWEST = 300


def swung(values: Iterable[float], least: float = 1.0, every: int = 10) -> Any:
    """A `Swing` that has followed these values, one each `every` cycles from cycle 1000 on."""
    swing = new(Swing)[0]
    for i, value in enumerate(values):
        step_swing(swing, value, least, SLOWEST, 1000 + every * i)
    return swing


# --- one quantity ---
@pytest.mark.parametrize(("top", "counts"), [(1.0, 0), (1.0 + 2.0**-40, 1), (4.0, 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_is_a_way_back_by_more_than_the_least(top: float, counts: int, sign: float) -> None:
    """From where it was farthest, on either side; the first one counts from zero."""
    swing = swung([sign * top])
    assert (swing.count, swing.direction) == (counts, sign * counts)
    swing = swung([sign * 5.0, sign * (5.0 - top)])
    assert (swing.count, swing.direction) == (1 + counts, sign * (1 - 2 * counts))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("back", "counts"), [(0.25, 0), (0.5, 1)])
def test_before_the_first_turn_both_sides_are_followed(sign: float, back: float, counts: int) -> None:
    swing = swung([sign * 0.75, -sign * back])
    assert (swing.count, swing.direction) == (counts, -sign * counts)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_amplitude_is_the_way_between_two_turns(sign: float) -> None:
    values = [sign * x for x in (2.0, 3.0, 2.5, -4.0, -4.5, -4.25)]
    swing = swung(values)
    assert (swing.count, swing.amplitude, swing.direction) == (2, 3.0, -sign)  # from 0 to 3
    swing = swung([*values, sign * 1.0])
    assert (swing.count, swing.amplitude, swing.direction) == (3, 7.5, sign)  # from 3 to -4.5
    swing = swung([*values, sign * 1.0, sign * 2.0, -sign])
    assert (swing.count, swing.amplitude) == (4, 6.5)  # from -4.5 to 2


def test_what_goes_on_the_same_way_does_not_count() -> None:
    assert swung([2.0, 4.0, 6.0, 8.0]).count == 1
    assert swung([-2.0, -4.0, -6.0, -8.0]).count == 1
    assert swung([2.0, 1.5, 2.5, 1.75, 2.75]).count == 1  # never back by more than 1


@pytest.mark.parametrize(("every", "count"), [(SLOWEST, 6), (SLOWEST + 1, 1)])
def test_what_is_slow_is_a_motion_and_no_swing(every: int, count: int) -> None:
    swing = swung([3.0, -3.0] * 3, every=every)
    assert swing.count == count
    assert swing.half_cycles == every


def test_the_first_turn_begins_the_count_however_late() -> None:
    """In cycle 1000 the last turn seems to be 1000 cycles ago."""
    swing = swung([3.0])
    assert (swing.count, swing.growing, swing.last_cycle) == (1, 1, 1000)


@pytest.mark.parametrize(("second", "growing"), [(GROWTH, 2), (GROWTH * (1.0 - 1e-12), 1), (0.5, 1), (8.0, 2)])
def test_half_swings_grow_if_each_is_greater_by_the_growth(second: float, growing: int) -> None:
    """From 0 to 4: an amplitude of 4; from 4 on by 4 times `second`."""
    back = 4.0 - 4.0 * second
    swing = swung([4.0, 2.0, back, back + 40.0], least=1.0)
    assert swing.count == 3
    assert swing.amplitude == pytest.approx(4.0 * second)
    assert swing.growing == growing


def test_a_pause_ends_the_growth_too() -> None:
    swing = new(Swing)[0]
    for cycle, value in ((1000, 2.0), (1010, -2.0), (1020, 8.0), (1030 + SLOWEST, -64.0)):
        step_swing(swing, value, 1.0, SLOWEST, cycle)
    assert (swing.count, swing.growing) == (1, 1)


def test_a_value_that_is_no_number_does_not_count() -> None:
    assert swung([math.nan] * 9).count == 0


# --- torque and error ---
def limits() -> Any:
    found = new(LimitConstants)[0]
    found.standstill_radps = 0.02
    found.swing.torque_Nm, found.swing.error_rad, found.swing.slowest_cycles = 60.0, 0.002, SLOWEST
    return found


def run_swing(
    found: Any,
    torque_Nm: Iterable[float] = (),
    error_rad: Iterable[float] = (),
    velocity_radps: Iterable[float] = (),
    state: Any = None,
) -> tuple[Any, list[Fault]]:
    """(`SwingState`, fault in each cycle); what is not given is zero, a value each 10 cycles."""
    state = new(SwingState)[0] if state is None else state
    columns = [list(torque_Nm), list(error_rad), list(velocity_radps)]
    count = max(map(len, columns))
    rows = zip(*[column or [0.0] * count for column in columns], strict=True)
    faults = [Fault(swing_fault(found, state, *row, 1000 + 10 * i)) for i, row in enumerate(rows)]
    return state, faults


@pytest.mark.trips(Fault.LIMIT_CYCLE, "(30.0 + 1e-9, Fault.LIMIT_CYCLE)")
@pytest.mark.stays(Fault.LIMIT_CYCLE, "(30.0, Fault.NONE)")
@pytest.mark.parametrize(("peak_Nm", "fault"), [(30.0, Fault.NONE), (30.0 + 1e-9, Fault.LIMIT_CYCLE)])
def test_torque_that_reverses_between_its_shares(peak_Nm: float, fault: Fault) -> None:
    """The limit is 60 Nm from peak to peak: 30 Nm to either side is just inside."""
    values = [31.0, *[-peak_Nm, peak_Nm] * 4]
    state, faults = run_swing(limits(), [40.0 + value for value in values])  # whatever the constant load
    first = next((i for i, found in enumerate(faults) if found), None)
    if fault is Fault.LIMIT_CYCLE:
        assert faults[:TORQUE_SWINGS] == [Fault.NONE] * (TORQUE_SWINGS - 1) + [Fault.LIMIT_CYCLE]
        assert state.torque.count >= TORQUE_SWINGS
    else:
        assert first is None
        assert fault is Fault.NONE


def test_a_small_joint_is_watched_too() -> None:
    found = limits()
    found.swing.torque_Nm = 0.5
    _, faults = run_swing(found, [0.3 * (-1.0) ** i for i in range(9)])
    assert max(faults) is Fault.LIMIT_CYCLE
    _, faults = run_swing(found, [0.25 * (-1.0) ** i for i in range(9)])
    assert set(faults) == {Fault.NONE}


@pytest.mark.parametrize(("turns", "fault"), [(TORQUE_SWINGS - 1, Fault.NONE), (TORQUE_SWINGS, Fault.LIMIT_CYCLE)])
def test_how_many_reversals_of_the_torque_are_a_limit_cycle(turns: int, fault: Fault) -> None:
    _, faults = run_swing(limits(), [61.0 * (-1.0) ** i for i in range(turns)])
    assert faults[-1] is fault
    assert set(faults[:-1]) == {Fault.NONE}


@pytest.mark.parametrize(("turns", "fault"), [(ERROR_SWINGS - 1, Fault.NONE), (ERROR_SWINGS, Fault.LIMIT_CYCLE)])
@pytest.mark.parametrize("twofold", [1.0, -1.0])
def test_how_many_reversals_of_the_error_are_a_limit_cycle(turns: int, fault: Fault, twofold: float) -> None:
    _, faults = run_swing(limits(), error_rad=[twofold * 0.0021 * (-1.0) ** i for i in range(turns)])
    assert faults[-1] is fault
    assert set(faults[:-1]) == {Fault.NONE}


@pytest.mark.parametrize(("peak_rad", "fault"), [(0.001, Fault.NONE), (0.001 + 1e-9, Fault.LIMIT_CYCLE)])
def test_an_error_that_stays_above_its_share(peak_rad: float, fault: Fault) -> None:
    state, faults = run_swing(limits(), error_rad=[peak_rad * (-1.0) ** i for i in range(40)])
    assert max(faults) is fault
    assert state.faint_error.count > ERROR_SWINGS  # half of it is a swing already, but it does not grow


@pytest.mark.parametrize(
    ("growth", "fault"), [(GROWTH + 1e-6, Fault.LIMIT_CYCLE), (GROWTH - 1e-3, Fault.NONE), (1.0, Fault.NONE)]
)
def test_an_error_whose_oscillation_grows(growth: float, fault: Fault) -> None:
    """Between the faint limit and the one that need not grow: 1.05 to 1.97 mrad from peak to peak."""
    values = [0.00055 * (-growth) ** i for i in range(12)]
    state, faults = run_swing(limits(), error_rad=values)
    assert max(faults) is fault
    assert state.error.count == 0 or fault is Fault.NONE or faults.index(Fault.LIMIT_CYCLE) < 12


def test_how_many_growing_half_swings_are_a_limit_cycle() -> None:
    values = [0.00051 * (-1.06) ** i for i in range(11)]
    state, faults = run_swing(limits(), error_rad=values)
    first = faults.index(Fault.LIMIT_CYCLE)
    assert state.error.count == 0
    assert GROWING_SWINGS - 1 <= first <= GROWING_SWINGS + 1
    state, faults = run_swing(limits(), error_rad=values[:first])
    assert state.faint_error.growing == GROWING_SWINGS - 1
    assert set(faults) == {Fault.NONE}


@pytest.mark.parametrize(("rest_rad", "fault"), [(0.0, 27), (0.0021 / REST_STEPS - 1e-9, 27), (0.0021 / REST_STEPS, 0)])
def test_what_the_reading_does_at_rest_is_no_swing(rest_rad: float, fault: int) -> None:
    state = new(SwingState)[0]
    state.rest_rad = rest_rad
    values = [0.0, *[0.0021 * (i % 2) for i in range(30)]]
    assert max(run_swing(limits(), error_rad=values, state=state)[1]) == fault
    assert state.faint_error.count > 0


@pytest.mark.parametrize("what", ["torque_Nm", "error_rad"])
def test_what_is_not_watched_does_not_trip(what: str) -> None:
    found = limits()
    setattr(found.swing, what, 0.0)
    values = [100.0 * (-1.0) ** i for i in range(30)]
    torque = what == "torque_Nm"
    _, faults = run_swing(found, **{"torque_Nm" if torque else "error_rad": values})
    assert set(faults) == {Fault.NONE}
    _, faults = run_swing(limits(), **{"torque_Nm" if torque else "error_rad": values})
    assert Fault.LIMIT_CYCLE in faults  # the twin: watched


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("speed_radps", "allowed"), [(0.02, False), (0.02 + 1e-9, True)])
def test_a_reversal_of_the_reference_takes_some_off_the_count(sign: float, speed_radps: float, allowed: bool) -> None:
    """The reference turns in each third value: friction may, too."""
    turns = 30
    velocity = [sign * speed_radps * (-1.0) ** (i // REVERSAL_SWINGS) for i in range(turns)]
    state, faults = run_swing(limits(), [61.0 * (-1.0) ** i for i in range(turns)], velocity_radps=velocity)
    assert max(faults) is (Fault.NONE if allowed else Fault.LIMIT_CYCLE)
    assert state.reference_direction == (round(math.copysign(1.0, velocity[-1])) if allowed else 0)
    error = [0.01 * (-1.0) ** i for i in range(turns)]
    assert max(run_swing(limits(), error_rad=error, velocity_radps=velocity)[1]) is max(faults)


def test_a_reversal_takes_three_off_each_count_and_leaves_none_below_zero() -> None:
    state = new(SwingState)[0]
    for swing, count, growing in ((state.torque, 2, 1), (state.error, 4, 3), (state.faint_error, 9, 7)):
        swing.count, swing.growing = count, growing
    assert swing_fault(limits(), state, 0.0, 0.0, 0.5, 1000) == Fault.NONE
    counts = [(s.count, s.growing) for s in (state.torque, state.error, state.faint_error)]
    assert counts == [(0, 0), (1, 0), (6, 4)]
    for velocity in (0.5, 0.0, 0.5):  # it goes on, stands, and goes on the same way
        swing_fault(limits(), state, 0.0, 0.0, velocity, 1010)
    assert (state.faint_error.count, state.reference_direction) == (6, 1)
    swing_fault(limits(), state, 0.0, 0.0, -0.5, 1020)
    assert (state.faint_error.count, state.reference_direction) == (3, -1)


def test_the_frequency_is_that_of_what_has_swung() -> None:
    state = new(SwingState)[0]
    state.torque.half_cycles, state.error.half_cycles, state.faint_error.half_cycles = 10, 20, 40
    assert swing_Hz(state, 1e-3) == 12.5
    state.error.count = ERROR_SWINGS - 1
    assert swing_Hz(state, 1e-3) == 12.5
    state.error.count = ERROR_SWINGS
    assert swing_Hz(state, 1e-3) == 25.0
    state.torque.count = TORQUE_SWINGS - 1
    assert swing_Hz(state, 1e-3) == 25.0
    state.torque.count = TORQUE_SWINGS
    assert swing_Hz(state, 1e-3) == 50.0
    assert swing_Hz(state, 2e-3) == 25.0
