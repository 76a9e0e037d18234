"""Arm files: what is read, and one clear line for each thing that cannot be."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.arm_model import newton_euler
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.configuration.records import trajectory_table
from jointctl.tools.configuration.urdf import read_urdf
from tests.places import CONFIGS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the shipped arm."""
    return Path(shutil.copytree(SHIPPED_ARM.parent, tmp_path / "arm"))


def change(path: Path, pattern: str, text: str) -> None:
    """Replace one place of a file; it must be there."""
    found, count = re.subn(pattern, text, path.read_text(), count=1, flags=re.S)
    assert count == 1, f"{pattern} is not in {path.name}"
    path.write_text(found)


def problem(folder: Path) -> str:
    with pytest.raises(ConfigurationError) as caught:
        load_arm(folder / "arm.toml")
    message = caught.value.message
    assert "\n" not in message, message
    return message


def test_the_shipped_arm_is_the_one_that_pinocchio_reads() -> None:
    """Torques of the whole model, payload and motors included, against another reader and another algorithm."""
    arm = load_arm(SHIPPED_ARM)
    model = pin.buildModelFromUrdf(str(SHIPPED_ARM.parent / "arm.urdf"))
    payload = pin.Inertia(arm.arm.payload_kg, np.array(arm.arm.payload_at_m), np.zeros((3, 3)))
    model.appendBodyToJoint(3, payload, pin.SE3.Identity())
    model.armature = np.array(arm.arm.motor_inertia_kgm2)
    memory = arm.model.memory()
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, v, a = rng.normal(size=(3, 3))
        for own, *motion in zip(memory.motion, q, v, a, strict=False):
            own.position_rad, own.velocity_radps, own.acceleration_radps2 = motion
        newton_euler(memory)
        np.testing.assert_allclose(
            memory.motion.torque_Nm[:3], pin.rnea(model, model.createData(), q, v, a), rtol=1e-11
        )


URDF = """<robot name="skew">
  <link name="world"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.1 0.4 -1.2"/></joint>
  <link name="base"><inertial><mass value="9"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="a" type="continuous"><parent link="base"/><child link="one"/><origin xyz="0 0.1 0.2" rpy="0.3 0 0.7"/>
    <axis xyz="1 2 -0.5"/></joint>
  <link name="one"><inertial><origin xyz="0.1 0 0.02" rpy="0.2 0.5 0.1"/><mass value="2"/>
    <inertia ixx="0.02" ixy="0.003" ixz="0.001" iyy="0.03" iyz="-0.002" izz="0.025"/></inertial></link>
  <joint name="flange" type="fixed"><parent link="one"/><child link="plate"/>
    <origin xyz="0.2 0 0" rpy="0 1.1 0"/></joint>
  <link name="plate"><inertial><origin xyz="0 0.05 0"/><mass value="0.5"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.0015"/></inertial></link>
  <joint name="finger" type="prismatic"><parent link="plate"/><child link="tip"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.05" velocity="1" effort="10"/></joint>
  <link name="tip"><inertial><mass value="0.1"/>
    <inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link>
  <joint name="b" type="revolute"><parent link="plate"/><child link="two"/><origin xyz="0.3 0 0" rpy="0 0 0.9"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" velocity="9" effort="900"/></joint>
  <link name="two"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.004"/></inertial></link>
</robot>"""


def test_a_link_whose_mass_is_that_of_what_is_fixed_to_it(folder: Path) -> None:
    """Some programs write a frame that moves, and its body beyond a fixed joint: the same arm."""
    before = load_arm(folder / "arm.toml")
    fixed = '</link><joint name="f" type="fixed"><parent link="hand"/><child link="body"/></joint><link name="body">'
    change(folder / "arm.urdf", r'(<link name="hand">)', r"\1" + fixed)
    arm = load_arm(folder / "arm.toml")
    mass_kg = before.bodies[-1].mass.mass_kg
    words = (
        f"link hand, which joint wrist moves, has no <inertial>: it has the mass of what is fixed to it, {mass_kg:.3g}"
    )
    assert [line for line in arm.remarks if line not in before.remarks] == [f"arm.urdf: {words} kg"]
    assert arm.model.links.tobytes() == before.model.links.tobytes()


