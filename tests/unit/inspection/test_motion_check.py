"""`doctor --motion`: its plan, its verdict, and what it says to each thing that may be the wrong way round."""

from __future__ import annotations

import dataclasses
import math
import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import ConfigurationError, MarginError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.faults import FaultKind
from jointctl.tools.analysis.margin_gate import passes, require_margin
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import static_friction_Nm, velocity_of_a_count_radps
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import APPROACH_MIN_S
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM, Finding
from jointctl.tools.inspection.motion_check import (
    CheckMotion,
    CheckPlan,
    TRAVEL_MAX_rad,
    TRAVEL_rad,
    config_of_check,
    judged,
    make_plan,
    motion_findings,
    motion_table,
)
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.tuning.frequency_response import motor_fed
from jointctl.tools.verbs import doctor as doctor_motion_module
from tests.configurations import shipped, written
from tests.made_faults import one_fault
from tests.two_encoders import NODE, config_with

REPORT = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.1, 0.06, 1e-5)


# --- The motion check on a virtual joint in simulated time ---
def check_in_lockstep(
    joint: LockstepJoint, config: Config, plan: CheckPlan, faults: Any = None, **options: Any
) -> tuple[Any, Any, Fault]:
    """The same motion on a virtual joint in simulated time: its records, the plant in the end and the fault."""
    table = motion_table(plan, joint.report.start_position_rad)
    constants = CheckMotion(config_of_check(config, plan), plan).constants(joint.report, table)
    constants[0].sequence.supervisor_max_cycles = 0  # nobody watches in simulated time
    joint.table = table
    run = joint.run(constants) if faults is None else joint.run_with_faults(faults, constants, **options)
    return run.log, run.plant, run.fault


def checked(config: Config, change: Any = None, faults: Any = None) -> tuple[dict[str, Finding], Any, Fault]:
    """Findings by topic, records and fault; `change` may spoil the joint."""
    plan = make_plan(config, None)
    joint = LockstepJoint(config)
    if change is not None:
        change(joint)
    records, _, fault = check_in_lockstep(joint, config, plan, faults)
    text = fault_text(fault, 0.0, 0) if fault is not Fault.NONE else None
    return {f.topic: f for f in motion_findings(config, plan, records, fault, text)}, records, fault


# --- The plan of a motion check: torque, speed and travel, smooth and never wider than the configuration ---
def test_the_torque_is_that_of_friction_and_gravity_and_never_above_the_limit(tmp_path: Path) -> None:
    static_Nm = 0.1575 * 121.0
    assert make_plan(config_with(tmp_path), None).torque_Nm == pytest.approx(2.0 * static_Nm)
    assert make_plan(config_with(tmp_path, joint__gravity_Nm=5.0), None).torque_Nm == pytest.approx(2.0 * static_Nm + 5)
    assert make_plan(config_with(tmp_path, limits__torque_max_Nm=25.0), None).torque_Nm == 25.0
    assert make_plan(config_with(tmp_path), 12.0).torque_Nm == 12.0
    with pytest.raises(ConfigurationError, match=re.escape("--torque (=60.1) must be in (0..60]")):
        make_plan(config_with(tmp_path), 60.1)


def test_a_soft_joint_on_a_slow_bus_is_pulled_farther_then_with_less_torque(tmp_path: Path) -> None:
    slow = {"loop__rate_Hz": 250, "control__velocity_cutoff_Hz": 100}
    wide = motor_fed(load_config(written(tmp_path / "wide.toml", "realistic", **slow)))
    narrow = wide.changed(limits__position_min_rad=-0.4, limits__position_max_rad=0.4)
    static_Nm = static_friction_Nm(wide)
    assert static_Nm is not None
    plan = make_plan(wide, None)
    assert (plan.travel_rad, plan.torque_Nm) == (0.3, 2.0 * static_Nm)
    plan = make_plan(narrow, None)
    assert plan.travel_rad == 0.2
    assert 1.25 * static_Nm < plan.torque_Nm < 1.6 * static_Nm
    assert passes(config_of_check(narrow, plan))
    findings, _, fault = checked(narrow)
    assert fault is Fault.NONE
    assert all(finding.status != PROBLEM for finding in findings.values())
    assert make_plan(narrow, 2.0 * static_Nm).torque_Nm == 2.0 * static_Nm  # which the user wants


