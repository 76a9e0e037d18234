"""`jointctl tune CONFIG`: the joint commissions itself, from its direction to gains that keep their margins."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import INTERRUPTED, UsageError
from jointctl.tools.verbs.verb_options import DryRun, JointOnBus, VerbOutput, Yes

if TYPE_CHECKING:
    from jointctl.tools.verbs.tune_steps import Tune

LAWS, OBJECTIVES = ("auto", "paper", "precise", "two_encoders", "link_encoder"), ("tracking", "settling", "quiet")


@dataclass(frozen=True)
class TuneOptions:
    """What `tune` may do, and what it is after."""

    law: Annotated[
        str, typer.Option("--law", help="paper, precise, two_encoders, link_encoder, or auto: what the joint allows")
    ] = "auto"
    objective: Annotated[str, typer.Option("--objective", help="tracking, settling or quiet")] = "tracking"
    torque_Nm: Annotated[
        float | None,
        typer.Option("--torque", metavar="NM", help="at the joint at most, in every step (limits.torque_max_Nm)"),
    ] = None
    refine: Annotated[
        bool, typer.Option("--refine", help="then a few runs with other gains of the same margins; the best stays")
    ] = False
    resume: Annotated[bool, typer.Option("--resume", help="go on after the last step that was done")] = False
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False


TUNE_ALL = TuneOptions()


def tune(
    config: JointOnBus,
    output: VerbOutput,
    *,
    options: TuneOptions = TUNE_ALL,
    folder: Annotated[
        Path | None, typer.Option("--folder", help="for what each step leaves, and the report (CONFIG.tune)")
    ] = None,
    assume_yes: Yes = False,
    dry_run: DryRun = False,
) -> int:
    """Identify the joint and choose its gains: about 9 minutes of motion; writes CONFIG and a report, asks once.

    Direction, frequency response, gravity, friction and its bristles, map of the reducer, gains, a run to verify them.
    An aborted tune leaves the file as it was.
    """
    from jointctl.tools.configuration.config import refuse_shipped
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.plan import require_terminal
    from jointctl.tools.session.result import never_begun, require_off
    from jointctl.tools.tuning.carry_out import Carrier, NotCarriedOut, ShownConsent
    from jointctl.tools.verbs.tune_report import envelope
    from jointctl.tools.verbs.tune_steps import Tune

    for name, value, known in (("--law", options.law, LAWS), ("--objective", options.objective, OBJECTIVES)):
        if value not in known:
            raise UsageError(f"{name} (={value}) must be one of {', '.join(known)}")
    refuse_shipped(config)
    if not (assume_yes or dry_run or options.lockstep):
        require_terminal()
    consent = ShownConsent(output, assume_yes=assume_yes or options.lockstep, dry_run=dry_run)
    with contextlib.ExitStack() as stack:
        carrier = Carrier(output, consent, None)
        job = Tune(config, options, carrier, folder or config.path.with_suffix(".tune"))
        if not options.lockstep:
            carrier.control = stack.enter_context(in_control(job.config, output))
        try:
            consent.show(envelope(job))
            if not (dry_run or consent.agreed(())):
                return never_begun("", output)
            if carrier.control is not None:
                carrier.control.signals.agreed()
            return job.run()
        except NotCarriedOut as ended:
            if not ended.stopped_by:
                return never_begun(ended.drive_state, output, dry_run=dry_run)
            output.note(f"stopped by {ended.stopped_by}; {_kept(job)}")
        except KeyboardInterrupt:
            by = carrier.control.signals.by_command if carrier.control is not None else ""
            output.note(f"interrupted{by}; nothing moves any more; {_kept(job)}")
        require_off(carrier.drive_state)
        return INTERRUPTED


def _kept(job: Tune) -> str:
    """After an interruption."""
    if job.written:
        return f"{job.original.path} has what was found, {job.folder / 'before.toml'} how it was"
    return f"{job.original.path} is as it was; {'--resume goes on' if job.state else 'no step was done'}"
