"""Trajectories and tables: the three quantities belong together, joins and ends are smooth, demands and approach."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import (
    approach_at,
    approach_duration_s,
    approach_peak,
    brake_step,
    ends_meet,
    peak_of,
    plan_approach,
    reference_at,
    trapezoid_times_s,
)
from jointctl.tools.configuration.load import table_from_csv
from tests.python_process import run_python

# Trajectories: the three quantities belong together, joins and ends are as promised, approach and brake are exact.
NO_TABLE = np.zeros((0, 5))
PAPER_SINE = {"amplitude_rad": 0.35, "omega_radps": 0.2 * math.pi}
FREQUENCY_CHANGE = {"switch_s": 82.5, "amplitude2_rad": 0.35, "omega2_radps": 0.125 * math.pi, "shift2_s": 1.5}
AMPLITUDE_CHANGE = {"switch_s": 82.5, "amplitude2_rad": 0.175, "omega2_radps": 0.2 * math.pi, "offset2_rad": 0.175}

quick = settings(max_examples=40)
angle = st.floats(-3.0, 3.0).map(lambda q_rad: round(q_rad, 12))  # far finer than encoders; the square of less may be 0
fraction = st.floats(0.01, 0.99)


def constants(kind, **values):
    c = new(TrajectoryConstants)[0]
    c.kind = kind
    for name, value in values.items():
        c[name] = value
    return c


def at(c, t_s, table=NO_TABLE):
    return tuple(sampled(c, table, [t_s])[0].tolist())


@kernel
def sample(c, table, hint, times, reference, rows):
    for k in range(len(times)):
        hint = reference_at(c, table, hint, times[k], reference)
        rows[k, 0], rows[k, 1] = reference.position_rad, reference.velocity_radps
        rows[k, 2] = reference.acceleration_radps2


def sampled(c, table, times, hint=0):
    """Position, velocity and acceleration at each time, as rows."""
    rows = np.zeros((len(times), 3))
    sample(c, table, hint, np.asarray(times, float), new(Reference)[0], rows)
    return rows


@kernel
def brake_to_rest(reference, brake_radps2, period_s, rows):
    """How many steps it takes; position, velocity and acceleration after each of them."""
    steps = 0
    while reference.velocity_radps != 0.0 and steps < len(rows):
        brake_step(reference, brake_radps2, period_s)
        rows[steps, 0], rows[steps, 1] = reference.position_rad, reference.velocity_radps
        rows[steps, 2] = reference.acceleration_radps2
        steps += 1
    return steps


def assert_consistent(function, t_s, step_s, tolerance):
    """Velocity and acceleration are the derivatives of position and velocity (central differences)."""
    before, now, after = function(t_s - step_s), function(t_s), function(t_s + step_s)
    assert (after[0] - before[0]) / (2.0 * step_s) == pytest.approx(now[1], abs=tolerance)
    assert (after[1] - before[1]) / (2.0 * step_s) == pytest.approx(now[2], abs=tolerance)


def test_hold_rests_at_its_start():
    assert at(constants(TrajectoryKind.HOLD, start_rad=0.3), 5.0) == (0.3, 0.0, 0.0)


def test_the_paper_sine():
    c = constants(TrajectoryKind.SINE, **PAPER_SINE)
    position, velocity, acceleration = at(c, 0.0)
    assert (position, acceleration) == (0.0, 0.0)
    assert velocity == pytest.approx(0.07 * math.pi)
    assert at(c, 2.5) == pytest.approx((0.35, 0.0, -0.35 * (0.2 * math.pi) ** 2), abs=1e-15)


@quick
@given(st.floats(-1.0, 1.0), st.floats(0.1, 10.0), st.floats(-5.0, 5.0), angle, st.floats(0.0, 100.0))
def test_sine_derivatives(amplitude, omega, shift, offset, t_s):
    c = constants(TrajectoryKind.SINE, amplitude_rad=amplitude, omega_radps=omega, shift_s=shift, offset_rad=offset)
    assert_consistent(lambda t: at(c, t), t_s, 1e-4, 1e-4)


@pytest.mark.parametrize(("change", "after_radps2"), [(FREQUENCY_CHANGE, -0.0540), (AMPLITUDE_CHANGE, -0.0691)])
def test_the_papers_changes_keep_position_and_velocity_and_jump_in_acceleration(change, after_radps2):
    c = constants(TrajectoryKind.SINE, **PAPER_SINE, **change)
    before, after = at(c, math.nextafter(82.5, 0.0)), at(c, 82.5)
    assert before[:2] == pytest.approx((0.35, 0.0), abs=1e-12)
    assert after[:2] == pytest.approx((0.35, 0.0), abs=1e-12)
    assert before[2] == pytest.approx(-0.1382, abs=5e-5)
    assert after[2] == pytest.approx(after_radps2, abs=5e-5)


def test_the_papers_changes_are_the_printed_formulas():
    c = constants(TrajectoryKind.SINE, **PAPER_SINE, **FREQUENCY_CHANGE)
    assert at(c, 90.0)[0] == pytest.approx(0.35 * math.sin(0.125 * math.pi * 91.5), abs=1e-12)
    c = constants(TrajectoryKind.SINE, **PAPER_SINE, **AMPLITUDE_CHANGE)
    assert at(c, 90.0)[0] == pytest.approx(0.175 * math.sin(0.2 * math.pi * 90.0) + 0.175, abs=1e-12)
    assert at(c, 80.0)[0] == pytest.approx(0.35 * math.sin(0.2 * math.pi * 80.0), abs=1e-12)


@quick
@given(angle, angle, st.floats(0.5, 10.0), fraction)
def test_min_jerk_derivatives_and_ends(start, target, move_s, part):
    c = constants(TrajectoryKind.MIN_JERK, start_rad=start, target_rad=target, move_s=move_s)
    step_s = 1e-4 * move_s
    assert_consistent(lambda t: at(c, t), part * move_s, step_s, 1e-4 * max(1.0, abs(target - start) / move_s**2))
    for t_s, rest in ((-1.0, start), (0.0, start), (move_s, target), (move_s + 1.0, target)):
        assert at(c, t_s) == (rest, 0.0, 0.0)
    assert at(c, 1e-7 * move_s) == pytest.approx((start, 0.0, 0.0), abs=1e-3)
    assert at(c, move_s * (1.0 - 1e-7)) == pytest.approx((target, 0.0, 0.0), abs=1e-3)
    assert at(c, 0.5 * move_s)[1] == pytest.approx(1.875 * (target - start) / move_s, abs=1e-12)


def test_a_trapezoid_is_triangular_when_short():
    assert trapezoid_times_s(3.0, 1.0, 2.0) == (0.5, 2.5)
    assert trapezoid_times_s(0.5, 1.0, 2.0) == (0.5, 0.0)  # just reaches its speed
    assert trapezoid_times_s(0.125, 1.0, 2.0) == (0.25, 0.0)


@quick
@given(angle, angle, st.floats(0.1, 3.0), st.floats(0.1, 10.0), fraction)
def test_trapezoid_within_its_limits_continuous_and_exact_at_the_end(start, target, speed, acceleration, part):
    c = constants(
        TrajectoryKind.TRAPEZOID,
        start_rad=start,
        target_rad=target,
        speed_radps=speed,
        acceleration_radps2=acceleration,
    )
    ramp_s, cruise_s = trapezoid_times_s(abs(target - start), speed, acceleration)
    move_s = 2.0 * ramp_s + cruise_s
    assert at(c, -1.0) == (start, 0.0, 0.0)
    assert at(c, move_s + 1e-9) == (target, 0.0, 0.0)
    previous = at(c, 0.0)
    step_s = move_s / 100.0
    for k in range(1, 101):
        now = at(c, k * step_s)
        assert abs(now[1]) <= speed * (1.0 + 1e-12)
        assert abs(now[2]) in (0.0, acceleration)
        assert abs(now[1] - previous[1]) <= acceleration * step_s * (1.0 + 1e-6) + 1e-12
        assert abs(now[0] - previous[0] - 0.5 * (now[1] + previous[1]) * step_s) <= acceleration * step_s**2
        previous = now
    assert previous[:2] == pytest.approx((target, 0.0), abs=1e-6)
    t_s = part * move_s
    if move_s > 0.0 and min(abs(t_s - ramp_s), abs(t_s - ramp_s - cruise_s), t_s, move_s - t_s) > 2e-4 * move_s:
        assert_consistent(lambda t: at(c, t), t_s, 1e-4 * move_s, 1e-6 * (speed + acceleration))


@quick
@given(angle, angle, st.floats(0.1, 3.0), st.floats(0.1, 10.0), st.floats(0.01, 2.0))
def test_a_rounded_trapezoid_is_the_mean_of_the_sharp_one(start, target, speed, acceleration, rounding_s):
    """Within the same limits, later at the target by the rounding, with a jerk of twice the acceleration at most."""
    numbers = {"start_rad": start, "target_rad": target, "speed_radps": speed, "acceleration_radps2": acceleration}
    sharp = constants(TrajectoryKind.TRAPEZOID, **numbers)
    round_ = constants(TrajectoryKind.TRAPEZOID, rounding_s=rounding_s, **numbers)
    ramp_s, cruise_s = trapezoid_times_s(abs(target - start), speed, acceleration)
    whole_s = 2.0 * ramp_s + cruise_s + rounding_s
    assert at(round_, whole_s + 1e-9) == (target, 0.0, 0.0)
    assert at(round_, whole_s - 1e-9) == pytest.approx((target, 0.0, 0.0), abs=1e-6)
    shares = np.linspace(0.0, 1.0, 101)
    for t_s in shares[1:] * whole_s:
        window = sampled(sharp, NO_TABLE, t_s - rounding_s + rounding_s * shares)
        now = at(round_, t_s)
        within = acceleration * rounding_s / len(shares)  # what the sum leaves of each of the three
        assert now[0] == pytest.approx(np.trapezoid(window[:, 0], shares), abs=within * rounding_s + 1e-9)
        assert now[1] == pytest.approx(np.trapezoid(window[:, 1], shares), abs=within + 1e-9)
        assert abs(now[1]) <= speed * (1.0 + 1e-9)
        assert abs(now[2]) <= acceleration * (1.0 + 1e-9)
        before = at(round_, t_s - 0.01 * rounding_s)
        assert abs(now[2] - before[2]) <= 0.02 * acceleration + 1e-9


@pytest.mark.parametrize("kind", [TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID])
def test_repeated_moves_go_back_and_forth_with_a_rest_at_each_end(kind):
    c = constants(
        kind,
        repeats=1,
        start_rad=1.0,
        target_rad=2.0,
        move_s=2.0,
        speed_radps=1.0,
        acceleration_radps2=1.0,
        dwell_s=0.5,
    )  # both kinds take 2 s a move
    for turn in (0.0, 5.0, 50.0):
        assert at(c, turn + 1.0)[:2] == pytest.approx((1.5, 0.9375 if kind == TrajectoryKind.MIN_JERK else 1.0))
        assert at(c, turn + 2.25) == (2.0, 0.0, 0.0)
        assert at(c, turn + 3.5)[0] == pytest.approx(1.5)
        assert at(c, turn + 3.5)[1] < 0.0
        assert at(c, turn + 4.75) == (1.0, 0.0, 0.0)
    for join in (2.0, 2.5, 4.5, 5.0):
        assert at(c, join - 1e-9)[:2] == pytest.approx(at(c, join + 1e-9)[:2], abs=1e-8)


@pytest.mark.parametrize("kind", [TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID])
def test_no_distance_is_rest_and_not_a_division_by_zero(kind):
    c = constants(kind, repeats=1, start_rad=1.0, target_rad=1.0, move_s=1.0, speed_radps=1.0, acceleration_radps2=1.0)
    for t_s in (0.0, 0.5, 7.3):
        assert at(c, t_s) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (TrajectoryKind.SINE, {"amplitude_rad": 0.4, "omega_radps": 5.0, "shift_s": 0.3, "offset_rad": 0.1}),
        (TrajectoryKind.MIN_JERK, {"start_rad": -0.2, "target_rad": 0.5, "move_s": 1.3}),
    ],
)
def test_jerk_and_fourth_derivative_are_those_of_the_acceleration(kind, values):
    c, reference, step_s = constants(kind, **values), new(Reference)[0], 1e-4
    for t_s in (0.2, 0.65, 1.1):
        around = [at(c, t_s + k * step_s)[2] for k in (-1, 0, 1)]
        reference_at(c, NO_TABLE, 0, t_s, reference)
        expected = (around[0] - 2.0 * around[1] + around[2]) / step_s**2
        assert reference.snap_radps4 == pytest.approx(expected, rel=1e-3, abs=1e-3)
        slope = (around[2] - around[0]) / (2.0 * step_s)
        assert reference.jerk_radps3 == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_jerk_and_fourth_derivative_of_an_approach_and_of_rest():
    reference, coefficients, step_s = new(Reference)[0], np.zeros(6), 1e-4
    reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = 0.6, 0.2, -1.0
    plan_approach(0.1, reference, 2.0, coefficients)
    around = []
    for k in (-1, 0, 1):
        approach_at(coefficients, 0.7 + k * step_s, reference)
        around.append(float(reference.acceleration_radps2))
    approach_at(coefficients, 0.7, reference)
    assert reference.snap_radps4 == pytest.approx((around[0] - 2.0 * around[1] + around[2]) / step_s**2, rel=1e-3)
    assert reference.jerk_radps3 == pytest.approx((around[2] - around[0]) / (2.0 * step_s), rel=1e-5)
    brake_step(reference, 1.0, 1e-3)
    assert reference.snap_radps4 == reference.jerk_radps3 == 0.0
    approach_at(coefficients, 0.7, reference)
    reference_at(constants(TrajectoryKind.HOLD, start_rad=0.3), NO_TABLE, 0, 1.0, reference)
    assert reference.snap_radps4 == reference.jerk_radps3 == 0.0


@quick
@given(angle, st.tuples(angle, st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)), st.floats(0.5, 20.0), fraction)
def test_approach_starts_at_rest_and_ends_in_the_trajectory(position, target, duration_s, part):
    reference, coefficients = new(Reference)[0], np.zeros(6)
    reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = target
    plan_approach(position, reference, duration_s, coefficients)

    def motion(t_s):
        out = new(Reference)[0]
        approach_at(coefficients, t_s, out)
        return float(out.position_rad), float(out.velocity_radps), float(out.acceleration_radps2)

    assert motion(0.0) == (position, 0.0, 0.0)
    assert motion(-1.0) == (position, 0.0, 0.0)
    assert motion(duration_s) == pytest.approx(target, abs=1e-9)
    assert_consistent(motion, part * duration_s, 1e-4 * duration_s, 1e-4)


def test_an_approach_without_duration_rests_where_the_joint_stands():
    reference, coefficients = new(Reference)[0], np.full(6, 9.0)
    reference.position_rad = 1.0
    for duration_s in (0.0, -1.0, math.nan):
        plan_approach(0.25, reference, duration_s, coefficients)
        assert coefficients.tolist() == [0.25, 0.0, 0.0, 0.0, 0.0, 0.0]


@quick
@given(angle, st.floats(-3.0, 3.0), st.floats(0.1, 20.0), st.sampled_from([1e-3, 5e-4, 1e-2]))
def test_brake_lands_on_exactly_zero_within_the_deceleration(position, velocity, brake, period_s):
    reference = new(Reference)[0]
    reference.position_rad, reference.velocity_radps = position, velocity
    rows = np.zeros((100_000, 3))
    steps = brake_to_rest(reference, brake, period_s, rows)
    positions, velocities = np.vstack([(position, velocity), rows[:steps, :2]]).T
    accelerations = rows[:steps, 2]
    assert np.all(np.abs(accelerations) <= brake * (1.0 + 1e-12))
    assert np.all(accelerations * velocity <= 0.0)
    np.testing.assert_allclose(np.diff(velocities), accelerations * period_s, rtol=0.0, atol=1e-12)
    travel = velocities[:-1] * period_s + 0.5 * accelerations * period_s**2
    np.testing.assert_allclose(np.diff(positions), travel, rtol=0.0, atol=1e-12)
    assert reference.velocity_radps == 0.0
    assert abs(steps - math.ceil(abs(velocity) / (brake * period_s))) <= 1
    ideal = position + velocity * abs(velocity) / (2.0 * brake)
    assert abs(float(reference.position_rad) - ideal) <= brake * period_s**2
    resting = float(reference.position_rad)
    brake_step(reference, brake, period_s)
    assert reference.tolist() == (resting, 0.0, 0.0, 0.0, 0.0)


def test_a_brake_that_is_not_positive_stops_at_once():
    for brake in (0.0, -1.0, math.nan):
        reference = new(Reference)[0]
        reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = 1.0, 2.0, 3.0
        brake_step(reference, brake, 1e-3)
        assert reference.tolist() == (1.0, 0.0, 0.0, 0.0, 0.0)


# --- Tables from CSV, the demands of a trajectory, the duration of an approach; compiled and plain runs agree ---
POINTS = "time_s,position_rad\n10,0.0\n11,0.5\n12.5,-0.25\n13,0.0\n"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text(POINTS)
    return table_from_csv(path)


def test_table_goes_through_the_points_at_rest_at_both_ends(table):
    assert table.shape == (4, 5)
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    motion = sampled(c, table, [-1.0, 0.0, 1.0, 2.5, 3.0, 9.0])
    assert motion[:, 0] == pytest.approx([0.0, 0.0, 0.5, -0.25, 0.0, 0.0], abs=1e-12)
    assert motion[[0, 1, 4, 5], 1] == pytest.approx([0.0] * 4, abs=1e-12)
    assert sampled(c, table, [1e-9, 3.0 - 1e-9])[:, 1] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_table_is_continuous_up_to_the_acceleration_and_its_derivatives_belong_together(table):
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    for join in (1.0, 2.5):
        before, after = sampled(c, table, [join - 1e-9, join + 1e-9])
        assert after == pytest.approx(before, abs=1e-6)
    for t_s in np.linspace(0.01, 2.99, 50):
        assert_consistent(lambda t: at(c, t, table), t_s, 1e-5, 1e-3)


def test_repeat_wraps_where_the_ends_meet_and_stays_where_they_do_not(table, tmp_path):
    assert ends_meet(table)
    c = constants(TrajectoryKind.TABLE, table_rows=4, repeats=1)
    once, later = sampled(c, table, [0.7, 2.2]), sampled(c, table, [30.7, 32.2])
    assert later == pytest.approx(once, abs=1e-9)
    path = tmp_path / "open.csv"
    path.write_text("time_s,position_rad\n0,0\n1,1\n")
    open_table = table_from_csv(path)
    assert not ends_meet(open_table)
    c = constants(TrajectoryKind.TABLE, table_rows=2, repeats=1)
    assert sampled(c, open_table, [1.0, 1.5]).tolist() == [[1.0, 0.0, 0.0]] * 2


@settings(max_examples=30)
@given(st.lists(st.floats(-1.0, 105.0), min_size=1, max_size=20), st.integers(-5, 200))
def test_any_row_hint_gives_the_same_motion(times, hint):
    steps = np.arange(101.0)
    rng = np.random.default_rng(3)
    table = np.column_stack([steps + 0.3 * np.sin(steps), rng.normal(size=(101, 4))])
    c = constants(TrajectoryKind.TABLE, table_rows=101)
    expected = [sampled(c, table, [t_s])[0].tolist() for t_s in times]
    assert sampled(c, table, times, hint).tolist() == expected
    for t_s, row in zip(times, expected, strict=True):
        if table[0, 0] < t_s < table[-1, 0]:
            i = int(np.searchsorted(table[:, 0], t_s, side="right")) - 1
            assert row[0] == pytest.approx(np.polyval(table[i, :0:-1], t_s - table[i, 0]), abs=1e-12)


def test_a_table_that_is_missing_rests_at_the_start():
    c = constants(TrajectoryKind.TABLE, table_rows=7, start_rad=0.4)
    assert sampled(c, NO_TABLE, [0.0, 3.0]).tolist() == [[0.4, 0.0, 0.0]] * 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "row 1 (='') must name the column time_s once; needed: time_s,position_rad"),
        (b"time_s,position_deg\n0,0\n1,1\n", "row 1 (='time_s,position_deg') must name the column position_rad once"),
        (b"time_s,position_rad,time_s\n0,0,0\n", "row 1 (='time_s,position_rad,time_s') must name the column time_s"),
        (b"time_s,position_rad\n0,0\n", "rows of values (=1) must be at least 2"),
        (b"time_s,position_rad\n0,0\n1,nan\n", "row 3: position_rad (='nan') must be a finite number"),
        (b"time_s,position_rad\n0,0\ninf,1\n", "row 3: time_s (='inf') must be a finite number"),
        (b"time_s,position_rad\n0,0\n1,abc\n", "row 3: position_rad (='abc') must be a finite number"),
        (b"time_s,position_rad\n0,0\n2,1\n1,1\n", "row 4: time_s (=1) must be above that of the row before (2)"),
        (b"time_s,position_rad\n0,0\n1,1\n1,2\n", "row 4: time_s (=1) must be above that of the row before (1)"),
        (b"time_s,position_rad\n0,0\n1\n2,3\n", "row 3 (='1') must have 2 values, like row 1"),
        (b"time_s,position_rad\n0,0\n1,0.3", "row 3 (='1,0.3') must end with a line end; cut off?"),
        (b"\x89PNG\r\n\x1a\n", "byte 0 is not UTF-8 text; a CSV file is needed"),
        (b"time_s,position_rad\n0,\0\n", "byte 22 is zero: a binary file"),
        (b"time_s,position_rad\n0,0\n1e-300,1\n1,1\n", "the smallest time step (=1e-300 s) must be longer"),
    ],
)
def test_a_bad_file_is_named_with_row_and_value(tmp_path, content, message):
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.csv") as caught:
        table_from_csv(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.csv: cannot be read \(No such file or directory\)"):
        table_from_csv(tmp_path / "none.csv")


def test_good_files_with_other_columns_blank_lines_and_windows_line_ends_are_read(tmp_path, table):
    path = tmp_path / "good.csv"
    path.write_bytes(b"\xef\xbb\xbfnote, position_rad ,time_s\r\na,0,10\r\nb,0.5,11\r\n\r\nc,-0.25,12.5\r\nd,0,13\r\n")
    assert table_from_csv(path).tolist() == table.tolist()


def assert_peak_covers_exactly(c, table, duration_s):
    """No sample is outside, and the samples come close to every bound."""
    switch_s = min(float(c.switch_s), duration_s)  # the bound is reached at it, not a fifth of a millisecond later
    motion = sampled(c, table, np.append(np.linspace(0.0, duration_s, 20001), (np.nextafter(switch_s, 0.0), switch_s)))
    peak = peak_of(c, table)
    seen = (motion[:, 0].min(), motion[:, 0].max(), np.abs(motion[:, 1]).max(), np.abs(motion[:, 2]).max())
    assert peak == pytest.approx(seen, rel=1e-3, abs=1e-4)
    assert peak[0] <= seen[0] + 1e-12
    assert all(bound >= value - 1e-12 for bound, value in zip(peak[1:], seen[1:], strict=True))


@settings(max_examples=15)
@example(0.0, 0.0, 0.0, 2.908203125, 4.0)
@given(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(0.0, 6.0), st.floats(0.5, 6.0))
def test_peak_of_a_sine_over_the_run(amplitude, omega, shift, switch_s, duration_s):
    c = constants(
        TrajectoryKind.SINE, duration_s=duration_s, switch_s=switch_s,
        amplitude_rad=amplitude, omega_radps=omega, shift_s=shift, offset_rad=0.1,
        amplitude2_rad=0.3, omega2_radps=2.0, shift2_s=0.4, offset2_rad=-0.2,
    )  # fmt: skip
    assert_peak_covers_exactly(c, NO_TABLE, duration_s)


def test_peak_of_an_endless_sine():
    c = constants(TrajectoryKind.SINE, amplitude_rad=0.35, omega_radps=0.2 * math.pi, offset_rad=1.0)
    assert peak_of(c) == pytest.approx((0.65, 1.35, 0.07 * math.pi, 0.35 * (0.2 * math.pi) ** 2))


@pytest.mark.parametrize("target", [0.1, 2.0, -1.0])
@pytest.mark.parametrize("kind", [TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID])
def test_peak_of_moves(kind, target):
    c = constants(kind, target_rad=target, move_s=1.5, speed_radps=0.8, acceleration_radps2=2.0)
    assert_peak_covers_exactly(c, NO_TABLE, 4.0)


def test_peak_of_a_table_finds_what_lies_between_the_points(table):
    c = constants(TrajectoryKind.TABLE, table_rows=4)
    assert_peak_covers_exactly(c, table, 3.0 - 1e-12)
    assert peak_of(c, table).position_max_rad > 0.5


def test_peak_of_rest():
    assert peak_of(constants(TrajectoryKind.HOLD, start_rad=0.2)) == (0.2, 0.2, 0.0, 0.0)
    assert peak_of(constants(TrajectoryKind.TABLE, start_rad=0.2)) == (0.2, 0.2, 0.0, 0.0)


@settings(max_examples=30)
@given(st.floats(-3.0, 3.0), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05), st.floats(0.6, 3.0), st.floats(1.1, 10.0))
def test_approach_duration_keeps_both_limits_and_is_not_longer_than_needed(start, velocity, acceleration, v_max, a_max):
    target = new(Reference)[0]
    target.velocity_radps, target.acceleration_radps2 = velocity, acceleration
    duration_s = approach_duration_s(start, target, v_max, a_max)
    peak = approach_peak(start, target, duration_s)
    assert peak.velocity_radps <= v_max * (1.0 + 1e-6)
    assert peak.acceleration_radps2 <= a_max * (1.0 + 1e-6)
    if duration_s > 0.1:
        shorter = approach_peak(start, target, 0.998 * duration_s)
        assert shorter.velocity_radps > v_max or shorter.acceleration_radps2 > a_max


def test_approach_duration_of_a_plain_move_is_the_closed_form():
    target = new(Reference)[0]
    target.position_rad = 1.0
    assert approach_duration_s(0.0, target, 0.5, 100.0) == pytest.approx(1.875 / 0.5, rel=2e-3)
    assert approach_duration_s(0.0, target, 100.0, 2.0) == pytest.approx(
        math.sqrt(10.0 / math.sqrt(3.0) / 2.0), rel=2e-3
    )
    assert approach_duration_s(1.0, target, 0.5, 2.0, minimum_s=0.25) == 0.25


def test_an_approach_to_a_start_above_the_limits_is_refused():
    target = new(Reference)[0]
    target.velocity_radps = 0.5
    approach_duration_s(0.0, target, 0.5, 2.0)
    target.acceleration_radps2 = 1.0
    with pytest.raises(ValueError, match=r"approach distance \(=-2 rad\) cannot be covered"):
        approach_duration_s(2.0, target, 0.5, 2.0)
    with pytest.raises(ValueError, match=r"velocity_radps \(=0.5\) at the trajectory start must be in \[-0.49..0.49\]"):
        approach_duration_s(0.0, target, 0.49, 2.0)


_BOTH_WAYS = """
import json
import numpy as np
from jointctl.firmware_py.motion_records import (Reference, TrajectoryConstants)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import approach_at, brake_step, plan_approach, reference_at
from jointctl.hil.plant import R1, encoder_counts, plant, step_plant

