"""From friction data to an identified model: outliers, knee, swarm, polish, cross-check, selection, intervals.

`Options` says what to fit, `identify_friction` does it, `Identification` is what was found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.fit import (
    MAX_OUTLIERS,
    Fit,
    Problem,
    Uncertainty,
    choose,
    find_outliers,
    held_out_rss,
    make_problem,
    noise_exponent,
    noise_of,
    points_beyond,
    polish,
    project,
    uncertainty,
    with_form,
    with_noise,
)
from jointctl.tools.identification.friction_data import FrictionData, refuse_unused, relative_figures
from jointctl.tools.identification.models import FORMS, MIN_PER_STAGE, Branch, Form
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.plausibility import JointLimits, check_branches, check_data
from jointctl.tools.identification.swarm import SwarmResult, SwarmSettings, run_swarms

# --- the flags of `jointctl identify`, and what of them is allowed ---

SLOWEST_degps, FASTEST_degps = 1e-4, 6e4
STATIC_MAX_Nm = 1e3  # at the motor
MODELS = ("multi-stage", "stribeck", "coulomb-viscous", "auto")
_CUBIC_STAGE = {"continuous", "search_knee", "knee_radps"}
_UNUSED = {
    "stribeck": _CUBIC_STAGE,
    "coulomb-viscous": {*_CUBIC_STAGE, "ws_min_radps", "ws_max_radps", "static_max_Nm"},
}


@dataclass(frozen=True)
class Options:
    """What to fit and how; speeds in joint rad/s."""

    model: str = "auto"
    continuous: bool = False
    search_knee: bool = False
    knee_radps: float = 40.0 * DEGREE
    ws_min_radps: float | None = None  # None: a third of the lowest speed
    ws_max_radps: float = 20.0 * DEGREE
    static_max_Nm: float | None = None  # None: 1.25 times the greatest friction near zero speed
    outlier_threshold: float = 5.0
    folds: int = 10
    swarm: SwarmSettings = field(default_factory=SwarmSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)  # of a time series, whose model is always chosen

    def check(self) -> None:
        """Raise `UsageError` for a value out of range, and for one that the chosen model does not look at."""
        s = self.swarm
        for name, value, low, high in (
            ("--outlier-threshold", self.outlier_threshold, 0.0, 100.0), ("--folds", self.folds, 2, 100),
            ("--particles", s.particles, 2, 100_000), ("--iterations", s.iterations, 1, 1_000_000),
            ("--inertia", s.inertia, 0.0, 1.0), ("--cognitive", s.cognitive, 0.0, 4.0),
            ("--social", s.social, 0.0, 4.0), ("--seed", s.seed, 0, 2**63 - 1), ("--stall", s.stall, 0, 1_000_000),
        ):  # fmt: skip
            if not low <= value <= high:
                raise UsageError(f"{name} (={value:g}) must be in [{low:g}..{high:g}]")
        # as they are given on the command line: in deg/s
        for name, value_radps in (("--knee", self.knee_radps), ("--ws-max", self.ws_max_radps)):
            if not SLOWEST_degps <= value_radps / DEGREE <= FASTEST_degps:
                allowed = f"[{SLOWEST_degps:g}..{FASTEST_degps:g}] deg/s"
                raise UsageError(f"{name} (={value_radps / DEGREE:g} deg/s) must be in {allowed}")
        if self.ws_min_radps is not None and not 0.0 < self.ws_min_radps < self.ws_max_radps:
            allowed = f"(0..{self.ws_max_radps / DEGREE:g}) deg/s"
            raise UsageError(f"--ws-min (={self.ws_min_radps / DEGREE:g} deg/s) must be in {allowed}")
        if self.static_max_Nm is not None and not 0.0 < self.static_max_Nm <= STATIC_MAX_Nm:
            raise UsageError(f"--static-max (={self.static_max_Nm:g} Nm) must be in (0..{STATIC_MAX_Nm:g}]")
        if self.model not in MODELS:
            raise UsageError(f"--model (={self.model}) must be one of {', '.join(MODELS)}")
        if unused := _UNUSED.get(self.model):
            used = {*vars(self), *vars(self.swarm), *vars(self.motion)} - unused
            refuse_unused(self, used, f"--model {self.model}")


# --- what was found, of both directions ---

DIRECTIONS = (("positive", 1), ("negative", -1))


@dataclass(frozen=True)
class Direction:
    """The result of one direction; arrays over the used points are in `fit.problem`, mirrored."""

    fit: Fit
    swarm: SwarmResult | None
    projected_rmse_Nm: float
    source: str  # where the parameters come from: swarm and polish, or variable projection
    uncertainty: Uncertainty
    index: np.ndarray  # of the used points in the data
    outliers: np.ndarray  # indices in the data

    def errors_Nm(self, data: FrictionData, points: np.ndarray) -> np.ndarray:
        """Measured minus model at the motor, mirrored, of points of this direction."""
        model = self.fit.torque_Nm(np.abs(data.velocity_radps[points]) / self.fit.problem.top_radps)
        return np.asarray(np.sign(data.velocity_radps[points]) * data.motor_torque_Nm[points] - model)


@dataclass(frozen=True)
class LeftOut:
    """What the fit did not see, and what it would make of the error."""

    outliers: int
    unsettled: int
    error_share: float  # of the squared error over all points, in [0..1]
    rmse_with_Nm: float  # over all points, those that were left out included


@dataclass(frozen=True)
class Identification:
    """All that there is to tell; `errors_Nm` is measured minus model over the used points of both directions."""

    data: FrictionData
    options: Options
    model: str
    directions: dict[str, Direction]
    rmse_by_model_Nm: dict[str, float]
    held_out_by_model_Nm: dict[str, float]
    noise_exponent: float  # of the friction in the noise's standard deviation, which weights the points; 0 = the same
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def branches(self) -> dict[str, Branch]:
        return {word: found.fit.branch() for word, found in self.directions.items()}

    @property
    def errors_Nm(self) -> np.ndarray:
        parts = []
        for word, sign in DIRECTIONS:
            fit = self.directions[word].fit
            parts.append(sign * (fit.problem.y_Nm - fit.torque_Nm(fit.problem.x)))
        return np.concatenate(parts)

    @property
    def measured_Nm(self) -> np.ndarray:
        return np.concatenate([sign * self.directions[word].fit.problem.y_Nm for word, sign in DIRECTIONS])

    @property
    def rmse_Nm(self) -> float:
        return float(np.sqrt(np.mean(self.errors_Nm**2)))

    @property
    def left_out(self) -> LeftOut:
        """The measured points that the fit did not see."""
        outliers, unsettled = [], []
        for word, sign in DIRECTIONS:
            found = self.directions[word]
            moving = np.flatnonzero(~self.data.settled & (sign * self.data.velocity_radps > 0.0))
            outliers.append(found.errors_Nm(self.data, found.outliers))
            unsettled.append(found.errors_Nm(self.data, moving))
        of_outliers, of_unsettled = np.concatenate(outliers), np.concatenate(unsettled)
        out, used = np.concatenate([of_outliers, of_unsettled]), self.errors_Nm
        whole = float(used @ used + out @ out)
        return LeftOut(
            len(of_outliers), len(of_unsettled), float(out @ out) / whole if whole else 0.0,
            float(np.sqrt(whole / (len(used) + len(out)))),
        )  # fmt: skip

    @property
    def projected_rmse_Nm(self) -> float:
        """What variable projection reaches, weighted as the fit: the least possible."""
        return _pooled({w: d.projected_rmse_Nm for w, d in self.directions.items()}, self.directions)

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers, texts, lists and dicts; parameters mirrored, joint rad/s and motor Nm."""
        errors, swarm = self.errors_Nm, self.options.swarm
        figures = relative_figures(errors, self.measured_Nm)
        relative = [value if math.isfinite(value) else None for value in figures]
        return {
            "data": str(self.data.path), "data_sha256": self.data.sha256, "model": self.model,
            "reduction_ratio": self.data.reduction_ratio, "points": len(errors),
            "rmse_Nm": self.rmse_Nm, "max_error_Nm": float(np.max(np.abs(errors))),
            "relative_rmse": relative[0],
            "relative_max_error": relative[1],
            "held_out_rmse_Nm": self.held_out_by_model_Nm[self.model],
            "left_out": asdict(self.left_out), "noise_exponent": self.noise_exponent,
            "projected_rmse_Nm": self.projected_rmse_Nm,
            "models": {
                name: {"rmse_Nm": self.rmse_by_model_Nm[name], "held_out_rmse_Nm": self.held_out_by_model_Nm[name]}
                for name in self.rmse_by_model_Nm
            },
            "swarm": {
                "seed": swarm.seed, "particles": swarm.particles, "iterations": swarm.iterations,
                "inertia": swarm.inertia, "cognitive": swarm.cognitive, "social": swarm.social,
            },
            "directions": {word: _direction_dict(found, self.data) for word, found in self.directions.items()},
            "notes": list(self.notes), "warnings": list(self.warnings),
        }  # fmt: skip


