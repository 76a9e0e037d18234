"""Set-points that come while the joint moves: what is followed, what is refused, and what happens without them."""

from __future__ import annotations

import math
import os
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from jointctl.firmware_py.live_change import between, step_other_motion
from jointctl.firmware_py.motion_records import SET_POINTS, ChangeKind, Reference, SetPoint
from jointctl.firmware_py.safety import reference_fault, set_point_problem
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest, TrajectoryKind
from jointctl.firmware_py.states import SetPointProblem as Problem
from tests.axis_on_stub_joint import NewRig, Rig, assert_well, finish

DELAY_ms, TIMEOUT_ms = 30, 100
MS = 1_000_000


class StreamRig(Rig):
    """A rig whose motion is set-points; `put` is what a program does."""

    def __init__(self, position_rad: float = 0.0) -> None:
        super().__init__(position_rad)
        axis = self.axis
        axis.trajectory.kind, axis.trajectory.start_rad, axis.sequence.approach_s = (
            TrajectoryKind.STREAM,
            position_rad,
            0.0,
        )
        set_limits(axis.stream)
        self.until(AxisPhase.TRACKING)

    def put(self, position_rad: float, velocity_radps: float = 0.0, *, at_ms: float = 0.0, **more: float) -> None:
        """A set-point for now, or that much later."""
        stream = self.axis.stream
        number = int(stream.written[0])
        stream.time_ns[number % SET_POINTS] = self.state.slot_ns + round(at_ms * MS)
        values = position_rad, velocity_radps, more.get("acceleration_radps2", math.nan), more.get("torque_Nm", 0.0)
        stream.values[number % SET_POINTS] = values
        stream.written[0] = number + 1

    @property
    def at(self) -> tuple[float, float]:
        return float(self.state.reference.position_rad), float(self.state.reference.velocity_radps)


def set_limits(stream: Any) -> None:
    stream.delay_ns, stream.timeout_ns = DELAY_ms * MS, TIMEOUT_ms * MS
    stream.acceleration_max_radps2, stream.jump_max_rad = 20.0, 0.2
    stream.torque_max_Nm, stream.torque_rate_max_Nmps = 5.0, 500.0


def ramp(run: StreamRig, cycles: int, every: int = 10, rate_radps: float = 0.2) -> None:
    """Set-points of a ramp that begins softly."""
    begun_ns = run.state.slot_ns
    for k in range(cycles):
        if k % every == 0:
            t_s = (run.state.slot_ns - begun_ns) * 1e-9
            soft_s = 0.1
            speed = rate_radps * min(1.0, t_s / soft_s)
            way = 0.5 * speed * t_s if t_s < soft_s else rate_radps * (t_s - 0.5 * soft_s)
            run.put(way, speed)
        run.tick()


def test_the_reference_follows_the_delay_behind() -> None:
    run = StreamRig()
    ramp(run, 500)
    position_rad, velocity_radps = run.at
    assert velocity_radps == pytest.approx(0.2)
    assert position_rad == pytest.approx(0.2 * (0.499 - 0.05 - 1e-3 * DELAY_ms), abs=2.1e-4)
    assert run.state.stream.refused == 0
    assert_well(run)


