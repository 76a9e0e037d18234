"""`jointctl run CONFIG`: track the configured trajectory on a real or virtual joint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.tools.output import Output
from jointctl.tools.scoping.remote_options import NOBODY_REMOTE, RemoteOptions
from jointctl.tools.verbs.verb_options import AllowLowMargin, DryRun, JointOrArmOnBus, VerbOutput, Yes

if TYPE_CHECKING:
    from jointctl.drivers.drive import CommissioningReport
    from jointctl.tools.child_process import OwnVirtualJoint
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.session.display import Display
    from jointctl.tools.session.plan import RunPlan


def _page(
    scope: Annotated[bool, typer.Option("--scope", help="live page in the browser (needs the extra scope)")] = False,
    scope_host: Annotated[str, typer.Option("--scope-host", help="address to serve the page at")] = "127.0.0.1",
    scope_port: Annotated[int, typer.Option("--scope-port", min=1, max=65535)] = 8642,
) -> tuple[str, int] | None:
    return (scope_host, scope_port) if scope else None


def run(
    config: JointOrArmOnBus,
    output: VerbOutput,
    *,
    assume_yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: AllowLowMargin = False,
    scope: Annotated[tuple[str, int] | None, _page] = None,
    live: RemoteOptions = NOBODY_REMOTE,
) -> int:
    """Track the configured trajectory on a real or virtual joint, or with all joints of an arm."""
    return tracked(
        config,
        output,
        assume_yes=assume_yes,
        dry_run=dry_run,
        allow_low_margin=allow_low_margin,
        scope=scope,
        live=live,
    )


def tracked(
    config: Config | ArmConfig,
    output: Output,
    *,
    assume_yes: bool,
    dry_run: bool = False,
    allow_low_margin: bool = False,
    scope: tuple[str, int] | None = None,
    live: RemoteOptions = NOBODY_REMOTE,
    own: OwnVirtualJoint | None = None,
) -> int:
    """`run` from Python; `own`: the virtual joint that was started for it, and may still be starting."""
    from jointctl.tools.scoping.remote import remote
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.plan import TerminalConsent, configured, free, require_terminal, resolve
    from jointctl.tools.session.result import broken_off, never_begun, report_run, run_title
    from jointctl.tools.session.session import Session

    if not (assume_yes or dry_run):
        require_terminal()
    motion = "hold" if live.hold else ""
    plan = resolve(config, free if live.hold else configured, allow_low_margin=allow_low_margin)
    consent = TerminalConsent(output, assume_yes=assume_yes, dry_run=dry_run)
    with (
        _displays(plan, output, run_title(config, motion), scope) as display,
        remote(live, config, output, motion=motion) as others,
        in_control(plan.config, output, plan.configs[1:]) as control,
    ):
        session = Session(
            plan, others.consent(consent, output), output, control, others.beside(display), others.set_points
        )
        session.own = own
        try:
            result = session.run()
        except KeyboardInterrupt:
            return broken_off(session.drive_state, output, control.signals.by_command)
    if result is None:
        return never_begun(session.drive_state, output, dry_run=dry_run)
    return report_run(result, output, config, motion)


@contextmanager
def _displays(
    plan: RunPlan, output: Output, title: str, scope: tuple[str, int] | None
) -> Iterator[Callable[[CommissioningReport], Display]]:
    """What shows the run: the terminal, and the page if one is wanted."""
    from jointctl.tools.recording.ros_messages import JOINT_NAMES
    from jointctl.tools.session.display import Displays, run_display

    terminal = run_display(output, title)
    if scope is None:
        yield terminal
        return
    from jointctl.tools.scoping.feed import scope_order, scope_server

    config, joints = plan.config, JOINT_NAMES if plan.arm is None else plan.names
    order = scope_order(title, *scope, drive=config.drive.kind, loop_cpu=config.loop.cpu, joints=joints)
    output.address(f"scope: {order.url}")
    with scope_server(order) as feed:
        feed.settings({"stage": "terminal"})
        yield lambda report: Displays([terminal(report), feed])
