"""The campaign on the shipped arm: no violation in a sample, and each invariant of several joints does notice."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.cyclic import IGNORED_MAX_CYCLES
from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.firmware_py.safety import SINKS_SHARE
from jointctl.firmware_py.states import AxisPhase, Fault, Notice
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_POSITION_rad, TRUE_VELOCITY_radps
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.experiments import arm_campaign
from jointctl.tools.experiments.arm_campaign import (
    ArmScenario,
    Masses,
    draw_arm_scenario,
    envelopes,
    judge_arm,
    masses_of,
    require_arm_fits,
    run_arm_scenario,
)
from jointctl.tools.experiments.fault_scenarios import FAULT_CLASSES, kinds_during
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.lockstep import LockstepArm, LockstepRun
from jointctl.tools.verbs.fault_campaign import Drawn, fault_campaign
from tests.bench.arm_study import random_arm
from tests.faults.campaign_variants import write_brakeless_arm
from tests.sessions import output
from tests.unit.hil.test_lockstep_arm import on_two_buses

KINDS = kinds_during("run")
PERIOD_NS = 1_000_000


@pytest.fixture(scope="module")
def arm() -> ArmConfig:
    return load_arm(SHIPPED_ARM)


@pytest.fixture(scope="module")
def joints(arm: ArmConfig) -> LockstepArm:
    return LockstepArm(arm)


@pytest.fixture(scope="module")
def masses(arm: ArmConfig) -> Masses:
    return masses_of(arm)


def of_kind(arm: ArmConfig, kind: FaultKind, axis: int, *, harmless: bool) -> ArmScenario:
    """The first scenario of seed 1 with this fault on this joint, while it tracks."""
    number = KINDS.index(kind) + len(KINDS) * axis
    while True:
        found = draw_arm_scenario(arm, 1, number)
        fault = found.fault
        if fault.harmless is harmless and 1.4 < fault.at_s < 1.0 + fault.trajectory.duration_s:
            return found
        number += len(KINDS) * len(arm.joints)


def test_no_scenario_violates_an_invariant(arm: ArmConfig, joints: LockstepArm, masses: Masses) -> None:
    """Each kind once, one joint after the other; the whole: docs/safety.md."""
    found = []
    for index in range(len(KINDS)):
        number = index + len(KINDS) * (index % len(arm.joints))
        found.append(judge_arm(joints, masses, draw_arm_scenario(arm, 21, number)))
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert [v.kind for v in found] == [kind.name.lower() for kind in KINDS]
    assert sum(v.fault != "NONE" for v in found) > len(found) // 4
    assert all(v.fault == "NONE" for v in found if v.harmless)


def test_no_pair_violates_an_invariant(arm: ArmConfig, joints: LockstepArm, masses: Masses) -> None:
    drawn = [draw_arm_scenario(arm, 22, number, pairs=True) for number in range(len(KINDS))]
    found = [judge_arm(joints, masses, one) for one in drawn]
    assert [(v.number, v.kind, v.then, v.violations) for v in found if v.violations] == []
    assert {one.second[0] for one in drawn if one.second is not None} == {0, 1, 2}
    assert sum(v.fault != "NONE" for v in found) > len(found) // 3


@pytest.mark.parametrize(
    "number",
    [
        854,  # the clock leaps by 44 ms: at 1.3 rad/s the reference would by more than the following error
        2430,  # the jump is within a gap in the samples, in which the joint may have moved as far
    ],
)
def test_of_a_pair_no_more_is_expected_than_can_be(
    arm: ArmConfig, joints: LockstepArm, masses: Masses, number: int
) -> None:
    verdict = judge_arm(joints, masses, draw_arm_scenario(arm, 77002, number, pairs=True))
    assert (verdict.violations, verdict.fault) == ((), "NONE")


@pytest.mark.slow("two more arms, whose drives are watched for longer")
@pytest.mark.parametrize("kind", ["brakeless", "flexible"])
def test_no_scenario_violates_an_invariant_with_other_arms(arm: ArmConfig, tmp_path: Path, kind: str) -> None:
    """On its side and without brakes; with soft reducers and two encoders a joint."""
    other = random_arm(arm, 1, 0, flexible=True) if kind == "flexible" else load_arm(write_brakeless_arm(tmp_path))
    require_arm_fits(other)
    joints, masses = LockstepArm(other), masses_of(other)
    drawn = [draw_arm_scenario(other, 41, number, pairs=bool(number % 2)) for number in range(2 * len(KINDS))]
    found = [judge_arm(joints, masses, one) for one in drawn]
    assert [(v.number, v.kind, v.then, v.violations) for v in found if v.violations] == []
    assert sum(v.fault != "NONE" for v in found) > len(found) // 4


def test_a_joint_without_a_brake_that_friction_does_not_hold_has_no_envelope(arm: ArmConfig) -> None:
    loose = arm.joints[0].changed(virtual__brake=False)
    with pytest.raises(ConfigurationError, match=r"gravity at shoulder \(=\d+\.\d+ Nm\) must be less than \d+\.\d+ Nm"):
        require_arm_fits(dataclasses.replace(arm, joints=(loose, *arm.joints[1:])))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    "kind",
    [
        FaultKind.ENCODER_JUMP, FaultKind.DRIVE_HEARTBEAT_LOST, FaultKind.TPDO_LOST, FaultKind.SYNC_LOST,
        FaultKind.CONTROLLER_HEARTBEAT_LOST,
    ],
)  # fmt: skip
def test_a_fault_is_that_of_its_joint_and_its_twin_is_none(
    arm: ArmConfig, joints: LockstepArm, kind: FaultKind, axis: int
) -> None:
    harmful = of_kind(arm, kind, axis, harmless=False)
    assert harmful.faulty == axis
    runs, _ = run_arm_scenario(joints, harmful)
    assert runs[axis].fault in FAULT_CLASSES[kind].causes
    rows = [arm_campaign.fault_row_of(run, joints.start_ns, PERIOD_NS) for run in runs]
    # a drive that does not hear us has the heartbeat withheld from all: their watchdogs end them as they brake, or as
    # they are switched off, a cycle later
    silent = (Fault.STALE_SAMPLE, Fault.OFF_TIMEOUT)
    for other, run in enumerate(runs):
        by_watchdog = run.fault in silent and rows[other] > rows[axis] + IGNORED_MAX_CYCLES
        assert other == axis or run.fault is Fault.NONE or by_watchdog
    begun = [int(np.flatnonzero(run.log.phase >= AxisPhase.RAMPING)[0]) for run in runs]
    assert max(begun) - min(begun) <= 1
    twin, _ = run_arm_scenario(joints, of_kind(arm, kind, axis, harmless=True))
    assert [run.fault for run in twin] == [Fault.NONE] * 3


@pytest.mark.parametrize(
    ("seed", "number", "fault"),
    [
        (20261126, 8579, Fault.FOLLOWING_ERROR),  # the shoulder's encoder is reversed: it throws the wrist
        (1, 8936, Fault.FOLLOWING_ERROR),  # the shoulder swings behind late samples, and shakes the elbow
        (880077123, 194, Fault.FOLLOWING_ERROR),  # the same, at a third of its following error
    ],
)
def test_a_joint_that_is_thrown_by_another_one_is_not_called_frozen(
    arm: ArmConfig, joints: LockstepArm, masses: Masses, seed: int, number: int, fault: Fault
) -> None:
    scenario = draw_arm_scenario(arm, seed, number)
    verdict = judge_arm(joints, masses, scenario)
    assert (verdict.violations, verdict.fault) == ((), fault.name)


def test_a_joint_sinks_by_little_while_it_waits_for_another_ones_drive(
    arm: ArmConfig, joints: LockstepArm, masses: Masses
) -> None:
    """The elbow's drive takes no RPDO any more, when the shoulder's brake has opened and gravity pulls at it."""
    scenario = draw_arm_scenario(arm, 31, 325)
    runs, constants = run_arm_scenario(joints, scenario)
    assert [run.fault for run in runs][:2] == [Fault.NONE, Fault.ENABLE_TIMEOUT]
    moved = np.abs(runs[0].truth[:, TRUE_POSITION_rad] - runs[0].truth[0, TRUE_POSITION_rad]).max()
    assert SINKS_SHARE < moved / constants[0].limits.following_error_max_rad < 2.0 * SINKS_SHARE
    assert judge_arm(joints, masses, scenario).violations == ()


def test_a_joint_that_friction_does_not_hold_sinks_by_little_when_its_torque_is_released(
    arm: ArmConfig, joints: LockstepArm, masses: Masses
) -> None:
    """27 Nm of gravity, 16 Nm of friction, and the brake closes only when the power goes off."""
    scenario = draw_arm_scenario(arm, 31, 1219)
    runs, constants = run_arm_scenario(joints, scenario)
    assert [run.fault for run in runs] == [Fault.NONE] * 3
    assert [int(run.state.notices) & Notice.SANK for run in runs] == [Notice.SANK, 0, 0]
    row = int(np.flatnonzero(runs[0].log.phase == AxisPhase.RELEASING)[0])
    position = runs[0].truth[row:, TRUE_POSITION_rad]
    assert np.ptp(position) < 2.0 * SINKS_SHARE * constants[0].limits.following_error_max_rad
    assert judge_arm(joints, masses, scenario).violations == ()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_drive_that_reboots_leaves_the_others_their_ramps(arm: ArmConfig, joints: LockstepArm, axis: int) -> None:
    """The heartbeat was withheld from all, as if a drive ignored its stop: they stopped by watchdog, and 5 s later."""
    scenario = of_kind(arm, FaultKind.DRIVE_REBOOT, axis, harmless=False)
    runs, _ = run_arm_scenario(joints, scenario)
    assert [run.fault for run in runs] == [Fault.DRIVE_RESTARTED if k == axis else Fault.NONE for k in range(3)]
    for run in runs:
        assert run.state.phase == AxisPhase.FINISHED
        assert run.log.time_ns[-1] - joints.start_ns < (scenario.fault.at_s + 1.0) * 1e9


def test_what_is_the_computers_reaches_every_drive(arm: ArmConfig, joints: LockstepArm) -> None:
    """Off the bus: no drive gets a frame, so each stops by its own watchdog."""
    scenario = of_kind(arm, FaultKind.BUS_OFF, 0, harmless=False)
    scenario = dataclasses.replace(
        scenario, joints=tuple(dataclasses.replace(joint, duration_s=30.0) for joint in scenario.joints)
    )
    runs, _ = run_arm_scenario(joints, scenario)
    at_row = round(scenario.fault.at_s / 1e-3)
    for run in runs:
        assert run.truth[at_row, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED
        assert run.truth[at_row + 1500, TRUE_POWER_STATE] != PowerState.OPERATION_ENABLED
        assert run.fault in FAULT_CLASSES[FaultKind.BUS_OFF].causes


@pytest.mark.parametrize(("axis", "touched"), [(0, [0, 1]), (2, [2])])
def test_an_adapter_that_is_off_one_of_two_buses_is_a_fault_of_the_joints_on_it(
    arm: ArmConfig, axis: int, touched: list[int]
) -> None:
    given = on_two_buses(arm)
    scenario = of_kind(given, FaultKind.BUS_OFF, axis, harmless=False)
    assert [k for k, events in enumerate(scenario.touching(given.joints)) if events] == touched
    assert all(scenario.touching(arm.joints))
    assert judge_arm(LockstepArm(given), masses_of(given), scenario).violations == ()


# --- each invariant notices ---


@pytest.fixture
def stopped(arm: ArmConfig, joints: LockstepArm) -> tuple[list[LockstepRun], ArmScenario]:
    """The elbow's encoder jumped; arrays that a test may change."""
    scenario = of_kind(arm, FaultKind.ENCODER_JUMP, 1, harmless=False)
    runs, _ = run_arm_scenario(joints, scenario)
    return [dataclasses.replace(run, log=run.log.copy(), truth=run.truth.copy()) for run in runs], scenario


