"""The verdict of a motion check about its records and about the fault that ended it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.faults.kinds import FaultConstants, FaultKind
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import PROBLEM
from jointctl.tools.motion_check.plan import make_plan
from jointctl.tools.motion_check.verdict import motion_findings
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.verbs import doctor_motion as doctor_motion_module
from tests.two_encoders import NODE, config_with
from tests.unit.inspection.checked_joint import checked

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
    faults = new(FaultConstants, 1)
    faults[0].kind, faults[0].start_s, faults[0].duration_s = FaultKind.LOAD_JUMP, 1.5, 10.0
    faults[0].magnitude = load_Nm
    found, _, fault = checked(config_with(tmp_path, second), None, faults)
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
    monkeypatch.setattr(doctor_motion_module, "Session", stub)
    code = doctor_motion_module.doctor_motion(config, Output(), assume_yes=True)
    told = capsys.readouterr()
    assert code == (130 if fault is Fault.NONE else 1)
    assert "stopped by SIGINT" in told.err
    assert ("VELOCITY_LIMIT" in told.out) is (fault is not Fault.NONE)


# --- the plan --------------------------------------------------------------------------------------------------


def test_figures_of_a_finding_are_plain_numbers(tmp_path: Path) -> None:
    found, _, _ = checked(config_with(tmp_path))
    for finding in found.values():
        assert all(isinstance(value, float) for value in dataclasses.asdict(finding)["numbers"].values())