def test_the_check_only_narrows_torque_speed_and_travel(tmp_path: Path) -> None:
    config = config_with(tmp_path)
    plan = make_plan(config, None)
    made = CheckMotion(config_of_check(config, plan), plan).constants(REPORT, motion_table(plan, 0.1))[0].limits
    assert made.torque_max_Nm == plan.torque_Nm < config.limits.torque_max_Nm
    assert made.velocity_max_radps == 0.5 < config.limits.velocity_max_radps
    assert (made.position_min_rad, made.position_max_rad) == pytest.approx((0.0, 0.2))
    assert made.sample_age_max_cycles == round(config.limits.sample_age_max_s * config.loop.rate_Hz)
    assert canopen_section(config_of_check(config, plan)).max_torque_permille is None


@pytest.mark.parametrize(("torque_Nm", "watched_Nm"), [(None, 0.75 * 38.115), (5.0, 4.75)])
def test_a_standing_joint_is_never_pushed_unwatched(tmp_path: Path, torque_Nm: float | None, watched_Nm: float) -> None:
    """Also where gravity takes more than the torque that is allowed."""
    gravity_Nm = 0.0 if torque_Nm is None else 10.0
    config = config_with(tmp_path, joint__gravity_Nm=gravity_Nm, virtual__gravity_Nm=gravity_Nm)
    plan = make_plan(config, torque_Nm)
    made = CheckMotion(config_of_check(config, plan), plan).constants(REPORT, motion_table(plan, 0.1))[0].limits
    assert made.frozen_torque_Nm == pytest.approx(watched_Nm)
    assert made.frozen_torque_Nm < plan.torque_Nm


@pytest.mark.parametrize("bristle_Nmprad", [5e3, 8e4])
def test_bristles_that_give_way_are_not_taken_for_breaking_away(tmp_path: Path, bristle_Nmprad: float) -> None:
    """4 mrad under the static friction, where 1.2 mrad of the motor's encoder count as moved."""
    findings, _, fault = checked(config_with(tmp_path, virtual__bristle_stiffness_Nmprad=bristle_Nmprad))
    assert fault is Fault.NONE
    assert 0.95 * 19.0575 < findings["friction"].numbers["break_away_Nm"] < 1.25 * 19.0575


@pytest.mark.parametrize("bits", [14, 15, 16])
def test_the_kicks_of_a_coarse_encoder_are_not_taken_for_what_moves_the_joint(bits: int) -> None:
    """Each count is some Nm for a few milliseconds; with them `tune` took the joint for a light one."""
    config = shipped("precise").changed(encoder__counts_per_turn=1 << bits, virtual__encoder_noise_counts=0.3)
    findings, _, fault = checked(config)
    assert fault is Fault.NONE
    assert 0.95 * 19.0575 < findings["friction"].numbers["break_away_Nm"] < 1.25 * 19.0575
    assert 0.95 * 19.0575 < findings["direction"].numbers["torque_max_Nm"] < 1.35 * 19.0575


@pytest.mark.parametrize("gravity_Nm", [-12.0, 0.0, 12.0])
def test_the_torque_to_break_away_is_that_beside_gravity(tmp_path: Path, gravity_Nm: float) -> None:
    """A pull down takes less torque than friction, a pull up takes more."""
    lever = {"gravity_Nm": abs(gravity_Nm), "gravity_zero_rad": -math.copysign(0.5 * math.pi, gravity_Nm)}
    gravity = {f"{section}__{key}": value for section in ("joint", "virtual") for key, value in lever.items()}
    findings, _, fault = checked(config_with(tmp_path, **gravity))
    assert fault is Fault.NONE
    assert findings["friction"].numbers["break_away_Nm"] == pytest.approx(22.4, abs=1.5)
    assert ("beside gravity" in findings["friction"].text) == bool(gravity_Nm)


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


