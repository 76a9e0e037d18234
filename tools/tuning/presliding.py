"""Presliding: how stiff the bristles of friction are, from a rigid joint that stands under less torque than moves it.

A soft spring holds the joint, as `inspection/motion_check.py` does, and its reference goes to and fro, so that the
torque is a slow triangle below what breaks away; then it drags the joint a little further.  In LuGre
(`firmware_py/friction.py`) the bristles of a joint that hardly moves bend by

    dq = dT / sigma0 / (1 - T / F)      T away from zero, F the static friction of that direction
    dq = dT / sigma0 / (1 + |T| / F)    T towards zero

so that the position is the compliance 1 / sigma0 times a known function of the torque, hysteresis included.  An encoder
shows counts of it.  Where the joint came to stand within a count is another for each place and not known: the
likelihood is averaged over it, which makes use of every count that changes, and of those that do not.  Noise of the
encoder is found from the spread of the counts.

Not modelled: inertia and damping of the bristles, which a motion of seconds does not show; torque ripple, which is
the same throughout a place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import text_Nm, text_radps
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.analysis.margin_gate import passes
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import (
    law_resolution_rad,
    period_s,
    static_friction_Nm,
    static_frictions_Nm,
)
from jointctl.tools.configuration.found_values import Found, rounded
from jointctl.tools.configuration.records import APPROACH_MIN_S, table_constants
from jointctl.tools.session.fault_words import ended_by
from jointctl.tools.session.plan import Placed, joint_lines, remark_lines
from jointctl.tools.tuning.carry_out import Carrier
from jointctl.tools.tuning.frequency_response import motor_fed, room_rad

Array = NDArray[np.float64]

# --- The motion ---

STRETCHES_rad = (0.06, 0.04, 0.09, 0.13)  # of the spring at the static friction: the first that the gate allows
COARSEST_COUNT = 0.01  # of the stretch: a reading stands within four counts, and the places are to be farther apart
SLOWEST_radps = 6.0  # of that spring with the joint's inertia: it must be quicker than what follows
DAMPING = 0.7
CUTOFF_OVER_LOOP = 4.0  # of the velocity: a count of a coarse encoder must not kick the joint
TORQUE_SHARE = 1.6  # of the static friction, which the motion may take
AMPLITUDE = 0.6  # of the triangle, of the static friction
PLACES = 30
MIDDLE, NEAREST, FARTHEST = 1.2, 0.35, 0.55  # stretches: from the start to the middle of the places, from there to each
REACH = 3.0  # stretches, which the motion takes
MOST_OF_ROOM = 0.5
STEP_s, DRAG_s, REST_s, RAMP_s = 0.002, 0.4, 0.25, 0.45
SIDES = (-1.0, 1.0, -1.0, 1.0)  # of the triangle, in the direction in which it was dragged
FROZEN_STRETCHES = 2.6  # way of the reference past a reading that stands, until the joint breaks away to the other side
FOLLOWS_STRETCHES = 2.5
LEAST_REST, MOST_REST = 0.3, 0.95  # of the static friction: a joint that was dragged holds the sliding one
SEED = 1


@dataclass(frozen=True)
class PreslidingMotion:
    """See `session.plan.Motion`; `config` has the spring."""

    config: Config
    static_Nm: float
    stretch_rad: float
    rests_at: tuple[float, float]  # of the static friction: where the joint comes to rest, dragged to either side

    @property
    def seconds(self) -> float:
        return float(self.table[-1, 0])

    @property
    def table(self) -> np.ndarray:
        """From zero, to positive first."""
        return self._table(0.0, 1.0)[0]

    @property
    def windows_s(self) -> Array:
        """Begin and end of the triangle of each place, shape (PLACES, 2)."""
        return self._table(0.0, 1.0)[1]

    def _table(self, start_rad: float, first: float) -> tuple[np.ndarray, Array]:
        """The reference from there, in this direction first, and the windows."""
        random = np.random.default_rng(SEED)
        times_s, places, windows, base = [0.0], [start_rad], [], start_rad

        def go(seconds: float, to_rad: float) -> None:
            times_s.append(times_s[-1] + seconds)
            places.append(to_rad)

        stretch_rad, middle_rad = self.stretch_rad, start_rad + first * MIDDLE * self.stretch_rad
        for k in range(PLACES):
            side = first if k % 2 == 0 else -first
            base = middle_rad + side * random.uniform(NEAREST, FARTHEST) * stretch_rad
            go(DRAG_s, base + side * self.rests_at[0 if side > 0.0 else 1] * stretch_rad)
            go(REST_s, places[-1])
            windows.append((times_s[-1], times_s[-1] + len(SIDES) * RAMP_s))
            for way in SIDES:
                go(RAMP_s, base + way * side * AMPLITUDE * stretch_rad)
        go(REST_s, base)
        # in small steps without speed, which the damping of the spring would take for torque
        steps_s = np.arange(0.0, times_s[-1], STEP_s)
        table = np.zeros((len(steps_s) + 1, 5))
        table[:-1, 0], table[:-1, 1] = steps_s, np.interp(steps_s, times_s, places)
        table[-1, :2] = times_s[-1], places[-1]
        return table, np.array(windows)

    def placed(self, report: CommissioningReport) -> Placed:
        """From where the joint stands, towards the middle of its travel first."""
        config, limits, start_rad = self.config, self.config.limits, report.start_position_rad
        first = 1.0 if start_rad < 0.5 * (limits.position_min_rad + limits.position_max_rad) else -1.0
        table, _ = self._table(start_rad, first)
        at_once = config.changed(sequence__approach_s=APPROACH_MIN_S)
        constants = table_constants(at_once, table, float(table[-1, 0]), start_rad)
        axis = constants[0]
        axis.limits.frozen_max_rad, axis.limits.frozen_ahead_rad = FROZEN_STRETCHES * self.stretch_rad, 0.0
        axis.limits.swing.hunting_rad = 0.0  # the spring pushes it to and fro on purpose
        way_rad = first * REACH * self.stretch_rad
        lines = [
            *joint_lines(report, limits),
            f"motion     a soft spring pushes the joint to and fro with {text_Nm(AMPLITUDE * self.static_Nm, 2)}, "
            f"while it stands, at places from {start_rad:+.3f} to {start_rad + way_rad:+.3f} rad, {self.seconds:.0f} s",
            f"limits     {text_Nm(limits.torque_max_Nm)}, {text_radps(limits.velocity_max_radps)}",
            *remark_lines(report.remarks),
        ]
        return Placed(constants, table, tuple(lines))

    def require_start(self, start_position_rad: float) -> None:
        """Nothing: it goes towards the middle, from anywhere within the limits."""


def presliding_motion(config: Config) -> PreslidingMotion | None:
    """For a rigid joint whose friction is known; None where the travel is too short, or no spring keeps the margin."""
    static_Nm, limits = static_friction_Nm(config) or 0.0, config.limits
    if config.friction is None or min(static_frictions_Nm(config, config.friction)) == 0.0:
        return None
    sides = (config.friction.positive, config.friction.negative)
    rests_at = [min(max(abs(one.tc_Nm / one.ts_Nm), LEAST_REST), MOST_REST) for one in sides]
    heavy_rad = static_Nm / config.joint.inertia_kgm2 / SLOWEST_radps**2
    for stretch_rad in dict.fromkeys(min(stretch_rad, heavy_rad) for stretch_rad in STRETCHES_rad):
        if REACH * stretch_rad > MOST_OF_ROOM * room_rad(config):
            continue
        if law_resolution_rad(config) > COARSEST_COUNT * stretch_rad:
            continue
        kp_ps2 = static_Nm / stretch_rad / config.joint.inertia_kgm2
        loop_radps = math.sqrt(kp_ps2)
        control: dict[str, Any] = {
            "kind": "computed_torque", "kp": kp_ps2, "kv": 2.0 * DAMPING * loop_radps, "feed_forward": "none",
            "learning": None, "adaptation": None, "observer_paired": False, "velocity_filter": "low_pass",
            "filtered_error_rate": False, "velocity_cutoff_Hz": CUTOFF_OVER_LOOP * loop_radps / math.tau,
        }  # fmt: skip
        most_Nm = min(TORQUE_SHARE * static_Nm + abs(config.joint.gravity_Nm), limits.torque_max_Nm)
        spring = motor_fed(config).changed(
            limits={"torque_max_Nm": most_Nm, "following_error_max_rad": FOLLOWS_STRETCHES * stretch_rad},
            control=control, drive=config.drive.free_of_torque_limit(),
        )  # fmt: skip
        if passes(spring):
            return PreslidingMotion(spring, static_Nm, stretch_rad, (rests_at[0], rests_at[1]))
    return None


# --- From torque and counts to the stiffness ---

BIN_s = 0.025  # over which torque and counts are averaged
STANDS, STANDS_AGAIN = 0.75, 0.5  # of the static friction: above, a joint may have begun to slide
LEAST_BINS = 16
OFFSET, FINEST, COARSEST = 0.75, 0.002, 0.05  # counts, of the place within a count: farthest, and steps
INDEPENDENT_s = 0.2  # of what the model misses: so far apart two readings do
LEAST_MISSED = 0.1  # counts: the model is not that good
EDGE_BINS = 0.3  # of what it moves in a bin: a change of the count within one is no noise
COARSE = np.concatenate(([0.0], np.geomspace(1e-6, 2e-2, 50)))  # bend of the bristles at the static friction [rad]
FINE = 61
INTERVAL = 0.5 * 3.84  # of the logarithm of the likelihood, 95 %
MODEL_SHARE = 0.15  # by which the stiffness may be wrong besides
EDGE_SHARE = 0.15  # and where a count without noise is more than the bend: the spring's torque jumps at its edge
NOISE_THAT_HELPS = 0.1  # counts
LEAST_STRETCHES = 10
SLIPPED = 1.0  # counts, of what the model misses
MOST_NOISE = 2.0  # counts, beyond which the mean of readings follows the angle to 1e-8 of a count
_TABLE = 2048  # of a count


@dataclass(frozen=True)
class Bristles:
    """Stiffness at the joint with its interval, 95 %; value and upper end are infinite where no bend was seen."""

    stiffness_Nmprad: float
    least_Nmprad: float
    most_Nmprad: float


@dataclass(frozen=True)
class Stretch:
    """A time in which the joint stood: means over bins, shape (N,)."""

    bend: Array  # [Nm] of a position that is the compliance times this
    counts: Array


def bend_Nm(torque_Nm: Array, positive_Nm: float, negative_Nm: float) -> Array:
    """The position over the compliance, from 0: torque (N,), static frictions of either direction, both positive."""
    change, middle = np.diff(torque_Nm), 0.5 * (torque_Nm[1:] + torque_Nm[:-1])
    left = np.where(change > 0.0, 1.0 - middle / positive_Nm, 1.0 + middle / negative_Nm)
    return np.concatenate(([0.0], np.cumsum(change / np.maximum(left, 0.05))))


def stretches_of(
    torque_Nm: Array, counts: Array, friction_Nm: tuple[float, float], period_s: float
) -> tuple[list[Stretch], Array]:
    """Of one place, and the variance of the counts within each bin; torque and reading of each cycle, shape (N,)."""
    length = max(round(BIN_s / period_s), 2)
    bins = len(torque_Nm) // length
    torque = torque_Nm[: bins * length].reshape(bins, length).mean(axis=1)
    readings = counts[: bins * length].reshape(bins, length)
    share = np.where(torque > 0.0, torque / friction_Nm[0], -torque / friction_Nm[1])
    found, begin = list[Stretch](), -1
    for i in range(bins + 1):
        if begin >= 0 and (i == bins or share[i] > STANDS):
            if i - begin >= LEAST_BINS:
                bend = bend_Nm(torque[begin:i], *friction_Nm)
                found.append(Stretch(bend - np.mean(bend), readings[begin:i].mean(axis=1)))
            begin = -1
        elif begin < 0 and i < bins and share[i] < STANDS_AGAIN:
            begin = i
    return found, readings.var(axis=1, ddof=1)


def _mean_reading(noise_counts: float) -> Array:
    """Of an angle of 0 .. 1 counts, `_TABLE` + 1 of them, less that angle."""
    angle, sigma = np.linspace(0.0, 1.0, _TABLE + 1), min(max(noise_counts, 1e-6), MOST_NOISE)
    reach = math.ceil(5.0 * sigma) + 1
    edges = np.arange(-reach, reach + 1) + 0.5
    return np.asarray(ndtr((angle[:, None] - edges) / sigma).sum(axis=1) - reach - angle)


def noise_of(variance: float) -> float:
    """Noise [counts] of readings with that variance at a place that is random within a count."""
    sizes = np.linspace(0.0, MOST_NOISE, 101)
    # rounding a noisy reading: variance of noise and of a count, less what the mean makes of the place
    of_sizes = [size * size + 1.0 / 12.0 - float(np.mean(_mean_reading(size)[:-1] ** 2)) for size in sizes]
    return float(np.interp(variance, of_sizes, sizes))


def _missed(stretches: list[Stretch], compliance: float, noise_counts: float) -> list[Array]:
    """Mean squares [counts^2] of what the model misses, of each place over offsets; `compliance` in counts per Nm."""
    moves = compliance * float(np.mean([np.mean(np.abs(np.diff(one.bend))) for one in stretches]))
    noise_counts = math.hypot(noise_counts, EDGE_BINS * moves)
    table, step = _mean_reading(noise_counts), min(max(0.5 * noise_counts, FINEST), COARSEST)
    offsets = np.linspace(-OFFSET, OFFSET, 2 * round(OFFSET / step) + 1)
    missed = []
    for one in stretches:
        angle = compliance * one.bend + (np.mean(one.counts) + offsets)[:, None]
        part = np.asarray((angle - np.floor(angle)) * _TABLE, dtype=np.int32)
        missed.append(np.mean((one.counts - angle - table[part]) ** 2, axis=1))
    return missed


def _likelihoods(stretches: list[Stretch], counts_pNm: Array, noise_counts: float) -> tuple[Array, Array]:
    """Logarithm of all places, and the mean square [counts^2] of what is missed at their best, of each compliance."""
    missed = [_missed(stretches, float(compliance), noise_counts) for compliance in counts_pNm]
    least = np.array([np.mean([np.min(one) for one in places]) for places in missed])
    independent = [0.5 * len(one.counts) * BIN_s / INDEPENDENT_s for one in stretches]
    size2, total = LEAST_MISSED**2, np.zeros(len(missed))
    for _ in range(3):
        for k, places in enumerate(missed):
            shares = [np.mean(np.exp(-n * one / size2)) for n, one in zip(independent, places, strict=True)]
            total[k] = np.sum(np.log(np.array(shares) + 1e-300))
        size2 = max(LEAST_MISSED**2, float(least[np.argmax(total)]))
    return total, least


def fit_bristles(
    stretches: list[Stretch], static_Nm: float, resolution_rad: float, noise_counts: float
) -> Bristles | None:
    """None where the joint stood too seldom, or slipped by more than its most likely bristles bend."""
    if len(stretches) < LEAST_STRETCHES:
        return None

    def likely(bends: Array) -> tuple[int, int, int, float]:
        """Indices of the most likely one and of the ends of the interval, and the mean square that it misses."""
        total, missed = _likelihoods(stretches, bends / (static_Nm * resolution_rad), noise_counts)
        allowed, best = np.flatnonzero(total > np.max(total) - INTERVAL), int(np.argmax(total))
        return best, int(allowed[0]), int(allowed[-1]), float(missed[best])

    _, low, high, _ = likely(COARSE)
    bends = np.linspace(COARSE[max(low - 1, 0)], COARSE[min(high + 1, len(COARSE) - 1)], FINE)
    best, low, high, missed = likely(bends)
    compliance = float(bends[best]) / (static_Nm * resolution_rad)
    if missed > max(SLIPPED**2, np.mean([np.var(compliance * one.bend) for one in stretches])):
        return None
    quiet = max(1.0 - noise_counts / NOISE_THAT_HELPS, 0.0)
    wider = 1.0 + MODEL_SHARE + EDGE_SHARE * quiet * resolution_rad / max(bends[best], 0.2 * resolution_rad)
    least, most = (float(static_Nm / bends[k]) if bends[k] > 0.0 else math.inf for k in (high, low))
    value = float(static_Nm / bends[best]) if bends[best] > 0.0 and math.isfinite(most) else math.inf
    return Bristles(value, float(least / wider), float(most * wider))


def bristles_of(motion: PreslidingMotion, records: np.recarray, friction_Nm: tuple[float, float]) -> Bristles | None:
    """`friction_Nm`: the static one of either direction at the joint, both positive."""
    rows: Any = records[records.phase == AxisPhase.TRACKING]
    time_s, resolution_rad = np.asarray(rows.trajectory_s), law_resolution_rad(motion.config)
    torque = np.asarray(rows.command_torque_Nm - rows.gravity_torque_Nm)
    counts = np.asarray(rows.position_rad) / resolution_rad
    counts = np.round(counts - counts[:1]) if len(counts) else counts  # a zero of the counts may lie between two
    found, variances = list[Stretch](), list[Array]()
    for begin_s, end_s in motion.windows_s:
        inside = slice(*np.searchsorted(time_s, (begin_s, end_s)))
        stretches, variance = stretches_of(torque[inside], counts[inside], friction_Nm, period_s(motion.config))
        found += stretches
        variances.append(variance)
    if not found:
        return None
    noise = noise_of(float(np.mean(np.concatenate(variances))))
    return fit_bristles(found, 0.5 * sum(friction_Nm), resolution_rad, noise)


# --- The step of a tune, and what it writes ---

QUARTER = 0.25  # of a count, by which bristles bend at the static friction: stiffer ones end moves worse
SPRINGS = (Fault.LIMIT_CYCLE, Fault.VELOCITY_LIMIT)  # of a joint that breaks loose from the spring
DAMPING_RATIO = 0.24  # of the bristles with the joint's inertia: that of the shipped configurations


def measured_bristles(config: Config, carrier: Carrier) -> dict[str, Any]:
    """As JSON holds it: their interval (None: without an end) and the values for the file, or `why` there are none.

    The joint is rigid and its friction known; faults as `Carrier.run` has them.
    """
    motion = presliding_motion(config)
    if motion is None or config.friction is None:
        return {"why": "the travel is too short, the encoder too coarse, or no spring keeps the margin"}
    carried = carrier.run(motion.config, motion, "bristles", also_faults=SPRINGS)
    if carried.text is not None:
        if carried.log:
            carrier.output.note(f"log: {carried.log}")
        return {"why": ended_by(carried.fault, carried.text).message}
    frictions_Nm = static_frictions_Nm(config, config.friction)
    found = bristles_of(motion, carried.records, frictions_Nm)
    if found is None:
        return {"why": f"the joint stood less than {LEAST_STRETCHES} times, or slipped"}
    seen = math.isfinite(found.stiffness_Nmprad)
    finest_Nmprad = 0.5 * sum(frictions_Nm) / (QUARTER * law_resolution_rad(config))
    stiffness_Nmprad = min(found.stiffness_Nmprad if seen else found.least_Nmprad, finest_Nmprad)
    damping_Nmspr = 2.0 * DAMPING_RATIO * math.sqrt(stiffness_Nmprad * config.joint.inertia_kgm2)
    return {
        "stiffness_Nmprad": rounded(stiffness_Nmprad), "damping_Nmspr": rounded(damping_Nmspr),
        "found_Nmprad": found.stiffness_Nmprad if seen else None, "least_Nmprad": found.least_Nmprad,
        "most_Nmprad": found.most_Nmprad if math.isfinite(found.most_Nmprad) else None, "places": PLACES,
    }  # fmt: skip


def bristles_text(kept: dict[str, Any]) -> str:
    """What was found of `measured_bristles`."""
    if "why" in kept:
        return f"not measured: {kept['why']}"
    if kept["found_Nmprad"] is None:
        return f"stiffer than {kept['least_Nmprad']:.2g} Nm/rad, which the encoder cannot tell from rigid"
    most = "" if kept["most_Nmprad"] is None else f"{kept['most_Nmprad']:.3g}"
    return f"{kept['found_Nmprad']:.3g} Nm/rad, [{kept['least_Nmprad']:.3g}..{most}] 95 %"


def bristle_values(kept: dict[str, Any]) -> list[Found]:
    """For [friction.lugre]; none where they were not measured."""
    if "why" in kept:
        return []
    source = f"{kept['stiffness_Nmprad']:g}; {bristles_text(kept)}; {kept['places']} places"
    damping = f"{kept['damping_Nmspr']:g}, {DAMPING_RATIO:g} of the critical one: not measured"
    section = ("friction", "lugre")
    return [
        Found(section, "stiffness_Nmprad", kept["stiffness_Nmprad"], source),
        Found(section, "damping_Nmspr", kept["damping_Nmspr"], damping),
    ]
