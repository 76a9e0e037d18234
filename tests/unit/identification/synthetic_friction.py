"""Friction data whose parameters are known (Table 3), as arrays and as sweep files, and a quick identification."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, FrictionData, sidecar_contents
from jointctl.tools.identification.identification import Options
from jointctl.tools.identification.plausibility import JointLimits
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.output import Output

# --- Synthetic friction data of Table 3, and options that make an identification quick ---
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


# --- Sweeps with known friction, as files ---
def write_sweep(path, seed=0, factor=1.0, noise_Nm=0.0046, **sidecar):
    velocity = np.linspace(-200.0, 200.0, 224) * DEGREE
    noise = np.random.default_rng(seed).normal(0.0, noise_Nm, len(velocity))
    torque = factor * (friction_curve_Nm(paper_friction(), velocity) + noise)
    lines = [",".join(SWEEP_COLUMNS)]
    for v, t in zip(velocity, torque, strict=True):
        lines.append(f"{v:.9g},{t / 0.1:.9g},{t:.9g},0.01,0.05,500,1,-0.5,0.5,1.0,,{1 if v > 0 else -1},0")
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".json").write_text(json.dumps(sidecar_contents(121.0, 0.1, **sidecar)))
    return path


def output(**options):
    return Output(stdout=io.StringIO(), stderr=io.StringIO(), **options)
