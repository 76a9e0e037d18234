"""The whole identification on synthetic data: what comes out, what is told, and whether it is plausible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.fit import make_problem, project
from jointctl.tools.identification.identification import Options, identify_friction
from jointctl.tools.identification.identification_report import left_out_text
from jointctl.tools.identification.models import FORMS, MIN_PER_STAGE
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.plausibility import JointLimits, check_branches, check_data
from jointctl.tools.identification.swarm import SwarmSettings
from tests.unit.identification.synthetic_friction import LIMITS, QUICK, DENSE_radps, NOISE_Nm, UNIFORM_radps, paper_data


# --- The whole identification on synthetic data of Table 3: what comes out, what is told, which options it takes ---
@pytest.mark.parametrize("velocity_radps", [UNIFORM_radps, DENSE_radps])
def test_identification_of_paper_data(velocity_radps):
    found = identify_friction(paper_data(1, velocity_radps), QUICK, limits=LIMITS)
    assert found.rmse_Nm <= 1.01 * found.projected_rmse_Nm
    assert found.rmse_Nm == pytest.approx(NOISE_Nm, rel=0.12)
    held_out = found.held_out_by_model_Nm
    assert found.rmse_Nm < held_out["multi-stage"] < held_out["stribeck"]
    assert held_out["coulomb-viscous"] < held_out["coulomb"]
    # the identified curve against the truth, 2 % of its maximum, over the measured range
    for word, sign in (("positive", 1.0), ("negative", -1.0)):
        u = np.linspace(2.0, 200.0, 300) * DEGREE
        truth = sign * friction_curve_Nm(paper_friction(), sign * u)
        assert np.max(np.abs(found.branches[word].torque_Nm(u) - truth)) < 0.02 * np.max(truth) + 0.5 * NOISE_Nm
    result = found.to_dict()
    assert result["data_sha256"] == "0" * 64
    assert result["swarm"]["seed"] == 1
    assert result["directions"]["negative"]["parameters"]["tc"]["value"] > 0.0
    assert set(result["models"]) == set(FORMS)
    assert result["points"] == len(velocity_radps[velocity_radps != 0.0])


def test_outliers_are_named_with_their_line_and_do_not_move_the_result():
    data = paper_data(3)
    data.motor_torque_Nm[[20, 180]] += 0.08
    found = identify_friction(data, QUICK)
    clean = identify_friction(paper_data(3), QUICK)
    assert [n for n in found.notes if n.startswith(("line 22: outlier", "line 182: outlier"))] == list(found.notes)
    assert len(found.notes) == 2
    assert found.to_dict()["directions"]["negative"]["outlier_lines"] == [22]
    assert found.rmse_Nm == pytest.approx(clean.rmse_Nm, rel=0.02)
    kept = identify_friction(data, Options(swarm=QUICK.swarm, outlier_threshold=0.0))
    assert kept.rmse_Nm > 1.5 * found.rmse_Nm


def test_what_was_left_out_is_reported_with_its_share_of_the_error():
    data = paper_data(3)
    data.motor_torque_Nm[[20, 180]] += 0.08
    data.settled[100] = False
    found = identify_friction(data, QUICK)
    out = found.to_dict()["left_out"]
    assert (out["outliers"], out["unsettled"]) == (2, 1)
    squared = found.rmse_Nm**2 * found.to_dict()["points"]
    assert out["rmse_with_Nm"] ** 2 * (found.to_dict()["points"] + 3) * (1.0 - out["error_share"]) == pytest.approx(
        squared
    )
    assert out["error_share"] == pytest.approx(2 * 0.08**2 / (squared + 2 * 0.08**2), rel=0.1)
    assert "2 outliers, 1 not settled" in left_out_text(found)
    assert left_out_text(identify_friction(paper_data(3), QUICK)) == "no measured point was left out"


def test_a_joint_slower_than_the_knee_gets_a_model_without_being_asked():
    speeds = np.geomspace(0.2, 25.0, 60) * DEGREE
    found = identify_friction(paper_data(1, np.concatenate([-speeds[::-1], speeds]), noise_Nm=0.001), QUICK)
    assert found.model == "stribeck"
    assert any("too few for the multi-stage model" in note for note in found.notes)


def test_the_greatest_static_friction_that_is_allowed_counts_for_whatever_model_is_chosen():
    data = paper_data(1)
    speed_radps = np.abs(data.velocity_radps)
    torque_Nm = 0.1 + 0.06 * np.exp(-((speed_radps / (3.0 * DEGREE)) ** 2)) + 0.02 * speed_radps
    torque_Nm += np.random.default_rng(1).normal(scale=1e-3, size=len(torque_Nm))
    data = replace(data, motor_torque_Nm=torque_Nm * np.sign(data.velocity_radps))
    found = identify_friction(data, replace(QUICK, static_max_Nm=0.155))
    assert found.model == "stribeck"  # and not the first one that was tried
    assert found.branches["positive"].static_Nm <= 0.155 * (1.0 + 1e-9)
    assert identify_friction(data, QUICK).branches["positive"].static_Nm > 0.157  # the twin


@pytest.mark.parametrize(("share", "warned"), [(0.12, False), (0.26, True)])
def test_too_many_outliers_are_no_outliers_and_it_is_told(share, warned):
    data = paper_data(0, noise_Nm=0.001)
    rng = np.random.default_rng(0)
    chosen = rng.random(len(data.line)) < share
    data.motor_torque_Nm[chosen] += rng.choice([-0.03, 0.03], np.count_nonzero(chosen))
    found = identify_friction(data, QUICK)
    used = sum(len(d.index) for d in found.directions.values())
    assert any("none was left out" in w for w in found.warnings) is warned
    assert used == (len(data.line) if warned else len(data.line) - np.count_nonzero(chosen))


@pytest.mark.parametrize(("noise_Nm", "warned"), [(0.02, False), (0.06, True)])
def test_a_bad_fit_is_told(noise_Nm, warned):
    found = identify_friction(paper_data(0, noise_Nm=noise_Nm), QUICK)
    assert any("badly" in w for w in found.warnings) is warned


@pytest.mark.parametrize("bends", [False, True])
@pytest.mark.parametrize("model", ["auto", "coulomb-viscous"])
def test_friction_of_another_form_than_the_model_is_told(bends, model):
    u = np.concatenate([np.geomspace(0.005, 0.2, 20), np.linspace(0.25, 3.0, 20)])
    friction_Nm = 0.08 + 0.05 * np.sqrt(u) if bends else 0.1 + 0.03 * u
    noise_Nm = np.random.default_rng(4).normal(0.0, 0.0007, (2, len(u)))
    data = replace(
        paper_data(0, np.concatenate([-u[::-1], u])),
        motor_torque_Nm=np.concatenate([-(friction_Nm + noise_Nm[0])[::-1], friction_Nm + noise_Nm[1]]),
    )
    found = identify_friction(data, Options(model=model, swarm=QUICK.swarm))
    assert any("go with the speed" in warning for warning in found.warnings) is bends


def test_the_same_seed_gives_the_same_result():
    first, second = (identify_friction(paper_data(2), QUICK).to_dict() for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    ("options", "model"),
    [
        (Options(model="stribeck", swarm=QUICK.swarm), "stribeck"),
        (Options(model="coulomb-viscous"), "coulomb-viscous"),
        (Options(continuous=True, swarm=QUICK.swarm), "multi-stage-continuous"),
    ],
)
def test_other_models_can_be_asked_for(options, model):
    found = identify_friction(paper_data(0), options)
    assert found.model == model
    simple = model != "multi-stage-continuous"
    assert found.rmse_Nm == pytest.approx(0.0170 if simple else 0.0044, rel=0.08)
    # a simple model was asked for, so nothing better is on the table to be warned about
    assert ("multi-stage" in found.rmse_by_model_Nm) is not simple


def test_auto_takes_a_simple_model_for_simple_friction_and_a_multi_stage_one_for_the_papers():
    simple = paper_data(0)
    noise = np.random.default_rng(1).normal(0.0, NOISE_Nm, len(simple.line))
    simple.motor_torque_Nm[:] = np.sign(simple.velocity_radps) * 0.1 + 0.05 * simple.velocity_radps + noise
    auto = Options(model="auto", swarm=QUICK.swarm)
    assert identify_friction(simple, auto).model == "coulomb-viscous"
    assert identify_friction(paper_data(0), auto).model.startswith("multi-stage")


@pytest.mark.parametrize(("beyond", "left_out"), [(MIN_PER_STAGE - 1, True), (MIN_PER_STAGE, False)])
def test_auto_leaves_out_a_model_that_the_data_do_not_reach(beyond, left_out):
    """A serial drive's quick grid hardly passes the knee: the user had to name another model."""
    speeds = np.concatenate([np.linspace(2.0, 39.0, 30), np.linspace(41.0, 52.0, beyond)]) * DEGREE
    data = paper_data(0, np.concatenate([-speeds[::-1], speeds]))
    found = identify_friction(data, Options(model="auto", folds=4, swarm=QUICK.swarm))
    assert [f"{beyond} beyond, too few" in note for note in found.notes] == ([True] if left_out else [])
    assert ("multi-stage" in found.held_out_by_model_Nm) is not left_out


