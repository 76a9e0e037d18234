"""Rigid or two-mass model of a joint, fitted to its frequency response with delay and lag of the current loop.

Both are `linear_loop`'s sampled joint, and the reducer also has hysteresis; a rigid joint is the motor's mass alone.
Least squares of the relative error of every line, weighted by its interval, with a soft loss, from several starts.  The
model with two masses is taken where the data tell it from the rigid one (Bayes' information criterion).  Intervals are
those of the linearised fit, as wide as its residuals say, and of inertias and delay what friction adds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import t as student

from jointctl.drivers.errors import DataError
from jointctl.tools.analysis.gains import Intervals
from jointctl.tools.analysis.linear_loop import TwoMasses
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.found_values import Found, rounded
from jointctl.tools.identification.friction_data import read_friction_data
from jointctl.tools.identification.identification import Identification, Options, identify_friction
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.tuning.frequency_response import (
    GOOD_COHERENCE,
    LEVEL,
    WORST_RELATIVE,
    Channel,
    ComplexArray,
    FrequencyResponse,
    ResponsePlan,
)

LEAST_RELATIVE = 0.02  # of a line: what no model describes
LEAST_LINES = 12
SOFT = 1.5  # residuals beyond so many deviations count less
DAMPING_SHARE = 0.04  # of the critical damping, where a fit begins
LOSS = 0.05  # of a spring, where a fit begins
START_RATIOS = (0.4, 1.2, 3.5)  # link over motor
START_RESONANCES_Hz = (10.0, 15.0, 20.0, 27.0, 36.0, 50.0, 70.0, 95.0, 130.0, 180.0)
START_LOW_Hz = (2.5, 3.5, 5.0, 7.0, 10.0)  # below most lines, of which a rigid joint then fits the motor alone
START_FRICTION_Nmspr, START_FRICTION_ps = 5.0, 6.0  # at most, and of a light joint so much over the inertia at most
STARTS = 3  # of them, the best ones, are followed
SLACK = 1e-5  # relative, of the search
BETTER = 10.0  # by which the criterion must be less
KNOWN_RESONANCE = 0.4  # half width of its interval over it, at most: a wider one is friction's, or none
# the same of one beyond the highest line, and how far: its flank is seen, and a law for a rigid joint would feed it
KNOWN_BEYOND, BEYOND = 0.2, 1.6
USUAL_LAG_s, LAG_SPREAD = 0.0005, 0.7  # a lag's logarithm: the data tell its sum with the delay, hardly the two apart
SHARE_SPREAD = 0.7  # of the motor's logarithm, or of link over motor: the link alone shows their sum and the resonance
LATEST_s = 0.012  # of delay and of lag, at most
# by which a value is off besides, because sliding friction is not viscous, and hysteresis no spring: of
# tests/bench/tune_ensemble.py
MODEL_SHARES = {"inertia_kgm2": 0.025, "link_kgm2": 0.025, "stiffness_Nmprad": 0.09, "resonance_Hz": 0.05}
MODEL_LATE_s = 1e-4
RIGID_SPLIT_s = 2.5e-4  # the same of delay and of lag, each by itself, where no resonance tells them apart
UNSEEN_LATE_s = 6e-4  # the same where the link's encoder is alone: there is no antiresonance to tell a loss from delay
# besides, for each rad/s^2 by which the friction over the inertia is more than `LITTLE_radps2`; `--light` there
LITTLE_radps2, MOST_radps2, FRICTION_SHARE, FRICTION_LATE_s = 5.0, 85.0, 4.5e-3, 5.5e-6
_NO_LINK = 1.0  # kg m^2 of a link that no spring holds
_VALUES = ("inertia_kgm2", "link_kgm2", "resonance_Hz", "stiffness_Nmprad", "damping_Nmspr", "friction_Nmspr",
           "delay_s", "lag_s", "late_s", "loss_factor")  # fmt: skip
_ALIASES = np.arange(-2, 3)  # of the rate, whose answers a sample holds: those beyond are less than 1e-3


@dataclass(frozen=True)
class Estimate:
    """A value with the half width of its interval of 95 %."""

    value: float
    half: float


@dataclass(frozen=True)
class JointFit:
    """What was found; all of the reducer is 0 of a rigid joint.

    `damping_Nmspr` is what the reducer loses at its resonance, to `loss_factor` as well.
    """

    flexible: bool
    values: dict[str, Estimate]
    period_s: float
    rms: float  # of the relative error over the lines that were used
    lines: int
    criterion: float  # by which the chosen model is better than the other one
    tells_link: bool = True  # False: its share of the inertia is believed, an encoder on the link alone does not see it
    friction_radps2: float = 0.0  # torque to break away over the inertia

    def __getattr__(self, name: str) -> Estimate:
        try:
            return self.__dict__["values"][name]
        except KeyError:
            raise AttributeError(name) from None

    def joint(self) -> TwoMasses:
        """As the loop's analysis takes it."""
        link = self.link_kgm2.value
        viscous = self.friction_Nmspr.value
        if not self.flexible:
            return TwoMasses(self.inertia_kgm2.value, _NO_LINK, 0.0, 0.0, (0.0, 0.0), (viscous, 0.0))
        return TwoMasses(
            self.inertia_kgm2.value - link, link, self.stiffness_Nmprad.value, self.damping_Nmspr.value, (0.0, 0.0),
            (viscous, 0.0),
        )  # fmt: skip

    def response(self, frequency_Hz: np.ndarray, side: str) -> ComplexArray:
        """Of the model, at the motor or the link."""
        joint, loss = self.joint(), self.loss_factor.value
        if self.flexible:
            lost = loss * joint.stiffness_Nmprad / (math.tau * joint.resonance_Hz)
            joint = replace(joint, damping_Nmspr=joint.damping_Nmspr - lost)
        late = (self.delay_s.value, self.lag_s.value)
        return _response(joint, loss, *late, self.period_s, frequency_Hz)[side if self.flexible else "motor"]

    def intervals(self) -> Intervals:
        """As the choice of gains takes them."""

        def share(name: str) -> float:
            return self.values[name].half / self.values[name].value

        known = Intervals(share("inertia_kgm2"), self.late_s.half, friction_radps2=self.friction_radps2)
        if not self.flexible:
            return known
        stiffness = share("stiffness_Nmprad") if self.tells_link else 2.0 * share("resonance_Hz")
        return replace(known, stiffness=stiffness, link=share("link_kgm2"), tells_link=self.tells_link)

    def beside_friction(self, break_away_Nm: float) -> JointFit:
        """Wider intervals where the friction is much for the inertia: where it slides it looks like a part of it."""
        inertia, late = self.inertia_kgm2, self.late_s
        friction_radps2 = break_away_Nm / inertia.value
        much = max(min(friction_radps2, MOST_radps2) - LITTLE_radps2, 0.0)
        wider = {
            "inertia_kgm2": replace(inertia, half=math.hypot(inertia.half, FRICTION_SHARE * much * inertia.value)),
            "late_s": replace(late, half=math.hypot(late.half, FRICTION_LATE_s * much)),
        }
        return replace(self, values={**self.values, **wider}, friction_radps2=friction_radps2)

    def to_dict(self) -> dict[str, Any]:
        return {
            "model": "two masses" if self.flexible else "rigid",
            "values": {name: {"value": one.value, "half": one.half} for name, one in self.values.items()},
            "period_s": self.period_s, "rms": self.rms, "lines": self.lines, "criterion": self.criterion,
            "tells_link": self.tells_link, "friction_radps2": self.friction_radps2,
        }  # fmt: skip


