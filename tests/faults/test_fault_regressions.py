"""What the fault campaign found, each as it was found, with the twin that must not trip."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.drivers.canopen.cyclic import IGNORED_MAX_CYCLES
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind, no_faults
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_VELOCITY_radps
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from tests.made_faults import faults_of, one_fault

AT_s = 2.0  # after the power stage is on: the joint tracks
HEARTBEAT_s, SAMPLE_AGE_s = 0.2, 0.05


def seconds_until(run: LockstepRun, state: PowerState) -> float:
    """From the beginning of the fault to the first period in this power state."""
    enabled = int(np.argmax(run.truth[:, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED))
    rows = np.flatnonzero(run.truth[enabled + int(AT_s * 1000) :, TRUE_POWER_STATE] == state)
    return float(rows[0]) * 1e-3 if len(rows) else float("inf")


@pytest.mark.parametrize(("kind", "fault"), [(FaultKind.SYNC_LOST, Fault.STALE_SAMPLE), (FaultKind.RPDO_LOST, None)])
def test_a_drive_that_does_not_hear_the_loop_is_stopped_by_its_own_watchdog(
    lockstep: LockstepJoint, kind: FaultKind, fault: Fault | None
) -> None:
    """The loop went on sending its heartbeat, so that the drive held the last torque until the loop ended, 5 s on."""
    run = lockstep.run_with_faults(one_fault(kind, AT_s), tail_s=1.0)
    assert run.fault is not Fault.NONE
    assert fault is None or run.fault is fault
    tripped = int(np.argmax(run.log.fault != Fault.NONE))
    enabled = int(np.argmax(run.truth[:, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED))
    known_s = (tripped - enabled) * 1e-3 - AT_s
    longest_s = known_s + IGNORED_MAX_CYCLES * 1e-3 + HEARTBEAT_s + 0.01
    assert seconds_until(run, PowerState.QUICK_STOP_ACTIVE) <= longest_s
    assert run.truth[-1, TRUE_POWER_STATE] == PowerState.SWITCH_ON_DISABLED


@pytest.mark.parametrize("name", ["virtual", "precise", "realistic"])
def test_an_answer_that_misses_its_cycle_is_no_leap_of_the_joint(name: str) -> None:
    """It was taken as of the cycle in which it came: a kick of up to the torque's rate limit at each first late one."""
    lockstep = LockstepJoint(load_config(shipped_config(name)))
    late = faults_of(*((FaultKind.TPDO_DELAYED, AT_s + 0.1 * k, 0.004, 0.0004) for k in range(8)))
    run, plain = (lockstep.run_with_faults(faults, longest_s=4.5) for faults in (late, no_faults()))
    assert run.fault is Fault.NONE
    assert int((run.log.sample_age_cycles > 0).sum()) == 8  # each time the first one is missed, the others follow late
    steps_Nm = [np.abs(np.diff(one.log.command_torque_Nm[one.tracking])).max() for one in (run, plain)]
    assert steps_Nm[0] < 1.5 * steps_Nm[1]  # 6 to 11 times before


@pytest.mark.trips("drive: the loop's RPDOs", "(0.102, True)")
@pytest.mark.stays("drive: the loop's RPDOs", "(0.098, False)")
@pytest.mark.parametrize(("kind", "magnitude"), [(FaultKind.RPDO_LOST, 1.0), (FaultKind.RPDO_LENGTH, 2.0)])
@pytest.mark.parametrize(("duration_s", "stops"), [(0.098, False), (0.102, True)])
def test_a_joint_that_holds_while_its_rpdos_stay_away_is_stopped_by_the_deadline_of_the_drive(
    lockstep: LockstepJoint, kind: FaultKind, magnitude: float, duration_s: float, stops: bool
) -> None:
    """It stands still, so that no limit of the loop sees the loss; the drive's own error code is the reported cause."""
    constants = lockstep.constants()
    constants[0].trajectory.amplitude_rad = 0.0
    run = lockstep.run_with_faults(one_fault(kind, 4.0, duration_s, magnitude), constants, tail_s=1.0)
    if stops:
        assert (run.fault, int(run.state.fault_drive_error)) == (Fault.DRIVE_NOT_ENABLED, 0x8250)
        assert run.truth[-1, TRUE_POWER_STATE] == PowerState.SWITCH_ON_DISABLED
        assert PowerState.QUICK_STOP_ACTIVE in run.truth[:, TRUE_POWER_STATE]
    else:
        assert run.fault is Fault.NONE
        assert run.state.phase == AxisPhase.FINISHED


