"""Which terms a motion tells of, their parameters, and what it leaves open (see `models` for the equations).

All parameters are found together by least squares with Huber's loss (scipy).  Which terms are in is chosen step by
step: the term whose presence lowers the error on held-out blocks most comes in, while it does so by more than 1 %.
The intervals come from a bootstrap of whole blocks of time, since neighbouring residuals resemble each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.models import (
    BOUNDS,
    EXPERIMENTS,
    FORM_STEPS,
    FORMS,
    MIN_PER_STAGE,
    ORDERS,
    SIGNS,
    TERMS,
    Branch,
    Model,
    Samples,
    WS_MAX_radps,
    basis,
    branch,
    jacobian,
    unit_of,
)
from jointctl.tools.identification.motion_data import Motion, MotionSettings, filtered

LEVEL = 0.95
SAMPLES_PER_BAND = 5.0  # of the fit, for each hertz of the band
MOST_SAMPLES, MOST_TO_CHOOSE = 20_000, 3_000  # of the fit, and of each fit in the choice of the model
BLOCKS, MOST_BLOCKS = 8, 256  # of the held-out error
GAIN = 1.01  # by which a term must lower the held-out error
_ALIKE = 1.005  # held-out errors up to it count as equal
RESAMPLES = 400
_HUBER = 1.345
_SLACK = 1e-6  # of the least squares, relative
_LEAST_SHARE = 0.2  # of each direction's samples that each half of the blocks must have
_LEAST_WARMING_K = 3.0
_ONE_DIRECTION = 0.02  # share of samples
_CONSTANT_SPEED = 0.2  # of the median speed, between the thousandths at the ends
_ALONG = 0.9  # rank correlation of acceleration and angle from which on they count as one
_PLACES, _REPEATS = 60, 0.8  # of the angle; share of the held-out error that is left with a mean for each place
_WEAK = 0.5
_SHARE_OF_RATE = 0.4
_PERIODS, _JOINT_PERIODS = 2.0, 0.5  # of an order that the angle must cover
_LEAST_SLOW = 0.2  # share of the samples at which an order is within the band
_NEEDED = frozenset(("inertia", "gravity"))  # what is transmitted; load friction is a share of it
_WORTH = 1.003  # by which a linear fit to what is left must lower the error for an order to be tried


@dataclass(frozen=True)
class Parameter:
    """One number with its interval; `weak` says what the data do not tell, and which experiment would."""

    value: float
    low: float
    high: float
    weak: str = ""


@dataclass(frozen=True)
class Step:
    """A term that was tried in the choice of the model: error [Nm] on held-out blocks with it; the best was taken."""

    name: str
    held_out_rmse_Nm: float
    taken: bool


@dataclass(frozen=True)
class MotionFit:
    """What was found; torques at the joint."""

    motion: Motion
    settings: MotionSettings
    model: Model
    vector: np.ndarray
    resampled: np.ndarray  # (resamples, parameters)
    parameters: dict[str, Parameter]
    reference_degC: float | None
    steps: tuple[Step, ...]
    blocks: int  # of the held-out error
    errors_Nm: np.ndarray  # (N,) measured minus predicted by the fit to the even blocks
    block: np.ndarray  # (N,) of each sample
    untold: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def value(self) -> dict[str, float]:
        return dict(zip(self.model.names, self.vector.tolist(), strict=True))

    def rmse_Nm(self, *, odd: bool, every: bool = False) -> float:
        """RMSE over even or odd blocks, of the samples that the model is for, or of every whole one."""
        chosen = (self.motion.whole if every else self.motion.used(self.settings)) & (self.block % 2 == int(odd))
        return float(np.sqrt(np.mean(self.errors_Nm[chosen] ** 2)))

    def branches(self) -> dict[str, Branch]:
        """Friction of each direction without load at T0, at the motor."""
        model, found = self.model, {}
        for word in SIGNS:
            beta, ws = model.own(self.value, word)
            found[word] = branch(model.form, beta / self.motion.reduction_ratio, ws, model.knee, model.top_radps)
        return found

    def samples(self) -> Samples:
        return samples_of(self.motion, self.reference_degC, self.settings)

    def _waves(self, kind: str, unit: str) -> list[dict[str, float]]:
        found = self.model.waves(self.value, kind, self.motion.reduction_ratio)
        return [dict(zip((unit, "per_motor_turn", "phase_rad"), wave, strict=True)) for wave in found]

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers, texts, lists and dicts; at the joint."""
        gravity = np.hypot(self.value.get("gravity_sin", 0.0), self.value.get("gravity_cos", 0.0))
        return {
            "data": str(self.motion.path), "data_sha256": self.motion.sha256, "kind": "motion",
            "model": self.model.form.name, "terms": sorted(self.model.terms), "band_Hz": self.motion.band_Hz,
            "reduction_ratio": self.motion.reduction_ratio, "samples": int(self.motion.used(self.settings).sum()),
            "samples_in_all": len(self.motion.time_s), "blocks": self.blocks,
            "held_out_rmse_Nm": self.rmse_Nm(odd=True), "fitted_rmse_Nm": self.rmse_Nm(odd=False),
            "held_out_rmse_all_samples_Nm": self.rmse_Nm(odd=True, every=True),
            "speed_min_radps": self.settings.speed_min_radps, "mean_samples": self.settings.mean_samples,
            "reference_degC": self.reference_degC,
            "gravity": {
                "amplitude_Nm": float(gravity),
                "zero_rad": float(np.arctan2(-self.value["gravity_cos"], self.value["gravity_sin"])),
            } if "gravity" in self.model.terms else None,
            "parameters": {
                name: {"value": p.value, "low": p.low, "high": p.high, "unit": unit_of(name), "weak": p.weak or None}
                for name, p in self.parameters.items()
            },
            "ripple": self._waves("ripple", "Nm"), "friction_of_angle": self._waves("angle", "share"),
            "steps": [vars(step) for step in self.steps], "untold": list(self.untold), "notes": list(self.notes),
        }  # fmt: skip


