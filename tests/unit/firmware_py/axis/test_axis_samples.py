"""Samples that an axis cannot believe or does not get: late, lost, jumping, at odds with the other encoder."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jointctl.firmware_py.observers import BRIDGED_CYCLES
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault, Reaction
from tests.axis_on_stub_joint import NewRig, assert_fault, assert_well


def test_missing_samples_are_bridged_by_the_velocity(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(100)
    for _ in range(5):
        run.tick(fresh=False)
        assert run.state.measured_position_rad == pytest.approx(run.joint.position_rad, abs=5e-6)
    torque_before = run.torques_Nm[-6]
    run.run(10)
    assert np.max(np.abs(np.array(run.torques_Nm[-15:]) - torque_before)) < 0.5
    assert_well(run)


def test_a_velocity_that_is_wrong_does_not_push_for_as_long_as_nothing_is_read(rig: NewRig) -> None:
    """The last one may be noise, or the answer to a swing that is over: it comes to that of the reference."""
    run = rig(0.0).until(AxisPhase.TRACKING).run(100)
    velocity, law = run.state.velocity, run.state.law.flexible
    run.axis.law.flexible.motor_velocity.period_s = run.axis.law.flexible.link_velocity.period_s = 1e-3
    for each in (velocity, law.motor_velocity, law.link_velocity):
        each.velocity_radps += 0.1
        each.error_rate_radps += 0.1
    wrong_Nm = []
    for cycle in range(60):
        if cycle == BRIDGED_CYCLES:  # a single lost sample takes no damping
            assert law.motor_velocity.error_rate_radps == pytest.approx(0.1)
        run.tick(fresh=False)
        wrong_Nm.append(abs(run.torques_Nm[-1]))
    assert velocity.velocity_radps == pytest.approx(run.state.reference.velocity_radps, abs=0.002)
    assert wrong_Nm[-1] < 0.3 * max(wrong_Nm)
    for each in (law.motor_velocity, law.link_velocity):
        assert each.velocity_radps == pytest.approx(run.state.reference.velocity_radps, abs=0.002)
        assert each.error_rate_radps == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize("overrun", [False, True])
@pytest.mark.parametrize(("moved_rad", "fault"), [(0.0799, Fault.NONE), (0.0801, Fault.POSITION_JUMP)])
def test_a_jump_is_measured_per_period_after_lost_samples_and_an_overrun(
    rig: NewRig, overrun: bool, moved_rad: float, fault: Fault
) -> None:
    run = rig(0.0)
    run.axis.trajectory.amplitude_rad = 0.0
    run.axis.limits.velocity_max_radps = 1e3  # only the jump is looked at
    run.until(AxisPhase.TRACKING).run(20)
    for _ in range(0 if overrun else 3):
        run.tick(fresh=False)
    offset_rad = run.state.velocity.last_position_rad - run.joint.position_rad + moved_rad
    run.tick(4 if overrun else 1, offset_rad=offset_rad)
    assert run.state.fault == fault


@pytest.mark.trips(Fault.POSITION_DISAGREEMENT, "(0.0101, True)")
@pytest.mark.stays(Fault.POSITION_DISAGREEMENT, "(0.0099, False)")
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


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.TRACKING])
def test_a_position_that_is_not_a_number_stops(rig: NewRig, phase: AxisPhase) -> None:
    run = rig(0.0)
    run.tick()
    run.until(phase)
    run.tick(offset_rad=math.nan)
    assert run.torques_Nm[-1] == 0.0
    assert run.state.fault == Fault.POSITION_JUMP
    assert run.phase >= AxisPhase.QUICK_STOPPING


@pytest.mark.parametrize(
    ("missing_every", "step_rad", "fault"),
    [(1, 0.0, Fault.NO_SAMPLES), (4, 0.0, Fault.SAMPLES_MISSING), (100, 0.0005, Fault.NOT_AT_STANDSTILL)],
)
def test_without_samples_or_with_holes_or_a_joint_that_moves_nothing_is_enabled(
    rig: NewRig, missing_every: int, step_rad: float, fault: Fault
) -> None:
    run = rig(0.0)
    for k in range(80):
        run.tick(fresh=k % missing_every != 0, offset_rad=step_rad * k)
    assert (run.phase, run.state.fault) == (AxisPhase.FINISHED, fault)
    assert set(run.requests) == {DriveRequest.OFF}
