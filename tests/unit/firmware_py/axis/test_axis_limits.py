"""Limits of position, velocity, reference, following error and torque, each with a twin just inside."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault, Reaction
from tests.axis_on_stub_joint import NewRig, assert_fault, assert_well


@pytest.mark.trips(Fault.POSITION_LIMIT, "(1.001, Fault.POSITION_LIMIT)")
@pytest.mark.stays(Fault.POSITION_LIMIT, "(0.999, Fault.NONE)")
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
    assert run.state.fault_drive_error == 0
    assert_fault(run, Fault.REFERENCE_LIMIT, Reaction.RAMP)


def disturbed(rig: NewRig) -> Any:
    """A run that tracks, and then reads one position 5 mrad off: a short peak of velocity and of following error."""
    return rig(0.0).until(AxisPhase.TRACKING).run(20)


@pytest.mark.trips(Fault.VELOCITY_LIMIT, "(1e-9, True)")
@pytest.mark.stays(Fault.VELOCITY_LIMIT, "(0.0, False)")
@pytest.mark.trips(Fault.FOLLOWING_ERROR, "(1e-9, True)")
@pytest.mark.stays(Fault.FOLLOWING_ERROR, "(0.0, False)")
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


@pytest.mark.trips(Fault.TORQUE_SATURATED, "(21, True)")
@pytest.mark.stays(Fault.TORQUE_SATURATED, "(20, False)")
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


@pytest.mark.trips(Fault.NOT_FINITE, "Fault.NOT_FINITE")
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_law_that_is_not_finite_sends_zero_and_stops(rig: NewRig, value: float) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    run.state.law.network.weights[3] = value
    run.tick()
    assert (run.torques_Nm[-1], run.requests[-1]) == (0.0, DriveRequest.QUICK_STOP)
    assert_fault(run, Fault.NOT_FINITE, Reaction.QUICK_STOP)


@pytest.mark.stays(Fault.NOT_FINITE, "1e300")
def test_its_twin_a_law_of_an_enormous_but_finite_torque_is_limited(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(20)
    before_Nm = run.torques_Nm[-1]
    run.state.law.network.weights[3] = 1e300
    run.tick()
    assert 1e290 < abs(run.state.unlimited_torque_Nm) < math.inf
    assert abs(run.torques_Nm[-1] - before_Nm) == pytest.approx(20.0)  # the rate limit
    assert_well(run)