@pytest.mark.parametrize("half_rad", [0.015, 0.03, 0.07])
def test_a_short_range_takes_a_quarter_of_it(tmp_path: Path, half_rad: float) -> None:
    """The usual 0.04 rad to either side fitted nowhere in it: "needs [0.01..-0.01]"."""
    limits = {"limits__position_min_rad": 1.0 - half_rad, "limits__position_max_rad": 1.0 + half_rad}
    config = config_with(tmp_path).changed(**limits, virtual__initial_position_rad=1.0 + 0.4 * half_rad)
    plan = make_plan(config, None)
    assert plan.travel_rad == pytest.approx(0.5 * half_rad)
    CheckMotion(config, plan).require_start(1.0 + 0.4 * half_rad)
    findings, records, fault = checked(config)
    assert fault is Fault.NONE
    assert findings["direction"].status == OK
    assert findings["friction"].numbers["break_away_Nm"] == pytest.approx(19.06, rel=0.2)
    assert np.max(np.abs(records.position_rad - 1.0)) < half_rad


def test_a_range_that_a_coarse_encoder_does_not_tell_is_refused_with_its_width(tmp_path: Path) -> None:
    config = config_with(tmp_path, encoder__counts_per_turn=4096)
    config = config.changed(limits__position_min_rad=-0.05, limits__position_max_rad=0.05)
    with pytest.raises(ConfigurationError, match=r"position_max_rad \(=0.05\) must be at least 0.184 rad apart"):
        CheckMotion(config, make_plan(config, None)).require_start(0.0)


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
    assert "braked beyond 0.23 rad to either side" in " ".join(CheckMotion(config, plan).placed(REPORT).lines)
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
    assert (found.remedy == "") is (status == OK)


# --- The verdict of a motion check about its records and about the fault that ended it ---
WAY_FAULTS = (Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_LIMIT, Fault.POSITION_DISAGREEMENT)


def sound_records(config: Config) -> Any:
    """Of a joint that moves with the torque, by both encoders nearly alike, until a fault stops it."""
    records = new(LogRecord, 400)
    records.phase[:380], records.phase[380:] = AxisPhase.TRACKING, AxisPhase.QUICK_STOPPING
    records.position_rad[:] = np.linspace(0.0, 0.04, 400)
    records.second_position_rad[:] = 0.86 * records.position_rad
    records.command_torque_Nm[:] = make_plan(config, None).static_friction_Nm
    return records


def judged_records(config: Config, records: Any, fault: Fault) -> tuple[set[str], str]:
    """Topics of the problems, and all that is said of the check as a whole."""
    text = fault_text(fault, 0.1, 0) if fault is not Fault.NONE else None
    found = list(motion_findings(config, make_plan(config, None), records, fault, text))
    said = " ".join(finding.text for finding in found if finding.topic == "check")
    return {finding.topic for finding in found if finding.status == PROBLEM}, said


@pytest.mark.parametrize("second", [None, NODE])
@pytest.mark.parametrize("fault", [*WAY_FAULTS, Fault.NONE])
def test_a_fault_that_no_finding_explains_is_told(tmp_path: Path, second: dict[str, Any] | None, fault: Fault) -> None:
    """With a second encoder these were dropped: everything was right, exit code 0."""
    config = config_with(tmp_path, second)
    problems, said = judged_records(config, sound_records(config), fault)
    assert problems == (set() if fault is Fault.NONE else {"check"})
    assert (f"ended while the joint moved: {fault.name}" in said) is (fault is not Fault.NONE)


@pytest.mark.parametrize("fault", [*WAY_FAULTS, Fault.DRIVE_FAULT])
def test_a_fault_that_another_problem_explains_is_not_told_twice(tmp_path: Path, fault: Fault) -> None:
    config = config_with(tmp_path, NODE)
    against = sound_records(config)
    against.command_torque_Nm *= -1.0
    problems, _ = judged_records(config, against, fault)
    assert problems == ({"direction"} if fault in WAY_FAULTS else {"direction", "check"})
    scaled = sound_records(config)
    scaled.second_position_rad[:] = 0.5 * scaled.position_rad
    problems, _ = judged_records(config, scaled, fault)
    assert problems == ({"scale"} if fault is Fault.POSITION_DISAGREEMENT else {"scale", "check"})


