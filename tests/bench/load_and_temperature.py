"""What friction by load and temperature buys, as it is identified: random simulated joints without learning.

    python -m tests.bench.load_and_temperature [joints] [seed] [quiet joints] [folder]

Each joint carries a pendulum of 20 Nm; how its friction goes with load and temperature is drawn at random.  It is moved
as `excite` does, cold (15 to 20 degC) and warm (45 to 50 degC), and both logs go through `identify`.  At a temperature
of its own, 15 to 55 degC, each law then believes the curve of 25 degC without load (today's model), the section that
was identified, or the truth.  The laws are `precise`, as it is and with `observer_paired`, with a slow observer, and
without one at its own gains and at those of the paper.  Errors: RMSE of the friction feed-forward against the true
friction, and of the joint itself, in the first period of a motion that is not one of those.  `quiet` joints have
neither ripple nor coarse encoders: what is left there is the friction model's.  Then one joint warms up from 20 to
50 degC while it moves.  What was identified is kept in `folder`, so that a run that was cut off goes on there.  All of
it is simulated.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it; before numpy

import numpy as np

from jointctl.hil.lockstep import TRUE_FRICTION_Nm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import Friction, FrictionLoad, FrictionTemperature
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.motion_fit import identify_motion
from jointctl.tools.identification.motion_report import motion_section
from jointctl.tools.identification.tables import ForeignFormat
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from jointctl.tools.output import Output
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.sweeping.carry_out import config_of_sweep, lockstep_log
from jointctl.tools.sweeping.excitation import Design, ExcitePass, designed
from jointctl.tools.verbs.identify import motion_from

PENDULUM_Nm = 20.0
AMPLITUDE_rad = 1.4  # the load is then up to 19.7 Nm either way
PERIOD_s = 10.0
COLD_degC, WARM_degC = (15.0, 20.0), (45.0, 50.0)
MOTION_s = 60.0
MODELS = ("today's model", "identified", "true")
LAWS: dict[str, dict[str, Any]] = {  # changes of [control]
    "precise": {},
    "precise, observer_paired": {"observer_paired": True},
    "observer of 10 rad/s": {"observer_radps": 10.0},
    "no observer": {"kind": "computed_torque", "observer_radps": 0.0},
    "no observer, the paper's kp 784, kv 56": {
        "kind": "computed_torque", "observer_radps": 0.0, "kp": 784.0, "kv": 56.0,
    },
}  # fmt: skip
QUIET = EnsembleSettings(
    friction_scale=(0.98, 1.02), torque_ripple_Nm=(0.0, 0.0), friction_ripple=(0.0, 0.0), encoder_bits=(24, 24)
)
WARM_UP_s = 300.0


def base_config() -> Config:
    """`precise` without learning, a pendulum on the joint, and a drive that reports its temperature."""
    config = load_config(shipped_config("precise"))
    return config.changed(
        control__learning=None, joint__gravity_Nm=PENDULUM_Nm, virtual__gravity_Nm=PENDULUM_Nm,
        drive={"temperature_object": "2103", "temperature_unit_degC": 0.1},
        limits={"position_min_rad": -3.0, "position_max_rad": 3.0},
        trajectory={"amplitude_rad": AMPLITUDE_rad, "frequency_Hz": 1.0 / PERIOD_s, "duration_s": PERIOD_s},
    )  # fmt: skip


def true_terms(config: Config, random: np.random.Generator, **virtual: Any) -> tuple[Config, Friction]:
    """The joint with friction that goes with load and temperature, which the controller knows nothing of; the truth."""
    truth = config.friction.model_copy(update={
        "load": FrictionLoad(coulomb=random.uniform(0.03, 0.2), viscous_spr=random.uniform(0.0, 0.1)),
        "temperature": FrictionTemperature(
            reference_degC=25.0, coulomb_pK=random.uniform(0.002, 0.008), viscous_pK=random.uniform(0.01, 0.03)
        ),
    })  # fmt: skip
    return config.changed(virtual={"friction": truth, **virtual}), truth


def believing(config: Config, friction: Friction) -> Config:
    """With another curve and terms; its bristles stay."""
    names = ("velocity_unit", "velocity_side", "torque_side", "positive", "negative", "load", "temperature")
    return config.changed(friction={name: getattr(friction, name) for name in names})


def excited(config: Config, design: Design, degC: float, folder: Path) -> Path:
    """The log of the designed motion at a temperature."""
    moving = config_of_sweep(config.changed(virtual__ambient_degC=degC, log__folder=str(folder)), "torque")
    path = lockstep_log(moving, ExcitePass(moving, design), TerminalConsent(Output(quiet=True), assume_yes=True))
    assert path is not None
    return path


def identified(config: Config, design: Design, random: np.random.Generator, kept: Path | None = None) -> Friction:
    """What `identify` makes of a cold and a warm log; `kept`: the file that has it already, or is to get it."""
    ends_degC = [random.uniform(*ends) for ends in (COLD_degC, WARM_degC)]
    if kept is not None and kept.exists():
        return Friction.model_validate_json(kept.read_text())
    with TemporaryDirectory() as name:
        cold, warm = (excited(config, design, degC, Path(name)) for degC in ends_degC)
        settings = MotionSettings(speed_min_radps=0.8 * design.slowest_radps, also=(warm,))
        found = identify_motion(motion_from(cold, ForeignFormat(), settings), settings)
    friction = Friction.model_validate(motion_section(found))
    if kept is not None:
        kept.write_text(friction.model_dump_json())
    return friction


def errors(run: LockstepRun, after_s: float, before_s: float) -> tuple[float, float]:
    """(RMSE of the friction feed-forward [Nm] where the joint moves, RMSE of the joint itself [mrad])."""
    log = run.log
    chosen = run.tracking & (log.trajectory_s >= after_s) & (log.trajectory_s < before_s)
    moving = chosen & (np.abs(log.desired_velocity_radps) > 0.05)
    friction_Nm = log.friction_torque_Nm[moving] - run.truth[moving, TRUE_FRICTION_Nm]
    error_mrad = run.true_error_rad[chosen] * 1e3
    return float(np.sqrt(np.mean(friction_Nm**2))), float(np.sqrt(np.mean(error_mrad**2)))


def random_joint(seed: int, index: int, design: Design, *, quiet: bool, kept: Path | None = None) -> np.ndarray:
    """(laws, 3 models, 2 errors) of the first period of one joint."""
    settings = QUIET if quiet else EnsembleSettings(friction_scale=(0.98, 1.02))
    random = np.random.default_rng([seed, index, 1])
    config, truth = true_terms(random_plant(base_config(), settings, seed, index), random)
    found = identified(config, design, random, kept)
    config = config.changed(virtual__ambient_degC=float(random.uniform(15.0, 55.0)))
    rows = []
    for changes in LAWS.values():
        for believed in (config, believing(config, found), believing(config, truth)):
            run = LockstepJoint(believed.changed(control=changes)).run()
            rows.append(errors(run, 0.0, PERIOD_s) if not run.fault else (np.inf, np.inf))
    return np.array(rows).reshape(len(LAWS), len(MODELS), 2)


def warm_up(design: Design) -> list[tuple[str, float, float, float]]:
    """(model, temperature at the end [degC], RMSE [mrad], the worst RMSE of a period [mrad]), from 20 degC on."""
    random = np.random.default_rng(7)
    heating = {"ambient_degC": 20.0, "thermal": True, "thermal_time_s": 100.0, "heating_KpA2": 6.0}
    config, _ = true_terms(base_config(), random)
    believed = believing(config, identified(config, design, random))
    rows = []
    for name, each in (("today's model", config), ("identified", believed)):
        run = LockstepJoint(each.changed(trajectory__duration_s=WARM_UP_s, virtual=heating)).run()
        periods = [errors(run, at_s, at_s + PERIOD_s)[1] for at_s in np.arange(PERIOD_s, WARM_UP_s, PERIOD_s)]
        whole = errors(run, PERIOD_s, WARM_UP_s)[1] if not run.fault else np.inf
        rows.append((name, float(run.plant.motor_temperature_degC), whole, max(periods)))
    return rows


def _print_law(found: np.ndarray) -> None:
    """The figures of one law, found (joints, models, errors)."""
    for model, name in enumerate(MODELS):
        for figure, unit in enumerate(("Nm of friction", "mrad of the joint")):
            low, middle, high = np.quantile(found[:, model, figure], (0.05, 0.5, 0.95), method="higher")
            print(f"  {name:14} {middle:8.4f} ({low:.4f} .. {high:.4f}) {unit}")
    for model in (1, 2):
        ratio = found[:, model] / found[:, 0]
        print(
            f"  {MODELS[model]}: at least halved on {np.mean(ratio[:, 0] <= 0.5):.0%} (friction), "
            f"{np.mean(ratio[:, 1] <= 0.5):.0%} (tracking); median ratio {np.median(ratio[:, 0]):.3f}, "
            f"{np.median(ratio[:, 1]):.3f}",
            flush=True,
        )


def main(joints: int = 40, seed: int = 90311, quiet_joints: int = 10, folder: Path | None = None) -> None:
    design = designed(config_of_sweep(base_config(), "torque"), MOTION_s, 1)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    for quiet, count in ((False, joints), (True, quiet_joints)):
        kind = "quiet" if quiet else "realistic"
        rows = []
        for index in range(count):
            kept = None if folder is None else folder / f"{seed}_{kind}_{index}.json"
            rows.append(random_joint(seed, index, design, quiet=quiet, kept=kept))
            print(f"{index}: {np.round(rows[-1], 4).tolist()}", file=sys.stderr, flush=True)
        found = np.array(rows)
        for law, title in enumerate(LAWS):
            print(f"{count} {kind} joints, seed {seed}, simulated, {title}; medians (5..95 %) of the first period")
            _print_law(found[:, law])
    for name, end, whole, worst in warm_up(design):
        print(f"warm-up 20 -> {end:.1f} degC, {name}: {whole:.4f} mrad RMSE, worst period {worst:.4f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]), *map(Path, sys.argv[4:5]))
