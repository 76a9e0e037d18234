"""Campaigns on other configurations than configs/virtual.toml, during a sweep, and which ones cannot be judged."""

from __future__ import annotations

import dataclasses
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import AxisPhase, CommandKind, Fault
from jointctl.hil.faults import FaultKind
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.experiments import judge as judge_module
from jointctl.tools.experiments.campaign import Campaign, campaign_joint, run_campaign
from jointctl.tools.experiments.fault_scenarios import (
    STEPS_THAT_MOVE,
    BEFORE_s,
    LONGEST_s,
    SweepStrokes,
    TuneStep,
    draw_scenario,
    fitted,
    kinds_during,
    placed_sweep,
)
from jointctl.tools.experiments.judge import envelope, in_time, judge, reaction_s, require_fit, run_scenario
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.verbs.fault_campaign import Drawn, fault_campaign, placed_step
from tests.configurations import shipped
from tests.faults.campaign_variants import VARIANTS, write_variant
from tests.faults.test_fault_campaign import REVERSED, WIDE, good_run
from tests.places import CONFIGS

pytestmark = pytest.mark.slow("some sixty faults on each of seven joints")

KINDS = len(kinds_during("run"))


@pytest.mark.parametrize("name", ["precise", *VARIANTS])
def test_no_scenario_violates_an_invariant_with_other_configurations(tmp_path: Path, name: str) -> None:
    path = write_variant(name, tmp_path) if name in VARIANTS else CONFIGS / f"{name}.toml"
    config, joint = campaign_joint(load_config(path), "run")
    require_fit(config)
    found = [judge(config, joint, draw_scenario(13, number)) for number in range(2 * KINDS)]
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert sum(v.fault != "NONE" for v in found) > len(found) // 4


# --- during a sweep ---
@pytest.fixture(scope="module")
def sweep() -> tuple[Config, LockstepJoint]:
    return campaign_joint(load_config(CONFIGS / "sweep_virtual.toml"), "sweep")


def test_no_scenario_violates_an_invariant_during_a_sweep(sweep: tuple[Config, LockstepJoint]) -> None:
    found = [judge(*sweep, draw_scenario(13, number, "sweep")) for number in range(2 * KINDS)]
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert sum(v.fault != "NONE" for v in found) > len(found) // 4


def test_a_sweep_is_carried_out_in_its_own_mode_to_its_end(sweep: tuple[Config, LockstepJoint]) -> None:
    config, joint = sweep
    scenario = dataclasses.replace(draw_scenario(13, 0, "sweep"), at_s=1e6)
    assert isinstance(scenario.trajectory, SweepStrokes)
    run, constants = run_scenario(config, joint, scenario)
    assert constants[0].command_kind == CommandKind.VELOCITY
    assert run.state.phase == AxisPhase.FINISHED
    shares = {round(s, 3) for s in run.log.desired_velocity_radps[run.tracking] / config.limits.velocity_max_radps}
    assert {round(share, 3) for share in scenario.trajectory.shares} <= shares
    assert np.ptp(run.log.command_velocity_radps) > 0.0
    assert judge(config, joint, scenario).violations == ()


def test_the_fault_of_a_sweep_begins_before_its_end(sweep: tuple[Config, LockstepJoint]) -> None:
    """Seed 915311, scenario 1949: a push in the last 5 ms of the watch, long after the run; not at rest in the end."""
    for number in (1949, *range(20)):
        drawn = draw_scenario(915311, number, "sweep")
        assert isinstance(drawn.trajectory, SweepStrokes)
        seen = in_time(*sweep, drawn)
        assert seen == dataclasses.replace(drawn, at_s=seen.at_s)
        placed = placed_sweep(*sweep, drawn.trajectory, 0.0)
        assert 0.0 <= seen.at_s / drawn.at_s == pytest.approx((BEFORE_s + placed.duration_s) / (BEFORE_s + LONGEST_s))
        assert seen.at_s <= BEFORE_s + placed.duration_s
    assert judge(*sweep, draw_scenario(915311, 1949, "sweep")).violations == ()
    run = draw_scenario(915311, 1949)
    assert in_time(*sweep, run) == run


