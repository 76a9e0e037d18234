"""`jointctl.Arm` at simulated time: motions that begin and end together, set-points of all joints or of none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jointctl
from jointctl.firmware_py.arm_model import newton_euler
from jointctl.firmware_py.motion_records import ChangeKind
from jointctl.firmware_py.states import AxisPhase, TrajectoryKind
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm

NAMES = ("shoulder", "elbow", "wrist")
RATE_Hz = 100.0
DOWN_rad = np.array([0.1, -0.2, 0.3])


@pytest.fixture
def arm() -> Iterator[jointctl.Arm]:
    with jointctl.Arm("virtual", lockstep=True) as arm:
        arm.enable()
        yield arm


@contextmanager
def refused(arm: jointctl.Arm, words: str) -> Iterator[None]:
    """What is asked for is not done, and no joint moves."""
    before = arm.state.desired_position_rad
    with pytest.raises(jointctl.ConfigurationError, match=words):
        yield
    arm.step(0.1)
    assert (arm.state.desired_position_rad == before).all()


def moving(log: Any) -> list[np.ndarray]:
    """For each joint the cycles in which its reference moves."""
    return [np.flatnonzero(log[:, axis]["desired_velocity_radps"]) for axis in range(log.shape[1])]


def test_it_is_commissioned_then_enabled_then_moves_and_is_off_afterwards() -> None:
    with jointctl.Arm("virtual", lockstep=True) as arm:
        assert arm.names == NAMES
        before = arm.state
        assert before.phase == "commissioned"
        assert before.drive_state == ("switch on disabled",) * 3
        arm.enable()
        state = arm.state
        assert (state.phase, state.fault) == ("tracking", "")
        assert np.abs(state.position_rad - before.position_rad).max() < 1e-3  # it holds where it stands
        arm.move_to(DOWN_rad, duration_s=1.0)
        state = arm.state
        assert np.abs(state.desired_position_rad - DOWN_rad).max() < 1e-12
        assert np.abs(state.position_rad - DOWN_rad).max() < 1e-3
    assert arm.state.phase == "finished"
    assert arm.state.drive_state == ("switch on disabled",) * 3
    log = arm.records
    assert log.shape[1] == 3
    powered = (log["phase"] >= AxisPhase.APPROACH) & (log["phase"] <= AxisPhase.RAMPING)
    assert (powered.all(axis=1) == powered.any(axis=1)).all()


@pytest.mark.parametrize("duration_s", [1.2, None])
def test_all_joints_begin_and_end_a_move_in_the_same_cycle(arm: jointctl.Arm, duration_s: float | None) -> None:
    first, start_rad = len(arm.records), arm.state.desired_position_rad
    target_rad = start_rad + np.array([0.3, -0.02, 0.1])
    arm.move_to(target_rad, duration_s=duration_s)
    log = arm.records[first:]
    cycles = moving(log)
    assert len({(int(found[0]), int(found[-1])) for found in cycles}) == 1
    if duration_s is not None:
        assert len(cycles[0]) == pytest.approx(1000 * duration_s, abs=2)
    share = (log["desired_position_rad"] - start_rad) / (target_rad - start_rad)
    assert np.abs(share - share[:, :1]).max() < 1e-9  # on a straight line in the joints' space


def test_the_default_duration_is_that_of_the_joint_that_takes_longest() -> None:
    lengths = []
    for way_rad in ([0.3, 0.0, 0.0], [0.0, 0.0, 0.1], [0.3, 0.0, 0.1]):
        with jointctl.Arm("virtual", lockstep=True) as arm:
            arm.enable()
            arm.move_to(arm.state.desired_position_rad + way_rad)
        lengths.append(max(len(found) for found in moving(arm.records)))
    assert lengths[2] == max(lengths[:2])


def test_a_table_is_begun_and_followed_together_twice(arm: jointctl.Arm) -> None:
    times = np.linspace(0.0, 1.0, 21)
    ways = 0.1 * np.sin(0.5 * np.pi * times)[:, np.newaxis] ** 2 * [1.0, -1.0, 0.5]
    for offset in ([0.3, 0.0, 0.1], [0.0, 0.1, 0.1]):  # far from each other: the joints' ways there differ
        first = len(arm.records)
        arm.follow(times, ways + offset)
        assert np.abs(arm.state.desired_position_rad - (ways[-1] + offset)).max() < 1e-9
        log = arm.records[first:]
        part = log["desired_position_rad"][-1000:] - offset
        assert np.abs(part[:, 1] + part[:, 0]).max() < 1e-9
        assert np.abs(part[:, 2] - 0.5 * part[:, 0]).max() < 1e-9


def test_set_points_of_all_joints_are_followed_in_the_same_cycles(arm: jointctl.Arm) -> None:
    start_rad, first = arm.state.desired_position_rad, len(arm.records)
    ways = np.array([0.05, -0.03, 0.02])
    for k in range(1, 201):
        u = min(0.01 * k, 1.0)
        share, rate = u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u) * (u < 1.0)
        arm.command(start_rad + ways * share, ways * rate, time_s=0.01 * k)
        arm.step(1.0 / RATE_Hz)
    log = arm.records[first:]
    shares = (log["desired_position_rad"] - start_rad) / ways
    assert np.abs(shares - shares[:, :1]).max() < 1e-9
    assert shares[-1, 0] == pytest.approx(1.0)
    assert len({int(found[0]) for found in moving(log)}) == 1


@pytest.mark.parametrize(
    ("point", "words"),
    [
        (([0.1, 5.0, 0.1],), r"elbow: position_rad \(=5\) must be in \["),
        (([0.1, 0.1, math.nan],), r"wrist: position_rad \(=nan\)"),
        (([0.1, 0.1, 0.1], [0.0, 0.0, 100.0]), r"wrist: velocity_radps \(=100\)"),
        (([0.9, 0.1, 0.1],), "shoulder: position_rad .* from the set-point before, must be within"),
        (([0.1, 0.13, 0.1],), "elbow: .* takes more than"),
        (([0.1] * 3, [0.0] * 3, [0.0, math.nan, 0.0]), "elbow: acceleration_radps2"),
        (([0.1] * 3, [0.0] * 3, None, [0.0, 0.0, 1e6]), r"wrist: torque_Nm \(=1e\+06\)"),
        (([0.1, 0.1],), r"position_rad \(=2 numbers\) must have 3, one a joint"),
        (([0.1, 0.1, "x"],), r"position_rad \(=\[0.1, 0.1, 'x'\]\) must be 3 numbers, one a joint"),
    ],
)
def test_what_is_wrong_with_one_joint_refuses_the_whole_set_point(
    arm: jointctl.Arm, point: tuple[Any, ...], words: str
) -> None:
    before = arm.state.desired_position_rad
    with pytest.raises(jointctl.SetPointError, match=words):
        arm.command(*point)
    arm.step(0.3)
    assert (arm.state.desired_position_rad == before).all()
    assert not arm._motor.axis["stream"]["taken"].any()
    arm.command(before)  # the next good one is followed
    arm.step(0.1)
    assert (arm._motor.axis["stream"]["taken"] == 1).all()


def test_a_set_point_that_has_come_for_some_joints_only_moves_none(arm: jointctl.Arm) -> None:
    """As of a program that dies between two of them."""
    before = arm.state.desired_position_rad
    arm.command(before + 0.001, time_s=0.0)
    arm._motor.constants["stream"]["written"][2] -= 1
    arm.step(0.3)
    assert (arm.state.desired_position_rad == before).all()


def test_nor_does_a_motion(arm: jointctl.Arm) -> None:
    before = arm.state.desired_position_rad
    motor = arm._motor
    boxes = motor.constants["change"]
    requests = boxes["request"]
    requests["kind"], requests["trajectory"]["kind"] = ChangeKind.MOTION, TrajectoryKind.HOLD
    requests["trajectory"]["start_rad"] = before + 0.1
    requests["first"] = requests["last"] = 1
    boxes["order"][:2] = 1
    arm.step(0.3)
    assert (arm.state.desired_position_rad == before).all()
    boxes["order"][2] = 1
    arm.step(0.01)
    assert (arm._motor.axis["change"]["answered"] == 1).all()


@pytest.mark.parametrize(
    ("targets", "how", "words"),
    [
        ([0.1, 9.0, 0.1], {}, "elbow: .*position"),
        ([0.1, 0.1, 1.0], {"duration_s": 0.01}, "wrist: "),
        ([0.1, 0.1], {}, r"^position_rad \(=\[0\.1, 0\.1\]\) must be 3 numbers: shoulder, elbow, wrist$"),
        (None, {}, r"^position_rad \(=None\) must be 3 numbers"),
        ("0.1", {}, r"^position_rad \(=0\.1\) must be 3 numbers"),
        (np.zeros((3, 1)), {}, r"^position_rad \(=\[\[0\.\] \[0\.\] \[0\.\]\]\) must be 3 numbers"),
        (
            [np.zeros((2, 2)), np.zeros((2, 3)), np.zeros((2, 2))],
            {},
            r"^position_rad \(=\[array\(.*\) must be 3 numbers",
        ),
        ([[0.1, 0.2], [0.3], [0.4]], {}, r"^position_rad of shoulder \(=\[0\.1, 0\.2\]\) must be a number$"),
        ([0.1, math.inf, 0.1], {}, r"position_rad of elbow \(=inf\) must be finite"),
        ([0.1, 0.1, 0.1], {"duration_s": math.nan}, "duration_s"),
    ],
)
def test_a_move_beyond_a_limit_names_the_joint_and_moves_none(
    arm: jointctl.Arm, targets: Any, how: dict[str, float], words: str
) -> None:
    with refused(arm, words):
        arm.move_to(targets, **how)


def upright(torque_max_Nm: float) -> ArmConfig:
    """The shipped arm, its upper arm nearly upright, with another torque limit of the shoulder."""
    arm = load_arm(SHIPPED_ARM)
    first = arm.joints[0].changed(limits__torque_max_Nm=torque_max_Nm, virtual__initial_position_rad=1.3)
    return replace(arm, joints=(first, *arm.joints[1:]))


@pytest.mark.parametrize(("limit_Nm", "allowed"), [(28.0, False), (70.0, True)])
@pytest.mark.parametrize(
    ("moved", "words"),
    [
        # slowly down to where gravity is 32 Nm: the shoulder's own inertia asks for next to nothing
        (lambda arm: arm.move_to([0.1, 0.1, 0.1], duration_s=3.0),
         r"shoulder: the motion takes -3\d.* by the arm's model"),
        # from one upright pose to the other one, past where gravity is 32 Nm
        (lambda arm: arm.follow([0.0, 1.0], [[-1.3, 0.1, 0.1]] * 2),
         "shoulder: the way to the beginning of the table takes .* by the arm's model"),
    ],
    ids=["a move", "the way to the beginning of a table"],
)  # fmt: skip
def test_what_the_arms_model_asks_on_the_way_is_within_the_torque_limits(
    moved: Callable[[jointctl.Arm], None], words: str, limit_Nm: float, allowed: bool
) -> None:
    with jointctl.Arm(upright(limit_Nm), lockstep=True) as arm:
        arm.enable()
        with nullcontext() if allowed else refused(arm, words):
            moved(arm)


@pytest.mark.parametrize(
    ("times", "positions", "words"),
    [
        ([0.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 9.0, 0.0]], "elbow: "),
        ([0.0, 1.0], [[0.0, 0.0], [0.0, 0.1]], r"must be \(N,\) and \(N, 3\)"),
        ([0.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 0.1, math.nan]], r"positions_rad\[1, 2\]"),
        ([0.0, 1.0], np.ma.masked_equal([[0.0, 0.0, 0.0], [0.0, 0.1, 9.0]], 9.0), r"positions_rad\[1, 2\]"),
        ([1.0, 1.0], [[0.0, 0.0, 0.0], [0.0, 0.1, 0.1]], r"times_s\[1\]"),
    ],
)
def test_a_table_is_checked_before_it_begins(arm: jointctl.Arm, times: Any, positions: Any, words: str) -> None:
    with refused(arm, words):
        arm.follow(times, positions)


def test_a_law_in_python_holds_the_arm_with_the_torques_of_its_model() -> None:
    with jointctl.Arm("virtual", lockstep=True) as arm:
        arm.enable()
        state, target_rad = arm.state, arm.state.position_rad
        memory = arm.config.model.memory()
        motion: Any = memory.motion
        for _ in range(1500):
            motion.position_rad[:3] = target_rad
            newton_euler(memory)
            feedback = np.array([3000.0, 1000.0, 200.0]) * (target_rad - state.position_rad)
            feedback -= np.array([150.0, 50.0, 10.0]) * state.velocity_radps
            state = arm.step_torque(motion.torque_Nm[:3] + feedback)
        assert np.abs(state.position_rad - target_rad).max() < 5e-3
    assert (arm.state.phase, arm.state.fault) == ("finished", "")


def test_a_fault_of_one_joint_stops_all_and_names_it() -> None:
    def pushed(arm: jointctl.Arm) -> None:
        arm.enable()
        for _ in range(3000):
            arm.step_torque([0.0, 60.0, 0.0])
            arm.wait(0.001)

    arm = jointctl.Arm("virtual", lockstep=True)
    with pytest.raises(jointctl.MotionFault, match=r"^\w+: (POSITION|VELOCITY)_LIMIT"), arm:
        pushed(arm)
    assert arm.state.phase == "finished"
    assert arm.state.fault.partition(": ")[2] in ("POSITION_LIMIT", "VELOCITY_LIMIT")


def test_the_first_of_several_faults_is_the_one_that_is_reported() -> None:
    arm = jointctl.Arm("virtual", lockstep=True)
    arm.enable()
    while not arm.step_torque([40.0, 30.0, 0.0]).fault:
        pass
    arm.step(5.0)  # no law brakes the shoulder, which is as fast a little later
    assert [bool(fault) for fault in arm.records["fault"][-1]] == [True, True, False]
    assert arm.state.fault == "elbow: VELOCITY_LIMIT"
    with pytest.raises(jointctl.MotionFault, match=r"^elbow: VELOCITY_LIMIT"):
        arm.wait(0.1)


@pytest.mark.parametrize(("made", "target_rad"), [(jointctl.Joint, 0.1), (jointctl.Arm, DOWN_rad)])
def test_nothing_enables_twice_and_nothing_moves_after_a_stop(made: Any, target_rad: Any) -> None:
    with made("virtual", lockstep=True) as moved:
        moved.enable()
        for _ in range(2):
            with pytest.raises(jointctl.UsageError, match=f"enabled before.*a new {made.__name__}"):
                moved.enable()
            moved.stop()
            assert moved.state.phase == "finished"
        for call in (lambda: moved.move_to(target_rad), lambda: moved.command(target_rad), lambda: moved.wait(0.1)):
            with pytest.raises(jointctl.MotionFault):
                call()


@pytest.mark.parametrize(("made", "target_rad"), [(jointctl.Joint, 0.2), (jointctl.Arm, DOWN_rad)])
def test_it_is_deterministic(made: Any, target_rad: Any) -> None:
    logs = []
    for _ in range(2):
        with made("virtual", lockstep=True) as moved:
            moved.enable()
            moved.move_to(target_rad, duration_s=0.5)
            moved.command(target_rad, time_s=0.0)
            moved.step(0.2)
        logs.append(moved.records)
    assert (logs[0] == logs[1]).all()


def shipped_joint() -> Path:
    return SHIPPED_ARM.parent / "elbow.toml"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jointctl.Arm("precise"), "is no file of an arm"),
        (lambda: jointctl.Arm(shipped_joint()), "is no file of an arm"),
        (lambda: jointctl.Joint(SHIPPED_ARM), "is no file of a joint"),
        (lambda: jointctl.Joint(load_arm(SHIPPED_ARM)), "is no file of a joint"),  # type: ignore[arg-type]
        (lambda: jointctl.Arm("no_such.toml"), "no_such.toml"),
    ],
)
def test_a_joint_is_no_arm(make: Callable[[], object], words: str) -> None:
    with pytest.raises(jointctl.ConfigurationError, match=words):
        make()


@pytest.mark.parametrize("value", ["0.1", b"1", True, np.True_, np.complex128(0.1 + 0.1j), 10**400], ids=str)
def test_what_python_takes_for_a_number_and_is_none_moves_nothing(arm: jointctl.Arm, value: Any) -> None:
    rest = arm.state.desired_position_rad
    given: Any = [*rest[:2], value]
    with pytest.raises(jointctl.ConfigurationError, match="position_rad of wrist "):
        arm.move_to(given)
    with pytest.raises(jointctl.SetPointError):
        arm.command(given, time_s=0.01)
    arm.step(0.1)
    assert np.array_equal(arm.state.desired_position_rad, rest)


@pytest.mark.parametrize("given", [3, None, b"virtual"])
def test_what_names_no_configuration_is_refused_in_words(given: Any) -> None:
    for made in (jointctl.Arm, jointctl.Joint):
        with pytest.raises(jointctl.ConfigurationError, match="must be a file, a name, or"):
            made(given)


def test_outside_of_its_block_there_is_no_state() -> None:
    with pytest.raises(jointctl.MotionFault, match="not commissioned"):
        print(jointctl.Arm("virtual").state)