@pytest.mark.parametrize("overrun", [1, 4])
def test_without_set_points_it_brakes_and_rests_and_may_begin_again(overrun: int) -> None:
    run = StreamRig()
    ramp(run, 301)
    last_rad = 0.2 * (0.3 - 0.05)
    run.axis.limits.skipped_max_cycles = 1 << 40
    for _ in range(200 // overrun):
        run.tick(overrun)
    position_rad, velocity_radps = run.at
    assert velocity_radps == 0.0
    assert position_rad == pytest.approx(last_rad + 0.2**2 / 40.0, abs=1e-6)
    run.put(position_rad + 0.005)
    run.run(2 * DELAY_ms)
    assert run.at == (pytest.approx(position_rad + 0.005), 0.0)
    assert_well(run)


def test_it_begins_again_from_wherever_the_reference_is_without_a_jump() -> None:
    run = StreamRig()
    ramp(run, 301)
    while run.state.stream.following:
        run.tick()
    run.run(4)  # it brakes
    position_rad, velocity_radps = run.at
    run.put(position_rad + 0.004, velocity_radps)
    run.tick()
    assert run.state.stream.following
    assert run.at[0] - position_rad == pytest.approx(1e-3 * velocity_radps, abs=2e-5)  # it has gone on meanwhile
    assert run.at[1] == pytest.approx(velocity_radps, abs=0.02)


def test_what_it_begins_again_with_is_not_that_of_the_last_set_point() -> None:
    run = StreamRig()
    for k in range(301):
        if k % 10 == 0:
            run.put(1e-4 * k, 0.1 * min(1.0, k / 100), acceleration_radps2=3.0, torque_Nm=min(4.0, 0.04 * k))
        run.tick()
    while run.state.stream.following:
        run.tick()
    run.run(4)  # it brakes, and the torque goes back at its rate
    torque_Nm, (position_rad, velocity_radps) = float(run.state.stream.torque_Nm), run.at
    assert 1.0 < torque_Nm < 3.0
    run.put(position_rad + 0.001, velocity_radps, acceleration_radps2=3.0, torque_Nm=torque_Nm)
    for _ in range(5):
        run.tick()
        assert run.state.stream.following
        assert run.state.stream.torque_Nm == pytest.approx(torque_Nm)
        assert abs(run.state.reference.acceleration_radps2) < 0.1  # between two equal velocities


@pytest.mark.parametrize(
    ("velocity", "acceleration", "begins"), [(0.0, 0.0, True), (0.0, 1.0, False), (1.0, 0.0, False)]
)
def test_another_motion_gives_way_at_rest_only(velocity: float, acceleration: float, begins: bool) -> None:
    run = StreamRig()
    run.axis.trajectory.kind = TrajectoryKind.SINE
    reference = run.state.reference
    reference.velocity_radps, reference.acceleration_radps2 = velocity, acceleration
    run.put(0.0)
    run.state.stream.written = 1  # the cycle has seen it
    step_other_motion(run.axis, run.state, 1)
    assert bool(run.axis.trajectory.kind == TrajectoryKind.STREAM) is begins
    assert run.state.stream.refused == (0 if begins else 1)


def test_set_points_a_third_of_the_delay_apart_are_not_close() -> None:
    run = StreamRig()
    for k in range(1, 10):
        run.put(1e-5 * k, at_ms=k * DELAY_ms / 3)
    lengths = []
    for _ in range(4 * DELAY_ms):
        run.tick()
        lengths += [run.state.stream.after.time_ns - run.state.stream.before.time_ns] * bool(run.state.stream.following)
    assert set(lengths) == {DELAY_ms * MS // 3, DELAY_ms * MS * 4 // 3}  # the second from rest to the first one


def test_set_points_that_lie_close_are_one() -> None:
    run = StreamRig()
    for k in range(1, 30):
        run.put(1e-5 * k, at_ms=k)
    for _ in range(DELAY_ms + 28):
        run.tick()
        if run.state.stream.following:
            length_ms = (run.state.stream.after.time_ns - run.state.stream.before.time_ns) / MS
            assert length_ms >= DELAY_ms / 3 or run.state.stream.taken == 29
    run.run(30)
    assert run.at == (pytest.approx(29e-5), 0.0)
    assert run.state.stream.refused == 0


def test_one_that_breaks_a_limit_is_left_out_and_the_others_are_followed() -> None:
    run = StreamRig()
    run.put(0.001, at_ms=0)
    run.put(9.0, at_ms=20)
    run.put(0.002, at_ms=40)
    run.run(120)
    assert run.state.stream.refused == 1
    assert run.at == (pytest.approx(0.002), 0.0)


def test_after_an_overrun_it_goes_on_where_it_is_by_then() -> None:
    run = StreamRig()
    run.axis.limits.skipped_max_cycles = 50
    for k in range(20):
        run.put(1e-4 * k, at_ms=10 * k)
    run.run(DELAY_ms + 20)
    run.tick(50)
    assert run.at[0] == pytest.approx(7e-4, abs=1e-4)


def test_one_that_comes_after_its_time_is_left_out() -> None:
    run = StreamRig()
    run.put(0.01, at_ms=-DELAY_ms - 5)
    run.run(50)
    assert (run.state.stream.refused, run.at) == (1, (0.0, 0.0))


def test_the_torque_comes_on_top_at_its_rate_and_goes_with_the_set_points() -> None:
    run = StreamRig()
    for k in range(20):
        run.put(0.0, at_ms=10 * k, torque_Nm=min(4.0, 1.0 * k))
    run.run(150)
    assert run.state.stream.torque_Nm == pytest.approx(4.0)
    run.run(80)
    assert run.state.stream.torque_Nm < 4.0
    for _ in range(20):
        before = float(run.state.stream.torque_Nm)
        run.tick()
        assert abs(float(run.state.stream.torque_Nm) - before) <= 0.5 + 1e-12
    assert run.state.stream.torque_Nm == 0.0


def test_a_stop_takes_the_torque_away_and_drops_what_comes() -> None:
    run = StreamRig()
    run.put(0.0, at_ms=0, torque_Nm=3.0)
    run.run(DELAY_ms)
    assert run.state.stream.torque_Nm > 2.0
    run.stop = StopRequest.RAMP
    run.tick()
    run.put(0.1)
    finish(run)
    assert (float(run.state.stream.torque_Nm), int(run.state.stream.refused)) == (0.0, 1)


def test_an_acceleration_that_is_given_is_fed_forward() -> None:
    run = StreamRig()
    run.put(0.0, at_ms=0, acceleration_radps2=2.0)
    run.put(0.0, at_ms=20, acceleration_radps2=4.0)
    run.run(DELAY_ms + 10)
    assert run.state.reference.acceleration_radps2 == pytest.approx(3.0)


def test_set_points_are_for_rest_not_for_a_motion(rig: NewRig) -> None:
    run = StreamRig()
    run.axis.trajectory.kind, run.axis.trajectory.amplitude_rad = TrajectoryKind.SINE, 0.0
    run.run(5)
    run.axis.trajectory.amplitude_rad = 0.3
    run.run(5)
    run.put(0.0)
    run.run(5)
    assert run.axis.trajectory.kind == TrajectoryKind.SINE
    assert run.state.stream.refused == 1
    run.axis.trajectory.kind, run.axis.trajectory.start_rad = TrajectoryKind.HOLD, run.at[0]
    run.tick()
    run.put(run.at[0])
    run.run(5)
    assert run.axis.trajectory.kind == TrajectoryKind.STREAM


def test_a_motion_from_where_the_reference_rests_begins_at_once() -> None:
    run = StreamRig()
    request = run.axis.change.request
    request.kind, request.trajectory.kind = ChangeKind.MOTION, TrajectoryKind.MIN_JERK
    request.trajectory.target_rad, request.trajectory.move_s = 0.1, 0.5
    run.axis.change.move_min_s = 0.2
    request.first = request.last = 1
    run.axis.change.order[0] = 1
    run.run(253)
    assert run.at[0] == pytest.approx(0.05, abs=1e-3)


def test_a_new_motion_ends_the_stream() -> None:
    run = StreamRig()
    ramp(run, 300)
    change = run.axis.change
    change.move_speed_radps, change.move_acceleration_radps2, change.move_min_s = 1.0, 10.0, 0.01
    request = change.request
    request.kind, request.trajectory.kind, request.trajectory.start_rad = ChangeKind.MOTION, TrajectoryKind.STREAM, 0.0
    request.first = request.last = 1
    change.order[0] = 1
    run.put(0.06)
    run.run(600)
    assert run.at == (pytest.approx(0.0, abs=1e-12), 0.0)
    assert_well(run)


# --- the limits, as a pure function ---
def problem(before: tuple[float, ...] = (0.0,) * 3, after: tuple[float, ...] = (0.0,) * 3, ms: float = 30.0) -> Problem:
    run = Rig()
    limits = run.axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -0.5, 0.5, 1.0
    set_limits(run.axis.stream)
    points = new(SetPoint, 2)
    for point, (position, velocity, torque), at_ms in zip(points, (before, after), (0.0, ms), strict=True):
        point.position_rad, point.velocity_radps, point.torque_Nm = position, velocity, torque
        point.time_ns, point.acceleration_radps2 = round(at_ms * MS), math.nan
    if len(after) > 3:
        points[1].acceleration_radps2 = after[3]
    return Problem(int(set_point_problem(limits, run.axis.stream, 20.0, points[0], points[1])))


NONE, FAST = Problem.NONE, (0.0, 0.9, 0.0)


@pytest.mark.parametrize(
    ("inside", "outside", "expected"),
    [
        ({"ms": 130.0}, {"ms": 130.001}, Problem.TIME),
        ({"ms": 0.001}, {"ms": 0.0}, Problem.TIME),
        ({}, {"after": (math.nan, 0.0, 0.0)}, Problem.POSITION),
        ({}, {"after": (0.0, math.inf, 0.0)}, Problem.VELOCITY),
        ({"before": (0.5, 0.0, 0.0), "after": (0.5, 0.0, 0.0)}, {"after": (0.501, 0.0, 0.0)}, Problem.POSITION),
        ({"before": FAST, "after": (0.0285, 1.0, 0.0)}, {"before": FAST, "after": (0.0, 1.001, 0.0)}, Problem.VELOCITY),
        ({"after": (0.2, 0.0, 0.0), "before": (0.195, 0.0, 0.0)}, {"after": (0.201, 0.0, 0.0)}, Problem.JUMP),
        ({"after": (0.0, 0.0, 5.0)}, {"after": (0.0, 0.0, 5.001)}, Problem.TORQUE),
        ({"after": (0.0, 0.0, 0.5), "ms": 1.0}, {"after": (0.0, 0.0, 0.501), "ms": 1.0}, Problem.TORQUE_RATE),
        ({}, {"after": (0.0, 0.0, math.nan)}, Problem.TORQUE),
        ({"after": (0.009, 0.6, 0.0)}, {"after": (0.009, 0.601, 0.0)}, Problem.ACCELERATION),
        ({"after": (0.00899, 0.0, 0.0)}, {"after": (0.00901, 0.0, 0.0)}, Problem.ACCELERATION),
    ],
)  # fmt: skip
def test_each_limit_at_its_edge(inside: dict[str, Any], outside: dict[str, Any], expected: Problem) -> None:
    assert problem(**inside) is NONE
    assert problem(**outside) is expected


def test_a_set_point_exactly_as_far_as_allowed_is_no_jump() -> None:
    assert problem(after=(0.2, 0.0, 0.0)) is not Problem.JUMP
    assert problem(after=(0.2001, 0.0, 0.0)) is Problem.JUMP


def test_a_torque_that_stays_is_not_too_fast() -> None:
    assert problem(before=(0.0, 0.0, 0.4), after=(0.0, 0.0, 0.4), ms=0.5) is NONE
    assert problem(before=(0.0, 0.0, -0.4), after=(0.0, 0.0, 0.4), ms=0.5) is Problem.TORQUE_RATE


def test_a_set_point_exactly_as_steep_as_allowed_is_none_too_steep() -> None:
    """In 1/32 s with 20 rad/s2: 0.625 rad/s, and 0.625/64 rad from rest to rest."""
    assert problem(after=(0.01, 0.625, 0.0), ms=31.25) is NONE
    assert problem(after=(0.009765625, 0.0, 0.0), ms=31.25) is NONE


def test_the_way_between_two_set_points_is_that_of_hermites_cubic() -> None:
    """Speed and stopping way at each quarter, where it is quickest and where it turns back, close to the limits.

    Against another implementation of the cubic.
    """
    random, rig = np.random.default_rng(20), Rig()
    limits = rig.axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -0.5, 0.5, 1.0
    found = Counter[Problem]()
    for _ in range(2000):
        duration_s = random.uniform(0.02, 0.12)
        speeds_radps = random.uniform(0.2, 1.0) + np.array([-0.5, 0.5]) * random.uniform(-0.4, 0.4)
        speeds_radps = np.clip(speeds_radps, -0.999, 0.999)  # not at the limit itself
        way_rad = duration_s * speeds_radps.mean() + random.uniform(-9.0, 9.0) * duration_s**2
        start_rad = random.uniform(0.2, 0.5)
        cubic = CubicHermiteSpline([0.0, duration_s], [start_rad, start_rad + way_rad], speeds_radps)
        inside_s = [*cubic.derivative(1).roots(extrapolate=False), *cubic.derivative(2).roots(extrapolate=False)]
        expected = set()
        for at_s in (*(duration_s * np.array([0.25, 0.5, 0.75, 1.0])), *inside_s):
            speed_radps = float(cubic(at_s, 1))
            if abs(speed_radps) > 1.0:
                expected.add(Problem.VELOCITY)
            elif (
                reference_fault(limits, float(cubic(at_s)), speed_radps, 0.0, 0.0, 20.0, DELAY_ms * 1e-3) != Fault.NONE
            ):
                expected.add(Problem.STOPPING_WAY)
        points = ((start_rad, speeds_radps[0], 0.0), (start_rad + way_rad, speeds_radps[1], 0.0))
        told = problem(*points, ms=1e3 * duration_s)
        if told not in (Problem.POSITION, Problem.JUMP, Problem.ACCELERATION):
            assert told in (expected or {Problem.NONE}), points
            found[told] += 1
    assert min(found[told] for told in (Problem.NONE, Problem.VELOCITY, Problem.STOPPING_WAY)) > 100


@pytest.mark.parametrize("given_radps2", [20.0, 20.1, -math.inf])
def test_an_acceleration_that_is_given_has_the_same_limit(given_radps2: float) -> None:
    expected = NONE if given_radps2 == 20.0 else Problem.ACCELERATION
    run = Rig()
    set_limits(run.axis.stream)
    points = new(SetPoint, 2)
    points[1].time_ns, points[1].acceleration_radps2 = 30 * MS, given_radps2
    assert set_point_problem(run.axis.limits, run.axis.stream, 20.0, points[0], points[1]) == expected


def test_a_way_that_could_not_be_braked_inside_the_limits_is_refused() -> None:
    before, after = (0.44, 0.6, 0.0), (0.458, 0.6, 0.0)
    assert problem(before, after) is NONE
    assert problem((0.46, 0.6, 0.0), (0.478, 0.6, 0.0)) is Problem.STOPPING_WAY


def test_a_velocity_between_two_set_points_counts_too() -> None:
    assert problem((0.0, 0.95, 0.0), (0.0285, 0.95, 0.0)) is NONE
    assert problem((0.0, 0.95, 0.0), (0.036, 0.95, 0.0)) is Problem.VELOCITY


@pytest.mark.parametrize(("highest", "expected"), [(0.9995, NONE), (1.0005, Problem.VELOCITY)])
@pytest.mark.parametrize("at", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_greatest_velocity_between_two_set_points_counts_wherever_it_is(
    highest: float, expected: Problem, at: float, direction: float
) -> None:
    """highest - 0.1 (share - at)^2: at each quarter of the way the velocity is less than the limit of 1 rad/s."""
    first, last = highest - 0.1 * at**2, highest - 0.1 * (1.0 - at) ** 2
    way = 0.03 * (highest - 0.1 * (at**3 + (1.0 - at) ** 3) / 3.0)
    assert problem((0.0, direction * first, 0.0), (direction * way, direction * last, 0.0)) is expected


def test_a_set_point_may_cruise_at_the_limit_and_turn_at_it() -> None:
    """Rounding is no excess: offsets that make the cubic's velocity a little greater than the limit."""
    for k in range(200):
        at_rad = -0.4 + 0.003 * k
        assert problem((at_rad, 1.0, 0.0), (at_rad + 0.01, 1.0, 0.0), ms=10.0) in (NONE, Problem.STOPPING_WAY)


@pytest.mark.parametrize("cubic", [0.0, 1e-13, -1e-13, 1e-9])
@pytest.mark.parametrize(("end_rad", "expected"), [(0.4999, NONE), (0.5001, Problem.STOPPING_WAY)])
def test_a_parabola_turns_back_inside_the_limits(cubic: float, end_rad: float, expected: Problem) -> None:
    """Constant acceleration through a reversal, 0.3 of the way, with what rounding makes of it; no look ahead."""
    run = Rig()
    limits = run.axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -0.5, 0.5, 1.0
    set_limits(run.axis.stream)
    run.axis.stream.delay_ns, run.axis.stream.timeout_ns = MS // 1000, 200 * MS
    points, slope, turn_s = new(SetPoint, 2), 4.0, 0.06
    for point, at_s in zip(points, (0.0, 0.2), strict=True):
        point.time_ns = round(at_s * 1e9)
        point.position_rad = end_rad - 0.5 * slope * (at_s - turn_s) ** 2 + cubic * at_s**3
        point.velocity_radps = -slope * (at_s - turn_s) + 3.0 * cubic * at_s**2
        point.acceleration_radps2 = math.nan
    assert set_point_problem(limits, run.axis.stream, 1000.0, points[0], points[1]) == expected


numbers = st.floats(-2.0, 2.0) | st.sampled_from([math.nan, math.inf, -math.inf, 1e300])


# plain Python, which tests/unit/firmware_py/test_kernel.py repeats this in, is a hundred times slower
@settings(max_examples=20 if os.environ.get("NUMBA_DISABLE_JIT") == "1" else 200)
@given(st.lists(st.tuples(numbers, numbers, numbers, st.floats(-50.0, 300.0)), max_size=30), st.integers(1, 3))
def test_whatever_comes_the_reference_stays_inside_its_limits(points: list[tuple[float, ...]], elapsed: int) -> None:
    run = StreamRig()
    limits = run.axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -0.5, 0.5, 2.0
    limits.saturation_max_cycles = 1 << 40  # what is allowed to be asked for may take all torque
    limits.skipped_max_cycles = 1 << 40
    for position, velocity, torque, at_ms in points:
        run.put(position, velocity, torque_Nm=torque, at_ms=at_ms)
        for _ in range(8):
            run.tick(elapsed)
            reference = run.state.reference
            assert -0.5 <= reference.position_rad <= 0.5
            assert abs(reference.velocity_radps) <= 2.0
            assert abs(float(run.state.stream.torque_Nm)) <= 5.0
            if (
                run.state.fault == Fault.VELOCITY_LIMIT
            ):  # of a joint that lags and makes up for it, not of the reference
                return
            assert run.state.fault == Fault.NONE


def test_between_two_set_points_it_is_the_cubic() -> None:
    points, reference = new(SetPoint, 2), new(Reference)[0]
    points[1].time_ns, points[1].position_rad, points[1].velocity_radps = 100 * MS, 0.1, 1.0
    points[0].acceleration_radps2, points[0].velocity_radps = math.nan, 0.5
    for u in np.linspace(0.0, 1.0, 11):
        between(points[0], points[1], round(u * 100 * MS), reference)
        position = 0.1 * (3 * u**2 - 2 * u**3 + u**3 - u**2 + 0.5 * (u - 2 * u**2 + u**3))
        velocity = 6 * u - 6 * u**2 + 3 * u**2 - 2 * u + 0.5 * (1 - 4 * u + 3 * u**2)
        assert reference.position_rad == pytest.approx(position, abs=1e-12)
        assert reference.velocity_radps == pytest.approx(velocity, abs=1e-12)
        assert reference.acceleration_radps2 == pytest.approx(5.0)  # between the velocities: 0.5 rad/s in 0.1 s


def test_it_brakes_from_the_time_of_the_last_set_point_on() -> None:
    run = StreamRig()
    run.put(0.003, 0.2, at_ms=0.4)
    run.run(DELAY_ms + 1)  # 0.6 ms behind it
    assert run.at[1] == pytest.approx(0.2 - 20.0 * 0.6e-3)


def test_the_rate_of_the_torque_is_one_of_time_not_of_cycles() -> None:
    run = StreamRig()
    run.put(0.0, at_ms=0, torque_Nm=5.0)
    run.put(0.0, at_ms=20, torque_Nm=5.0)
    run.run(DELAY_ms + 19)
    before = float(run.state.stream.torque_Nm)
    run.run(1)
    run.tick(3)  # no set-point any more: 500 Nm/s for 3 ms
    assert before - float(run.state.stream.torque_Nm) == pytest.approx(1.5, abs=0.51)
