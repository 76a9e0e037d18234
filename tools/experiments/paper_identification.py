"""Section 4.1 of the paper: identify its own friction model from a synthetic sweep.

The measured points are not published, so that Table 3 is taken as the truth: 225 speeds, evenly spaced over both
directions, normally distributed noise of 0.0046 Nm, the RMSE that the paper states.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.identification.friction_data import FrictionData
from jointctl.tools.identification.identification import Identification, Options, identify_friction
from jointctl.tools.identification.identification_report import fit_figure

POINTS = 225
NOISE_Nm = 0.0046
TOP_radps = 200.0 * DEGREE
_REDUCTION = 121.0


@dataclass(frozen=True)
class PaperIdentification:
    """What was found, beside what was put in."""

    found: Identification
    rmse_Nm: float
    stribeck_rmse_Nm: float
    coulomb_rmse_Nm: float
    curve_error_Nm: float  # greatest difference of the found curve from Table 3 over the speeds of the sweep


def synthetic_sweep(seed: int = 1) -> FrictionData:
    """Table 3 with noise, as `jointctl sweep` would have measured it."""
    velocity = np.linspace(-TOP_radps, TOP_radps, POINTS + 1)
    velocity = np.delete(velocity, int(np.argmin(np.abs(velocity))))
    noise = np.random.default_rng(seed).normal(0.0, NOISE_Nm, len(velocity))
    return FrictionData(
        path=Path("synthetic sweep of Table 3"),
        sha256="",
        velocity_radps=velocity,
        motor_torque_Nm=friction_curve_Nm(paper_friction(), velocity) + noise,
        line=np.arange(1, len(velocity) + 1),
        settled=np.ones(len(velocity), dtype=bool),
        reduction_ratio=_REDUCTION,
        torque_constant_NmpA=None,
    )


def identify_paper_friction(options: Options | None = None, seed: int = 1) -> PaperIdentification:
    """Identify the synthetic sweep with the swarm of the paper, or with other options."""
    data = synthetic_sweep(seed)
    found = identify_friction(data, options or Options())
    truth = friction_curve_Nm(paper_friction(), data.velocity_radps)
    curve = np.empty_like(truth)
    for word, sign in (("positive", 1.0), ("negative", -1.0)):
        chosen = sign * data.velocity_radps > 0.0
        curve[chosen] = sign * found.branches[word].torque_Nm(sign * data.velocity_radps[chosen])
    return PaperIdentification(
        found=found,
        rmse_Nm=found.rmse_Nm,
        stribeck_rmse_Nm=found.rmse_by_model_Nm["stribeck"],
        coulomb_rmse_Nm=found.rmse_by_model_Nm["coulomb"],
        curve_error_Nm=float(np.max(np.abs(curve - truth))),
    )


def identification_figure(result: PaperIdentification) -> Any:
    """Fig. 7: points, curve and errors."""
    found = result.found
    used = {word: direction.index for word, direction in found.directions.items()}
    return fit_figure(
        found.data, found.branches, used, "Fig. 7: friction identified from a synthetic sweep", identified=found
    )
