"""What may last how long: the supervisor's silence, skipped cycles, enabling, stopping, rest; with twins."""

from __future__ import annotations

import pytest

from jointctl.firmware_py.states import AxisPhase, Fault, Reaction, StopRequest
from tests.axis_on_stub_joint import NewRig, assert_fault, assert_well, finish


@pytest.mark.trips(Fault.SUPERVISOR_LOST, "(11, True)")
@pytest.mark.stays(Fault.SUPERVISOR_LOST, "(10, False)")
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


@pytest.mark.trips(Fault.CLIENT_SILENT, "(101, True)")
@pytest.mark.stays(Fault.CLIENT_SILENT, "(100, False)")
@pytest.mark.parametrize("phase", [AxisPhase.ENABLING, AxisPhase.APPROACH, AxisPhase.TRACKING])
@pytest.mark.parametrize(("silent_ms", "trips"), [(100, False), (101, True)])
def test_client_silent(rig: NewRig, phase: AxisPhase, silent_ms: int, trips: bool) -> None:
    run = rig(0.0).until(phase)
    stream = run.axis.stream
    stream.client_timeout_ns = 100_000_000
    stream.alive_ns[0] = run.state.slot_ns + 1_000_000 - silent_ms * 1_000_000
    run.tick()
    if trips:
        assert run.state.fault_value == pytest.approx(1e-3 * silent_ms)
        reaction = Reaction.OFF if phase is AxisPhase.ENABLING else Reaction.RAMP
        assert_fault(run, Fault.CLIENT_SILENT, reaction)
    else:
        stream.client_timeout_ns = 0
        assert_well(run.until(AxisPhase.TRACKING))


def test_a_joint_that_is_being_stopped_needs_no_client(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING)
    run.stop = StopRequest.RAMP
    run.tick()
    run.axis.stream.client_timeout_ns = 1
    finish(run)
    assert run.state.fault == Fault.NONE


def test_a_run_without_supervision_does_not_look_for_it(rig: NewRig) -> None:
    run = rig(0.0)
    run.axis.sequence.supervisor_max_cycles = 0
    run.supervisor_age_cycles = 10**12
    assert_well(run.until(AxisPhase.TRACKING).run(5))


@pytest.mark.trips(Fault.OVERRUN, "(9, True)")
@pytest.mark.stays(Fault.OVERRUN, "(8, False)")
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
