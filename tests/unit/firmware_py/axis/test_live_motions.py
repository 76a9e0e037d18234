"""Set points and trajectories while the joint moves: by way of rest, inside speed and limits, stopped from anywhere."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from jointctl.firmware_py import live_change
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.live_change import move_duration_s, trajectory_allowed
from jointctl.firmware_py.motion_records import ChangeAnswer, ChangeKind, MotionChange, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest, TrajectoryKind
from tests.axis_on_stub_joint import NewRig
from tests.unit.firmware_py.axis.live_axis import answered, hold, live, post


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


@pytest.mark.parametrize("limit_rad", [-1.0, 1.0])
def test_a_set_point_may_be_a_limit_itself(rig: NewRig, limit_rad: float) -> None:
    run = live(rig(0.0))
    assert (run.axis.limits.position_min_rad, run.axis.limits.position_max_rad) == (-1.0, 1.0)
    run.until(AxisPhase.TRACKING).run(50)
    assert answered(run, hold(run, limit_rad)) is ChangeAnswer.TAKEN
    while run.state.change.motion != MotionChange.NONE and run.phase is AxisPhase.TRACKING:
        run.tick()
    assert run.state.fault == Fault.NONE
    assert run.state.reference.position_rad == limit_rad


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
    while run.state.change.motion != MotionChange.NONE:
        run.tick()
    run.run(10)
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


def test_a_change_has_come_to_its_end_when_the_new_motion_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that waits for its motion reads both in another process, at any moment."""
    constants = SimpleNamespace(trajectory="before")

    class Change(SimpleNamespace):
        def __setattr__(self, name: str, value: object) -> None:
            assert (name, value, constants.trajectory) == ("motion", MotionChange.NONE, "new")
            super().__setattr__(name, value)

    change = Change(motion=MotionChange.MOVING, next_trajectory="new")
    state = SimpleNamespace(change=change, trajectory_s=0.0, reference=None, law=SimpleNamespace(learning=None))
    for name in ("reset_learning", "reference_at"):
        monkeypatch.setattr(live_change, name, lambda *_: 0)
    plain(live_change.step_new_motion)(constants, state, np.zeros((0, 5)), 1)
    assert change.motion == MotionChange.NONE


def test_an_overrun_on_the_way_loses_no_time(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    answered(run, hold(run, -0.3))
    run.axis.limits.skipped_max_cycles = 1 << 40  # one after the other, as no run may have them
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
    ({"kind": TrajectoryKind.TABLE, "table_rows": 2}, True),
    ({"kind": TrajectoryKind.TABLE, "table_rows": 1}, False),
    ({"kind": TrajectoryKind.TABLE, "table_rows": 8}, False),
    ({"kind": TrajectoryKind.STREAM, "start_rad": 1.0}, True),
    ({"kind": TrajectoryKind.STREAM, "start_rad": 1.001}, False),
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
