"""Grid, order and motion of a sweep: always inside travel and limits, windows only at constant speed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import peak_of, reference_at
from jointctl.tools.sweeping.grid import (
    SweepPoint,
    both_directions,
    grid_speeds,
    listed_velocities,
    ordered_points,
    plan_hash,
)
from jointctl.tools.sweeping.plan import PlanSettings, SweepMotion, fastest_radps, plan_motion, shifted, stroke_of

RATIO = 121.0


def plan_settings(**changes: Any) -> PlanSettings:
    values = {"width_rad": 6.2, "acceleration_radps2": 4.0, "transit_radps": 1.7, "dwell_s": 1.0, "settle_s": 0.3,
              "reduction_ratio": RATIO}  # fmt: skip
    return PlanSettings(**{**values, **changes})


def constants_of(motion: SweepMotion) -> Any:
    constants = new(TrajectoryConstants)
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(motion.table)
    return constants[0]


def reference(motion: SweepMotion, time_s: float) -> Any:
    found = new(Reference)[0]
    reference_at(constants_of(motion), motion.table, 0, time_s, found)
    return found


def points_of(speeds: list[float], passes: int = 1) -> list[SweepPoint]:
    return ordered_points(both_directions(speeds, 2 * len(speeds)), passes, None)


@settings(max_examples=60, deadline=None)
@given(
    width=st.floats(0.2, 50.0),
    acceleration=st.floats(0.5, 20.0),
    dwell=st.floats(0.1, 5.0),
    settle=st.floats(0.0, 0.5),
    shares=st.lists(st.floats(0.001, 1.0), min_size=1, max_size=4, unique=True),
    warm_up=st.floats(0.0, 1.0),
)
def test_any_plan_stays_inside_travel_speed_and_acceleration(
    width: float, acceleration: float, dwell: float, settle: float, shares: list[float], warm_up: float
) -> None:
    s = plan_settings(width_rad=width, acceleration_radps2=acceleration, dwell_s=dwell, settle_s=settle)
    fastest = min(fastest_radps(s), 10.0)
    speeds = sorted(share * fastest for share in shares)
    motion = plan_motion(points_of(speeds), s, warm_up)
    peak = peak_of(constants_of(motion), motion.table)
    assert peak.position_max_rad - peak.position_min_rad <= width * (1.0 + 1e-9)
    assert peak.velocity_radps <= max(speeds[-1], s.transit_radps) * (1.0 + 1e-9)
    assert peak.acceleration_radps2 <= acceleration * (1.0 + 1e-9)
    assert peak.position_min_rad == pytest.approx(motion.low_rad, abs=1e-9)
    assert peak.position_max_rad == pytest.approx(motion.high_rad, abs=1e-9)
    for window in motion.windows:
        for share in (0.001, 0.5, 0.999):
            at = reference(motion, window.start_s + share * (window.end_s - window.start_s))
            assert at.acceleration_radps2 == 0.0
            assert at.velocity_radps == pytest.approx(window.point.velocity_radps, rel=1e-9)
    visited = {(w.point.velocity_radps) for w in motion.windows}
    assert visited == {signed for speed in speeds for signed in (speed, -speed)}


def test_the_table_is_continuous_in_position_and_velocity_and_starts_and_ends_at_rest() -> None:
    motion = plan_motion(points_of([0.004, 0.05, 0.5, 3.4]), plan_settings(), 0.5)
    steps = np.diff(motion.table[:, 0])
    c0, c1, c2, c3 = motion.table[:-1, 1:].T
    ends = c0 + steps * (c1 + steps * (c2 + steps * c3))
    speeds = c1 + steps * (2.0 * c2 + 3.0 * c3 * steps)
    assert np.all(steps > 0.0)
    assert np.max(np.abs(ends - motion.table[1:, 1])) < 1e-9
    assert np.max(np.abs(speeds - motion.table[1:, 2])) < 1e-9
    assert motion.table[0, 2] == 0.0
    assert motion.table[-1, 2] == 0.0


def test_windows_begin_after_the_settling_time_at_constant_speed() -> None:
    s = plan_settings()
    motion = plan_motion(points_of([0.004, 0.5, 3.0]), s)
    for window in motion.windows:
        before = reference(motion, window.start_s - 0.99 * s.settle_s)
        assert before.acceleration_radps2 == 0.0
        assert before.velocity_radps == pytest.approx(window.point.velocity_radps)


def test_exactly_one_window_completes_each_point() -> None:
    points = points_of([0.004, 0.5, 3.4], passes=2)
    motion = plan_motion(points, plan_settings())
    assert [w.point.index for w in motion.windows if w.last] == [p.index for p in points]
    for point in points:
        own = [w for w in motion.windows if w.point == point]
        assert own[-1].last


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.0, 2.0, 3.0, 3.4])
def test_a_window_covers_whole_ripple_periods_of_the_joint(speed: float) -> None:
    s = plan_settings()
    stroke = stroke_of(speed, s)
    periods = stroke.window_rad / s.joint_period_rad
    assert stroke.teeth == 1
    assert periods == pytest.approx(round(periods))
    assert stroke.measured_s >= 0.6 * s.dwell_s


@pytest.mark.parametrize("speed", [0.0035, 0.01, 0.05])
def test_slow_speeds_are_spread_evenly_over_one_ripple_period(speed: float) -> None:
    s = plan_settings()
    stroke = stroke_of(speed, s)
    assert stroke.teeth * stroke.pitch_rad == pytest.approx(s.joint_period_rad)
    assert stroke.window_rad / s.motor_period_rad == pytest.approx(round(stroke.window_rad / s.motor_period_rad))
    motion = plan_motion(points_of([speed]), s)
    starts = [reference(motion, w.start_s).position_rad for w in motion.windows if w.point.direction > 0]
    assert np.diff(starts) == pytest.approx(s.joint_period_rad / stroke.teeth)


def test_fast_speeds_are_repeated_where_the_travel_is_short() -> None:
    s = plan_settings(dwell_s=2.0)
    assert stroke_of(3.4, s).strokes > 1
    assert stroke_of(3.4, plan_settings(dwell_s=2.0, width_rad=60.0)).strokes == 1


def test_the_fastest_speed_just_fits_and_a_little_more_is_refused() -> None:
    s = plan_settings()
    fastest = fastest_radps(s)
    assert stroke_of(fastest * (1.0 - 1e-6), s).length_rad <= s.width_rad
    narrow = plan_settings(width_rad=0.3)  # not even one ripple period of the joint
    assert stroke_of(fastest_radps(narrow) * (1.0 - 1e-6), narrow).length_rad <= narrow.width_rad
    with pytest.raises(UsageError, match=r"speed \(=20 rad/s\) must be at most"):
        stroke_of(20.0, s)
    with pytest.raises(UsageError, match=r"the travel \(=0.0200 rad\) must be more than"):
        fastest_radps(plan_settings(width_rad=0.02))


def test_shifted_moves_the_motion_and_nothing_else() -> None:
    motion = plan_motion(points_of([0.5]), plan_settings())
    moved = shifted(motion, 2.0)
    assert moved.low_rad == pytest.approx(motion.low_rad + 2.0)
    assert np.array_equal(moved.table[:, 2:], motion.table[:, 2:])
    assert reference(moved, 1.0).position_rad == pytest.approx(reference(motion, 1.0).position_rad + 2.0)


def test_the_default_number_of_points_is_kept_to_the_letter() -> None:
    velocities = both_directions(grid_speeds("near-zero", 113, 0.0035, 3.5), 225)
    assert len(velocities) == 225
    assert sum(v > 0.0 for v in velocities) == 113
    assert {v for v in velocities if v > 0.0} - {-v for v in velocities if v < 0.0} == {0.0035}


@pytest.mark.parametrize("grid", ["near-zero", "linear", "log"])
def test_grids_ascend_from_slowest_to_fastest(grid: str) -> None:
    speeds = grid_speeds(grid, 40, 0.004, 3.2)
    assert len(speeds) == 40
    assert np.all(np.diff(speeds) > 0.0)
    assert speeds[-1] == pytest.approx(3.2)
    assert speeds[0] == pytest.approx(0.08 if grid == "linear" else 0.004)


def test_near_zero_is_denser_near_zero_and_linear_is_even() -> None:
    near = np.diff(grid_speeds("near-zero", 50, 0.004, 3.2))
    assert np.all(np.diff(near) > 0.0)
    assert np.ptp(np.diff(grid_speeds("linear", 50, 0.004, 3.2))) < 1e-12
    with pytest.raises(UsageError, match=r"--grid \(=square\) must be one of near-zero, linear, log, list"):
        grid_speeds("square", 3, 0.1, 1.0)


def test_shuffling_keeps_the_points_and_the_pairs_and_repeats_with_its_seed() -> None:
    velocities = both_directions([0.1, 0.2, 0.3, 0.4, 0.5], 10)
    plain, mixed = ordered_points(velocities, 2, None), ordered_points(velocities, 2, 7)
    assert sorted(p.velocity_radps for p in plain) == sorted(p.velocity_radps for p in mixed)
    assert [p.index for p in mixed] == list(range(20))
    assert [abs(p.velocity_radps) for p in mixed[::2]] == [abs(p.velocity_radps) for p in mixed[1::2]]
    assert mixed == ordered_points(velocities, 2, 7)
    assert mixed != ordered_points(velocities, 2, 8)
    assert [p.velocity_radps for p in mixed[:10]] != [p.velocity_radps for p in mixed[10:]]
    assert [p.pass_number for p in plain] == [0] * 10 + [1] * 10


def test_the_hash_tells_plans_apart() -> None:
    points = points_of([0.1, 0.2])
    assert plan_hash(points, {"dwell_s": 1.0}) == plan_hash(points_of([0.1, 0.2]), {"dwell_s": 1.0})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points, {"dwell_s": 1.1})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points[:3], {"dwell_s": 1.0})
    assert plan_hash(points, {"dwell_s": 1.0}) != plan_hash(points_of([0.2, 0.1]), {"dwell_s": 1.0})


def test_a_list_of_velocities(tmp_path: Path) -> None:
    file = tmp_path / "speeds.txt"
    file.write_text("velocity_radps\n0.1  # slow\n\n-0.1\n2\n")
    assert listed_velocities(file) == [0.1, -0.1, 2.0]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"0.1\nfast\n", r"line 2 \(=fast\) must be a velocity"),
        (b"0.1\n0\n", r"line 2 \(=0\) must be a velocity"),
        (b"nan\n", r"line 1 \(=nan\) must be a velocity"),
        (b"0.1\n0.2\n0.10\n", r"line 3 \(=0.10\) is a velocity that the list already has"),
        (b"# nothing\n", "holds no velocities"),
        (b"\xff\xfe1", "byte 0 is not UTF-8"),
    ],
)
def test_a_bad_list_is_one_line(tmp_path: Path, content: bytes, text: str) -> None:
    file = tmp_path / "speeds.txt"
    file.write_bytes(content)
    with pytest.raises(DataError, match=text) as error:
        listed_velocities(file)
    assert "\n" not in error.value.message
    with pytest.raises(DataError, match="cannot be read"):
        listed_velocities(tmp_path / "none.txt")


def test_warm_up_travels_the_turns_asked_for() -> None:
    s = plan_settings()
    points = points_of([3.0])
    cold, warm = plan_motion(points, s), plan_motion(points, s, 2.0)
    assert warm.high_rad - warm.low_rad <= s.width_rad
    way = math.tau * 2.0
    assert warm.duration_s - cold.duration_s >= way / s.transit_radps
    assert warm.windows[0].start_s - cold.windows[0].start_s == pytest.approx(
        warm.duration_s - cold.duration_s, rel=0.3
    )