def fit_from_dict(found: dict[str, Any]) -> JointFit:
    """What `to_dict` made."""
    values = {name: Estimate(one["value"], one["half"]) for name, one in found["values"].items()}
    values.setdefault("loss_factor", Estimate(0.0, 0.0))  # of a tune that was begun before there was one
    return JointFit(
        found["model"] == "two masses", values, found["period_s"], found["rms"], found["lines"], found["criterion"],
        found.get("tells_link", True), found.get("friction_radps2", 0.0),
    )  # fmt: skip


def _response(
    joint: TwoMasses, loss: float, delay_s: float, lag_s: float, period_s: float, frequency_Hz: np.ndarray
) -> dict[str, ComplexArray]:
    """Of the sampled joint, as `sampled_joint` has it, whose spring is that of a reducer with hysteresis.

        K (f / resonance)^(loss / pi) (1 + j loss)

    It loses the same share at every frequency, and is stiffer for the smaller motion of a higher one.  In continuous
    time behind a hold, summed over the frequencies that a sample cannot tell apart.
    """
    omega = math.tau * (frequency_Hz + _ALIASES[:, None] / period_s)
    s = 1j * omega
    spring = joint.damping_Nmspr * s
    if joint.stiffness_Nmprad > 0.0:
        stiffer = np.abs(omega / (math.tau * joint.resonance_Hz)) ** (loss / math.pi)
        spring = spring + joint.stiffness_Nmprad * stiffer * (1.0 + 1j * loss * np.sign(omega))
    motor = (joint.motor_kgm2 * s + joint.bristle_damping_Nmspr[0]) * s + spring
    link = (joint.link_kgm2 * s + joint.bristle_damping_Nmspr[1]) * s + spring
    torque = np.exp(-delay_s * s) * (1.0 - np.exp(-period_s * s)) / ((1.0 + lag_s * s) * period_s * s)
    of_both = torque / (motor * link - spring * spring)
    return {"link": np.sum(of_both * spring, axis=0), "motor": np.sum(of_both * link, axis=0)}