c, r, a, out = new(TrajectoryConstants)[0], new(Reference)[0], np.zeros(6), []
c.repeats, c.start_rad, c.target_rad, c.move_s, c.dwell_s = 1, 0.1, 0.9, 1.3, 0.2
c.speed_radps, c.acceleration_radps2 = 0.7, 2.0
c.amplitude_rad, c.omega_radps, c.switch_s, c.amplitude2_rad, c.omega2_radps, c.table_rows = 0.3, 2.0, 2.0, 0.2, 3.0, 3
table = np.array([[0.0, 0.0, 0.0, 3.0, -2.0], [1.0, 1.0, 0.0, -3.0, 2.0], [2.0, 0.0, 0.0, 0.0, 0.0]])
for kind in range(5):
    c.kind = kind
    row = 0
    for k in range(40):
        row = reference_at(c, table, row, 0.13 * k - 0.2, r)
        out.append([int(row), *map(float, r.tolist())])
plan_approach(0.3, r, 1.7, a)
approach_at(a, 0.9, r)
for _ in range(30):
    out.append([0, *map(float, r.tolist())])
    brake_step(r, 2.0, 0.01)
for kind in range(4):
    loaded = {"flexible": True, "thermal": True, "gravity_Nm": 5.0, "end_stops": True, "encoder_noise_counts": 2.0,
              "hysteresis_width_rad": 2e-4, "link_friction_share": 0.2, "kinematic_error_rad": (2e-4,),
              "kinematic_error_per_motor_turn": (2.0,), "reducer_knees_Nm": (7.0, 25.0),
              "reducer_stiffness_beyond_Nmprad": (2.5e4, 2.9e4)}
    for extra in ({}, loaded):
        pc, ps = plant(**{**R1, "friction_kind": kind, **extra})
        for k in range(300):
            step_plant(pc[0], ps[0], 40.0 if k < 200 else -55.0)
        s = ps[0]
        out.append([encoder_counts(pc[0], s), float(s.joint_position_rad), float(s.joint_velocity_radps),
                    float(s.friction_torque_Nm), float(s.motor_position_rad),
                    float(s.actuator_torque_Nm)])
print(json.dumps(out))
"""


def test_compiled_and_plain_python_agree():
    compiled, plain = (
        np.array(json.loads(run_python(_BOTH_WAYS, NUMBA_DISABLE_JIT=disabled, PYTHONWARNINGS="error")))
        for disabled in ("0", "1")
    )
    assert compiled.shape == (238, 6)
    assert plain == pytest.approx(compiled, rel=1e-9, abs=1e-12)