def samples_of(motion: Motion, reference_degC: float | None, settings: MotionSettings) -> Samples:
    """All samples of a motion as the model takes them."""
    warm = None
    if motion.temperature_degC is not None and reference_degC is not None:
        warm = motion.temperature_degC - reference_degC
    moved = motion.velocity_radps, motion.acceleration_radps2, motion.position_rad
    return Samples(*moved, motion.load_Nm, warm, _waves(motion, settings))


def _waves(motion: Motion, settings: MotionSettings) -> np.ndarray | None:
    """Sines of the angle (N, 2 orders), through the filter of the torque; too fast for the rate they are none."""
    if motion.plateaus or not motion.placed:
        return None
    columns = []
    for count in _counts(motion).values():
        angle = count * motion.position_rad
        slow = np.abs(count * motion.velocity_radps) < math.tau * _SHARE_OF_RATE * motion.rate_Hz
        columns += [filtered(np.where(slow, wave, 0.0), motion, settings) for wave in (np.sin(angle), np.cos(angle))]
    return np.column_stack(columns)


def _counts(motion: Motion) -> dict[str, float]:
    """Periods a joint turn of each order."""
    return {order: count * (motion.reduction_ratio if of_motor else 1.0)
            for order, (count, of_motor) in ORDERS.items()}  # fmt: skip


# --- the fit of a given model ---


def fit_model(
    model: Model, samples: Samples, torque_Nm: np.ndarray, start: Mapping[str, float], speed_min_radps: float
) -> np.ndarray:
    """Huber's loss over all parameters; `start` holds those of a smaller model, the others begin without effect."""
    low, high = model.bounds(speed_min_radps)
    size = float(np.median(np.abs(torque_Nm))) or 1.0
    middle = {"rise": 0.1 * size, "log_ws": 0.5 * (np.log(speed_min_radps + 1e-4) + np.log(WS_MAX_radps)), "tc": size}
    begin = np.array([start.get(name, middle.get(name.split()[0], 0.0)) for name in model.names])
    begin = np.clip(begin, np.where(np.isfinite(low), low + 1e-6, low), np.where(np.isfinite(high), high - 1e-6, high))

    def residual(vector: np.ndarray) -> np.ndarray:
        return model.torque_Nm(vector, samples) - torque_Nm

    scale = np.maximum(np.abs(begin), 1e-2 * size)
    found = begin
    for _ in range(2):  # the scale of the loss from the residuals of the first round
        spread = max(1.4826 * float(np.median(np.abs(residual(found)))), 1e-9 * size)
        found = least_squares(
            residual, found, bounds=(low, high), x_scale=scale, loss="huber", f_scale=_HUBER * spread, max_nfev=60,
            ftol=_SLACK, xtol=_SLACK, gtol=_SLACK,
        ).x  # fmt: skip
    return np.asarray(found)


