"""Late, doubled and reordered TPDOs through the fault engine: an old value does not pass for a new sample."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.faults import FaultKind
from jointctl.tools.lockstep import LockstepJoint
from tests.made_faults import faults_of, one_fault

AT_s = 2.0


@pytest.mark.parametrize("other", [FaultKind.TPDO_DUPLICATED, FaultKind.TPDO_REORDERED, FaultKind.TPDO_DELAYED])
@pytest.mark.parametrize("magnitude", [0.5, 1.0])
def test_a_stuck_encoder_is_noticed_behind_a_wire_that_doubles_delays_or_reorders(
    lockstep: LockstepJoint, other: FaultKind, magnitude: float
) -> None:
    size = 0.004 * magnitude if other is FaultKind.TPDO_DELAYED else magnitude
    run = lockstep.run_with_faults(
        faults_of((other, AT_s - 0.5, 30.0, size), (FaultKind.ENCODER_STUCK, AT_s, 30.0, 1.0)), longest_s=6.0
    )
    assert run.fault is Fault.POSITION_FROZEN


@pytest.mark.trips("loop: old values")
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_the_age_counts_on_although_old_frames_come(lockstep: LockstepJoint, share: float) -> None:
    """Doubled until the answers stop: what comes then is nothing, and the age reaches its limit in its time."""
    faults = faults_of((FaultKind.TPDO_DUPLICATED, 0.5, 30.0, share), (FaultKind.TPDO_LOST, AT_s, 30.0, 1.0))
    run = lockstep.run_with_faults(faults)
    alone = lockstep.run_with_faults(faults_of((FaultKind.TPDO_LOST, AT_s, 30.0, 1.0)))
    assert run.fault is alone.fault is Fault.STALE_SAMPLE
    tripped = [int(np.argmax(one.log.fault != Fault.NONE)) for one in (run, alone)]
    assert tripped[0] == tripped[1]


@pytest.mark.stays("loop: old values")
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (FaultKind.TPDO_DUPLICATED, 1.0),
        (FaultKind.TPDO_REORDERED, 0.3),
        (FaultKind.TPDO_DELAYED, 0.001),
    ],
)  # fmt: skip
def test_the_twins_with_a_sound_encoder_go_on(lockstep: LockstepJoint, kind: FaultKind, size: float) -> None:
    run = lockstep.run_with_faults(faults_of((kind, AT_s, 30.0, size)))
    assert run.fault is Fault.NONE
    assert run.state.phase == AxisPhase.FINISHED


@pytest.mark.parametrize(("delay_s", "stale"), [(0.045, False), (0.06, True)])
def test_a_wire_that_becomes_late_shows_by_the_hole_before(
    lockstep: LockstepJoint, delay_s: float, stale: bool
) -> None:
    """The joint holds its position, so that nothing but the age can notice."""
    constants = lockstep.constants()
    constants[0].trajectory.amplitude_rad = 0.0
    run = lockstep.run_with_faults(one_fault(FaultKind.TPDO_DELAYED, 4.0, magnitude=delay_s), constants)
    assert (run.fault is Fault.STALE_SAMPLE) is stale


@pytest.mark.parametrize(("duration_s", "silent"), [(0.35, False), (1.0, True)])
def test_a_drive_that_loses_only_its_heartbeat(lockstep: LockstepJoint, duration_s: float, silent: bool) -> None:
    run = lockstep.run_with_faults(one_fault(FaultKind.DRIVE_HEARTBEAT_LOST, AT_s, duration_s))
    assert run.fault is (Fault.DRIVE_SILENT if silent else Fault.NONE)
