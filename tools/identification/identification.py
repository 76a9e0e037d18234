"""From friction data to an identified model: outliers, knee, swarm, polish, cross-check, selection, intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.errors import DataError
from firmware_py.friction import DEGREE
from tools.identification.friction_data import FrictionData
from tools.identification.intervals import uncertainty
from tools.identification.models import FORMS, MIN_PER_STAGE, Form
from tools.identification.options import Options
from tools.identification.plausibility import JointLimits, check_branches, check_data
from tools.identification.polish import polish
from tools.identification.pso import SwarmResult, run_swarms
from tools.identification.result import DIRECTIONS, Direction, Identification
from tools.identification.selection import MAX_OUTLIERS, choose, find_outliers, held_out_rss, with_form
from tools.identification.variable_projection import Fit, Problem, make_problem, project

_BAD_FIT = 0.15  # RMSE over mean friction
_EXACT = 1e-6  # of the greatest friction: between errors below nothing measured decides


def _refuse(data: FrictionData, problems: list[str]) -> None:
    if problems:
        raise DataError(f"{data.path}: {'; '.join(problems)}")


def _too_few(speeds: np.ndarray, knee: float) -> str:
    """How many speeds lie on either side of the knee, where one side has too few of them; else nothing."""
    low = int(np.count_nonzero(speeds <= knee))
    high = len(speeds) - low
    return f"{low} points up to it and {high} beyond" if min(low, high) < MIN_PER_STAGE else ""


def _stage_check(data: FrictionData, problem: Problem, word: str) -> None:
    few = _too_few(problem.x, problem.knee) if problem.form.cubic else ""
    if few:
        raise DataError(
            f"{data.path}: knee (={problem.knee * problem.top_radps / DEGREE:.4g} deg/s) at {word} velocity: {few}; at "
            f"least {MIN_PER_STAGE} are needed on both sides",
            "set --knee, or --search-knee, or --model auto; or the unit or side of the velocity is wrong",
        )


def _first_form(data: FrictionData, options: Options, notes: list[str]) -> Form:
    """The richest model that is considered; the chosen one, unless the held-out error is to choose."""
    if options.model in ("stribeck", "coulomb-viscous"):
        return FORMS[options.model]
    form = FORMS["multi-stage-continuous" if options.continuous else "multi-stage"]
    if options.model != "auto" or options.search_knee:
        return form
    for word, sign in DIRECTIONS:
        few = _too_few(np.abs(data.velocity_radps[data.direction(sign)]), options.knee_radps)
        if few:
            notes.append(
                f"knee (={options.knee_radps / DEGREE:.4g} deg/s) at {word} velocity: {few}, too few for the "
                f"{form.name} model, which was left out"
            )
            return FORMS["stribeck"]
    return form


def identify_friction(
    data: FrictionData,
    options: Options,
    *,
    limits: JointLimits | None = None,
    progress: Callable[[int], None] | None = None,
) -> Identification:
    """The whole computation.

    Raises `UsageError` for options out of range, `DataError` where the data or the result are not believable.
    """
    options.check()
    before = check_data(data, limits)
    _refuse(data, before.problems)
    notes, warnings = list(data.notes), list(before.warnings)
    first = _first_form(data, options, notes)
    problems: dict[str, Problem] = {}
    index, outliers = {}, {}
    for word, sign in DIRECTIONS:
        chosen = data.direction(sign)
        chosen = chosen[np.argsort(sign * data.velocity_radps[chosen], kind="stable")]
        problem = make_problem(
            first, sign * data.velocity_radps[chosen], sign * data.motor_torque_Nm[chosen], options.knee_radps,
            (options.ws_min_radps, options.ws_max_radps), options.static_max_Nm,
        )  # fmt: skip
        if not options.search_knee:
            _stage_check(data, problem, word)
        elif first.cubic:
            problem = replace(problem, knee=project(problem, search_knee=True).knee)
        out, score = find_outliers(problem, options.outlier_threshold)
        if np.count_nonzero(out) > MAX_OUTLIERS * len(out):
            warnings.append(
                f"{np.count_nonzero(out)} of {len(out)} points at {word} velocity are far from the curve: the model "
                "does not describe these data; none was left out"
            )
            out = np.zeros_like(out)
        for line, value in zip(data.line[chosen[out]], score[out], strict=True):
            notes.append(f"line {line}: outlier at {word} velocity, {abs(value):.1f} standard deviations: not used")
        problem = problem.part(~out)
        if options.search_knee and first.cubic and out.any():
            problem = replace(problem, knee=project(problem, search_knee=True).knee)
        _stage_check(data, problem, word)
        problems[word], index[word] = problem, chosen[~out]
        outliers[word] = chosen[out]

    total = sum(len(p.x) for p in problems.values())
    rmse, held_out = {}, {}
    names = [n for n in FORMS if FORMS[n].cubic <= first.cubic]
    for name in names:
        parts = [with_form(p, FORMS[name]) for p in problems.values()]
        rmse[name] = float(np.sqrt(sum(project(p).rss for p in parts) / total))
        squared = sum(held_out_rss(p, options.folds, options.swarm.seed) for p in parts)
        held_out[name] = float(np.sqrt(squared / total))
    model = choose(held_out) if options.model == "auto" else first.name
    best = choose(held_out)
    rounding_Nm = _EXACT * max(float(np.max(np.abs(p.y_Nm))) for p in problems.values())
    if model != best and held_out[best] < held_out[model] / 1.02 and held_out[model] > rounding_Nm:
        warnings.append(
            f"the model {best} predicts held-out points better: {held_out[best]:.4g} against {held_out[model]:.4g} Nm"
        )
    problems = {word: with_form(p, FORMS[model]) for word, p in problems.items()}
    swarms: list[SwarmResult | None] = [None] * len(problems)
    if FORMS[model].stribeck:
        swarms = list(
            run_swarms(list(problems.values()), options.swarm, search_knee=options.search_knee, progress=progress)
        )
    directions = {}
    for (word, problem), swarm in zip(problems.items(), swarms, strict=True):
        fit, projected, source = _best_fit(problem, swarm, warnings, word)
        directions[word] = Direction(fit, swarm, projected, source, uncertainty(fit), index[word], outliers[word])
    for word, found in directions.items():
        share = found.fit.rmse_Nm / float(np.mean(np.abs(found.fit.problem.y_Nm)))
        if share > _BAD_FIT:
            warnings.append(
                f"the model describes the data at {word} velocity badly: RMSE is {share:.0%} of the friction"
            )
    after = check_branches({word: found.fit.branch() for word, found in directions.items()})
    _refuse(data, after.problems)
    return Identification(
        data, options, model, directions, rmse, held_out, tuple(notes), tuple(warnings + after.warnings)
    )  # fmt: skip


def _best_fit(problem: Problem, swarm: SwarmResult | None, warnings: list[str], word: str) -> tuple[Fit, float, str]:
    """(fit, RMSE of variable projection, source); the exact minimum is taken where swarm and polish stay above it."""
    projected = project(problem)  # a searched knee is already the problem's
    if swarm is None:
        return projected, projected.rmse_Nm, "least squares"
    polished = polish(swarm.fit)
    if polished.rss <= projected.rss * (1.0 + 1e-6):
        return polished, projected.rmse_Nm, "swarm and polish"
    if polished.rmse_Nm > max(1.01 * projected.rmse_Nm, _EXACT * float(np.max(np.abs(problem.y_Nm)))):
        warnings.append(
            f"the swarm at {word} velocity ended {polished.rmse_Nm / projected.rmse_Nm - 1.0:.1%} above the least "
            "RMSE: more particles or iterations, or another seed; the variable projection is used"
        )
    return projected, projected.rmse_Nm, "variable projection"