@dataclass(frozen=True)
class _Data:
    frequency_Hz: np.ndarray
    measured: ComplexArray
    sigma: np.ndarray
    side: str


def _used(found: FrequencyResponse) -> list[_Data]:
    """Lines of either encoder that say something."""
    parts = []
    for side in ("motor", "link"):
        channel: Channel | None = getattr(found, side)
        if channel is None:
            continue
        good = (channel.half < WORST_RELATIVE) & (channel.coherence > 0.5 * GOOD_COHERENCE)
        sigma = np.hypot(0.5 * channel.half[good], LEAST_RELATIVE)
        parts.append(_Data(found.frequency_Hz[good], channel.response[good], sigma, side))
    if sum(len(part.sigma) for part in parts) < LEAST_LINES:
        lines = sum(len(part.sigma) for part in parts)
        raise DataError(
            f"lines with coherence (={lines}) must be at least {LEAST_LINES} for a model of the joint",
            "more torque (--torque), or a longer response (--legs)",
        )
    return parts


class _Model:
    """Parameters, logarithms but for B and loss: (J, delay, lag, B), and (link / motor, resonance, damping, loss).

    The loss is that of hysteresis: as damping alone it would look like delay.
    """

    def __init__(self, parts: list[_Data], period_s: float, flexible: bool, motor_kgm2: float | None) -> None:
        self.parts, self.period_s, self.flexible = parts, period_s, flexible
        self.count = 2 * sum(len(part.sigma) for part in parts)
        self.motor_kgm2 = motor_kgm2
        self.tells_link = not flexible or any(part.side == "motor" for part in parts)

    def joint(self, x: np.ndarray) -> TwoMasses:
        inertia, viscous = math.exp(x[0]), x[3]
        if not self.flexible:
            return TwoMasses(inertia, _NO_LINK, 0.0, 0.0, (0.0, 0.0), (viscous, 0.0))
        ratio = math.exp(x[4])
        motor, link = inertia / (1.0 + ratio), inertia * ratio / (1.0 + ratio)
        reduced = motor * link / inertia
        omega = math.tau * math.exp(x[5])
        damping = 2.0 * math.exp(x[6]) * omega * reduced
        return TwoMasses(motor, link, omega * omega * reduced, damping, (0.0, 0.0), (viscous, 0.0))

    def loss(self, x: np.ndarray) -> float:
        return float(x[7]) if self.flexible else 0.0

    def believed(self, x: np.ndarray) -> NDArray[np.float64]:
        """Residuals of what is known beforehand of values that the data hardly tell."""
        rows = [(x[2] - math.log(USUAL_LAG_s)) / LAG_SPREAD]
        if not self.tells_link:
            motor_kgm2 = self.joint(x).motor_kgm2
            off = x[4] if self.motor_kgm2 is None else math.log(motor_kgm2 / self.motor_kgm2)
            rows.append(off / SHARE_SPREAD)
        return np.array(rows)

    def residuals(self, x: np.ndarray) -> NDArray[np.float64]:
        joint, late = self.joint(x), (math.exp(x[1]), math.exp(x[2]))
        rows = [self.believed(x)]
        for part in self.parts:
            side = part.side if self.flexible else "motor"
            model = _response(joint, self.loss(x), *late, self.period_s, part.frequency_Hz)[side]
            off = np.log(model / part.measured) / part.sigma
            rows += [off.real, off.imag]
        return np.concatenate(rows)

    def fitted(self, start: list[float]) -> OptimizeResult:
        low = [-12.0, math.log(1e-5), math.log(1e-5), -1e3]
        high = [12.0, math.log(LATEST_s), math.log(LATEST_s), 1e4]
        if self.flexible:
            low = [*low, math.log(0.02), math.log(2.0), math.log(1e-3), 0.0]
            high = [*high, math.log(50.0), 8.0, 0.0, 1.0]
        return least_squares(
            self.residuals, start, bounds=(low, high), loss="soft_l1", f_scale=SOFT,
            x_scale=[1.0, 1.0, 1.0, 10.0] + [1.0, 1.0, 1.0, 0.1] * self.flexible, max_nfev=60, ftol=SLACK, xtol=SLACK,
        )  # fmt: skip

    def criterion(self, found: OptimizeResult) -> float:
        """Bayes' information criterion of a soft loss, in units of its own noise."""
        return self.count * math.log(2.0 * found.cost / self.count) + len(found.x) * math.log(self.count)

    def named(self, x: np.ndarray) -> np.ndarray:
        """The values of `_VALUES`."""
        joint, delay, lag = self.joint(x), math.exp(x[1]), math.exp(x[2])
        if self.flexible:
            whole = joint.motor_kgm2 + joint.link_kgm2
            damping = joint.damping_Nmspr + self.loss(x) * joint.stiffness_Nmprad / (math.tau * joint.resonance_Hz)
            parts = [whole, joint.link_kgm2, joint.resonance_Hz, joint.stiffness_Nmprad, damping]
        else:
            parts = [joint.motor_kgm2, 0.0, 0.0, 0.0, 0.0]
        return np.array([*parts, x[3], delay, lag, delay + lag, self.loss(x)])