@pytest.mark.parametrize("bends", [True, False])
def test_few_points_beyond_the_knee_neither_bend_the_curve_nor_count_as_noise(bends):
    """A quick sweep of a joint up to 52 deg/s: Coulomb and viscous friction were off by several intervals."""
    speeds = np.concatenate([np.linspace(0.3, 39.0, 24), [43.0, 47.0, 52.0]]) * DEGREE
    data = paper_data(0, np.concatenate([-speeds[::-1], speeds]))
    u, sign = np.abs(data.velocity_radps) / DEGREE, np.sign(data.velocity_radps)
    straight = np.where(
        sign > 0.0,
        0.11985 + (0.14537 - 0.11985) * np.exp(-u / 1.2301) + 0.0026518 * u,
        0.1063 + (0.1575 - 0.1063) * np.exp(-u / 2.887) + 0.002475 * u,
    )
    truth = friction_curve_Nm(paper_friction(), data.velocity_radps) if bends else sign * straight
    data.motor_torque_Nm[:] = truth + 2e-4 * np.random.default_rng(5).standard_normal(len(u))
    found = identify_friction(data, Options(model="auto", folds=4, swarm=QUICK.swarm))
    assert ["beyond the knee" in warning for warning in found.warnings] == [True, True] * bends
    assert found.noise_exponent == 0.0
    for direction, tc_Nm, tv in (("positive", 0.11985, 0.0026518), ("negative", 0.1063, 0.002475)):
        branch = found.branches[direction]
        assert (branch.coulomb_Nm, branch.viscous_Nmspr) == pytest.approx((tc_Nm, tv / DEGREE), rel=0.01)
        assert branch.max_radps == pytest.approx((39.0 if bends else 52.0) * DEGREE)
        assert len(found.directions[direction].outliers) == 3 * bends


