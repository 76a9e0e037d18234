"""The scope's page: signals over time with pause, zoom and trigger, state in words, deadlines, events, STOP."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from firmware_py.states import Fault
from tools.running.events import drive_state_name, phase_name
from tools.scoping.feed import ScopeOrder
from tools.scoping.history import SIGNALS, History, crossing_s, percentiles_us

REFRESH_s = 0.1
SLOW = 5  # every so many refreshes the texts are renewed
SPANS_s = (2, 5, 10, 30, 60)
FIRST_SIGNALS = ("error [mrad]", "command torque [Nm]")
STATISTICS_s = 10.0
_AFTER_TRIGGER = 0.5  # share of the span that is shown after the trigger


class ScopePage:
    """One viewer; all viewers look at the same history."""

    def __init__(self, order: ScopeOrder, history: History, stop: Callable[[int], None] | None) -> None:
        self._order, self._history, self._stop = order, history, stop
        self._live = stop is not None
        self._stops = 0
        self._ticks = 0
        self._held_s: float | None = None  # right end of the picture while it stands
        self._build()
        ui.timer(REFRESH_s, self._refresh)

    def _build(self) -> None:
        with ui.row().classes("w-full items-center justify-between"):
            ui.label(self._order.title).classes("text-2xl font-bold")
            self._state = ui.label("waiting for the run").classes("text-lg").props('data-testid="state"')
            if self._live:
                button = ui.button("STOP", on_click=self._on_stop, color="red")
                button.classes("text-2xl px-10 py-3 font-bold").props('data-testid="stop"')
        with ui.row().classes("w-full items-center gap-4"):
            self._signals = ui.select(list(SIGNALS), value=list(FIRST_SIGNALS), multiple=True, label="signals")
            self._signals.classes("min-w-64").props("use-chips")
            self._span = ui.select(list(SPANS_s), value=10 if self._live else 60, label="span [s]").classes("w-24")
            self._pause = ui.switch("pause", on_change=self._on_pause)
            self._armed = ui.switch("trigger", on_change=self._on_arm)
            self._source = ui.select(list(SIGNALS), value=FIRST_SIGNALS[0], label="on").classes("w-48")
            self._edge = ui.toggle({True: "rising", False: "falling"}, value=True)
            self._level = ui.number("level", value=0.0, format="%.4g").classes("w-28")
        self._chart = ui.echart(_options()).classes("w-full").style("height: 460px")
        with ui.row().classes("w-full gap-16 items-start"):
            with ui.column():
                ui.label(f"deadlines, last {STATISTICS_s:g} s: p50 / p99 / max").classes("font-bold")
                self._deadlines = ui.label("-").style("white-space: pre-line")
            with ui.column():
                ui.label("events").classes("font-bold")
                self._events = ui.label("-").style("white-space: pre-line")

    def _on_stop(self) -> None:
        """First brake under control, then quick stop, as Ctrl-C does."""
        self._stops = min(self._stops + 1, 2)
        if self._stop is not None:
            self._stop(self._stops)
        ui.notify("braking" if self._stops == 1 else "quick stop", type="warning")

    def _on_pause(self) -> None:
        rows = self._history.newest(1.0)
        self._held_s = float(self._history.seconds(rows)[-1]) if self._pause.value and len(rows) else None

    def _on_arm(self) -> None:
        self._held_s = None
        self._pause.value = False

    def _refresh(self) -> None:
        self._ticks += 1
        if self._ticks % SLOW == 1:
            self._texts()
        if self._pause.value and self._ticks > 1 and self._held_s is not None:
            return
        span_s = float(self._span.value)
        rows = self._history.newest(span_s, self._held_s)
        if not len(rows):
            return
        if self._armed.value and not self._pause.value:
            self._look_for_trigger(rows, span_s)
        self._draw(rows)

    def _look_for_trigger(self, rows: Any, span_s: float) -> None:
        """Hold the picture when the newest crossing stands in its middle."""
        field, factor = SIGNALS[self._source.value]
        time_s = self._history.seconds(rows)
        at_s = crossing_s(time_s, rows[field] * factor, float(self._level.value or 0.0), rising=bool(self._edge.value))
        if at_s is not None and time_s[-1] >= at_s + _AFTER_TRIGGER * span_s:
            self._held_s = at_s + _AFTER_TRIGGER * span_s
            self._pause.value = True
            self._held_s = at_s + _AFTER_TRIGGER * span_s  # the switch has set its own
            self._armed.value = False
            self._pause.value = True

    def _draw(self, rows: Any) -> None:
        names = list(self._signals.value or [])
        units = list(dict.fromkeys(name[name.index("[") :] for name in names))
        options = self._chart.options
        options["yAxis"] = [
            {"type": "value", "name": unit, "scale": True, "position": "left" if i == 0 else "right",
             "offset": max(0, i - 1) * 60}
            for i, unit in enumerate(units or [""])
        ]  # fmt: skip
        options["series"] = [
            {"type": "line", "name": name, "showSymbol": False, "lineStyle": {"width": 1.3}, "animation": False,
             "yAxisIndex": units.index(name[name.index("[") :]), "data": self._history.series(rows, name)}
            for name in names
        ]  # fmt: skip
        self._chart.update()

    def _texts(self) -> None:
        rows = self._history.newest(STATISTICS_s)
        if not len(rows):
            return
        last = rows[-1]
        drive = drive_state_name(int(last["status_word"]), int(last["drive_state"]), cia402=self._order.cia402)
        fault = int(last["fault"])
        words = [phase_name(int(last["phase"])), drive]
        if fault:
            words.append(Fault(fault).name if fault in list(Fault) else f"fault {fault}")
        if self._history.ended:
            words.append("the run has ended")
        self._state.text = " · ".join(words)
        self._state.style("color: #d33" if fault else "color: inherit")
        lines = [f"{name}: {text}" for name, text in percentiles_us(rows).items()]
        self._deadlines.text = "\n".join([*lines, f"skipped since the start: {self._history.skipped} cycles"])
        newest = list(self._history.events)[-8:]
        self._events.text = "\n".join(f"{e.source}: {e.text}" for e in reversed(newest)) or "-"


def _options() -> dict[str, Any]:
    return {
        "animation": False,
        "legend": {"top": 0},
        "grid": {"left": 60, "right": 70, "top": 50, "bottom": 80},
        "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "value", "name": "s", "min": "dataMin", "max": "dataMax"},
        "yAxis": [{"type": "value", "scale": True}],
        "dataZoom": [{"type": "inside"}, {"type": "slider", "bottom": 20}],
        "series": [],
    }


def build_page(order: ScopeOrder, history: History, stop: Callable[[int], None] | None) -> None:
    """The page of one viewer; `stop` None means that there is nothing to stop, only a log to look at."""
    ScopePage(order, history, stop)