def test_fixed_parts_skew_axes_and_joints_that_are_not_the_arms(folder: Path) -> None:
    (folder / "arm.urdf").write_text(URDF)
    change(folder / "arm.toml", r'\["shoulder.toml.*?\]', '["shoulder.toml", "elbow.toml"]')
    change(folder / "arm.toml", r"joint_names = \[.*?\]", 'joint_names = ["a", "b"]')
    change(folder / "arm.toml", r"motor_inertia_kgm2 = \[.*?\]", "motor_inertia_kgm2 = [0.0, 0.0]")
    change(
        folder / "arm.toml", r"\[motion\].*", '[motion]\nkind = "hold"\nduration_s = 1.0\nposition_rad = [0.0, 0.0]\n'
    )
    arm = load_arm(folder / "arm.toml")
    assert arm.remarks == ("joint finger of arm.urdf is not the arm's: it stands at 0",)
    whole = pin.buildModelFromXML(URDF)
    model = pin.buildReducedModel(whole, [whole.getJointId("finger")], pin.neutral(whole))
    frame = model.frames[model.getFrameId("two")]
    model.appendBodyToJoint(
        frame.parentJoint,
        pin.Inertia(arm.arm.payload_kg, np.array(arm.arm.payload_at_m), np.zeros((3, 3))), frame.placement,
    )  # fmt: skip
    memory = arm.model.memory()
    q, v, a = np.array([0.4, -0.9]), np.array([1.0, 2.0]), np.array([-3.0, 2.0])
    for own, *motion in zip(memory.motion, q, v, a, strict=False):
        own.position_rad, own.velocity_radps, own.acceleration_radps2 = motion
    newton_euler(memory)
    turned = np.array([np.cos(q[0]), np.sin(q[0]), q[1]])  # a joint without limits is a point of the circle
    np.testing.assert_allclose(
        memory.motion.torque_Nm[:2], pin.rnea(model, model.createData(), turned, v, a), rtol=1e-11
    )


def test_each_joint_gets_its_part_of_the_motion() -> None:
    arm = load_arm(SHIPPED_ARM)
    assert [config.trajectory.amplitude_rad for config in arm.joints] == [0.6, 0.7, 0.6]
    constants = arm.axis_constants([trajectory_table(config) for config in arm.joints], [0.1, 0.1, 0.1])
    assert set(constants.trajectory.kind) == {TrajectoryKind.SINE}
    assert len(set(constants.sequence.approach_s)) == 1
    assert constants.law.of_arm.all()


def test_a_move_ends_for_all_joints_at_once_within_every_limit(folder: Path) -> None:
    text = '[motion]\nkind = "min_jerk"\nduration_s = 5.0\nstart_rad = [0, 0, 0]\ntarget_rad = [0.5, -1.5, 0.1]\n'
    change(folder / "arm.toml", r"\[motion\].*", text)
    arm = load_arm(folder / "arm.toml")
    times = [config.trajectory.move_s for config in arm.joints]
    peaks = [1.875 * way / times[0] for way in (0.5, 1.5, 0.1)]
    shares = [peak / config.limits.velocity_max_radps for peak, config in zip(peaks, arm.joints, strict=True)]
    assert len(set(times)) == 1
    assert max(shares) == pytest.approx(0.9, rel=1e-3)


def test_a_table_has_a_column_for_each_joint(folder: Path) -> None:
    rows = ["time_s,elbow_rad,wrist_rad,shoulder_rad", "0,0.0,0.1,0.2", "1,0.1,0.2,0.3", "2,0.0,0.1,0.2"]
    (folder / "way.csv").write_text("\n".join(rows) + "\n")
    change(folder / "arm.toml", r"\[motion\].*", '[motion]\nkind = "table"\nduration_s = 2.0\nfile = "way.csv"\n')
    arm = load_arm(folder / "arm.toml")
    starts = [trajectory_table(config)[0, 1] for config in arm.joints]
    assert starts == [0.2, 0.0, 0.1]


