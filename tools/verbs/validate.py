"""`jointctl validate CONFIG DATA`: the identified friction model against other data of the same joint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.configuration.conversions import friction_constants
from jointctl.tools.configuration.load import load_config
from jointctl.tools.drawing import png, require_png
from jointctl.tools.identification.friction_data import (
    ForeignFormat,
    FrictionData,
    read_friction_data,
    relative_figures,
)
from jointctl.tools.identification.identification import DIRECTIONS
from jointctl.tools.identification.identification_report import error_table, fit_figure
from jointctl.tools.identification.models import Branch
from jointctl.tools.identification.plausibility import check_data
from jointctl.tools.output import Output
from jointctl.tools.verbs.identify import joint_limits
from jointctl.tools.written_file import replace_file


def _branch(record: Any) -> Branch:
    a = [float(c) for c in record.cubic]
    return Branch(
        float(record.coulomb_Nm), float(record.static_Nm), float(record.stribeck_speed_radps),
        float(record.viscous_Nmspr), (a[0], a[1], a[2], a[3]), float(record.knee_radps), float(record.max_radps),
    )  # fmt: skip


def model_errors_Nm(data: FrictionData, branches: dict[str, Branch]) -> tuple[np.ndarray, np.ndarray]:
    """(measured - model, measured) at the motor over the usable points, positive velocities first."""
    errors, measured = [], []
    for word, sign in DIRECTIONS:
        chosen = data.direction(sign)
        torque = data.motor_torque_Nm[chosen]
        errors.append(torque - sign * branches[word].torque_Nm(np.abs(data.velocity_radps[chosen])))
        measured.append(torque)
    return np.concatenate(errors), np.concatenate(measured)


def validate(
    config_path: Path, data_path: Path, output: Output, *, told: ForeignFormat | None = None, figure: Path | None = None
) -> int:
    """Compare, report, draw (default DATA.validation.png); returns the exit code."""
    figure = figure or data_path.with_suffix(".validation.png")
    require_png(figure, (data_path, data_path.with_suffix(".json"), config_path))
    config = load_config(config_path)
    if config.friction is None:
        raise ConfigurationError(
            f"{config_path}: [friction] is missing: there is nothing to validate", "identify first"
        )
    data = read_friction_data(data_path, told, both=False)
    verdict = check_data(data, joint_limits(config_path))
    if verdict.problems:
        raise DataError(f"{data_path}: {'; '.join(verdict.problems)}")
    record = friction_constants(config.friction, config.joint.reduction_ratio)[0]
    branches = {"positive": _branch(record.positive), "negative": _branch(record.negative)}
    errors, measured = model_errors_Nm(data, branches)
    warnings = list(verdict.warnings)
    for word, sign in DIRECTIONS:
        beyond = np.abs(data.velocity_radps[data.direction(sign)]) > branches[word].max_radps * 1.001
        if beyond.any():
            warnings.append(
                f"{np.count_nonzero(beyond)} points at {word} velocity are faster than the model's range "
                f"({branches[word].max_radps:.4g} rad/s), where its end slope is held"
            )
    used = {word: data.direction(sign) for word, sign in DIRECTIONS}
    picture = png(fit_figure(data, branches, used, f"{config_path.name} against {data_path.name}"))
    replace_file(figure, picture)
    for note in data.notes:
        output.note(f"{data_path}: {note}")
    for warning in warnings:
        output.warning(warning)
    relative_rmse, relative_worst, _ = relative_figures(errors, measured)
    output.result(
        error_table(errors, measured, data.reduction_ratio),
        {
            "config": str(config_path), "data": str(data_path), "data_sha256": data.sha256, "points": len(errors),
            "rmse_Nm": float(np.sqrt(np.mean(errors**2))), "max_error_Nm": float(np.max(np.abs(errors))),
            "mean_error_Nm": float(np.mean(errors)), "relative_rmse": relative_rmse,
            "relative_max_error": relative_worst, "warnings": warnings, "notes": list(data.notes),
            "picture": str(figure),
        },
    )  # fmt: skip
    output.note(f"written: {figure}")
    return 0
