"""`jointctl excite CONFIG`: a motion that tells inertia, gravity and friction at once, into a log for `identify`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from jointctl.drivers.errors import UsageError
from jointctl.tools.output import Output, command_line
from jointctl.tools.verbs.verb_options import AllowLowMargin, DryRun, JointOnBus, VerbOutput, Yes

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.session.plan import Motion
    from jointctl.tools.sweeping.excitation import Design

DURATION_s = 60.0


@dataclass(frozen=True)
class ExciteOptions:
    """The motion, and how it is carried out."""

    duration_s: Annotated[float, typer.Option("--duration", metavar="S", help="of the motion")] = DURATION_s
    seed: Annotated[int, typer.Option("--seed", help="of the motions that the best is chosen from")] = 1
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False


@dataclass(frozen=True)
class ExciteResult:
    """What was carried out: a run log for `identify`."""

    log: str
    speed_min_radps: float
    condition: float
    known: dict[str, float]
    untold: list[str]


def excite(
    config: JointOnBus,
    output: VerbOutput,
    *,
    options: ExciteOptions = ExciteOptions(),
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG of the motion (CONFIG.excite.png)")] = None,
    assume_yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: AllowLowMargin = False,
) -> int:
    """Move so that inertia, gravity, friction and its load can be separated; writes a run log for `identify`."""
    from jointctl.tools.drawing import require_png, save_png
    from jointctl.tools.session.plan import require_terminal
    from jointctl.tools.sweeping.carry_out import config_of_sweep
    from jointctl.tools.sweeping.excitation import ExcitePass, designed, excitation_figure
    from jointctl.tools.sweeping.plan import refuse_constants

    refuse_constants(config)
    if not 0 <= options.seed < 2**31:
        raise UsageError(f"--seed (={options.seed}) must be in [0..{2**31 - 1}]")
    picture = figure or Path(f"{config.path.stem}.excite.png")
    require_png(picture, [config.path])
    if not (assume_yes or dry_run or options.lockstep):
        require_terminal()
    moving = config_of_sweep(config, "torque")
    design = designed(moving, options.duration_s, options.seed)
    save_png(excitation_figure(design, f"{config.path.stem}: motion of {design.motion.duration_s:.0f} s"), picture)
    output.note(f"written: {picture}")
    _show(design, output)
    log = _log_of(
        moving, ExcitePass(moving, design), output, lockstep=options.lockstep, allow_low_margin=allow_low_margin,
        assume_yes=assume_yes or options.lockstep, dry_run=dry_run,
    )  # fmt: skip
    if isinstance(log, int):
        return log
    found = ExciteResult(str(log), 0.8 * design.slowest_radps, design.condition, design.known, design.untold)
    table = Table(title="Excitation", title_justify="left", show_header=False)
    table.add_row("log", str(log))
    table.add_row(
        "next", command_line("identify", log, "--speed-min", f"{found.speed_min_radps:.3g}", "--into", "CONFIG")
    )
    output.result(table, vars(found), found)
    return 0


def _show(design: Design, output: Output) -> None:
    """What the motion will tell, before it moves."""
    for name, share in design.known.items():
        output.fact(f"expected   {name} within {share:.0%}")
    for line in design.untold:
        output.fact(f"open       {line}")


def _log_of(
    config: Config, motion: Motion, output: Output, *, lockstep: bool, allow_low_margin: bool, **how: bool
) -> Path | int:
    """The run log of the motion, or the exit code without one."""
    from jointctl.tools.recording.run_log import log_path
    from jointctl.tools.session.plan import RunPlan, TerminalConsent
    from jointctl.tools.sweeping.carry_out import carried_out, lockstep_log

    if not lockstep:
        result = carried_out(RunPlan(config, motion, log_path(config), allow_low_margin), output, "excitation", **how)
        return result if isinstance(result, int) else result.log_path
    log = lockstep_log(config, motion, TerminalConsent(output, **how), allow_low_margin=allow_low_margin)
    if log is None:
        output.note("dry run: nothing moved")
    return log or 0