def test_outliers_beyond_the_knee_leave_out_the_multi_stage_model_and_end_nothing():
    """A direct drive under gravity: a tune of seven minutes ended, and the hint was the model that it had chosen."""
    speeds = np.concatenate([np.linspace(0.3, 39.0, 24), [43.0, 47.0, 52.0, 56.0, 60.0]]) * DEGREE
    data = paper_data(0, np.concatenate([-speeds[::-1], speeds]))
    data.motor_torque_Nm[-3] += 0.1
    found = identify_friction(data, Options(model="auto", folds=4, swarm=QUICK.swarm))
    assert any("24 points up to it and 2 beyond, too few for the multi-stage model without" in n for n in found.notes)
    assert found.model == "stribeck"
    with pytest.raises(DataError, match="24 points up to it and 2 beyond; at least 5 are needed on both sides"):
        identify_friction(data, Options(model="multi-stage", folds=4, swarm=QUICK.swarm))


def test_a_searched_knee_is_told_and_not_worse():
    searched = identify_friction(paper_data(0), Options(folds=4, search_knee=True, swarm=SwarmSettings(400, 400)))
    assert searched.rmse_Nm <= identify_friction(paper_data(0), QUICK).rmse_Nm * (1.0 + 1e-6)


@pytest.mark.parametrize(("knee_degps", "fits"), [(8.0, False), (10.0, True), (190.0, True), (193.0, False)])
def test_a_knee_with_too_few_points_on_one_side_is_refused(knee_degps, fits):
    options = Options(model="multi-stage", knee_radps=knee_degps * DEGREE, swarm=QUICK.swarm)
    if fits:
        assert identify_friction(paper_data(0), options).rmse_Nm < 0.03
        return
    with pytest.raises(DataError, match="at least 5 are needed on both sides"):
        identify_friction(paper_data(0), options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "cubic"}, r"--model \(=cubic\) must be one of"),
        ({"folds": 1}, r"--folds \(=1\) must be in \[2..100\]"),
        ({"swarm": SwarmSettings(particles=1)}, r"--particles \(=1\)"),
        ({"swarm": SwarmSettings(iterations=0)}, r"--iterations \(=0\)"),
        ({"swarm": SwarmSettings(inertia=float("nan"))}, r"--inertia \(=nan\)"),
        ({"swarm": SwarmSettings(seed=-1)}, r"--seed \(=-1\)"),
        ({"ws_min_radps": 30 * DEGREE}, r"--ws-min \(=30 deg/s\) must be in \(0..20\) deg/s"),
        ({"ws_max_radps": 0.0}, r"--ws-max \(=0 deg/s\) must be in"),
        ({"knee_radps": float("nan")}, r"--knee \(=nan deg/s\) must be in \[0.0001..60000\] deg/s"),
        ({"knee_radps": 7e4 * DEGREE}, r"--knee \(=70000 deg/s\) must be in"),
        ({"static_max_Nm": 0.0}, r"--static-max \(=0 Nm\) must be in \(0..1000\]"),
        ({"static_max_Nm": -1.0}, r"--static-max \(=-1 Nm\) must be in"),
        ({"static_max_Nm": float("nan")}, r"--static-max \(=nan Nm\) must be in"),
        # those that nothing would look at
        ({"model": "stribeck", "search_knee": True}, "--search-knee does not apply to --model stribeck"),
        ({"model": "stribeck", "knee_radps": 1.0}, "--knee does not apply to --model stribeck"),
        ({"model": "coulomb-viscous", "ws_max_radps": 0.1}, "--ws-max does not apply to --model coulomb-viscous"),
        ({"model": "coulomb-viscous", "static_max_Nm": 0.1}, "--static-max does not apply to --model"),
        ({"motion": MotionSettings(band_Hz=10.0)}, "--band does not apply to .*, which holds plateaus"),
        ({"motion": MotionSettings(mean_samples=3)}, "--mean-samples does not apply to .*, which holds plateaus"),
    ],
)
def test_options_out_of_range_or_without_a_use_are_refused(change, message):
    with pytest.raises(UsageError, match=message):
        identify_friction(paper_data(0), Options(**{"swarm": QUICK.swarm, **change}))


