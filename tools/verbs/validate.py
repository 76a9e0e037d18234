"""`jointctl validate CONFIG DATA`: the identified friction model against other data of the same joint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.identification.tables import OURS, ForeignFormat
from jointctl.tools.verbs.identify import joint_limits
from jointctl.tools.verbs.verb_options import VerbOutput, config_path, configurations

if TYPE_CHECKING:
    import numpy as np

    from jointctl.tools.identification.friction_data import FrictionData
    from jointctl.tools.identification.models import Branch


@dataclass(frozen=True)
class Validation:
    """Errors of a friction model, measured torque minus the model's; at the motor."""

    config: str
    data: str
    data_sha256: str
    points: int
    rmse_Nm: float
    max_error_Nm: float
    mean_error_Nm: float
    relative_rmse: float
    relative_max_error: float
    warnings: list[str]
    notes: list[str]
    picture: str


def _branch(record: Any) -> Branch:
    from jointctl.tools.identification.models import Branch

    a = [float(c) for c in record.cubic]
    return Branch(
        float(record.coulomb_Nm), float(record.static_Nm), float(record.stribeck_speed_radps),
        float(record.viscous_Nmspr), (a[0], a[1], a[2], a[3]), float(record.knee_radps), float(record.max_radps),
    )  # fmt: skip


def model_errors_Nm(data: FrictionData, branches: dict[str, Branch]) -> tuple[np.ndarray, np.ndarray]:
    """(measured - model, measured) at the motor over the usable points, positive velocities first."""
    import numpy as np

    from jointctl.tools.identification.identification import DIRECTIONS

    errors, measured = [], []
    for word, sign in DIRECTIONS:
        chosen = data.direction(sign)
        torque = data.motor_torque_Nm[chosen]
        errors.append(torque - sign * branches[word].torque_Nm(np.abs(data.velocity_radps[chosen])))
        measured.append(torque)
    return np.concatenate(errors), np.concatenate(measured)


def validate(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG", help="configuration with the identified friction section", autocompletion=configurations
        ),
    ],
    data_path: Annotated[Path, typer.Argument(metavar="DATA", help="CSV of velocity plateaus")],
    output: VerbOutput,
    *,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG to write")] = None,
    given: ForeignFormat = OURS,
) -> int:
    """An identified friction model against other data of the same joint."""
    import numpy as np

    from jointctl.tools.configuration.conversions import friction_constants
    from jointctl.tools.configuration.load import load_config
    from jointctl.tools.drawing import png, require_png
    from jointctl.tools.identification.friction_data import read_friction_data, relative_figures
    from jointctl.tools.identification.identification import DIRECTIONS
    from jointctl.tools.identification.identification_report import error_table, fit_figure
    from jointctl.tools.identification.plausibility import check_data
    from jointctl.tools.written_file import replace_file, with_ending

    path = config_path(path)
    figure = figure or with_ending(data_path, ".validation.png")
    require_png(figure, (data_path, with_ending(data_path, ".json"), path))
    config = load_config(path)
    if config.friction is None:
        raise ConfigurationError(f"{path}: [friction] is missing: there is nothing to validate", "identify first")
    data = read_friction_data(data_path, given, both=False)
    verdict = check_data(data, joint_limits(path))
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
    picture = png(fit_figure(data, branches, used, f"{path.name} against {data_path.name}"))
    replace_file(figure, picture)
    for note in data.notes:
        output.note(f"{data_path}: {note}")
    for warning in warnings:
        output.warning(warning)
    relative_rmse, relative_worst, _ = relative_figures(errors, measured)
    found = Validation(
        config=str(path), data=str(data_path), data_sha256=data.sha256, points=len(errors),
        rmse_Nm=float(np.sqrt(np.mean(errors**2))), max_error_Nm=float(np.max(np.abs(errors))),
        mean_error_Nm=float(np.mean(errors)), relative_rmse=relative_rmse, relative_max_error=relative_worst,
        warnings=warnings, notes=list(data.notes), picture=str(figure),
    )  # fmt: skip
    output.result(error_table(errors, measured, data.reduction_ratio), vars(found), found)
    output.note(f"written: {figure}")
    return 0