def _direction_dict(found: Direction, data: FrictionData) -> dict[str, Any]:
    model = found.fit.branch()
    return {
        "parameters": {
            name: {"value": i.value, "low": i.low, "high": i.high, "weak": i.weak or None}
            for name, i in found.uncertainty.intervals.items()
        },
        "knee_radps": model.knee_radps, "max_radps": model.max_radps, "rmse_Nm": found.fit.rmse_Nm,
        "swarm_rmse_Nm": found.swarm.fit.weighted_rmse_Nm if found.swarm else None,
        "projected_rmse_Nm": found.projected_rmse_Nm, "source": found.source,
        "iterations": found.swarm.iterations if found.swarm else 0,
        "outlier_lines": [int(n) for n in data.line[found.outliers]],
    }  # fmt: skip


def _pooled(rmse: dict[str, float], directions: dict[str, Any]) -> float:
    count = {word: len(d.fit.problem.x) for word, d in directions.items()}
    return float(np.sqrt(sum(rmse[w] ** 2 * count[w] for w in rmse) / sum(count.values())))


# --- how it is found ---

_BAD_FIT, _OTHER_FORM = 0.15, 0.005  # RMSE over mean friction
_CORRELATED = 3.0  # standard deviations of the correlation between neighbours where there is none
_EXACT = 1e-6  # of the greatest friction: between errors below nothing measured decides


