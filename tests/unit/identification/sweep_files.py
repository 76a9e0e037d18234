"""Sweeps with known friction, as files."""

import io
import json

import numpy as np

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, sidecar_contents
from jointctl.tools.output import Output


def write_sweep(path, seed=0, factor=1.0, noise_Nm=0.0046):
    velocity = np.linspace(-200.0, 200.0, 224) * DEGREE
    noise = np.random.default_rng(seed).normal(0.0, noise_Nm, len(velocity))
    torque = factor * (friction_curve_Nm(paper_friction(), velocity) + noise)
    lines = [",".join(SWEEP_COLUMNS)]
    for v, t in zip(velocity, torque, strict=True):
        lines.append(f"{v:.9g},{t / 0.1:.9g},{t:.9g},0.01,0.05,500,1,-0.5,0.5,1.0,,{1 if v > 0 else -1},0")
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".json").write_text(json.dumps(sidecar_contents(121.0, 0.1)))
    return path


def output(**options):
    return Output(stdout=io.StringIO(), stderr=io.StringIO(), **options)
