"""What friction by load and temperature buys: random simulated joints under `precise`, without learning.

    python -m tests.bench.load_and_temperature [joints] [seed]

Each joint carries a pendulum of 20 Nm and has a temperature of its own, 15 to 55 degC; how its friction goes with both
is drawn at random.  The controller believes the curve of 25 degC without load (today's model), or the true load and
temperature terms beside it, each wrong by up to 10 % (the extended one).  Errors: RMSE of the friction feed-forward
against the true friction, and of the joint itself, in the first period of the motion.  Then one joint warms up from 20
to 50 degC while it moves.  All of it is simulated.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from jointctl.hil.lockstep import TRUE_FRICTION_Nm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import FrictionLoad, FrictionTemperature
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant
from jointctl.tools.lockstep import LockstepJoint, LockstepRun

PENDULUM_Nm = 20.0
AMPLITUDE_rad = 1.4  # the load is then up to 19.7 Nm either way
PERIOD_s = 10.0
BELIEF_ERROR = 0.1
WARM_UP_s = 300.0


def base_config() -> Config:
    """`precise` without learning, a pendulum on the joint, and a drive that reports its temperature."""
    config = load_config(shipped_config("precise"))
    assert config.virtual is not None
    drive = {"temperature_object": "2103", "temperature_unit_degC": 0.1}
    limits = {"position_min_rad": -3.0, "position_max_rad": 3.0}
    return config.model_copy(
        update={
            "control": config.control.model_copy(update={"learning": None}),
            "joint": config.joint.model_copy(update={"gravity_Nm": PENDULUM_Nm}),
            "drive": config.drive.model_copy(update=drive),
            "limits": config.limits.model_copy(update=limits),
            "virtual": config.virtual.model_copy(update={"gravity_Nm": PENDULUM_Nm}),
            "trajectory": config.trajectory.model_copy(
                update={"amplitude_rad": AMPLITUDE_rad, "frequency_Hz": 1.0 / PERIOD_s, "duration_s": 3.0 * PERIOD_s}
            ),
        }
    )


def with_terms(config: Config, random: np.random.Generator, *, extended: bool, virtual: dict[str, Any]) -> Config:
    """The joint with its true terms, and what the controller believes of them."""
    assert config.friction is not None
    assert config.virtual is not None
    load = {"coulomb": random.uniform(0.03, 0.2), "viscous_spr": random.uniform(0.0, 0.1)}
    warm = {"coulomb_pK": random.uniform(0.002, 0.008), "viscous_pK": random.uniform(0.01, 0.03)}

    def friction(wrong: float) -> Any:
        def about(values: dict[str, float]) -> dict[str, float]:
            return {key: value * (1.0 + random.uniform(-wrong, wrong)) for key, value in values.items()}

        assert config.friction is not None
        terms = {"load": FrictionLoad(**about(load)),
                 "temperature": FrictionTemperature(reference_degC=25.0, **about(warm))}  # fmt: skip
        return config.friction.model_copy(update=terms)

    truth, belief = friction(0.0), friction(BELIEF_ERROR)
    return config.model_copy(
        update={
            "friction": belief if extended else config.friction,
            "virtual": config.virtual.model_copy(update={"friction": truth, **virtual}),
        }
    )


def errors(run: LockstepRun, after_s: float, before_s: float) -> tuple[float, float]:
    """(RMSE of the friction feed-forward [Nm] where the joint moves, RMSE of the joint itself [mrad])."""
    log = run.log
    chosen = run.tracking & (log.trajectory_s >= after_s) & (log.trajectory_s < before_s)
    moving = chosen & (np.abs(log.desired_velocity_radps) > 0.05)
    friction_Nm = log.friction_torque_Nm[moving] - run.truth[moving, TRUE_FRICTION_Nm]
    error_mrad = run.true_error_rad[chosen] * 1e3
    return float(np.sqrt(np.mean(friction_Nm**2))), float(np.sqrt(np.mean(error_mrad**2)))


def random_joints(joints: int, seed: int) -> np.ndarray:
    """(joints, 2 models, 2 errors) of the first period."""
    found = np.zeros((joints, 2, 2))
    settings = EnsembleSettings(friction_scale=(0.98, 1.02))
    for index in range(joints):
        drawn = random_plant(base_config(), settings, seed, index)
        for model in (0, 1):
            random = np.random.default_rng([seed, index, 1])
            virtual = {"ambient_degC": float(random.uniform(15.0, 55.0))}
            config = with_terms(drawn, random, extended=bool(model), virtual=virtual)
            run = LockstepJoint(config).run()
            found[index, model] = errors(run, 0.0, PERIOD_s) if not run.fault else np.inf
    return found


def warm_up(*, extended: bool) -> tuple[float, float, float, float]:
    """(temperature at the start, at the end [degC], RMSE [mrad], the worst RMSE of a period [mrad])."""
    config = base_config()
    virtual = {"ambient_degC": 20.0, "thermal": True, "thermal_time_s": 100.0, "heating_KpA2": 6.0}
    config = with_terms(config, np.random.default_rng(7), extended=extended, virtual=virtual)
    trajectory = config.trajectory.model_copy(update={"duration_s": WARM_UP_s})
    joint = LockstepJoint(config.model_copy(update={"trajectory": trajectory}))
    run = joint.run()
    periods = [errors(run, at_s, at_s + PERIOD_s)[1] for at_s in np.arange(PERIOD_s, WARM_UP_s, PERIOD_s)]
    whole = errors(run, PERIOD_s, WARM_UP_s)[1] if not run.fault else np.inf
    return 20.0, float(run.plant.motor_temperature_degC), whole, max(periods)


def main(joints: int = 40, seed: int = 90311) -> None:
    found = random_joints(joints, seed)
    print(f"{joints} joints, seed {seed}, simulated; medians (5..95 %) of the first period")
    for model, name in enumerate(("today's model", "load and temperature")):
        for figure, unit in enumerate(("Nm of friction", "mrad of the joint")):
            low, middle, high = np.quantile(found[:, model, figure], (0.05, 0.5, 0.95), method="higher")
            print(f"  {name:22} {middle:8.4f} ({low:.4f} .. {high:.4f}) {unit}")
    halved = np.mean(found[:, 1] <= 0.5 * found[:, 0], axis=0)
    print(f"  at least halved on {halved[0]:.0%} (friction), {halved[1]:.0%} (tracking) of the joints")
    for extended in (False, True):
        start, end, whole, worst = warm_up(extended=extended)
        name = "load and temperature" if extended else "today's model"
        print(f"warm-up {start:.0f} -> {end:.1f} degC, {name}: {whole:.4f} mrad RMSE, worst period {worst:.4f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
