"""Outliers, folds, selection of a model, intervals and profile on synthetic data of Table 3."""

import numpy as np
import pytest

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.fit import choose, find_outliers, fold_numbers, held_out_rss, make_problem, project
from jointctl.tools.identification.models import FORMS
from jointctl.tools.identification.uncertainty import uncertainty
from tests.unit.identification.synthetic_friction import DENSE_radps, NOISE_Nm, UNIFORM_radps, paper_data


def one_direction(seed, form="multi-stage", velocity_radps=UNIFORM_radps, **settings):
    data = paper_data(seed, velocity_radps, **settings)
    chosen = data.direction(1)
    return make_problem(FORMS[form], data.velocity_radps[chosen], data.motor_torque_Nm[chosen], 40.0 * DEGREE,
                        (None, 20.0 * DEGREE))  # fmt: skip


def moved(problem, at, by_Nm):
    y = problem.y_Nm.copy()
    y[at] += by_Nm
    return make_problem(problem.form, problem.x * problem.top_radps, y, problem.knee * problem.top_radps,
                        (None, 20.0 * DEGREE))  # fmt: skip


@pytest.mark.parametrize("at", [5, 21, 22, 60, 110])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_point_ten_deviations_off_is_found_and_no_other(at, sign):
    out, score = find_outliers(moved(one_direction(1), at, sign * 10.0 * NOISE_Nm), 5.0)
    assert np.flatnonzero(out).tolist() == [at]
    assert abs(score[at]) > 5.0


def test_outliers_do_not_hide_each_other_and_clean_data_have_none():
    out, _ = find_outliers(moved(one_direction(2), [30, 31, 32, 70, 90], 0.1), 5.0)
    assert np.flatnonzero(out).tolist() == [30, 31, 32, 70, 90]
    assert sum(find_outliers(one_direction(seed), 5.0)[0].sum() for seed in range(20)) <= 1
    assert not find_outliers(one_direction(0, noise_Nm=0.0), 5.0)[0].any()


def test_the_outlier_test_can_be_switched_off():
    assert not find_outliers(moved(one_direction(1), 60, 1.0), 0.0)[0].any()


def test_folds_are_seeded_balanced_and_keep_repeats_together():
    problem = make_problem(FORMS["stribeck"], np.repeat(np.arange(1.0, 31.0), 2), np.ones(60), 10.0, (None, 1.0))
    number = fold_numbers(problem, 5, seed=3)
    assert np.array_equal(number[::2], number[1::2])
    assert np.bincount(number).tolist() == [12] * 5
    assert np.array_equal(number, fold_numbers(problem, 5, seed=3))
    assert not np.array_equal(number, fold_numbers(problem, 5, seed=4))


def test_held_out_error_is_larger_than_the_fitted_one_and_near_the_noise():
    problem = one_direction(0)
    held_out = np.sqrt(held_out_rss(problem, 10, 1) / len(problem.x))
    assert project(problem).rmse_Nm < held_out < 1.25 * NOISE_Nm


def test_among_equals_the_model_with_fewer_parameters_is_chosen():
    assert choose({"multi-stage": 1.0, "multi-stage-continuous": 1.005, "stribeck": 1.02}) == "multi-stage-continuous"
    assert choose({"multi-stage": 1.0, "multi-stage-continuous": 1.011, "stribeck": 4.0}) == "multi-stage"


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    inside = {"tc": 0, "tv": 0, "a1": 0, "a3": 0}
    truth = {"tc": 0.11985, "tv": 0.0026518 / DEGREE, "a1": 0.0012298 / DEGREE, "a3": -7.6969e-9 / DEGREE**3}
    for seed in range(60):
        found = uncertainty(project(one_direction(seed, velocity_radps=DENSE_radps))).intervals
        for name in inside:
            inside[name] += found[name].low <= truth[name] <= found[name].high
    # 57 expected, standard deviation 1.7
    assert all(count >= 51 for count in inside.values()), inside


def test_the_band_covers_the_true_curve_about_as_often_as_it_says():
    covered = []
    for seed in range(40):
        problem = one_direction(seed)
        fit = project(problem)
        half = uncertainty(fit).band_Nm(fit, problem.x)
        truth = friction_curve_Nm(paper_friction(), problem.x * problem.top_radps)
        covered.append(np.mean(np.abs(fit.torque_Nm(problem.x) - truth) <= half))
    assert 0.88 < np.mean(covered) < 0.985


def test_the_profile_says_that_a_uniform_grid_does_not_determine_ws_and_a_dense_one_does():
    weak = [uncertainty(project(one_direction(seed))).intervals["ws"].weak for seed in range(8)]
    assert sum(bool(w) for w in weak) >= 7
    dense = [uncertainty(project(one_direction(seed, velocity_radps=DENSE_radps, noise_Nm=0.001))) for seed in range(8)]
    intervals = [u.intervals["ws"] for u in dense]
    assert not any(i.weak for i in intervals)
    assert sum(i.low <= 1.2301 * DEGREE <= i.high for i in intervals) >= 6


def test_no_stribeck_effect_is_told_and_not_made_up():
    u = np.linspace(0.05, 3.0, 80)
    y = 0.1 + 0.02 * u - 0.02 * np.exp(-u / 0.3)
    found = uncertainty(project(make_problem(FORMS["stribeck"], u, y, 1.0, (None, 0.5)))).intervals
    assert found["ts"].value == pytest.approx(found["tc"].value, rel=1e-6)
    assert found["ts"].weak == "no Stribeck effect found (ts = tc)"
    assert found["ws"].weak
