"""The scope's page: one viewer, put together from its panels; all viewers look at the same history."""

from __future__ import annotations

import time
from typing import Any, Protocol

from nicegui import ui

from jointctl.tools.recording.run_log import Event
from jointctl.tools.scoping.change_panels import ChangePanels
from jointctl.tools.scoping.chart import Chart
from jointctl.tools.scoping.history import History, percentiles_us
from jointctl.tools.scoping.order import ScopeOrder
from jointctl.tools.scoping.start_panel import StartPanel
from jointctl.tools.scoping.stop_button import StopButton, stale_mark
from jointctl.tools.session.display import ViewerRequest, viewer
from jointctl.tools.session.events import drive_state_name, fault_words, phase_name

REFRESH_s = 0.1
IDLE_SHARE = 3.0  # drawing leaves at least so many times its own duration to everything else, STOP above all
SLOW = 5  # every so many refreshes the texts are renewed
STATISTICS_s = 10.0
SHOWN_EVENTS = 8
SILENT_s = 2.0  # a run tells something 50 times a second
CSS = (
    ".q-field__label{font-size:13px} body{font-size:14px} .nicegui-content{padding:0 14px 10px; gap:8px}"
    " .scope-head{position:sticky; top:0; z-index:10; background:#fff; padding:10px 0 4px}"
    " @media (max-width: 900px) {.scope-body{flex-wrap:wrap} .scope-body>*{width:100%}}"
)
STAGES = {
    "terminal": "waiting for the answer in the terminal",
    "preparing": "preparing the drive; nothing moves",
    "ready": "ready; nothing moves before Start",
    "declined": "not started; the drive is disabled",
}


class Link(Protocol):
    """The way back to the supervisor."""

    def ask(self, request: ViewerRequest) -> bool:
        """Whether it was taken; STOP has a way of its own."""
        ...


class ScopePage:
    """What one viewer sees; `link` None means that there is only a log to look at."""

    def __init__(self, order: ScopeOrder, history: History, link: Link | None) -> None:
        self._order, self._history, self._link = order, history, link
        self._ticks = 0
        self._draw_again_s = 0.0
        client: Any = ui.context.client
        self._who = viewer(getattr(client, "ip", None))
        ui.add_css(CSS)
        self._build()
        self._tell()
        ui.timer(REFRESH_s, self._refresh)

    def _build(self) -> None:
        self._stop: StopButton | None = None
        with ui.row().classes("w-full items-start no-wrap gap-4 scope-head"):
            with ui.column().classes("gap-0 grow min-w-0"):
                ui.label(self._order.title).classes("text-xl font-bold leading-tight")
                self._state = ui.label("waiting for the run").classes("text-base").props('data-testid="state"')
                stale_mark()
            if self._link is not None:
                self._stop = StopButton()
        self._start = StartPanel(self._ask) if self._link is not None else None
        with ui.row().classes("w-full no-wrap items-start gap-4 scope-body"):
            with ui.column().classes("grow min-w-0 gap-2"):
                self._chart = Chart(self._history, live=self._link is not None)
                with ui.row().classes("w-full no-wrap gap-10 items-start scope-body"):
                    self._deadlines = _text_block(f"Deadlines, last {STATISTICS_s:g} s", "deadlines")
                    self._events = _text_block("Events", "events")
            if self._link is not None:
                self._changes: ChangePanels | None = ChangePanels(self._ask)
            else:
                self._changes = None

    def _ask(self, kind: str, values: dict[str, Any]) -> None:
        if self._link is not None and not self._link.ask(ViewerRequest(kind, self._who, values)):
            ui.notify("not taken: jointctl does not listen", type="negative", position="top")

    def _refresh(self) -> None:
        self._ticks += 1
        if self._ticks % SLOW == 1:
            self._tell()
        now_s = time.monotonic()
        if now_s >= self._draw_again_s:
            self._chart.refresh()
            drawn_s = time.monotonic()
            self._draw_again_s = drawn_s + IDLE_SHARE * (drawn_s - now_s)

    def _tell(self) -> None:
        """Everything but the picture."""
        self._texts()
        if self._stop is not None:
            self._stop.beat(self._ticks)
        settings = self._history.settings
        if self._start is not None:
            self._start.show(settings)
        if self._changes is not None:
            self._changes.show(settings)

    def _texts(self) -> None:
        stage = str(self._history.settings.get("stage", ""))
        rows = self._history.newest(STATISTICS_s)
        events = list(self._history.events)[-SHOWN_EVENTS:]
        self._events.text = "\n".join(self._line(event) for event in reversed(events)) or "none yet"
        fault = int(rows[-1]["fault"]) if len(rows) else 0
        words = [STAGES[stage]] if stage in STAGES else self._words(rows, stage) if len(rows) else []
        self._state.text = " · ".join(words) or "waiting for the run"
        silent_s = time.monotonic() - self._history.heard_s
        if stage == "running" and not self._history.ended and silent_s > SILENT_s:
            words.append(f"NO NEWS FROM THE RUN for {silent_s:.0f} s")
        bad = (fault and stage not in STAGES) or (silent_s > SILENT_s and stage == "running")
        self._state.style(replace="color: #c62828; font-weight: 600" if bad else "color: inherit")
        if len(rows):
            lines = [f"{name:13}{text}" for name, text in percentiles_us(rows).items()]
            lines.append(f"{'skipped':13}{self._history.skipped} cycles since the start")
            self._deadlines.text = "\n".join([f"{'':13}p50 / p99 / max", *lines])

    def _line(self, event: Event) -> str:
        return f"{max(0.0, self._history.second(event.time_ns)):7.1f} s  {event.source}: {event.text}"

    def _words(self, rows: Any, stage: str) -> list[str]:
        last = rows[-1]
        drive = drive_state_name(int(last["status_word"]), int(last["drive_state"]), cia402=self._order.cia402)
        words = [phase_name(int(last["phase"])), f"drive: {drive}"]
        temperature_degC = self._history.settings.get("temperature_degC")
        if temperature_degC is not None and not self._history.ended and stage != "ended":
            words.append(f"{temperature_degC:.1f} °C")
        fault = int(last["fault"])
        if fault:
            words.append(f"FAULT: {fault_words(fault)}")
        if self._history.ended or stage == "ended":
            words.append("the run has ended")
        elif motion := self._history.settings.get("motion"):
            words.append(str(motion))
        return words


def _text_block(title: str, name: str) -> Any:
    with ui.column().classes("gap-0 min-w-0" if name == "events" else "gap-0 shrink-0"):
        ui.label(title).classes("font-bold")
        label = ui.label("-").style("white-space: pre-wrap; font: 12px/1.45 monospace")
        label.style("" if name == "events" else "white-space: pre")
        return label.props(f'data-testid="{name}"')


def build_page(order: ScopeOrder, history: History, link: Link | None) -> None:
    """The page of one viewer."""
    ScopePage(order, history, link)
