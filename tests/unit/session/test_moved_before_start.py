"""A joint that is moved while the question is open: the motion would not be the one that was shown."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import MOVED_COUNTS
from jointctl.tools.motion_check.plan import CheckMotion, config_of_check, make_plan, motion_table
from jointctl.tools.simulation.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import middle_rad, sweep_constants
from jointctl.tools.sweeping.grid import both_directions, ordered_points
from jointctl.tools.sweeping.plan import PlanSettings, plan_motion, shifted
from tests.places import CONFIGS
from tests.sessions import constants_of


def config_with(folder: Path, **changes: str) -> Config:
    text = (CONFIGS / "virtual.toml").read_text()
    for key, value in {"duration_s": "1.0", **changes}.items():
        lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in text.splitlines()]
        assert lines != text.splitlines()
        text = "\n".join(lines) + "\n"
    path = folder / "joint.toml"
    path.write_text(text)
    return load_config(path)


def moved(joint: LockstepJoint, by_rad: float) -> Any:
    state = joint.plant_state.copy()
    state.joint_position_rad += by_rad
    return state


@pytest.mark.parametrize("by_rad", [0.6, 0.051, -0.051])
def test_a_joint_that_was_moved_is_not_enabled(tmp_path: Path, by_rad: float) -> None:
    """It was driven the longer way in the time of the shorter one: 0.99 rad/s where 0.26 rad/s were shown."""
    joint = LockstepJoint(config_with(tmp_path))
    run = joint.run(plant_state=moved(joint, by_rad))
    assert run.fault is Fault.MOVED_BEFORE_START
    assert run.state.fault_value == pytest.approx(by_rad, abs=1e-4)
    assert not np.isin(run.log.drive_state, (DriveState.STARTING, DriveState.ENABLED)).any()
    assert not run.log.command_torque_Nm.any()


@pytest.mark.parametrize("by_rad", [0.049, -0.049, 0.0])
def test_within_the_following_error_it_is_driven(tmp_path: Path, by_rad: float) -> None:
    joint = LockstepJoint(config_with(tmp_path))
    run = joint.run(plant_state=moved(joint, by_rad))
    assert run.fault is Fault.NONE
    assert AxisPhase.TRACKING in run.log.phase


def test_the_tolerance(tmp_path: Path) -> None:
    config = config_with(tmp_path)
    sequence = constants_of(config, start_position_rad=0.25)[0].sequence
    assert (sequence.start_rad, sequence.moved_max_rad) == (0.25, config.limits.following_error_max_rad)
    assert constants_of(config)[0].sequence.moved_max_rad == 0.0  # not known where it stands: not checked
    coarse = config_with(tmp_path, counts_per_turn="256", following_error_max_rad="0.05", velocity_cutoff_Hz="5.0")
    sequence = constants_of(coarse, start_position_rad=0.25)[0].sequence
    assert sequence.moved_max_rad == pytest.approx(MOVED_COUNTS * math.tau / 256)


@pytest.mark.parametrize(("by_rad", "fault"), [(0.6, Fault.MOVED_BEFORE_START), (0.04, Fault.NONE)])
def test_a_sweep_is_not_begun_elsewhere(by_rad: float, fault: Fault) -> None:
    joint = LockstepJoint(load_config(CONFIGS / "sweep_virtual.toml"))
    settings = PlanSettings(
        width_rad=0.2, acceleration_radps2=4.0, transit_radps=0.5, dwell_s=0.3, settle_s=0.1, reduction_ratio=121.0
    )
    motion = plan_motion(ordered_points(both_directions([0.2], 2), 1, None), settings)
    placed = shifted(motion, middle_rad(joint.config, motion, joint.report.start_position_rad))
    joint.table = placed.table
    constants = sweep_constants(joint.config, joint.report, placed)
    constants[0].sequence.supervisor_max_cycles = 0
    run = joint.run(constants, plant_state=moved(joint, by_rad))
    assert run.fault is fault
    assert (run.log.drive_state == DriveState.ENABLED).any() is np.bool_(fault is Fault.NONE)


def test_the_motion_check_looks_as_well(tmp_path: Path) -> None:
    config = config_with(tmp_path)
    plan = make_plan(config, None)
    report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.1, 0.06, 1e-5)
    check = CheckMotion(config_of_check(config, plan), plan).constants(report, motion_table(plan, 0.1))[0].sequence
    assert (check.start_rad, check.moved_max_rad) == (0.1, pytest.approx(1.25 * plan.travel_rad))
