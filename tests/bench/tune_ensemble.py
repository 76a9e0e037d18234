"""`tune` on random joints, started from wrong guesses: identified errors, margins with the true values, tracking.

    python tests/bench/tune_ensemble.py [--seed 90701] [--plants 40] [--soft | --light | --sizes]
                                       [--encoders both] [--bits 17 20] [--noise COUNTS] [--bristles]
                                       [--workers 2] [--csv FILE] [--motions] [--cluster tls://HOST:8786]

Each joint of the ensemble of `study` (`tools/experiments/controller_study.py`; `--soft`: the realistic one with a soft
reducer and two encoders, or one of them, `--encoders`; `--light`: rigid, light, with much friction; `--sizes`: rigid,
from a finger to a base joint) begins with an inertia that is wrong by a factor of 0.5 to 2, a friction wrong by the
same, no reducer, and the delay of the shipped configuration.  Simulated time.  The same law is chosen a second time
from the true values, and both run 0.35 sin(0.2 pi t), with `--sizes` a sine that suits the joint; the error is that of
the link itself from 20 s to 40 s, and once more until 60 s, when what adapts has found its weights.  `--motions`: what
was tuned also makes the runs of `flexible_study.py`, with learning and with adaptation, motions that never repeat.
`--bits`, `--noise`: of the encoder at the joint.  `--bristles`: no further than the step that measures how stiff they
are; then motions with that stiffness and with the 8e4 Nm/rad of the shipped configurations, errors of the joint itself
from 20 to 50 s: up to 16 bit with the Kalman filter of docs/law.md, with and without adaptation, above with the gains
that are chosen, adaptation and pairing.

Hysteresis leaves a reducer no single stiffness.  The one that is compared is what the virtual reducer did in the
response itself: its torque over its twist, both of the simulation and by the lines of the excitation, as the analysis
takes positions (`frequency_response.py`), within a third of an octave of the resonance that comes out.  The loss there
counts as damping.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.drivers.errors import JointctlError  # noqa: E402
from jointctl.firmware_py.states import Encoders  # noqa: E402
from jointctl.hil.lockstep import TRUE_POSITION_rad  # noqa: E402
from jointctl.tools.analysis.gains import choose_gains  # noqa: E402
from jointctl.tools.analysis.linear_loop import TwoMasses, loop_settings  # noqa: E402
from jointctl.tools.analysis.margins import margins  # noqa: E402
from jointctl.tools.configuration.config import Config, Control  # noqa: E402
from jointctl.tools.configuration.conversions import law_resolution_rad  # noqa: E402
from jointctl.tools.configuration.found_values import with_values  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config  # noqa: E402
from jointctl.tools.configuration.sections import Friction, LuGre, Virtual  # noqa: E402
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant  # noqa: E402
from jointctl.tools.experiments.many_runs import Workers  # noqa: E402
from jointctl.tools.experiments.scenarios import (  # noqa: E402
    RANDOM_MOTIONS,
    Controller,
    Scenario,
    changed,
    controller_constants,
    error_figures,
    random_motion,
    run_scenario,
)
from jointctl.tools.lockstep import LockstepJoint, LockstepRun  # noqa: E402
from jointctl.tools.output import Output  # noqa: E402
from jointctl.tools.session.plan import Motion, TerminalConsent  # noqa: E402
from jointctl.tools.sweeping import carry_out as sweeping  # noqa: E402
from jointctl.tools.tuning.carry_out import STAGE_PAIRS, Carried, Carrier  # noqa: E402
from jointctl.tools.tuning.frequency_response import ResponseMotion, ResponsePlan, fourier_sums, median_of  # noqa: E402
from jointctl.tools.tuning.joint_fit import SMALL_MOTION, Estimate, JointFit, values_of_fit  # noqa: E402
from jointctl.tools.verbs import tune_steps  # noqa: E402
from jointctl.tools.verbs.tune import TuneOptions  # noqa: E402
from jointctl.tools.verbs.tune_steps import STEPS, Tune  # noqa: E402
from tests.bench.flexible_study import ADAPTATION, Row, runs_of, table  # noqa: E402
from tests.configurations import KALMAN  # noqa: E402
from tests.joint_sizes import Size  # noqa: E402
from tests.joint_sizes import joint as joint_of  # noqa: E402

RUN_s, FROM_s, LATE_s = 60.0, 20.0, 40.0
SCALED = ("tc_Nm", "ts_Nm", "tv", "a0", "a1", "a2", "a3")
IN_LOCKSTEP = sweeping.sweep_in_lockstep
LAWS: dict[str, Any] = {"both": "joint_encoder", "motor": "encoder", "link": "joint_encoder_alone"}  # of `study`
LIGHT_kgm2, LIGHT_FRICTION = (0.08, 0.6), (0.3, 1.0)  # total inertia; share of the friction of a joint of 2 kg m^2
HELD_LINK = ((0.0, 1e4), (0.0, 200.0))  # of a rigid joint: a link that nothing moves


class Timed(Carrier):
    """Counts the time that the joint moves and that its simulation takes, and keeps the whole response."""

    seconds = simulation_s = 0.0
    response: tuple[ResponsePlan, LockstepRun] | None = None

    def run(self, config: Config, motion: Motion, *args: Any, **how: Any) -> Carried:
        runs: list[LockstepRun] = []

        class Watched(LockstepJoint):
            def run_as_configured(self, *given: Any, **options: Any) -> LockstepRun:
                runs.append(super().run_as_configured(*given, **options))
                return runs[-1]

        with patch.object(sweeping, "LockstepJoint", Watched), self.simulation():
            carried = super().run(config, motion, *args, **how)
        self.seconds += len(carried.records) / config.loop.rate_Hz
        if isinstance(motion, ResponseMotion) and len(motion.plan.legs.starts) > 2 * STAGE_PAIRS:
            self.response = motion.plan, runs[-1]
        return carried

    @contextmanager
    def simulation(self) -> Iterator[None]:
        """Its processor time is not that of the tune."""
        begun = time.process_time()
        try:
            yield
        finally:
            self.simulation_s += time.process_time() - begun

    def sweep(self, *given: Any, **options: Any) -> Any:
        """Of the friction step, which does not ask a carrier."""
        with self.simulation():
            return IN_LOCKSTEP(*given, **options)


def scaled(friction: Friction, positive: float, negative: float) -> Friction:
    """The same with the torque of each direction times a factor."""

    def side(one: Any, factor: float) -> Any:
        return one.model_copy(update={key: factor * getattr(one, key) for key in SCALED})

    return friction.model_copy(
        update={"positive": side(friction.positive, positive), "negative": side(friction.negative, negative)}
    )


def wrong_guess(config: Config, seed: int, index: int) -> Config:
    """What a user begins with; the virtual joint stays what it is."""
    random = np.random.default_rng([seed, index, 1])
    inertia, friction = (float(math.exp(random.uniform(-math.log(2.0), math.log(2.0)))) for _ in range(2))
    assert config.friction is not None
    return config.changed(
        joint__inertia_kgm2=inertia * config.joint.inertia_kgm2,
        friction=scaled(config.friction, friction, friction),
        virtual={"inertia_scale": config.virtual.inertia_scale / inertia, "friction": config.friction},
        margin={"loop_delay_s": None, "current_lag_s": 0.0005},
        reducer=None,
    )


def true_fit(config: Config, found: JointFit, true_kgm2: float, local: tuple[float, float, float]) -> JointFit:
    """As if the response had told the truth, with the intervals of the one that was measured; `local_reducer`."""
    virtual = config.virtual
    assert virtual is not None
    late_s = virtual.command_delay_s + virtual.current_lag_s
    values = {"inertia_kgm2": true_kgm2, "delay_s": virtual.command_delay_s, "lag_s": virtual.current_lag_s,
              "late_s": late_s, "friction_Nmspr": found.friction_Nmspr.value}  # fmt: skip
    if virtual.flexible:
        link = true_kgm2 - virtual.motor_side_inertia_kgm2
        values |= {"link_kgm2": link, "stiffness_Nmprad": local[0], "resonance_Hz": local[1],
                   "damping_Nmspr": local[2]}  # fmt: skip
    estimates = {name: Estimate(values.get(name, 0.0), one.half) for name, one in found.values.items()}
    return replace(found, flexible=virtual.flexible, values=estimates, tells_link=True)


def true_margin_deg(config: Config, true_kgm2: float) -> float:
    """Least phase margin of the loop on the joint as it is; a soft one with and without what hysteresis adds."""
    virtual = config.virtual
    assert virtual is not None
    if virtual.flexible:
        motor, link = virtual.motor_side_inertia_kgm2, true_kgm2 - virtual.motor_side_inertia_kgm2
        joints = tuple(
            TwoMasses(motor, link, factor * virtual.reducer_stiffness_Nmprad, virtual.reducer_damping_Nmspr)
            for factor in (1.0, SMALL_MOTION, 2.0)
        )
        how: dict[str, Any] = {"joints": joints}
    else:
        how = {"joints": (TwoMasses(true_kgm2, 1.0, 0.0, 0.0, *HELD_LINK),), "encoders": Encoders.MOTOR}
    settings, _ = loop_settings(config)
    late: dict[str, Any] = {"delay_s": virtual.command_delay_s, "lag_s": virtual.current_lag_s}
    return margins(replace(settings, **late, **how)).phase_margin_deg


NEAR_octaves = 1.0 / 3.0
SETTLED = 12  # times that stiffness and resonance follow each other


def torsion_Nm(virtual: Virtual, twist_rad: np.ndarray) -> np.ndarray:
    """Of the virtual reducer without damping, `hil/plant.py`: three slopes and the bristle, which begins relaxed."""
    size, slope, knee_rad, knee_Nm = np.abs(twist_rad), virtual.reducer_stiffness_Nmprad, 0.0, 0.0
    spring = slope * size
    for to_Nm, beyond in zip(virtual.reducer_knees_Nm, virtual.reducer_stiffness_beyond_Nmprad, strict=True):
        knee_rad, knee_Nm = knee_rad + (to_Nm - knee_Nm) / slope, to_Nm
        spring += (beyond - slope) * np.maximum(size - knee_rad, 0.0)
        slope = beyond
    slide_rad, z, at_rad, bristle = 0.5 * virtual.hysteresis_width_rad, 0.0, 0.0, np.zeros(len(twist_rad))
    for i, to_rad in enumerate(twist_rad if slide_rad > 0.0 else ()):
        way, half = to_rad - at_rad, 0.5 * abs(to_rad - at_rad)
        z = (z * (slide_rad - half) + slide_rad * way) / (slide_rad + half)
        at_rad, bristle[i] = to_rad, z
    torque: np.ndarray = np.copysign(spring, twist_rad) + virtual.reducer_stiffness_Nmprad * bristle
    return torque


def true_twist_rad(config: Config, run: LockstepRun) -> np.ndarray:
    """Of the trajectory's records: the motor by its encoder without what that reads too much, the link as it was."""
    virtual, ratio = config.virtual, config.joint.reduction_ratio
    assert virtual is not None
    read_rad = np.asarray(run.log.position_rad)[run.tracking]
    eccentric = np.sin(ratio * read_rad + virtual.motor_encoder_eccentricity_phase_rad)
    motor_rad = read_rad - virtual.motor_encoder_eccentricity_rad / ratio * eccentric
    waves = zip(
        virtual.kinematic_error_rad, virtual.kinematic_error_per_motor_turn, virtual.kinematic_error_phase_rad,
        strict=True,
    )  # fmt: skip
    ahead = sum((size * np.sin(order * ratio * motor_rad + phase) for size, order, phase in waves), 0.0 * motor_rad)
    twist: np.ndarray = motor_rad + ahead - run.truth[run.tracking, TRUE_POSITION_rad]
    return twist


