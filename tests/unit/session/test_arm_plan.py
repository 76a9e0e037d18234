"""An arm in a session: what is shown of all joints, the memory of the loop joint by joint, logs that are kept."""

from __future__ import annotations

import math
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import (
    BusError,
    ConfigurationError,
    DeviceError,
    JointctlError,
    MarginError,
    MotionFault,
    UsageError,
    blamed,
)
from jointctl.firmware_py.cycle import Word
from jointctl.tools.analysis.arm_check import moments_s
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import Hold
from jointctl.tools.recording.run_log import INFO, Event, remove_oldest
from jointctl.tools.session.canopen_drive import require_buses
from jointctl.tools.session.display import Display, JointDisplay, PreparedMotion, ViewerRequest
from jointctl.tools.session.loop_memory import RING_RECORDS, SharedBlock
from jointctl.tools.session.plan import free, resolve, resolve_arm
from jointctl.tools.verbs.bench_drive import stop_targets
from jointctl.tools.verbs.check import check_arm
from jointctl.tools.verbs.verb_options import on_bus
from tests.sessions import output

NAMES = ["shoulder", "elbow", "wrist"]


@pytest.fixture(scope="module")
def arm() -> ArmConfig:
    return load_arm(SHIPPED_ARM)


def report(start_rad: float) -> CommissioningReport:
    return CommissioningReport(DriveIdentity("", "", "", ""), "cst", start_rad, 0.1, 1e-5)


def test_the_envelope_names_every_joint_and_their_common_approach(arm: ArmConfig) -> None:
    plan = resolve_arm(arm)
    placed = plan.placed([report(start) for start in (0.1, 0.2, -0.3)])
    text = "\n".join(placed.lines)
    assert re.findall(r"--- (\w+) \(", text) == NAMES
    assert re.findall(r"now at +(\S+) rad", text) == ["+0.1000", "+0.2000", "-0.3000"]
    shown = {float(seconds) for seconds in re.findall(r"approach .* in (\S+) s", text)}
    assert len(shown) == 1
    approaches = placed.constants.sequence.approach_s
    assert np.all(approaches == approaches[0])  # what is shown is what the loop gets
    assert round(float(approaches[0]), 1) in shown
    assert [float(start) for start in placed.constants.sequence.start_rad] == [0.1, 0.2, -0.3]


def test_the_gate_before_enabling_is_that_of_the_poses(arm: ArmConfig) -> None:
    """An inertia that no pose has: alone the joint would have its margin."""
    wrong = replace(arm, joints=(*arm.joints[:2], arm.joints[2].changed(joint__inertia_kgm2=0.4)))
    joints = resolve_arm(wrong).joints
    for joint in (*joints[:2], replace(joints[2], poses=None)):
        assert joint.require_margin(0.001, allow_low_margin=False).phase_margin_deg > 35.0
    with pytest.raises(MarginError, match=r"must be at least 30 deg: .*worst case: inertia 0\.133 kg m2"):
        joints[2].require_margin(0.001, allow_low_margin=False)
    assert joints[2].require_margin(0.001, allow_low_margin=True).stable


def test_an_arm_that_a_joint_cannot_hold_is_refused_before_anything_is_sent(arm: ArmConfig) -> None:
    weak = arm.joints[0].changed(limits__torque_max_Nm=30.0)
    with pytest.raises(ConfigurationError, match="joint shoulder: gravity reaches 32"):
        resolve_arm(replace(arm, joints=(weak, *arm.joints[1:])))


def moving(tmp_path: Path, motion: str, table: str = "") -> ArmConfig:
    """The shipped arm with this [motion], and a table in way.csv."""
    folder = Path(shutil.copytree(SHIPPED_ARM.parent, tmp_path / "arm"))
    (folder / "way.csv").write_text(table)
    text = (folder / "arm.toml").read_text()
    (folder / "arm.toml").write_text(text[: text.index("[motion]")] + motion)
    return load_arm(folder / "arm.toml")


@pytest.mark.parametrize(("frequency_Hz", "duration_s", "allowed"), [
    (11.0, 5.0, False), (11.0, 0.0, False), (4.0, 5.0, True),
])  # fmt: skip
def test_a_motion_that_takes_more_than_a_joints_torque_is_refused_before_anything_is_sent(
    tmp_path: Path, frequency_Hz: float, duration_s: float, allowed: bool
) -> None:
    """Within all limits of position and speed."""
    motion = f"duration_s = {duration_s}\namplitude_rad = [0.04, 0.04, 0.04]\nfrequency_Hz = [{frequency_Hz}, 0.1, 0.1]"
    arm = moving(tmp_path, f'[motion]\nkind = "sine"\n{motion}\n')
    resolve_arm(arm, free)  # that is not what it does there
    for refuses in (resolve_arm, lambda arm: check_arm(arm, output()[0])):
        if allowed:
            refuses(arm)
        else:
            with pytest.raises(ConfigurationError, match=r"^shoulder: the motion takes .* must be in \[-145\.\.145\]"):
                refuses(arm)