IN_URDF: list[tuple[str, str, str]] = [
    (r"<inertial>\s*<origin xyz=\"0.16.*?</inertial>", "", "link forearm, which joint elbow moves, has no <inertial>"),
    (r'<mass value="2.4"/>', '<mass value="2400"/>', "link forearm: mass (='2400') must be within 1000; grams"),
    (r'xyz="0.35 0 0"', 'xyz="350 0 0"', "joint elbow: xyz (='350 0 0') must be within 10; millimetres"),
    (
        r'lower="-2.1"',
        'lower="-120"',
        "joint elbow: limit lower (='-120') must be within 12.57",
    ),
    (r'ixx="0.004" ixy="0" ixz="0.001"', 'ixx="0.4" ixy="0" ixz="0"', "link forearm: the principal moments"),
    (r'iyy="0.028"', 'iyy="28000"', "link forearm: iyy (='28000') must be within 240; kg mm2"),
    (r'<parent link="forearm"/>', '<parent link="hand"/>', "joint wrist is in a loop"),
    (
        r'<child link="hand"/>',
        '<child link="forearm"/>',
        "link forearm has two joints above it, elbow and wrist: a loop",
    ),
    (r'<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "joint shoulder: axis must not be 0 0 0"),
    (r'name="wrist" type="revolute"', 'name="wrist" type="planar"', "joint wrist: type (=planar) must be one of"),
    (r'name="wrist" type="revolute"', 'name="wrist" type="prismatic"', "joint wrist (=prismatic) must be revolute"),
    (r'name="wrist"', 'name="hand_turn"', "arm.joint_names: wrist must be a joint of arm.urdf that moves by itself"),
    (r"<robot", "<!DOCTYPE robot><robot", "must have no DOCTYPE"),
    (r'lower="-2.1"', 'lower="2.2"', "joint elbow: limit lower (=2.2) must be below upper (=2.1)"),
    (r'xyz="0.30 0 0"', 'xyz="0.30 0 0" rpy="0 10 0"', "joint wrist: rpy (='0 10 0') must be within 6.284; degrees"),
    (r'xyz="0.30 0 0"', 'xyz="0.30 0 0" rpy="0 90 0"', "joint wrist: rpy (='0 90 0') must be within 6.284; degrees"),
    (r'xyz="0.30 0 0"', 'xyz="0.30 0 0" rpy="0 0 -5"', "joint wrist: rpy has the angle -5, more than half a turn"),
    (
        r'<origin xyz="0.05 0 0"/>',
        '<origin xyz="0.05 0 0" rpy="90 0 0"/>',
        "link hand: inertial: rpy (='90 0 0') must be within 6.284; degrees",
    ),
    (r'<limit lower="-2.0".*?/>', "", "joint wrist in arm.urdf: <limit> must have lower, upper, velocity, effort"),
    (r'lower="-2.0" ', "", "joint wrist in arm.urdf: <limit> must have lower"),
    (
        r'(<limit lower="-2.0".*?/>)',
        r'\1<safety_controller soft_lower_limit="1" soft_upper_limit="1" k_velocity="0"/>',
        "joint wrist: limit lower (=1) must be below upper (=1), with those of <safety_controller>",
    ),
    (
        r'(<limit lower="-2.0".*?/>)',
        r'\1<safety_controller soft_upper_limit="90" k_velocity="0"/>',
        "joint wrist: safety_controller soft_upper_limit (='90') must be within 12.57; degrees",
    ),
    (r'velocity="4.2"', 'velocity="0"', "joint wrist in arm.urdf: limit velocity (=0) must be above 0"),
    (r'effort="25"', 'effort="-25"', "joint wrist in arm.urdf: limit effort (=-25) must be above 0"),
    (
        r'revolute"(.*?)effort="150"',
        r'continuous"\1effort="0"',
        "joint shoulder in arm.urdf: limit effort (=0) must be above 0",
    ),
    (r'<mass value="0.7"/>', '<mass value="0"/>', "link hand: mass (=0) must be at least 1e-06 kg"),
    (r'<mass value="0.7"/>', "<mass/>", "link hand: <inertial> has no <mass> with value"),
    (r'<mass value="0.7"/>', '<mass value="1e400"/>', "link hand: mass (='1e400') must be within 1000"),
    (r'ixx="0.0006" ', "", "link hand: <inertial> has no <inertia> with ixx"),
    (r'ixx="0.0006"', 'ixx="0.006"', "link hand: the principal moments of its inertia"),
    (r'ixx="0.0006"', 'ixx="-0.0006"', "link hand: the principal moments of its inertia"),
    (
        r'ixx="0.0006" ixy="0" ixz="0" iyy="0.0012" iyz="0" izz="0.0010"',
        'ixx="6" ixy="0" ixz="0" iyy="12" iyz="0" izz="10"',
        "link hand: its inertia (=12 kg m2) has its mass (=0.7 kg) 4.14 m from the centre",
    ),
    (r'xyz="0.05 0 0"', 'xyz="5 0 0"', "link hand: the centre of its mass is 5 m from its frame"),
    (r"<inertial>", "<inertial/><inertial>", "link upper_arm has 2 elements inertial"),
    (
        r'xyz="0.30 0 0"',
        'xyz="0.30 0 0" quat_xyzw="0.6 0 0 0.8"',  # of URDF 1.2
        "joint wrist: <origin> has quat_xyzw, must have xyz and rpy alone",
    ),
    (r'<origin xyz="0.05 0 0"/>', '<origin xzy="0.05 0 0"/>', "link hand: inertial: <origin> has xzy, must have xyz"),
    (r'<axis xyz="0 1 0"/>', "<axis/>", "joint shoulder: <axis> has no xyz"),
    (r'<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>', "joint shoulder: axis (='0 1') must be 3 numbers"),
    (r'name="wrist" type="revolute"', 'name="wrist" type="floating"', "joint wrist: type (=floating) must be one of"),
    (r'name="wrist" type="revolute"', 'name="wrist" type="fixed"', "wrist must be a joint of arm.urdf that moves by"),
    (
        r'<limit lower="-2.0"',
        '<mimic joint="elbow"/><limit lower="-2.0"',
        "wrist must be a joint of arm.urdf that moves",
    ),
    (r'<limit lower="-2.0"', '<mimic joint="thumb"/><limit lower="-2.0"', "joint wrist: <mimic> (=thumb) must name a"),
    (r'<limit lower="-2.0"', '<mimic joint="wrist"/><limit lower="-2.0"', "(=wrist) must name another joint"),
    (r'"hand"', '"${prefix}hand"', "arm.urdf: child has ${prefix}hand: xacro, which must be expanded first"),
    (r'lower="-2.0"', 'lower="$(arg low)"', "arm.urdf: limit has $(arg low): xacro, which must be expanded first"),
    (
        r"</robot>",
        '<xacro:macro name="x"/></robot>',
        "not valid XML: unbound prefix: line 47, column 0; it seems to be xacro",
    ),
    (
        r'<robot name="arm">',
        '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/>',
        "has elements of xacro, which must be expanded first",
    ),
    (r"^.*$", "hello", "not valid XML: syntax error"),
    (r"^.*$", '<sdf version="1.6"/>', "the outermost element (=sdf) must be robot"),
    (r"</robot>", "<!--" + "x" * (17 << 20) + "--></robot>", "at most 16777216 are read"),
    (r'name="elbow"', 'name="shoulder"', "joint shoulder is there 2 times"),
    (r'name="elbow"', 'name="el&#10;bow"', "its name must be of characters that can be printed"),
    (r'<link name="hand">', '<link name="forearm"/><link name="hand">', "link forearm is there 2 times"),
    (
        r"</robot>",
        '<link name="a"/>' + "".join(f'<link name="l{i}"/>' for i in range(9)) + "</robot>",
        "here: base, a, l0, l1, l2 and 6 more",
    ),
    (r"</robot>", "".join(f'<link name="l{i}"/>' for i in range(1000)) + "</robot>", "elements link, at most 1000"),
    (r"</robot>", "", "not valid XML"),
    (
        r'velocity="3.5" effort="80"',
        'velocity="1.5" effort="80"',
        "elbow.toml: limits.velocity_max_radps (=3.4) must be",
    ),
]


@pytest.mark.parametrize(("pattern", "text", "words"), IN_URDF, ids=[words[:40] for _, _, words in IN_URDF])
def test_a_urdf_that_cannot_be(folder: Path, pattern: str, text: str, words: str) -> None:
    change(folder / "arm.urdf", pattern, text)
    assert words in problem(folder)


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        (r'xyz="0.30 0 0"', 'xyz="0.30 0 0" rpy="0 -4.712389 6.28319"'),
        (r'revolute"(.*?)<limit.*?/>', r'continuous"\1'),
        (r'xyz="0.05 0 0"', 'xyz="2.9 0 0"'),
        (r"<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'),
        (r' ixy="0" ixz="0"', ""),
        (
            r"</robot>",
            '<joint name="thumb" type="revolute"><parent link="hand"/><child link="thumb"/></joint>'
            '<link name="thumb"/></robot>',
        ),
    ],
    ids=["three quarters of a turn", "continuous", "long", "was xacro", "no products", "no joint of the arm"],
)
def test_a_urdf_just_inside_what_is_allowed(folder: Path, pattern: str, text: str) -> None:
    change(folder / "arm.urdf", pattern, text)
    load_arm(folder / "arm.toml")


