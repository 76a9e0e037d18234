"""The campaign: no violation in some hundred scenarios, and each invariant does notice what it is for."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUTHS
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.drawing import png
from jointctl.tools.experiments import judge as judge_module
from jointctl.tools.experiments.campaign import Campaign, campaign_figure, rows_by_kind, run_campaign
from jointctl.tools.experiments.fault_scenarios import FAULT_CLASSES, During, Event, draw_scenario, kinds_during
from jointctl.tools.experiments.judge import Envelope, envelope, judge, reaction_s, run_scenario
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from jointctl.tools.verbs.fault_campaign import Drawn, fault_campaign
from tests.page_figures import foreign_colours, svgs
from tests.places import CONFIGS
from tests.sessions import output

CONFIG = CONFIGS / "virtual.toml"
KINDS = len(kinds_during("run"))
WIDE = Envelope(-9.0, 9.0, 9.0, 60.0, 20.0, 1.0, 2.0)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(CONFIG)


@pytest.mark.parametrize(("seed", "during"), [(11, "run"), (12, "run"), (13, "program")])
def test_no_scenario_violates_an_invariant(config: Config, lockstep: LockstepJoint, seed: int, during: During) -> None:
    kinds = kinds_during(during)
    found = [judge(config, lockstep, draw_scenario(seed, number, during)) for number in range(6 * len(kinds))]
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert {v.kind for v in found} == {kind.name.lower() for kind in kinds}
    assert any(v.harmless for v in found)
    tripped = [v for v in found if v.fault != "NONE"]
    assert len(tripped) > len(found) // 4  # the faults are no trifles
    assert all(v.fault == "NONE" for v in found if v.harmless)


@pytest.mark.parametrize(("seed", "during"), [(14, "run"), (15, "program")])
def test_no_pair_violates_an_invariant(config: Config, lockstep: LockstepJoint, seed: int, during: During) -> None:
    drawn = [draw_scenario(seed, number, during, pairs=True) for number in range(3 * KINDS)]
    found = [judge(config, lockstep, one) for one in drawn]
    assert [(v.number, v.kind, v.then, v.violations) for v in found if v.violations] == []
    assert sum(v.fault != "NONE" for v in found) > len(found) // 3
    events = [event for one in drawn for event in one.events]
    assert {FaultKind.STOP_REQUESTED, FaultKind.LOOP_KILLED} <= {event.kind for event in events}
    assert not any(v.harmless for v in found)


def test_the_second_fault_of_a_pair_comes_as_often_in_the_cycle_as_in_the_stop() -> None:
    drawn = [draw_scenario(1, number, pairs=True) for number in range(1000)]
    after_s = [one.second.at_s - one.at_s for one in drawn if one.second is not None]
    counts, _ = np.histogram(after_s, (0.0005, 0.005, 0.05, 0.5, 2.0))
    assert counts == pytest.approx([278, 278, 278, 167], abs=50)
    assert [draw_scenario(1, number).second for number in range(50)] == [None] * 50


def test_a_damaged_report_is_not_that_of_a_drive_that_stops(config: Config, lockstep: LockstepJoint) -> None:
    """The drive got no SYNC after it: it held its last torque for 5.1 s, until the heartbeat ended with the loop.

    Whatever the report says: the numbers draw its bytes.
    """
    scenario = draw_scenario(16, 1862, pairs=True)
    for number in (1862, *range(13, 1400, 33)):
        verdict = judge(config, lockstep, dataclasses.replace(scenario, number=number))
        assert (verdict.kind, verdict.then) == ("tpdo_corrupted", "sync_lost 1.6 ms later")
        assert verdict.violations == (), number
        assert verdict.off_s is not None
        assert verdict.off_s < 0.3


def test_a_jump_behind_a_reading_that_stands_still_need_not_be_noticed(config: Config, lockstep: LockstepJoint) -> None:
    scenario = draw_scenario(42, 615, "program", pairs=True)
    assert [event.kind for event in scenario.events] == [FaultKind.ENCODER_STUCK, FaultKind.ENCODER_JUMP]
    run, _ = run_scenario(config, lockstep, scenario)
    assert judge_module.wrong_cause(run, scenario.events, 1e-3, lockstep.start_ns) == []
    assert judge_module.wrong_cause(run, scenario.events[1:], 1e-3, lockstep.start_ns) == ["the fault was not noticed"]


def test_every_kind_of_fault_has_its_class() -> None:
    assert set(FAULT_CLASSES) == set(FaultKind) - {FaultKind.NONE}
    for item in FAULT_CLASSES.values():
        assert item.harmful is not None or item.harmless is not None
        assert (item.harmful is None) == (not item.causes)


def test_number_and_seed_decide_everything(config: Config, lockstep: LockstepJoint) -> None:
    assert draw_scenario(3, 40) == draw_scenario(3, 40)
    assert draw_scenario(3, 40) != draw_scenario(4, 40)
    assert judge(config, lockstep, draw_scenario(3, 40)) == judge(config, lockstep, draw_scenario(3, 40))


# --- each invariant notices ---
def good_run(cycles: int = 300, tail: int = 100) -> LockstepRun:
    """A made-up run that satisfies every invariant: off, enabled with a torque that varies, off."""
    log = new(LogRecord, cycles)
    truth = np.zeros((cycles + tail, TRUTHS))
    log.time_ns = np.arange(cycles) * 1_000_000
    log.phase[:50], log.phase[50:250], log.phase[250:] = AxisPhase.WAITING, AxisPhase.TRACKING, AxisPhase.DISABLING
    log.request[50:250] = DriveRequest.ENABLE
    log.command_torque_Nm[51:240] = 10.0 * np.sin(np.arange(189) / 20.0)
    truth[:, TRUE_POWER_STATE] = PowerState.SWITCH_ON_DISABLED
    truth[53:252, TRUE_POWER_STATE] = PowerState.OPERATION_ENABLED
    state = type("State", (), {"phase": AxisPhase.FINISHED, "fault_value": 0.0, "fault_drive_error": 0})()
    return LockstepRun(log, state, None, None, Fault.NONE, truth)


def all_checks(run: LockstepRun, fault_row: int = -1) -> list[str]:
    scenario = draw_scenario(1, 0)
    return judge_module.wrong_of_joint(run, WIDE, scenario.events, fault_row, 0, 1_000_000)[0]


def test_a_good_run_violates_nothing() -> None:
    assert all_checks(good_run()) == []


def set_(field: str, rows: Any, value: Any) -> Any:
    return lambda run: run.log[field].__setitem__(rows, value)


def true(column: int, rows: Any, value: Any) -> Any:
    return lambda run: run.truth.__setitem__((rows, column), value)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (set_("command_torque_Nm", 100, 60.1), "exceeds 60"),
        (set_("command_torque_Nm", 100, float("nan")), "torque command"),
        (set_("command_torque_Nm", slice(100, 110), 35.0), "steps by"),
        (set_("command_torque_Nm", 20, 0.1), "without power"),
        (true(0, 60, 9.1), "position"),
        (true(0, 399, -9.1), "position"),
        (true(1, 60, -9.1), "speed 9.10"),
        (true(1, 60, float("nan")), "not finite"),
        (true(TRUE_POWER_STATE, 399, PowerState.OPERATION_ENABLED), "not off and at rest"),
        (true(1, 399, 0.03), "not off and at rest"),
        (true(TRUE_POWER_STATE, slice(300, 310), PowerState.OPERATION_ENABLED), "enabled again 51 ms after"),
        (set_("request", slice(260, 270), DriveRequest.ENABLE), "asked to enable again"),
        (set_("request", slice(200, 210), DriveRequest.PREPARE), "asked to enable again"),
        (lambda run: setattr(run.state, "phase", AxisPhase.DISABLING), "did not finish"),
    ],
)
def test_each_invariant_notices(spoil: Any, words: str) -> None:
    run = good_run()
    spoil(run)
    assert any(words in line for line in all_checks(run)), all_checks(run)


@pytest.mark.parametrize(
    ("kind", "rises", "allowed"),
    [
        (FaultKind.RPDO_CORRUPTED, 254, True),  # asked last in 249; 2 cycles of the bus and 3 of the fault
        (FaultKind.RPDO_CORRUPTED, 255, False),
        (FaultKind.RPDO_LOST, 251, True),
        (FaultKind.RPDO_LOST, 252, False),
        (FaultKind.RPDO_REORDERED, 252, True),
        (FaultKind.RPDO_REORDERED, 253, False),
    ],
)
def test_only_what_the_wire_holds_may_enable_after_the_loop_has_given_up(
    kind: FaultKind, rises: int, allowed: bool
) -> None:
    """Seed 3, scenario 2834: the frame that should have said "off" said "enable"; the next sound one said "off"."""
    run = good_run()
    run.truth[240:rises, TRUE_POWER_STATE] = PowerState.SWITCH_ON_DISABLED
    run.truth[rises : rises + 2, TRUE_POWER_STATE] = PowerState.OPERATION_ENABLED
    run.truth[rises + 2 :, TRUE_POWER_STATE] = PowerState.SWITCH_ON_DISABLED
    scenario = dataclasses.replace(draw_scenario(1, 0), kind=kind, duration_s=0.003)
    assert (judge_module._enabled_again(run, scenario.events, 0, 1_000_000) == []) is allowed


@pytest.mark.parametrize(("off_row", "late"), [(1299, False), (1302, True)])
def test_the_time_to_stop_is_checked_at_its_boundary(off_row: int, late: bool) -> None:
    run = good_run(300, 1200)
    run.truth[253:off_row, TRUE_POWER_STATE] = PowerState.QUICK_STOP_ACTIVE
    lines = judge_module._time_off(run, WIDE, (), 300, 1e-3)[0]
    assert any("after the fault" in line for line in lines) is late


@pytest.mark.parametrize(("off_row", "late"), [(1219, False), (1222, True)])
def test_a_loop_that_is_killed_is_given_up_in_time(off_row: int, late: bool) -> None:
    run = good_run(300, 1200)
    run.state.phase = AxisPhase.TRACKING
    run.truth[200:off_row, TRUE_POWER_STATE] = PowerState.QUICK_STOP_ACTIVE
    killed = Event(FaultKind.LOOP_KILLED, True, 0.22, 30.0, 1.0)
    lines, _ = judge_module.wrong_of_joint(run, WIDE, [killed], -1, 0, 1_000_000)
    assert [line for line in lines if "after the death of the loop" in line] == lines
    assert bool(lines) is late
    assert "the axis did not finish, phase TRACKING" in judge_module.wrong_of_joint(run, WIDE, [], -1, 0, 1_000_000)[0]


def test_a_wrong_cause_and_a_fault_that_is_not_noticed_are_violations(config: Config, lockstep: LockstepJoint) -> None:
    number = list(FAULT_CLASSES).index(FaultKind.DRIVE_REBOOT)
    scenario = dataclasses.replace(draw_scenario(1, number), at_s=1.5, trajectory=draw_scenario(1, 1).trajectory)
    run, _ = run_scenario(config, lockstep, scenario)
    assert judge_module.wrong_cause(run, scenario.events, 1e-3, lockstep.start_ns) == []
    wrong = dataclasses.replace(run, fault=Fault.VELOCITY_LIMIT)
    (line,) = judge_module.wrong_cause(wrong, scenario.events, 1e-3, lockstep.start_ns)
    assert "the cause is reported as VELOCITY_LIMIT" in line
    left = dataclasses.replace(run, fault=Fault.DRIVE_NOT_ENABLED)
    for code, told in ((0x8250, False), (0x8130, True)):
        left.state.fault_drive_error = code
        lost = dataclasses.replace(scenario, kind=FaultKind.RPDO_LOST)
        lines = judge_module.wrong_cause(left, lost.events, 1e-3, lockstep.start_ns)
        assert any("reported as 8130h, not 8250h" in line for line in lines) is told
    (line,) = judge_module.wrong_cause(run, scenario.events, 1e-3, lockstep.start_ns, twin=True)
    assert "a harmless fault tripped" in line
    early = dataclasses.replace(scenario, at_s=1e6)
    quiet, _ = run_scenario(config, lockstep, early)
    late = dataclasses.replace(scenario, at_s=1.2)
    assert judge_module.wrong_cause(quiet, late.events, 1e-3, lockstep.start_ns) == ["the fault was not noticed"]


REVERSED = dataclasses.replace(  # on a plant of 2 kg m2 without ripple, whose friction is the configured one
    draw_scenario(1, 0),
    kind=FaultKind.TORQUE_REVERSED,
    plant={"inertia_kgm2": 2.0, "torque_ripple_Nm": (0.0, 0.0), "friction_positive_scale": 1.0,
           "friction_negative_scale": 1.0},
)  # fmt: skip


def test_the_envelope_follows_its_derivation(config: Config, lockstep: LockstepJoint) -> None:
    """Recomputed by hand for a plant of 2 kg m2 without ripple: 60.5 Nm for 10 ms, then friction alone."""
    allowed = envelope(config, REVERSED, lockstep.constants()[0])
    speed = 1.0 + 60.5 / 2.0 * 0.01
    brake = 121.0 * 0.1063 * 0.95 / 2.0
    assert allowed.velocity_max_radps == pytest.approx(speed)
    way = 0.01 + 0.5 * 30.25 * 1e-4 + speed**2 / (2.0 * brake)
    assert allowed.position_max_rad == pytest.approx(0.7 + way)
    assert allowed.position_min_rad == pytest.approx(-0.7 - way)
    assert allowed.stop_s == pytest.approx(0.01 + speed / brake + 1.0)
    assert reaction_s(config, [dataclasses.replace(REVERSED, kind=FaultKind.SYNC_LOST)]) == pytest.approx(
        0.01 + 0.05 + 0.02 + 0.2
    )


# --- the verb ---
def test_the_verb_writes_table_json_and_picture(config: Config, tmp_path: Path) -> None:
    shown, out, _ = output(json=True)
    page = tmp_path / "campaign.html"
    assert (
        fault_campaign(
            config, shown, drawn=Drawn(count=KINDS, seed=5), folder=tmp_path / "new", workers=Workers(1), report=page
        )
        == 0
    )
    assert [foreign_colours(svg) for svg in svgs(page.read_text())] == [set()]
    assert f"0 of {KINDS} scenarios violate an invariant, seed 5." in page.read_text()
    data = json.loads(out.getvalue())
    assert (data["scenarios"], data["violations"], data["interrupted"]) == (KINDS, 0, False)
    report = json.loads((tmp_path / "new" / "campaign.json").read_text())
    assert report["violations"] == []
    assert len(report["kinds"]) == KINDS
    assert (tmp_path / "new" / "campaign.png").read_bytes().startswith(b"\x89PNG")


def test_a_violation_is_told_with_the_command_that_replays_it(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judge_module, "_motion", lambda run, allowed: ["made up"])
    shown, _, err = output(json=True)
    page = tmp_path / "campaign.html"
    assert (
        fault_campaign(config, shown, drawn=Drawn(count=2, seed=5), folder=tmp_path, workers=Workers(1), report=page)
        == 10
    )
    assert page.read_text().count("made up") == 2
    assert "virtual.toml --seed 5 --scenario 0" in err.getvalue()
    report = json.loads((tmp_path / "campaign.json").read_text())
    assert report["violations"][1]["violations"] == ["made up"]
    assert report["violations"][1]["scenario"]["number"] == 1


def test_a_violation_of_a_pair_names_both_and_is_replayed(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judge_module, "_motion", lambda run, allowed: ["made up"])
    shown, _, err = output(json=True)
    drawn = Drawn(count=1, seed=5, pairs=True)
    assert fault_campaign(config, shown, drawn=drawn, folder=tmp_path, workers=Workers(1)) == 10
    first = draw_scenario(5, 0, pairs=True)
    assert first.second is not None
    assert f"scenario 0 (frames_lost, {first.then(first.second)}): made up" in err.getvalue()
    assert "virtual.toml --pairs --seed 5 --scenario 0" in err.getvalue()
    shown, out, _ = output(json=True)
    assert fault_campaign(config, shown, drawn=dataclasses.replace(drawn, scenario=0)) == 10
    told = json.loads(out.getvalue())
    assert told["scenario"]["second"]["kind"] == first.second.kind.name.lower()
    assert told["verdict"]["then"] == first.then(first.second)


def test_one_scenario_is_replayed(config: Config) -> None:
    shown, out, _ = output(json=True)
    assert fault_campaign(config, shown, drawn=Drawn(seed=5, scenario=7)) == 0
    data = json.loads(out.getvalue())
    assert data["scenario"]["number"] == 7
    assert data["verdict"]["number"] == 7


def test_ctrl_c_keeps_what_is_done(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def three(*_: Any) -> Any:
        lockstep = LockstepJoint(config)
        for number in range(3):
            yield [judge(config, lockstep, draw_scenario(1, number))]
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    monkeypatch.setattr(Workers, "results", three)
    shown, out, _ = output(json=True)
    assert fault_campaign(config, shown, drawn=Drawn(count=100), folder=tmp_path) == 130
    data = json.loads(out.getvalue())
    assert (data["scenarios"], data["interrupted"]) == (3, True)
    assert json.loads((tmp_path / "campaign.json").read_text())["scenarios"] == 3


def test_workers_give_the_same_verdicts_as_one_process(config: Config, lockstep: LockstepJoint, tmp_path: Path) -> None:
    done: list[float] = []
    found, _, interrupted = run_campaign(Campaign(load_config(CONFIG), 9), 40, done.append, Workers(2))
    assert not interrupted
    assert done[-1] == 40.0
    alone = [judge(config, lockstep, draw_scenario(9, number)) for number in range(40)]
    assert [dataclasses.astuple(v)[:8] for v in found] == [dataclasses.astuple(v)[:8] for v in alone]
    rows = rows_by_kind(found)
    assert sum(row.scenarios for row in rows) == 40
    assert len(png(campaign_figure(found, 1.0))) > 10_000
