"""Synthetic friction data of Table 3, and options that make an identification quick."""

from pathlib import Path

import numpy as np

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.friction_data import FrictionData
from jointctl.tools.identification.identification import Options
from jointctl.tools.identification.plausibility import JointLimits
from jointctl.tools.identification.swarm import SwarmSettings

NOISE_Nm = 0.0046
UNIFORM_radps = np.linspace(-200.0, 200.0, 225) * DEGREE
DENSE_radps = np.concatenate([-np.geomspace(0.2, 200.0, 112)[::-1], np.geomspace(0.2, 200.0, 112)]) * DEGREE
QUICK = Options(folds=4, swarm=SwarmSettings(particles=150, iterations=300))
LIMITS = JointLimits(torque_max_Nm=60.0, velocity_max_radps=3.5, reduction_ratio=121.0, torque_constant_NmpA=0.1)


def paper_data(seed=0, velocity_radps=UNIFORM_radps, noise_Nm=NOISE_Nm, torque_factor=1.0, speed_factor=1.0,
               ratio=121.0, offset_Nm=0.0):  # fmt: skip
    velocity_radps = velocity_radps[velocity_radps != 0.0]
    noise = np.random.default_rng(seed).normal(0.0, noise_Nm, len(velocity_radps))
    torque = (friction_curve_Nm(paper_friction(), velocity_radps) + noise + offset_Nm) * torque_factor
    velocity_radps = velocity_radps * speed_factor
    order = np.argsort(velocity_radps)
    count = len(order)
    return FrictionData(
        Path("sweep.csv"), "0" * 64, velocity_radps[order], torque[order], np.arange(2, count + 2),
        np.ones(count, bool), ratio, 0.1,
    )  # fmt: skip
