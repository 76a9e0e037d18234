"""`jointctl fault-campaign`: thousands of random faults against the virtual joint, faster than real time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointctl.drivers.errors import INTERRUPTED, UsageError
from jointctl.tools.output import Output, command_line
from jointctl.tools.verbs.study import ManyRuns
from jointctl.tools.verbs.verb_options import ConfigPath, Report, VerbOutput, loaded_joint_or_arm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.experiments.campaign import Campaign
    from jointctl.tools.experiments.fault_scenarios import During, PlacedSweep, PlaceStep, TuneStep
    from jointctl.tools.experiments.judge import Verdict
    from jointctl.tools.lockstep import LockstepJoint
    from jointctl.tools.session.plan import Motion

EXIT_VIOLATIONS = 10
LARGEST = 2**31 - 1  # of a seed or of a scenario's number
SHOWN = 20


@dataclass(frozen=True)
class Drawn:
    """Which scenarios."""

    count: Annotated[int, typer.Option("--count", help="how many random scenarios", min=1, max=LARGEST)] = 10_000
    seed: Annotated[int, typer.Option("--seed", min=0, max=LARGEST)] = 1
    scenario: Annotated[int | None, typer.Option("--scenario", help="replay this one alone", min=0, max=LARGEST)] = None
    pairs: Annotated[bool, typer.Option("--pairs", help="two faults in each, the second up to 2 s after the first")] = (
        False
    )


AS_USUAL = Drawn()


def _during(
    *,
    sweep: Annotated[bool, typer.Option("--sweep", help="during a sweep, in its mode, instead of a run")] = False,
    program: Annotated[
        bool, typer.Option("--program", help="while a program sends set-points, which may fail too")
    ] = False,
    tune: Annotated[bool, typer.Option("--tune", help="during the steps of a tune, which move the joint")] = False,
) -> During:
    asked: tuple[tuple[During, bool], ...] = (("sweep", sweep), ("program", program), ("tune", tune))
    given = [name for name, on in asked if on]
    if len(given) > 1:
        raise UsageError(f"--{given[0]} and --{given[1]} exclude each other")
    return given[0] if given else "run"


BrokenMotion = Annotated["During", _during]


def _joint_or_arm(config: ConfigPath = Path("virtual")) -> Config | ArmConfig:
    return loaded_joint_or_arm(config)


JointOrArmToBreak = Annotated["Config | ArmConfig", _joint_or_arm]


def fault_campaign(
    config: JointOrArmToBreak,
    output: VerbOutput,
    *,
    drawn: Drawn = AS_USUAL,
    during: BrokenMotion = "run",
    folder: Annotated[Path, typer.Option("--folder", help="for report, JSON and picture")] = Path("fault-campaign"),
    workers: ManyRuns = None,
    report: Report = None,
) -> int:
    """Random faults on random joints in lockstep; every safety invariant is checked in every scenario.

    Of an arm one joint after the other has the fault, and all of them are checked.
    """
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.drive_section import require_simulated
    from jointctl.tools.drawing import save_png
    from jointctl.tools.experiments.arm_campaign import require_arm_fits
    from jointctl.tools.experiments.campaign import (
        Campaign,
        campaign_figure,
        rows_by_kind,
        run_campaign,
        table,
        violations,
        write_json,
    )
    from jointctl.tools.experiments.judge import require_fit
    from jointctl.tools.experiments.many_runs import HERE
    from jointctl.tools.recording.report_page import check_target
    from jointctl.tools.written_file import prepare_folder

    if isinstance(config, ArmConfig):
        if during != "run":
            raise UsageError(f"--{during} is one joint's, and {config.path} is an arm", "give the joint's file")
        require_arm_fits(config)
    else:
        require_simulated(config, "fault-campaign")
        require_fit(config)
    campaign = Campaign(config, drawn.seed, during, drawn.pairs, place_of(during))
    if drawn.scenario is not None:
        return _replay(campaign, drawn.scenario, output)
    if report is not None:
        check_target(report)
    prepare_folder(folder)
    with output.progress("fault campaign", float(drawn.count)) as advance:
        verdicts, elapsed_s, interrupted = run_campaign(campaign, drawn.count, advance, workers or HERE)
    rows = rows_by_kind(verdicts)
    found = violations(campaign, verdicts)
    joints = config.joints if isinstance(config, ArmConfig) else (config,)
    figure = campaign_figure(verdicts, max(joint.limits.velocity_max_radps for joint in joints))
    if verdicts:
        write_json(folder / "campaign.json", campaign, verdicts, elapsed_s, found)
        save_png(figure, folder / "campaign.png")
    data = {
        "scenarios": len(verdicts), "violations": len(found), "seed": drawn.seed, "elapsed_s": round(elapsed_s, 1),
        "interrupted": interrupted, "report": str(folder / "campaign.json"),
    }  # fmt: skip
    output.result(table(rows), data, verdicts)
    if report is not None and verdicts:
        _write_page(report, campaign, verdicts, found, figure, output)
    output.note(f"{len(verdicts)} scenarios in {elapsed_s:.0f} s, seed {drawn.seed}; report in {folder}")
    for item in found[:SHOWN]:
        output.warning(f"scenario {item['number']} ({_told(item)}): {'; '.join(item['violations'])}")
    if found:
        output.error(
            f"{len(found)} of {len(verdicts)} scenarios violate an invariant",
            f"replay one with: {command_line('fault-campaign', config.path)}{'' if during == 'run' else f' --{during}'}"
            f"{' --pairs' if drawn.pairs else ''} --seed {drawn.seed} --scenario {found[0]['number']}",
        )
        return EXIT_VIOLATIONS
    return INTERRUPTED if interrupted else 0


def _told(item: dict[str, Any]) -> str:
    """The faults of a violation."""
    return f"{item['kind']}, {item['then']}" if item["then"] else str(item["kind"])


def place_of(during: During) -> PlaceStep | None:
    """The motions of a tune, which is of another package than the campaign."""
    return placed_step if during == "tune" else None


def placed_step(config: Config, joint: LockstepJoint, step: TuneStep, start_rad: float) -> PlacedSweep:
    """`step` of a tune of the joint, which stands at `start_rad`: a scenario of `--tune` breaks it.

    The law, the limits and the table are those of the step itself; a response has one pair of legs, a friction step few
    plateaus.  Where the joint stands is drawn: a step begins from anywhere.
    """
    import numpy as np

    from jointctl.firmware_py.friction import friction_curve_Nm
    from jointctl.tools.configuration.conversions import friction_constants, static_friction_Nm
    from jointctl.tools.configuration.found_values import with_break_away, with_sliding
    from jointctl.tools.experiments.fault_scenarios import PlacedSweep, placed_sweep
    from jointctl.tools.inspection.motion_check import CheckMotion, config_of_check, make_plan
    from jointctl.tools.tuning.carry_out import LEAST_LEGS, response_task
    from jointctl.tools.tuning.frequency_response import motor_fed, speed_and_period
    from jointctl.tools.tuning.presliding import presliding_motion

    # what the step of the direction finds, on this joint
    static_Nm = static_friction_Nm(config) or 0.0
    unknown = with_break_away(config, static_Nm)
    motion: Motion
    if step.name == "friction":
        if config.friction is not None:  # and what the response adds
            curve = friction_constants(config.friction, config.joint.reduction_ratio)
            speed_radps, _ = speed_and_period(config)
            at_radps = np.array([speed_radps, -speed_radps])
            sliding = config.joint.reduction_ratio * friction_curve_Nm(curve, at_radps)
            unknown = with_sliding(config, static_Nm, (float(sliding[0]), float(sliding[1])), 0.0, speed_radps)
        return placed_sweep(unknown, joint, step.strokes, start_rad)
    pushed = presliding_motion(config) if step.name == "bristles" and config.reducer is None else None
    if pushed is not None:
        motion = pushed
    elif step.name in ("direction", "bristles"):
        moving = motor_fed(config)
        plan = make_plan(moving, None)
        motion = CheckMotion(config_of_check(moving, plan), plan)
    else:
        task = response_task(unknown, None, LEAST_LEGS)
        motion = task.motion(step.share * task.largest_Nm, 1)
    placed = motion.placed(replace(joint.report, start_position_rad=start_rad))
    duration_s = float(placed.constants[0].trajectory.duration_s)
    return PlacedSweep(placed.constants, placed.table, start_rad, duration_s)


def _write_page(
    path: Path, campaign: Campaign, verdicts: list[Verdict], found: list[dict[str, Any]], figure: Figure, output: Output
) -> None:
    from jointctl.tools.experiments.campaign import rows_by_kind, table
    from jointctl.tools.recording.report_page import (
        Details,
        Paragraph,
        Section,
        Table,
        from_terminal,
        svg_figure,
        write_verb_page,
    )

    tone = "error" if found else "good"
    said = f"{len(found)} of {len(verdicts)} scenarios violate an invariant, seed {campaign.seed}."
    listed = Table(
        ["scenario", "kind", "violations"],
        [(item["number"], _told(item), "; ".join(item["violations"])) for item in found],
    )
    points = svg_figure(figure, "Greatest speed, and time until off, of each scenario by kind of fault")
    sections = [
        Section("Verdict", [Paragraph(said, tone)]),
        Section("By kind of fault", [from_terminal(table(rows_by_kind(verdicts)))]),
        Section("Violations", [listed] if found else []),
        Section("Figures", [points]),
        Section("Configuration", [Details("Configuration", campaign.config.text)]),
    ]
    write_verb_page(path, "Fault campaign", sections, output, subtitle=str(campaign.config.path))


def _replay(campaign: Campaign, number: int, output: Output) -> int:
    """One scenario, with all that it consists of."""
    chosen = campaign.scenario(number)
    verdict = campaign.judge()(chosen)
    described = chosen.describe()
    lines = [f"{key}: {value}" for key, value in described.items()]
    lines += [
        f"reported as {verdict.fault}, reaction {verdict.reaction}, greatest speed {verdict.peak_radps:.3f} rad/s"
    ]
    lines += [f"VIOLATION: {line}" for line in verdict.violations] or ["no invariant violated"]
    output.result("\n".join(lines), {"scenario": described, "verdict": vars(verdict)}, [verdict])
    return EXIT_VIOLATIONS if verdict.violations else 0