@pytest.mark.parametrize(
    ("soft", "allowed"),
    [
        ('soft_lower_limit="-1.2" soft_upper_limit="1.9"', (-1.2, 1.9)),
        ('soft_lower_limit="-9" soft_upper_limit="9"', (-2.0, 2.0)),
        ('k_position="100"', (-2.0, 2.0)),
    ],
)
def test_soft_limits_narrow_a_joints_range(folder: Path, soft: str, allowed: tuple[float, float]) -> None:
    change(folder / "arm.urdf", r'(<limit lower="-2.0".*?/>)', rf'\1<safety_controller {soft} k_velocity="40"/>')
    wrist = read_urdf(folder / "arm.urdf").joints[-1]
    assert (wrist.lower_rad, wrist.upper_rad) == allowed
    if allowed[0] > -1.9:
        assert f"wrist.toml: limits.position_min_rad (=-1.9) must be at least {allowed[0]:g}" in problem(folder)
    else:
        assert [line for line in remarks(folder) if "k_position and k_velocity are not" in line]


def test_a_frame_that_is_exported_with_a_negligible_mass(folder: Path) -> None:
    inertial = '<inertial><mass value="1e-9"/><inertia ixx="0" iyy="0" izz="0"/></inertial>'
    joint = '<joint name="t" type="fixed"><parent link="hand"/><child link="t"/></joint></robot>'
    change(folder / "arm.urdf", "</robot>", f'<link name="t">{inertial}</link>{joint}')
    assert read_urdf(folder / "arm.urdf").links["t"] is None
    change(folder / "arm.urdf", '"1e-9"', '"-1e-9"')
    assert "link t: mass (=-1e-09) must be at least 1e-06 kg" in problem(folder)


