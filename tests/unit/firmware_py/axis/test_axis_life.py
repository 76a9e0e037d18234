"""The life of a run of one axis: from standstill to the end, by itself or on request, and only ever forward."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.records import AxisState, Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import (
    AxisPhase,
    DriveRequest,
    DriveState,
    Fault,
    FeedForward,
    Notice,
    Reaction,
    StopRequest,
)
from tests.axis_on_stub_joint import POWERED, NewRig, finish, step_axis


# --- the regular life of a run ---
@pytest.mark.parametrize("start_rad", [-0.9, -0.3, 0.0, 0.31, 0.95])
@pytest.mark.parametrize("matched", [0, 1])
def test_a_whole_run_wherever_the_joint_stands(rig: NewRig, start_rad: float, matched: int) -> None:
    run = rig(start_rad)
    run.axis.law.filtered_error_rate = matched
    run.axis.trajectory.duration_s = 0.3
    run.axis.sequence.approach_s = 0.5
    run.until(AxisPhase.APPROACH)
    assert run.joint.position_rad == start_rad
    assert run.state.reference.position_rad == pytest.approx(start_rad, abs=1e-12)
    assert abs(run.torques_Nm[-1]) < 0.2  # the initial weights, nothing else: no jump
    references = []
    while run.phase <= AxisPhase.TRACKING:
        run.tick()
        references.append(float(run.state.reference.position_rad))
        assert abs(run.joint.position_rad - references[-1]) < 0.02
    # the reference is smooth through the hand-over to the trajectory: second differences are accelerations
    assert np.max(np.abs(np.diff(references[:-1], 2))) / 1e-6 < 60.0
    finish(run)
    assert run.state.fault == Fault.NONE
    assert run.joint.drive_state is DriveState.OFF
    assert run.phases.count(AxisPhase.APPROACH) == pytest.approx(500, abs=1)
    assert run.phases.count(AxisPhase.TRACKING) == pytest.approx(300, abs=1)


def test_the_trajectory_begins_where_the_approach_ends(rig: NewRig) -> None:
    run = rig(0.05).until(AxisPhase.TRACKING)
    assert run.state.trajectory_s == pytest.approx(0.0, abs=1.001e-3)
    for _ in range(20):
        angle = 0.2 * math.pi * run.state.trajectory_s
        assert run.state.reference.position_rad == pytest.approx(0.35 * math.sin(angle), abs=1e-12)
        assert run.state.reference.velocity_radps == pytest.approx(0.35 * 0.2 * math.pi * math.cos(angle), abs=1e-12)
        run.tick()


def test_a_sample_taken_late_is_brought_back_to_its_slot(rig: NewRig) -> None:
    """A loop that wakes up late by a different time in every cycle sees neither error nor speed that are not there."""
    late_s = 1e-6 * np.random.default_rng(1).uniform(0.0, 900.0, 300)
    errors = []
    for told in (True, False):
        run = rig(0.0).until(AxisPhase.TRACKING).run(50)
        worst_rad = worst_radps = 0.0
        for k, late in enumerate(late_s):
            # the joint is where the reference will be in this cycle, and moves on until SYNC comes
            angle = 0.2 * math.pi * (run.state.trajectory_s + 1e-3)
            velocity_radps = 0.35 * 0.2 * math.pi * math.cos(angle)
            run.joint.position_rad, run.joint.velocity_radps = 0.35 * math.sin(angle), 0.0
            run.state.sample_late_s = late if told else 0.0
            run.sample.position_rad = run.joint.position_rad + velocity_radps * late
            run.sample.count += 1
            step_axis(run.axis, run.state, run.table, run.sample, run.command, 1, 0, 0)
            assert run.phase is AxisPhase.TRACKING
            if k < 100:  # the filter forgets how the joint got here
                continue
            worst_rad = max(worst_rad, abs(run.state.measured_position_rad - run.state.reference.position_rad))
            worst_radps = max(worst_radps, abs(run.state.velocity.error_rate_radps))
        errors.append((worst_rad, worst_radps))
    (told_rad, told_radps), (untold_rad, untold_radps) = errors
    assert told_rad < 1e-9
    assert told_radps < 1e-5
    assert untold_rad > 1e-4
    assert untold_radps > 0.02


def test_release_is_a_straight_line_to_zero(rig: NewRig) -> None:
    run = rig(0.0)
    run.axis.law.gravity_Nm, run.axis.law.gravity_zero_rad = 12.0, -math.pi / 2.0
    run.joint.load_Nm = 0.0
    run.until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.until(AxisPhase.RELEASING)
    run.until(AxisPhase.DISABLING)
    released = [t for p, t in zip(run.phases, run.torques_Nm, strict=True) if p is AxisPhase.RELEASING]
    assert len(released) == 10
    np.testing.assert_allclose(np.diff(released), released[1] - released[0], rtol=1e-9)
    assert run.torques_Nm[-1] == 0.0


@pytest.mark.parametrize(("load_Nm", "notices"), [(0.0, 0), (100.0, Notice.SANK)])
def test_a_load_that_friction_does_not_hold_is_no_fault_of_a_stop(rig: NewRig, load_Nm: float, notices: int) -> None:
    """The drive brakes it before the power goes off, and the run has ended as it was asked to."""
    run = rig(0.0)
    run.axis.sequence.release_s = 0.2
    run.until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.until(AxisPhase.RELEASING)
    run.joint.load_Nm = load_Nm
    stood_rad = run.joint.position_rad
    while run.phase is AxisPhase.RELEASING:
        run.tick()
    assert run.phase == (AxisPhase.QUICK_STOPPING if notices else AxisPhase.DISABLING)
    assert abs(run.joint.position_rad - stood_rad) < 0.3 * run.axis.limits.following_error_max_rad
    run.joint.load_Nm = 0.0
    finish(run)
    assert (run.state.fault, run.state.notices) == (Fault.NONE, notices)


def test_ramp_decelerates_as_configured(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    run.stop = StopRequest.RAMP
    speeds = [run.state.reference.velocity_radps]
    while run.phase <= AxisPhase.RAMPING:
        run.tick()
        speeds.append(float(run.state.reference.velocity_radps))
    assert speeds[0] == pytest.approx(0.35 * 0.2 * math.pi, rel=0.01)
    assert speeds[-1] == 0.0
    assert np.diff(speeds).min() == pytest.approx(-20.0 * 1e-3)


@pytest.mark.parametrize("feed_forward", FeedForward)
def test_every_feed_forward_runs(rig: NewRig, feed_forward: FeedForward) -> None:
    run = rig(0.0)
    run.axis.law.feed_forward = feed_forward
    run.axis.limits.saturation_max_cycles = 10_000
    run.until(AxisPhase.TRACKING).run(10)
    assert abs(run.state.law.friction_torque_Nm) > 10.0 or feed_forward is FeedForward.NONE


# --- stop requests ---
def test_a_stop_request_that_is_withdrawn_is_still_carried_out(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.tick()
    run.stop = StopRequest.NONE
    finish(run)


# --- properties over anything that a bus may deliver ---
one_cycle = st.tuples(
    st.integers(0, 9).map(lambda n: max(n, 1) if n < 9 else 12),  # elapsed cycles
    st.booleans(),  # a new sample?
    st.one_of(st.just(0.0), st.floats(-0.01, 0.01), st.sampled_from([math.nan, math.inf, 5.0])),  # position step
    st.one_of(st.none(), st.sampled_from(DriveState)),  # a drive state of its own, or that of a good drive
    st.sampled_from([0] * 8 + [1, 2, 3]),  # stop request
    st.sampled_from([0] * 8 + [10, 11]),  # age of the supervisor
    st.sampled_from([0] * 20 + [1]),  # restart
)


def good_answer(request_: int, state: int) -> int:
    """What a good drive says next."""
    if request_ == DriveRequest.ENABLE:
        return {DriveState.OFF: DriveState.STARTING}.get(DriveState(state), DriveState.ENABLED)
    return DriveState.OFF if request_ == DriveRequest.OFF else DriveState.STOPPING


@pytest.mark.filterwarnings("ignore:.*encountered in scalar:RuntimeWarning")  # plain Python tells of inf - inf
# the fixture is a class: nothing is shared between examples
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(good_cycles=st.integers(0, 60), cycles=st.lists(one_cycle, min_size=1, max_size=60))
def test_whatever_comes_the_run_only_goes_forward(rig: NewRig, good_cycles: int, cycles: list[Any]) -> None:
    axis = rig().axis
    axis.sequence.approach_s = 0.02
    state, sample, command = new(AxisState)[0], new(Sample)[0], new(Command)[0]
    reset_axis(axis, state)
    table = np.zeros((1, 5))
    calm = (1, True, 0.0, None, 0, 0, 0)
    phase, fault, reaction, torque_Nm, stopped = AxisPhase.WAITING, Fault.NONE, Reaction.NONE, 0.0, False
    for elapsed, fresh, step_rad, drive_state, stop, age, restart in [calm] * good_cycles + cycles:
        if fresh:
            sample.count += 1
            sample.position_rad += step_rad
            sample.drive_state = (
                good_answer(int(command.request), int(sample.drive_state)) if drive_state is None else drive_state
            )
        sample.restarts += restart
        step_axis(axis, state, table, sample, command, elapsed, stop, age)
        assert state.phase >= phase
        assert state.reaction >= reaction
        if fault != Fault.NONE:
            assert state.fault == fault
        if stopped:
            assert command.request != DriveRequest.ENABLE
        stopped = stopped or (phase >= AxisPhase.ENABLING and command.request != DriveRequest.ENABLE)
        assert math.isfinite(command.torque_Nm)
        assert abs(command.torque_Nm) <= 60.0
        if state.phase not in POWERED:
            assert command.torque_Nm == 0.0
        else:
            assert abs(command.torque_Nm - torque_Nm) <= 20.0 + 1e-9
            assert fresh or state.sample_age_cycles <= 5
        if state.fault != Fault.NONE:
            assert state.reaction != Reaction.NONE
        phase, fault, reaction, torque_Nm = int(state.phase), int(state.fault), int(state.reaction), command.torque_Nm
