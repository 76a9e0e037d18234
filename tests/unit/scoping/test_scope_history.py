"""The scope's memory: a ring, the picture of a stretch, peaks, gaps, trigger, deadlines."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.recording.run_log import INFO, Event
from jointctl.tools.scoping.history import EVENTS, POINTS, SIGNALS, History, crossing_s, percentiles_us
from tests.unit.scoping.scope_records import records


def test_the_memory_is_a_ring() -> None:
    history = History(1000)
    assert len(history.newest(1.0)) == 0
    for first in range(0, 10_000, 30):
        history.take(records(30, first))
    history.take(records(2500, 10_020))
    kept = history.newest(1e9)
    np.testing.assert_array_equal(kept.cycle, np.arange(11_520, 12_520))
    for number in range(3 * EVENTS):
        history.events.append(Event(number, INFO, "a", "b"))
    assert len(history.events) == EVENTS
    assert history.events[-1].time_ns == 3 * EVENTS - 1


@pytest.mark.parametrize(("span_s", "before_s", "first", "last"), [(0.1, None, 900, 999), (0.1, 0.5, 401, 500)])
def test_the_picture_is_the_last_stretch_or_the_held_one(
    span_s: float, before_s: float | None, first: int, last: int
) -> None:
    history = History()
    history.take(records(1000))
    rows = history.newest(span_s, before_s)
    assert abs(int(rows.cycle[0]) - first) <= 1
    assert int(rows.cycle[-1]) == last


def test_a_series_keeps_its_peaks_and_leaves_out_what_is_no_number() -> None:
    history, rows = History(), records(20_000)
    rows.error_rad[7777] = 0.5
    rows.error_rad[100] = np.nan
    history.take(rows)
    points = np.array(history.series(history.newest(1e9), "error [mrad]"))
    assert len(points) <= POINTS + 2
    assert points[:, 1].max() == 500.0
    assert points[np.argmax(points[:, 1]), 0] == pytest.approx(7.777)
    assert np.all(np.isfinite(points))
    assert np.all(np.diff(points[:, 0]) > 0)
    for signal in SIGNALS:
        assert history.series(history.newest(0.1), signal)


@pytest.mark.parametrize(("missing", "gap"), [(99, False), (100, True)])
def test_records_that_did_not_come_are_a_gap_in_the_line(missing: int, gap: bool) -> None:
    history = History()
    history.take(records(200))
    history.take(records(200, 200 + missing))
    found = history.series(history.newest(1e9), "angle [rad]")
    empty = [i for i, (_, value) in enumerate(found) if value is None]
    assert len(empty) == gap
    if gap:
        assert found[empty[0]][0] == pytest.approx(0.199)
        assert found[empty[0] + 1][0] == pytest.approx(0.3)
    times = [time_s for time_s, _ in found if time_s is not None]
    assert times == sorted(times)


def test_the_error_is_only_drawn_while_the_law_is_at_work() -> None:
    history, rows = History(), records(300)
    rows.phase[:100], rows.phase[200:] = AxisPhase.WAITING, AxisPhase.DISABLING
    history.take(rows)
    found = history.newest(1e9)
    assert len(history.series(found, "error [mrad]")) == 100
    assert len(history.series(found, "angle [rad]")) == 300


def test_the_trigger_is_the_last_crossing_in_its_direction() -> None:
    time_s = np.arange(6) * 1.0
    values = np.array([0.0, 2.0, 0.0, 2.0, 2.0, 0.0])
    assert crossing_s(time_s, values, 1.0, rising=True) == 3.0
    assert crossing_s(time_s, values, 1.0, rising=False) == 5.0
    assert crossing_s(time_s, values, 2.0, rising=True) is None
    assert crossing_s(time_s[:1], values[:1], 1.0, rising=True) is None


def test_deadline_statistics_leave_out_cycles_without_a_sample() -> None:
    rows = records(100)
    rows.wake_late_ns, rows.work_ns = 20_000, 10_000
    rows.round_trip_ns[:50] = 90_000
    assert percentiles_us(rows) == {
        "wake-up late": "20 / 20 / 20 us", "round trip": "90 / 90 / 90 us", "work": "10 / 10 / 10 us",
    }  # fmt: skip
    rows.round_trip_ns = 0
    assert "round trip" not in percentiles_us(rows)