def powered_s(run: LockstepRun) -> float:
    return (
        float(
            np.isin(run.truth[:, TRUE_POWER_STATE], (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)).sum()
        )
        * 1e-3
    )


@pytest.mark.parametrize("kind", [FaultKind.SYNC_LOST, FaultKind.CONTROLLER_HEARTBEAT_LOST])
def test_the_loop_does_not_wait_for_a_drive_whose_watchdog_has_stopped_it(
    lockstep: LockstepJoint, kind: FaultKind
) -> None:
    """A stopped node sends no TPDO: the loop waited for stop_timeout_s and off_timeout_s, 5 s, until it was read."""
    run = lockstep.run_with_faults(one_fault(kind, AT_s))
    assert run.fault is Fault.STALE_SAMPLE
    assert run.state.phase == AxisPhase.FINISHED
    tripped = int(np.argmax(run.log.fault != Fault.NONE))
    assert (len(run.log) - tripped) * 1e-3 <= IGNORED_MAX_CYCLES * 1e-3 + 2.0 * HEARTBEAT_s + 0.01
    silent = faults_of((kind, AT_s, 60.0, 1.0), (FaultKind.DRIVE_HEARTBEAT_LOST, AT_s, 60.0, 1.0))
    twin = lockstep.run_with_faults(silent)  # whether it is operational is not known: its word is awaited
    assert twin.fault is Fault.STALE_SAMPLE
    tripped = int(np.argmax(twin.log.fault != Fault.NONE))
    assert (len(twin.log) - tripped) * 1e-3 >= 2.0


@pytest.mark.parametrize("at_s", [0.0545, 0.055, 0.06])
def test_a_drive_that_is_lost_in_the_moment_of_enabling_is_stopped_by_its_watchdog(
    lockstep: LockstepJoint, at_s: float
) -> None:
    """It was enabled after its last report, which said "switched on": it kept its power, brake open, for 2.2 s."""
    run = lockstep.run_with_faults(one_fault(FaultKind.SYNC_LOST, at_s), tail_s=1.0, epoch_at_start=True)
    assert run.fault is Fault.STALE_SAMPLE
    assert 0.0 < powered_s(run) <= SAMPLE_AGE_s + IGNORED_MAX_CYCLES * 1e-3 + HEARTBEAT_s + 0.01
    twin = lockstep.run_with_faults(one_fault(FaultKind.SYNC_LOST, at_s, 0.045), epoch_at_start=True)
    assert twin.fault is Fault.NONE


def test_its_twin_a_drive_that_hears_again_in_time_is_not_left_alone(lockstep: LockstepJoint) -> None:
    run = lockstep.run_with_faults(one_fault(FaultKind.SYNC_LOST, AT_s, 0.045))
    assert run.fault is Fault.NONE
    assert run.state.phase == AxisPhase.FINISHED


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_behind_a_stuck_encoder_the_joint_does_not_run_away(lockstep: LockstepJoint, noise: float) -> None:
    """The law pushed ever harder: 4.7 rad/s before the following error was seen."""
    plant = lockstep.plant_constants.copy()
    plant[0].encoder_noise_counts = noise
    for at_s in np.arange(1.0, 8.0, 0.7):
        run = lockstep.run_with_faults(one_fault(FaultKind.ENCODER_STUCK, float(at_s)), plant_constants=plant)
        assert run.fault is Fault.POSITION_FROZEN
        assert np.abs(run.truth[:, TRUE_VELOCITY_radps]).max() < 1.0


@pytest.mark.parametrize("friction_kind", [2, 3])
@pytest.mark.parametrize("scale", [0.85, 1.0, 1.15])
def test_its_twin_a_joint_that_sticks_at_its_reversals_is_not_frozen(
    lockstep: LockstepJoint, friction_kind: int, scale: float
) -> None:
    plant = lockstep.plant_constants.copy()
    plant[0].friction_kind = friction_kind
    plant[0].positive_factor *= scale
    plant[0].negative_factor *= scale
    run = lockstep.run_with_faults(one_fault(FaultKind.NONE), plant_constants=plant)
    assert run.fault is Fault.NONE
    assert run.state.phase == AxisPhase.FINISHED


