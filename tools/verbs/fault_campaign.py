"""`jointctl fault-campaign`: thousands of random faults against the virtual joint, faster than real time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.errors import INTERRUPTED, ConfigurationError
from tools.campaign.judge import Verdict, judge
from tools.campaign.report import campaign_figure, rows_by_kind, table, violations, write_json
from tools.campaign.runner import run_campaign
from tools.campaign.scenario import draw_scenario
from tools.configuration.config import Config
from tools.configuration.elmo_settings import refuse_serial
from tools.drawing import save_png
from tools.output import Output
from tools.reporting.figure import svg_figure
from tools.reporting.page import Details, Paragraph, Section, Table, check_target
from tools.reporting.verb_page import from_terminal, write_verb_page
from tools.simulation.lockstep import LockstepJoint
from tools.written_file import prepare_folder

EXIT_VIOLATIONS = 10
SHOWN = 20


def fault_campaign(
    config: Config,
    output: Output,
    *,
    count: int = 10_000,
    seed: int = 1,
    scenario: int | None = None,
    folder: Path = Path("fault-campaign"),
    workers: int | None = None,
    report: Path | None = None,
) -> int:
    """Run `count` scenarios, or replay one; 0 if nothing was violated, 10 if something was, 130 after Ctrl-C."""
    refuse_serial(config, "fault-campaign")
    if config.virtual is None or config.friction is None:
        missing = "[virtual]" if config.virtual is None else "[friction]"
        raise ConfigurationError(f"{config.path}: {missing} is missing: the campaign needs a virtual joint")
    if config.virtual.faults:
        raise ConfigurationError(f"{config.path}: [[virtual.faults]] must be empty: the campaign brings its own")
    if scenario is not None:
        return _replay(config, output, seed, scenario)
    if report is not None:
        check_target(report)
    prepare_folder(folder)
    with output.progress("fault campaign", float(count)) as advance:
        verdicts, elapsed_s, interrupted = run_campaign(config.path, seed, count, advance, workers)
    rows = rows_by_kind(verdicts)
    found = violations(verdicts, seed)
    figure = campaign_figure(verdicts, config.limits.velocity_max_radps)
    if verdicts:
        write_json(folder / "campaign.json", seed, verdicts, elapsed_s)
        save_png(figure, folder / "campaign.png")
    data = {
        "scenarios": len(verdicts), "violations": len(found), "seed": seed, "elapsed_s": round(elapsed_s, 1),
        "interrupted": interrupted, "report": str(folder / "campaign.json"),
    }  # fmt: skip
    output.result(table(rows), data)
    if report is not None and verdicts:
        _write_page(report, config, verdicts, found, figure, seed, output)
    output.note(f"{len(verdicts)} scenarios in {elapsed_s:.0f} s, seed {seed}; report in {folder}")
    for item in found[:SHOWN]:
        output.warning(f"scenario {item['number']} ({item['kind']}): {'; '.join(item['violations'])}")
    if found:
        output.error(
            f"{len(found)} of {len(verdicts)} scenarios violate an invariant",
            f"replay one with: jointctl fault-campaign {config.path} --seed {seed} --scenario {found[0]['number']}",
        )
        return EXIT_VIOLATIONS
    return INTERRUPTED if interrupted else 0


def _write_page(
    path: Path, config: Config, verdicts: list[Verdict], found: list[dict[str, Any]], figure: Any, seed: int,
    output: Output,
) -> None:  # fmt: skip
    tone = "error" if found else "good"
    said = f"{len(found)} of {len(verdicts)} scenarios violate an invariant, seed {seed}."
    listed = Table(
        ["scenario", "kind", "violations"],
        [(item["number"], item["kind"], "; ".join(item["violations"])) for item in found],
    )
    points = svg_figure(figure, "Greatest speed, and time until off, of each scenario by kind of fault")
    sections = [
        Section("Verdict", [Paragraph(said, tone)]),
        Section("By kind of fault", [from_terminal(table(rows_by_kind(verdicts)))]),
        Section("Violations", [listed] if found else []),
        Section("Figures", [points]),
        Section("Configuration", [Details("Configuration", config.text)]),
    ]
    write_verb_page(path, "Fault campaign", sections, output, subtitle=str(config.path))


def _replay(config: Config, output: Output, seed: int, number: int) -> int:
    """One scenario, with all that it consists of."""
    chosen = draw_scenario(seed, number)
    verdict = judge(config, LockstepJoint(config), chosen)
    described = chosen.describe()
    lines = [f"{key}: {value}" for key, value in described.items()]
    lines += [f"told as {verdict.fault}, reaction {verdict.reaction}, greatest speed {verdict.peak_radps:.3f} rad/s"]
    lines += [f"VIOLATION: {line}" for line in verdict.violations] or ["no invariant violated"]
    output.result("\n".join(lines), {"scenario": described, "verdict": vars(verdict)})
    return EXIT_VIOLATIONS if verdict.violations else 0
