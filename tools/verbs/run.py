"""`jointctl run CONFIG`: track the configured trajectory on a real or virtual joint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.log_folder import log_path
from jointctl.tools.running.control import in_control
from jointctl.tools.running.display.display import Display
from jointctl.tools.running.display.live_panel import run_display
from jointctl.tools.running.permission.consent import agreed, approval, require_terminal
from jointctl.tools.running.permission.envelope import motion_envelope
from jointctl.tools.running.permission.readiness import prepare_log, require_ready, require_start
from jointctl.tools.running.result import drive_end
from jointctl.tools.running.result.drive_end import require_off
from jointctl.tools.running.result.run_report import report_run, run_title
from jointctl.tools.running.supervisor import Supervisor


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

    def confirm(report: CommissioningReport) -> bool:
        for line in motion_envelope(config, report):
            output.fact(line)
        if dry_run:
            return False
        require_ready(config, report, path)
        require_start(config, report.start_position_rad)
        if not (assume_yes or agreed(output)):
            return False
        prepare_log(config, path, output)
        return True

    path = log_path(config)
    title = run_title(config)
    approve = None if dry_run else approval(output, assume_yes=assume_yes)
    with _displays(config, output, title, scope) as display, in_control(config, output) as control:
        supervisor = Supervisor(
            config, output, path, confirm, control, approve=approve, allow_low_margin=allow_low_margin, display=display
        )
        try:
            result = supervisor.run()
        except KeyboardInterrupt:
            output.note(f"interrupted{control.signals.by_command}; nothing moved")
            require_off(supervisor.drive_state)
            return INTERRUPTED
    if result is None:
        left = drive_end.words(supervisor.drive_state)
        output.note(
            f"dry run: nothing moved; the drive was commissioned; {left}" if dry_run else f"nothing moved; {left}"
        )
        return 0 if dry_run else DECLINED
    return report_run(result, output, config)


@contextmanager
def _displays(
    config: Config, output: Output, title: str, scope: tuple[str, int] | None
) -> Iterator[Callable[[], Display]]:
    """What shows the run: the terminal, and the page if one is wanted."""
    terminal = run_display(output, title)
    if scope is None:
        yield terminal
        return
    from jointctl.tools.scoping.feed import Displays, scope_order, scope_server

    order = scope_order(title, *scope, cia402=not config.is_serial)
    output.address(f"scope: {order.url}")
    with scope_server(order) as feed:
        feed.settings({"stage": "terminal"})
        yield lambda: Displays([terminal(), feed])
