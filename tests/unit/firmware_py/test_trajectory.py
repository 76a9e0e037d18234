"""Trajectories: the three quantities belong together, joins and ends are as promised, approach and brake are exact."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import approach_at, brake_step, plan_approach, reference_at, trapezoid_times_s

NO_TABLE = np.zeros((0, 5))
PAPER_SINE = {"amplitude_rad": 0.35, "omega_radps": 0.2 * math.pi}
FREQUENCY_CHANGE = {"switch_s": 82.5, "amplitude2_rad": 0.35, "omega2_radps": 0.125 * math.pi, "shift2_s": 1.5}
AMPLITUDE_CHANGE = {"switch_s": 82.5, "amplitude2_rad": 0.175, "omega2_radps": 0.2 * math.pi, "offset2_rad": 0.175}

quick = settings(max_examples=40, deadline=None)
angle = st.floats(-3.0, 3.0)
fraction = st.floats(0.01, 0.99)


def constants(kind, **values):
    c = new(TrajectoryConstants)[0]
    c.kind = kind
    for name, value in values.items():
        c[name] = value
    return c


def at(c, t_s, table=NO_TABLE):
    reference = new(Reference)[0]
    reference_at(c, table, 0, t_s, reference)
    return float(reference.position_rad), float(reference.velocity_radps), float(reference.acceleration_radps2)


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


@quick
@given(
    angle,
    st.tuples(angle, st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)),
    st.floats(0.5, 20.0),
    fraction,
)
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
    steps = 0
    while reference.velocity_radps != 0.0:
        before = (float(reference.position_rad), float(reference.velocity_radps))
        brake_step(reference, brake, period_s)
        acceleration = float(reference.acceleration_radps2)
        assert abs(acceleration) <= brake * (1.0 + 1e-12)
        assert acceleration * velocity <= 0.0
        assert float(reference.velocity_radps) == pytest.approx(before[1] + acceleration * period_s, abs=1e-12)
        travel = before[1] * period_s + 0.5 * acceleration * period_s**2
        assert float(reference.position_rad) == pytest.approx(before[0] + travel, abs=1e-12)
        steps += 1
    assert abs(steps - math.ceil(abs(velocity) / (brake * period_s))) <= 1
    ideal = position + velocity * abs(velocity) / (2.0 * brake)
    assert abs(float(reference.position_rad) - ideal) <= brake * period_s**2
    resting = float(reference.position_rad)
    brake_step(reference, brake, period_s)
    assert reference.tolist() == (resting, 0.0, 0.0)


def test_a_brake_that_is_not_positive_stops_at_once():
    for brake in (0.0, -1.0, math.nan):
        reference = new(Reference)[0]
        reference.position_rad, reference.velocity_radps, reference.acceleration_radps2 = 1.0, 2.0, 3.0
        brake_step(reference, brake, 1e-3)
        assert reference.tolist() == (1.0, 0.0, 0.0)
