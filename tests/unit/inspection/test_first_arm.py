"""`new --arm --urdf`: the files of an arm of one's own, which check, hil and run take as they are."""

from __future__ import annotations

import io
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, UsageError
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.arm_check import joint_loops, pose_ranges, require_budgets
from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.load import load_config
from jointctl.tools.lockstep import LockstepArm
from jointctl.tools.session.plan import resolve_arm
from jointctl.tools.verbs.demo import demo
from jointctl.tools.verbs.new import DriveOptions, new
from tests.arms import long_arm
from tests.sessions import output

_LINK = (
    '<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="{mass}"/>'
    '<inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial></link>'
)


def robot(joints: str, masses: tuple[float, ...] = (3.0, 2.0)) -> str:
    links = "".join(_LINK.format(name=f"l{k + 1}", mass=mass, i=0.02 * mass) for k, mass in enumerate(masses))
    return f'<robot name="r"><link name="base"/>{links}{joints}</robot>'


def joint(k: int, limit: str, kind: str = "revolute", name: str = "") -> str:
    parent = "base" if k == 1 else f"l{k - 1}"
    return (
        f'<joint name="{name or f"j{k}"}" type="{kind}"><parent link="{parent}"/><child link="l{k}"/>'
        f'<origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>{limit}</joint>'
    )


LIMIT = '<limit lower="-1.2" upper="2.5" velocity="2.0" effort="{effort}"/>'
TURNS = '<limit velocity="3.0" effort="20"/>'
GOOD = robot(joint(1, LIMIT.format(effort=60)) + joint(2, TURNS, "continuous"))


def made(folder: Path, text: str, joints: str = "") -> Path:
    urdf = folder / "own robot.urdf"
    urdf.write_text(text)
    out, _, _ = output()
    assert new(folder / "arm", out, arm=True, urdf=urdf, joints=joints, no_input=True) == 0
    return folder / "arm" / "arm.toml"


def test_what_the_urdf_says_is_in_the_files(tmp_path: Path) -> None:
    path = made(tmp_path, GOOD)
    assert (path.parent / "own robot.urdf").read_text() == GOOD
    arm = load_arm(path)
    assert arm.names == ("j1", "j2")
    first, second = (load_config(path.parent / f"{name}.toml") for name in arm.names)  # each alone as well
    limits = first.limits
    assert (limits.position_min_rad, limits.position_max_rad) == (-1.2, 2.5)
    assert (limits.velocity_max_radps, limits.torque_max_Nm) == (2.0, 60.0)
    assert (second.limits.velocity_max_radps, second.limits.torque_max_Nm) == (3.0, 20.0)
    assert -math.pi < second.limits.position_min_rad < -3.0
    assert [canopen_section(config).node for config in arm.joints] == [1, 2]
    for config, found in zip(arm.joints, pose_ranges(arm), strict=True):
        assert found.least_kgm2 * 0.999 <= config.joint.inertia_kgm2 <= found.greatest_kgm2 * 1.001
        drive = canopen_section(config)
        at_joint_Nm = drive.rated_torque_Nm * config.joint.reduction_ratio * drive.max_torque_permille / 1000
        assert config.limits.torque_max_Nm <= at_joint_Nm <= 1.02 * config.limits.torque_max_Nm


def test_its_loops_have_their_margins_and_it_moves_in_lockstep(tmp_path: Path) -> None:
    arm = load_arm(made(tmp_path, GOOD))
    require_budgets(arm)
    for loop in joint_loops(arm):
        assert loop.margins.stable
        assert loop.margins.phase_margin_deg >= loop.config.margin.min_phase_margin_deg
    lockstep = LockstepArm(arm)
    constants = lockstep.constants()
    constants.trajectory.duration_s[:] = 3.0
    for run in lockstep.run(constants):
        assert run.fault is Fault.NONE
        assert np.max(np.abs(run.true_error_rad[run.tracking])) < 2e-3


@pytest.mark.parametrize("effort", [0.05, 1.5, 4.53, 400.0])
def test_whatever_the_effort_the_gains_suit_the_poses_and_the_drive_has_it(tmp_path: Path, effort: float) -> None:
    text = robot(joint(1, LIMIT.format(effort=effort)), (effort / 100.0,))
    arm = load_arm(made(tmp_path, text))
    LockstepArm(arm)  # commissions: the drive's rated torque is in whole mNm
    (loop,) = joint_loops(arm)
    assert loop.margins.phase_margin_deg >= loop.config.margin.min_phase_margin_deg


def test_seven_joints_get_the_rate_that_one_bus_carries(tmp_path: Path) -> None:
    (tmp_path / "long").mkdir()
    arm = load_arm(made(tmp_path, (long_arm(tmp_path / "long").parent / "arm.urdf").read_text()))
    assert arm.rate_Hz == 500.0
    require_budgets(arm)
    assert len({canopen_section(config).node for config in arm.joints}) == 7


