"""CSP and CSV at simulated time: what the feed-forward is worth, no jump, and a drive that no one watches any more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultConstants, FaultKind
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_POSITION_rad, TRUE_VELOCITY_radps
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from tests.configurations import own_loop
from tests.joint_sizes import SIZES, own_loop_joint

POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
DEAD_AT_s = 3.0


def short(mode: str, **cascade: Any) -> LockstepJoint:
    return LockstepJoint(own_loop(mode, **cascade).changed(trajectory__duration_s=6.0))


@pytest.fixture(scope="module", params=["csp", "csv"])
def joint(request: pytest.FixtureRequest) -> LockstepJoint:
    return short(request.param)


def rmse_mrad(run: LockstepRun) -> float:
    assert run.fault is Fault.NONE
    return float(1e3 * np.sqrt(np.mean(run.true_error_rad[run.tracking][1000:] ** 2)))


def test_the_feed_forward_divides_the_following_error_of_the_drive_by_more_than_ten() -> None:
    alone = short("csp", torque_offset=False, velocity_offset=False, lead_s=0.0).run()
    everything = short("csp").run()
    assert rmse_mrad(alone) > 3.0  # the lag of a P position loop: speed / gain
    assert rmse_mrad(everything) < 0.1 * rmse_mrad(alone)


def test_each_part_makes_it_better(joint: LockstepJoint) -> None:
    mode = joint.config.drive.mode  # type: ignore[attr-defined]
    without_torque = short(mode, torque_offset=False).run()
    assert rmse_mrad(joint.run()) < 0.5 * rmse_mrad(without_torque)


def test_the_joint_does_not_jump_when_it_is_enabled_and_nothing_moves_it_after_release(joint: LockstepJoint) -> None:
    run = joint.run()
    first = int(np.argmax(run.truth[:, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED))
    positions = run.truth[:, TRUE_POSITION_rad]
    assert np.abs(positions[first : first + 20] - positions[first]).max() < 5e-5
    releasing = positions[run.log.phase == AxisPhase.RELEASING]
    assert np.ptp(releasing) < 2e-4
    assert run.state.phase == AxisPhase.FINISHED
    assert not np.isin(run.truth[-1, TRUE_POWER_STATE], POWERED)


def dead_from(kind: FaultKind, duration_s: float) -> Any:
    faults = new(FaultConstants)
    faults[0].kind, faults[0].start_s, faults[0].duration_s = kind, DEAD_AT_s, duration_s
    faults[0].magnitude, faults[0].seed = 1.0, 1
    return faults


@pytest.mark.parametrize("kind", [FaultKind.LOOP_HELD_UP, FaultKind.BUS_OFF])
def test_a_joint_whose_computer_dies_is_braked_by_the_drive_and_switched_off(
    joint: LockstepJoint, kind: FaultKind
) -> None:
    run = joint.run_with_faults(dead_from(kind, 30.0), epoch_at_start=True, longest_s=5.0, tail_s=1.0)
    on = np.flatnonzero(np.isin(run.truth[:, TRUE_POWER_STATE], POWERED))
    off_after_s = (on[-1] + 1) * 1e-3 - DEAD_AT_s
    braking_s = 1.0 / 2.0  # from the velocity limit at brake_radps2, more than the quick stop of the drive needs
    assert 0.0 < off_after_s < 0.28 + braking_s
    assert np.abs(run.truth[on[-1] + 100 :, TRUE_VELOCITY_radps]).max() < 0.02
    assert run.truth[int(DEAD_AT_s * 1e3), TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED


@pytest.mark.parametrize("kind", [FaultKind.LOOP_HELD_UP, FaultKind.BUS_OFF])
def test_its_twin_a_computer_that_was_away_for_a_moment_goes_on(joint: LockstepJoint, kind: FaultKind) -> None:
    run = joint.run_with_faults(dead_from(kind, 0.015), epoch_at_start=True)
    assert run.fault is Fault.NONE
    assert np.abs(run.log.error_rad[run.tracking]).max() < 0.02


@pytest.mark.parametrize("mode", ["csp", "csv"])
@pytest.mark.parametrize("name", SIZES)
def test_a_joint_of_any_size_is_off_and_at_rest_after_each_end_of_its_control(name: str, mode: str) -> None:
    """A quick stop of 12 rad/s2 alone was too slow for a finger's range and too fast for a base joint's torque."""
    size = SIZES[name]
    joint = LockstepJoint(own_loop_joint(size, mode, trajectory__duration_s=3.0))
    healthy = joint.run()
    begins_s = 1e-9 * float(healthy.log.time_ns[int(np.argmax(healthy.tracking))] - healthy.log.time_ns[0])
    for kind, magnitude, expected in (
        (FaultKind.LOOP_KILLED, 1.0, {Fault.NONE}),
        (FaultKind.BUS_OFF, 1.0, {Fault.BUS_ERROR}),
        (FaultKind.DRIVE_FAULT, float(0x2310), {Fault.DRIVE_FAULT}),
        (FaultKind.ENCODER_REVERSED, 1.0, {Fault.FOLLOWING_ERROR, Fault.VELOCITY_LIMIT}),
    ):
        fault = new(FaultConstants, 1)
        fault[0].kind, fault[0].start_s, fault[0].duration_s = kind, begins_s + 1.0, 100.0
        fault[0].magnitude = magnitude
        run = joint.run_with_faults(fault, tail_s=3.0)
        speeds = np.abs(run.truth[:, TRUE_VELOCITY_radps])
        assert run.fault in expected
        assert run.truth[-1, TRUE_POWER_STATE] not in POWERED
        assert speeds.max() < 1.1 * size.speed_radps
        if kind != FaultKind.ENCODER_REVERSED:  # which may leave a joint under gravity where it falls
            assert speeds[-1] < 1e-3 * size.speed_radps
        assert np.abs(run.log.measured_torque_Nm).max() < 1.1 * size.torque_Nm