def test_a_joint_that_mimics_another_is_named(folder: Path) -> None:
    finger = '<joint name="f" type="revolute"><parent link="hand"/><child link="f"/><mimic joint="wrist"/></joint>'
    change(folder / "arm.urdf", r"</robot>", f'{finger}<link name="f"/></robot>')
    assert load_arm(folder / "arm.toml").remarks == ("joint f of arm.urdf mimics wrist: for the model it stands at 0",)


def test_entities_are_refused_in_whatever_encoding_the_file_is(folder: Path) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>'
    for encoding in ("utf-8", "utf-16"):
        (folder / "arm.urdf").write_bytes(bomb.encode(encoding))
        assert "must have no DOCTYPE and no entities" in problem(folder)


@pytest.mark.parametrize("encoding", ["no-such", "shift_jis", "rot13"])
def test_an_encoding_that_the_parser_does_not_know(folder: Path, encoding: str) -> None:
    change(folder / "arm.urdf", r"^<\?xml.*?\?>", f'<?xml version="1.0" encoding="{encoding}"?>')
    assert "arm.urdf: not valid XML: " in problem(folder)


IN_FILES: list[tuple[str, str, str, str]] = [
    ("elbow.toml", r"node = 2", "node = 1", "elbow.toml: drive.node (=1) must differ from drive.node of shoulder.toml"),
    ("wrist.toml", r"rate_Hz = 1000.0", "rate_Hz = 500.0", "wrist.toml: loop.rate_Hz (=500) must be that of shoulder"),
    ("wrist.toml", r"bitrate_bitps = 1_000_000", "bitrate_bitps = 500_000", "wrist.toml: bus.bitrate_bitps (=500000)"),
    ("wrist.toml", r"heartbeat_s = 0.2", "heartbeat_s = 0.3", "wrist.toml: drive.heartbeat_s (=0.3) must be that of"),
    ("wrist.toml", r"node = 3", "node = 3\nmaster_node = 99", "wrist.toml: drive.master_node (=99) must be that of"),
    ("arm.toml", r'"elbow.toml"', '"arm.toml"', "arm.joints: arm.toml must be the file of a joint, and is that of an"),
    ("arm.toml", r"joints = \[.*?\]", "joints = []", "arm.joints (=[]) must be a list of at least 1"),
    ("arm.toml", r"joints = \[.*?\]", f"joints = {['a.toml'] * 17}", "must be a list of at most 16"),
    ("arm.toml", r"joints = \[.*?\]", "joints = 'a.toml'", "arm.joints (=a.toml) must be a list"),
    ("arm.toml", r"0.0, 0.0\]  ", "0.0]", "arm.payload_at_m (=[0.1, 0.0]) must be a list of at least 3"),
    ("arm.toml", r"1.2, 0.5, 0.12", "1.2, -0.5, 0.12", "must be 3 inertias of at least 0, one a joint"),
    ("arm.toml", r"-9.81", "-981", "arm.gravity_mps2 (=[0.0, 0.0, -981]) must be 3 numbers with a magnitude in"),
    ("arm.toml", r"payload_at_m = \[0.1", "payload_at_m = [100.0", "arm.payload_at_m.0 (=100) must be in [-10..10]"),
    ("arm.toml", r'"elbow", "wrist"\]', '"elbow"]', "arm.joint_names (=2: shoulder, elbow) must be as many as"),
    ("arm.toml", r'"shoulder", "elbow", ', '"elbow", "shoulder", ', "joint shoulder is nearer to the base than elbow"),
    ("arm.toml", r"amplitude_rad = \[0.6, ", "amplitude_rad = [", "motion.amplitude_rad (=2 numbers) must have 3"),
    ("arm.toml", r"amplitude_rad = \[0.6", "amplitude_rad = [1.2", "with [motion], shoulder.toml: trajectory"),
    *(
        ("arm.toml", r'kind = "sine"', kind, f"motion.kind{given} must be one of 'sine', 'min_jerk', 'table', 'hold'")
        for kind, given in (('kind = "trapezoid"', " (=trapezoid)"), ("", ""))
    ),
    ("arm.toml", r"payload_kg", "payload", "arm.payload is not a known key: did you mean payload_kg"),
    ("arm.toml", r'feed_forward = "whole"', 'feed_forward = "all"', "arm.feed_forward (=all) must be"),
    ("arm.toml", r"motor_inertia_kgm2 = \[.*?\]", "", "arm.motor_inertia_kgm2 must be given"),
    ("arm.toml", r'urdf = "arm.urdf"', 'urdf = "no.urdf"', "cannot be read"),
    ("arm.toml", r'"elbow.toml"', '"shoulder.toml"', "arm.joints (=shoulder.toml, shoulder.toml, wrist.toml) must not"),
    (
        "arm.toml",
        r"\[motion\].*",
        "[motion]\nkind = 'min_jerk'\nduration_s = 1\nstart_rad = [0, 0, 0]\ntarget_rad = [1e308, 0, 0]\n",
        "motion.target_rad (=1e+308) must be in [-1000..1000] (joint shoulder)",
    ),
    (
        "wrist.toml",
        r"\[limits\]",
        "[reducer]\nmotor_inertia_kgm2 = 0.05\nstiffness_Nmprad = 5e4\n[limits]",
        "arm.motor_inertia_kgm2 (=0.12) of wrist.toml must be its reducer.motor_inertia_kgm2 (=0.05)",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "pattern", "text", "words"), IN_FILES, ids=[one[3][:40] for one in IN_FILES])