@pytest.mark.parametrize("limit", [
    '<limit lower="-3.0718" upper="-0.0698" velocity="2.175" effort="87"/>',  # its range is beside 0
    '<limit lower="-0.0175" upper="3.7525" velocity="2.61" effort="12"/>',
    '<limit lower="-1.5" upper="1.5" velocity="30" effort="60"/>',  # on by more than the template's jump in a period
])  # fmt: skip
def test_limits_that_are_not_like_the_templates(tmp_path: Path, limit: str) -> None:
    arm = load_arm(made(tmp_path, robot(joint(1, limit), (1.0,))))
    (config,) = arm.joints
    assert config.limits.position_jump_max_rad >= max(0.02, config.limits.velocity_max_radps / arm.rate_Hz)
    load_config(config.path)  # alone as well
    require_budgets(arm)
    joint_loops(arm)


@pytest.mark.parametrize(("speed", "effort", "key"), [(50, 60, "stop_timeout_s"), (2, 20000, "rated_current_A")])
def test_limits_that_make_no_file_say_where_they_come_from(
    tmp_path: Path, speed: float, effort: float, key: str
) -> None:
    with pytest.raises(ConfigurationError, match=key) as caught:
        made(tmp_path, robot(joint(1, f'<limit lower="-1" upper="1" velocity="{speed}" effort="{effort}"/>'), (9.0,)))
    assert caught.value.hint.startswith("nothing was written: it is made of the limits in own robot.urdf")
    assert not (tmp_path / "arm").exists()


def test_joints_that_are_not_named_stand_at_0(tmp_path: Path) -> None:
    arm = load_arm(made(tmp_path, GOOD, joints="j1"))
    assert arm.names == ("j1",)
    assert any("j2" in remark and "stands at 0" in remark for remark in arm.remarks)


def test_names_that_are_no_file_names(tmp_path: Path) -> None:
    odd = 'a/"b"\u00e9 ..'
    limit = LIMIT.format(effort=60)
    text = robot(joint(1, limit, name="arm") + joint(2, limit, name=odd.replace('"', "&quot;")))
    arm = load_arm(made(tmp_path, text))
    assert arm.names == ("arm", odd)
    plan = resolve_arm(arm).arm
    assert plan is not None
    assert len({joint.log_path.name for joint in plan.joints}) == 2
    assert all(config.path.parent == tmp_path / "arm" for config in arm.joints)
    assert len({config.path.name.lower() for config in arm.joints} | {"arm.toml"}) == 3


def test_names_too_long_for_a_file_system(tmp_path: Path) -> None:
    limit = LIMIT.format(effort=60)
    text = robot(joint(1, limit, name="\u00e9" * 400) + joint(2, limit, name="\u00e9" * 401))
    assert [len(name) for name in load_arm(made(tmp_path, text)).names] == [400, 401]


def test_what_check_remarks_is_said_at_once(tmp_path: Path) -> None:
    finger = '<joint name="f" type="revolute"><parent link="l2"/><child link="f"/><mimic joint="j1"/></joint>'
    odd = GOOD.replace("</robot>", f'<link name="f"/>{finger}</robot>')
    (tmp_path / "odd.urdf").write_text(odd)
    out, _, said = output()
    assert new(tmp_path / "arm", out, arm=True, urdf=tmp_path / "odd.urdf", no_input=True) == 0
    assert "mimics j1: for the model it stands at 0" in " ".join(said.getvalue().split())


@pytest.mark.parametrize(("effort", "told"), [(3, True), (5, False)])
def test_a_joint_that_gravity_is_too_much_for_is_named(tmp_path: Path, effort: int, told: bool) -> None:
    (tmp_path / "own.urdf").write_text(robot(joint(1, LIMIT.format(effort=effort)), (4.0,)))  # 3.92 Nm, stretched
    out, _, said = output()
    assert new(tmp_path / "arm", out, arm=True, urdf=tmp_path / "own.urdf", no_input=True) == 0
    words = "joint j1: gravity reaches 3.92 Nm within the joints' limits, and limits.torque_max_Nm (=3) of j1.toml"
    assert (words in " ".join(said.getvalue().split())) is told