def lines(arm: ArmConfig, joints: LockstepArm, runs: list[LockstepRun], scenario: ArmScenario) -> list[str]:
    start_ns = joints.start_ns
    rows = [arm_campaign.fault_row_of(run, start_ns, PERIOD_NS) for run in runs]
    return [
        *arm_campaign._torque_before_all(runs, start_ns, PERIOD_NS),
        *arm_campaign._not_together(runs),
        *arm_campaign._wrong_report(runs, scenario, arm, rows, start_ns, PERIOD_NS),
    ]


def first_torque(run: LockstepRun) -> int:
    return int(np.flatnonzero(run.log.command_torque_Nm)[0])


def spoil_enabling(runs: list[LockstepRun], cycles: int) -> None:
    """The wrist's drive is enabled so many cycles after the first torque."""
    row = min(first_torque(run) for run in runs)
    runs[2].truth[: row + cycles, TRUE_POWER_STATE] = PowerState.SWITCHED_ON
    runs[2].truth[row + cycles, TRUE_POWER_STATE] = PowerState.OPERATION_ENABLED


def spoil_stop(runs: list[LockstepRun], cycles: int) -> None:
    """The wrist goes on for so many cycles."""
    first = min(int(np.flatnonzero(run.log.phase >= AxisPhase.RAMPING)[0]) for run in runs)
    runs[2].log.phase[: first + cycles] = AxisPhase.TRACKING