def local_reducer(config: Config, true_kgm2: float, carrier: Timed) -> tuple[float, float, float]:
    """(stiffness [Nm/rad], resonance [Hz], damping [Nm s/rad]) of the response that was measured; see the module."""
    virtual = config.virtual
    assert virtual is not None
    assert carrier.response is not None
    plan, run = carrier.response
    twist = true_twist_rad(config, run)
    torque = torsion_Nm(virtual, twist)
    cycle = np.round(np.asarray(run.log.trajectory_s)[run.tracking] * config.loop.rate_Hz).astype(int)
    rows = np.searchsorted(cycle, plan.legs.starts)[:, None] + np.arange(plan.samples)
    line = np.fft.rfft(plan.sine.wave)[plan.sine.bins]
    turned = line * np.exp(1j * math.tau * plan.sine.bins * (cycle[rows[:, :1]] / plan.samples))
    sums = (fourier_sums(values[rows], plan.sine.bins) / turned for values in (torque, twist))
    of_torque, of_twist = map(median_of, sums)
    spring, frequency_Hz = of_torque / of_twist, plan.sine.frequency_Hz
    motor, link = virtual.motor_side_inertia_kgm2, true_kgm2 - virtual.motor_side_inertia_kgm2
    joint = TwoMasses(motor, link, virtual.reducer_stiffness_Nmprad, 0.0)
    loss = 0.0
    for _ in range(SETTLED):
        near = np.abs(np.log2(frequency_Hz / joint.resonance_Hz)) < NEAR_octaves
        joint = replace(joint, stiffness_Nmprad=float(np.median(spring[near].real)))
        loss = float(np.median(spring[near].imag))
    damping = virtual.reducer_damping_Nmspr + loss / (math.tau * joint.resonance_Hz)
    return joint.stiffness_Nmprad, joint.resonance_Hz, damping


