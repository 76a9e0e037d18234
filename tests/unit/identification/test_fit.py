"""Models, variable projection, particle swarm, polish, outliers, folds and intervals, on data of Table 3."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.fit import (
    beta_from_vector,
    choose,
    find_outliers,
    fold_numbers,
    held_out_rss,
    knee_candidates,
    make_problem,
    noise_exponent,
    noise_of,
    polish,
    project,
    solve_linear,
    uncertainty,
    vector_limits,
    with_noise,
)
from jointctl.tools.identification.models import FORMS, Regression, basis
from jointctl.tools.identification.swarm import (
    CHUNK,
    Samples,
    SwarmSettings,
    fill_uniform,
    run_swarm,
    run_swarms,
    squared_error,
    stage_table,
    stream_seed,
    suffix_sums,
)
from tests.unit.identification.synthetic_friction import DENSE_radps, NOISE_Nm, UNIFORM_radps, paper_data

# --- Models, variable projection, particle swarm, polish: on data of Table 3 they reach what can be reached ---
VELOCITY_radps = np.linspace(-200.0, 200.0, 225) * DEGREE
SMALL = SwarmSettings(particles=60, iterations=150)


def paper_problems(seed, form="multi-stage", noise_Nm=NOISE_Nm, knee_degps=40.0):
    """Both directions of 225 uniform speeds on Table 3; the middle one is zero and belongs to neither."""
    noise = np.random.default_rng(seed).normal(0.0, noise_Nm, len(VELOCITY_radps))
    torque = friction_curve_Nm(paper_friction(), VELOCITY_radps) + noise
    problems = []
    for sign in (1, -1):
        chosen = sign * VELOCITY_radps > 0.0
        problems.append(
            make_problem(FORMS[form], sign * VELOCITY_radps[chosen], sign * torque[chosen], knee_degps * DEGREE,
                         (None, 20.0 * DEGREE))
        )  # fmt: skip
    return problems


def pooled_rmse_Nm(fits):
    return np.sqrt(sum(fit.rss for fit in fits) / sum(len(fit.problem.x) for fit in fits))


def truth_Nm(problem, sign):
    return sign * friction_curve_Nm(paper_friction(), sign * problem.x * problem.top_radps)


@pytest.mark.parametrize("form", list(FORMS))
def test_the_controllers_expression_gives_the_fitted_curve_for_every_model(form):
    for problem in paper_problems(3, form):
        fit = project(problem)
        curve = fit.branch().torque_Nm(problem.x * problem.top_radps)
        assert curve == pytest.approx(fit.torque_Nm(problem.x), abs=1e-12)


def test_the_continuous_model_has_no_step_at_the_knee_and_the_other_one_has():
    def step_Nm(form):
        found = project(paper_problems(1, form, noise_Nm=0.0)[0]).branch()
        below, above = found.torque_Nm(found.knee_radps * np.array([1.0 - 1e-9, 1.0 + 1e-9]))
        return abs(above - below)

    assert step_Nm("multi-stage-continuous") < 1e-8
    assert step_Nm("multi-stage") == pytest.approx(0.0017, abs=1e-4)


def test_noiseless_data_give_the_parameters_of_table_3_back():
    positive, negative = (project(p).branch() for p in paper_problems(0, noise_Nm=0.0))
    assert positive.coulomb_Nm == pytest.approx(0.11985, rel=1e-6)
    assert positive.static_Nm == pytest.approx(0.14537, rel=1e-5)
    assert positive.stribeck_radps == pytest.approx(1.2301 * DEGREE, rel=1e-4)
    assert positive.viscous_Nmspr == pytest.approx(0.0026518 / DEGREE, rel=1e-6)
    assert negative.static_Nm == pytest.approx(0.1575, rel=1e-5)
    assert negative.stribeck_radps == pytest.approx(2.887 * DEGREE, rel=1e-5)
    # mirrored: the even powers have changed their sign
    expected = np.array([0.1272, 0.0022866, -1e-5, 2.1182e-8]) / DEGREE ** np.arange(4)
    assert negative.cubic == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_least_rmse_of_the_models_on_paper_data(seed):
    rmse = {form: pooled_rmse_Nm([project(p) for p in paper_problems(seed, form)]) for form in FORMS}
    assert rmse["multi-stage"] == pytest.approx(0.004418, rel=0.08)
    assert rmse["multi-stage"] <= rmse["multi-stage-continuous"] * (1.0 + 1e-6)
    assert rmse["stribeck"] == pytest.approx(0.0170, rel=0.06)
    assert rmse["stribeck"] <= rmse["coulomb-viscous"] * (1.0 + 1e-6)
    assert rmse["coulomb"] == pytest.approx(0.062, rel=0.03)


def test_the_minimum_over_ws_is_the_least_of_a_dense_scan():
    for seed in range(3):
        for problem in paper_problems(seed):
            regression = Regression(problem.form, problem.x, problem.knee)
            dense = [solve_linear(problem, ws, regression)[1]
                     for ws in np.geomspace(problem.ws_low, problem.ws_high, 1500)]  # fmt: skip
            assert project(problem).rss <= min(dense) * (1.0 + 1e-9)


def test_limits_of_static_and_coulomb_friction_hold_and_the_face_found_is_the_best():
    rng = np.random.default_rng(5)
    touched = 0
    for _ in range(40):
        u = np.sort(rng.uniform(0.02, 3.5, 40))
        y = rng.normal(0.0, 0.1) + 0.05 * u + rng.normal(0.0, 0.05, 40)
        problem = make_problem(FORMS["stribeck"], u, y, 1.0, (0.05, 0.5), 0.12)
        beta, rss = solve_linear(problem, 0.05, Regression(problem.form, problem.x, 1.0))
        assert -1e-12 <= beta[0] <= beta[1] + 1e-12 <= 0.12 + 1e-11
        columns = basis(problem.form, problem.x, 0.05, 1.0)
        free = np.linalg.lstsq(columns, y, rcond=None)[0]
        inside = 0.0 <= free[0] <= free[1] <= 0.12
        touched += not inside
        # no allowed (tc, ts) of a grid is better
        for tc in np.linspace(0.0, 0.12, 13):
            for ts in np.linspace(tc, 0.12, 7):
                rest = y - columns[:, 0] * tc - columns[:, 1] * ts
                tv = (columns[:, 2] @ rest) / (columns[:, 2] @ columns[:, 2])
                assert rss <= np.sum((rest - tv * columns[:, 2]) ** 2) * (1.0 + 1e-9)
    assert touched > 10


@pytest.mark.parametrize("form", ["multi-stage", "multi-stage-continuous", "stribeck"])
@pytest.mark.parametrize("search_knee", [False, True])
def test_the_error_of_a_particle_is_the_sum_of_squares(form, search_knee):
    problem = paper_problems(2, form)[1]
    search_knee = search_knee and problem.form.cubic
    sums = suffix_sums(problem.x, problem.y_Nm, problem.weight, problem.knee)
    limits = vector_limits(problem)
    stage = problem.x <= problem.knee
    table = stage_table(problem.x[stage], problem.y_Nm[stage], problem.weight[stage], limits[0, 2], limits[1, 2])
    rng = np.random.default_rng(0)
    for ws_share in (0.0, *rng.uniform(0.0, 1.0, 30), 1.0):
        vector = rng.uniform(limits[0], limits[1])
        vector[2] = limits[0, 2] + ws_share * (limits[1, 2] - limits[0, 2])
        knee = float(rng.uniform(0.1, 0.8)) if search_knee else problem.knee
        beta, ws = beta_from_vector(problem, vector, knee)
        expected = np.sum((problem.y_Nm - basis(problem.form, problem.x, ws, knee) @ beta) ** 2)
        particle = np.append(vector, knee) if search_knee else vector
        split = int(np.searchsorted(problem.x, knee, side="right")) if problem.form.cubic else len(problem.x)
        samples = Samples(problem.x, problem.y_Nm, problem.weight, sums, table, problem.knee, split, problem.form.cubic,
                          problem.form.continuous, search_knee)  # fmt: skip
        found = squared_error(particle, samples)
        assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_every_seed_ends_within_one_percent_of_the_least_rmse(seed):
    problems = paper_problems(seed)
    least = pooled_rmse_Nm([project(p) for p in problems])
    swarms = run_swarms(problems, SwarmSettings(particles=200, iterations=600, seed=seed))
    polished = [polish(swarm.fit) for swarm in swarms]
    assert pooled_rmse_Nm(polished) <= 1.01 * least
    for fit, problem, sign in zip(polished, problems, (1, -1), strict=True):
        error = fit.torque_Nm(problem.x) - truth_Nm(problem, sign)
        assert np.sqrt(np.mean(error**2)) < 0.5 * NOISE_Nm
        assert np.max(np.abs(error[2:])) < 0.02 * np.max(truth_Nm(problem, sign)) + NOISE_Nm


def test_the_full_budget_reaches_the_least_rmse_even_without_polish():
    problems = paper_problems(1)
    swarms = run_swarms(problems, SwarmSettings())
    assert [len(s.curve_Nm) for s in swarms] == [5000, 5000]
    assert pooled_rmse_Nm([s.fit for s in swarms]) <= 1.01 * pooled_rmse_Nm([project(p) for p in problems])


def test_polish_improves_a_bad_start_and_never_spoils():
    for problem in paper_problems(4):
        rough = run_swarm(problem, SwarmSettings(particles=20, iterations=10)).fit
        better = polish(rough)
        assert better.rss < 0.9 * rough.rss
        assert polish(better).rss <= better.rss
        assert better.rss >= project(problem).rss * (1.0 - 1e-9)


def test_the_same_seed_gives_the_same_bits_whatever_the_threads():
    problems = paper_problems(0)
    together = run_swarms(problems, SMALL)
    alone = [run_swarm(problem, SMALL, stream=k) for k, problem in enumerate(problems)]
    for a, b in zip(together, alone, strict=True):
        assert np.array_equal(a.curve_Nm, b.curve_Nm)
        assert np.array_equal(a.fit.beta, b.fit.beta)
    other = run_swarm(problems[0], SwarmSettings(particles=60, iterations=150, seed=2))
    assert not np.array_equal(other.curve_Nm, alone[0].curve_Nm)


def test_the_random_stream_is_xorshift64():
    random, numbers = np.array([stream_seed(7, 0)]), np.empty(50)
    state = int(random[0])
    fill_uniform(random, numbers)
    for number in numbers:
        for shift in (13, -7, 17):
            state ^= (state << shift if shift > 0 else state >> -shift) & (2**64 - 1)
        assert number == (state >> 11) / 2**53
    assert int(random[0]) == state


def test_random_numbers_are_uniform_and_streams_differ():
    numbers = np.empty((2, 20000))
    for stream in range(2):
        fill_uniform(np.array([stream_seed(1, stream)]), numbers[stream])
    assert numbers.min() >= 0.0
    assert numbers.max() < 1.0
    counts = np.histogram(numbers[0], bins=20, range=(0.0, 1.0))[0]
    assert np.max(np.abs(counts - 1000)) < 150  # five standard deviations
    assert abs(np.corrcoef(numbers)[0, 1]) < 0.04


def test_the_best_error_never_grows_and_is_that_of_the_result():
    result = run_swarm(paper_problems(0)[0], SMALL)
    assert np.all(np.diff(result.curve_Nm) <= 0.0)
    assert result.fit.rmse_Nm == pytest.approx(result.curve_Nm[-1], rel=1e-9)


def test_a_stop_ends_the_swarm_within_a_chunk_and_progress_counts():
    stop, seen = threading.Event(), []

    def progress(done):
        seen.append(done)
        if done >= 2 * CHUNK:
            stop.set()

    result = run_swarm(paper_problems(0)[0], SMALL, stop=stop, progress=progress)
    assert seen == [CHUNK, 2 * CHUNK]
    assert result.iterations == len(result.curve_Nm) == 2 * CHUNK


def test_an_interruption_stops_both_threads():
    def progress(done):
        raise KeyboardInterrupt

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        run_swarms(paper_problems(0), SwarmSettings(particles=1000, iterations=1_000_000), progress=progress)
    assert threading.active_count() == before


def test_early_stop_is_an_option_and_off_by_default():
    problem = paper_problems(0, noise_Nm=0.0)[1]
    settings = SwarmSettings(particles=40, iterations=3000)
    assert run_swarm(problem, settings).iterations == 3000
    assert run_swarm(problem, SwarmSettings(particles=40, iterations=3000, stall=100)).iterations < 3000


@pytest.mark.parametrize("form", ["multi-stage", "multi-stage-continuous"])
def test_a_knee_elsewhere_is_found(form):
    # a kink of slope at 1.2 rad/s, with friction rising to it and falling behind it
    u = np.linspace(0.03, 3.0, 120)
    y = 0.1 + np.where(u <= 1.2, 0.08 * u, 0.096 - 0.05 * (u - 1.2) + 0.02 * (u - 1.2) ** 2)
    y += np.random.default_rng(1).normal(0.0, 0.001, len(u))
    problem = make_problem(FORMS[form], u, y, 0.7, (None, 0.3))
    found = project(problem, search_knee=True)
    assert found.knee * problem.top_radps == pytest.approx(1.2, abs=0.08)
    assert found.rss < 0.5 * project(problem).rss
    swarm = run_swarm(problem, SwarmSettings(particles=400, iterations=500), search_knee=True)
    assert polish(swarm.fit).knee * problem.top_radps == pytest.approx(1.2, abs=0.15)


def test_knee_candidates_leave_points_on_both_sides():
    problem = paper_problems(0)[0]
    candidates = knee_candidates(problem)
    assert np.count_nonzero(problem.x <= candidates[0]) == 5
    assert np.count_nonzero(problem.x > candidates[-1]) == 5


# --- Outliers, folds, selection of a model, intervals and profile on synthetic data of Table 3 ---
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


def sure(fit):
    return uncertainty(fit, noise_of([fit])[0])


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    inside = {"tc": 0, "tv": 0, "a1": 0, "a3": 0}
    truth = {"tc": 0.11985, "tv": 0.0026518 / DEGREE, "a1": 0.0012298 / DEGREE, "a3": -7.6969e-9 / DEGREE**3}
    for seed in range(60):
        found = sure(project(one_direction(seed, velocity_radps=DENSE_radps))).intervals
        for name in inside:
            inside[name] += found[name].low <= truth[name] <= found[name].high
    # 57 expected, standard deviation 1.7
    assert all(count >= 51 for count in inside.values()), inside


def test_the_band_covers_the_true_curve_about_as_often_as_it_says():
    covered = []
    for seed in range(40):
        problem = one_direction(seed)
        fit = project(problem)
        low, high = sure(fit).band_Nm(fit, problem.x)
        truth = friction_curve_Nm(paper_friction(), problem.x * problem.top_radps)
        covered.append(np.mean((low <= truth) & (truth <= high)))
    assert 0.88 < np.mean(covered) < 0.985


def test_the_profile_says_that_a_uniform_grid_does_not_determine_ws_and_a_dense_one_does():
    weak = [sure(project(one_direction(seed))).intervals["ws"].weak for seed in range(8)]
    assert sum(bool(w) for w in weak) >= 7
    dense = [sure(project(one_direction(seed, velocity_radps=DENSE_radps, noise_Nm=0.001))) for seed in range(8)]
    intervals = [u.intervals["ws"] for u in dense]
    assert not any(i.weak for i in intervals)
    assert sum(i.low <= 1.2301 * DEGREE <= i.high for i in intervals) >= 6


def test_the_interval_of_ws_ends_where_the_f_test_crosses_and_moves_with_the_noise():
    """Not at points of a grid: noise that is 1 % larger widens it by less than a step of 4 %, but widens it."""
    fit = project(one_direction(3, velocity_radps=DENSE_radps, noise_Nm=0.001))
    noise = noise_of([fit])[0]
    for part in (1.0, 1.01):
        interval = uncertainty(fit, replace(noise, variance_Nm2=part * noise.variance_Nm2)).intervals["ws"]
        regression = Regression(fit.problem.form, fit.problem.x, fit.knee)
        ends = [
            solve_linear(fit.problem, end / fit.problem.top_radps, regression)[1]
            for end in (interval.low, interval.high)
        ]
        reached = 1.0 + 4.0 / len(fit.problem.x)
        allowed = fit.rss + part * reached * noise.variance_Nm2 * stats.f.ppf(0.95, 1, noise.freedom)
        assert ends == pytest.approx([allowed, allowed], rel=1e-4)


@pytest.mark.parametrize("true", [0.0, 1.0])
def test_noise_that_grows_with_the_friction_is_found_and_weighted(true):
    found = []
    for seed in range(6):
        fits = []
        for word in (seed, 100 + seed):
            problem = one_direction(word, velocity_radps=DENSE_radps, noise_Nm=0.0)
            scale = np.abs(problem.y_Nm / np.mean(problem.y_Nm)) ** true
            noise = NOISE_Nm * scale * np.random.default_rng(word).standard_normal(len(problem.x))
            fits.append(project(replace(problem, y_Nm=problem.y_Nm + noise)))
        found.append(noise_exponent(fits))
    assert np.median(found) == pytest.approx(true, abs=0.25)
    weight = with_noise(fits[0], 1.0).weight
    assert np.mean(weight) == pytest.approx(1.0)
    assert weight[0] / weight[-1] == pytest.approx(
        (fits[0].torque_Nm(np.ones(1))[0] / fits[0].torque_Nm(fits[0].problem.x[:1])[0]) ** 2
    )


def test_the_swarm_and_the_exact_minimum_agree_with_weights_as_well():
    fit = project(one_direction(5))
    weighted = with_noise(fit, 1.5)
    exact = project(weighted)
    assert exact.rss < weighted.weight @ fit.residual_Nm**2
    found = polish(run_swarm(weighted, SwarmSettings(particles=200, iterations=500)).fit)
    assert found.rss == pytest.approx(exact.rss, rel=0.005)


def test_directions_of_unlike_noise_are_not_pooled():
    alike = [project(one_direction(seed)) for seed in (1, 2)]
    assert noise_of(alike)[0] == noise_of(alike)[1]
    unlike = [project(one_direction(1)), project(one_direction(2, noise_Nm=3.0 * NOISE_Nm))]
    quiet, loud = noise_of(unlike)
    assert loud.variance_Nm2 > 4.0 * quiet.variance_Nm2


def test_no_stribeck_effect_is_told_and_not_made_up():
    u = np.linspace(0.05, 3.0, 80)
    y = 0.1 + 0.02 * u - 0.02 * np.exp(-u / 0.3)
    found = sure(project(make_problem(FORMS["stribeck"], u, y, 1.0, (None, 0.5)))).intervals
    assert found["ts"].value == pytest.approx(found["tc"].value, rel=1e-6)
    assert found["ts"].weak == "no Stribeck effect found (ts = tc)"
    assert found["ws"].weak
