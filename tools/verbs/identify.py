"""`jointctl identify DATA`: a friction model from measured plateaus or from any motion, into a configuration.

Nothing is written unless the whole computation succeeds; every file is replaced in one step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.identification.tables import OURS, ForeignFormat
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import Report, VerbOutput, config_path, configuration_files, configurations

if TYPE_CHECKING:
    from rich.console import RenderableType

    from jointctl.tools.identification.identification import Identification, Options
    from jointctl.tools.identification.motion_data import Motion, MotionSettings
    from jointctl.tools.identification.plausibility import JointLimits
    from jointctl.tools.recording.report_page import Block, Section


Data = Annotated[
    Path, typer.Argument(metavar="DATA", help="CSV of velocity plateaus, run log (MCAP), or table of a motion in time")
]
Model = Annotated[
    str, typer.Option("--model", help="auto (least held-out error), multi-stage, stribeck or coulomb-viscous")
]


@dataclass(frozen=True)
class FitOptions:
    """How to fit: fields of `Options` and of `SwarmSettings`, speeds in deg/s."""

    model: Model = "auto"
    continuous: Annotated[bool, typer.Option("--continuous", help="let the two stages meet at the knees")] = False
    search_knee: Annotated[bool, typer.Option("--search-knee", help="search the knees as well")] = False
    knee: Annotated[float, typer.Option("--knee", help="speed at which the stages change (deg/s of the joint)")] = 40.0
    ws_min: Annotated[float | None, typer.Option("--ws-min", help="least Stribeck speed (deg/s)")] = None
    ws_max: Annotated[float, typer.Option("--ws-max", help="greatest Stribeck speed (deg/s)")] = 20.0
    static_max_Nm: Annotated[
        float | None, typer.Option("--static-max", help="greatest static friction (Nm, motor)")
    ] = None
    outlier_threshold: Annotated[float, typer.Option("--outlier-threshold", help="robust deviations; 0 = off")] = 5.0
    folds: Annotated[int, typer.Option("--folds", help="of the held-out error")] = 10
    particles: Annotated[int, typer.Option("--particles")] = 1000
    iterations: Annotated[int, typer.Option("--iterations")] = 5000
    inertia: Annotated[float, typer.Option("--inertia", help="of the swarm")] = 0.7298
    cognitive: Annotated[float, typer.Option("--cognitive")] = 1.49618
    social: Annotated[float, typer.Option("--social")] = 1.49618
    seed: Annotated[int, typer.Option("--seed")] = 1
    stall: Annotated[int, typer.Option("--stall", help="stop after so many iterations without progress; 0 = never")] = 0
    band: Annotated[
        float | None, typer.Option("--band", help="of the differentiation of a motion (Hz); 20 if not given")
    ] = None
    speed_min: Annotated[float, typer.Option("--speed-min", help="of the samples of a motion (rad/s)")] = 0.05
    acceleration_max: Annotated[
        float, typer.Option("--acceleration-max", help="of the samples of a motion (rad/s2)")
    ] = math.inf
    mean_samples: Annotated[
        int | None, typer.Option("--mean-samples", help="running mean of a motion, in place of the band's low-pass")
    ] = None
    also: Annotated[
        list[Path] | None,
        typer.Option("--also", help="a further motion of the joint, warmer or with another load; may be repeated"),
    ] = None


def _fit(given: FitOptions) -> Options:
    from jointctl.tools.identification.identification import Options
    from jointctl.tools.identification.motion_data import MotionSettings
    from jointctl.tools.identification.swarm import SwarmSettings

    also = tuple(given.also or ())
    motion = MotionSettings(given.band, given.speed_min, given.acceleration_max, given.mean_samples, also)
    swarm = SwarmSettings(**{field.name: getattr(given, field.name) for field in fields(SwarmSettings)})
    same = ("model", "continuous", "search_knee", "static_max_Nm", "outlier_threshold", "folds")
    return Options(
        **{name: getattr(given, name) for name in same},
        knee_radps=math.radians(given.knee),
        ws_min_radps=None if given.ws_min is None else math.radians(given.ws_min),
        ws_max_radps=math.radians(given.ws_max),
        swarm=swarm,
        motion=motion,
    )


Fit = Annotated["Options | None", _fit]


def joint_limits(path: Path) -> JointLimits:
    """What the checks of plausibility need of a configuration."""
    from jointctl.tools.configuration.conversions import torque_constant_NmpA
    from jointctl.tools.configuration.load import load_config
    from jointctl.tools.identification.plausibility import JointLimits

    config = load_config(path)
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
    from jointctl.tools.configuration.load import load_config

    try:
        return load_config(path).control.feed_forward == "none"
    except ConfigurationError:
        return False


def remarks(found: Identification) -> list[str]:
    """Comment lines above the section: where the numbers come from."""
    from jointctl.tools.identification.identification_report import left_out_text

    swarm = found.options.swarm
    return [
        f"{found.data.path.name}, SHA-256 {found.data.sha256}",
        f"model {found.model}, seed {swarm.seed}, {swarm.particles} particles x {swarm.iterations} iterations",
        f"RMSE {found.rmse_Nm:.4g} Nm, held out {found.held_out_by_model_Nm[found.model]:.4g} Nm at the motor; "
        + left_out_text(found),
    ]


@dataclass(frozen=True)
class _Found:
    """What an identification writes and shows, whatever it was made from."""

    shown: RenderableType
    result: dict[str, Any]
    section: dict[str, Any]
    remarks: list[str]
    pictures: dict[str, tuple[Any, str]]  # (figure, caption) by the end of its file's name
    tables: list[Section]  # of the page, before the pictures
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    title: str


def identify(
    data_path: Data,
    output: VerbOutput,
    *,
    into: Annotated[
        Path | None,
        typer.Option(
            "--into", help="configuration whose friction section to replace", autocompletion=configuration_files
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="TOML file to write instead")] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="configuration to check plausibility against", autocompletion=configurations),
    ] = None,
    given: ForeignFormat = OURS,
    options: Fit = None,
    report: Report = None,
) -> int:
    """Fit the friction model (11) to plateaus, or to any motion; writes TOML, figures and a report beside the data."""
    # into: the section goes into it, figures and the JSON report beside the data.  Otherwise into `out`, default
    # DATA.friction.toml, and they beside it.
    from jointctl.tools.configuration.found_values import friction_snippet
    from jointctl.tools.identification.identification import Options
    from jointctl.tools.identification.motion_data import is_series, motion_of_plateaus

    options = options or Options()
    _require_targets(into, out, report, [path for path in (data_path, into, config) if path is not None])
    config = None if config is None else config_path(config)
    limits = _limits(into, config, output)
    in_time = is_series(data_path, given)
    regressed = in_time or motion_of_plateaus(data_path, given) is not None
    from_data = _from_motion if regressed else _from_plateaus
    found = from_data(data_path, given, options, limits, output)
    for note in found.notes:  # also with -q: a fit of other points than were measured is another result
        output.address(f"{data_path}: {note}")
    for warning in found.warnings:
        output.warning(warning)
    if out is None and into is None:
        out = data_path.with_suffix(".friction.toml")
    text = friction_snippet(found.section, found.remarks)
    result = {**found.result, "friction": found.section}
    files = _files(found, result, data_path, out, text)
    read = (data_path, data_path.with_suffix(".json"), into, config, *options.motion.also)
    _write(files, found, into, [path for path in read if path is not None])
    output.result(found.shown, {**result, "files": [str(path) for path in files]})
    for path in ([into] if into is not None else []) + list(files):
        output.note(f"written: {path}")
    if into is not None and _not_compensated(into):
        output.warning(f'{into}: control.feed_forward (="none") leaves the friction to the feedback; "desired" uses it')
    if report is not None:
        _write_page(report, found, text, data_path, output)
    return 0


def _require_targets(into: Path | None, out: Path | None, report: Path | None, read: Sequence[Path]) -> None:
    """`DataError` for a file that cannot be written, before minutes of computing."""
    from jointctl.tools.configuration.load import shipped_config
    from jointctl.tools.recording.report_page import check_target
    from jointctl.tools.written_file import refuse_unwritable

    if out is not None and out.suffix != ".toml":
        raise DataError(f"{out}: the name of the section's file (-o) must end in .toml")
    if report is not None:
        check_target(report, read)
    if into is not None and not into.exists() and shipped_config(into.name).exists():
        hint = f"`jointctl new FILE --from {into.stem}` makes one of your own"
        raise DataError(f"--into {into}: a shipped configuration is not written into", hint)
    if into is not None:
        refuse_unwritable(into)


def _files(found: _Found, result: dict[str, Any], data_path: Path, out: Path | None, text: str) -> dict[Path, bytes]:
    """What is written besides the configuration: figures, the report as JSON, and `text` where `out` is named."""
    from jointctl.tools.drawing import png

    stem = out.with_suffix("") if out is not None else data_path.with_suffix(".friction")
    files = {stem.with_name(f"{stem.name}{end}.png"): png(figure) for end, (figure, _) in found.pictures.items()}
    files[stem.with_name(stem.name + ".report.json")] = json.dumps(result, indent=1, allow_nan=False).encode("utf-8")
    if out is not None:
        files[out] = text.encode("utf-8")
    return files


def _write(files: Mapping[Path, bytes], found: _Found, into: Path | None, protected: Sequence[Path]) -> None:
    """The section goes into the configuration, if one is named, and the files are written beside it."""
    from jointctl.tools.configuration.found_values import with_friction_section, write_changed
    from jointctl.tools.written_file import replace_file, require_target

    for path in files:
        require_target(path, protected)
    if into is not None:  # first, because it is the one that may be refused
        write_changed(into, lambda before: with_friction_section(before, found.section, found.remarks))
    for path, content in files.items():
        replace_file(path, content)


def _from_plateaus(
    path: Path, given: ForeignFormat, options: Options, limits: JointLimits | None, output: Output
) -> _Found:
    import numpy as np

    from jointctl.tools.identification import identification_report as reports
    from jointctl.tools.identification.friction_data import read_friction_data
    from jointctl.tools.identification.identification import identify_friction
    from jointctl.tools.recording.report_page import Section, from_terminal
    from jointctl.tools.recording.report_page import remarks as notes_of

    data = read_friction_data(path, given)
    if limits is None and data.recorded_limits is None:
        output.warning(
            f"{path}: no limits of the joint are known: sizes of torque and speed could not be checked, a wrong "
            "torque constant, ratio, unit or side may go unnoticed; --config CONFIG checks them"
        )
    with output.progress("particle swarm", 2.0 * options.swarm.iterations) as advance:
        found = identify_friction(data, options, limits=limits, progress=advance)
    used = {word: direction.index for word, direction in found.directions.items()}
    outliers = np.concatenate([direction.outliers for direction in found.directions.values()])
    fit = reports.fit_figure(
        data, found.branches, used, f"{path.name}: {found.model}", outliers=outliers, identified=found
    )
    pictures = {"": (fit, "Measured friction torque and the model, and the error between them")}
    convergence = reports.convergence_figure(found)
    if convergence is not None:
        pictures[".convergence"] = (convergence, "How the particle swarm converged")
    errors = reports.error_table(found.errors_Nm, found.measured_Nm, data.reduction_ratio)
    left_out = notes_of([reports.left_out_text(found)], "")
    models = from_terminal(reports.model_table(found))
    tables = [
        Section("Fit", [*notes_of(found.warnings), *left_out, models, from_terminal(errors)]),
        Section("Parameters", [from_terminal(reports.parameter_table(found))]),
    ]
    section = reports.section_values(found.branches["positive"], found.branches["negative"])
    return _Found(
        reports.identification_report(found), found.to_dict(), section, remarks(found), pictures, tables, found.notes,
        found.warnings, f"Friction of {path.stem}: {found.model}",
    )  # fmt: skip


def motion_from(path: Path, given: ForeignFormat, settings: MotionSettings) -> Motion:
    """The motion of a run log or of a table, with those of `settings.also` after it."""
    from jointctl.tools.identification.friction_data import refuse_unused
    from jointctl.tools.identification.motion_data import is_series, joined, motion_of_log, motion_of_plateaus
    from jointctl.tools.identification.motion_table import read_motion
    from jointctl.tools.recording.run_log_reader import read_run_log

    def one(path: Path) -> Motion:
        if path.suffix.lower() == ".mcap":
            return motion_of_log(path, read_run_log(path), given, settings)
        if not path.exists():
            raise DataError(f"{path}: no such file")
        if not is_series(path, given):
            raise DataError(
                f"{path}: is no motion in time",
                "--also is for run logs, and tables with --time-column or --sample-rate",
            )
        return read_motion(path, given, settings)

    if plateaus := motion_of_plateaus(path, given):
        refuse_unused(settings, (), f"{path}, which holds plateaus")
        return plateaus
    paths = (path, *settings.also)
    if all(each.suffix.lower() == ".mcap" for each in paths):
        refuse_unused(given, ("ratio",), "a run log, which tells its own columns")
    return joined([one(each) for each in paths])


def _from_motion(
    path: Path, given: ForeignFormat, options: Options, limits: JointLimits | None, output: Output
) -> _Found:
    from jointctl.tools.identification import motion_report as reports
    from jointctl.tools.identification.friction_data import refuse_unused
    from jointctl.tools.identification.motion_fit import identify_motion
    from jointctl.tools.identification.plausibility import Verdict, check_motion
    from jointctl.tools.recording.report_page import Section, from_terminal
    from jointctl.tools.recording.report_page import remarks as notes_of

    options.check()
    used = {"knee_radps", "seed", *vars(options.motion)}
    refuse_unused(options, used, f"{path}, which holds motions")
    motion = motion_from(path, given, options.motion)
    output.note(f"fitting {len(motion.time_s)} samples, which takes some seconds")
    verdict = check_motion(motion, limits) if limits is not None else Verdict()
    if verdict.problems:
        raise DataError(f"{path}: {'; '.join(verdict.problems)}")
    found = identify_motion(motion, options.motion, knee_radps=options.knee_radps, seed=options.swarm.seed)
    section = reports.motion_section(found)
    warnings = list(verdict.warnings)
    if len(found.model.directions) == 1:
        warnings.append(f"{motion.speed_name}: no reversal: friction of the other direction is taken to be the same")
    tables = [
        Section("Fit", [*notes_of(reports.motion_lines(found), ""), *map(from_terminal, reports.motion_tables(found))]),
        Section("Left open by these data", notes_of(found.untold)),
    ]
    return _Found(
        reports.motion_report(found), found.to_dict(), section, reports.motion_remarks(found),
        reports.motion_figures(found), tables, found.notes, tuple(warnings), f"Motion of {path.stem}",
    )  # fmt: skip


def _write_page(path: Path, found: _Found, text: str, data_path: Path, output: Output) -> None:
    from jointctl.tools.recording.report_page import Details, Section, svg_figure, write_verb_page
    from jointctl.tools.recording.report_page import remarks as notes_of

    pictures: list[Block] = [svg_figure(figure, caption) for figure, caption in found.pictures.values()]
    origin = [*notes_of(found.remarks, ""), Details("The section for a configuration", text)]
    sections = [*found.tables, Section("Figures", pictures), Section("Origin", origin)]
    write_verb_page(path, found.title, sections, output, subtitle=str(data_path), inputs=(data_path,))
