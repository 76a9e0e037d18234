"""`jointctl identify DATA`: a friction model from measured plateaus, into a configuration.

Nothing is written unless the whole computation succeeds; every file is replaced in one step.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.configuration.conversions import torque_constant_NmpA
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.drawing import png
from jointctl.tools.identification.friction_data import ForeignFormat, read_friction_data
from jointctl.tools.identification.identification import Identification, Options, identify_friction
from jointctl.tools.identification.identification_report import (
    convergence_figure,
    error_table,
    fit_figure,
    identification_report,
    model_table,
    parameter_table,
    section_values,
    snippet,
    write_into,
)
from jointctl.tools.identification.plausibility import JointLimits
from jointctl.tools.output import Output
from jointctl.tools.reporting.page import (
    Block,
    Details,
    Section,
    check_target,
    from_terminal,
    svg_figure,
    write_verb_page,
)
from jointctl.tools.reporting.page import remarks as notes_of
from jointctl.tools.written_file import replace_file, require_target


def joint_limits(config_path: Path) -> JointLimits:
    """What the checks of plausibility need of a configuration."""
    config = load_config(config_path)
    return JointLimits(
        config.limits.torque_max_Nm, config.limits.velocity_max_radps, config.joint.reduction_ratio,
        torque_constant_NmpA(config),
    )  # fmt: skip


def _limits(into: Path | None, config: Path | None, output: Output) -> JointLimits | None:
    if config is not None:
        return joint_limits(config)
    if into is None:
        return None
    try:
        return joint_limits(into)
    except ConfigurationError as error:
        # it may be incomplete just because [friction] is what it waits for
        if "[friction] is missing" not in error.message:
            raise
        output.warning(f"{into}: cannot be compared with the data before it has [friction]")
        return None


def _not_compensated(path: Path) -> bool:
    """Whether the configuration has a friction section that its law does not use; False if it cannot be read yet."""
    try:
        return load_config(path).control.feed_forward == "none"
    except ConfigurationError:
        return False


def remarks(found: Identification) -> list[str]:
    """Comment lines above the section: where the numbers come from."""
    swarm = found.options.swarm
    return [
        f"{found.data.path.name}, SHA-256 {found.data.sha256}",
        f"model {found.model}, seed {swarm.seed}, {swarm.particles} particles x {swarm.iterations} iterations",
        f"RMSE {found.rmse_Nm:.4g} Nm, held out {found.held_out_by_model_Nm[found.model]:.4g} Nm at the motor",
    ]


def identify(
    data_path: Path,
    output: Output,
    *,
    into: Path | None = None,
    out: Path | None = None,
    config: Path | None = None,
    told: ForeignFormat | None = None,
    options: Options | None = None,
    report: Path | None = None,
) -> int:
    """Identify, report, write; returns the exit code.

    `into`: configuration whose [friction] is replaced; `out`: TOML file with the section alone (default, if `into` is
    not given: DATA.friction.toml).  `config` only serves to compare with limits and constants of the joint.  Figures
    and a JSON report go beside the TOML file, or beside the data with `into`.  `report`: HTML page to write as well.
    """
    options = options or Options()
    if out is not None and out.suffix != ".toml":
        raise DataError(f"{out}: the name of the section's file (-o) must end in .toml")
    if report is not None:
        check_target(report, [path for path in (data_path, into, config) if path is not None])
    if into is not None and not into.exists() and shipped_config(into.name).exists():
        hint = f"`jointctl new FILE --from {into.stem}` makes one of your own"
        raise DataError(f"--into {into}: a shipped configuration is not written into", hint)
    limits = _limits(into, config, output)
    data = read_friction_data(data_path, told)
    if limits is None and data.recorded_limits is None:
        output.warning(
            f"{data_path}: no limits of the joint are known: sizes of torque and speed could not be checked, a wrong "
            "torque constant, ratio, unit or side may go unnoticed; --config CONFIG checks them"
        )
    total = 2.0 * options.swarm.iterations
    with output.progress("particle swarm", total) as advance:
        found = identify_friction(data, options, limits=limits, progress=advance)
    for note in found.notes:
        output.note(f"{data_path}: {note}")
    for warning in found.warnings:
        output.warning(warning)

    if out is None and into is None:
        out = data_path.with_suffix(".friction.toml")
    stem = out.with_suffix("") if out is not None else data_path.with_suffix(".friction")
    used = {word: direction.index for word, direction in found.directions.items()}
    outliers = np.concatenate([direction.outliers for direction in found.directions.values()])
    fit = fit_figure(
        data, found.branches, used, f"{data_path.name}: {found.model}", outliers=outliers, identified=found
    )
    convergence = convergence_figure(found)
    values = section_values(found.branches["positive"], found.branches["negative"])
    result = {**found.to_dict(), "friction": values}
    files = {
        stem.with_name(stem.name + ".png"): png(fit),
        stem.with_name(stem.name + ".report.json"): json.dumps(result, indent=1, allow_nan=False).encode("utf-8"),
    }
    if convergence is not None:
        files[stem.with_name(stem.name + ".convergence.png")] = png(convergence)
    if out is not None:
        files[out] = snippet(values, remarks(found)).encode("utf-8")
    protected = [p for p in (data_path, data_path.with_suffix(".json"), into, config) if p is not None]
    for path in files:
        require_target(path, protected)
    if into is not None:  # first, because it is the one that may be refused
        write_into(into, values, remarks(found))
    for path, content in files.items():
        replace_file(path, content)
    output.result(identification_report(found), {**result, "files": [str(p) for p in files]})
    for path in ([into] if into is not None else []) + list(files):
        output.note(f"written: {path}")
    if into is not None and _not_compensated(into):
        output.warning(f'{into}: control.feed_forward (="none") leaves the friction to the feedback; "desired" uses it')
    if report is not None:
        _write_page(report, found, fit, convergence, snippet(values, remarks(found)), output)
    return 0


def _write_page(
    path: Path, found: Identification, fit: Any, convergence: Any | None, section: str, output: Output
) -> None:
    errors = error_table(found.errors_Nm, found.measured_Nm, found.data.reduction_ratio)
    pictures: list[Block] = [svg_figure(fit, "Measured friction torque and the model, and the error between them")]
    if convergence is not None:
        pictures.append(svg_figure(convergence, "How the particle swarm converged"))
    sections = [
        Section("Fit", [*notes_of(found.warnings), from_terminal(model_table(found)), from_terminal(errors)]),
        Section("Parameters", [from_terminal(parameter_table(found))]),
        Section("Figures", pictures),
        Section("Origin", [*notes_of(remarks(found), ""), Details("The section for a configuration", section)]),
    ]
    title = f"Friction of {found.data.path.stem}: {found.model}"
    write_verb_page(path, title, sections, output, subtitle=str(found.data.path), inputs=(found.data.path,))