@pytest.mark.parametrize("fault", [Fault.POSITION_FROZEN, Fault.TORQUE_SATURATED, Fault.DRIVE_FAULT])
def test_what_stopped_a_standing_joint_is_told_unless_standing_explains_it(tmp_path: Path, fault: Fault) -> None:
    config = config_with(tmp_path)
    still = sound_records(config)
    still.position_rad[:] = 0.0
    problems, _ = judged_records(config, still, fault)
    assert problems == ({"motion", "check"} if fault is Fault.DRIVE_FAULT else {"motion"})


@pytest.mark.parametrize("second", [None, NODE])
@pytest.mark.parametrize("load_Nm", [-60.0, -1.0])
def test_a_push_from_outside(tmp_path: Path, second: dict[str, Any] | None, load_Nm: float) -> None:
    found, _, fault = checked(
        config_with(tmp_path, second), None, one_fault(FaultKind.LOAD_JUMP, 1.5, magnitude=load_Nm)
    )
    pushed = load_Nm == -60.0
    assert fault is (Fault.VELOCITY_LIMIT if pushed else Fault.NONE)
    assert ("check" in found) is pushed
    assert any(finding.status == PROBLEM for finding in found.values()) is pushed


@pytest.mark.parametrize("fault", [Fault.VELOCITY_LIMIT, Fault.NONE])
def test_an_interruption_does_not_hide_the_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], fault: Fault
) -> None:
    config = config_with(tmp_path, log__folder=str(tmp_path))
    text = fault_text(fault, 0.6, 0) if fault is not Fault.NONE else None
    result = SimpleNamespace(
        stopped_by="SIGINT", drive_state="switch on disabled", records=sound_records(config), fault=fault,
        fault_text=text, log_path=tmp_path / "run.mcap", report=SimpleNamespace(counts_per_motor_turn=0.0),
    )  # fmt: skip
    stub = lambda *_: SimpleNamespace(run=lambda: result)  # noqa: E731
    monkeypatch.setattr("jointctl.tools.session.session.Session", stub)
    code = doctor_motion_module.doctor_motion(config, Output(), assume_yes=True)
    told = capsys.readouterr()
    assert code == (130 if fault is Fault.NONE else 1)
    assert "stopped by SIGINT" in told.err
    assert ("VELOCITY_LIMIT" in told.out) is (fault is not Fault.NONE)


@pytest.mark.parametrize("moved", [True, False])
def test_an_interruption_behind_the_motion_does_not_say_that_nothing_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], moved: bool
) -> None:
    """As it is judged, say; the twin comes before the motion."""
    config = config_with(tmp_path, log__folder=str(tmp_path))

    def run() -> SimpleNamespace:
        if not moved:
            raise KeyboardInterrupt
        return SimpleNamespace(
            stopped_by="", drive_state="switch on disabled", records=(), fault=Fault.NONE, fault_text=None,
            report=SimpleNamespace(counts_per_motor_turn=0.0),
        )  # fmt: skip

    def judge(*_: object) -> None:
        raise KeyboardInterrupt

    session = SimpleNamespace(run=run, drive_state="switch on disabled")
    monkeypatch.setattr("jointctl.tools.session.session.Session", lambda *_: session)
    monkeypatch.setattr("jointctl.tools.inspection.motion_check.motion_findings", judge)
    with pytest.raises(KeyboardInterrupt) if moved else nullcontext():
        assert doctor_motion_module.doctor_motion(config, Output(), assume_yes=True) == 130
    assert ("nothing moved" in capsys.readouterr().err) is not moved


class Refusing:
    """A session that keeps its plan and is refused by the margin gate."""

    plan: Any = None

    def __init__(self, plan: Any, *_: Any) -> None:
        Refusing.plan = plan

    def run(self) -> None:
        raise MarginError("phase margin (=1.0 deg) must be at least 30 deg", "control.kp = 1 (now 2)")