def rmse_mrad(config: Config) -> tuple[float, float]:
    """Of the link itself, before and after `LATE_s`; nan where a fault ended the run."""
    run = LockstepJoint(config.changed(trajectory__duration_s=RUN_s)).run()
    if run.fault:
        return math.nan, math.nan
    time_s, error_mrad = run.log.trajectory_s, 1e3 * run.true_error_rad
    parts = (run.tracking & (FROM_s <= time_s) & (time_s < LATE_s), run.tracking & (time_s >= LATE_s))
    early, late = (float(np.sqrt(np.mean(error_mrad[rows] ** 2))) for rows in parts)
    return early, late


def unloaded(plant: Config, seed: int, index: int) -> Config:
    """A light joint with much friction for its inertia, such as a motor and its reducer on the bench alone."""
    random = np.random.default_rng([seed, index, 7])
    inertia, factor = math.exp(random.uniform(*np.log(LIGHT_kgm2))), float(random.uniform(*LIGHT_FRICTION))
    assert plant.friction is not None
    return plant.changed(joint__inertia_kgm2=inertia, friction=scaled(plant.friction, factor, factor))


def of_any_size(seed: int, index: int) -> Config:
    """A rigid joint of 0.3 to 1000 Nm, with 4 to 40 % of friction, 16 to 22 bit, at 250 Hz to 1 kHz."""
    random = np.random.default_rng([seed, index, 77])

    def between(low: float, high: float) -> float:
        return math.exp(random.uniform(math.log(low), math.log(high)))

    torque_Nm = between(0.3, 1000.0)
    inertia_kgm2 = torque_Nm / (between(4.0, 600.0) * (60.0 / torque_Nm) ** 0.25)
    friction_Nm, gravity = between(0.04, 0.4) * torque_Nm, float(random.choice([0.0, 0.0, random.uniform(0.1, 0.45)]))
    rate_Hz, bits = float(random.choice([1000.0, 1000.0, 1000.0, 500.0, 250.0])), int(random.integers(16, 23))
    ratio, speed_radps, travel_rad = (
        float(random.choice([5.0, 10.0, 50.0, 100.0, 160.0])),
        between(0.3, 12.0),
        between(0.3, 3.0),
    )
    size = Size(
        torque_Nm, inertia_kgm2, ratio, friction_Nm, speed_radps, travel_rad, bits, rate_Hz, gravity * torque_Nm
    )
    delay_s = random.uniform(0.5e-3, 2e-3) if rate_Hz >= 1000.0 else random.uniform(0.5, 1.5) / rate_Hz
    return joint_of(
        size,
        virtual__friction_kind=str(random.choice(["lugre", "lugre", "lugre", "stick_slip"])),
        virtual__command_delay_s=float(delay_s), virtual__current_lag_s=random.uniform(0.3e-3, 1e-3),
        virtual__friction_positive_scale=random.uniform(0.9, 1.1),
        virtual__friction_negative_scale=random.uniform(0.9, 1.1),
        virtual__current_limit_A=min(100.0 * torque_Nm / ratio, 9000.0), sequence__stop_timeout_s=10.0,
    )  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One joint; it is sent to a process."""

    seed: int
    index: int
    kind: str
    encoders: str
    motions: bool
    bits: tuple[int, int]
    noise_counts: float
    bristles: bool


def bristles_row(kept: dict[str, Any], virtual: Virtual) -> dict[str, Any]:
    """What was found over what is true; of a joint without bristles the bound alone."""
    if "why" in kept:
        return {"not_measured": kept["why"]}
    if virtual.friction_kind != "lugre":
        return {"bound_Nmprad": kept["least_Nmprad"], "bound_holds": kept["most_Nmprad"] is None}
    true = virtual.bristle_stiffness_Nmprad
    held = kept["least_Nmprad"] <= true <= (kept["most_Nmprad"] or math.inf)
    written = math.log(kept["stiffness_Nmprad"] / true)
    row = {"true_Nmprad": true, "bristles_held": held, "bristles_written": written}
    if kept["found_Nmprad"] is not None:
        row["bristles"] = math.log(kept["found_Nmprad"] / true)
    return row


SHIPPED = LuGre(stiffness_Nmprad=8e4, damping_Nmspr=200.0)
MOTIONS_s, MOTIONS_FROM_s = 50.0, 20.0
COMPARED: tuple[Scenario, ...] = ("reversals", "point_to_point", "multi_sine", "sine")


def laws_of(job: Tune) -> dict[str, Control]:
    """Without learning."""
    bits = job.config.encoder.counts_per_turn.bit_length() - 1
    if bits not in KALMAN:
        return {"tuned": job.chosen_gains("precise", "tracking").control.model_copy(update={"learning": None})}
    precise = load_config(shipped_config("precise")).control
    kalman = {**KALMAN[bits], "feed_forward_lead_s": "auto", "learning": None}
    laws = {"plain": kalman, "adapting": {**kalman, "adaptation": ADAPTATION}}
    return {name: changed(precise, changes, name) for name, changes in laws.items()}


def compared(job: Tune, task: Task) -> list[tuple[str, Scenario, float, float]]:
    """(law, motion, RMSE [mrad] with the shipped stiffness, with the measured one); nan where a fault ended it."""
    friction, joint, rows = job.config.friction, LockstepJoint(job.config), []
    assert friction is not None
    for name, control in laws_of(job).items():
        for scenario in COMPARED:
            motion = None
            if scenario in RANDOM_MOTIONS:
                motion = random_motion(scenario, task.seed, task.index, MOTIONS_s)
            errors = []
            for lugre in (SHIPPED, friction.lugre):
                chosen = Controller(name, control, friction.model_copy(update={"lugre": lugre}))
                constants = controller_constants(job.config, chosen, joint.report.start_position_rad)
                run = run_scenario(joint, constants, scenario, motion=motion)
                figures = error_figures(run, MOTIONS_FROM_s, motion, law_resolution_rad(job.config))
                errors.append(math.nan if figures.fault else figures.true_rmse_mrad)
            rows.append((name, scenario, errors[0], errors[1]))
    return rows


def tuned(task: Task) -> dict[str, Any]:
    """One joint; with `failed` where it was not tuned."""
    seed, index, kind, encoders = task.seed, task.index, task.kind, task.encoders
    soft = kind == "soft"
    base = load_config(shipped_config("realistic" if soft else "precise"))
    settings = EnsembleSettings(flexible=soft, law=LAWS[encoders], encoder_bits=task.bits)
    plant = random_plant(base, settings, seed, index).changed(virtual__encoder_noise_counts=task.noise_counts)
    if kind == "light":
        plant = unloaded(plant, seed, index)
    elif kind == "sizes":
        plant = of_any_size(seed, index)
    if encoders == "motor":
        plant = plant.changed(joint_encoder=None)
    true_kgm2 = plant.joint.inertia_kgm2 * plant.virtual.inertia_scale
    guess = wrong_guess(plant, seed, index)
    silent = Output(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    row: dict[str, Any] = {"plant": index, "friction": plant.virtual.friction_kind}
    carrier = Timed(silent, TerminalConsent(silent, assume_yes=True), None)
    started = time.process_time()
    try:
        with tempfile.TemporaryDirectory() as folder:
            job = Tune(guess, TuneOptions(lockstep=True), carrier, Path(folder))
            steps = STEPS[: STEPS.index("bristles") + 1] if task.bristles else STEPS
            with patch.object(sweeping, "sweep_in_lockstep", carrier.sweep), patch.object(tune_steps, "STEPS", steps):
                job.carry_out()
    except JointctlError as error:
        return {**row, "failed": error.message}
    row |= bristles_row(job.state["bristles"], plant.virtual)
    if task.bristles:
        return {**row, "compared": [] if "not_measured" in row else compared(job, task)}
    whole_s = time.process_time() - started
    row |= {"cpu_s": whole_s, "computing_s": whole_s - carrier.simulation_s}
    row |= {"joint_s": carrier.seconds + job.state["friction"]["seconds"]}
    fit, virtual = job.fit, plant.virtual
    assert fit is not None
    row["flexible"] = fit.flexible
    row["inertia"] = fit.inertia_kgm2.value / true_kgm2 - 1.0
    row["inertia_half"] = fit.inertia_kgm2.half / true_kgm2
    row["late_ms_half"] = 1e3 * fit.late_s.half
    period_s = 1.0 / plant.loop.rate_Hz if kind == "sizes" else 0.0  # which a synchronous RPDO takes
    row["late_ms"] = 1e3 * (fit.late_s.value - virtual.command_delay_s - virtual.current_lag_s - period_s)
    local = (0.0, 0.0, 0.0)
    if encoders == "link":  # which tells neither the twist nor the two inertias apart
        stiffness, damping = SMALL_MOTION * virtual.reducer_stiffness_Nmprad, fit.damping_Nmspr.value
        motor_kgm2 = virtual.motor_side_inertia_kgm2
        joint = TwoMasses(motor_kgm2, true_kgm2 - motor_kgm2, stiffness, damping)
        local = (stiffness, joint.resonance_Hz, damping)
    elif soft:
        local = local_reducer(plant, true_kgm2, carrier)
    if soft and encoders != "link":
        link = true_kgm2 - virtual.motor_side_inertia_kgm2
        row["link"] = fit.link_kgm2.value / link - 1.0
        row["stiffness_over_first"] = fit.stiffness_Nmprad.value / virtual.reducer_stiffness_Nmprad
        stiffness, resonance_Hz, _ = local
        row["stiffness"] = fit.stiffness_Nmprad.value / stiffness - 1.0
        row["resonance"] = fit.resonance_Hz.value / resonance_Hz - 1.0
        row |= {"stiffness_half": fit.stiffness_Nmprad.half / stiffness, "link_half": fit.link_kgm2.half / link}
        row["resonance_half"] = fit.resonance_Hz.half / resonance_Hz
    row["law"] = job.state["gains"]["law"]
    row["missed"] = "; ".join(job.state["gains"]["missed"])
    row["believed_margin_deg"] = job.state["gains"]["phase_margin_deg"]
    row["true_margin_deg"] = true_margin_deg(job.config, true_kgm2)
    row["rmse_mrad"], row["late_rmse_mrad"] = rmse_mrad(job.config)
    row["rmse_before_mrad"] = job.state["verification"].get("before", {}).get("rmse_mrad", math.nan)
    if fit.flexible != soft:  # its law is none of the true joint
        return {**row, "rmse_true_mrad": math.nan, "late_rmse_true_mrad": math.nan}
    truth = true_fit(plant, fit, true_kgm2, local)
    known = with_values(job.config, values_of_fit(job.config, truth, ""))
    assert plant.friction is not None
    friction = scaled(plant.friction, virtual.friction_positive_scale, virtual.friction_negative_scale)
    assert job.config.friction is not None
    lugre = job.config.friction.lugre
    if lugre is not None and "true_Nmprad" in row:
        lugre = lugre.model_copy(update={"stiffness_Nmprad": row["true_Nmprad"]})
    friction = friction.model_copy(update={"lugre": lugre})
    known = known.changed(friction=friction)
    best = choose_gains(known, truth.intervals(), row["law"])
    row["rmse_true_mrad"], row["late_rmse_true_mrad"] = rmse_mrad(known.changed(control=best.control))
    if task.motions:
        control = job.config.control.model_copy(update={"learning": None, "adaptation": None})
        chosen = Controller("tuned", control, job.config.friction)
        row["motions"] = [
            Row(index, virtual.friction_kind, name, scenario, figures.fault, figures.true_rmse_mrad,
                figures.true_peak_mrad, figures.chatter_Nm, math.nan, convergence, math.nan)
            for name, scenario, figures, convergence in runs_of(job.config, chosen, seed, index)
        ]  # fmt: skip
    return row


def _figures(rows: list[dict[str, Any]], name: str) -> str:
    values = np.abs([row[name] for row in rows if name in row and math.isfinite(row[name])])
    if not len(values):
        return "none"
    return f"median {np.median(values):.4g}, worst {np.max(values):.4g} of {len(values)}"


def _bristles(rows: list[dict[str, Any]]) -> None:
    """Stiffness found over the true one, as a factor either way, and whether the interval holds it."""
    some = [row for row in rows if "true_Nmprad" in row]
    print(f"  bristles: interval holds {sum(row['bristles_held'] for row in some)} of {len(some)}")
    for name in ("bristles", "bristles_written"):
        factors = np.exp(np.abs([row[name] for row in some if name in row]))
        if len(factors):
            print(f"    {name}: factor median {np.median(factors):.3f}, worst {np.max(factors):.3f} of {len(factors)}")
    bounds = [row["bound_Nmprad"] for row in rows if "bound_Nmprad" in row]
    if bounds:
        held = sum(row.get("bound_holds", False) for row in rows)
        print(f"    rigid contact: bound {min(bounds):.3g} .. {max(bounds):.3g}, no end for {held} of {len(bounds)}")
    print(f"    not measured: {sum('not_measured' in row for row in rows)}")


def _compared(rows: list[dict[str, Any]]) -> None:
    """Medians and worst of both stiffnesses, and of their quotient."""
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in rows:
        for law, scenario, shipped, measured in row["compared"]:
            found.setdefault((law, row["friction"], scenario), []).append((shipped, measured))
    for names, pairs in sorted(found.items()):
        values = np.array(pairs)
        both = np.isfinite(values).all(axis=1)
        median, worst = np.median(values[both], axis=0), np.max(values[both], axis=0)
        ratio, faults = values[both, 1] / values[both, 0], np.isnan(values).sum(axis=0)
        print(
            f"  {' '.join(names)}: {median[0]:.4f} / {worst[0]:.4f} -> {median[1]:.4f} / {worst[1]:.4f} mrad, quotient "
            f"{np.median(ratio):.3f} / {np.max(ratio):.3f} of {both.sum()}, faults {faults[0]} -> {faults[1]}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=90701)
    parser.add_argument("--plants", type=int, default=40)
    kinds = parser.add_mutually_exclusive_group()
    for kind in ("soft", "light", "sizes"):
        kinds.add_argument(f"--{kind}", dest="kind", action="store_const", const=kind, default="rigid")
    parser.add_argument("--encoders", choices=tuple(LAWS), default="both", help="of a soft joint; default: both")
    parser.add_argument("--motions", action="store_true")
    parser.add_argument("--bits", type=int, nargs=2, default=(17, 20), help="of the encoder at the joint")
    parser.add_argument("--noise", type=float, default=0.0, help="of the encoder, counts")
    parser.add_argument("--bristles", action="store_true", help="the steps up to that alone")
    parser.add_argument("--workers", type=int, help="processes; default: one a core")
    parser.add_argument("--cluster", help="address of a dask scheduler: docs/cluster.md")
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    tasks = [
        Task(
            given.seed, index, given.kind, given.encoders, given.motions, tuple(given.bits), given.noise, given.bristles
        )
        for index in range(given.plants)
    ]
    rows: list[dict[str, Any]] = []
    for row in Workers(given.workers, given.cluster).results(tuned, tasks):
        rows.append(row)
        print(row, flush=True)
    rows.sort(key=lambda row: int(row["plant"]))
    moved = [one for row in rows for one in row.pop("motions", ())]
    good = [row for row in rows if "failed" not in row]
    if given.bristles:
        print(f"{len(good)} of {len(rows)} measured, seed {given.seed}, {given.kind}, {given.bits} bit; simulated")
        _bristles(good)
        _compared(good)
        return
    for row in good:
        row["ratio"] = row["rmse_mrad"] / row["rmse_true_mrad"]
        row["late_ratio"] = row["late_rmse_mrad"] / row["late_rmse_true_mrad"]
    if given.csv is not None:
        with given.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, sorted({key for row in rows for key in row}))
            writer.writeheader()
            writer.writerows(rows)
    print(f"{len(good)} of {len(rows)} tuned, seed {given.seed}, {given.kind}; simulated")
    for name in ("inertia", "link", "resonance", "stiffness", "stiffness_over_first", "late_ms", "rmse_mrad",
                 "rmse_true_mrad", "ratio", "late_rmse_mrad", "late_rmse_true_mrad", "late_ratio", "joint_s",
                 "computing_s", "cpu_s"):  # fmt: skip
        print(f"  {name}: {_figures(good, name)}")
    _bristles(good)
    margins_deg = sorted(row["true_margin_deg"] for row in good)
    print(f"  true phase margin: worst {margins_deg[0]:.1f}, 30 deg and more {sum(m >= 30.0 for m in margins_deg)}")
    for name in ("ratio", "late_ratio"):
        print(f"  {name} at most 1.2: {sum(row[name] <= 1.2 for row in good)}")
    for name in ("inertia", "link", "resonance", "stiffness", "late_ms"):
        some = [row for row in good if name in row]
        if some:
            print(f"  interval of {name} holds: {sum(abs(row[name]) <= row[f'{name}_half'] for row in some)}")
    if moved:
        table(moved)


if __name__ == "__main__":
    main()
