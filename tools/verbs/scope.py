"""`jointctl scope LOG|CONFIG`: a run log in a web page, or runs that are started and watched from there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointctl.drivers.errors import DECLINED, INTERRUPTED, JointctlError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import (
    AS_CONFIGURED,
    AllowLowMargin,
    CanOptions,
    ProgressOutput,
    loaded,
    logs_and_configurations,
)

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.scoping.feed import ScopeFeed

HOST, PORT = "127.0.0.1", 8642
POLL_S = 0.05
TELL_AGAIN_S = 1.0
START_LATE = "Start came late and was not taken, nothing moves: press it again"
PREPARED_S = 300.0  # what was found and shown holds for so long; then the run is to be prepared again


def scope(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="LOG|CONFIG",
            help="run log (MCAP), or configuration of a joint",
            autocompletion=logs_and_configurations,
        ),
    ],
    output: ProgressOutput,
    *,
    host: Annotated[str, typer.Option("--host", help="address to serve at")] = HOST,
    port: Annotated[int, typer.Option("--port", help="of the page")] = PORT,
    bus: CanOptions = AS_CONFIGURED,
    allow_low_margin: AllowLowMargin = False,
    stop_unwatched: Annotated[
        float | None,
        typer.Option("--stop-unwatched", metavar="S", min=1.0, help="brake when no page has been open for S seconds"),
    ] = None,
) -> int:
    """A local web page: a run log to zoom into, or a joint to start, watch, change and stop from the browser."""
    if path.suffix == ".mcap":
        return _scope_of_log(path, output, host, port)
    return live_scope(
        loaded(path, bus), output, host=host, port=port, allow_low_margin=allow_low_margin, unwatched_s=stop_unwatched
    )


def _scope_of_log(path: Path, output: Output, host: str, port: int) -> int:
    """Serve a run log; the page can zoom, but there is nothing to stop."""
    from jointctl.tools.recording.run_log_reader import read_run_log
    from jointctl.tools.scoping.feed import scope_order

    read_run_log(path)  # what is wrong with it is to be reported here
    order = scope_order(path.stem, host, port, log=str(path))
    output.address(f"scope: {order.url}  (Ctrl-C ends it)")
    from jointctl.tools.scoping.server import serve

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
    from jointctl.drivers.stop_note import asked_anew
    from jointctl.tools.scoping.feed import scope_order, scope_server
    from jointctl.tools.session.result import run_title, words

    title = run_title(config)
    order = scope_order(title, host, port, drive=config.drive.kind, loop_cpu=config.loop.cpu)
    output.address(f"scope: {order.url}  (Ctrl-C ends it; nothing moves before Start on the page)")
    with scope_server(order, in_charge=True, unwatched_s=unwatched_s) as feed:
        runs = _Runs(config, output, feed, title, allow_low_margin=allow_low_margin)
        try:
            while not runs.one():
                asked_anew(_wait_for_prepare(feed, runs.last_end))
        except KeyboardInterrupt:
            try:
                ended = f"scope ended{runs.ended_by}; {words(runs.drive_state, interrupted=True)}"
            except JointctlError as error:
                runs.tell("ended", [error.message, error.hint])
                raise
            output.note(ended)
            runs.tell("ended", [ended])
        return runs.code


class _Runs:
    """One run after another, each prepared, confirmed and watched from the page."""

    def __init__(self, config: Config, output: Output, feed: ScopeFeed, title: str, *, allow_low_margin: bool) -> None:
        self._config, self._output, self._feed, self._title = config, output, feed, title
        self._allow_low_margin = allow_low_margin
        self.code = 0  # exit code of the last one
        self.drive_state = ""  # after the last one
        self.ended_by = ""  # in words, where `jointctl stop` has ended the program
        self._ended = False  # whether a signal or `jointctl stop` has ended the program as well
        self.last_end: dict[str, Any] = {}  # to the page, of how the last one ended

    def tell(self, stage: str, lines: list[str]) -> None:
        """The pages, and again until the next run is prepared."""
        self.last_end = {"stage": stage, "lines": lines}
        self._feed.settings(self.last_end)

    def one(self) -> bool:
        """Prepare, wait for Start, run, report; whether a signal has ended the program as well."""
        from jointctl.tools.session.control import in_control
        from jointctl.tools.session.display import Displays, run_display
        from jointctl.tools.session.plan import resolve
        from jointctl.tools.session.result import report_run, words
        from jointctl.tools.session.session import Session

        output, feed, config = self._output, self._feed, self._config
        feed.forget()
        self.tell("preparing", [])
        terminal = run_display(output, self._title)
        try:
            plan = resolve(config, allow_low_margin=self._allow_low_margin)
            with in_control(config, output) as control:
                consent = PageConsent(feed, output)
                session = Session(plan, consent, output, control, lambda report: Displays([terminal(report), feed]))
                try:
                    result = session.run()
                finally:
                    self.drive_state, self._ended = session.drive_state, control.signals.count > 0
            if result is None:
                self.code = DECLINED
                why = "stopped before it began" if feed.stop_request() else f"not started within {PREPARED_S:g} s"
                self.tell("declined", [f"{why}; nothing moved; {words(self.drive_state)}"])
                return False
            self.code = report_run(result, output, self._config)
        except ServerGone:
            raise
        except KeyboardInterrupt as stop:
            self.ended_by = str(stop)
            if self.ended_by:
                self.code = INTERRUPTED
            raise
        except JointctlError as error:
            output.error(error.message, error.hint)
            self.code = error.exit_code
            self.tell("ended", [error.message, error.hint])
            return self._ended
        lines = [f"log      {result.log_place}", f"drive    {result.drive_state}"]
        if result.summary.error is not None:
            lines.insert(0, f"error    RMSE {result.summary.error.rmse_rad * 1e3:.3f} mrad")
        if result.stopped_by:
            lines.insert(0, f"stopped  by {result.stopped_by}")
        if result.fault_text is not None:
            text = result.fault_text
            lines.insert(0, f"{result.fault.name}: {text.happened}; {text.advice}")
        self.tell("ended", lines)
        return self._ended


class PageConsent:
    """The viewer who presses Start below the envelope; see `Consent`.  Nobody at the page may brake a drive."""

    dry_run, brake = False, None

    def __init__(self, feed: ScopeFeed, output: Output) -> None:
        self._feed, self._output = feed, output

    def show(self, lines: Sequence[str]) -> None:
        """See `Consent`; the page shows them with its question."""
        for line in lines:
            self._output.note(line)

    def agreed(self, lines: Sequence[str]) -> bool:
        return confirmed(self._feed, list(lines))


def confirmed(feed: ScopeFeed, lines: list[str], patience_s: float = PREPARED_S) -> bool:
    """Wait until a viewer confirms this very envelope; False if one presses STOP, or nobody does anything for long.

    The number goes to the page with the lines and comes back with Start: a page that still shows an older envelope
    starts nothing.  So does the time of the last word that the browser had: a Start that was held up on its way, or by
    a server or a supervisor that stood still, comes when nobody expects it.
    """
    import secrets

    from jointctl.firmware_py.states import StopRequest
    from jointctl.tools.scoping.feed import in_time, now_s

    number = secrets.randbelow(1 << 48)
    told_s, give_up_s, late = 0.0, now_s() + patience_s, ""
    while feed.stop_request() is StopRequest.NONE and now_s() < give_up_s:
        for request in feed.requests():
            given = request.values.get("number"), request.values.get("clear")
            if request.kind == "start" and given == (number, True):
                if in_time(request):
                    return True
                late, told_s = START_LATE, 0.0
        _require_server(feed)
        if now_s() - told_s > TELL_AGAIN_S:
            told_s = now_s()
            feed.settings({"stage": "ready", "number": number, "lines": lines, "told_s": told_s, "late": late})
        time.sleep(POLL_S)
    return False


def _wait_for_prepare(feed: ScopeFeed, last_end: dict[str, Any]) -> int:
    """Until a viewer asks for the next run; CLOCK_BOOTTIME [ns] just before: a stop that came later is one of that run.

    How the last one ended is said again: a full socket may drop it.
    """
    from jointctl.drivers.stop_note import now_ns

    told_s, before_ns = time.monotonic(), now_ns()
    while True:
        looked_ns = now_ns()
        if any(request.kind == "prepare" for request in feed.requests()):
            return before_ns
        before_ns = looked_ns
        _require_server(feed)
        if time.monotonic() - told_s > TELL_AGAIN_S:
            told_s = time.monotonic()
            feed.settings(last_end)
        time.sleep(POLL_S)


class ServerGone(JointctlError):
    """Without its page, nobody could start or stop anything."""


def _require_server(feed: ScopeFeed) -> None:
    if feed.gone:
        raise ServerGone("the scope's web server has ended", "what it said is above; is the extra `scope` complete?")