def spoil_report(runs: list[LockstepRun], cycles: int) -> None:
    """The shoulder says that it was so many cycles before the elbow; negative: after it."""
    row = int(np.flatnonzero(runs[1].log.fault != Fault.NONE)[0])
    runs[0].log.fault[row - cycles :] = Fault.FOLLOWING_ERROR
    runs[0] = dataclasses.replace(runs[0], fault=Fault.FOLLOWING_ERROR)


@pytest.mark.parametrize(
    ("spoil", "just_wrong", "just_right", "words"),
    [
        (spoil_enabling, 1, 0, "before the drive of joint 2 was enabled"),
        (spoil_stop, 2, 1, "went on for 2 cycles"),
        (spoil_report, 1, 0, "reported as that of shoulder, FOLLOWING_ERROR"),
    ],
)
def test_each_invariant_of_all_joints_notices(
    arm: ArmConfig, joints: LockstepArm, stopped: Any, spoil: Any, just_wrong: int, just_right: int, words: str
) -> None:
    runs, scenario = stopped
    assert lines(arm, joints, runs, scenario) == []
    for amount, noticed in ((just_right, False), (just_wrong, True)):
        spoilt = [dataclasses.replace(run, log=run.log.copy(), truth=run.truth.copy()) for run in runs]
        spoil(spoilt, amount)
        assert any(words in line for line in lines(arm, joints, spoilt, scenario)) is noticed