@pytest.mark.parametrize("change", [{"static_max_Nm": 0.2}, {"static_max_Nm": 1e3}, {"ws_min_radps": 19.9 * DEGREE}])
def test_options_at_the_edge_of_their_range_are_taken(change):
    assert identify_friction(paper_data(0), replace(QUICK, **change)).rmse_Nm < 0.1


def test_friction_without_speed_and_noise_is_compared_with_rounding_by_nobody():
    data = paper_data(0)
    data = replace(data, motor_torque_Nm=0.1 * np.sign(data.velocity_radps))
    found = identify_friction(data, QUICK)
    assert found.rmse_Nm < 1e-6
    assert not [w for w in found.warnings if "held-out" in w or "the least RMSE" in w]


def test_friction_of_next_to_nothing_has_no_relative_error():
    data = paper_data(0)
    data = replace(data, motor_torque_Nm=1e-13 / np.max(np.abs(data.motor_torque_Nm)) * data.motor_torque_Nm)
    result = identify_friction(data, QUICK).to_dict()
    assert (result["relative_rmse"], result["relative_max_error"]) == (None, None)


# --- Plausibility of an identified friction: constants, units, sides and signs that are wrong on purpose ---
def test_one_point_far_off_on_the_wrong_side_is_told_as_such():
    data = paper_data(0)
    torque = data.motor_torque_Nm.copy()
    torque[0] = 1e300
    problems = check_data(replace(data, motor_torque_Nm=torque), None).problems
    assert "mean torque at negative velocity drives the motion" in problems[0]
    assert not any("a factor of" in problem for problem in problems)


