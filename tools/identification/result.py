"""What an identification found: parameters, errors and intervals of both directions, and all of it as numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.tools.identification.friction_data import FrictionData, relative_figures
from jointctl.tools.identification.intervals import Uncertainty
from jointctl.tools.identification.models import Branch
from jointctl.tools.identification.options import Options
from jointctl.tools.identification.pso import SwarmResult
from jointctl.tools.identification.variable_projection import Fit

DIRECTIONS = (("positive", 1), ("negative", -1))


@dataclass(frozen=True)
class Direction:
    """The result of one direction; arrays over the used points are in `fit.problem`, mirrored."""

    fit: Fit
    swarm: SwarmResult | None
    projected_rmse_Nm: float
    source: str  # where the parameters come from: swarm and polish, or variable projection
    uncertainty: Uncertainty
    index: np.ndarray  # of the used points in the data
    outliers: np.ndarray  # indices in the data


@dataclass(frozen=True)
class Identification:
    """All that there is to tell; `errors_Nm` is measured minus model over the used points of both directions."""

    data: FrictionData
    options: Options
    model: str
    directions: dict[str, Direction]
    rmse_by_model_Nm: dict[str, float]
    held_out_by_model_Nm: dict[str, float]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def branches(self) -> dict[str, Branch]:
        return {word: found.fit.branch() for word, found in self.directions.items()}

    @property
    def errors_Nm(self) -> np.ndarray:
        parts = []
        for word, sign in DIRECTIONS:
            fit = self.directions[word].fit
            parts.append(sign * (fit.problem.y_Nm - fit.torque_Nm(fit.problem.x)))
        return np.concatenate(parts)

    @property
    def measured_Nm(self) -> np.ndarray:
        return np.concatenate([sign * self.directions[word].fit.problem.y_Nm for word, sign in DIRECTIONS])

    @property
    def rmse_Nm(self) -> float:
        return float(np.sqrt(np.mean(self.errors_Nm**2)))

    @property
    def projected_rmse_Nm(self) -> float:
        """What variable projection reaches: the least possible."""
        return _pooled({w: d.projected_rmse_Nm for w, d in self.directions.items()}, self.directions)

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers, texts, lists and dicts; parameters mirrored, joint rad/s and motor Nm."""
        errors, swarm = self.errors_Nm, self.options.swarm
        relative = relative_figures(errors, self.measured_Nm)
        return {
            "data": str(self.data.path), "data_sha256": self.data.sha256, "model": self.model,
            "reduction_ratio": self.data.reduction_ratio, "points": len(errors),
            "rmse_Nm": self.rmse_Nm, "max_error_Nm": float(np.max(np.abs(errors))),
            "relative_rmse": relative[0],
            "relative_max_error": relative[1],
            "held_out_rmse_Nm": self.held_out_by_model_Nm[self.model],
            "projected_rmse_Nm": self.projected_rmse_Nm,
            "models": {
                name: {"rmse_Nm": self.rmse_by_model_Nm[name], "held_out_rmse_Nm": self.held_out_by_model_Nm[name]}
                for name in self.rmse_by_model_Nm
            },
            "swarm": {
                "seed": swarm.seed, "particles": swarm.particles, "iterations": swarm.iterations,
                "inertia": swarm.inertia, "cognitive": swarm.cognitive, "social": swarm.social,
            },
            "directions": {word: _direction_dict(found, self.data) for word, found in self.directions.items()},
            "notes": list(self.notes), "warnings": list(self.warnings),
        }  # fmt: skip


def _direction_dict(found: Direction, data: FrictionData) -> dict[str, Any]:
    model = found.fit.branch()
    return {
        "parameters": {
            name: {"value": i.value, "low": i.low, "high": i.high, "weak": i.weak or None}
            for name, i in found.uncertainty.intervals.items()
        },
        "knee_radps": model.knee_radps, "max_radps": model.max_radps, "rmse_Nm": found.fit.rmse_Nm,
        "swarm_rmse_Nm": found.swarm.fit.rmse_Nm if found.swarm else None,
        "projected_rmse_Nm": found.projected_rmse_Nm, "source": found.source,
        "iterations": found.swarm.iterations if found.swarm else 0,
        "outlier_lines": [int(n) for n in data.line[found.outliers]],
    }  # fmt: skip


def _pooled(rmse: dict[str, float], directions: dict[str, Any]) -> float:
    count = {word: len(d.fit.problem.x) for word, d in directions.items()}
    return float(np.sqrt(sum(rmse[w] ** 2 * count[w] for w in rmse) / sum(count.values())))