def _refuse(data: FrictionData, problems: list[str]) -> None:
    if problems:
        raise DataError(f"{data.path}: {'; '.join(problems)}")


def _too_few(speeds: np.ndarray, knee: float) -> str:
    """How many speeds lie on either side of the knee, where one side has too few of them; else nothing."""
    low = int(np.count_nonzero(speeds <= knee))
    high = len(speeds) - low
    return f"{low} points up to it and {high} beyond" if min(low, high) < MIN_PER_STAGE else ""


class _TooFewBeside(DataError):
    """Too few points on one side of the knee; `seen` says so without what to do about it."""

    def __init__(self, data: FrictionData, seen: str) -> None:
        super().__init__(
            f"{data.path}: {seen}; at least {MIN_PER_STAGE} are needed on both sides",
            "set --knee, or --search-knee, or --model auto; or the unit or side of the velocity is wrong",
        )
        self.seen = seen


def _stage_check(data: FrictionData, problem: Problem, word: str) -> None:
    few = _too_few(problem.x, problem.knee) if problem.form.cubic else ""
    if few:
        knee_degps = problem.knee * problem.top_radps / DEGREE
        raise _TooFewBeside(data, f"knee (={knee_degps:.4g} deg/s) at {word} velocity: {few}")


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
    refuse_unused(options.motion, (), f"{data.path}, which holds plateaus")
    before = check_data(data, limits)
    _refuse(data, before.problems)
    notes, warnings = list(data.notes), list(before.warnings)
    first = _first_form(data, options, notes)
    try:
        points, exponent = _weighted_points(data, options, first, warnings)
    except _TooFewBeside as error:  # without the outliers
        if options.model != "auto" or options.search_knee or options.knee_radps != Options.knee_radps:
            raise
        notes.append(f"{error.seen}, too few for the {first.name} model without the outliers, which was left out")
        first, warnings = FORMS["stribeck"], list(before.warnings)
        points, exponent = _weighted_points(data, options, first, warnings)
    for word, found in points.items():
        for line, score in zip(data.line[found.outliers], found.score, strict=True):
            notes.append(f"line {line}: outlier at {word} velocity, {abs(score):.1f} standard deviations: not used")
    if exponent:
        notes.append(f"the noise goes with the friction to the power of {exponent:.2g}: points are weighted by it")
    rmse, held_out = _compared([found.problem for found in points.values()], first, options)
    greatest_Nm = max(float(np.max(np.abs(found.problem.y_Nm))) for found in points.values())
    model = _model(held_out, options, first, _EXACT * greatest_Nm, warnings)
    directions = _fitted(points, FORMS[model], options, progress, warnings)
    after = check_branches({word: found.fit.branch() for word, found in directions.items()})
    _refuse(data, after.problems)
    return Identification(
        data, options, model, directions, rmse, held_out, exponent, tuple(notes), tuple(warnings + after.warnings)
    )  # fmt: skip


