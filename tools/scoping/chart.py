"""The scope's picture: chosen signals over time, with pause, zoom and trigger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from nicegui import ui

from jointctl.tools.scoping.history import SIGNALS, History, crossing_s

SPANS_s = (2, 5, 10, 30, 60)
FIRST_SIGNALS = ("desired angle [rad]", "angle [rad]", "command torque [Nm]")
AFTER_TRIGGER = 0.5  # share of the span that is shown after the trigger
COLOURS = ("#1f5fa8", "#b85c0c", "#2e7d52", "#a8323e", "#6a51a3", "#5f6b76")  # on white
DARK_COLOURS = ("#6fa8e8", "#f0a35e", "#6fce9b", "#ef8791", "#b7a3ea", "#b4bec8")  # on nearly black
_TEXT, _DARK_TEXT = "#333333", "#dddddd"
# an axis shows at least so much: the noise of a joint at rest is no motion
LEAST_SPAN = {"[mrad]": 0.2, "[rad]": 2e-3, "[rad/s]": 0.02, "[Nm]": 0.2, "[us]": 20.0}
_AXIS = {"type": "value", "scale": True, "nameTextStyle": {"fontSize": 12}, "splitLine": {"lineStyle": {"width": 0.6}}}


def axis_range(low: float, high: float, unit: str) -> tuple[float, float] | None:
    """Ends of an axis whose signals hardly change; None where it fits itself to them."""
    least = LEAST_SPAN.get(unit, 0.0)
    if not high - low < least:
        return None
    step = least / 4.0  # ends on round numbers, which do not creep with the noise
    middle = round((low + high) / 2.0 / step) * step
    return middle - least / 2.0 - step, middle + least / 2.0 + step


class Chart:
    """Refreshed ten times a second; what is not live or is paused is drawn only when something about it changes."""

    def __init__(self, history: History, *, live: bool) -> None:
        self._history = history
        self._held_s: float | None = None  # right end of the picture while it stands
        self._drawn: Any = None
        self._names: list[str] = []
        self._colours = COLOURS
        with ui.row().classes("w-full items-center gap-3"):
            self._signals = ui.select(list(SIGNALS), value=list(FIRST_SIGNALS), multiple=True, label="signals")
            self._signals.classes("grow min-w-40").props('dense options-dense data-testid="signals"')
            self._span = ui.select(list(SPANS_s), value=10 if live else 60, label="span [s]").classes("w-20")
            self._span.props("dense options-dense")
            self._pause = ui.switch("pause", on_change=self._on_pause).props('dense data-testid="pause"')
            ui.button("reset zoom", on_click=self._reset_zoom, color=None).props("flat dense no-caps")
        with ui.row().classes("w-full items-center gap-3"):
            self._armed = ui.switch("trigger", on_change=self._on_arm).props('dense data-testid="trigger"')
            self._source = ui.select(list(SIGNALS), value="angle [rad]", label="on").classes("w-48")
            self._source.props("dense options-dense")
            self._edge = ui.toggle({True: "rising", False: "falling"}, value=True).props("dense no-caps")
            self._level = ui.number("level", value=0.0, format="%.4g").classes("w-24").props("dense")
            ui.label("holds the picture with the crossing in its middle").classes("text-xs scope-aside")
        self._chart = ui.echart(_options()).classes("w-full").style("height: 390px")
        self._chart.props('data-testid="chart" role=img aria-label="the chosen signals over time"')
        self.dark(False)

    def dark(self, on: bool) -> None:
        self._colours, text = (DARK_COLOURS, _DARK_TEXT) if on else (COLOURS, _TEXT)
        options, plain = self._chart.options, {"color": text}
        options["textStyle"], options["legend"]["textStyle"] = plain, plain
        options["xAxis"] |= {"nameTextStyle": plain, "axisLabel": {**options["xAxis"]["axisLabel"], **plain}}
        self._text, self._drawn = text, None
        self._chart.update()

    def _on_pause(self) -> None:
        rows = self._history.newest(1.0)
        if not self._pause.value:
            self._held_s = None
        elif self._held_s is None and len(rows):
            self._held_s = float(self._history.seconds(rows)[-1])

    def _on_arm(self) -> None:
        if self._armed.value:
            self._held_s = None
            self._pause.value = False

    def _reset_zoom(self) -> None:
        self._chart.run_chart_method("dispatchAction", {"type": "dataZoom", "start": 0, "end": 100})

    def refresh(self) -> None:
        span_s = float(self._span.value)
        rows = self._history.newest(span_s, self._held_s)
        if not len(rows):
            return
        if self._armed.value and not self._pause.value:
            self._look_for_trigger(rows, span_s)
            rows = self._history.newest(span_s, self._held_s)
        names = list(self._signals.value or [])
        now = (int(rows["time_ns"][0]), int(rows["time_ns"][-1]), names, span_s)
        if now != self._drawn:
            self._drawn = now
            self._draw(rows, names)

    def _look_for_trigger(self, rows: np.ndarray, span_s: float) -> None:
        """Hold the picture when the newest crossing stands in its middle."""
        field, factor = SIGNALS[self._source.value]
        time_s = self._history.seconds(rows)
        values = rows[field] * factor
        older = time_s <= time_s[-1] - AFTER_TRIGGER * span_s
        level = float(self._level.value or 0.0)
        at_s = crossing_s(time_s[older], values[older], level, rising=bool(self._edge.value))
        if at_s is not None:
            self._held_s = at_s + AFTER_TRIGGER * span_s
            self._armed.value = False
            self._pause.value = True

    def _draw(self, rows: np.ndarray, names: list[str]) -> None:
        units = list(dict.fromkeys(name[name.index("[") :] for name in names))
        options, series = self._chart.options, {name: self._history.series(rows, name) for name in names}
        plain = {"color": self._text}
        options["yAxis"] = [
            {**_AXIS, **_ends(unit, series), "name": unit, "position": "left" if i == 0 else "right",
             "offset": max(0, i - 1) * 56, "axisLabel": plain, "nameTextStyle": {"fontSize": 12, **plain}}
            for i, unit in enumerate(units or [""])
        ]  # fmt: skip
        options["grid"]["right"] = 24 + 56 * max(0, len(units) - 1)
        options["series"] = [
            {"type": "line", "name": name, "showSymbol": False, "lineStyle": {"width": 1.4}, "animation": False,
             "color": self._colours[i % len(self._colours)],
             "yAxisIndex": units.index(name[name.index("[") :]), "data": series[name]}
            for i, name in enumerate(names)
        ]  # fmt: skip
        if names != self._names:  # axes that are left over would stay otherwise; the zoom begins anew
            self._names = names
            self._chart.run_chart_method("clear")
        self._chart.update()


def _ends(unit: str, series: Mapping[str, Sequence[Sequence[float | None]]]) -> dict[str, float]:
    """`min` and `max` of the axis of a unit, where it does not fit itself to its signals."""
    values = [pair[1] for name, data in series.items() if name.endswith(unit) for pair in data if pair[1] is not None]
    found = axis_range(min(values), max(values), unit) if values and unit else None
    return {} if found is None else {"min": found[0], "max": found[1]}


def _options() -> dict[str, Any]:
    return {
        "animation": False,
        "legend": {"top": 0},
        "grid": {"left": 56, "right": 24, "top": 52, "bottom": 74},
        "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "value", "name": "s", "min": "dataMin", "max": "dataMax", "splitLine": {"show": False},
                  "axisLine": {"onZero": False},
                  "axisLabel": {"showMinLabel": False, "showMaxLabel": False}},
        "yAxis": [dict(_AXIS)],
        "dataZoom": [{"type": "inside"}, {"type": "slider", "bottom": 8, "height": 22, "labelPrecision": 1}],
        "series": [],
    }  # fmt: skip