def fit_of(found: FrequencyResponse, config: Config, break_away_Nm: float) -> JointFit:
    """`fit_joint` with what the file believes in, and the intervals that its friction leaves."""
    motor_kgm2 = None if config.reducer is None else config.reducer.motor_inertia_kgm2
    return fit_joint(found, config.joint.inertia_kgm2, motor_kgm2).beside_friction(break_away_Nm)


def fit_joint(found: FrequencyResponse, inertia_kgm2: float, motor_kgm2: float | None = None) -> JointFit:
    """The model that the data choose; `inertia_kgm2` is where the search begins.  `DataError` with too few lines.

    Where only the link was measured, whose response does not tell it, the motor is believed to have about `motor_kgm2`,
    or half of what is found.
    """
    parts = _used(found)
    viscous_Nmspr = min(START_FRICTION_Nmspr, START_FRICTION_ps * inertia_kgm2)
    begin = [math.log(inertia_kgm2), math.log(0.0015), math.log(0.0005), viscous_Nmspr]
    rigid = _Model(parts, found.period_s, False, motor_kgm2)
    one = min((rigid.fitted([begin[0] + step, *begin[1:]]) for step in (-0.5, 0.5)), key=lambda fit: fit.cost)
    soft = _Model(parts, found.period_s, True, motor_kgm2)
    inertia = float(np.clip(one.x[0], -3.0 + begin[0], 3.0 + begin[0]))
    starts = [
        [inertia + behind, *begin[1:], math.log(ratio), math.log(resonance), math.log(DAMPING_SHARE), LOSS]
        for ratio in START_RATIOS
        for resonances, behind in ((START_RESONANCES_Hz, 0.0), (START_LOW_Hz, math.log(1.0 + ratio)))
        for resonance in resonances
    ]
    starts.sort(key=lambda start: float(np.sum(np.abs(soft.residuals(np.array(start))))))
    two = min((soft.fitted(start) for start in starts[:STARTS]), key=lambda fit: fit.cost)
    better = rigid.criterion(one) - soft.criterion(two)
    highest = max(float(part.frequency_Hz[-1]) for part in parts)
    values, resonance_Hz = _intervals(soft, two), soft.joint(two.x).resonance_Hz
    beyond = resonance_Hz >= highest
    known = values["resonance_Hz"].half <= (KNOWN_BEYOND if beyond else KNOWN_RESONANCE) * resonance_Hz
    flexible = better > BETTER and known and resonance_Hz < BEYOND * highest
    model, best = (soft, two) if flexible else (rigid, one)
    values = values if flexible else _intervals(rigid, one)
    relative = [part.sigma for part in parts]
    measured = model.residuals(best.x)[len(model.believed(best.x)) :]
    weighted = measured * np.concatenate([np.concatenate((s, s)) for s in relative])
    return JointFit(
        flexible, values, found.period_s, float(np.sqrt(np.mean(weighted**2))), model.count // 2,
        abs(better), model.tells_link,
    )  # fmt: skip