def test_what_is_wrong_with_a_table_is_the_arms_motion_and_not_the_joints(tmp_path: Path) -> None:
    table = "time_s,shoulder_rad,elbow_rad,wrist_rad\n0,0,0,0\n0.1,0,1,0\n2,0,0,0\n"
    arm = moving(tmp_path, '[motion]\nkind = "table"\nduration_s = 1.0\nfile = "way.csv"\n', table)
    for refuses in (resolve_arm, lambda arm: check_arm(arm, output()[0])):
        with pytest.raises(ConfigurationError) as caught:
            refuses(arm)
        lines = caught.value.message.splitlines()
        assert len(lines) == 2
        assert all(re.match(r".*arm\.toml: with \[motion\], .*elbow\.toml: trajectory: ", line) for line in lines)


def test_an_approach_that_swings_beyond_a_limit_is_refused_before_anything_moves(arm: ArmConfig) -> None:
    """The wrist begins with speed, and has as long for its approach as the shoulder needs from its limit."""
    plan = resolve_arm(arm)
    plan.placed([report(start) for start in (1.0, 0.1, 0.1)])
    with pytest.raises(
        MotionFault, match=r"^wrist: the approach from \+0\.1000 rad in 5.* must be in \[-1\.9\.\.1\.9\]"
    ):
        plan.placed([report(start) for start in (1.39, 0.1, 0.1)])
    plan.placed([report(start) for start in (0.1, 2.1, 0.1)])  # stands beyond its limit: that is the loop's fault


def test_each_joint_has_a_log_of_its_own(arm: ArmConfig) -> None:
    plan = resolve_arm(arm)
    assert [joint.name for joint in plan.joints] == NAMES
    assert [joint.log_path.name.split(".")[1:] for joint in plan.joints] == [[name, "mcap"] for name in NAMES]
    assert plan.tables.shape[::2] == (3, 5)


def test_joints_that_one_loop_cannot_command_are_refused(arm: ArmConfig) -> None:
    joints = list(arm.joints)
    require_buses(joints)
    joints[2] = joints[2].changed(bus__interface="slcan")
    with pytest.raises(ConfigurationError, match="must be one of socketcan, jointctl") as caught:
        require_buses(joints)
    assert "wrist.toml" in str(caught.value)


@pytest.fixture
def on_two_buses(tmp_path: Path) -> Path:
    """The shipped arm, its wrist on a bus of its own with the shoulder's node."""
    shutil.copytree(SHIPPED_ARM.parent, tmp_path / "arm")
    wrist = tmp_path / "arm" / "wrist.toml"
    wrist.write_text(re.sub(r"(?m)^node = 3", "node = 1", wrist.read_text().replace("virtual0", "virtual1")))
    return tmp_path / "arm" / "arm.toml"


def test_a_channel_that_is_given_is_that_of_the_first_virtual_bus(on_two_buses: Path) -> None:
    given = GivenPlace("jointctl", "mine")
    arm = on_bus(load_arm(on_two_buses), given)
    assert [joint.bus.channel for joint in arm.joints] == ["mine", "mine", "mine.2"]
    targets, unread = stop_targets(on_two_buses, given)
    assert [target.place for target in targets.values()] == [
        (joint.bus.interface, joint.bus.channel) for joint in arm.joints
    ]
    assert not unread
    targets, _ = stop_targets(on_two_buses)
    assert [target.place[1] for target in targets.values()] == ["virtual0", "virtual0", "virtual1"]


def test_one_channel_is_refused_where_the_buses_are_real(on_two_buses: Path) -> None:
    with pytest.raises(UsageError, match=r"--channel \(=can0\) names one bus, and the joints of .* are on 2"):
        on_bus(load_arm(on_two_buses), GivenPlace("socketcan", "can0"))
    arm = on_bus(load_arm(on_two_buses), GivenPlace("socketcan"))
    assert [(joint.bus.interface, joint.bus.channel) for joint in arm.joints][1:] == [
        ("socketcan", "virtual0"), ("socketcan", "virtual1"),
    ]  # fmt: skip


