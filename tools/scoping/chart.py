"""The scope's picture: chosen signals in one of their views, with pause, zoom, trigger, cursors and export."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from nicegui import ui

from jointctl.tools.scoping.history import (
    AGAINST,
    SIGNALS,
    SPECTRUM,
    TIME,
    TIME_NAME,
    VIEWS,
    History,
    Seen,
    crossing_s,
    readings,
    seen,
)

SPANS_s = (2, 5, 10, 30, 60)
FIRST_SIGNALS = ("desired angle [rad]", "angle [rad]", "command torque [Nm]")
NARROW_px = 600  # in rows, the names of the lines would cover the units of a picture that is no wider
AFTER_TRIGGER = 0.5  # share of the span that is shown after the trigger
COLOURS = ("#1f5fa8", "#b85c0c", "#2e7d52", "#a8323e", "#6a51a3", "#5f6b76")  # on white
DARK_COLOURS = ("#6fa8e8", "#f0a35e", "#6fce9b", "#ef8791", "#b7a3ea", "#b4bec8")  # on nearly black
_TEXT, _DARK_TEXT = "#333333", "#dddddd"
_GRID, _DARK_GRID = "#dde2e8", "#3b4148"
# an axis shows at least so much: the noise of a joint at rest is no motion
LEAST_SPAN = {"[mrad]": 0.2, "[rad]": 2e-3, "[rad/s]": 0.02, "[Nm]": 0.2, "[us]": 20.0}
# a click where no cursor was set longer ago than the other's sets it; the chart is there some time after the page
_ON_CLICK = """(function listen() {
  const chart = getElement(ID)?.chart
  if (!chart) return setTimeout(listen, 200)
  chart.getZr().on('click', event => {
    const at = [event.offsetX, event.offsetY]
    if (chart.containPixel('grid', at)) emitEvent('cursor-ID', chart.convertFromPixel({xAxisIndex: 0}, at[0]))
  })
})()"""
# a choice shows before the server has answered: the next one, made from what is shown, would take it back
_SHOWN_AT_ONCE = """value => { mounted_app.elements[ID].props['model-value'] = value }"""
# null: not cut off at that end, where samples may lie beyond the drawn ones
_ZOOMED = """(zoom => [zoom.start > 0 ? zoom.startValue : null, zoom.end < 100 ? zoom.endValue : null])(
  getElement(ID).chart.getOption().dataZoom[0])"""
# the options as the element has them: functions among them are none on the way there
_ANEW = "(element => element?.chart?.setOption(element.options, true))(getElement(ID))"
_SAVE_PNG = """(() => {
  const link = document.createElement('a')
  link.href = getElement(ID).chart.getDataURL({type: 'png', pixelRatio: 2, backgroundColor: 'BEHIND'})
  link.download = 'NAME'
  link.click()
})()"""
_BEHIND, _DARK_BEHIND = "#ffffff", "#121212"
_AXIS = {"type": "value", "scale": True, "axisLine": {"onZero": False}, "nameTextStyle": {"fontSize": 12}}
_POWERS = {":formatter": "value => value.toExponential(0)"}  # of ten, as the ticks of a spectrum


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
        self._all, self._history, self._live = history, history, live
        self._run = history.runs
        self._held_s: float | None = None  # right end of the picture while it stands
        self._drawn: Any = None
        self._names: tuple[str, list[str]] | None = None  # view and signals of the picture
        self._colours, self._behind = COLOURS, _BEHIND
        self._seen = Seen("", np.zeros(0), {})
        self._next_cursor = 0
        with ui.row().classes("w-full items-center gap-3"):
            if len(history.joints) > 1:
                names = dict(enumerate(history.joints))
                self._joint = ui.select(names, value=0, label="joint", on_change=self._on_joint).classes("w-32")
                self._joint.props('dense options-dense data-testid="joint"')
            self._signals = ui.select(list(SIGNALS), value=list(FIRST_SIGNALS), multiple=True, label="signals")
            self._signals.classes("grow min-w-40").props('dense options-dense data-testid="signals"')
            self._signals.on("update:model-value", js_handler=_SHOWN_AT_ONCE.replace("ID", str(self._signals.id)))
            self._span = ui.select(list(SPANS_s), value=10 if live else 60, label="span [s]").classes("w-20")
            self._span.props("dense options-dense")
            if not live and (end_s := self._end_s()) > SPANS_s[-1]:  # what came before can be seen as well
                self._until = ui.number("until [s]", value=end_s, step=5, format="%.6g").classes("w-24")
                self._until.on_value_change(self._on_until).props('dense data-testid="until"')
            self._pause = ui.switch("pause", on_change=self._on_pause).props('dense data-testid="pause"')
            ui.button("reset zoom", on_click=self._reset_zoom, color=None).props("flat dense no-caps")
        with ui.row().classes("w-full items-center gap-3"):
            self._armed = ui.switch("trigger", on_change=self._on_arm).props('dense data-testid="trigger"')
            self._source = ui.select(list(SIGNALS), value="angle [rad]", label="source").classes("w-48")
            self._source.props("dense options-dense")
            self._edge = ui.toggle({True: "rising", False: "falling"}, value=True).props("dense no-caps")
            self._level = ui.number("level", value=0.0, format="%.4g").classes("w-24").props("dense")
            ui.label("holds the picture with the crossing in its middle").classes("text-xs scope-aside")
        self._build_views()
        self._chart = ui.echart(_options()).classes("w-full").style("height: 390px")
        self._chart.props('data-testid="chart" role=img aria-label="the chosen signals over time"')
        self._readings = ui.label("").style("white-space: pre; overflow-x: auto; font: 12px/1.45 monospace")
        self._readings.classes("w-full").props('data-testid="readings" role=status')
        ui.on(f"cursor-{self._chart.id}", lambda event: self._on_click(float(event.args)))
        ui.run_javascript(_ON_CLICK.replace("ID", str(self._chart.id)))
        self._show_cursors()
        self.dark(False)

    def _build_views(self) -> None:
        """The line with view, cursors and export."""
        with ui.row().classes("w-full items-center gap-3"):
            self._view = ui.toggle({view: view for view in VIEWS}, value=TIME, on_change=self._on_view)
            self._view.props('dense no-caps data-testid="view" aria-label="view"')
            self._cursors = ui.switch("cursors", on_change=self._on_cursors).props('dense data-testid="cursors"')
            self._places = [ui.number(name, value=0.0, step=0.01, format="%.6g").classes("w-24") for name in "AB"]
            for name, place in zip("ab", self._places, strict=True):
                place.props(f'dense data-testid="cursor-{name}"')
            self._hint = ui.label("a click sets A, the next one B").classes("text-xs scope-aside")
            ui.space()
            for name, save in (("CSV", self._save_csv), ("PNG", self._save_png)):
                button = ui.button(name, on_click=save, color=None).props("flat dense no-caps")
                button.props(f'data-testid="{name.lower()}" title="what is seen, as {name}"')

    def _on_joint(self) -> None:
        self._history = self._all.of(int(self._joint.value or 0))
        self._names = self._drawn = None

    def _on_view(self) -> None:
        self._names = None  # the zoom and the axes begin anew
        self._drawn = None
        self._cursors.set_enabled(self._view.value != AGAINST)
        if self._view.value == AGAINST:
            self._cursors.value = False
        elif self._cursors.value:
            self.refresh()
            self._place_cursors()

    def _on_cursors(self) -> None:
        if self._cursors.value:
            self._pause.value = True
            self._place_cursors()
        self._show_cursors()

    def _place_cursors(self) -> None:
        """At a third and two thirds of the picture."""
        if len(self._seen.x):
            low, high = float(self._seen.x[0]), float(self._seen.x[-1])
            for place, share in zip(self._places, (1 / 3, 2 / 3), strict=True):
                place.value = round(low + share * (high - low), 4)

    def _show_cursors(self) -> None:
        for part in (*self._places, self._hint, self._readings):
            part.visible = bool(self._cursors.value)
        self._drawn = None

    def _on_click(self, x: float) -> None:
        if self._cursors.value:
            self._places[self._next_cursor].value = round(x, 6)
            self._next_cursor = 1 - self._next_cursor

    def _cursor_places(self) -> list[float]:
        return [float(place.value) for place in self._places if place.value is not None] if self._cursors.value else []

    async def _save_csv(self) -> None:
        """Every sample that stands in the picture, zoom included."""
        low, high = await ui.run_javascript(_ZOOMED.replace("ID", str(self._chart.id)))
        ends = -math.inf if low is None else float(low), math.inf if high is None else float(high)
        ui.download.content(self._seen.csv(*ends), self._file_name("csv"))

    def _save_png(self) -> None:
        script = _SAVE_PNG.replace("ID", str(self._chart.id)).replace("BEHIND", self._behind)
        ui.run_javascript(script.replace("NAME", self._file_name("png")))

    def _file_name(self, ending: str) -> str:
        return f"jointctl-{self._view.value}.{ending}"

    def resend_choice(self) -> None:
        """What counts: of a page that was cut off, a choice may not have arrived."""
        self._signals.update()

    def dark(self, on: bool) -> None:
        self._colours, text = (DARK_COLOURS, _DARK_TEXT) if on else (COLOURS, _TEXT)
        self._grid = {"lineStyle": {"width": 0.6, "color": _DARK_GRID if on else _GRID}}
        self._behind = _DARK_BEHIND if on else _BEHIND
        options, plain = self._chart.options, {"color": text}
        options["textStyle"], options["legend"]["textStyle"] = plain, plain
        narrow = {"type": "scroll", "pageTextStyle": plain, "pageIconColor": text, **options["legend"]}
        options["media"] = [{"query": {"maxWidth": NARROW_px}, "option": {"legend": narrow}}]
        options["xAxis"] |= {"nameTextStyle": plain, "axisLabel": {**options["xAxis"]["axisLabel"], **plain}}
        self._text, self._drawn = text, None
        self._chart.update()

    def _end_s(self) -> float:
        rows = self._history.newest(1.0)
        return round(float(self._history.seconds(rows)[-1]), 3) if len(rows) else 0.0

    def _on_until(self) -> None:
        self._held_s = None if self._until.value is None else float(self._until.value)

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

    @property
    def _between_runs(self) -> bool:
        """Whether what is here is of a run that is over, and another one may follow."""
        return self._live and self._all.settings.get("stage") != "running"

    def refresh(self) -> None:
        if self._run != self._all.runs:  # the picture that was held is gone
            self._run, self._held_s = self._all.runs, None
            self._pause.value = False
        span_s = float(self._span.value)
        rows = self._history.newest(span_s, self._held_s)
        if not len(rows):
            return
        if self._armed.value and not self._pause.value and not self._between_runs:
            self._look_for_trigger(rows, span_s)
            rows = self._history.newest(span_s, self._held_s)
        names = list(self._signals.value or [])
        ends = int(rows["time_ns"][0]), int(rows["time_ns"][-1])
        now = (*ends, names, span_s, self._view.value, self._cursor_places())
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
        view, found = self._view.value, seen(self._view.value, self._history, rows, names)
        over_time = found.x_name == TIME_NAME
        series: Mapping[str, Sequence[Sequence[float | None]]] = {
            name: self._history.series(rows, name) if over_time else found.drawn(name) for name in found.columns
        }
        self._seen, chosen, names = found, (view, names), list(series)
        units = list(dict.fromkeys(name[name.index("[") :] for name in names))
        options, plain = self._chart.options, {"color": self._text}
        options["xAxis"] |= {"name": found.x_name, **x_ends(view, found)}
        log = {"type": "log", "min": None, "max": None} if view == SPECTRUM else None
        options["yAxis"] = [
            {**_AXIS, **(log or axis_ends(unit, series)), "name": unit, "position": "left" if i == 0 else "right",
             "offset": max(0, i - 1) * 56, "axisLabel": {**plain, **(_POWERS if log else {})},
             "splitLine": self._grid, "nameTextStyle": {"fontSize": 12, **plain}}
            for i, unit in enumerate(units or [""])
        ]  # fmt: skip
        options["grid"]["right"] = 24 + 56 * max(0, len(units) - 1)
        options["series"] = [
            {"type": "line", "name": name, "showSymbol": False, "lineStyle": {"width": 1.4}, "animation": False,
             "color": self._colours[i % len(self._colours)],
             "yAxisIndex": units.index(name[name.index("[") :]), "data": series[name]}
            for i, name in enumerate(names)
        ]  # fmt: skip
        if names and (places := self._cursor_places()):
            lines = [{"xAxis": x, "label": {"formatter": "AB"[i], **plain}} for i, x in enumerate(places)]
            options["series"][0]["markLine"] = {"symbol": "none", "animation": False, "silent": True, "data": lines,
                                                "lineStyle": {"color": self._text, "width": 1}}  # fmt: skip
            self._readings.text = readings(found, *places) if len(places) == 2 else ""
        self._chart.update()
        if chosen != self._names:  # axes that are left over would stay otherwise; the zoom begins anew
            self._names = chosen
            ui.run_javascript(_ANEW.replace("ID", str(self._chart.id)))


def axis_ends(unit: str, series: Mapping[str, Sequence[Sequence[float | None]]]) -> dict[str, float | None]:
    """`min` and `max` of the axis of a unit; None where it fits itself to its signals: without it the old ones stay."""
    values = [pair[1] for name, data in series.items() if name.endswith(unit) for pair in data if pair[1] is not None]
    found = axis_range(min(values), max(values), unit) if values and unit else None
    low, high = found or (None, None)
    return {"min": low, "max": high}


def x_ends(view: str, found: Seen) -> dict[str, Any]:
    """`min` and `max` of the axis across: that of a signal has the least span of its unit as well."""
    values = found.x[np.isfinite(found.x)] if view == AGAINST else []
    if len(values):
        unit = found.x_name[found.x_name.index("[") :]
        ends = axis_range(float(np.min(values)), float(np.max(values)), unit)
        if ends is not None:
            return {"min": ends[0], "max": ends[1]}
    return {"min": "dataMin", "max": "dataMax"}


def _options() -> dict[str, Any]:
    return {
        "animation": False,
        "legend": {"top": 0},
        "grid": {"left": 56, "right": 24, "top": 52, "bottom": 74},
        "tooltip": {"trigger": "axis"},
        # beside its axis the name would take the width of a narrow picture
        "xAxis": {"type": "value", "name": TIME_NAME, "min": "dataMin", "max": "dataMax", "splitLine": {"show": False},
                  "nameLocation": "middle", "nameGap": 24,
                  "axisLine": {"onZero": False},
                  "axisLabel": {"showMinLabel": False, "showMaxLabel": False}},
        "yAxis": [dict(_AXIS)],
        "dataZoom": [{"type": "inside"}, {"type": "slider", "bottom": 8, "height": 22, "labelPrecision": 1}],
        "series": [],
    }  # fmt: skip
