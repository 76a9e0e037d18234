"""`check` of an arm: bus budgets, margins over the poses, and the files that `new --arm` writes."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, MarginError, UsageError
from jointctl.tools.analysis.arm_check import (
    MOST_POSES,
    PoseRange,
    bus_budgets,
    joint_loop,
    joint_loops,
    pose_ranges,
    poses,
    require_budgets,
)
from jointctl.tools.analysis.linear_loop import RigidJoint, loop_settings
from jointctl.tools.analysis.margins import margins
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.config import Config, Learning
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import JointEncoder, Reducer
from jointctl.tools.verbs.check import check
from jointctl.tools.verbs.new import DriveOptions, new
from tests.arms import long_arm
from tests.sessions import output

SECOND = JointEncoder(source="drive", counts_per_turn=2**19, direction=1, zero_counts=0, disagreement_max_rad=0.02)


@pytest.fixture(scope="module")
def arm() -> ArmConfig:
    return load_arm(SHIPPED_ARM)


def of(arm: ArmConfig, *joints: Config) -> ArmConfig:
    """An arm of these joints, for its buses alone."""
    return replace(arm, joints=joints, names=tuple(f"joint{i}" for i in range(len(joints))))


def at_rate(config: Config, rate_Hz: float) -> Config:
    return config.changed(loop__rate_Hz=rate_Hz)


def on_bus(config: Config, channel: str) -> Config:
    return config.changed(bus__channel=channel)


def test_the_budgets_that_the_documentation_gives(arm: ArmConfig) -> None:
    one = arm.joints[0]
    with_second = one.changed(joint_encoder=SECOND)
    assert bus_budgets(arm)[0].load == pytest.approx(0.745)
    assert bus_budgets(of(arm, *[at_rate(one, 500.0)] * 7))[0].load == pytest.approx(0.8325)
    assert bus_budgets(of(arm, *[with_second] * 3))[0].load == pytest.approx(1.03)


def test_a_bus_that_is_too_slow_is_refused_with_the_rate_that_fits(arm: ArmConfig) -> None:
    with_second = arm.joints[0].changed(joint_encoder=SECOND)
    with pytest.raises(ConfigurationError) as caught:
        require_budgets(of(arm, *[with_second] * 3))
    words = "bus virtual0: 3 joints (joint0, joint1, joint2) need 1030 bits a cycle, 103.0% of the bus"
    assert words in str(caught.value)
    assert caught.value.hint.startswith("500 Hz fits")
    assert "they fit on 2 buses, as 2 + 1 joints" in caught.value.hint
    require_budgets(of(arm, *[at_rate(with_second, 500.0)] * 3))


@pytest.mark.parametrize(
    ("count", "rate_Hz", "hint"),
    [(7, 1000.0, "on 3 buses, as 3 + 3 + 1 joints"),
     (4, 2000.0, "on 4 buses, "), (2, 4000.0, "one of them alone is too much for a bus")],
)  # fmt: skip
def test_so_many_buses_as_are_needed_are_named(arm: ArmConfig, count: int, rate_Hz: float, hint: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        require_budgets(of(arm, *[at_rate(arm.joints[0], rate_Hz)] * count))
    assert hint in caught.value.hint


def test_joints_on_two_buses_share_neither(arm: ArmConfig) -> None:
    with_second = arm.joints[0].changed(joint_encoder=SECOND)
    budgets = require_budgets(of(arm, with_second, on_bus(with_second, "other"), with_second))
    assert [(budget.channel, budget.bits) for budget in budgets] == [("virtual0", 705), ("other", 380)]


def test_inertias_and_gravity_over_the_poses(arm: ArmConfig) -> None:
    """The wrist's are those of one body; the shoulder's greatest is that of the stretched arm."""
    ranges = pose_ranges(arm)
    wrist = 0.12 + 0.0012 + 0.7 * 0.05**2 + 1.0 * 0.1**2
    assert (ranges[2].least_kgm2, ranges[2].greatest_kgm2) == pytest.approx((wrist, wrist))
    stretched = 1.2 + 0.075 + 4.6 * 0.19**2 + 0.028 + 2.4 * (0.51**2 + 0.01**2) + 0.0012 + 0.7 * 0.70**2 + 1.0 * 0.75**2
    assert ranges[0].greatest_kgm2 == pytest.approx(stretched)
    assert ranges[0].least_kgm2 < 0.65 * stretched
    assert ranges[2].gravity_Nm == pytest.approx(9.81 * (0.7 * 0.05 + 0.1), rel=0.02)


def test_joints_that_turn_all_round_are_looked_at_between_whole_turns(tmp_path: Path) -> None:
    """Ends that are a turn apart are one pose; seven joints leave a grid with their ends and middles alone."""
    path = long_arm(tmp_path)
    long = load_arm(path)
    turning = replace(long, joints=tuple(
        c.changed(limits__position_min_rad=-math.tau, limits__position_max_rad=math.tau) for c in long.joints
    ))  # fmt: skip
    within, beyond = pose_ranges(long), pose_ranges(turning)
    for one, other in zip(within[:4], beyond[:4], strict=True):
        assert other.greatest_kgm2 == pytest.approx(one.greatest_kgm2, rel=1e-3)  # stretched
        assert other.least_kgm2 < 0.5 * (one.least_kgm2 + one.greatest_kgm2)


def test_many_joints_take_no_more_poses(tmp_path: Path) -> None:
    long = load_arm(long_arm(tmp_path))
    many = replace(long, joints=long.joints * 2)
    found = np.array(list(poses(many)))
    assert MOST_POSES <= len(found) <= 2 * MOST_POSES
    for column in found.T:
        assert -1.4 <= column.min() < -1.39
        assert 1.39 < column.max() <= 1.4


def test_a_smaller_inertia_is_a_higher_gain(arm: ArmConfig) -> None:
    """With an inertia that the law does not believe the gain margin is that of the believed one, times their ratio."""
    settings, _ = loop_settings(arm.joints[0])
    lighter = replace(settings, joints=(RigidJoint(0.5 * settings.inertia_kgm2, "light"),))
    assert margins(lighter).gain_margin_up == pytest.approx(0.5 * margins(settings).gain_margin_up, rel=1e-6)
    assert margins(lighter).joint == "light"


def test_each_joint_has_its_margin_in_the_worst_pose(arm: ArmConfig) -> None:
    for loop in joint_loops(arm):
        assert loop.margins.phase_margin_deg >= 30.0
        alone, _ = loop_settings(loop.config)
        assert loop.margins.phase_margin_deg <= margins(alone).phase_margin_deg + 1e-9


def test_a_joint_that_swings_in_one_pose_is_refused(arm: ArmConfig) -> None:
    control = arm.joints[0].control
    quick = control.model_copy(update={"kp": 3.0 * control.kp, "kv": 1.8 * control.kv})
    joints = (arm.joints[0].changed(control=quick), *arm.joints[1:])
    with pytest.raises(MarginError) as caught:
        check(replace(arm, joints=joints), output()[0])
    assert str(caught.value).startswith("joint shoulder: ")
    assert re.search(r"worst case: inertia 1\.83 kg m2", str(caught.value))


def test_gravity_beyond_the_torque_is_refused(arm: ArmConfig) -> None:
    joints = (arm.joints[0].changed(limits__torque_max_Nm=30.0), *arm.joints[1:])
    with pytest.raises(ConfigurationError, match=r"joint shoulder: gravity reaches 32\.7 Nm"):
        joint_loops(replace(arm, joints=joints))


def test_check_refuses_what_the_gate_of_a_run_refuses(arm: ArmConfig) -> None:
    learning = Learning(gain=1.0, error_gain_ps2=1e5, lead_cycles=0, half_width_cycles=0)
    joints = (*arm.joints[:2], arm.joints[2].changed(control__adaptation=None, control__learning=learning))
    with pytest.raises(MarginError, match="wrist: iterative learning would diverge"):
        check(replace(arm, joints=joints), output()[0])


def test_check_says_of_an_arms_joints_what_it_says_of_a_joint_alone(arm: ArmConfig) -> None:
    first, *others = arm.joints
    assert first.joint.torque_constant_NmpA == 0.1
    out, shown, said = output(json=True)
    assert check(of(arm, first.changed(joint__torque_constant_NmpA=1.0), *others), out) == 0
    (warning,) = json.loads(shown.getvalue())["warnings"]
    assert "shoulder.toml: joint.torque_constant_NmpA (=1 in the drive" in warning
    assert "shoulder.toml: joint.torque_constant_NmpA" in " ".join(said.getvalue().split())
    out, shown, said = output(json=True)
    assert check(arm, out) == 0
    assert json.loads(shown.getvalue())["warnings"] == []
    assert said.getvalue() == ""


def test_check_refuses_a_bus_that_no_arm_runs_on(arm: ArmConfig) -> None:
    *others, last = arm.joints
    with pytest.raises(ConfigurationError, match=r"bus.interface \(=pcan\) must be one of socketcan, jointctl"):
        check(of(arm, *others, last.changed(bus__interface="pcan")), output()[0])


def test_the_files_of_an_arm_of_ones_own(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    assert new(folder, output()[0], arm=True) == 0
    assert check(load_arm(folder / "arm.toml"), output()[0]) == 0
    with pytest.raises(DataError, match="exists already"):
        new(folder, output()[0], arm=True)
    with pytest.raises(UsageError, match="--arm asks no drive"):
        new(tmp_path / "other", output()[0], arm=True, drive=DriveOptions("virtual"))


def test_a_flexible_joint_bears_the_links_of_its_poses(arm: ArmConfig) -> None:
    config = load_config(shipped_config("precise"))
    reducer = Reducer(motor_inertia_kgm2=1.2, stiffness_Nmprad=1e5)
    flexible = config.changed(reducer=reducer)
    for least, greatest, expected in ((1.65, 2.55, [0.45, 0.9, 1.35]), (2.1, 2.1, [0.63, 0.9, 1.26])):
        loop = joint_loop("one", flexible, PoseRange(least, greatest, 0.0))
        links = {joint.link_kgm2 for joint in loop.settings.joints if not isinstance(joint, RigidJoint)}
        assert sorted(links) == pytest.approx(expected)  # of margin.payload_range at least
