"""One axis on a stub joint: the life of a run, every way to end it, and what must never happen."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from firmware_py.axis import step_axis
from firmware_py.records import LINE_GONE, AxisState, Command, Sample
from firmware_py.schema import new
from firmware_py.sequence import reset_axis
from firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, FeedForward, Reaction, StopRequest

NewRig = Callable[..., Any]
POWERED = (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING)


def assert_safe_history(run: Any) -> None:
    """Forward only, never enabled again, torque only while powered."""
    assert run.phases == sorted(run.phases)
    first_other = next((i for i, r in enumerate(run.requests) if r is not DriveRequest.OFF), len(run.requests))
    enabled = [r is DriveRequest.ENABLE for r in run.requests[first_other:]]
    assert enabled == sorted(enabled, reverse=True)
    assert all(torque == 0.0 for phase, torque in zip(run.phases, run.torques_Nm, strict=True) if phase not in POWERED)


def finish(run: Any) -> Any:
    run.until(AxisPhase.FINISHED)
    assert_safe_history(run)
    return run


# --- the regular life of a run ---------------------------------------------------------------------------------


@pytest.mark.parametrize("start_rad", [-0.9, -0.3, 0.0, 0.31, 0.95])
@pytest.mark.parametrize("matched", [0, 1])
def test_a_whole_run_wherever_the_joint_stands(rig: NewRig, start_rad: float, matched: int) -> None:
    run = rig(start_rad)
    run.axis.law.matched_filter = matched
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


# --- stop requests ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [p for p in AxisPhase if p < AxisPhase.DISABLING])
@pytest.mark.parametrize("request_", [StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF])
def test_stop_request_in_each_phase(rig: NewRig, phase: AxisPhase, request_: StopRequest) -> None:
    run = rig(0.05)
    if phase is AxisPhase.RAMPING or phase is AxisPhase.RELEASING:
        run.until(AxisPhase.TRACKING).run(5)
        run.stop = StopRequest.RAMP
    elif phase is AxisPhase.QUICK_STOPPING:
        run.until(AxisPhase.TRACKING).run(5)
        run.stop = StopRequest.QUICK_STOP
    run.until(phase)
    run.stop = request_
    run.tick()
    if phase <= AxisPhase.ENABLING or request_ is StopRequest.OFF:
        assert run.phase == AxisPhase.DISABLING
        assert run.requests[-1] == DriveRequest.OFF
    elif request_ is StopRequest.QUICK_STOP:
        assert run.phase == max(phase, AxisPhase.QUICK_STOPPING)
        assert run.requests[-1] == DriveRequest.QUICK_STOP
    else:
        assert run.phase == max(phase, AxisPhase.RAMPING)
    finish(run)
    assert run.state.fault == Fault.NONE


def test_a_stop_request_that_is_withdrawn_is_still_carried_out(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.tick()
    run.stop = StopRequest.NONE
    finish(run)


# --- faults, each with a twin just inside the limit ------------------------------------------------------------


def assert_fault(run: Any, fault: Fault, reaction: Reaction) -> None:
    assert (Fault(int(run.state.fault)), Reaction(int(run.state.reaction))) == (fault, reaction)
    run.joint.load_Nm = 0.0
    finish(run)
    assert run.state.fault == fault


def assert_well(run: Any) -> None:
    assert run.state.fault == Fault.NONE
    assert run.phase == AxisPhase.TRACKING


@pytest.mark.parametrize(("missing", "trips"), [(1, False), (5, False), (6, True)])
def test_stale_sample(rig: NewRig, missing: int, trips: bool) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    for _ in range(missing):
        run.tick(fresh=False)
    if trips:
        assert run.phase == AxisPhase.QUICK_STOPPING
        assert run.state.fault_value == 6.0
        assert_fault(run, Fault.STALE_SAMPLE, Reaction.QUICK_STOP)
    else:
        run.run(20)
        assert_well(run)


def test_missing_samples_are_bridged_by_the_velocity(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(100)
    for _ in range(5):
        run.tick(fresh=False)
        assert run.state.measured_position_rad == pytest.approx(run.joint.position_rad, abs=5e-6)
    torque_before = run.torques_Nm[-6]
    run.run(10)
    assert np.max(np.abs(np.array(run.torques_Nm[-15:]) - torque_before)) < 0.5
    assert_well(run)


@pytest.mark.parametrize("phase", [AxisPhase.ENABLING, AxisPhase.APPROACH, AxisPhase.TRACKING])
@pytest.mark.parametrize(("age_cycles", "trips"), [(10, False), (11, True)])
def test_supervisor_lost(rig: NewRig, phase: AxisPhase, age_cycles: int, trips: bool) -> None:
    run = rig(0.0).until(phase)
    run.supervisor_age_cycles = age_cycles
    run.tick()
    if trips:
        reaction = Reaction.OFF if phase is AxisPhase.ENABLING else Reaction.RAMP
        assert_fault(run, Fault.SUPERVISOR_LOST, reaction)
    else:
        run.supervisor_age_cycles = 0
        run.until(AxisPhase.TRACKING)
        assert_well(run)


def test_a_run_without_supervision_does_not_look_for_it(rig: NewRig) -> None:
    run = rig(0.0)
    run.axis.sequence.supervisor_max_cycles = 0
    run.supervisor_age_cycles = 10**12
    assert_well(run.until(AxisPhase.TRACKING).run(5))


@pytest.mark.parametrize(("skipped", "trips"), [(1, False), (8, False), (9, True)])
def test_overrun(rig: NewRig, skipped: int, trips: bool) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    run.tick(skipped + 1)
    if trips:
        assert run.phase == AxisPhase.RAMPING
        assert run.state.fault_value == skipped
        assert_fault(run, Fault.OVERRUN, Reaction.RAMP)
    else:
        run.run(20)
        assert_well(run)


@pytest.mark.parametrize("matched", [0, 1])
def test_after_an_overrun_the_reference_is_that_of_now(rig: NewRig, matched: int) -> None:
    """The twin without an overrun has the same reference at the same time, and the torque does not kick."""
    run, twin = rig(0.0), rig(0.0)
    for one in (run, twin):
        one.axis.law.matched_filter = matched
        one.until(AxisPhase.TRACKING).run(50)
    run.tick(8)
    twin.run(8)
    for _ in range(3):
        assert run.state.reference.position_rad == pytest.approx(twin.state.reference.position_rad, abs=1e-12)
        assert run.state.trajectory_s == pytest.approx(twin.state.trajectory_s, abs=1e-12)
        assert abs(run.torques_Nm[-1] - twin.torques_Nm[-1]) < 2.0
        run.tick()
        twin.tick()


def test_an_overrun_while_braking_brakes_on(rig: NewRig) -> None:
    run, twin = rig(0.0), rig(0.0)
    for one in (run, twin):
        one.axis.sequence.brake_radps2 = 5.0
        one.until(AxisPhase.TRACKING).run(20)
        one.stop = StopRequest.RAMP
        one.run(5)
    run.tick(8)
    twin.run(8)
    assert run.state.reference.velocity_radps == pytest.approx(twin.state.reference.velocity_radps, abs=1e-12)
    assert run.state.reference.position_rad == pytest.approx(twin.state.reference.position_rad, abs=1e-12)
    finish(run)


@pytest.mark.parametrize("drive_state", [DriveState.FAULT, DriveState.FAULT_BRAKING])
@pytest.mark.parametrize("phase", [p for p in AxisPhase if p < AxisPhase.DISABLING and p != AxisPhase.QUICK_STOPPING])
def test_drive_fault_in_each_phase(rig: NewRig, phase: AxisPhase, drive_state: DriveState) -> None:
    run = rig(0.05)
    if phase in (AxisPhase.RAMPING, AxisPhase.RELEASING):
        run.until(AxisPhase.TRACKING).run(5)
        run.stop = StopRequest.RAMP
    run.until(phase)
    run.joint.drive_state = drive_state
    run.sample.drive_error, run.sample.status_word = 0x8311, 0x0218
    run.tick()
    assert run.phase == AxisPhase.DISABLING
    assert run.state.fault_drive_error == 0x8311
    run.joint.drive_state = DriveState.FAULT
    assert_fault(run, Fault.DRIVE_FAULT, Reaction.OFF)


def test_its_twin_a_warning_of_the_drive_is_no_fault(rig: NewRig) -> None:
    """An EMCY code and the warning bit (7) of the statusword, while the drive stays enabled."""
    run = rig(0.05).until(AxisPhase.TRACKING)
    run.sample.drive_error, run.sample.status_word = 0x4210, 0x12B7
    run.run(20)
    assert_well(run)
    assert run.state.fault_drive_error == 0


@pytest.mark.parametrize("cleared_before", [False, True])
def test_the_encoders_error_of_the_first_fault_is_kept(rig: NewRig, cleared_before: bool) -> None:
    run = rig(0.05).until(AxisPhase.TRACKING)
    run.sample.encoder_error = 0x5000
    run.tick()
    if cleared_before:
        run.sample.encoder_error = 0
    run.joint.drive_state = DriveState.FAULT
    run.tick()
    assert run.state.fault == Fault.DRIVE_FAULT
    run.sample.encoder_error = 0x7300
    run.tick()
    assert run.state.fault_encoder_error == (0 if cleared_before else 0x5000)
    reset_axis(run.axis, run.state)
    assert run.state.fault_encoder_error == 0


def test_a_restart_before_the_first_cycle_ends_the_run_without_power(rig: NewRig) -> None:
    """It was taken for one from before the run: a drive without its limits would have been enabled."""
    run, twin = rig(0.0), rig(0.0)
    run.sample.restarts = 1
    run.tick()
    assert_fault(run, Fault.DRIVE_RESTARTED, Reaction.OFF)
    assert set(run.requests) == {DriveRequest.OFF}
    twin.tick()
    assert twin.until(AxisPhase.TRACKING).state.fault == Fault.NONE


@pytest.mark.parametrize("phase", [AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING])
def test_a_drive_that_brakes_by_itself_is_left_braking(rig: NewRig, phase: AxisPhase) -> None:
    """Power off would make it coast; at standstill, or after the time for a stop, it is switched off."""
    run = rig(0.05)
    if phase >= AxisPhase.RAMPING:
        run.until(AxisPhase.TRACKING).run(5)
        run.stop = StopRequest.RAMP
    run.until(phase)
    before = len(run.requests)
    run.joint.drive_state, run.joint.delay_cycles = DriveState.STOPPING, 50
    run.run(40)
    assert run.phase == AxisPhase.QUICK_STOPPING
    assert set(run.requests[before:]) == {DriveRequest.QUICK_STOP}
    assert set(run.torques_Nm[before:]) == {0.0}
    run.joint.drive_state = DriveState.OFF
    assert_fault(run, Fault.DRIVE_NOT_ENABLED, Reaction.QUICK_STOP)


def test_a_drive_that_brakes_for_ever_is_switched_off(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.joint.drive_state, run.joint.delay_cycles = DriveState.STOPPING, 1000
    run.run(int(run.axis.sequence.stop_max_cycles) + 2)
    assert run.requests[-1] == DriveRequest.OFF
    run.joint.drive_state = DriveState.OFF
    assert_fault(run, Fault.DRIVE_NOT_ENABLED, Reaction.OFF)


@pytest.mark.parametrize("drive_state", [DriveState.OFF, DriveState.STARTING, DriveState.UNKNOWN])
def test_a_drive_that_leaves_enabled_unasked_is_switched_off_and_not_enabled_again(
    rig: NewRig, drive_state: DriveState
) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.joint.drive_state = drive_state
    run.joint.delay_cycles = 100  # it stays there for a while
    run.tick()
    assert run.phase == AxisPhase.DISABLING
    assert (run.requests[-1], run.torques_Nm[-1]) == (DriveRequest.OFF, 0.0)
    run.joint.drive_state = DriveState.OFF
    assert_fault(run, Fault.DRIVE_NOT_ENABLED, Reaction.OFF)


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING, AxisPhase.APPROACH, AxisPhase.TRACKING])
def test_drive_restart(rig: NewRig, phase: AxisPhase) -> None:
    run = rig(0.0)
    run.tick()
    run.until(phase)
    assert run.state.fault == Fault.NONE
    run.sample.restarts = 1
    run.tick()
    assert_fault(run, Fault.DRIVE_RESTARTED, Reaction.OFF)


@pytest.mark.parametrize(("delay_cycles", "trips"), [(10, False), (20, True)])
def test_enable_timeout(rig: NewRig, delay_cycles: int, trips: bool) -> None:
    run = rig(0.0)
    run.joint.delay_cycles = delay_cycles  # two steps: 20 or 40 cycles, 30 are allowed
    run.until(AxisPhase.ENABLING).run(45)
    run.joint.delay_cycles = 2
    if trips:
        assert_fault(run, Fault.ENABLE_TIMEOUT, Reaction.OFF)
    else:
        assert run.state.fault == Fault.NONE
        assert run.phase == AxisPhase.APPROACH


@pytest.mark.parametrize(("delay_cycles", "trips"), [(19, False), (30, True)])
def test_off_timeout(rig: NewRig, delay_cycles: int, trips: bool) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.joint.delay_cycles = delay_cycles
    run.stop = StopRequest.OFF
    finish(run)
    assert run.state.fault == (Fault.OFF_TIMEOUT if trips else Fault.NONE)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("gap_cycles", [1, 2, 4])
@pytest.mark.parametrize("trips", [False, True])
def test_position_jump_scales_with_the_gap(rig: NewRig, sign: float, gap_cycles: int, trips: bool) -> None:
    run = rig(0.0)
    run.axis.trajectory.amplitude_rad = 0.0
    run.axis.limits.velocity_max_radps = 1e3  # only the jump is looked at
    run.until(AxisPhase.TRACKING).run(20)
    for _ in range(gap_cycles - 1):
        run.tick(fresh=False)
    moved_rad = 0.02 * gap_cycles * (1.001 if trips else 0.999)
    run.tick(offset_rad=run.state.velocity.last_position_rad - run.joint.position_rad + sign * moved_rad)
    if trips:
        assert run.state.fault_value == pytest.approx(moved_rad)
        assert_fault(run, Fault.POSITION_JUMP, Reaction.QUICK_STOP)
    else:
        assert run.state.fault == Fault.NONE


def test_a_jump_after_an_overrun_is_measured_per_period_too(rig: NewRig) -> None:
    run = rig(0.0)
    run.axis.trajectory.amplitude_rad = 0.0
    run.axis.limits.velocity_max_radps = 1e3
    run.until(AxisPhase.TRACKING).run(20)
    run.tick(4, offset_rad=0.079)
    assert run.state.fault == Fault.NONE


@pytest.mark.parametrize(("position_rad", "fault"), [(0.999, Fault.NONE), (1.001, Fault.POSITION_LIMIT)])
def test_position_limit(rig: NewRig, position_rad: float, fault: Fault) -> None:
    run = rig(0.9)
    run.axis.trajectory.amplitude_rad, run.axis.trajectory.offset_rad = 0.0, 0.99
    run.until(AxisPhase.TRACKING).run(5)
    run.tick(offset_rad=position_rad - run.joint.position_rad)  # the joint moves by less than 2e-5 rad
    if fault:
        assert run.state.fault_value == run.sample.position_rad > 1.0
        assert_fault(run, fault, Reaction.QUICK_STOP)
    else:
        assert_well(run)


def test_a_reference_that_will_leave_the_limits_is_braked_inside_them(rig: NewRig) -> None:
    run = rig(0.0)
    run.axis.trajectory.amplitude_rad, run.axis.trajectory.omega_radps = 1.5, 1.0
    run.axis.sequence.approach_s = 1.0
    run.until(AxisPhase.TRACKING).run(20)
    assert_well(run)  # the twin: the same trajectory while it is inside
    while run.phase == AxisPhase.TRACKING:
        run.tick()
    assert run.phase == AxisPhase.RAMPING
    assert run.state.reaction == Reaction.RAMP
    run.until(AxisPhase.RELEASING, at_most=400)
    assert 0.99 < run.state.reference.position_rad <= 1.0
    assert_fault(run, Fault.REFERENCE_LIMIT, Reaction.RAMP)


@pytest.mark.parametrize(("apart_rad", "trips"), [(0.0101, True), (-0.0101, True), (0.0099, False), (-0.0099, False)])
@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.APPROACH, AxisPhase.TRACKING])
def test_the_other_encoder(rig: NewRig, phase: AxisPhase, apart_rad: float, trips: bool) -> None:
    run = rig(0.05)
    run.axis.limits.disagreement_max_rad = 0.01
    run.until(phase).run(2)
    assert run.state.fault == Fault.NONE
    run.twin_rad = apart_rad
    run.run(5)
    if trips:
        assert run.state.fault_value == pytest.approx(apart_rad)
        assert_fault(
            run, Fault.POSITION_DISAGREEMENT, Reaction.OFF if phase is AxisPhase.WAITING else Reaction.QUICK_STOP
        )
    else:
        assert run.state.fault == Fault.NONE


@pytest.mark.parametrize(("source", "fault"), [(0, Fault.NONE), (1, Fault.POSITION_LIMIT), (2, Fault.POSITION_LIMIT)])
def test_the_limits_see_the_encoder_that_they_are_told(rig: NewRig, source: int, fault: Fault) -> None:
    run = rig(0.05)
    run.axis.limits.disagreement_max_rad = 0.9
    run.axis.limits.limit_source = source
    run.until(AxisPhase.TRACKING).run(5)
    run.twin_rad = 0.899  # of limits -1 .. 1; the joint is between 0 and 0.1
    run.run(5)
    assert_well(run)
    run.axis.limits.position_max_rad = 0.8
    run.tick()
    if fault is Fault.NONE:
        assert_well(run)
    else:
        assert run.state.fault_value > 0.8
        assert_fault(run, fault, Reaction.QUICK_STOP)


@pytest.mark.parametrize(("limit_rad", "trips"), [(0.0040, True), (0.0100, False)])
def test_following_error(rig: NewRig, limit_rad: float, trips: bool) -> None:
    run = rig(0.0)
    run.axis.law.kind = 0  # without the network a constant load leaves load / (J kp) = 6.07 mrad
    run.axis.limits.following_error_max_rad = limit_rad
    run.until(AxisPhase.TRACKING).run(20)
    run.joint.load_Nm = 10.0
    run.run(150)
    if trips:
        assert run.state.fault_value > limit_rad
        assert_fault(run, Fault.FOLLOWING_ERROR, Reaction.QUICK_STOP)
    else:
        assert_well(run)


def disturbed(rig: NewRig) -> Any:
    """A run that tracks, and then reads one position 5 mrad off: a short peak of velocity and of following error."""
    return rig(0.0).until(AxisPhase.TRACKING).run(20)


@pytest.mark.parametrize("offset_rad", [-0.005, 0.005])
@pytest.mark.parametrize(("past", "trips"), [(-1e-9, False), (0.0, False), (1e-9, True)])
@pytest.mark.parametrize("fault", [Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR])
def test_velocity_and_following_error_are_dense_at_their_limits(
    rig: NewRig, fault: Fault, offset_rad: float, past: float, trips: bool
) -> None:
    """The run is the same each time, so that its first peak is known to the last bit: the limit is put beside it."""
    scout = disturbed(rig)
    scout.tick(offset_rad=offset_rad)
    run = disturbed(rig)
    if fault is Fault.VELOCITY_LIMIT:
        peak = float(scout.state.velocity.velocity_radps)
        run.axis.limits.velocity_max_radps = abs(peak) * (1.0 - past)
    else:
        peak = float(scout.state.measured_position_rad - scout.state.reference.position_rad)
        run.axis.limits.following_error_max_rad = abs(peak) * (1.0 - past)
    assert peak * offset_rad > 0.0
    run.tick(offset_rad=offset_rad)
    if trips:
        assert run.state.fault_value == peak
        assert (run.torques_Nm[-1], run.requests[-1]) == (0.0, DriveRequest.QUICK_STOP)
        assert_fault(run, fault, Reaction.QUICK_STOP)
    else:
        assert_well(run)


@pytest.mark.parametrize(("blocked_cycles", "trips"), [(20, False), (21, True)])
def test_saturation(rig: NewRig, blocked_cycles: int, trips: bool) -> None:
    run = rig(0.0)
    run.axis.limits.torque_rate_max_Nmps = 1e9
    run.until(AxisPhase.TRACKING).run(20)
    for _ in range(blocked_cycles):
        run.axis.law.gravity_Nm, run.axis.law.gravity_zero_rad = 1e4, -math.pi / 2.0
        run.joint.load_Nm = -run.command.torque_Nm
        run.tick()
        assert abs(run.state.unlimited_torque_Nm) > 60.0
    if trips:
        assert_fault(run, Fault.TORQUE_SATURATED, Reaction.QUICK_STOP)
    else:
        assert run.torques_Nm[-1] == 60.0
        run.axis.law.gravity_Nm = run.joint.load_Nm = 0.0
        run.tick()
        assert run.state.saturated_cycles == 19  # forgotten as slowly as it came
        assert run.state.fault == Fault.NONE


@pytest.mark.parametrize(("free_every", "trips"), [(2, False), (3, True)])
def test_a_torque_that_jumps_from_limit_to_limit_is_saturated_all_the_same(
    rig: NewRig, free_every: int, trips: bool
) -> None:
    """At the limit in half of the cycles, and in two thirds of them, with the sign changing each time."""
    run = rig(0.0)
    run.axis.limits.torque_rate_max_Nmps = 1e9
    run.until(AxisPhase.TRACKING).run(20)
    for cycle in range(90):
        free = cycle % free_every == 0
        run.axis.law.gravity_Nm = 0.0 if free else 1e4 * (-1.0) ** cycle
        run.axis.law.gravity_zero_rad = -math.pi / 2.0
        run.joint.load_Nm = -run.command.torque_Nm
        run.tick()
        if run.state.fault != Fault.NONE:
            break
    assert (run.state.fault == Fault.TORQUE_SATURATED) == trips
    assert run.state.fault in (Fault.NONE, Fault.TORQUE_SATURATED)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_law_that_is_not_finite_sends_zero_and_stops(rig: NewRig, value: float) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    run.state.law.network.weights[3] = value
    run.tick()
    assert (run.torques_Nm[-1], run.requests[-1]) == (0.0, DriveRequest.QUICK_STOP)
    assert_fault(run, Fault.NOT_FINITE, Reaction.QUICK_STOP)


def test_its_twin_a_law_of_an_enormous_but_finite_torque_is_limited(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    before_Nm = run.torques_Nm[-1]
    run.state.law.network.weights[3] = 1e300
    run.tick()
    assert 1e290 < abs(run.state.unlimited_torque_Nm) < math.inf
    assert abs(run.torques_Nm[-1] - before_Nm) == pytest.approx(20.0)  # the rate limit
    assert_well(run)


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.TRACKING])
def test_a_position_that_is_not_a_number_stops(rig: NewRig, phase: AxisPhase) -> None:
    run = rig(0.0)
    run.tick()
    run.until(phase)
    run.tick(offset_rad=math.nan)
    assert run.torques_Nm[-1] == 0.0
    assert run.state.fault == Fault.POSITION_JUMP
    assert run.phase >= AxisPhase.QUICK_STOPPING


@pytest.mark.parametrize(("errors", "trips"), [(5, False), (6, True)])
def test_bus_errors(rig: NewRig, errors: int, trips: bool) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.sample.bus_errors = errors
    run.tick()
    if trips:
        assert_fault(run, Fault.BUS_ERROR, Reaction.QUICK_STOP)
    else:
        assert_well(run)


def test_without_a_line_the_run_ends_at_once(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.sample.bus_errors = LINE_GONE
    run.tick()
    assert_fault(run, Fault.BUS_ERROR, Reaction.QUICK_STOP)
    assert run.state.phase == AxisPhase.FINISHED


def test_with_a_line_that_only_fails_it_goes_on_stopping(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.sample.bus_errors = LINE_GONE - 1
    run.tick()
    assert run.state.phase == AxisPhase.QUICK_STOPPING


@pytest.mark.parametrize("moves", [True, False])
def test_stop_timeout(rig: NewRig, moves: bool) -> None:
    run = rig(0.0)
    run.until(AxisPhase.TRACKING).run(5)
    run.stop = StopRequest.RAMP
    for k in range(150):
        # an encoder that is noisier than standstill allows, or quiet
        run.tick(offset_rad=1e-3 * (-1.0) ** k if moves else 0.0)
    if moves:
        assert_fault(run, Fault.STOP_TIMEOUT, Reaction.QUICK_STOP)
    else:
        finish(run)
        assert run.state.fault == Fault.NONE


@pytest.mark.parametrize("missing_cycles", [0, 1])
def test_standstill_is_complete_in_the_last_cycle_or_one_too_late(rig: NewRig, missing_cycles: int) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.stop = StopRequest.RAMP
    run.until(AxisPhase.RAMPING)
    while run.state.still_cycles == 0:
        run.tick()
    assert run.phase == AxisPhase.RAMPING
    run.state.phase_cycle = run.axis.sequence.stop_max_cycles
    run.state.still_cycles = run.axis.sequence.settle_cycles - 1 - missing_cycles
    run.tick()
    if missing_cycles:
        assert_fault(run, Fault.STOP_TIMEOUT, Reaction.QUICK_STOP)
    else:
        assert (run.phase, run.state.fault) == (AxisPhase.RELEASING, Fault.NONE)


def test_a_lost_sample_while_the_joint_comes_to_rest_proves_nothing_either_way(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.stop = StopRequest.RAMP
    while run.state.still_cycles == 0:
        run.tick()
    counted = int(run.state.still_cycles)
    run.tick(fresh=False)
    assert (run.phase, run.state.still_cycles) == (AxisPhase.RAMPING, counted)
    run.tick()
    assert run.state.still_cycles == counted + 1


def test_no_samples_at_all(rig: NewRig) -> None:
    run = rig(0.0)
    for _ in range(80):
        run.tick(fresh=False)
    assert run.phase == AxisPhase.FINISHED
    assert run.state.fault == Fault.NO_SAMPLES
    assert set(run.requests) == {DriveRequest.OFF}


def test_a_moving_joint_is_not_enabled(rig: NewRig) -> None:
    run = rig(0.0)
    for k in range(80):
        run.tick(offset_rad=0.0005 * k)
    assert run.state.fault == Fault.NOT_AT_STANDSTILL
    assert set(run.requests) == {DriveRequest.OFF}


def test_samples_with_holes_are_not_enough_to_enable(rig: NewRig) -> None:
    run = rig(0.0)
    for k in range(80):
        run.tick(fresh=k % 4 != 0)
    assert run.state.fault == Fault.SAMPLES_MISSING
    assert set(run.requests) == {DriveRequest.OFF}


# --- properties over anything that a bus may deliver -----------------------------------------------------------

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