@pytest.mark.parametrize(
    ("text", "joints", "said"),
    [
        (robot(joint(1, LIMIT.format(effort=0)), (1.0,)), "", "joint j1: limit effort (=0) must be above 0"),
        (robot(joint(1, '<limit lower="-1" upper="1"/>'), (1.0,)), "", "<limit> must have velocity, effort"),
        (robot(joint(1, ""), (1.0,)), "", "<limit> must have lower, upper, velocity, effort"),
        (robot(joint(1, LIMIT.format(effort=9), "prismatic"), (1.0,)), "", "0 joints turn, must be 1 to 16"),
        (robot(joint(1, LIMIT.format(effort=9)), (1.0,)), "j7", "j7 must be a joint of own robot.urdf that turns"),
        (robot(joint(1, LIMIT.format(effort=9)), (1.0,)), "j1,j1", "must not name a joint twice"),
        (GOOD.replace('<link name="l2">', '<link name="l2"/><link name="l9">'), "", "one link must have no joint"),
        ("no xml", "", "not valid XML"),
    ],
)
def test_what_makes_no_arm_is_said_in_one_line_and_nothing_is_written(
    tmp_path: Path, text: str, joints: str, said: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        made(tmp_path, text, joints)
    assert said in str(caught.value)
    assert ("--joints" if joints else "own robot.urdf") in str(caught.value)
    assert not (tmp_path / "arm").exists()


def test_it_overwrites_nothing_and_its_options_go_together(tmp_path: Path) -> None:
    path, (out, _, _) = made(tmp_path, GOOD), output()
    before = path.read_bytes()
    urdf = tmp_path / "own robot.urdf"
    with pytest.raises(DataError, match="exists already"):
        new(path.parent, out, arm=True, urdf=urdf, no_input=True)
    assert path.read_bytes() == before
    with pytest.raises(UsageError, match="--arm"):
        new(tmp_path / "x.toml", out, urdf=urdf)
    with pytest.raises(UsageError, match="--urdf"):
        new(tmp_path / "x", out, arm=True, joints="j1")
    with pytest.raises(UsageError, match=r"--from \(=csp\) is for a joint's file"):
        new(tmp_path / "x", out, arm=True, shipped="csp")
    with pytest.raises(UsageError, match=r"--from \(=arm\) is an arm"):
        new(tmp_path / "x.toml", out, shipped="arm")
    assert not (tmp_path / "x.toml").exists()
    with pytest.raises(UsageError, match=r"--config \(=csp\) is for one joint"):
        demo(Path("csp"), arm=True, output=out)
    with pytest.raises(UsageError, match="no drive"):
        new(tmp_path / "x", out, arm=True, urdf=urdf, drive=DriveOptions(node=1))
    with pytest.raises(UsageError, match="no terminal"):
        new(tmp_path / "x", out, arm=True, urdf=urdf)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        new(tmp_path / "x", out, arm=True, urdf=tmp_path / "none.urdf", no_input=True)
    with pytest.raises(ConfigurationError, match="must be a URDF file"):
        new(tmp_path / "x", out, arm=True, urdf=SHIPPED_ARM, no_input=True)


def answered(folder: Path, monkeypatch: pytest.MonkeyPatch, answers: str) -> Path:
    """The URDF that is asked about at a terminal that gives these lines."""
    urdf = folder / "own.urdf"
    urdf.write_text(GOOD)
    stdin = io.StringIO(answers)
    stdin.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdin", stdin)
    return urdf


def test_questions_and_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    urdf = answered(tmp_path, monkeypatch, "7\n\n-3\nmany\n9\n0.5\n")
    out, _, err = output()
    assert new(tmp_path / "arm", out, arm=True, urdf=urdf) == 0
    arm = load_arm(tmp_path / "arm" / "arm.toml")
    assert [canopen_section(config).node for config in arm.joints] == [7, 9]
    assert arm.arm.motor_inertia_kgm2 is not None
    assert np.allclose(arm.arm.motor_inertia_kgm2, (1.2 * 60.0 / 145.0, 0.5), rtol=5e-3)
    said = err.getvalue()
    assert re.search(r"drive.node \(=-3\)", said)
    assert "drive.node (=many)" in said


def test_ctrl_c_at_a_question_says_that_nothing_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> str:
        raise KeyboardInterrupt

    urdf = answered(tmp_path, monkeypatch, "")
    monkeypatch.setattr(sys.stdin, "readline", interrupted)
    out, _, _ = output()
    with pytest.raises(KeyboardInterrupt, match=r"^; nothing was written$"):
        new(tmp_path / "arm", out, arm=True, urdf=urdf)
    assert not (tmp_path / "arm").exists()


def test_two_joints_with_one_node_are_refused_with_the_names_of_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    urdf = answered(tmp_path, monkeypatch, "7\n\n7\n\n")
    out, _, _ = output()
    with pytest.raises(ConfigurationError, match=r"arm/arm\.toml: j2\.toml: drive\.node \(=7\) must differ"):
        new(tmp_path / "arm", out, arm=True, urdf=urdf)
    assert not (tmp_path / "arm").exists()