def fitted_again(found: FrequencyResponse, before: JointFit) -> Estimate:
    """The inertia by another response of a joint whose model is known: one search, which begins there."""
    joint = before.joint()
    model = _Model(_used(found), found.period_s, before.flexible, joint.motor_kgm2)
    late = [math.log(max(before.values[name].value, 2e-5)) for name in ("delay_s", "lag_s")]
    start = [math.log(before.inertia_kgm2.value), *late, before.friction_Nmspr.value]
    if before.flexible:
        loss = min(before.loss_factor.value, 0.99)
        damping = 0.5 * (joint.damping_Nmspr * math.tau * joint.resonance_Hz / joint.stiffness_Nmprad - loss)
        start += [math.log(joint.link_kgm2 / joint.motor_kgm2), math.log(joint.resonance_Hz)]
        start += [math.log(min(max(damping, 2e-3), 0.9)), loss]
    return _intervals(model, model.fitted(start))["inertia_kgm2"]


def _intervals(model: _Model, best: OptimizeResult) -> dict[str, Estimate]:
    free = max(model.count - len(best.x), 1)
    residuals = model.residuals(best.x)
    # of the bulk: what the soft loss leaves aside is no noise of the fit
    scale = max(1.4826 * float(np.median(np.abs(residuals))), 0.5) ** 2
    cov = np.linalg.pinv(best.jac.T @ best.jac) * scale
    width = float(student.ppf(0.5 + 0.5 * LEVEL, free))
    centre = model.named(best.x)
    slopes = np.empty((len(centre), len(best.x)))
    for k in range(len(best.x)):
        step = np.zeros(len(best.x))
        step[k] = 1e-4
        slopes[:, k] = (model.named(best.x + step) - model.named(best.x - step)) / 2e-4
    half = width * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, cov, slopes), 0.0))
    found = {}
    for name, value, own in zip(_VALUES, centre, half, strict=True):
        late_s = MODEL_LATE_s if model.tells_link else UNSEEN_LATE_s
        besides = late_s if name in ("delay_s", "lag_s", "late_s") else MODEL_SHARES.get(name, 0.0) * value
        if name in ("delay_s", "lag_s") and not model.flexible:
            besides = max(besides, RIGID_SPLIT_s)
        found[name] = Estimate(float(value), math.hypot(own, besides))
    return found


