"""Three joints that move one another, through the real cycle, codec and drives, in simulated time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.arm_model import ArmFeedForward
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind, no_faults
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_POSITION_rad, TRUE_VELOCITY_radps
from jointctl.tools.analysis.arm_check import joint_loop, joint_loops, pose_ranges, require_budgets
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.lockstep import LockstepArm, LockstepRun
from jointctl.tools.virtual_joint import arm_plant_of
from tests.arms import long_arm
from tests.bench.arm_study import KINDS, SPEEDS, random_arm, rmse_mrad
from tests.bench.arm_study import run as run_study
from tests.made_faults import one_fault

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


@pytest.fixture(scope="module")
def seven(tmp_path_factory: pytest.TempPathFactory) -> LockstepArm:
    return LockstepArm(load_arm(long_arm(tmp_path_factory.mktemp("long"))))


def test_seven_joints_at_500_hz_fill_a_bus_and_move_together(seven: LockstepArm) -> None:
    (budget,) = require_budgets(seven.arm)
    assert (len(budget.joints), budget.fitting_Hz) == (7, 500.0)
    assert budget.load == pytest.approx(0.8325)
    assert min(joint.margins.phase_margin_deg for joint in joint_loops(seven.arm)) > 30.0
    runs = run(seven)
    assert [one.fault for one in runs] == [Fault.NONE] * 7
    for phase in (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING):
        assert len({int(one.log.cycle[np.argmax(one.log.phase == phase)]) for one in runs}) == 1, phase
    for one in runs:
        assert np.sqrt(np.mean(one.true_error_rad[one.tracking] ** 2)) < 1e-3


@pytest.mark.parametrize("faulty", [0, 3, 6])
def test_one_of_seven_joints_that_trips_stops_all_in_the_same_cycle(seven: LockstepArm, faulty: int) -> None:
    constants = seven.constants()
    constants.limits.following_error_max_rad[faulty] = 1e-6
    runs = run(seven, constants=constants)
    assert [axis for axis, one in enumerate(runs) if one.fault is not Fault.NONE] == [faulty]
    assert runs[faulty].fault is Fault.FOLLOWING_ERROR
    assert len({int(one.log.cycle[np.argmax(one.log.phase >= AxisPhase.RAMPING)]) for one in runs}) == 1
    assert {int(one.state.phase) for one in runs} == {AxisPhase.FINISHED}


def on_two_buses(arm: ArmConfig) -> ArmConfig:
    """The wrist alone on a second one, with the shoulder's node."""
    *others, wrist = arm.joints
    return replace(arm, joints=(*others, wrist.changed(bus__channel="virtual1", drive__node=1)))


@pytest.mark.parametrize("brake", [True, False])
def test_a_joint_without_a_brake_falls_while_its_power_is_off(arm: LockstepArm, brake: bool) -> None:
    """Before the start, where all drives are off: gravity is more than its friction."""
    first = arm.arm.joints[0]
    changed = first.changed(virtual__brake=brake)
    given = replace(arm.arm, joints=(changed, *arm.arm.joints[1:]))
    position = arm.run(plant=arm_plant_of(given), longest_s=0.045)[0].truth[:, TRUE_POSITION_rad]
    assert (abs(position[-1] - position[0]) < 1e-3) == brake


@pytest.mark.parametrize(("faulty", "lost"), [(0, {"shoulder", "elbow"}), (2, {"wrist"})])
def test_a_bus_that_is_lost_stops_the_joints_of_both(arm: LockstepArm, faulty: int, lost: set[str]) -> None:
    given = on_two_buses(arm.arm)
    joints, constants = LockstepArm(given), arm.constants()
    faults = [one_fault(FaultKind.BUS_OFF, 3.0) if axis == faulty else no_faults() for axis in range(3)]
    plants = joints.plant_constants, joints.plant_state
    runs = joints.run_with_faults(faults, constants, plants, arm_plant_of(given), longest_s=12.0, tail_s=1.0)
    first = [int(np.argmax(run.log.fault != 0)) if run.log.fault.any() else 1 << 30 for run in runs]
    blamed = {name for name, row in zip(given.names, first, strict=True) if row == min(first)}
    assert blamed == lost
    assert {runs[axis].fault for axis in range(3) if given.names[axis] in lost} == {Fault.BUS_ERROR}
    began = [int(np.argmax(run.log.phase >= AxisPhase.RAMPING)) for run in runs]
    assert max(began) - min(began) <= 1
    for run in runs:
        assert run.state.phase == AxisPhase.FINISHED
        assert run.truth[-1, TRUE_POWER_STATE] != PowerState.OPERATION_ENABLED
        assert abs(run.truth[-1, TRUE_VELOCITY_radps]) < 1e-3


def test_its_twin_on_two_buses_the_arm_moves_as_on_one(arm: LockstepArm, whole: list[LockstepRun]) -> None:
    for one, other in zip(whole, run(LockstepArm(on_two_buses(arm.arm))), strict=True):
        assert np.array_equal(one.log.position_rad, other.log.position_rad)


def test_gravity_helps_every_joint_and_the_whole_model_the_quick_ones_more() -> None:
    """A random arm of the study, near its limits."""
    random = LockstepArm(random_arm(load_arm(SHIPPED_ARM), 1, 0))
    independent, gravity, whole = (np.array(rmse_mrad(run_study(random, kind, SPEEDS[-1]))) for kind in KINDS.values())
    assert np.all(gravity < 0.95 * independent)
    assert np.all(whole < 0.9 * gravity)
    assert np.all(whole < 0.65 * independent)


@pytest.mark.slow("gains are searched for each of its joints")
def test_an_arm_of_flexible_joints_moves_within_its_margins_and_the_model_helps_it() -> None:
    """Slowly: at higher speed the kinematic error of the reducers is what is left."""
    shipped = load_arm(SHIPPED_ARM)
    soft = random_arm(shipped, 1, 0, flexible=True)
    for name, config, poses in zip(soft.names, soft.joints, pose_ranges(soft), strict=True):
        assert config.control.kind == "flexible_joint"
        found = joint_loop(name, config, poses).margins
        assert found.phase_margin_deg > 30.0
        assert found.sensitivity_peak < 3.0
    joints = LockstepArm(soft)
    independent, whole = (
        np.array(rmse_mrad(run_study(joints, kind, SPEEDS[0]))) for kind in (ArmFeedForward.NONE, ArmFeedForward.WHOLE)
    )
    assert np.all(whole < 0.03)
    assert np.all(whole < 0.5 * independent)


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
