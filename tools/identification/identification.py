"""From friction data to an identified model: outliers, knee, swarm, polish, cross-check, selection, intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.friction_data import FrictionData
from jointctl.tools.identification.intervals import uncertainty
from jointctl.tools.identification.models import FORMS, MIN_PER_STAGE, Form
from jointctl.tools.identification.options import Options
from jointctl.tools.identification.plausibility import JointLimits, check_branches, check_data
from jointctl.tools.identification.polish import polish
from jointctl.tools.identification.pso import SwarmResult, run_swarms
from jointctl.tools.identification.result import DIRECTIONS, Direction, Identification
from jointctl.tools.identification.selection import MAX_OUTLIERS, choose, find_outliers, held_out_rss, with_form
from jointctl.tools.identification.variable_projection import Fit, Problem, make_problem, project

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
    """The whole computation: points that are used, model, fit of each direction, what is believable of it.

    Raises `UsageError` for options out of range, `DataError` where the data or the result are not believable.
    """
    options.check()
    before = check_data(data, limits)
    _refuse(data, before.problems)
    notes, warnings = list(data.notes), list(before.warnings)
    first = _first_form(data, options, notes)
    points = {word: _points(data, options, first, word, sign, notes, warnings) for word, sign in DIRECTIONS}
    rmse, held_out = _compared([found.problem for found in points.values()], first, options)
    greatest_Nm = max(float(np.max(np.abs(found.problem.y_Nm))) for found in points.values())
    model = _model(held_out, options, first, _EXACT * greatest_Nm, warnings)
    directions = _fitted(points, FORMS[model], options, progress, warnings)
    after = check_branches({word: found.fit.branch() for word, found in directions.items()})
    _refuse(data, after.problems)
    return Identification(
        data, options, model, directions, rmse, held_out, tuple(notes), tuple(warnings + after.warnings)
    )  # fmt: skip


@dataclass(frozen=True)
class _Points:
    """The points of one direction that are used, as a problem, and which they are of all."""

    problem: Problem
    index: np.ndarray
    outliers: np.ndarray


def _points(
    data: FrictionData, options: Options, first: Form, word: str, sign: int, notes: list[str], warnings: list[str]
) -> _Points:
    """Those of one direction without outliers, with the knee where the data have it if it is searched."""
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
    return _Points(problem, chosen[~out], chosen[out])


def _compared(problems: Sequence[Problem], first: Form, options: Options) -> tuple[dict[str, float], dict[str, float]]:
    """RMSE [Nm] of each model that the data allow: of all points, and of points held out of the fit."""
    total = sum(len(problem.x) for problem in problems)
    rmse, held_out = {}, {}
    for name in [n for n in FORMS if FORMS[n].cubic <= first.cubic]:
        parts = [with_form(problem, FORMS[name]) for problem in problems]
        rmse[name] = float(np.sqrt(sum(project(part).rss for part in parts) / total))
        squared = sum(held_out_rss(part, options.folds, options.swarm.seed) for part in parts)
        held_out[name] = float(np.sqrt(squared / total))
    return rmse, held_out


def _model(held_out: dict[str, float], options: Options, first: Form, rounding_Nm: float, warnings: list[str]) -> str:
    """The model asked for, or the one that predicts best; a warning where the former predicts worse."""
    best = choose(held_out)
    model = best if options.model == "auto" else first.name
    if model != best and held_out[best] < held_out[model] / 1.02 and held_out[model] > rounding_Nm:
        warnings.append(
            f"the model {best} predicts held-out points better: {held_out[best]:.4g} against {held_out[model]:.4g} Nm"
        )
    return model


def _fitted(
    points: dict[str, _Points],
    form: Form,
    options: Options,
    progress: Callable[[int], None] | None,
    warnings: list[str],
) -> dict[str, Direction]:
    """The fit of each direction: swarm and polish where the model has a Stribeck stage, else the exact minimum."""
    problems = [with_form(found.problem, form) for found in points.values()]
    swarms: list[SwarmResult | None] = [None] * len(problems)
    if form.stribeck:
        swarms = list(run_swarms(problems, options.swarm, search_knee=options.search_knee, progress=progress))
    directions = {}
    for (word, used), problem, swarm in zip(points.items(), problems, swarms, strict=True):
        fit, projected, source = _best_fit(problem, swarm, warnings, word)
        directions[word] = Direction(fit, swarm, projected, source, uncertainty(fit), used.index, used.outliers)
        share = fit.rmse_Nm / float(np.mean(np.abs(fit.problem.y_Nm)))
        if share > _BAD_FIT:
            warnings.append(
                f"the model describes the data at {word} velocity badly: RMSE is {share:.0%} of the friction"
            )
    return directions


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