@dataclass(frozen=True)
class _Points:
    """The points of one direction that are used, as a problem, and which they are of all."""

    problem: Problem
    index: np.ndarray
    outliers: np.ndarray
    score: np.ndarray  # of the outliers, in standard deviations


def _weighted_points(
    data: FrictionData, options: Options, first: Form, warnings: list[str]
) -> tuple[dict[str, _Points], float]:
    """The points of both directions, and the power of the friction that the noise goes with (see `noise_exponent`).

    Which points are outliers hangs on the noise, and the noise on which points are used.
    """
    exponent, said = 0.0, list[str]()
    shapes: dict[str, Fit] = {}
    for _ in range(2):
        said.clear()
        points = {
            word: _points(data, options, first, sign, (shapes.get(word), exponent), said) for word, sign in DIRECTIONS
        }
        shapes = {word: project(found.problem) for word, found in points.items()}
        before, exponent = exponent, noise_exponent(list(shapes.values()))
        if exponent == before:
            break
    warnings += said
    return {
        word: replace(found, problem=with_noise(shapes[word], exponent)) for word, found in points.items()
    }, exponent


def _points(
    data: FrictionData, options: Options, first: Form, sign: int, noise: tuple[Fit | None, float], warnings: list[str]
) -> _Points:
    """Those of one direction without outliers, with the knee where the data have it if it is searched."""
    word = "positive" if sign > 0 else "negative"
    chosen = data.direction(sign)
    chosen = chosen[np.argsort(sign * data.velocity_radps[chosen], kind="stable")]

    def problem_of(points: np.ndarray) -> Problem:
        return make_problem(
            first, sign * data.velocity_radps[points], sign * data.motor_torque_Nm[points], options.knee_radps,
            (options.ws_min_radps, options.ws_max_radps), options.static_max_Nm,
        )  # fmt: skip

    problem = problem_of(chosen)
    beyond = problem.x * problem.top_radps > options.knee_radps
    bent = np.zeros(0)
    few = options.model == "auto" and not first.cubic and 0 < np.count_nonzero(beyond) < MIN_PER_STAGE
    if few and options.outlier_threshold > 0.0:
        bent = points_beyond(problem, beyond, options.outlier_threshold)
    if len(bent):
        warnings.append(
            f"{len(bent)} points beyond the knee (={options.knee_radps / DEGREE:.4g} deg/s) at {word} velocity do not "
            f"continue the curve below it, {np.max(np.abs(bent)):.1f} standard deviations off: not used, and the model "
            f"ends there; measure at least {MIN_PER_STAGE} of them, or set --knee or --model"
        )
        bent_index, chosen = chosen[beyond], chosen[~beyond]
        problem = problem_of(chosen)
    shape, exponent = noise
    if shape is not None and exponent:
        problem = with_noise(replace(shape, problem=problem), exponent)
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
    problem = problem.part(~out)
    if options.search_knee and first.cubic and out.any():
        problem = replace(problem, knee=project(problem, search_knee=True).knee)
    _stage_check(data, problem, word)
    if len(bent):
        return _Points(problem, chosen[~out], np.append(chosen[out], bent_index), np.append(score[out], bent))
    return _Points(problem, chosen[~out], chosen[out], score[out])


