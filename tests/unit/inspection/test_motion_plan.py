"""The plan of a motion check: torque, speed and travel, smooth and never wider than the configuration."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.conversions import velocity_of_a_count_radps
from jointctl.tools.configuration.records import APPROACH_MIN_S
from jointctl.tools.inspection.health import NOTE, OK
from jointctl.tools.motion_check.plan import CheckMotion, config_of_check, make_plan, motion_table
from jointctl.tools.motion_check.verdict import judged
from tests.two_encoders import config_with


def test_the_torque_is_that_of_friction_and_gravity_and_never_above_the_limit(tmp_path: Path) -> None:
    static_Nm = 0.1575 * 121.0
    assert make_plan(config_with(tmp_path), None).torque_Nm == pytest.approx(2.0 * static_Nm)
    assert make_plan(config_with(tmp_path, joint__gravity_Nm=5.0), None).torque_Nm == pytest.approx(2.0 * static_Nm + 5)
    assert make_plan(config_with(tmp_path, limits__torque_max_Nm=25.0), None).torque_Nm == 25.0
    assert make_plan(config_with(tmp_path), 12.0).torque_Nm == 12.0
    with pytest.raises(ConfigurationError, match=re.escape("--torque (=60.1) must be in (0..60]")):
        make_plan(config_with(tmp_path), 60.1)


def test_the_check_only_narrows_torque_speed_and_travel(tmp_path: Path) -> None:
    config = config_with(tmp_path)
    plan = make_plan(config, None)
    report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.1, 0.06, 1e-5)
    made = CheckMotion(config_of_check(config, plan), plan).constants(report, motion_table(plan, 0.1))[0].limits
    assert made.torque_max_Nm == plan.torque_Nm < config.limits.torque_max_Nm
    assert made.velocity_max_radps == 0.5 < config.limits.velocity_max_radps
    assert (made.position_min_rad, made.position_max_rad) == pytest.approx((0.0, 0.2))
    assert made.sample_age_max_cycles == round(config.limits.sample_age_max_s * config.loop.rate_Hz)
    assert config_of_check(config, plan).canopen.max_torque_permille is None


@pytest.mark.parametrize(("torque_Nm", "watched_Nm"), [(None, 0.75 * 38.115), (5.0, 4.75)])
def test_a_standing_joint_is_never_pushed_unwatched(tmp_path: Path, torque_Nm: float | None, watched_Nm: float) -> None:
    """Also where gravity takes more than the torque that is allowed."""
    gravity_Nm = 0.0 if torque_Nm is None else 10.0
    config = config_with(tmp_path, joint__gravity_Nm=gravity_Nm, virtual__gravity_Nm=gravity_Nm)
    plan = make_plan(config, torque_Nm)
    report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.1, 0.06, 1e-5)
    made = CheckMotion(config_of_check(config, plan), plan).constants(report, motion_table(plan, 0.1))[0].limits
    assert made.frozen_torque_Nm == pytest.approx(watched_Nm)
    assert made.frozen_torque_Nm < plan.torque_Nm


def test_the_motion_is_smooth_and_ends_where_it_begins(tmp_path: Path) -> None:
    plan = make_plan(config_with(tmp_path), None)
    table = motion_table(plan, 0.3)
    assert table[0, 1] == table[-1, 1] == pytest.approx(0.3)
    assert np.ptp(table[:, 1]) == pytest.approx(2.0 * plan.travel_rad)
    assert np.abs(table[:, 2]).max() < plan.velocity_radps / 2.0
    assert np.all(np.diff(table[:, 0]) > 0.0)


@pytest.mark.parametrize(("start_rad", "refused"), [(0.659, False), (0.661, True), (-0.659, False), (-0.661, True)])
def test_room_on_both_sides_is_needed(tmp_path: Path, start_rad: float, refused: bool) -> None:
    config = config_with(tmp_path)
    plan = make_plan(config, None)
    if not refused:
        CheckMotion(config, plan).require_start(start_rad)
        return
    with pytest.raises(ConfigurationError, match=r"needs \[-0\.66\.\.0\.66\]"):
        CheckMotion(config, plan).require_start(start_rad)


def test_a_coarse_encoder_takes_more_travel_and_time_and_is_told_so(tmp_path: Path) -> None:
    fine = make_plan(config_with(tmp_path), None)
    config = config_with(tmp_path, encoder__counts_per_turn=4096)
    plan = make_plan(config, None)
    assert plan.travel_rad == pytest.approx(60.0 * math.tau / 4096)
    assert np.abs(motion_table(plan, 0.1)[:, 2]).max() == pytest.approx(np.abs(motion_table(fine, 0.1)[:, 2]).max())
    assert plan.duration_s == pytest.approx(motion_table(plan, 0.1)[-1, 0] + APPROACH_MIN_S)
    assert plan.velocity_radps == config.limits.velocity_max_radps == 1.0  # never more than the user's
    config = config_with(tmp_path, encoder__counts_per_turn=8192)
    assert make_plan(config, None).velocity_radps > 2.0 * velocity_of_a_count_radps(config) > fine.velocity_radps
    report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.1, 0.06, 1e-5)
    assert "braked beyond 0.23 rad to either side" in " ".join(CheckMotion(config, plan).placed(report).lines)
    coarsest = config_with(tmp_path, encoder__counts_per_turn=512, control__velocity_cutoff_Hz=10.0)
    assert make_plan(coarsest, None).travel_rad == 0.3


@pytest.mark.parametrize(
    ("side", "own", "per_motor_turn", "status"),
    [
        ("motor", 65536, 65536.0, OK), ("motor", 131072, 65536.0, NOTE), ("joint", 524288, 524288.0, OK),
        ("joint", 524288, 524288.0 / 121.0, OK), ("joint", 262144, 524288.0, NOTE),
    ],
)  # fmt: skip
def test_the_drives_own_counts(tmp_path: Path, side: str, own: int, per_motor_turn: float, status: str) -> None:
    config = config_with(tmp_path, encoder__side=side, encoder__counts_per_turn=own)
    found = judged(config, per_motor_turn)
    assert found.status == status
    assert (found.cure == "") is (status == OK)