def test_without_a_velocity_mode_the_law_of_a_sweep_closes_the_loop() -> None:
    config, joint = campaign_joint(load_config(CONFIGS / "virtual.toml"), "run")
    placed = placed_sweep(config, joint, SweepStrokes((0.1, -0.1), 0.1), 0.05)
    assert placed.constants[0].command_kind == CommandKind.TORQUE
    assert placed.constants[0].law.observer.bandwidth_radps > 0.0
    assert placed.start_rad == pytest.approx(0.05)


def test_workers_sweep_as_well(sweep: tuple[Config, LockstepJoint]) -> None:
    campaign = Campaign(load_config(CONFIGS / "sweep_virtual.toml"), 9, "sweep")
    found, _, _ = run_campaign(campaign, 20, lambda _: None, Workers(2))
    alone = [judge(*sweep, draw_scenario(9, number, "sweep")) for number in range(20)]
    assert [dataclasses.astuple(v)[:8] for v in found] == [dataclasses.astuple(v)[:8] for v in alone]


def test_the_command_that_replays_a_violation_names_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judge_module, "_motion", lambda run, allowed: ["made up"])
    err = StringIO()
    shown = Output(json=True, stdout=StringIO(), stderr=err)
    config = load_config(CONFIGS / "sweep_virtual.toml")
    assert (
        fault_campaign(config, shown, drawn=Drawn(count=1, seed=5), folder=tmp_path, workers=Workers(1), during="sweep")
        == 10
    )
    assert "sweep_virtual.toml --sweep --seed 5 --scenario 0" in err.getvalue()
    assert fault_campaign(config, shown, drawn=Drawn(seed=5, scenario=0), during="sweep") == 10


# --- during a tune ---
@pytest.fixture(scope="module")
def tuned() -> tuple[Config, LockstepJoint]:
    return campaign_joint(load_config(CONFIGS / "precise.toml"), "tune")


def test_no_scenario_violates_an_invariant_in_the_steps_of_a_tune(tuned: tuple[Config, LockstepJoint]) -> None:
    drawn = [draw_scenario(880603, number, "tune") for number in range(2 * KINDS)]
    steps = {one.trajectory.name if isinstance(one.trajectory, TuneStep) else "verification" for one in drawn}
    assert steps == set(STEPS_THAT_MOVE)
    found = [judge(*tuned, one, placed_step) for one in drawn]
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert sum(v.fault != "NONE" for v in found) > len(found) // 4


def test_no_scenario_violates_an_invariant_in_the_steps_of_a_soft_joint() -> None:
    """Two encoders; scenario 24 of seed 880612 also with a quick stop along 6085 that is slower than friction alone."""
    soft = campaign_joint(load_config(CONFIGS / "realistic.toml"), "tune")
    drawn = [draw_scenario(880611, number, "tune") for number in range(KINDS)]
    found = [judge(*soft, one, placed_step) for one in (*drawn, draw_scenario(880612, 24, "tune"))]
    assert [(v.number, v.kind, v.violations) for v in found if v.violations] == []
    assert {v.fault for v in found} >= {"POSITION_DISAGREEMENT", "VELOCITY_LIMIT"}
    assert soft[1].quick_stop_radps2 == pytest.approx(11.98, abs=0.01)
    soft[1]._virtual.device[0].drive.quick_stop_deceleration = 1_000_000  # counts of the motor: 0.8 rad/s2
    slow = judge(*soft, draw_scenario(880612, 24, "tune"), placed_step)
    assert (soft[1].quick_stop_radps2 < 0.8, slow.violations) == (True, ())
    assert slow.off_s is not None
    assert found[-1].off_s is not None
    assert slow.off_s > found[-1].off_s


def test_behind_a_stuck_encoder_no_step_of_a_tune_runs_away(tuned: tuple[Config, LockstepJoint]) -> None:
    """Scenario 206 of seed 880603 went 3.3 rad/s while nothing knew the torque that moves the joint."""
    verdict = judge(*tuned, draw_scenario(880603, 206, "tune"), placed_step)
    assert verdict.fault == "POSITION_FROZEN"
    assert verdict.violations == ()
    assert verdict.peak_radps < 1.0


