"""What [friction.angle] buys, as it is identified: random simulated joints, by the chain that a user goes through.

    python -m tests.bench.angle_friction [joints] [seed]

The friction of each joint goes with the angle, once a joint turn and 1, 2 and 4 times a motor turn, with amplitudes and
phases drawn at random; ripple, delay, lag, stick-slip and encoder are those of `study`.  It is moved as `excite` does,
its log goes through `identify`, the section and the ripple that it names go into the configuration, and the first
period of another motion is run without learning.  Errors: peak and RMSE of the joint in that period.  All of it is
simulated.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it; before numpy

import numpy as np

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import Friction, FrictionAngle, Ripple
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant
from jointctl.tools.identification.models import ORDERS
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.motion_fit import MotionFit, identify_motion
from jointctl.tools.identification.motion_report import motion_section
from jointctl.tools.identification.tables import ForeignFormat
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import config_of_sweep
from jointctl.tools.sweeping.excitation import Design, designed
from jointctl.tools.verbs.identify import motion_from
from tests.bench.load_and_temperature import excited

AMPLITUDES = {"j1": (0.03, 0.12), "m1": (0.03, 0.10), "m2": (0.02, 0.08), "m4": (0.01, 0.05)}
PERIOD_s = 10.0
MOTION_s = 120.0
BELIEVED = ("the file's curve", "identified, no angle", "identified", "identified, [ripple]", "true [friction.angle]")
LAWS: dict[str, dict[str, Any]] = {  # changes of [control]
    "precise": {},
    "precise, observer_paired, lead auto": {"observer_paired": True, "feed_forward_lead_s": "auto"},
    "no observer": {"kind": "computed_torque", "observer_radps": 0.0},
}


def true_angle(ratio: float, random: np.random.Generator) -> FrictionAngle:
    """The share of the friction that goes with the angle."""
    periods = [ORDERS[order][0] / (1.0 if ORDERS[order][1] else ratio) for order in AMPLITUDES]
    shares = [random.uniform(*ends) for ends in AMPLITUDES.values()]
    phases = random.uniform(-np.pi, np.pi, len(periods))
    return FrictionAngle(share=tuple(shares), per_motor_turn=tuple(periods), phase_rad=tuple(phases.tolist()))


def base_config() -> Config:
    config = load_config(shipped_config("precise"))
    return config.changed(control__learning=None, trajectory__duration_s=PERIOD_s)


def identified(config: Config, design: Design) -> MotionFit:
    """What `identify` makes of the log of `excite`."""
    with TemporaryDirectory() as name:
        log = excited(config, design, config.virtual.ambient_degC, Path(name))
        settings = MotionSettings(speed_min_radps=0.8 * design.slowest_radps)
        return identify_motion(motion_from(log, ForeignFormat(), settings), settings)


def believing(config: Config, friction: Friction, ripple: Ripple | None = None) -> Config:
    """With another section, whose bristles are those of the file, and the ripple that was found."""
    return config.changed(friction=friction, ripple=ripple, friction__lugre=config.friction.lugre)


def found_ripple(found: MotionFit) -> Ripple | None:
    """The section that the remarks of `identify` name."""
    waves = found.model.waves(found.value, "ripple", found.motion.reduction_ratio)
    if not waves or found.motion.mounting is None:
        return None
    amplitudes, periods, phases = zip(*waves[:4], strict=True)
    return Ripple(**found.motion.mounting, torque_Nm=amplitudes, per_motor_turn=periods, phase_rad=phases)


def random_joint(seed: int, index: int, design: Design) -> tuple[np.ndarray, str]:
    """(laws, believed, peak and RMSE [mrad]) of the first period of one joint, and what was true and found."""
    random = np.random.default_rng([seed, index, 2])
    config = random_plant(base_config(), EnsembleSettings(friction_scale=(0.98, 1.02)), seed, index)
    assert config.virtual is not None
    angle = true_angle(config.joint.reduction_ratio, random)
    truth = config.friction.model_copy(update={"angle": angle})
    config = config.changed(virtual__friction=truth)
    found = identified(config, design)
    section = Friction.model_validate(motion_section(found))
    believed = (
        config, believing(config, section.model_copy(update={"angle": None})), believing(config, section),
        believing(config, section, found_ripple(found)), believing(config, truth),
    )  # fmt: skip
    rows = []
    for changes in LAWS.values():
        for each in believed:
            run = LockstepJoint(each.changed(control=changes)).run()
            error_mrad = run.true_error_rad[run.tracking] * 1e3
            rows.append(
                (np.inf, np.inf) if run.fault else (np.max(np.abs(error_mrad)), np.sqrt(np.mean(error_mrad**2)))
            )
    waves = found.model.waves(found.value, "angle", found.motion.reduction_ratio)
    words = [
        "; ".join(f"{share:.3f} {periods:.3g}/turn {phase:+.2f}" for share, periods, phase in each) or "none"
        for each in (zip(angle.share, angle.per_motor_turn, angle.phase_rad, strict=True), waves)
    ]
    shape = (len(LAWS), len(BELIEVED), 2)
    return np.array(rows).reshape(shape), f"true {words[0]} | found {words[1]}"


def main(joints: int = 12, seed: int = 40811) -> None:
    design = designed(config_of_sweep(base_config(), "torque"), MOTION_s, 1)
    rows = []
    for index in range(joints):
        figures, words = random_joint(seed, index, design)
        rows.append(figures)
        print(f"{index}: {words}\n   {np.round(figures, 4).tolist()}", file=sys.stderr, flush=True)
    found = np.array(rows)
    for law, title in enumerate(LAWS):
        print(f"{joints} joints, seed {seed}, simulated, {title}; medians (least .. greatest) of the first period")
        for model, name in enumerate(BELIEVED):
            peak, rmse = found[:, law, model].T
            ratio = found[:, law, model, 0] / found[:, law, 0, 0]
            print(
                f"  {name:24} peak {np.median(peak):.4f} ({peak.min():.4f} .. {peak.max():.4f}) mrad, RMSE "
                f"{np.median(rmse):.4f} ({rmse.min():.4f} .. {rmse.max():.4f}) mrad; peak of the first "
                f"{np.median(ratio):.2f} ({ratio.min():.2f} .. {ratio.max():.2f})"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