def test_on_a_soft_reducer_the_spring_is_that_of_the_motor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the link it is unstable: the gate refused the check of `configs/realistic.toml`, with gains of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jointctl.tools.session.session.Session", Refusing)
    with pytest.raises(MarginError) as caught:
        doctor_motion_module.doctor_motion(shipped("realistic"), Output(), assume_yes=True)
    assert caught.value.hint == (
        "the check pulls with a law of its own: its spring is softer with less --torque (now 38.115), or with wider "
        "limits.position_*"
    )
    require_margin(Refusing.plan.config)
    assert Refusing.plan.motion.plan.travel_rad == TRAVEL_rad


@pytest.mark.parametrize("side", ["motor", "joint"])
def test_a_joint_that_the_spring_would_make_unstable_is_pulled_further(side: str) -> None:
    light = shipped(
        "realistic", joint_encoder=None, encoder__side=side, reducer__map=None, reducer__motor_inertia_kgm2=0.25,
        virtual__motor_side_inertia_kgm2=0.25, encoder__counts_per_turn=2**19 if side == "joint" else 2**16,
    )  # fmt: skip
    plan = make_plan(light, None)
    assert TRAVEL_rad < plan.travel_rad <= TRAVEL_MAX_rad
    require_margin(config_of_check(light, plan))
    with pytest.raises(MarginError):
        require_margin(config_of_check(light, dataclasses.replace(plan, travel_rad=TRAVEL_rad)))
    narrow = light.changed(limits__position_min_rad=-0.1, limits__position_max_rad=0.1)
    assert make_plan(narrow, None).travel_rad == pytest.approx(0.05)  # a quarter of the range
    found, _, fault = checked(light)
    assert fault is Fault.NONE
    assert {finding.status for finding in found.values()} == {OK}


# --- the plan ---
def test_figures_of_a_finding_are_plain_numbers(tmp_path: Path) -> None:
    found, _, _ = checked(config_with(tmp_path))
    for finding in found.values():
        assert all(isinstance(value, float) for value in dataclasses.asdict(finding)["numbers"].values())


# --- `doctor --motion`: what it says to a joint that is right, and to each thing that may be the wrong way round ---
WAYS = ("positive", "negative")


def assert_gentle(config: Config, records: Any) -> None:
    """Whatever is wrong: little torque, a little way, and switched off at the end."""
    plan = make_plan(config, None)
    assert np.abs(records.command_torque_Nm).max() <= plan.torque_Nm + 1e-9
    assert np.abs(records.position_rad - records.position_rad[0]).max() < 0.1
    assert records.phase[-1] >= AxisPhase.DISABLING


@pytest.mark.parametrize("second", [None, NODE, {**NODE, "law": "encoder"}])
@pytest.mark.parametrize("scale", [0.5, 1.1])
def test_a_joint_that_is_right(tmp_path: Path, second: dict[str, Any] | None, scale: float) -> None:
    friction = {"virtual__friction_positive_scale": scale, "virtual__friction_negative_scale": scale}
    config = config_with(tmp_path, second, **friction)
    found, records, fault = checked(config)
    assert fault is Fault.NONE
    assert {f.status for f in found.values()} == {OK}, found
    assert set(found) == {"direction", "measured torque", "friction"} | ({"two encoders"} if second else set())
    assert "began to move at" in found["friction"].text
    assert_gentle(config, records)


def reverse_encoder(joint: Any) -> None:
    """The configuration is wrong about the sign of 6064; it still knows where the joint stands."""
    port, angle = joint._port[0], joint.report.start_position_rad
    port.position_radpcount *= -1.0
    port.zero_counts += 2 * round(angle / port.position_radpcount) * -1


def reverse_torque(joint: Any) -> None:
    joint._port[0].torque_Nmppermille *= -1.0


@pytest.mark.parametrize(
    ("change", "counts"), [(reverse_encoder, 524288), (reverse_torque, 524288), (reverse_torque, 4096)]
)
def test_a_wrong_sign(tmp_path: Path, change: Any, counts: int) -> None:
    config = config_with(tmp_path, encoder__counts_per_turn=counts)
    found, records, fault = checked(config, change)
    assert fault in (Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_LIMIT)
    assert found["direction"].status == PROBLEM
    assert "encoder.direction; else drive.torque_direction" in found["direction"].remedy
    assert_gentle(config, records)


