"""A motion from which `identify` finds inertia, gravity and friction at once, designed before anything moves.

It is made of strokes at constant speeds, from the slowest that tells the Stribeck effect to the fastest that the limits
allow, at several places of the travel, and of a sum of sines, which accelerates.  Speeds, places, frequencies and
phases of many candidates are drawn; the one is taken whose information matrix, in shares of what is believed of each
parameter, has the least condition number.

The matrix is sum g g^T of the slopes g of the torque (see `models`) over the samples that `identify` would use.
With an error of ERROR of the Coulomb friction that is another one every CORRELATED_s, its inverse says how well each
parameter will be known.  Temperature is none of them: one motion is as good as at one temperature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import UsageError
from jointctl.firmware_py.trajectory import eased, spline_table
from jointctl.tools.analysis.margin_gate import OVERLOADED
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import free_torque_Nm, friction_constants, turning_of
from jointctl.tools.drawing import BLUE, GREY, ORANGE, canvas
from jointctl.tools.identification.models import EXPERIMENTS, FORMS, SIGNS, Model, Samples, jacobian
from jointctl.tools.session.plan import Placed, joint_lines, limits_line, remark_lines
from jointctl.tools.sweeping.carry_out import sweep_constants
from jointctl.tools.sweeping.options import check_range
from jointctl.tools.sweeping.plan import (
    ACCELERATION_SHARE,
    SPEED_SHARE,
    MotionBuilder,
    PlanSettings,
    SweepMotion,
    fastest_allowed_radps,
    position_margin_rad,
    ramps_rad,
    require_torque,
    shifted,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CANDIDATES = 60
STROKES_SHARE = (0.4, 0.7)  # of the duration; the rest are sines
SLOWEST_SHARE = 0.02  # of the fastest, where no Stribeck speed is known
STROKE_S = 3.0  # of a stroke at constant speed, at most
PLACES = 3  # of each slow speed
SINES = 5
EASE_S = 2.0  # in which the sines come and go
ROW_S = 0.01
FASTEST_SHARE = (0.3, 1.0)  # of what the limits allow
TORQUE_SHARE = 0.8  # of limits.torque_max_Nm that the motion may need
SPARE_SHARE, MOST_SHARE = 0.5, 0.95  # of what gravity and friction leave of it, where that is less than 0.4; of it
ERROR, CORRELATED_s = 0.1, 0.1  # of the Coulomb friction; ripple and noise of a usual joint
OPEN = 0.5  # half the interval over the value from which on a parameter counts as not found
_SAMPLE_s = 0.02
_ASSUMED_LOAD = {"load_coulomb": 0.1, "load_viscous": 0.05}  # of a usual strain-wave gear
_FRICTION_SHARE, _STRIBECK_radps = 0.05, 0.03  # of limits.torque_max_Nm; where no friction is configured
_LEAST_GRAVITY = 0.02  # of limits.torque_max_Nm


@dataclass(frozen=True)
class Design:
    """The motion about the middle of the limits, and what it will tell."""

    motion: SweepMotion
    middle_rad: float
    slowest_radps: float
    condition: float  # number of the information matrix
    known: dict[str, float]  # half the expected interval over what is believed, of each parameter
    samples: Samples
    torque_Nm: np.ndarray  # that is expected at each of them

    @property
    def untold(self) -> list[str]:
        """What this motion cannot tell, with the experiment that would."""
        lines = [
            f"{name}: not expected to be known better than {share:.0%}: {EXPERIMENTS.get(name.split()[0], 'longer')}"
            for name, share in self.known.items() if share > OPEN
        ]  # fmt: skip
        return [
            *lines,
            "temperature: once more when the joint is 15 K warmer, and both logs to identify together",
            "scale of all torques (the torque constant): attach a known mass, once more, and compare gravity",
        ]


def believed(config: Config) -> tuple[Model, np.ndarray]:
    """(model, its parameters) from the configuration, usual values where it has none."""
    limits, ratio, joint = config.limits, config.joint.reduction_ratio, config.joint
    top = SPEED_SHARE * limits.velocity_max_radps
    model = Model(
        FORMS["stribeck"], frozenset({"inertia", "gravity", "load-coulomb", "load-viscous"}), tuple(SIGNS), top, 1.0
    )
    value = dict(_ASSUMED_LOAD)
    value["inertia"] = joint.inertia_kgm2
    value["gravity_sin"] = joint.gravity_Nm * math.cos(joint.gravity_zero_rad)
    value["gravity_cos"] = -joint.gravity_Nm * math.sin(joint.gravity_zero_rad)
    coulomb_Nm = _FRICTION_SHARE * limits.torque_max_Nm
    for word in SIGNS:
        own = {"tc": coulomb_Nm, "rise": 0.3 * coulomb_Nm, "tv": coulomb_Nm, "log_ws": math.log(_STRIBECK_radps)}
        if config.friction is not None:
            branch = getattr(friction_constants(config.friction, ratio)[0], word)
            own = {
                "tc": ratio * branch.coulomb_Nm, "rise": ratio * (branch.static_Nm - branch.coulomb_Nm),
                "tv": ratio * branch.viscous_Nmspr * top, "log_ws": math.log(branch.stribeck_speed_radps),
            }  # fmt: skip
        value |= {f"{name} {word}": number for name, number in own.items()}
    return model, np.array([value[name] for name in model.names])


def designed(config: Config, duration_s: float, seed: int) -> Design:
    """The best of the candidates; `UsageError` where nothing fits into limits and duration."""
    check_range("--duration", duration_s, 20.0, 1800.0)
    limits = config.limits
    margin_rad = position_margin_rad(config)
    width_rad = limits.position_max_rad - limits.position_min_rad - 2.0 * margin_rad
    fastest = fastest_allowed_radps(config)
    acceleration_radps2, rounding_s = turning_of(config, ACCELERATION_SHARE * config.sequence.brake_radps2)
    settings = PlanSettings(
        width_rad, acceleration_radps2, fastest, 1.0, 0.0, config.joint.reduction_ratio, rounding_s=rounding_s
    )
    model, vector = believed(config)
    middle = 0.5 * (limits.position_min_rad + limits.position_max_rad)
    slowest = _slowest_radps(model, vector)
    left_Nm, usual_Nm = free_torque_Nm(config), TORQUE_SHARE * limits.torque_max_Nm
    most_Nm = usual_Nm
    if left_Nm > 0.0:
        spared_Nm = limits.torque_max_Nm - SPARE_SHARE * left_Nm
        most_Nm = max(usual_Nm, min(spared_Nm, MOST_SHARE * limits.torque_max_Nm))
    best: Design | None = None
    best_rank = (True, math.inf)  # one that needs no more than usual comes first
    for number in range(CANDIDATES):
        random = np.random.default_rng([seed, number])
        slower = replace(settings, transit_radps=fastest * float(random.uniform(*FASTEST_SHARE)))
        motion = _candidate(slower, slowest, duration_s, random)
        found = _judged(motion, middle, slowest, model, vector)
        needed_Nm = float(np.max(np.abs(found.torque_Nm)))
        rank = (needed_Nm > usual_Nm, found.condition)
        if needed_Nm <= most_Nm and (best is None or rank < best_rank):
            best, best_rank = found, rank
    if best is None:
        raise UsageError(
            f"limits.torque_max_Nm (={limits.torque_max_Nm:g}) must leave room for gravity, friction and the "
            f"acceleration of the motion ({settings.acceleration_radps2:g} rad/s2 at most)",
            "lower sequence.brake_radps2" if left_Nm > 0.0 else OVERLOADED,
        )
    return best


def _slowest_radps(model: Model, vector: np.ndarray) -> float:
    """Where a third of the Stribeck effect has decayed, but never slower than standstill, for `identify` to use."""
    stribeck = math.exp(min(vector[model.names.index(f"log_ws {word}")] for word in SIGNS))
    usual = SLOWEST_SHARE * model.top_radps
    return min(max(0.4 * stribeck, 0.002 * model.top_radps), usual, 0.5 * model.top_radps)


def _candidate(s: PlanSettings, slowest_radps: float, duration_s: float, random: np.random.Generator) -> SweepMotion:
    builder = MotionBuilder(s)
    half = 0.5 * s.width_rad
    until_s = duration_s * random.uniform(*STROKES_SHARE)
    fastest = min(s.transit_radps, builder.peak_radps(half, 0.0))
    count = int(random.integers(4, 9))
    speeds = np.geomspace(slowest_radps, fastest, count)
    while builder.t_s < until_s:
        for number, speed in enumerate(random.permutation(speeds)):
            ramps = ramps_rad(speed, s)
            length = min(s.width_rad - ramps, speed * STROKE_S)
            reach = half - 0.5 * (length + ramps)
            place = reach * ((number % PLACES) - 1) * random.uniform(0.5, 1.0)
            _there_and_back(builder, speed, place, (length, ramps))
            if builder.t_s > until_s:
                break
    builder.move_to(0.0)
    builder.rest(0.2)
    rows = builder.table()
    sines = _sines(s, max(duration_s - builder.t_s, 4.0 * EASE_S), random)
    sines[:, 0] += rows[-1, 0]
    table = np.vstack((rows[:-1], sines))
    low = min(builder.low_rad, float(sines[:, 1].min()))
    return SweepMotion(table, (), low, max(builder.high_rad, float(sines[:, 1].max())))


def _there_and_back(builder: MotionBuilder, speed: float, place_rad: float, ways_rad: tuple[float, float]) -> None:
    """About a place, both ways: `ways_rad` at constant speed, and of both ramps together."""
    steady_rad, ramps_rad = ways_rad
    for side in (1.0, -1.0):
        builder.move_to(place_rad - 0.5 * side * (steady_rad + ramps_rad))
        builder.ramp(side * speed)
        builder.cruise(max(steady_rad, 1e-6))
        builder.ramp(0.0)


def _sines(s: PlanSettings, duration_s: float, random: np.random.Generator) -> np.ndarray:
    """A table of sines from rest to rest, as large as travel, speed and acceleration allow."""
    time_s = np.linspace(0.0, duration_s, round(duration_s / ROW_S) + 1)
    position = np.zeros_like(time_s)
    turn_Hz = s.acceleration_radps2 / (math.tau * s.transit_radps)  # where speed and acceleration bind alike
    for _ in range(SINES):
        frequency_Hz = turn_Hz * math.exp(random.uniform(math.log(0.2), math.log(4.0)))
        amplitude = random.uniform(0.3, 1.0) / frequency_Hz ** random.uniform(1.0, 2.0)
        position += amplitude * np.sin(math.tau * (frequency_Hz * time_s + random.uniform()))
    position *= eased(time_s / EASE_S) * eased((duration_s - time_s) / EASE_S)
    table = spline_table(time_s, position)
    reach = np.max(np.abs(table[:, 1])) / (0.5 * s.width_rad)
    speed = np.max(np.abs(table[:, 2])) / s.transit_radps
    acceleration = 2.0 * np.max(np.abs(table[:, 3])) / s.acceleration_radps2
    table[:, 1:] /= max(reach, speed, acceleration)
    return table


def samples_of_table(table: np.ndarray, middle_rad: float) -> Samples:
    """The motion as `models` takes it, on a uniform grid of time."""
    time_s = np.arange(0.0, table[-1, 0], _SAMPLE_s)
    row = np.clip(np.searchsorted(table[:, 0], time_s, side="right") - 1, 0, len(table) - 2)
    d = time_s - table[row, 0]
    _, c0, c1, c2, c3 = table[row].T
    return Samples(
        c1 + d * (2.0 * c2 + 3.0 * d * c3), 2.0 * c2 + 6.0 * d * c3, middle_rad + c0 + d * (c1 + d * (c2 + d * c3)),
        None, None,
    )  # fmt: skip


def _judged(motion: SweepMotion, middle_rad: float, slowest_radps: float, model: Model, vector: np.ndarray) -> Design:
    every = samples_of_table(motion.table, middle_rad)
    used = every.part(np.abs(every.velocity_radps) > 0.8 * slowest_radps)
    value = dict(zip(model.names, vector, strict=True))
    coulomb_Nm = 0.5 * (value["tc positive"] + value["tc negative"])
    gravity_Nm = math.hypot(value["gravity_sin"], value["gravity_cos"])
    size = np.abs(vector)
    for number, name in enumerate(model.names):
        kind = name.split()[0]
        if kind.startswith("gravity"):
            size[number] = max(gravity_Nm, _LEAST_GRAVITY * coulomb_Nm / _FRICTION_SHARE)
        elif kind == "log_ws":
            size[number] = 1.0
        elif kind in ("rise", "tv"):
            size[number] = max(size[number], 0.1 * coulomb_Nm)
    slopes = jacobian(model, vector, used) * size
    information = slopes.T @ slopes * (_SAMPLE_s / CORRELATED_s) / (ERROR * coulomb_Nm) ** 2
    eigen = np.linalg.eigvalsh(information)
    condition = float(eigen[-1] / max(eigen[0], 1e-300))
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, rcond=1e-14, hermitian=True)), 0.0))
    known = {
        ("ws " + name.split()[1] if name.startswith("log_ws") else name): 1.96 * float(share)
        for name, share in zip(model.names, spread, strict=True)
    }
    return Design(
        motion, middle_rad, slowest_radps, condition, known, every, model.torque_Nm(vector, every)
    )  # fmt: skip


@dataclass(frozen=True)
class ExcitePass:
    """The designed motion at its place; see `session.plan.Motion`.  `config` is that of `config_of_sweep`."""

    config: Config
    design: Design

    @property
    def table(self) -> np.ndarray:
        return self.design.motion.table

    def placed(self, report: CommissioningReport) -> Placed:
        """See `Motion`; always about the middle of the limits, since gravity goes with the angle."""
        require_torque(report)
        motion = shifted(self.design.motion, self.design.middle_rad)
        constants = sweep_constants(self.config, report, motion)
        approach_s = float(constants[0].sequence.approach_s)
        return Placed(constants, motion.table, tuple(self._envelope(approach_s, motion, report)))

    def require_start(self, start_position_rad: float) -> None:
        """From everywhere within the limits."""

    def _envelope(self, approach_s: float, motion: SweepMotion, report: CommissioningReport) -> list[str]:
        design, found = self.design, self.design.samples
        return [
            *joint_lines(report, self.config.limits),
            f"approach   to {motion.table[0, 1]:+.4f} rad in {approach_s:.1f} s",
            f"motion     {motion.low_rad:+.3f} .. {motion.high_rad:+.3f} rad, {design.slowest_radps:.3g} to "
            f"{np.max(np.abs(found.velocity_radps)):.3g} rad/s, up to {np.max(np.abs(found.acceleration_radps2)):.3g} "
            f"rad/s2, {approach_s + motion.duration_s:.0f} s",
            f"torque     up to {np.max(np.abs(design.torque_Nm)):.3g} Nm expected",
            f"condition  {design.condition:.3g} of the information matrix, the least of {CANDIDATES} motions",
            limits_line(self.config.limits),
            *remark_lines(report.remarks),
        ]


def excitation_figure(design: Design, title: str) -> Figure:
    """The motion over time, and which speeds it visits under which torque."""
    found = design.samples
    time_s = np.arange(len(found.position_rad)) * _SAMPLE_s
    with canvas(5.4, title) as figure:
        axes = figure.subplot_mosaic([["q", "c"], ["v", "c"], ["a", "c"]], width_ratios=(3, 2))
        for key, values, label in (
            ("q", found.position_rad, "angle [rad]"), ("v", found.velocity_radps, "speed [rad/s]"),
            ("a", found.acceleration_radps2, "acceleration [rad/s²]"),
        ):  # fmt: skip
            axes[key].plot(time_s, values, color=BLUE, linewidth=0.9)
            axes[key].set_ylabel(label)
            axes[key].set_xmargin(0.01)
        axes["a"].set_xlabel("time [s]")
        slow = np.abs(found.velocity_radps) < 0.8 * design.slowest_radps
        for chosen, colour, label in ((slow, GREY, "not used"), (~slow, ORANGE, "used by identify")):
            axes["c"].plot(found.velocity_radps[chosen], design.torque_Nm[chosen], ".", color=colour, markersize=2.0,
                           label=label)  # fmt: skip
        axes["c"].set_xlabel("speed [rad/s]")
        axes["c"].locator_params(axis="x", nbins=5)  # it is narrow
        axes["c"].set_ylabel("expected torque at the joint [Nm]")
        axes["c"].legend()
        return figure