def test_right_data_raise_nothing():
    verdict = check_data(paper_data(0), LIMITS)
    assert verdict.problems == []
    assert verdict.warnings == []


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"torque_factor": -1.0}, "torque does not oppose the motion at positive velocity: right sign at 0%"),
        ({"speed_factor": -1.0}, "torque does not oppose the motion"),
        ({"offset_Nm": 0.4}, "does not oppose the motion at negative velocity"),
        ({"torque_factor": 121.0}, "times limits.torque_max_Nm"),  # joint torque taken for motor torque
        ({"torque_factor": 10.0}, r"6\.9\d times limits.torque_max_Nm"),  # torque constant ten times too large
        ({"speed_factor": 180.0 / np.pi}, "times limits.velocity_max_radps"),  # deg/s taken for rad/s
        ({"speed_factor": 121.0}, "times limits.velocity_max_radps"),  # motor speed taken for joint speed
        ({"ratio": 100.0}, r"reduction ratio of the data \(=100\) differs from joint.reduction_ratio \(=121\)"),
    ],
)
def test_what_is_wrong_on_purpose_is_refused(wrong, message):
    with pytest.raises(DataError, match=message):
        identify_friction(paper_data(0, **wrong), QUICK, limits=LIMITS)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"torque_factor": 1.0 / 121.0}, "times limits.torque_max_Nm"),  # motor torque divided by the ratio again
        ({"speed_factor": 1.0 / 121.0}, "or a unit or a side is wrong"),  # joint speed divided by the ratio again
        ({"speed_factor": np.pi / 180.0}, "or a unit or a side is wrong"),
        ({"offset_Nm": 0.14}, "a load"),
        ({"torque_factor": 1.3}, "times limits.torque_max_Nm"),
    ],
)
def test_what_may_be_wrong_is_warned_about(wrong, message):
    verdict = check_data(paper_data(0, **wrong), LIMITS)
    assert verdict.problems == []
    assert any(message in warning for warning in verdict.warnings)


@pytest.mark.parametrize(("constant", "refused"), [(0.1, False), (0.10009, False), (0.10011, True), (0.1414, True)])
def test_another_torque_constant_than_configured_is_refused(constant, refused):
    limits = JointLimits(60.0, 3.5, 121.0, constant)
    assert bool(check_data(paper_data(0), limits).problems) is refused


@pytest.mark.parametrize(("share", "refused"), [(1.19, False), (1.21, True)])
def test_friction_above_what_the_joint_can_drive_is_refused_at_the_limit(share, refused):
    data = paper_data(0)
    reach_Nm = 121.0 * np.percentile(np.abs(data.motor_torque_Nm), 95)
    limits = JointLimits(reach_Nm / share, 3.5, 121.0, 0.1)
    assert bool(check_data(data, limits).problems) is refused


def test_negative_viscous_friction_and_a_falling_end_are_told_with_their_numbers():
    u = np.linspace(0.05, 3.0, 80)
    found = project(make_problem(FORMS["coulomb-viscous"], u, 0.2 - 0.03 * u, 1.0, (None, 0.5))).branch()
    verdict = check_branches({"positive": found})
    assert any("tv = -0.03" in w for w in verdict.warnings)
    assert any("falls with speed" in w for w in verdict.warnings)
    steep = project(make_problem(FORMS["coulomb-viscous"], u, 0.2 - 0.08 * u, 1.0, (None, 0.5))).branch()
    assert "drives the motion" in check_branches({"positive": steep}).problems[0]