@pytest.mark.parametrize("friction", [0.1, 1.0])
@pytest.mark.parametrize("load_Nm", [-28.0, -18.0, 22.0, 35.0])
@pytest.mark.parametrize("counts", [16384, 524288])
def test_a_load_that_the_file_does_not_state_is_taken_for_no_wrong_sign(
    tmp_path: Path, friction: float, load_Nm: float, counts: int
) -> None:
    """As of gravity, when the brake opens; and no load hides a wrong sign."""
    scales = {"virtual__friction_positive_scale": friction, "virtual__friction_negative_scale": friction}
    config = config_with(tmp_path, encoder__counts_per_turn=counts, **scales)
    for change in (None, reverse_encoder, reverse_torque):
        found, records, _ = checked(config, change, one_fault(FaultKind.LOAD_JUMP, 0.2, magnitude=load_Nm))
        topics = {finding.topic for finding in found.values() if finding.status == PROBLEM}
        if change is None:
            assert topics <= {"load", "check", "motion"}
            assert "load" not in topics or "joint.gravity_Nm" in found["load"].remedy
        else:
            assert topics in ({"direction"}, {"motion"})
        assert_gentle(config, records)


def test_two_encoders_that_agree_with_each_other_are_turned_round_together(tmp_path: Path) -> None:
    found, _, _ = checked(config_with(tmp_path, NODE), reverse_torque)
    assert found["two encoders"].status == OK
    remedy = found["direction"].remedy
    assert ": joint_encoder.direction and encoder.direction; else drive.torque_direction" in remedy


@pytest.mark.parametrize(("law", "wrong"), [("encoder", "encoder"), ("joint_encoder", "encoder")])
def test_with_two_encoders_the_wrong_one_is_named(tmp_path: Path, law: str, wrong: str) -> None:
    config = config_with(tmp_path, {**NODE, "law": law}, virtual__initial_position_rad=0.0)
    found, records, _ = checked(config, reverse_encoder)
    assert found["two encoders"].status == PROBLEM
    assert found["two encoders"].remedy.startswith(f"{wrong}.direction")
    assert_gentle(config, records)


def test_with_two_encoders_a_wrong_torque_sign_is_told_from_a_wrong_encoder(tmp_path: Path) -> None:
    found, _, _ = checked(config_with(tmp_path, NODE), reverse_torque)
    assert found["two encoders"].status == OK
    assert found["direction"].status == PROBLEM


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_counts_wrong_by_a_factor(tmp_path: Path, factor: float) -> None:
    def change(joint: Any) -> None:
        joint._port[0].position_radpcount *= factor

    config = config_with(tmp_path, NODE, virtual__initial_position_rad=0.0)
    found, records, _ = checked(config, change)
    assert found["scale"].status == PROBLEM
    assert f"[encoder] moves {factor:.3g}" in found["scale"].text.replace("1.99", "2").replace("2.01", "2")
    assert_gentle(config, records)


@pytest.mark.parametrize("start_rad", [0.0, 0.1])
@pytest.mark.parametrize("law", ["encoder", "joint_encoder"])
@pytest.mark.parametrize(("own", "second"), [(65536, 524288), (524288, 65536), (32768, 16384)])
def test_counts_in_the_key_of_the_other_encoder(
    tmp_path: Path, own: int, second: int, law: str, start_rad: float
) -> None:
    """`own` and `second` are those of the joint; away from zero the two disagree before it moves."""

    def change(joint: Any) -> None:
        joint._port[0].position_radpcount *= own / second
        joint._port[0].second.radpcount *= second / own

    encoder = {**NODE, "law": law}
    true = config_with(
        tmp_path, {**encoder, "counts_per_turn": second}, encoder__counts_per_turn=own,
        virtual__initial_position_rad=start_rad,
    )  # fmt: skip
    swapped = config_with(tmp_path, {**encoder, "counts_per_turn": own}, encoder__counts_per_turn=second)
    joint, plan = LockstepJoint(true), make_plan(swapped, None)
    change(joint)
    records, _, fault = check_in_lockstep(joint, swapped, plan)
    found = list(motion_findings(swapped, plan, records, fault, None))
    (scale,) = [finding for finding in found if finding.topic == "scale"]
    assert scale.status == PROBLEM
    assert scale.text.endswith(
        f"as if encoder.counts_per_turn (={second}) and joint_encoder.counts_per_turn (={own}) were swapped"
    )
    assert scale.remedy.startswith("swap encoder.counts_per_turn and joint_encoder.counts_per_turn")
    assert not any("dead" in finding.remedy or "stood still" in finding.text for finding in found)
    assert (AxisPhase.APPROACH in records.phase) == (start_rad == 0.0)