def test_a_cause_that_has_nothing_to_do_with_it_is_noticed(arm: ArmConfig, joints: LockstepArm, stopped: Any) -> None:
    runs, scenario = stopped
    for axis, fault, words in ((1, Fault.OVERRUN, "elbow: the cause"), (0, Fault.DRIVE_FAULT, "shoulder: reported")):
        spoilt = list(runs)
        spoilt[axis] = dataclasses.replace(runs[axis], fault=fault)
        assert any(words in line for line in lines(arm, joints, spoilt, scenario)), fault


def test_a_joint_that_leaves_its_envelope_is_named(
    arm: ArmConfig, joints: LockstepArm, masses: Masses, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = of_kind(arm, FaultKind.ENCODER_JUMP, 1, harmless=False)
    runs, constants = run_arm_scenario(joints, scenario)
    allowed = envelopes(joints, masses, scenario, constants)
    assert judge_arm(joints, masses, scenario).violations == ()
    for column, value, words in (
        (TRUE_POSITION_rad, allowed[2].position_max_rad + 1e-6, "wrist: position"),
        (TRUE_VELOCITY_radps, -allowed[2].velocity_max_radps - 1e-6, "wrist: speed"),
    ):
        runs[2].truth[1000, column], before = value, runs[2].truth[1000, column]
        monkeypatch.setattr(arm_campaign, "run_arm_scenario", lambda *_: (runs, constants))
        (line,) = judge_arm(joints, masses, scenario).violations
        assert line.startswith(words)
        runs[2].truth[1000, column] = before


def test_the_envelope_follows_its_derivation(arm: ArmConfig, joints: LockstepArm) -> None:
    """By hand, for masses that do not depend on the pose: the elbow's drive fails, nothing else is thrown."""
    scenario = of_kind(arm, FaultKind.DRIVE_FAULT, 1, harmless=False)
    _, constants = run_arm_scenario(joints, scenario)
    plain = Masses(np.diag([0.5, 1.25, 8.0]), np.zeros((3, 3)), np.array([30.0, 10.0, 1.0]), np.eye(3))
    allowed = envelopes(joints, plain, scenario, constants)[1]
    push = 1.25 * (0.6 * 121.0 + 10.0 + sum(scenario.fault.plant["torque_ripple_Nm"]))
    speed, brake = 3.4 + push * 0.01, joints.quick_stop_radps2[1]
    assert brake == pytest.approx(1e6 / (524288 / (2 * np.pi)))
    assert allowed.velocity_max_radps == pytest.approx(speed)
    assert allowed.position_max_rad == pytest.approx(2.0 + 0.034 + 0.5 * push * 1e-4 + speed**2 / (2 * brake))


# --- the verb ---


def test_the_verb_takes_an_arm_and_replays_one_scenario(arm: ArmConfig, tmp_path: Path) -> None:
    shown, out, _ = output(json=True)
    assert fault_campaign(arm, shown, drawn=Drawn(count=3, seed=5), folder=tmp_path / "new", workers=Workers(1)) == 0
    assert json.loads(out.getvalue())["scenarios"] == 3
    assert json.loads((tmp_path / "new" / "campaign.json").read_text())["violations"] == []
    shown, out, _ = output(json=True)
    assert fault_campaign(arm, shown, drawn=Drawn(seed=5, scenario=40)) == 0
    told = json.loads(out.getvalue())
    assert told["scenario"]["joint"] == 1
    assert len(told["scenario"]["joints"]) == 3
    assert told["verdict"]["number"] == 40


def test_what_is_one_joints_is_refused_and_so_is_an_arm_that_proves_nothing(arm: ArmConfig) -> None:
    shown, _, _ = output()
    with pytest.raises(UsageError, match=r"--sweep is one joint's, and .*arm.toml is an arm"):
        fault_campaign(arm, shown, during="sweep")
    slow = arm.joints[1].changed(limits__velocity_max_radps=0.9)
    with pytest.raises(ConfigurationError, match=r"elbow.toml: limits.velocity_max_radps \(=0.9\) must be at least 1"):
        require_arm_fits(dataclasses.replace(arm, joints=(arm.joints[0], slow, arm.joints[2])))
