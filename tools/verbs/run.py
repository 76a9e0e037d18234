"""`jointctl run CONFIG`: track the configured trajectory on a real or virtual joint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.session import result as drive_end
from jointctl.tools.session.consent import TerminalConsent, require_terminal
from jointctl.tools.session.control import in_control
from jointctl.tools.session.display import Display, Displays
from jointctl.tools.session.live_panel import run_display
from jointctl.tools.session.plan import resolve
from jointctl.tools.session.result import report_run, require_off, run_title
from jointctl.tools.session.session import Session


def run(
    config: Config,
    output: Output,
    *,
    assume_yes: bool,
    dry_run: bool = False,
    allow_low_margin: bool = False,
    scope: tuple[str, int] | None = None,
) -> int:
    """Commission, show the motion envelope, ask, track, report; returns the exit code.

    `scope`: host and port at which a live page is to be served.
    """
    if not (assume_yes or dry_run):
        require_terminal()
    plan = resolve(config, allow_low_margin=allow_low_margin)
    consent = TerminalConsent(output, assume_yes=assume_yes, dry_run=dry_run)
    with _displays(config, output, run_title(config), scope) as display, in_control(config, output) as control:
        session = Session(plan, consent, output, control, display)
        try:
            result = session.run()
        except KeyboardInterrupt:
            output.note(f"interrupted{control.signals.by_command}; nothing moved")
            require_off(session.drive_state)
            return INTERRUPTED
    if result is None:
        left = drive_end.words(session.drive_state)
        output.note(
            f"dry run: nothing moved; the drive was commissioned; {left}" if dry_run else f"nothing moved; {left}"
        )
        return 0 if dry_run else DECLINED
    return report_run(result, output, config)


@contextmanager
def _displays(
    config: Config, output: Output, title: str, scope: tuple[str, int] | None
) -> Iterator[Callable[[CommissioningReport], Display]]:
    """What shows the run: the terminal, and the page if one is wanted."""
    terminal = run_display(output, title)
    if scope is None:
        yield lambda _: terminal()
        return
    from jointctl.tools.scoping.feed import scope_order, scope_server

    order = scope_order(title, *scope, cia402=not config.is_serial)
    output.address(f"scope: {order.url}")
    with scope_server(order) as feed:
        feed.settings({"stage": "terminal"})
        yield lambda _: Displays([terminal(), feed])