def test_files_that_do_not_fit_together(folder: Path, name: str, pattern: str, text: str, words: str) -> None:
    change(folder / name, pattern, text)
    assert words in problem(folder)


def test_a_drive_that_no_arm_has_is_named_before_a_motion_that_it_cannot_do(folder: Path) -> None:
    shutil.copy(CONFIGS / "elmo_serial.toml", folder / "wrist.toml")
    with pytest.raises(ConfigurationError) as caught:
        load_arm(folder / "arm.toml")
    first, *_ = caught.value.message.splitlines()
    assert first.endswith("wrist.toml: drive.kind (=elmo_serial) must be canopen in an arm")
    assert "[motion]" not in caught.value.message


def test_a_file_in_the_place_of_another_joint_is_named(folder: Path) -> None:
    """With equal limits it fits, and the torque of one joint would go to the drive of the other."""
    shutil.copy(folder / "shoulder.toml", folder / "drive1.toml")
    change(folder / "arm.toml", r'"shoulder.toml"', '"drive1.toml"')
    assert not load_arm(folder / "arm.toml").remarks
    change(folder / "arm.toml", r'"drive1.toml", "elbow.toml"', '"elbow.toml", "shoulder.toml"')
    for name, low, high, speed, torque in (("shoulder", -1.4, 1.6, 3.0, 72.0), ("elbow", -1.4, 1.4, 3.0, 72.0)):
        limits = {"position_min_rad": low, "position_max_rad": high, "velocity_max_radps": speed}
        for key, value in {**limits, "torque_max_Nm": torque}.items():
            change(folder / f"{name}.toml", rf"(?m)^{key} = \S+", f"{key} = {value}")
    remarks = load_arm(folder / "arm.toml").remarks
    assert remarks == (
        "arm.joints: elbow.toml stands in the place of joint shoulder; is it that of joint elbow?",
        "arm.joints: shoulder.toml stands in the place of joint elbow; is it that of joint shoulder?",
    )


