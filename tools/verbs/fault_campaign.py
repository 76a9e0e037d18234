"""`jointctl fault-campaign`: thousands of random faults against the virtual joint, faster than real time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jointctl.drivers.errors import INTERRUPTED
from jointctl.tools.campaign.campaign import (
    campaign_figure,
    campaign_joint,
    rows_by_kind,
    run_campaign,
    table,
    violations,
    write_json,
)
from jointctl.tools.campaign.fault_scenarios import draw_scenario
from jointctl.tools.campaign.judge import Verdict, judge, require_fit
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import refuse_serial
from jointctl.tools.drawing import save_png
from jointctl.tools.output import Output
from jointctl.tools.reporting.page import (
    Details,
    Paragraph,
    Section,
    Table,
    check_target,
    from_terminal,
    svg_figure,
    write_verb_page,
)
from jointctl.tools.written_file import prepare_folder

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
    sweep: bool = False,
) -> int:
    """Run `count` scenarios, or replay one, of a run or of a `sweep`.

    0 if nothing was violated, 10 if something was, 130 after Ctrl-C.
    """
    refuse_serial(config, "fault-campaign")
    require_fit(config)
    if scenario is not None:
        return _replay(config, output, seed, scenario, sweep)
    if report is not None:
        check_target(report)
    prepare_folder(folder)
    with output.progress("fault campaign", float(count)) as advance:
        verdicts, elapsed_s, interrupted = run_campaign(config.path, seed, count, advance, workers, sweep=sweep)
    rows = rows_by_kind(verdicts)
    found = violations(verdicts, seed, sweep=sweep)
    figure = campaign_figure(verdicts, config.limits.velocity_max_radps)
    if verdicts:
        write_json(folder / "campaign.json", seed, verdicts, elapsed_s, sweep=sweep)
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
            f"replay one with: jointctl fault-campaign {config.path}{' --sweep' if sweep else ''} --seed {seed} "
            f"--scenario {found[0]['number']}",
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


def _replay(config: Config, output: Output, seed: int, number: int, sweep: bool) -> int:
    """One scenario, with all that it consists of."""
    chosen = draw_scenario(seed, number, sweep=sweep)
    verdict = judge(*campaign_joint(config, sweep=sweep), chosen)
    described = chosen.describe()
    lines = [f"{key}: {value}" for key, value in described.items()]
    lines += [f"told as {verdict.fault}, reaction {verdict.reaction}, greatest speed {verdict.peak_radps:.3f} rad/s"]
    lines += [f"VIOLATION: {line}" for line in verdict.violations] or ["no invariant violated"]
    output.result("\n".join(lines), {"scenario": described, "verdict": vars(verdict)})
    return EXIT_VIOLATIONS if verdict.violations else 0