@pytest.mark.parametrize("start_rad", [0.0, 0.1])
@pytest.mark.parametrize("swapped", [True, False])
def test_readings_in_the_place_of_the_other_encoder(tmp_path: Path, swapped: bool, start_rad: float) -> None:
    """On the motor and on the joint: the one that turns less was taken for dead."""
    config = config_with(
        tmp_path, {**NODE, "law": "encoder", "counts_per_turn": 524288}, encoder__side="motor",
        encoder__counts_per_turn=65536, virtual__initial_position_rad=start_rad,
    )  # fmt: skip
    joint, plan = LockstepJoint(config), make_plan(config, None)
    if swapped:
        joint._port[0].position_radpcount *= 524288 / 65536 / 121.0
        joint._port[0].second.radpcount *= 121.0 * 65536 / 524288
    records, _, fault = check_in_lockstep(joint, config, plan)
    found = [finding.text for finding in motion_findings(config, plan, records, fault, None)]
    said = "as if the readings of [encoder] and [joint_encoder] were swapped"
    assert [text.endswith(said) for text in found].count(True) == swapped, found
    assert (fault is Fault.NONE) is not swapped
    assert not any("stood still" in text for text in found)


def test_an_encoder_that_stood_did_not_go_the_same_way(tmp_path: Path) -> None:
    config = config_with(tmp_path, NODE, virtual__initial_position_rad=0.0)

    def change(joint: Any) -> None:
        joint._port[0].position_radpcount *= 0.01

    found, _, _ = checked(config, change)
    assert found["two encoders"].text == "[encoder] stood still while [joint_encoder] moved"


def test_the_drives_counts_are_those_in_the_key_of_the_other_encoder(tmp_path: Path) -> None:
    swapped = config_with(tmp_path, {**NODE, "counts_per_turn": 65536}, encoder__counts_per_turn=524288)
    finding = judged(swapped, 65536.0)
    assert (finding.status, "and so says joint_encoder.counts_per_turn" in finding.text) == (NOTE, True)
    assert finding.remedy.startswith("swap encoder.counts_per_turn and joint_encoder.counts_per_turn")


def test_a_joint_that_is_stuck(tmp_path: Path) -> None:
    friction = {"virtual__friction_positive_scale": 5.0, "virtual__friction_negative_scale": 5.0}
    config = config_with(tmp_path, **friction)
    found, records, _ = checked(config)
    assert found["motion"].status == PROBLEM
    assert "stood still" in found["motion"].text
    assert_gentle(config, records)


@pytest.mark.parametrize("kind", ["lugre", "stick_slip"])
@pytest.mark.parametrize(("counts", "cutoff_Hz"), [(1024, 20.0), (8192, 100.0), (16384, 100.0), (524288, 100.0)])
def test_the_way_back_is_no_standing_reading(tmp_path: Path, kind: str, counts: int, cutoff_Hz: float) -> None:
    """Friction holds the joint while the spring turns round; few counts, or pure Coulomb friction, show no twist."""
    friction = {"virtual__friction_kind": kind} | {f"virtual__friction_{way}_scale": 1.3 for way in WAYS}
    config = config_with(tmp_path, encoder__counts_per_turn=counts, control__velocity_cutoff_Hz=cutoff_Hz, **friction)
    found, records, fault = checked(config)
    assert fault is Fault.NONE
    assert {f.status for f in found.values()} == {OK}, found
    way = (records.position_rad - records.position_rad[0]) / make_plan(config, None).travel_rad
    assert -1.0 < way.min() < -0.4
    assert 0.4 < way.max() < 1.0