# Gravity of a joint from a motion back and forth at constant speed: what the torque has in common in both directions.
#
#     torque = F+ or F- by direction + a sin q + b cos q,    gravity_Nm sin(q - gravity_zero_rad) = a sin q + b cos q
#
# The friction of a direction is a constant, because the legs of the motion hardly differ in speed; what it does besides
# is noise.  Neighbouring samples are alike, so that the interval counts a sample for each turn of the ripple.

LEAST_SHARE = 0.025  # of the friction: less is no gravity
SURE = 4.0  # standard errors
BLOCK_rad = 0.1  # of the way, one independent value each
LEAST_WAY_rad = 0.3  # a shorter one does not tell gravity from friction that goes with the angle


@dataclass(frozen=True)
class Gravity:
    """Amplitude with its interval, angle without lever; `found` where it is more than friction may look like."""

    torque_Nm: float
    half_Nm: float
    zero_rad: float
    sliding_Nm: tuple[float, float]  # friction of the positive and of the negative direction, with its sign

    @property
    def found(self) -> bool:
        friction_Nm = 0.5 * (self.sliding_Nm[0] - self.sliding_Nm[1])
        return abs(self.torque_Nm) > max(LEAST_SHARE * friction_Nm, 0.5 * SURE * self.half_Nm)


def gravity_of(plan: ResponsePlan, records: Any, period_s: float, zero_rad: float) -> Gravity:
    """Of the legs of a frequency response, whose multisine has no mean over its period.

    Over the way of a joint the cosine hardly differs from the friction's asymmetry: where it is not sure, the angle
    without lever is the configured `zero_rad`.
    """
    cycle = np.round(np.asarray(records.trajectory_s) / period_s).astype(int)
    position, torque, sides, ways, held = [], [], [], [], []
    for start in plan.legs.starts:
        first, last = np.searchsorted(cycle, (start, start + plan.samples))
        rows = records[first:last]
        if len(rows) < 0.99 * plan.samples:
            continue
        way = abs(float(rows.position_rad[-1] - rows.position_rad[0]))
        ways.append(way)
        excitation = plan.peak_Nm * plan.sine.wave[np.asarray(cycle[first:last]) % plan.samples]
        for part in np.array_split(np.arange(len(rows)), max(round(way / BLOCK_rad), 2)):
            position.append(float(np.mean(rows.position_rad[part])))
            torque.append(float(np.mean(rows.command_torque_Nm[part] - excitation[part])))
            held.append(float(np.mean(rows.gravity_torque_Nm[part])))
            sides.append(math.copysign(1.0, rows.desired_velocity_radps[part[0]]))
    angle, side = np.array(position) - zero_rad, np.array(sides)
    constant = np.column_stack((side > 0.0, side < 0.0)).astype(float)
    if max(ways, default=0.0) < LEAST_WAY_rad:
        sliding, _ = _fitted(constant, np.array(torque) - np.array(held))
        return Gravity(0.0, 0.0, zero_rad, (float(sliding[0]), float(sliding[1])))
    both, spread = _fitted(np.column_stack((constant, np.sin(angle), np.cos(angle))), np.array(torque))
    if abs(both[3]) > SURE * spread[3]:
        size = math.hypot(both[2], both[3])
        zero_rad += math.atan2(-both[3], both[2])
        return Gravity(size, 2.0 * float(np.max(spread[2:])), zero_rad, (float(both[0]), float(both[1])))
    one, spread = _fitted(np.column_stack((constant, np.sin(angle))), np.array(torque))
    return Gravity(float(one[2]), 2.0 * float(spread[2]), zero_rad, (float(one[0]), float(one[1])))