def test_missing_samples_are_no_frozen_reading(lockstep: LockstepJoint) -> None:
    """Samples that stay away were reported as a reading that stands still."""
    run = lockstep.run_with_faults(one_fault(FaultKind.TPDO_LOST, AT_s))
    assert run.fault is Fault.STALE_SAMPLE
    assert lockstep.run_with_faults(one_fault(FaultKind.TPDO_LOST, AT_s, 0.045)).fault is Fault.NONE


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_samples_with_holes_prove_standstill_too(lockstep: LockstepJoint, share: float) -> None:
    """One hole within settle_s began the wait for standstill anew: STOP_TIMEOUT at the end of a good run."""
    run = lockstep.run_with_faults(one_fault(FaultKind.TPDO_REORDERED, 0.0, magnitude=share))
    assert run.fault is Fault.NONE
    assert run.state.phase == AxisPhase.FINISHED


@pytest.mark.parametrize(("share", "fault"), [(0.05, Fault.NONE), (0.26, Fault.SAMPLES_MISSING)])
def test_nothing_is_enabled_on_a_bus_that_mixes_up_every_fourth_sample(
    lockstep: LockstepJoint, share: float, fault: Fault
) -> None:
    """An answer that comes after its cycle is none; the campaign took this for harmless at any time."""
    run = lockstep.run_with_faults(one_fault(FaultKind.TPDO_REORDERED, 0.0, magnitude=share), epoch_at_start=True)
    assert run.fault is fault
    assert (PowerState.OPERATION_ENABLED in run.truth[:, TRUE_POWER_STATE]) == (fault is Fault.NONE)


def test_a_watchdog_that_trips_is_told_by_its_error_code(lockstep: LockstepJoint) -> None:
    """A stopped node sends no TPDO: the loop saw stale samples only, and did not tell the drive's 8130h."""
    run = lockstep.run_with_faults(one_fault(FaultKind.CONTROLLER_HEARTBEAT_LOST, AT_s))
    assert (run.fault, int(run.state.fault_drive_error)) == (Fault.STALE_SAMPLE, 0x8130)
    assert seconds_until(run, PowerState.QUICK_STOP_ACTIVE) <= HEARTBEAT_s
    twin = lockstep.run_with_faults(one_fault(FaultKind.CONTROLLER_HEARTBEAT_LOST, AT_s, 0.06))
    assert twin.fault is Fault.NONE


@pytest.mark.parametrize(
    ("at_s", "step_s", "fault"),
    [
        (0.025, 5.6, Fault.OVERRUN),  # seed 915311, scenarios 1269 and 4927: reported as SAMPLES_MISSING
        (0.025, 4.97, Fault.OVERRUN),  # the wait ends some cycles after the step
        (0.0, 5.6, Fault.OVERRUN),  # before the first sample: reported as NO_SAMPLES
        (0.0525, 5.6, Fault.OVERRUN),  # while the drive is asked to enable: reported as ENABLE_TIMEOUT
        (0.025, 4.9, Fault.NONE),  # the twins: the power is off, and there is time left to wait
        (0.0525, 2.9, Fault.NONE),
    ],
)
def test_a_clock_that_leaps_before_enabling_is_told_as_that(
    lockstep: LockstepJoint, at_s: float, step_s: float, fault: Fault
) -> None:
    """The wait was over at once, and what had not come in the few cycles that there were was reported as the cause."""
    run = lockstep.run_with_faults(one_fault(FaultKind.CLOCK_STEP, at_s, 0.01, step_s), epoch_at_start=True)
    assert run.fault is fault
    if fault is Fault.OVERRUN:
        assert run.state.fault_value == pytest.approx(1e3 * step_s, abs=1.0)
        assert PowerState.OPERATION_ENABLED not in run.truth[:, TRUE_POWER_STATE]
    else:
        assert run.state.phase == AxisPhase.FINISHED