@dataclass(frozen=True)
class _Problem:
    """The samples that are fitted, decimated to what the band holds."""

    samples: Samples
    torque_Nm: np.ndarray
    block: np.ndarray
    speed_min_radps: float

    def fit(self, model: Model, start: Mapping[str, float], chosen: np.ndarray | None = None) -> np.ndarray:
        chosen = np.ones(len(self.torque_Nm), bool) if chosen is None else chosen
        return fit_model(model, self.samples.part(chosen), self.torque_Nm[chosen], start, self.speed_min_radps)

    def coarse(self) -> _Problem:
        """With as few samples as serve to choose a model; each differs little from its neighbours."""
        every = slice(None, None, -(-len(self.torque_Nm) // MOST_TO_CHOOSE))
        return replace(
            self, samples=self.samples.part(every), torque_Nm=self.torque_Nm[every], block=self.block[every]
        )  # fmt: skip

    def held_out_Nm(self, model: Model, start: Mapping[str, float]) -> float:
        """RMSE of each half of the blocks, predicted from the other half."""
        squared = 0.0
        for parity in (0, 1):
            test = self.block % 2 == parity
            vector = self.fit(model, start, ~test)
            error = self.torque_Nm[test] - model.torque_Nm(vector, self.samples.part(test))
            squared += float(error @ error)
        return float(np.sqrt(squared / len(self.torque_Nm)))


def _blocks(motion: Motion, used: np.ndarray, words: tuple[str, ...]) -> tuple[np.ndarray, int]:
    """(block of each sample, number): as few as give both halves slow and fast samples of each direction."""
    count = len(motion.time_s)
    if motion.plateaus:  # a block is a speed, both ways; at random, so that each half has every speed somewhere
        blocks = -(-count // 2)
        return np.random.default_rng(0).permutation(blocks)[np.arange(count) // 2], blocks
    parts = []
    for word in words:
        speed = SIGNS[word] * motion.velocity_radps
        middle = np.median(speed[used & (speed > 0.0)])
        parts += [used & (speed > middle), used & (speed > 0.0) & (speed <= middle)]
    blocks = BLOCKS
    while True:
        block = np.minimum(np.arange(count) * blocks // count, blocks - 1)
        odd = block % 2 == 1
        shares = [np.mean(odd[part]) for part in parts if part.any()]
        if all(_LEAST_SHARE <= share <= 1.0 - _LEAST_SHARE for share in shares) or 2 * blocks > MOST_BLOCKS:
            return block, blocks
        blocks *= 2


# --- what the data can tell ---


@dataclass(frozen=True)
class _Ground:
    """What the motion covers, which decides on the terms that are tried."""

    forms: frozenset[str]
    terms: frozenset[str]
    words: tuple[str, ...]
    untold: tuple[str, ...]


def _ground(motion: Motion, used: np.ndarray) -> _Ground:
    v = motion.velocity_radps[used]
    untold = []
    words = tuple(word for word, sign in SIGNS.items() if np.mean(sign * v > 0.0) > _ONE_DIRECTION)
    name = motion.speed_name
    if len(words) == 1:
        untold.append(
            f"{name}: no reversal: friction of the other direction is taken to be the same, and an offset of the "
            "torque or a load looks like Coulomb friction: move both ways"
        )
    forms, terms = set(FORM_STEPS), set[str]() if motion.plateaus else {"inertia"}
    low, middle, high = np.percentile(np.abs(v), (0.1, 50, 99.9))
    if high - low < _CONSTANT_SPEED * middle:
        forms = {"coulomb"}
        untold.append(
            f"{name}: constant speed only ({low:.3g} to {high:.3g} rad/s): viscous friction and the Stribeck effect "
            "cannot be separated from Coulomb friction: move at several speeds"
        )
    q, a = motion.position_rad[used], motion.acceleration_radps2[used]
    if min(np.ptp(q), np.ptp(a)) > 0.0 and abs(stats.spearmanr(q, a).statistic) > _ALONG:
        untold.append(
            f"{name}: the acceleration goes with the angle, as in a single sine: gravity, or friction that depends "
            "on the position, may stand in for inertia beyond its interval: move at frequencies that differ more"
        )
    if motion.load_Nm is not None:
        terms |= {"load-scale", "load-coulomb", "load-viscous"}
    elif float(np.ptp(motion.position_rad[used])) > 0.3:
        terms |= {"gravity", "load-coulomb", "load-viscous"}
    else:
        untold.append(
            f"{name}: the angle covers {np.ptp(motion.position_rad[used]):.3g} rad: gravity cannot be separated from "
            "friction: move over 1 rad or more"
        )
    terms |= _orders_told(motion, used, both=len(words) == 2)
    if motion.temperature_degC is None:
        untold.append("temperature: not in these data: let it warm up by 15 K (of a table: --temperature-column)")
    else:
        spread = float(np.ptp(motion.temperature_degC[used]))
        if spread >= _LEAST_WARMING_K:
            terms |= {"temperature-coulomb", "temperature-viscous"}
        else:
            untold.append(f"temperature: constant within {spread:.2g} K: measure cold, and again 15 K warmer")
    return _Ground(frozenset(forms), frozenset(terms), words, tuple(untold))


def _orders_told(motion: Motion, used: np.ndarray, *, both: bool) -> set[str]:
    """Ripple and friction of the angle: orders that the motion covers, slowly enough; once a turn a load has ripple."""
    if motion.plateaus or not motion.placed:
        return set()
    span, speed = float(np.ptp(motion.position_rad[used])), np.abs(motion.velocity_radps[used])
    found = set()
    for order, count in _counts(motion).items():
        of_motor = ORDERS[order][1]
        covered = span * count / math.tau >= (_PERIODS if of_motor else _JOINT_PERIODS)
        slow = float(np.mean(speed * count < math.tau * motion.band_Hz))
        if not covered or slow < _LEAST_SLOW or (of_motor and motion.reduction_ratio < _PERIODS):
            continue
        if of_motor:  # of the joint's angle gravity and load are that
            found.add(f"ripple-{order}")
        if both:
            found.add(f"angle-{order}")
    return found


def _worth(term: str, model: Model, vector: np.ndarray, problem: _Problem) -> bool:
    """Whether an order of the angle may lower the held-out error: a linear fit to what the model leaves."""
    samples, value = problem.samples, _named(model, vector)
    assert samples.waves is not None
    kind, order = term.split("-")
    at = 2 * list(ORDERS).index(order)
    columns = samples.waves[:, at : at + 2]
    if kind == "angle":
        columns = columns * model.friction_Nm(value, samples, model.transmitted_Nm(value, samples))[:, None]
    left, after = problem.torque_Nm - model.torque_Nm(vector, samples), 0.0
    for parity in (0, 1):
        test = problem.block % 2 == parity
        weights = np.linalg.lstsq(columns[~test], left[~test], rcond=None)[0]
        after += float(np.sum((left[test] - columns[test] @ weights) ** 2))
    return float(left @ left) > _WORTH**2 * after


def _moves(model: Model, vector: np.ndarray, ground: _Ground, problem: _Problem, *, placed: bool) -> dict[str, Model]:
    """Models with one term more than `model`; `placed`: with friction that goes with the joint's angle."""
    found = {}
    for name in FORM_STEPS[model.form.name]:
        beyond = np.abs(problem.samples.velocity_radps) > model.knee * model.top_radps
        enough = min(np.count_nonzero(beyond), np.count_nonzero(~beyond)) >= 4 * MIN_PER_STAGE
        if name in ground.forms and (enough or not FORMS[name].cubic):
            found[name] = replace(model, form=FORMS[name])
    for term in [name for name in TERMS if name in ground.terms - model.terms]:
        loaded = problem.samples.load_Nm is not None or {"gravity", "inertia"} & model.terms
        if term in ("load-coulomb", "load-viscous") and not loaded:
            continue
        if term == "temperature-viscous" and not model.form.viscous:
            continue
        if term.startswith("angle-j") and not placed:
            continue
        if term.startswith(("ripple-", "angle-")) and not _worth(term, model, vector, problem):
            continue
        found[term] = replace(model, terms=model.terms | {term})
    return found


def _named(model: Model, vector: np.ndarray) -> dict[str, float]:
    return dict(zip(model.names, vector.tolist(), strict=True))


def _choose(problem: _Problem, first: Model, ground: _Ground) -> tuple[Model, np.ndarray, list[Step]]:
    """Term by term, by the held-out error; then those go that others have made useless.

    Friction that goes with the joint's angle comes last: gravity goes with the angle too, so that twice a turn it would
    stand in for friction that goes with the load.
    """
    model, vector = first, problem.fit(first, {})
    best_Nm = problem.held_out_Nm(model, _named(model, vector))
    steps = [Step("coulomb", best_Nm, True)]
    placed = False
    seen: dict[Model, float] = {}
    while True:
        start = _named(model, vector)
        moves = _moves(model, vector, ground, problem, placed=placed)
        new = {name: candidate for name, candidate in moves.items() if candidate not in seen}
        seen.update({candidate: problem.held_out_Nm(candidate, start) for candidate in new.values()})
        taken, left = None, {name: (candidate, seen[candidate]) for name, candidate in moves.items()}
        while left and taken is None:
            least_Nm = min(error for _, error in left.values())
            if least_Nm * GAIN >= best_Nm:
                break
            # of terms that serve alike the first: the simpler one
            taken = next(name for name, (_, error) in left.items() if error <= _ALIKE * least_Nm)
            found = problem.fit(left[taken][0], start)
            if _drives(left.pop(taken)[0], found):
                taken = None
        steps += [Step(name, seen[moves[name]], name == taken) for name in moves if name in new or name == taken]
        if taken is not None:
            model, best_Nm, vector = moves[taken], seen[moves[taken]], found
        elif placed:
            return _without_useless(problem, model, vector, steps)
        else:
            placed = True


def _without_useless(
    problem: _Problem, model: Model, vector: np.ndarray, steps: list[Step]
) -> tuple[Model, np.ndarray, list[Step]]:
    """The model without the terms that no longer lower the held-out error by more than 1 %, the least useful first."""
    best_Nm = min(step.held_out_rmse_Nm for step in steps if step.taken)
    while True:
        start = _named(model, vector)
        fewer = {term: replace(model, terms=model.terms - {term}) for term in sorted(model.terms - _NEEDED)}
        errors = {term: problem.held_out_Nm(candidate, start) for term, candidate in fewer.items()}
        least = min(errors, key=errors.__getitem__, default=None)
        taken = None if least is None or errors[least] >= GAIN * best_Nm else least
        steps += [Step(f"without {term}", error, term == taken) for term, error in errors.items()]
        if taken is None:
            return model, vector, steps
        model, best_Nm = fewer[taken], min(best_Nm, errors[taken])
        vector = problem.fit(model, start)


def _drives(model: Model, vector: np.ndarray) -> bool:
    """Whether the friction without load would drive the motion at some speed: a form that the data do not carry."""
    value = _named(model, vector)
    return any(
        float(basis(model.form, np.linspace(0.0, 1.0, 101), ws, model.knee).dot(beta).min()) < 0.0
        for beta, ws in (model.own(value, word) for word in model.directions)
    )


# --- intervals ---


def _resampled(model: Model, vector: np.ndarray, problem: _Problem, seed: int) -> np.ndarray:
    """Parameter vectors (resamples, p) of a bootstrap of blocks of time, each one Gauss-Newton step from the fit.

    A block is ten times as long as residuals resemble each other (the sum of their autocorrelation), and there are at
    least sixteen.  The spread is widened for the parameters that the fit has taken from the blocks.
    """
    residual = problem.torque_Nm - model.torque_Nm(vector, problem.samples)
    spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-12)
    weight = np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(residual), 1e-12))
    count = len(residual)
    length = max(1, min(int(10.0 * _correlation_samples(residual)), count // 16))
    blocks = -(-count // length)
    which = np.arange(count) // length
    size, freedom = len(vector), max(blocks - len(vector), 2)
    normal, right = np.zeros((blocks, size, size)), np.zeros((blocks, size))
    slopes = jacobian(model, vector, problem.samples)
    weighted = weight[:, None] * slopes
    for at in range(blocks):
        mine = which == at
        normal[at], right[at] = weighted[mine].T @ slopes[mine], weighted[mine].T @ residual[mine]
    scale = np.sqrt(np.maximum(np.trace(normal.sum(0)) / size, 1e-300))
    ridge = 1e-10 * scale**2 * np.eye(size)

    def shift(chosen: np.ndarray, axis: int = -1) -> np.ndarray:
        moved = np.linalg.solve(normal[chosen].sum(axis=-3) + ridge, right[chosen].sum(axis=-2)[..., None])[..., 0]
        return np.asarray(np.moveaxis(moved, -1, 0))

    drawn = stats.bootstrap(
        (np.arange(blocks),), shift, n_resamples=RESAMPLES, vectorized=True, axis=-1, method="percentile", rng=seed,
    ).bootstrap_distribution  # fmt: skip
    wider = np.sqrt(blocks / freedom) * stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)
    return np.asarray(vector + wider * (drawn - drawn.mean(axis=-1, keepdims=True)).T)


def _correlation_samples(residual: np.ndarray) -> float:
    """Sum of the autocorrelation up to where it first falls below 0.05, at least 1."""
    centred = residual - residual.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * len(centred))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(centred) // 4]
    if not len(correlation) or correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    ends = np.flatnonzero(correlation < 0.05)
    return float(max(1.0, 2.0 * np.sum(correlation[: ends[0] if len(ends) else None]) - 1.0))


def _parameters(model: Model, vector: np.ndarray, resampled: np.ndarray) -> dict[str, Parameter]:
    """Intervals in physical terms: ws instead of its logarithm, and a hint where a number is hardly known."""
    low, high = np.percentile(resampled, (50.0 - 50.0 * LEVEL, 50.0 + 50.0 * LEVEL), axis=0)
    found = {}
    for name, *ends in zip(model.names, vector.tolist(), low.tolist(), high.tolist(), strict=True):
        kind, _, word = name.partition(" ")
        if kind == "log_ws":
            kind, ends = "ws", [float(np.exp(end)) for end in ends]
        value, least, most = (end / model.top_radps for end in ends) if kind == "tv" else ends
        if kind in BOUNDS:
            least = max(least, BOUNDS[kind][0])
        weak = ""
        # a sine is judged with its cosine, by the held-out error
        if max(most - value, value - least) > _WEAK * abs(value) and kind.split("_")[0] not in ("ripple", "angle"):
            zero = least <= 0.0 <= most
            weak = (
                ("not distinguishable from 0" if zero else "hardly known") + ": " + EXPERIMENTS.get(kind, "more data")
            )
        found[f"{kind} {word}".strip()] = Parameter(value, least, most, weak)
    return found


def _untold(model: Model, motion: Motion, parameters: dict[str, Parameter]) -> list[str]:
    """What no interval shows: parameters that others stand in for."""
    found = []
    if len(model.directions) == 1 and model.terms & {"load-scale", "load-coulomb", "load-viscous"}:
        found.append(
            "load: one direction only cannot tell load friction from an error of the torque constant or of the masses: "
            "move both ways under the same loads"
        )
    if motion.load_Nm is None:
        found.append(
            f"{motion.torque_name}: its scale (the torque constant) stays unknown without a known load: all torques, "
            "the inertia and gravity scale with it: attach a known mass (of a table: --load-column)"
        )
    if not model.form.stribeck:
        found.append("Stribeck effect: not found above --speed-min: move more slowly")
    found += [f"{name}: {p.weak}" for name, p in parameters.items() if p.weak]
    return found


def _repeating(motion: Motion, used: np.ndarray, error_Nm: np.ndarray, block: np.ndarray) -> list[str]:
    """A line where the error on odd blocks is that at the same place, the same way, in even ones."""
    q = motion.position_rad[used]
    if motion.plateaus:
        return []
    place = np.minimum(((q - q.min()) / max(float(np.ptp(q)), 1e-12) * _PLACES).astype(int), _PLACES - 1)
    place = place + _PLACES * (motion.velocity_radps[used] > 0.0)
    error, odd = error_Nm[used], block[used] % 2 == 1
    count = np.bincount(place[~odd], minlength=2 * _PLACES)
    mean = np.bincount(place[~odd], error[~odd], 2 * _PLACES) / np.maximum(count, 1)
    known = odd & (count[place] > 0)
    before = np.sqrt(np.mean(error[known] ** 2)) if known.any() else 0.0
    after = np.sqrt(np.mean((error[known] - mean[place[known]]) ** 2)) if known.any() else 0.0
    if after >= _REPEATS * before:
        return []
    return [
        f"{motion.torque_name}: the residual repeats with the angle (RMSE {before:.3g} Nm, {after:.3g} Nm without what "
        "repeats): friction or ripple with other periods than are looked for, or too fast for the band, may lie in the "
        "other parameters: move slowly both ways, over several turns of the motor"
    ]


# --- the whole ---


def identify_motion(
    motion: Motion, settings: MotionSettings, *, knee_radps: float = 40.0 * DEGREE, seed: int = 1
) -> MotionFit:
    """Model, parameters, intervals, held-out error; `DataError` where the result is not friction."""
    if motion.plateaus:
        settings = replace(settings, speed_min_radps=0.5 * float(abs(motion.velocity_radps).min()))
    used = motion.used(settings)
    ground = _ground(motion, used)
    block, blocks = _blocks(motion, used, ground.words)
    stride = max(1, int(motion.rate_Hz / (SAMPLES_PER_BAND * motion.band_Hz)), -(-int(used.sum()) // MOST_SAMPLES))
    kept = np.flatnonzero(used)
    kept = kept[kept % stride == 0]
    warm = motion.temperature_degC
    reference = None if warm is None else float(np.round(np.median(warm[used]), 1))
    every = samples_of(motion, reference, settings)
    problem = _Problem(every.part(kept), motion.torque_Nm[kept], block[kept], settings.speed_min_radps)
    top = float(np.max(np.abs(motion.velocity_radps[used])))
    first = Model(FORMS["coulomb"], frozenset(), ground.words, top, min(knee_radps / top, 1.0))
    model, vector, steps = _choose(problem.coarse(), first, ground)
    vector = problem.fit(model, _named(model, vector))
    even = problem.fit(model, _named(model, vector), problem.block % 2 == 0)
    error = motion.torque_Nm - model.torque_Nm(even, every)
    resampled = _resampled(model, vector, problem, seed)
    parameters = _parameters(model, vector, resampled)
    found = MotionFit(
        motion, settings, model, vector, resampled, parameters, reference, tuple(steps), blocks, error, block,
        (*ground.untold, *_repeating(motion, used, error, block), *_untold(model, motion, parameters)), motion.notes,
    )  # fmt: skip
    _check_signs(found)
    return found


def _check_signs(found: MotionFit) -> None:
    """`DataError` where the friction drives the motion: the fit holds it at zero, what is left points along."""
    motion, model = found.motion, found.model
    left = motion.torque_Nm - model.torque_Nm(found.vector, found.samples())
    for word, each in found.branches().items():
        moving = motion.used(found.settings) & (SIGNS[word] * motion.velocity_radps > 0.0)
        against = SIGNS[word] * float(np.median(left[moving])) if moving.any() else 0.0
        least_Nm = float(each.torque_Nm(np.linspace(0.0, each.max_radps, 101)).min()) * motion.reduction_ratio
        if least_Nm < 0.0 or (least_Nm < -0.1 * against):
            raise DataError(
                f"{motion.path}: {motion.torque_name}: friction at {word} velocity would drive the motion "
                f"({min(least_Nm, against):.3g} Nm at the joint)",
                "the sign of torque or velocity is wrong (--reverse), or the load is not what the column says",
            )
