"""`jointctl study`: many random joints, many controllers, one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table

from jointctl.drivers.errors import INTERRUPTED, ConfigurationError, UsageError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import Report, VerbOutput, configurations

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.experiments.controller_study import StudyResult, StudySettings
    from jointctl.tools.experiments.many_runs import Workers


def _workers(
    workers: Annotated[
        int | None, typer.Option("--workers", help="processes; default: one a core", min=1, max=1024)
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option("--cluster", metavar="TCP://HOST:PORT", help="on the workers of a dask scheduler (extra cluster)"),
    ] = None,
    cluster_unprotected: Annotated[
        bool, typer.Option("--cluster-unprotected", help="also without TLS on another computer: docs/cluster.md")
    ] = False,
) -> Workers:
    from jointctl.tools.experiments.many_runs import Workers

    if cluster is not None and workers is not None:
        raise UsageError("--workers and --cluster exclude each other: the cluster has its own workers")
    return Workers(workers, cluster, cluster_unprotected, Output().warning)


ManyRuns = Annotated["Workers | None", _workers]  # where many runs are carried out


_COLUMNS = (
    ("peak_mrad", "peak [mrad]"),
    ("rmse_mrad", "RMSE [mrad]"),
    ("true_peak_mrad", "true peak [mrad]"),
    ("true_rmse_mrad", "true RMSE [mrad]"),
    ("settling_s", "settling [s]"),
    ("chatter_Nm", "chatter [Nm]"),
    ("phase_margin_deg", "margin [deg]"),
    ("settled_share", "settled [share]"),
    ("stuck_share", "stuck [share]"),
    ("stuck_later_share", "stuck later [share]"),
)
_MEANINGS = (
    ("rmse_mrad", "peak and RMSE as the encoder shows them"),
    ("true_rmse_mrad", "true: of the joint itself"),
    ("settling_s", "settling: until the error stays within 1 mrad"),
    ("chatter_Nm", "chatter: mean change of the torque command in a cycle"),
    ("settled_share", "settled: share of the moves after which the error is within 1 count or 20 urad from 50 ms on"),
    (
        "stuck_share",
        "stuck: share of a creeping motion in which the joint stands; later: from 0.5 s after each turn on",
    ),
)
OTHER_SIZE = 5.0  # times: a controller of another joint
_BOXES = (
    "Box: quartiles, line: median; whiskers: 5 and 95 %; dots: plants beyond them. A run ended by a fault is left out."
)


def study(
    settings: StudySettings,
    output: Output,
    *,
    file: Path | None = None,
    workers: Workers | None = None,
    csv: Path | None = None,
    figure: Path | None = None,
    report: Path | None = None,
) -> int:
    """Run the study and print medians with 5-95 % ranges; `csv`, `figure` and `report` are files to write.

    `file` is where the settings came from; like the configurations that they name, it is never overwritten.
    Ctrl-C keeps the plants that are done, says so, and gives exit code 130.
    """
    from jointctl.tools.configuration.drive_section import require_simulated
    from jointctl.tools.configuration.load import load_config, shipped_config
    from jointctl.tools.experiments.controller_study import random_plant, run_study, study_controllers
    from jointctl.tools.experiments.many_runs import HERE
    from jointctl.tools.experiments.scenarios import controller_config

    base_path = Path(settings.base)
    base = load_config(base_path if base_path.exists() else shipped_config(settings.base))
    require_simulated(base, "study")
    if base.reducer is not None and not settings.plant.flexible:
        raise ConfigurationError(
            f"base (={settings.base}) has a [reducer], and rigid joints are drawn: --plants realistic"
        )
    _require_targets(settings, file, csv, figure, report)
    controllers, joint = study_controllers(settings), random_plant(base, settings.plant, settings.seed, 0)
    for controller in controllers:
        controller_config(joint, controller)  # a contradiction is to be reported before an hour of simulation
    if settings.plant.flexible and settings.plant.choose_gains:
        names = [one.name for one in controllers if one.control.kind == "flexible_joint"]
        if names:
            output.note(f"{', '.join(names)}: gains and filters are chosen for each joint (plant.choose_gains)")
    for line in size_warnings(base, settings):
        output.warning(line)
    title = f"{settings.plants} plants, seed {settings.seed}, {settings.scenario}"
    with output.progress(title, settings.plants) as advance:
        result = run_study(base, controllers, settings, workers=workers or HERE, progress=advance)
    done = len(result.plants)
    if result.interrupted:
        title = f"INTERRUPTED: {done} of {title}"
        output.warning(f"interrupted: only {done} of {settings.plants} plants are in the result")
    if done:
        # first of all: a file that cannot be written does not cost the result
        output.result(_table(result, title, settings.after_s), study_data(result, settings), result)
        _write(result, settings, title, csv, figure, output)
        if report is not None:
            _write_page(report, result, settings, title, output)
    return INTERRUPTED if result.interrupted else 0


def _require_targets(
    settings: StudySettings, file: Path | None, csv: Path | None, figure: Path | None, report: Path | None
) -> None:
    """`DataError` for a file that cannot be written, before an hour of simulation."""
    from jointctl.tools.drawing import require_png
    from jointctl.tools.recording.report_page import check_target
    from jointctl.tools.written_file import prepare_target, refuse_overwriting

    inputs = [Path(name) for name in (settings.base, *settings.controllers)] + ([file] if file is not None else [])
    if csv is not None:
        refuse_overwriting(csv, inputs)
    if figure is not None:
        require_png(figure, inputs)
    if report is not None:
        check_target(report, inputs)
    for target in (csv, figure):
        prepare_target(target)


def _write(
    result: StudyResult, settings: StudySettings, title: str, csv: Path | None, figure: Path | None, output: Output
) -> None:
    from jointctl.tools.drawing import save_png
    from jointctl.tools.experiments.controller_study import write_csv

    if csv is not None:
        write_csv(result, csv)
        output.note(f"written: {csv}")
    if figure is not None:
        save_png(_figure(result, settings, title), figure)
        output.note(f"written: {figure}")


def size_warnings(base: Config, settings: StudySettings) -> list[str]:
    """Where controllers are of another joint than the plants."""
    from jointctl.tools.configuration.load import load_config, shipped_config

    found, plants_kgm2 = [], base.joint.inertia_kgm2
    for name in settings.controllers:
        path = next((path for path in (Path(name), shipped_config(name)) if path.is_file()), None)
        own_kgm2 = plants_kgm2 if path is None else load_config(path).joint.inertia_kgm2
        if not 1.0 / OTHER_SIZE <= own_kgm2 / plants_kgm2 <= OTHER_SIZE:
            found.append(
                f"{name} is of a joint of {own_kgm2:.3g} kg m2, and the plants are joints of {plants_kgm2:.3g} kg m2: "
                f"--base {name} draws plants of that joint"
            )
    return found


def _figure(result: StudyResult, settings: StudySettings, title: str) -> Any:
    from jointctl.tools.experiments.controller_study import study_figure

    return study_figure(result, f"{title}, after {settings.after_s:g} s")


def _write_page(path: Path, result: StudyResult, settings: StudySettings, title: str, output: Output) -> None:
    from jointctl.tools.recording.report_page import Details, Section, from_terminal, svg_figure, write_verb_page

    boxes = svg_figure(_figure(result, settings, title), "Errors of each controller over all plants, as boxes", _BOXES)
    sections = [
        Section("In numbers", [from_terminal(_table(result, title, settings.after_s))]),
        Section("Figures", [boxes]),
        Section("Settings", [Details("Settings", settings.model_dump_json(indent=1))]),
    ]
    write_verb_page(path, "Study", sections, output, subtitle=title)


def _text(values: tuple[float, float, float], digits: int = 3) -> str:
    median, low, high = values
    if not math.isfinite(median):
        return "never" if median > 0 else "-"
    texts = [f"{x:.{digits}g}" if math.isfinite(x) else "never" for x in (median, low, high)]
    return f"{texts[0]} ({texts[1]}..{texts[2]})"


def _columns(result: StudyResult) -> list[tuple[str, str]]:
    """Those that the motion of this study has."""
    return [
        (key, heading)
        for key, heading in _COLUMNS
        if not all(math.isnan(value) for name in result.controllers for value in result.values(name, key))
    ]


def _table(result: StudyResult, title: str, after_s: float) -> Table:
    columns = _columns(result)
    headings, shown = [heading for _, heading in columns], {key for key, _ in columns}
    table = Table(
        "controller",
        *(Column(heading, justify="right") for heading in (*headings, "faults")),
        title=f"{title}: errors after {after_s:g} s [mrad], median (5..95 %)",
        caption="; ".join(words for key, words in _MEANINGS if key in shown),
        title_justify="left",
        caption_justify="left",
    )
    for name in result.controllers:
        cells = [_text(spread(result, name, key)) for key, _ in columns]
        table.add_row(name, *cells, str(result.faults(name)))
    return table


def spread(result: StudyResult, controller: str, figure: str) -> tuple[float, float, float]:
    """(median, 5 %, 95 %) over the plants; a run ended by a fault counts as infinitely bad."""
    from jointctl.tools.experiments.controller_study import quantile

    values = result.values(controller, figure)
    return quantile(values, 0.5), quantile(values, 0.05), quantile(values, 0.95)


def study_data(result: StudyResult, settings: StudySettings) -> dict[str, Any]:
    """For --json; null stands for infinite (a fault, or never settled)."""
    rows = {}
    for name in result.controllers:
        row: dict[str, Any] = {"faults": result.faults(name)}
        for key, _ in _columns(result):
            median, low, high = spread(result, name, key)
            row[key] = {"median": median, "p5": low, "p95": high}
        rows[name] = row
    return {
        "interrupted": result.interrupted,
        "plants_done": len(result.plants),
        "settings": settings.model_dump(),
        "controllers": rows,
    }


@dataclass(frozen=True)
class StudyFlags:
    """Settings of the study that replace those of its file; None: as there."""

    plants: Annotated[
        list[str] | None,
        typer.Option(
            "--plants", help="how many random plants; rigid, realistic (a soft reducer), loaded (friction by load too)"
        ),
    ] = None
    seed: Annotated[int | None, typer.Option("--seed")] = None
    after_s: Annotated[float | None, typer.Option("--after", help="errors are taken after this time (s)")] = None
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            help="sine, frequency, amplitude, load; never repeating: multi_sine, point_to_point, reversals, creep",
        ),
    ] = None
    controllers: Annotated[
        list[str] | None,
        typer.Option("--controller", help="name or configuration file; may be repeated", autocompletion=configurations),
    ] = None
    base: Annotated[
        str | None,
        typer.Option("--base", help="configuration of the joint: name or file", autocompletion=configurations),
    ] = None


def with_plants(settings: StudySettings, given: list[str]) -> StudySettings:
    """How many plants, and of which ensemble."""
    from jointctl.tools.experiments.controller_study import checked

    changed = settings.model_dump(exclude_unset=True)
    for text in given:
        if text in ("rigid", "realistic", "loaded"):
            changed["plant"] = changed.get("plant", {}) | {"flexible": text != "rigid", "loaded": text == "loaded"}
        elif text.isascii() and text.isdigit():
            changed["plants"] = int(text)
        else:
            raise ConfigurationError(f"--plants (={text}) must be a number, rigid, realistic or loaded")
    return checked(changed, "command line")


def study_verb(
    *,
    file: Annotated[Path | None, typer.Option("--file", help="TOML with plants, seed and controllers")] = None,
    flags: StudyFlags,
    workers: ManyRuns = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="file for all single results")] = None,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG with a box plot")] = None,
    report: Report = None,
    output: VerbOutput,
) -> int:
    """Compare controllers on many random joints: medians and 5-95 % ranges of error, peak and settling time."""
    from jointctl.tools.experiments.controller_study import StudySettings, checked, load_study

    given = {key: value for key, value in vars(flags).items() if key != "plants" and value not in (None, [])}
    settings = load_study(file) if file is not None else StudySettings()
    settings = checked({**settings.model_dump(exclude_unset=True), **given}, "command line")
    settings = with_plants(settings, flags.plants or [])
    return study(settings, output, file=file, workers=workers, csv=csv, figure=figure, report=report)