def test_a_step_that_ends_by_itself_is_no_false_alarm_of_a_twin(
    tuned: tuple[Config, LockstepJoint], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only where the same step ends in the same way without the harmless fault."""
    numbers = (n for n in range(500) if (one := draw_scenario(3, n, "tune")).harmless
               and isinstance(one.trajectory, TuneStep))  # fmt: skip
    scenario = draw_scenario(3, next(numbers), "tune")
    for fault, alone, wrong in ((Fault.LIMIT_CYCLE, Fault.LIMIT_CYCLE, 0), (Fault.LIMIT_CYCLE, Fault.NONE, 1)):
        faults = iter((fault, alone))
        real = run_scenario(*tuned, scenario, placed_step)
        monkeypatch.setattr(
            judge_module, "run_scenario",
            lambda *_, real=real, faults=faults: (dataclasses.replace(real[0], fault=next(faults)), real[1]),
        )  # fmt: skip
        found = [text for text in judge(*tuned, scenario, placed_step).violations if "harmless" in text]
        assert len(found) == wrong


@pytest.mark.parametrize(
    ("rows", "value", "words"),
    [
        (100, 1.01, "velocity command 1.010 rad/s exceeds 1"),
        (100, float("nan"), "velocity command"),
        (slice(100, 110), 0.011, "velocity command steps by 0.0110"),
        (20, 0.001, "a velocity commanded in a phase without power"),
        (slice(100, 110), 0.01, ""),
    ],
)
def test_the_invariants_of_a_velocity_command_notice(rows: Any, value: float, words: str) -> None:
    allowed = dataclasses.replace(WIDE, command_max_radps=1.0, command_step_radps=0.01)
    run = good_run()
    run.log.command_velocity_radps[rows] = value
    lines = judge_module._commands(run, allowed)
    assert any(words in line for line in lines) if words else lines == []


# --- the envelope and what it takes for granted ---
def test_a_load_pushes_before_the_reaction_and_is_held_by_less_friction_after_it(virtual_config: Config) -> None:
    joint = LockstepJoint(virtual_config)
    allowed = envelope(shipped(virtual__gravity_Nm=6.0), REVERSED, joint.constants()[0])
    speed = 1.0 + (60.5 + 6.0) / 2.0 * 0.01
    brake = (121.0 * 0.1063 * 0.95 - 6.0) / 2.0
    assert allowed.velocity_max_radps == pytest.approx(speed)
    assert allowed.stop_s == pytest.approx(0.01 + speed / brake + 1.0)
    assert allowed.command_max_radps == 1.0


@pytest.mark.parametrize(
    ("rate_Hz", "cutoff_Hz", "measuring_s"),
    [(1000.0, 100.0, 0.010), (2000.0, 0.0, 0.010), (250.0, 100.0, 0.008 + 0.00477 + 0.0013),
     (1000.0, 20.0, 0.002 + 0.02387 + 0.0013)],
)  # fmt: skip
def test_a_slow_loop_or_filter_reacts_later(rate_Hz: float, cutoff_Hz: float, measuring_s: float) -> None:
    config = shipped(loop__rate_Hz=rate_Hz, control__velocity_cutoff_Hz=cutoff_Hz)
    assert reaction_s(config, [REVERSED]) == pytest.approx(measuring_s, abs=1e-5)


@pytest.mark.parametrize(
    ("rate_Hz", "cutoff_Hz", "one"),
    [(1000.0, 100.0, False), (2000.0, 200.0, False), (1000.0, 101.0, True), (500.0, 100.0, True), (1000.0, 0.0, True)],
)
def test_where_the_velocity_filter_passes_more_a_harmless_reordering_is_one_swap(
    rate_Hz: float, cutoff_Hz: float, one: bool
) -> None:
    """`precise`, seed 13, scenario 12: two swaps within three cycles read as 1.01 rad/s, at a true 0.59 rad/s."""
    config = shipped(loop__rate_Hz=rate_Hz, control__velocity_cutoff_Hz=cutoff_Hz)
    twin = draw_scenario(13, 12)
    assert (twin.kind, twin.harmless) == (FaultKind.TPDO_REORDERED, True)
    seen = fitted(config, twin)
    assert (seen == twin) is not one
    assert not one or (seen.duration_s, seen.magnitude) == (1.5 / rate_Hz, 1.0)
    for other in (dataclasses.replace(twin, harmless=False), draw_scenario(13, 10)):
        assert fitted(config, other) == other


def test_there_a_reading_that_stands_still_for_one_sample_is_harmless() -> None:
    """`precise`, seed 20261125, scenario 299: two of them read as 1.26 rad/s afterwards, at a true 0.6 rad/s."""
    config, joint = campaign_joint(load_config(CONFIGS / "precise.toml"), "run")
    twin = draw_scenario(20261125, 299)
    assert (twin.kind, twin.harmless) == (FaultKind.ENCODER_STUCK, True)
    assert fitted(config, twin).duration_s == 0.5e-3
    assert judge(config, joint, twin).violations == ()
    assert fitted(shipped(), twin) == twin


def test_a_slow_quick_stop_of_the_drive_brakes_less_than_friction(virtual_config: Config) -> None:
    joint = LockstepJoint(virtual_config)
    plain = envelope(virtual_config, REVERSED, joint.constants()[0])
    assert envelope(virtual_config, REVERSED, joint.constants()[0], joint.quick_stop_radps2) == plain  # 12 rad/s2
    slow = envelope(virtual_config, REVERSED, joint.constants()[0], 0.8)
    speed = plain.velocity_max_radps
    assert slow.stop_s == pytest.approx(0.01 + speed / 0.8 + 1.0)
    assert slow.position_max_rad - virtual_config.limits.position_max_rad > speed**2 / 1.6


def test_a_drift_beside_another_encoder_is_harmless_within_what_they_may_differ_by() -> None:
    twin = dataclasses.replace(draw_scenario(880611, 53, "tune"), duration_s=0.97, magnitude=-0.007)
    assert (twin.kind, twin.harmless) == (FaultKind.ENCODER_DRIFT, True)
    both = load_config(CONFIGS / "realistic.toml")
    assert fitted(both, twin).duration_s == pytest.approx(0.5 * both.joint_encoder.disagreement_max_rad / 0.007)
    for config, other in ((shipped(), twin), (both, dataclasses.replace(twin, harmless=False))):
        assert fitted(config, other) == other


@pytest.mark.parametrize(("load_Nm", "fits"), [(9.59, True), (9.6, False)])
def test_a_load_that_friction_does_not_hold_has_no_envelope(load_Nm: float, fits: bool) -> None:
    """0.9 x 121 x 0.1063 Nm x 0.95 - 1.4 Nm of ripple."""
    if fits:
        require_fit(shipped(virtual__gravity_Nm=load_Nm))
        return
    with pytest.raises(ConfigurationError, match=r"\[virtual\] \(=9\.6 Nm\) must be less than 9\.60 Nm.* a brake"):
        require_fit(shipped(virtual__gravity_Nm=load_Nm))


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("limits", "position_max_rad", 0.69), ("limits", "position_min_rad", -0.69),
        ("limits", "velocity_max_radps", 0.99), ("limits", "sample_age_max_s", 0.049),
        ("limits", "skipped_max_s", 0.049), ("sequence", "supervisor_timeout_s", 0.9), ("drive", "heartbeat_s", 0.19),
    ],
)  # fmt: skip
def test_tighter_limits_than_the_harmless_faults_are_made_for_are_refused(
    virtual_config: Config, section: str, key: str, value: float
) -> None:
    require_fit(virtual_config)
    with pytest.raises(ConfigurationError, match=rf"{section}\.{key} \(=.*\) must be at least"):
        require_fit(shipped(**{f"{section}__{key}": value}))


def test_without_any_friction_there_is_no_campaign() -> None:
    with pytest.raises(ConfigurationError, match=r"\[friction\] is missing, and so is \[virtual\.friction\]"):
        require_fit(shipped(friction=None))
    with pytest.raises(ConfigurationError, match=r"\[virtual\] is missing"):
        require_fit(shipped(virtual=None))