@pytest.mark.parametrize(("upper", "said"), [("-0.1", ", where its limits [-2..-0.1] let it never be"), ("0", "")])
def test_a_joint_that_cannot_stand_at_0_is_named(folder: Path, upper: str, said: str) -> None:
    two = "[motion]\nkind = 'hold'\nduration_s = 1.0\nposition_rad = [0.0, 0.0]\n"
    change(folder / "arm.toml", r', "wrist.toml"\](.*?), "wrist"\](.*?), 0.12\](.*?)\[motion\].*', r"]\1]\2]\3" + two)
    change(folder / "arm.urdf", r'lower="-2.0" upper="2.0"', f'lower="-2.0" upper="{upper}"')
    (remark,) = load_arm(folder / "arm.toml").remarks
    assert remark.startswith(f"joint wrist of arm.urdf is not the arm's: it stands at 0{said}")
    assert remark.endswith("another arm") == bool(said)


def test_the_motors_inertias_may_be_in_both_places(folder: Path) -> None:
    reducer = "[reducer]\nmotor_inertia_kgm2 = 0.12\nstiffness_Nmprad = 5e4\n[limits]"
    change(folder / "wrist.toml", r"\[limits\]", reducer)
    load_arm(folder / "arm.toml")


def test_two_buses_may_have_the_same_node(folder: Path) -> None:
    change(folder / "elbow.toml", r"node = 2", "node = 1")
    change(folder / "elbow.toml", r'channel = "virtual0"', 'channel = "virtual1"')
    joints: Any = load_arm(folder / "arm.toml").joints
    assert [config.drive.node for config in joints] == [1, 1, 3]


# --- magnitudes that are allowed and look like another unit: one remark, and none on what is usual ---


def remarks(folder: Path) -> list[str]:
    return list(load_arm(folder / "arm.toml").remarks)


def scaled(folder: Path, key: str, factor: float) -> None:
    """Every number of that attribute in the URDF."""

    def times(match: re.Match[str]) -> str:
        return f'{match[1]}"{" ".join(f"{factor * float(word):g}" for word in match[2].split())}"'

    path = folder / "arm.urdf"
    path.write_text(re.sub(rf'({key}=)"([^"]*)"', times, path.read_text()))


