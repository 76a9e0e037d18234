"""`doctor --motion`: what it says to a joint that is right, and to each thing that may be the wrong way round."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.faults.kinds import FaultConstants, FaultKind
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import OK, PROBLEM
from jointctl.tools.motion_check.plan import CheckMotion, config_of_check, make_plan, motion_table
from jointctl.tools.motion_check.verdict import motion_findings
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.simulation.lockstep import LockstepJoint
from tests.two_encoders import NODE, config_with
from tests.unit.inspection.checked_joint import checked

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


@pytest.mark.parametrize("change", [reverse_encoder, reverse_torque])
def test_a_wrong_sign(tmp_path: Path, change: Any) -> None:
    config = config_with(tmp_path)
    found, records, fault = checked(config, change)
    assert fault in (Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR)
    assert found["direction"].status == PROBLEM
    assert "encoder.direction; else drive.torque_direction" in found["direction"].cure
    assert_gentle(config, records)


@pytest.mark.parametrize(("law", "wrong"), [("encoder", "encoder"), ("joint_encoder", "encoder")])
def test_with_two_encoders_the_wrong_one_is_named(tmp_path: Path, law: str, wrong: str) -> None:
    config = config_with(tmp_path, {**NODE, "law": law}, virtual__initial_position_rad=0.0)
    found, records, _ = checked(config, reverse_encoder)
    assert found["two encoders"].status == PROBLEM
    assert found["two encoders"].cure.startswith(f"{wrong}.direction")
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
    faults = new(FaultConstants, 1)
    faults[0].kind, faults[0].start_s, faults[0].duration_s = FaultKind.ENCODER_STUCK, 0.5, 100.0
    plan, joint = make_plan(config, None), LockstepJoint(config)
    constants = CheckMotion(config_of_check(config, plan), plan).constants(
        joint.report, motion_table(plan, joint.report.start_position_rad)
    )
    constants[0].sequence.supervisor_max_cycles = 0
    joint.table = motion_table(plan, joint.report.start_position_rad)
    run = joint.run_with_faults(faults, constants, tail_s=0.2)
    assert run.fault in (Fault.POSITION_FROZEN, Fault.POSITION_DISAGREEMENT)
    assert abs(float(run.plant.joint_position_rad) - joint.report.start_position_rad) < 0.1


def test_the_records_name_the_encoder_that_stood(tmp_path: Path) -> None:
    config = config_with(tmp_path, {**NODE, "law": "encoder"})
    _, records, _ = checked(config)
    still = records.copy()
    still.position_rad[:] = still.position_rad[0]
    (found,) = motion_findings(config, make_plan(config, None), still, Fault.POSITION_DISAGREEMENT, None)
    assert (found.status, found.cure.startswith("[encoder] is dead")) == (PROBLEM, True)
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