def test_two_buses_become_one_by_the_environment_only_with_different_nodes(
    on_two_buses: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_CHANNEL", "shared")
    with pytest.raises(
        ConfigurationError, match=r"wrist.toml: drive.node \(=1\) must differ from drive.node of shoulder"
    ):
        on_bus(load_arm(on_two_buses), GivenPlace())


@pytest.mark.parametrize("cycles", [0, 1, 7, RING_RECORDS // 3 - 1, RING_RECORDS // 3 + 5, RING_RECORDS])
def test_each_joint_sees_its_own_records_and_how_many_it_lost(cycles: int) -> None:
    block = SharedBlock.create(1, CanopenPort, 3)
    try:
        for record in range(max(0, 3 * cycles - RING_RECORDS), 3 * cycles):
            block.ring[record % RING_RECORDS].cycle = record // 3
            block.ring[record % RING_RECORDS].phase = record % 3
        block.words[Word.HEAD] = 3 * cycles
        for axis in range(3):
            records, lost = block.of_axis(axis).new_records(0, 3 * cycles)
            assert lost + len(records) == cycles
            assert list(records.cycle) == list(range(lost, cycles))
            assert set(records.phase) <= {axis}
            assert lost <= max(0, cycles - RING_RECORDS // 3) + 1
    finally:
        os.close(block.fd)


def test_of_an_arms_display_each_joint_has_its_name_and_the_first_one_the_phase() -> None:
    said: list[str] = []

    class Lines(Display):
        note = phase = said.append

        def event(self, event: Event) -> None:
            said.append(event.text)

    for number, name in enumerate(NAMES[:2]):
        shown = JointDisplay(Lines(), name, [], number)
        shown.phase("tracking")
        shown.note("a remark")
        shown.event(Event(0, INFO, "loop", "an event"))
    assert said == ["tracking", "shoulder: a remark", "shoulder: an event", "elbow: a remark", "elbow: an event"]


def test_a_program_moves_each_joint_viewers_none() -> None:
    waiting = [
        ViewerRequest("gains", "a viewer", {"kp": 1.0}), ViewerRequest("viewers", "", {"count": 0}),
        *(PreparedMotion("motion", "the program", joint=name) for name in reversed(NAMES)),
    ]  # fmt: skip

    class Asking(Display):
        def requests(self) -> list[ViewerRequest]:
            taken = list(waiting)
            waiting.clear()
            return taken

    orders: list[ViewerRequest] = []
    shown = [JointDisplay(Asking(), name, orders, axis) for axis, name in enumerate(NAMES)]
    taken = [[(each.kind, getattr(each, "joint", "")) for each in one.requests()] for one in shown]
    assert taken == [[("viewers", ""), ("motion", "shoulder")], [("motion", "elbow")], [("motion", "wrist")]]
    assert not orders


def test_of_an_arm_the_newest_logs_of_each_joint_are_kept(arm: ArmConfig, tmp_path: Path) -> None:
    config = arm.joints[0]
    config = config.changed(log__keep=2)
    for minute in range(3):
        for name in NAMES:
            for ending in ("mcap", "png"):
                path = tmp_path / f"arm-20260101-00{minute:02}00.{name}.{ending}"
                path.touch()
                os.utime(path, (minute, minute))
    (tmp_path / "shoulder-20260101-000000.mcap").touch()  # of the joint alone
    removed = remove_oldest(config, tmp_path / "arm-20260101-000300.shoulder.mcap")
    assert sorted(path.name for path in removed) == [
        f"arm-20260101-00{minute:02}00.shoulder.{ending}" for minute in range(2) for ending in ("mcap", "png")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (DeviceError("6040 was changed"), "elbow: 6040 was changed"),
        (BusError("1 x SDO request to node 3"), "1 x SDO request to node 3"),  # the joint whose watch saw it is any
    ],
)
def test_an_error_names_its_joint_and_one_of_the_bus_none(arm: ArmConfig, error: JointctlError, message: str) -> None:
    with pytest.raises(JointctlError) as raised, blamed(resolve_arm(arm).joints[1].name):
        raise error
    assert raised.value.message == message


def test_an_exchange_keeps_what_a_cycle_reads_near_and_no_long_arrays() -> None:
    block = SharedBlock.create(1, CanopenPort, axes=3, links=3)
    near = block.near()
    kept = np.zeros(len(near.words), bool)
    for first, last in near.parts:
        kept[first:last] = True

    def is_near(values: np.ndarray) -> bool:
        return bool(kept[(values.ctypes.data - near.words.ctypes.data) // 8])

    for axis in range(3):
        state, constants = block.state, block.constants
        short = (
            state["cycle"],
            state["law"]["adaptation"]["covariance"],
            state["swing"]["faint_error"],
            block.port["cycle"],
        )
        for column in (*short, constants["law"]["kp"], constants["limits"], block.links["mass_kg"]):
            assert is_near(column[axis : axis + 1])
        for column in (state["law"]["learning"]["learned_Nm"], constants["stream"]["values"]):
            assert not is_near(column[axis, 1:])
    assert 8 * kept.sum() < 3 * 8192
    os.close(block.fd)


@pytest.mark.parametrize("limit_rad", [0.7, -0.7])
def test_an_approach_that_ends_at_a_limit_is_allowed_from_everywhere(limit_rad: float) -> None:
    """Its polynomial ends there but for rounding."""
    hold = Hold(kind="hold", duration_s=1.0, position_rad=limit_rad)
    config = load_config(shipped_config("virtual")).changed(limits__position_min_rad=-0.7, limits__position_max_rad=0.7)
    plan = resolve(config.changed(trajectory=hold))
    for start_rad in np.linspace(-0.7, 0.7, 60):
        plan.placed([report(float(start_rad))])


def test_the_torques_of_a_sine_are_not_looked_at_where_it_rests() -> None:
    """Evenly spread, the moments of 399 periods would all be its ends."""
    for duration_s in (399.0, 79.8, 60.0):
        away = np.abs(np.sin(math.tau * moments_s(duration_s)))
        assert np.max(away) > 0.99
        assert np.mean(away) > 0.5
    assert np.sum(moments_s(60.0) < 0.2) > 20
