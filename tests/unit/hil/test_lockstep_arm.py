"""Three joints that move one another, through the real cycle, codec and drives, in simulated time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.arm_model import ArmFeedForward
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.lockstep import LockstepArm, LockstepRun
from tests.bench.arm_study import KINDS, SPEEDS, random_arm, rmse_mrad
from tests.bench.arm_study import run as run_study

TRACKED_s = 6.0


@pytest.fixture(scope="module")
def arm() -> LockstepArm:
    return LockstepArm(load_arm(SHIPPED_ARM))


def run(arm: LockstepArm, kind: ArmFeedForward = ArmFeedForward.WHOLE, constants: Any = None) -> list[LockstepRun]:
    constants = arm.constants() if constants is None else constants
    constants.trajectory.duration_s[:] = TRACKED_s
    constants.law.of_arm[:] = kind != ArmFeedForward.NONE
    model = arm.arm.model.memory()
    model.constants[0].feed_forward = kind
    return arm.run(constants, model=model)


@pytest.fixture(scope="module")
def whole(arm: LockstepArm) -> list[LockstepRun]:
    return run(arm)


def test_all_joints_begin_and_end_together(whole: list[LockstepRun]) -> None:
    for one in whole:
        assert one.fault is Fault.NONE
        assert one.state.phase == AxisPhase.FINISHED
    for phase in (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING):
        first = {int(one.log.cycle[np.argmax(one.log.phase == phase)]) for one in whole}
        assert len(first) == 1, phase


def test_no_joint_has_torque_before_all_may(whole: list[LockstepRun]) -> None:
    for one in whole:
        assert not one.log.command_torque_Nm[one.log.phase < AxisPhase.APPROACH].any()


def test_gravity_helps_every_joint_and_the_whole_model_the_quick_ones_more() -> None:
    """A random arm of the study, near its limits."""
    random = LockstepArm(random_arm(load_arm(SHIPPED_ARM), 1, 0))
    independent, gravity, whole = (np.array(rmse_mrad(run_study(random, kind, SPEEDS[-1]))) for kind in KINDS.values())
    assert np.all(gravity < 0.95 * independent)
    assert np.all(whole < 0.9 * gravity)
    assert np.all(whole < 0.65 * independent)


def test_a_run_repeats_bit_by_bit(arm: LockstepArm, whole: list[LockstepRun]) -> None:
    for one, other in zip(whole, run(arm), strict=True):
        np.testing.assert_array_equal(one.log.command_torque_Nm, other.log.command_torque_Nm)


@pytest.mark.parametrize("faulty", range(3))
def test_a_fault_of_one_joint_stops_the_others_in_the_same_cycle(arm: LockstepArm, faulty: int) -> None:
    constants = arm.constants()
    constants.limits.following_error_max_rad[faulty] = 1e-6
    runs = run(arm, constants=constants)
    faults = [one.fault for one in runs]
    assert faults[faulty] is Fault.FOLLOWING_ERROR
    assert all(fault is Fault.NONE for axis, fault in enumerate(faults) if axis != faulty)
    begun = {int(one.log.cycle[np.argmax(one.log.phase >= AxisPhase.RAMPING)]) for one in runs}
    assert len(begun) == 1
    for axis, one in enumerate(runs):
        assert one.state.phase == AxisPhase.FINISHED
        if axis != faulty:
            assert (one.log.phase == AxisPhase.RAMPING).any()


def test_a_stop_brakes_all(arm: LockstepArm) -> None:
    runs = arm.run(stop_cycle=4000)
    for one in runs:
        assert one.fault is Fault.NONE
        assert int(one.log.cycle[np.argmax(one.log.phase == AxisPhase.RAMPING)]) == 4001


def test_the_arm_holds_where_the_drives_have_no_power(whole: list[LockstepRun]) -> None:
    for one in whole:
        before = one.truth[one.log.phase < AxisPhase.ENABLING, 0]
        assert np.ptp(before) < 1e-3
