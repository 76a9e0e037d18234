"""A drive that brakes, restarts or leaves Operation Enabled by itself, and the error codes that are kept."""

from __future__ import annotations

import pytest

from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, Reaction
from tests.axis_on_stub_joint import NewRig, assert_fault, assert_well


@pytest.mark.stays(Fault.DRIVE_FAULT)
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


@pytest.mark.trips(Fault.DRIVE_RESTARTED, "Fault.DRIVE_RESTARTED")
@pytest.mark.stays(Fault.DRIVE_RESTARTED, "twin.until(AxisPhase.TRACKING)")
def test_a_restart_before_the_first_cycle_ends_the_run_without_power(rig: NewRig) -> None:
    """It was taken for one from before the run: a drive without its limits would have been enabled."""
    run, twin = rig(0.0), rig(0.0)
    run.sample.restarts = 1
    run.tick()
    assert_fault(run, Fault.DRIVE_RESTARTED, Reaction.OFF)
    assert set(run.requests) == {DriveRequest.OFF}
    twin.tick()
    assert twin.until(AxisPhase.TRACKING).state.fault == Fault.NONE


@pytest.mark.parametrize("booted", [True, False])
def test_a_drive_that_has_booted_is_off_although_it_sends_no_samples(rig: NewRig, booted: bool) -> None:
    """The loop waited for OFF_TIMEOUT, 2 s.  The twin has said "off" too, but why its samples stay away is unknown."""
    run = rig(0.05).until(AxisPhase.TRACKING).run(5)
    run.sample.drive_state = DriveState.OFF
    run.sample.restarts = int(booted)
    cycles = 0
    while run.phase != AxisPhase.FINISHED:
        run.tick(fresh=False)
        cycles += 1
    assert (cycles <= 5) is booted
    assert run.state.fault == (Fault.DRIVE_RESTARTED if booted else Fault.DRIVE_NOT_ENABLED)


@pytest.mark.parametrize("phase", [AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING])
def test_a_drive_that_brakes_by_itself_is_left_braking(rig: NewRig, phase: AxisPhase) -> None:
    """Power off would make it coast; at standstill, or after the time for a stop, it is switched off."""
    run = rig(0.05).reach(phase)
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
