"""Changes while the joint moves: taken whole and checked, without a jump, by way of rest, never while stopping."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from firmware_py.change_records import ChangeAnswer, ChangeKind, MotionChange
from firmware_py.live_change import gains_allowed, gains_of, move_duration_s, set_gains, trajectory_allowed
from firmware_py.lyapunov import solve_lyapunov_p
from firmware_py.records import Gains, TrajectoryConstants
from firmware_py.schema import new
from firmware_py.states import AxisPhase, ControllerKind, Fault, StopRequest, TrajectoryKind

NewRig = Callable[..., Any]
GAINS = ("kp", "kv", "ki", "observer_radps", "learning_rate")
RAMP_s = 0.05


def live(run: Any) -> Any:
    """The rig with limits for changes: gains by a factor of 2, moves at 2 rad/s."""
    change, law = run.axis.change, run.axis.law
    gains_of(law, change.low)
    gains_of(law, change.high)
    for name in GAINS:
        setattr(change.low, name, getattr(change.low, name) / 2.0)
        setattr(change.high, name, getattr(change.high, name) * 2.0)
    change.ramp_s, change.q1, change.q2 = RAMP_s, 1800.0, 1800.0
    change.move_speed_radps, change.move_acceleration_radps2, change.move_min_s = 2.0, 20.0, 0.05
    return run


def post(run: Any, what: int, /, **fields: Any) -> int:
    """What the supervisor does: the request first, its number last."""
    change = run.axis.change
    number = int(change.order[0]) + 1
    request = change.request
    request.first = request.last = number
    request.kind = what
    gains_of(run.axis.law, request.gains)
    target = request.gains if what == ChangeKind.GAINS else request.trajectory
    for name, value in fields.items():
        setattr(target, name, value)
    change.order[0] = number
    return number


def answered(run: Any, number: int) -> ChangeAnswer:
    run.tick()
    assert run.state.change.answered == number
    return ChangeAnswer(int(run.state.change.answer))


def hold(run: Any, at_rad: float) -> int:
    run.axis.change.request.trajectory = new(TrajectoryConstants)[0]
    return post(run, ChangeKind.MOTION, kind=TrajectoryKind.HOLD, start_rad=at_rad, target_rad=at_rad)


def test_gains_change_along_a_line_and_nothing_jumps(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(100)
    number = post(run, ChangeKind.GAINS, kp=1200.0, kv=70.0, learning_rate=40.0)
    assert answered(run, number) is ChangeAnswer.TAKEN
    seen = [float(run.axis.law.kp)]
    while run.state.change.ramping:
        run.tick()
        seen.append(float(run.axis.law.kp))
        _, p12, p22 = solve_lyapunov_p(seen[-1], float(run.axis.law.kv), 1800.0, 1800.0)
        np.testing.assert_allclose(run.axis.law.network.p_b, [p12 / 2.1, p22 / 2.1], rtol=1e-12)
    assert len(seen) == pytest.approx(RAMP_s / 1e-3, abs=2)
    np.testing.assert_allclose(np.diff(seen), (1200.0 - 784.0) / 50.0, rtol=1e-6)
    assert (run.axis.law.kp, run.axis.law.kv, run.axis.law.network.learning_rate) == (1200.0, 70.0, 40.0)
    assert np.max(np.abs(np.diff(run.torques_Nm[-60:]))) < 0.2
    run.run(200)
    assert run.phase is AxisPhase.TRACKING
    assert run.state.fault == Fault.NONE


@pytest.mark.parametrize("name", GAINS)
def test_gain_limits_are_dense_at_their_boundary(name: str) -> None:
    low, high, gains = new(Gains)[0], new(Gains)[0], new(Gains)[0]
    for field in GAINS:
        setattr(low, field, 1.0)
        setattr(high, field, 3.0)
        setattr(gains, field, 2.0)
    for value, allowed in (
        (1.0, True), (3.0, True), (math.nextafter(1.0, 0.0), False), (math.nextafter(3.0, 4.0), False),
        (math.nan, False), (math.inf, False), (-math.inf, False), (0.0, False),
    ):  # fmt: skip
        setattr(gains, name, value)
        assert bool(gains_allowed(low, high, gains)) is allowed


@pytest.mark.parametrize("value", [784.0 * 2.0001, 784.0 * 0.4999, math.nan, math.inf, -784.0, 0.0])
def test_gains_outside_of_the_limits_change_nothing(rig: NewRig, value: float) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    before = run.axis.law.copy()
    assert answered(run, post(run, ChangeKind.GAINS, kp=value, kv=60.0)) is ChangeAnswer.GAIN_LIMIT
    run.run(60)
    assert (run.axis.law.kp, run.axis.law.kv) == (before.kp, before.kv)
    assert run.phase is AxisPhase.TRACKING


def test_a_change_is_taken_whole_or_not_yet(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    number = post(run, ChangeKind.GAINS, kp=900.0)
    for first, last in ((number - 1, number), (number, number - 1), (number + 1, number + 1)):
        run.axis.change.request.first, run.axis.change.request.last = first, last
        run.run(5)
        assert run.state.change.answered == number - 1
        assert run.axis.law.kp == 784.0
    run.axis.change.request.first = run.axis.change.request.last = number
    assert answered(run, number) is ChangeAnswer.TAKEN


def test_one_request_is_carried_out_once(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    answered(run, post(run, ChangeKind.GAINS, kp=900.0))
    run.run(100)
    run.axis.change.request.gains.kp = 1500.0  # without a new number: nobody looks
    run.run(100)
    assert run.axis.law.kp == 900.0


@pytest.mark.parametrize("kind", [0, 3, -1])
def test_a_kind_that_is_not_known_is_refused(rig: NewRig, kind: int) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    assert answered(run, post(run, kind)) is ChangeAnswer.WRONG_KIND


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING, AxisPhase.APPROACH, AxisPhase.TRACKING])
def test_gains_change_while_the_law_follows_and_motions_while_it_tracks(rig: NewRig, phase: AxisPhase) -> None:
    run = live(rig(0.1))
    if phase is not AxisPhase.WAITING:
        run.until(phase)
    gains = answered(run, post(run, ChangeKind.GAINS, kp=900.0))
    motion = answered(run, hold(run, 0.1))
    assert run.phase is phase
    assert (gains is ChangeAnswer.TAKEN) is (phase >= AxisPhase.APPROACH)
    assert (motion is ChangeAnswer.TAKEN) is (phase is AxisPhase.TRACKING)


@pytest.mark.parametrize("stop", [StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF])
def test_nothing_changes_any_more_once_the_joint_is_being_stopped(rig: NewRig, stop: StopRequest) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    post(run, ChangeKind.GAINS, kp=1200.0)
    run.run(20)
    halfway = float(run.axis.law.kp)
    assert 784.0 < halfway < 1200.0
    run.stop = stop
    number = post(run, ChangeKind.GAINS, kp=1000.0)
    assert answered(run, number) is ChangeAnswer.WRONG_PHASE
    assert answered(run, hold(run, 0.0)) is ChangeAnswer.WRONG_PHASE
    run.until(AxisPhase.FINISHED)
    assert run.axis.law.kp == pytest.approx(halfway, rel=1e-12)


def test_a_set_point_is_reached_from_rest_inside_the_speed_of_moves(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    assert answered(run, hold(run, -0.6)) is ChangeAnswer.TAKEN
    path, motions, times = [], [], []
    while run.state.change.motion != MotionChange.NONE:
        path.append((run.state.reference.position_rad, run.state.reference.velocity_radps))
        motions.append(int(run.state.change.motion))
        times.append(float(run.state.trajectory_s))
        assert abs(run.joint.position_rad - path[-1][0]) < 0.02
        run.tick()
    position, velocity = np.array(path).T
    assert sorted(set(motions)) == [MotionChange.BRAKING, MotionChange.MOVING]
    assert motions == sorted(motions)
    assert abs(velocity[motions.index(MotionChange.MOVING)]) < 1e-3  # at rest in between
    assert np.max(np.abs(velocity)) <= 2.0 + 1e-9
    assert np.max(np.abs(np.diff(velocity))) <= 20.0e-3 + 1e-9  # brake_radps2 and the acceleration of moves
    assert np.max(np.abs(np.diff(position) - velocity[1:] * 1e-3)) < 2e-5
    assert all(t < 0.0 for t in times)
    assert times == sorted(times)
    run.run(100)
    assert run.state.reference.position_rad == -0.6
    assert run.phase is AxisPhase.TRACKING
    assert run.joint.position_rad == pytest.approx(-0.6, abs=5e-3)
    assert run.state.fault == Fault.NONE


def test_a_stop_brakes_from_wherever_the_move_is(rig: NewRig) -> None:
    for after in (1, 10, 60, 200):
        run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
        answered(run, hold(run, -0.6))
        run.run(after)
        before = float(run.state.reference.velocity_radps)
        run.stop = StopRequest.RAMP
        run.tick()
        assert run.phase is AxisPhase.RAMPING
        assert abs(run.state.reference.velocity_radps - before) <= 20.0e-3 + 1e-9
        run.until(AxisPhase.FINISHED)
        assert run.state.fault == Fault.NONE


def test_a_second_set_point_while_the_first_move_is_under_way(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    answered(run, hold(run, -0.6))
    run.run(120)
    assert run.state.change.motion == MotionChange.MOVING
    assert answered(run, hold(run, 0.4)) is ChangeAnswer.TAKEN
    run.run(1500)
    assert run.state.reference.position_rad == 0.4
    assert run.state.fault == Fault.NONE


def test_a_sine_begins_at_its_crest_and_the_run_ends_after_its_time(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    omega = 2.0
    sine = {"kind": TrajectoryKind.SINE, "amplitude_rad": 0.2, "omega_radps": omega, "offset_rad": 0.1}
    assert answered(run, post(run, ChangeKind.MOTION, **sine)) is ChangeAnswer.NOT_FROM_REST
    sine |= {"shift_s": 0.5 * math.pi / omega, "duration_s": 0.3}
    assert answered(run, post(run, ChangeKind.MOTION, **sine)) is ChangeAnswer.TAKEN
    while run.state.change.motion != MotionChange.NONE:
        run.tick()
    began = len(run.phases)
    assert run.state.reference.position_rad == pytest.approx(0.3, abs=1e-5)
    assert abs(run.state.reference.velocity_radps) < 2e-3
    run.until(AxisPhase.RAMPING)
    assert len(run.phases) - began == pytest.approx(300, abs=2)
    assert run.state.fault == Fault.NONE


def test_an_overrun_on_the_way_loses_no_time(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    answered(run, hold(run, -0.3))
    for _ in range(60):
        before = float(run.state.trajectory_s)
        run.tick(4)
        if run.state.change.motion == MotionChange.MOVING and before < -0.02:
            assert run.state.trajectory_s >= before
    run.run(400)
    assert run.state.reference.position_rad == -0.3
    assert run.state.fault == Fault.NONE


TRAJECTORIES: list[tuple[dict[str, float], bool]] = [
    ({"kind": TrajectoryKind.HOLD, "start_rad": 1.0}, True),
    ({"kind": TrajectoryKind.HOLD, "start_rad": math.nextafter(1.0, 2.0)}, False),
    ({"kind": TrajectoryKind.HOLD, "start_rad": math.nan}, False),
    ({"kind": TrajectoryKind.HOLD, "duration_s": math.nan}, False),
    ({"kind": TrajectoryKind.HOLD, "duration_s": -1.0}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.5, "offset_rad": 0.5, "omega_radps": 20.0}, True),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.5, "offset_rad": -0.5, "omega_radps": -20.0}, True),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.5, "offset_rad": 0.5, "omega_radps": 20.001}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.501, "offset_rad": 0.5, "omega_radps": 1.0}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": -0.501, "offset_rad": -0.5, "omega_radps": 1.0}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": math.nan, "omega_radps": 1.0}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.1, "omega_radps": math.nan}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.1, "omega_radps": 1.0, "shift_s": math.inf}, False),
    ({"kind": TrajectoryKind.SINE, "amplitude_rad": 0.1, "omega_radps": 1.0, "switch_s": 1.0}, False),
    ({"kind": TrajectoryKind.MIN_JERK, "start_rad": -1.0, "target_rad": 1.0, "move_s": 0.375}, True),
    ({"kind": TrajectoryKind.MIN_JERK, "start_rad": -1.0, "target_rad": 1.0, "move_s": 0.374}, False),
    ({"kind": TrajectoryKind.MIN_JERK, "start_rad": -1.001, "target_rad": 1.0, "move_s": 9.0}, False),
    ({"kind": TrajectoryKind.MIN_JERK, "target_rad": 1.001, "move_s": 9.0}, False),
    ({"kind": TrajectoryKind.MIN_JERK, "target_rad": 0.5, "move_s": 9.0, "dwell_s": -1.0}, False),
    ({"kind": TrajectoryKind.MIN_JERK, "target_rad": 0.5, "move_s": math.nan}, False),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 10.0, "acceleration_radps2": 1e6}, True),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 10.1, "acceleration_radps2": 1e6}, False),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 50.0, "acceleration_radps2": 99.0}, True),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 0.0, "acceleration_radps2": 9.0}, False),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 1.0, "acceleration_radps2": 0.0}, False),
    ({"kind": TrajectoryKind.TRAPEZOID, "target_rad": 1.0, "speed_radps": 1.0, "acceleration_radps2": math.nan}, False),
    ({"kind": TrajectoryKind.TABLE, "table_rows": 7}, True),
    ({"kind": TrajectoryKind.TABLE, "table_rows": 6}, False),
    ({"kind": TrajectoryKind.TABLE, "table_rows": 8}, False),
    ({"kind": 9}, False),
]  # fmt: skip


@pytest.mark.parametrize(("fields", "allowed"), TRAJECTORIES)
def test_motions_against_the_limits(rig: NewRig, fields: dict[str, float], allowed: bool) -> None:
    """Limits of the rig: +-1 rad, 10 rad/s."""
    trajectory = new(TrajectoryConstants)[0]
    for name, value in fields.items():
        setattr(trajectory, name, value)
    assert bool(trajectory_allowed(rig(0.0).axis.limits, trajectory, 7)) is allowed


def test_a_motion_outside_of_the_limits_is_refused_and_the_old_one_goes_on(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    before = float(run.state.trajectory_s)
    assert answered(run, hold(run, 1.01)) is ChangeAnswer.MOTION_LIMIT
    assert run.state.trajectory_s == pytest.approx(before + 1e-3)
    assert run.state.change.motion == MotionChange.NONE


def test_the_time_of_a_move_keeps_both_limits(rig: NewRig) -> None:
    change = live(rig(0.0)).axis.change
    u = np.linspace(0.0, 1.0, 10_001)
    speed, acceleration = 30 * u**2 * (1 - u) ** 2, 60 * u - 180 * u**2 + 120 * u**3
    for distance in (1e-6, 0.01, 0.3, -2.0, 50.0):
        duration = move_duration_s(change, distance)
        assert abs(distance) * speed.max() / duration <= 2.0 * (1 + 1e-6)
        assert abs(distance) * np.abs(acceleration).max() / duration**2 <= 20.0 * (1 + 1e-6)
        assert duration >= 0.05


def test_what_was_integrated_keeps_its_torque(rig: NewRig) -> None:
    run = live(rig(0.0))
    law, state, gains = run.axis.law, run.state.law, new(Gains)[0]
    law.kind, law.ki, law.observer.bandwidth_radps = ControllerKind.PID, 1000.0, 50.0
    state.integral_rads, state.observer.disturbance_Nm, state.observer.integral_Nms = 0.01, 7.0, 7.0 / 50.0 + 0.3
    gains_of(law, gains)
    gains.ki, gains.observer_radps = 2000.0, 80.0
    set_gains(run.axis.change, law, state, gains)
    assert law.ki * state.integral_rads == pytest.approx(10.0)
    assert law.observer.bandwidth_radps * (state.observer.integral_Nms - 0.3) == pytest.approx(7.0)
