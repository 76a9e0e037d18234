"""`jointctl scope LOG|CONFIG`: a run log in a web page, or runs that are started and watched from there."""

from __future__ import annotations

import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.drive import CommissioningReport
from drivers.errors import JointctlError
from firmware_py.states import StopRequest
from tools.output import Output
from tools.recording.log_folder import log_path
from tools.recording.run_log import read_run_log
from tools.running.envelope import motion_envelope
from tools.running.live_panel import run_display
from tools.running.run_report import report_run
from tools.running.shared_block import SERIAL
from tools.running.supervisor import Supervisor
from tools.scoping.displays import Displays
from tools.scoping.feed import ScopeFeed, scope_server
from tools.scoping.order import scope_order

if TYPE_CHECKING:
    from tools.configuration.config import Config

HOST, PORT = "127.0.0.1", 8642
POLL_S = 0.05
PREPARED_S = 300.0  # what was found and shown holds for so long; then the run is to be prepared again


def scope(path: Path, output: Output, *, host: str = HOST, port: int = PORT) -> int:
    """Serve a run log; the page can zoom, but there is nothing to stop.  Returns the exit code."""
    read_run_log(path)  # what is wrong with it is to be told here
    order = scope_order(path.stem, host, port, log=str(path))
    output.note(f"scope: {order.url}  (Ctrl-C ends it)")
    from tools.scoping.server import serve

    serve(order)
    return 0


def live_scope(
    config: Config, output: Output, *, host: str = HOST, port: int = PORT, allow_low_margin: bool = False,
    unwatched_s: float | None = None,
) -> int:  # fmt: skip
    """Serve a page from which runs are started, changed and stopped, until Ctrl-C; the exit code of the last run.

    Nothing moves before a viewer has confirmed the motion envelope that the page shows.  `unwatched_s`: brake when no
    page has been open for so long; None = go on.
    """
    title = f"{config.path.stem}: {config.trajectory.kind}"
    order = scope_order(title, host, port, cia402=config.bus.interface != SERIAL)
    output.note(f"scope: {order.url}  (Ctrl-C ends it; nothing moves before Start on the page)")
    code = 0
    with scope_server(order, in_charge=True, unwatched_s=unwatched_s) as feed:
        try:
            while True:
                code, ended = _one_run(config, output, feed, title, allow_low_margin=allow_low_margin)
                if ended:
                    return code
                _wait_for_prepare(feed)
        except KeyboardInterrupt:
            output.note("scope ended; the drive is disabled")
            return code


def _one_run(
    config: Config, output: Output, feed: ScopeFeed, title: str, *, allow_low_margin: bool
) -> tuple[int, bool]:
    """(exit code, whether a signal has ended the program as well)."""
    feed.forget()
    feed.settings({"stage": "preparing", "lines": []})

    def confirm(report: CommissioningReport) -> bool:
        lines = motion_envelope(config, report)
        for line in lines:
            output.note(line)
        return confirmed(feed, lines)

    terminal = run_display(output, title)
    supervisor = Supervisor(
        config,
        output,
        log_path(config),
        confirm,
        allow_low_margin=allow_low_margin,
        display=lambda: Displays([terminal(), feed]),
    )
    try:
        result = supervisor.run()
        if result is None:
            why = "stopped before it began" if feed.stop_request() else f"not started within {PREPARED_S:g} s"
            feed.settings({"stage": "declined", "lines": [f"{why}; nothing moved"]})
            return 0, False
        code = report_run(result, output, title)
    except ServerGone:
        raise
    except JointctlError as error:
        output.error(error.message, error.hint)
        feed.settings({"stage": "ended", "lines": [error.message, error.hint]})
        return error.exit_code, supervisor.signals.count > 0
    lines = [f"log      {result.log_path}", f"drive    {result.drive_state}"]
    if result.summary.error is not None:
        lines.insert(0, f"error    RMSE {result.summary.error.rmse_rad * 1e3:.3f} mrad")
    feed.settings({"stage": "ended", "lines": lines})
    return code, result.stopped_by.startswith("SIG")


def confirmed(feed: ScopeFeed, lines: list[str], patience_s: float = PREPARED_S) -> bool:
    """Wait until a viewer confirms this very envelope; False if one presses STOP, or nobody does anything for long.

    The number goes to the page with the lines and comes back with Start: a page that still shows an older envelope
    starts nothing.
    """
    number = secrets.randbelow(1 << 48)
    told_s, give_up_s = 0.0, time.monotonic() + patience_s
    while feed.stop_request() is StopRequest.NONE and time.monotonic() < give_up_s:
        for request in feed.requests():
            given = request.values.get("number"), request.values.get("clear")
            if request.kind == "start" and given == (number, True):
                return True
        _require_server(feed)
        if time.monotonic() - told_s > 1.0:
            told_s = time.monotonic()
            feed.settings({"stage": "ready", "number": number, "lines": lines})
        time.sleep(POLL_S)
    return False


def _wait_for_prepare(feed: ScopeFeed) -> None:
    while not any(request.kind == "prepare" for request in feed.requests()):
        _require_server(feed)
        time.sleep(POLL_S)


class ServerGone(JointctlError):
    """Without its page, nobody could start or stop anything."""


def _require_server(feed: ScopeFeed) -> None:
    if feed.gone:
        raise ServerGone("the scope's web server has ended", "what it said is above; is the extra `scope` complete?")