def _fitted(columns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(least squares, standard errors)."""
    found, *_ = np.linalg.lstsq(columns, values, rcond=None)
    left = values - columns @ found
    variance = float(left @ left) / max(len(values) - columns.shape[1], 1)
    return found, np.sqrt(variance * np.diag(np.linalg.pinv(columns.T @ columns)))


# --- Friction, of the plateaus ---

SWARM = SwarmSettings(particles=300, iterations=1500)
PLACES = 1.05  # of the friction where the joint began to move: it is another one at each place
SLOW = 2.0  # times the lowest speed: the static friction is no less than what those plateaus took


def friction_of(path: Path, moved_Nm: float, reduction_ratio: float) -> Identification:
    """Of the plateaus in that file; `moved_Nm` at the joint has moved it to either side from standstill.

    Where the slow plateaus are left out, since a light joint swings there between sticking and sliding, the static
    friction is continued from the faster ones, and may come out twice as large: it is no more than that torque.
    """
    data, options = read_friction_data(path, None), Options(swarm=SWARM)
    found, speeds = identify_friction(data, options), np.abs(data.velocity_radps)
    slow_Nm = np.abs(data.motor_torque_Nm[speeds <= SLOW * np.min(speeds)])
    most_Nm = max(PLACES * moved_Nm / reduction_ratio, float(np.max(slow_Nm)))
    if most_Nm < max(branch.static_Nm for branch in found.branches.values()):
        return identify_friction(data, replace(options, static_max_Nm=most_Nm))
    return found


# --- The fit as values of a configuration ---

SMALL_MOTION = 1.6  # stiffness of a small motion over that under a steady torque: hysteresis, 1.4 to 1.84
CRITICAL_SHARE = 0.04  # of the critical damping: what is more is hysteresis, which a small motion does not have


def values_of_fit(config: Config, fit: JointFit, source: str) -> list[Found]:
    """Inertia, delay, lag, and of a soft reducer its inertias, stiffness and damping."""

    def found(section: str, key: str, one: Estimate) -> Found:
        number = rounded(max(one.value, 0.0))
        return Found((section,), key, number, f"{number:g} +- {one.half:.2g}, {source}")

    values = [
        found("joint", "inertia_kgm2", fit.inertia_kgm2),
        found("margin", "loop_delay_s", fit.delay_s),
        found("margin", "current_lag_s", fit.lag_s),
    ]
    if not fit.flexible:
        return values
    joint = fit.joint()
    of_both = math.hypot(fit.inertia_kgm2.half, fit.link_kgm2.half)  # the motor's is the difference
    values.append(found("reducer", "motor_inertia_kgm2", Estimate(joint.motor_kgm2, of_both)))
    if not fit.tells_link:
        remark = f"{joint.motor_kgm2:.3g}, a share that the encoder on the link does not tell"
        values[-1] = replace(values[-1], source=remark)
    values.append(found("reducer", "loop_stiffness_Nmprad", fit.stiffness_Nmprad))
    if config.reducer is None:
        steady = rounded(fit.stiffness_Nmprad.value / SMALL_MOTION)
        remark = f"{steady:g}, loop_stiffness_Nmprad / {SMALL_MOTION:g}: not measured"
        values.append(Found(("reducer",), "stiffness_Nmprad", steady, remark))
    values.append(found("reducer", "damping_Nmspr", fit.damping_Nmspr))
    most = CRITICAL_SHARE * joint.critical_Nmspr
    if joint.damping_Nmspr > most:
        remark = f"{rounded(most):g}, {CRITICAL_SHARE * 100.0:g} % of the critical damping: more is hysteresis; found: "
        values[-1] = replace(values[-1], value=rounded(most), source=remark + values[-1].source)
    return values


def values_of_gravity(kept: Mapping[str, Any]) -> list[Found]:
    """Of `Gravity` as JSON holds it, with `found`: amplitude and angle without lever, where it is certain."""
    if not kept["found"]:
        return []
    torque, zero = rounded(kept["torque_Nm"]), rounded(kept["zero_rad"])
    return [
        Found(("joint",), "gravity_Nm", torque, f"{torque:g} +- {kept['half_Nm']:.2g}, 95 %, legs of the response"),
        Found(("joint",), "gravity_zero_rad", zero, f"{zero:g}, legs of the response"),
    ]