@pytest.mark.parametrize("scale", [0.0, 0.001, 0.05])
@pytest.mark.parametrize("wrong", [False, True])
def test_a_joint_with_hardly_any_friction(tmp_path: Path, scale: float, wrong: bool) -> None:
    """It gives back all of the work that is put into it."""
    friction = (
        {f"virtual__friction_{way}_scale": scale for way in WAYS} if scale else {"virtual__friction_kind": "none"}
    )
    found, _, _ = checked(config_with(tmp_path, **friction), reverse_torque if wrong else None)
    assert found["direction"].status == (PROBLEM if wrong else OK)


def test_a_reading_that_stands_has_no_velocity(tmp_path: Path) -> None:
    config = config_with(tmp_path, encoder__counts_per_turn=4096)
    still = checked(config)[1].copy()
    still.position_rad[:] = still.position_rad[0]
    plan = make_plan(config, None)
    (dead,) = motion_findings(config, plan, still, Fault.POSITION_FROZEN, None)
    assert (dead.topic, dead.status) == ("motion", PROBLEM)
    (fast,) = motion_findings(config, plan, still, Fault.VELOCITY_LIMIT, fault_text(Fault.VELOCITY_LIMIT, 1.2, 0))
    assert "VELOCITY_LIMIT" in fast.text


@pytest.mark.parametrize("second", [None, NODE])
def test_a_dead_encoder_is_found_before_the_joint_has_gone_far(tmp_path: Path, second: dict[str, Any] | None) -> None:
    config = config_with(tmp_path, second)
    stuck = one_fault(FaultKind.ENCODER_STUCK, 0.5)
    records, plant, fault = check_in_lockstep(LockstepJoint(config), config, make_plan(config, None), stuck, tail_s=0.2)
    assert fault in (Fault.POSITION_FROZEN, Fault.POSITION_DISAGREEMENT)
    assert abs(float(plant.joint_position_rad) - records.position_rad[0]) < 0.1


@pytest.mark.parametrize("gravity_Nm", [0.0, 20.0, 35.0])
@pytest.mark.parametrize("at_s", [0.2, 1.2])
def test_behind_a_dead_encoder_the_joint_is_not_pushed_on_whatever_gravity(
    tmp_path: Path, gravity_Nm: float, at_s: float
) -> None:
    """What holds the joint is no push: as one it hid the spring's until the joint had swung by 0.4 rad and more."""
    config = config_with(tmp_path, joint__gravity_Nm=gravity_Nm, virtual__gravity_Nm=gravity_Nm)
    plan, stuck = make_plan(config, None), one_fault(FaultKind.ENCODER_STUCK, at_s)
    records, plant, fault = check_in_lockstep(LockstepJoint(config), config, plan, stuck, tail_s=0.2)
    assert fault is Fault.POSITION_FROZEN
    assert abs(float(plant.joint_position_rad) - records.position_rad[0]) < 0.2
    _, _, healthy = check_in_lockstep(LockstepJoint(config), config, plan)
    assert healthy is Fault.NONE


def test_the_records_name_the_encoder_that_stood(tmp_path: Path) -> None:
    config = config_with(tmp_path, {**NODE, "law": "encoder"})
    _, records, _ = checked(config)
    still = records.copy()
    still.position_rad[:] = still.position_rad[0]
    (found,) = motion_findings(config, make_plan(config, None), still, Fault.POSITION_DISAGREEMENT, None)
    assert (found.status, found.remedy.startswith("[encoder] is dead")) == (PROBLEM, True)
    still = records.copy()
    still.second_position_rad[:] = 0.0
    topics = {f.topic: f for f in motion_findings(config, make_plan(config, None), still, Fault.NONE, None)}
    assert topics["two encoders"].text == "[joint_encoder] stood still while [encoder] moved"


def test_a_check_that_was_never_enabled_tells_the_fault(tmp_path: Path) -> None:
    config = config_with(tmp_path)
    _, records, _ = checked(config)
    waiting = records[records.phase == AxisPhase.WAITING]
    text = fault_text(Fault.POSITION_DISAGREEMENT, 0.3, 0)
    (found,) = motion_findings(config, make_plan(config, None), waiting, Fault.POSITION_DISAGREEMENT, text)
    assert found.text.startswith("ended before the drive was enabled: POSITION_DISAGREEMENT: the two encoders")