def test_the_shipped_arm_has_nothing_odd(folder: Path) -> None:
    assert remarks(folder) == []


@pytest.mark.parametrize(
    ("key", "factor", "said"),
    [
        ("effort", 1000.0, "Nmm instead of Nm?"),
        ("effort", 50.0, None),  # of a user who does not know it
    ],
)
def test_an_effort_in_another_unit_is_named(folder: Path, key: str, factor: float, said: str | None) -> None:
    scaled(folder, key, factor)
    found = remarks(folder)
    if said is None:
        assert found == []
        return
    assert len(found) == 4  # of the arm as a whole, and of each joint's own limit
    assert all(said in line for line in found)
    assert any("shoulder" in line and "limits.torque_max_Nm (=145)" in line for line in found)


def small(folder: Path, mass: float, length: float, effort: float = 5.0) -> list[str]:
    """Remarks on a desk arm of 0.3 kg and 0.2 m a link, with these units."""
    inertia = 2e-3 * mass * length**2
    (folder / "arm.urdf").write_text(
        '<robot name="desk"><link name="base"/>'
        + "".join(
            f'<link name="l{k}"><inertial><origin xyz="{0.1 * length} 0 0"/><mass value="{0.3 * mass}"/>'
            f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial></link>'
            f'<joint name="{name}" type="revolute"><parent link="{f"l{k - 1}" if k else "base"}"/><child link="l{k}"/>'
            f'<origin xyz="{0.2 * length if k else 0} 0 0"/><axis xyz="0 1 0"/>'
            f'<limit lower="-3" upper="3" velocity="5" effort="{effort}"/></joint>'
            for k, name in enumerate(("shoulder", "elbow", "wrist"))
        )
        + "</robot>"
    )
    for name in ("shoulder", "elbow", "wrist"):
        change(folder / f"{name}.toml", r"\ntorque_max_Nm = \S+", f"\ntorque_max_Nm = {0.9 * effort}")
    change(folder / "arm.toml", r"payload_kg = 1.0", "payload_kg = 0.0")
    return remarks(folder)


@pytest.mark.parametrize(
    ("mass", "length", "said"),
    [(1.0, 1.0, None), (0.2, 0.5, None), (4.0, 2.0, None), (1000.0, 1.0, "grams instead of kg"), (1.0, 25.0, None)],
)
def test_masses_in_grams_are_named(folder: Path, mass: float, length: float, said: str | None) -> None:
    found = small(folder, mass, length)
    assert ([said in line for line in found] == [True]) if said else found == []


def test_a_fixed_joint_needs_no_axis(folder: Path) -> None:
    path = folder / "arm.urdf"
    path.write_text(path.read_text().replace("</robot>", '<link name="tool"/><joint name="flange" type="fixed">'
        '<parent link="hand"/><child link="tool"/><axis xyz="0 0 0"/></joint></robot>'))  # fmt: skip
    assert remarks(folder) == []


def test_a_limit_of_a_whole_number_beyond_a_turn_is_named(folder: Path) -> None:
    change(folder / "arm.urdf", r'lower="[^"]*"', 'lower="-10"')
    assert [line for line in remarks(folder) if "limit lower (=-10) is more than a turn; degrees" in line]
    change(folder / "arm.urdf", r'lower="[^"]*"', 'lower="-6.2831853"')
    assert remarks(folder) == []


@pytest.mark.parametrize(
    ("angle", "said"),
    [("2", "114.6 degrees"), ("-1", "-57.3 degrees"), ("1.5", "85.94 degrees"), ("1.57", None), ("0.5", None)],
)
def test_a_few_degrees_in_an_rpy_are_named(folder: Path, angle: str, said: str | None) -> None:
    for place, what in (('xyz="0.30 0 0"', "joint wrist"), ('<origin xyz="0.05 0 0"', "link hand: inertial")):
        before = (folder / "arm.urdf").read_text()
        change(folder / "arm.urdf", place, f'{place} rpy="0 {angle} 0"')
        wanted = [f"arm.urdf: {what}: rpy has the angle {angle}, which is {said}; degrees instead of rad?"]
        assert remarks(folder) == (wanted if said else [])
        (folder / "arm.urdf").write_text(before)
