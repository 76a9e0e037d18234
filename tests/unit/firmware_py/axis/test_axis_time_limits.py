"""What may last how long: the supervisor's silence, skipped cycles, enabling, stopping, rest; with twins."""

from __future__ import annotations

import pytest

from jointctl.firmware_py.states import AxisPhase, Fault, Reaction, StopRequest
from tests.axis_on_stub_joint import NewRig, PERIOD_s, assert_fault, finish

COUNT_rad = 1e-3


def test_a_joint_that_is_being_stopped_needs_no_client(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.tick()
    run.axis.stream.client_timeout_ns = 1
    finish(run)
    assert run.state.fault == Fault.NONE


@pytest.mark.parametrize("matched", [0, 1])
def test_after_an_overrun_the_reference_is_that_of_now(rig: NewRig, matched: int) -> None:
    """The twin without an overrun has the same reference at the same time, and the torque does not kick."""
    run, twin = rig(0.0), rig(0.0)
    for one in (run, twin):
        one.axis.law.filtered_error_rate = matched
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


@pytest.mark.trips(Fault.STOP_TIMEOUT, "Fault.STOP_TIMEOUT")
@pytest.mark.stays(Fault.STOP_TIMEOUT, "(AxisPhase.RELEASING, Fault.NONE)")
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


@pytest.mark.trips(Fault.STOP_TIMEOUT, "(5.0, 0.0)")
@pytest.mark.stays(Fault.STOP_TIMEOUT, "(2.0, 0.0)")
@pytest.mark.parametrize(("flicker_counts", "speed"), [(0.0, 0.0), (2.0, 0.0), (5.0, 0.0), (0.0, 1.1)])
def test_a_joint_stands_whose_reading_flickers_by_some_counts(rig: NewRig, flicker_counts: float, speed: float) -> None:
    """One count reads as five times `standstill_radps`; a motion of 1.1 times that is none of a joint that stands."""
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.axis.sequence.settle_cycles, run.axis.limits.standstill_radps = 50, 0.1
    run.axis.limits.frozen_tolerance_rad, run.axis.limits.saturation_max_cycles = 4.0 * COUNT_rad, 1000
    run.stop = StopRequest.RAMP
    while run.state.phase != AxisPhase.RAMPING or run.state.reference.velocity_radps != 0.0:
        run.tick()
    run.state.still_cycles = cycle = 0
    rest_rad = run.joint.position_rad
    while run.phase == AxisPhase.RAMPING:
        cycle += 1
        away = cycle % 7 // 4 * flicker_counts * COUNT_rad + cycle * PERIOD_s * speed * run.axis.limits.standstill_radps
        run.joint.position_rad, run.joint.velocity_radps = rest_rad + away, 0.0
        run.tick()
    if flicker_counts > 4.0 or speed > 1.0:
        assert_fault(run, Fault.STOP_TIMEOUT, Reaction.QUICK_STOP)
    else:
        assert (run.phase, run.state.fault) == (AxisPhase.RELEASING, Fault.NONE)