def _compared(problems: Sequence[Problem], first: Form, options: Options) -> tuple[dict[str, float], dict[str, float]]:
    """RMSE [Nm] of each model that the data allow: of all points, and of points held out of the fit."""
    total = sum(len(problem.x) for problem in problems)
    rmse, held_out = {}, {}
    for name, form in FORMS.items():
        if form.cubic > first.cubic:
            continue
        parts = [with_form(problem, form, options.static_max_Nm) for problem in problems]
        rmse[name] = float(np.sqrt(sum(project(part).rmse_Nm ** 2 * len(part.x) for part in parts) / total))
        squared = sum(held_out_rss(part, options.folds, options.swarm.seed) for part in parts)
        held_out[name] = float(np.sqrt(squared / total))
    return rmse, held_out


def _model(held_out: dict[str, float], options: Options, first: Form, rounding_Nm: float, warnings: list[str]) -> str:
    """The model asked for, or the one that predicts best; a warning where the former predicts worse."""
    best = choose({name: error for name, error in held_out.items() if not options.continuous or name != "multi-stage"})
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
    problems = [with_form(found.problem, form, options.static_max_Nm) for found in points.values()]
    swarms: list[SwarmResult | None] = [None] * len(problems)
    if form.stribeck:
        swarms = list(run_swarms(problems, options.swarm, search_knee=options.search_knee, progress=progress))
    best = [
        _best_fit(problem, swarm, warnings, word) for word, problem, swarm in zip(points, problems, swarms, strict=True)
    ]
    noises = noise_of([fit for fit, _, _ in best])
    directions = {}
    for (word, used), swarm, (fit, projected, source), noise in zip(points.items(), swarms, best, noises, strict=True):
        sure = uncertainty(fit, noise)
        directions[word] = Direction(fit, swarm, projected, source, sure, used.index, used.outliers)
        share = fit.rmse_Nm / float(np.mean(np.abs(fit.problem.y_Nm)))
        if share > _BAD_FIT:
            warnings.append(
                f"the model describes the data at {word} velocity badly: RMSE is {share:.0%} of the friction"
            )
        elif share > _OTHER_FORM and (found := serial_correlation(fit)) * math.sqrt(len(fit.problem.x)) > _CORRELATED:
            warnings.append(
                f"the errors at {word} velocity go with the speed (correlation of neighbours {found:.2f}): friction "
                "has another form than the model, for which alone the intervals hold; look at the picture"
            )
    return directions


def serial_correlation(fit: Fit) -> float:
    """Of the weighted errors of points that are neighbours in speed, in [-1..1]; 0 where there is nothing to tell."""
    errors = fit.residual_Nm * np.sqrt(fit.problem.weight)
    squares = float(errors @ errors)
    return float(errors[1:] @ errors[:-1]) / squares if squares > 0.0 else 0.0


def _best_fit(problem: Problem, swarm: SwarmResult | None, warnings: list[str], word: str) -> tuple[Fit, float, str]:
    """(fit, RMSE of variable projection, source); the exact minimum is taken where swarm and polish stay above it."""
    projected = project(problem)  # a searched knee is already the problem's
    least_Nm = projected.weighted_rmse_Nm
    if swarm is None:
        return projected, least_Nm, "least squares"
    polished = polish(swarm.fit)
    if polished.rss <= projected.rss * (1.0 + 1e-6):
        return polished, least_Nm, "swarm and polish"
    reached_Nm = polished.weighted_rmse_Nm
    if reached_Nm > max(1.01 * least_Nm, _EXACT * float(np.max(np.abs(problem.y_Nm)))):
        warnings.append(
            f"the swarm at {word} velocity ended {reached_Nm / least_Nm - 1.0:.1%} above the least "
            "RMSE: more particles or iterations, or another seed; the variable projection is used"
        )
    return projected, least_Nm, "variable projection"
