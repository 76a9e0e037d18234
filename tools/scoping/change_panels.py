"""What may be changed while the joint moves: set-point, trajectory, gains; and the recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui

Ask = Callable[[str, dict[str, Any]], None]
# kind -> key -> (label, first value)
FIELDS: dict[str, dict[str, tuple[str, float]]] = {
    "configured": {},
    "sine": {
        "amplitude_rad": ("amplitude [rad]", 0.1), "frequency_Hz": ("frequency [Hz]", 0.2),
        "offset_rad": ("offset [rad]", 0.0),
    },
    "min_jerk": {
        "start_rad": ("start [rad]", 0.0), "target_rad": ("target [rad]", 0.1), "move_s": ("move [s]", 2.0),
        "dwell_s": ("rest [s]", 0.5),
    },
    "trapezoid": {
        "start_rad": ("start [rad]", 0.0), "target_rad": ("target [rad]", 0.1), "speed_radps": ("speed [rad/s]", 0.1),
        "acceleration_radps2": ("acceleration [rad/s2]", 0.5), "dwell_s": ("rest [s]", 0.5),
    },
}  # fmt: skip
ENDLESS = "a set-point, sine, move or trapezoid goes on until it is stopped; the configured motion ends by itself"
UNITS = {"kp": "kp [1/s2]", "kv": "kv [1/s]", "ki": "ki [1/s3]", "observer_radps": "observer [rad/s]",
         "learning_rate": "learning rate"}  # fmt: skip


class Followed:
    """A field that shows what is in force until a viewer types into it, and again once that is in force."""

    def __init__(self, field: Any, digits: str) -> None:
        self.field, self._digits = field, digits
        self._shown: float | None = _number(field)

    def _same(self, value: float | None, other: float | None) -> bool:
        """As far as the field shows them: a browser gives back what it shows."""
        if value is None or other is None:
            return value is other
        return format(value, self._digits) == format(other, self._digits)

    @property
    def typed(self) -> bool:
        """Whether it holds something of the viewer's own."""
        return not self._same(_number(self.field), self._shown)

    def follow(self, now: float) -> None:
        """`now` is in force."""
        if self.typed and not self._same(_number(self.field), now):
            return
        if not self._same(_number(self.field), now):
            self.field.value = now
        self._shown = now


class ChangePanels:
    """The right-hand side of the page; nothing here is more than a wish: the supervisor checks each."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._gains: dict[str, Followed] = {}
        self._given: dict[str, Any] = {}
        self._recording = False
        with ui.column().classes("w-64 shrink-0 gap-2") as self._column:
            with _card("Set-point"), ui.row().classes("w-full no-wrap items-end gap-2"):
                self._set_point = ui.number("angle [rad]", value=0.0, step=0.01, format="%.4f")
                self._set_point.classes("grow").props('dense data-testid="set-point"')
                self._angle = Followed(self._set_point, ".4f")
                _button("Go", self._go, "go")
            with _card("Trajectory"):
                kinds = {kind: kind.replace("_", " ") for kind in FIELDS}
                self._kind = ui.select(kinds, value="configured", on_change=self._on_kind).classes("w-full")
                self._kind.props('dense options-dense data-testid="kind"')
                self._fields = ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0")
                _button("Follow it", self._follow, "follow")
            ui.label(ENDLESS).classes("text-xs text-grey-7")
            with _card("Gains"):
                self._gain_rows = ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0")
                _button("Apply", self._apply, "apply")
            self._record = _button("Record", self._on_record, "record").classes("w-full")
            self._recorded = ui.label("the run log has everything in any case").classes("text-xs text-grey-7")

    def _go(self) -> None:
        self._ask("set_point", {"position_rad": _number(self._set_point)})

    def _on_kind(self) -> None:
        self._given = {}
        self._fields.clear()
        with self._fields:
            for key, (label, value) in FIELDS[self._kind.value].items():
                self._given[key] = ui.number(label, value=value, format="%.4g").props(f'dense data-testid="{key}"')

    def _follow(self) -> None:
        kind = self._kind.value
        values: dict[str, Any] = {"kind": kind}
        if kind != "configured":
            values |= {"duration_s": 0.0, **{key: _number(field) for key, field in self._given.items()}}
        if kind in ("min_jerk", "trapezoid"):
            values["repeat"] = True
        self._ask("trajectory", values)

    def _apply(self) -> None:
        """Only what was typed: the other gains may be another viewer's by now."""
        typed = {name: _number(gain.field) for name, gain in self._gains.items() if gain.typed}
        if typed:
            self._ask("gains", typed)

    def _on_record(self) -> None:
        self._ask("record", {"on": not self._recording})

    def show(self, settings: Mapping[str, Any]) -> None:
        """Gains appear when the supervisor tells them; what the viewer has typed stays."""
        gains: Mapping[str, Any] = settings.get("gains", {})
        self._column.visible = settings.get("stage") == "running" and bool(gains)
        if set(gains) != set(self._gains):
            self._gain_rows.clear()
            self._gains = {}
            with self._gain_rows:
                for name, (low, now, high) in gains.items():
                    field = ui.number(UNITS.get(name, name), value=now, min=low, max=high, format="%.5g")
                    self._gains[name] = Followed(field.props(f'dense data-testid="gain-{name}"'), ".5g")
        for name, (low, now, high) in gains.items():
            self._gains[name].follow(now)
            self._gains[name].field.props(f'hint="now {now:.5g}, {low:.4g} to {high:.4g}"')
        if "reference_rad" in settings:
            self._angle.follow(float(settings["reference_rad"]))
        self._recording = bool(settings.get("recording"))
        self._record.text = "Stop recording" if self._recording else "Record"
        self._recorded.text = str(settings.get("recording") or "the run log has everything in any case")


def _number(field: Any) -> float | None:
    return None if field.value is None else float(field.value)


def _card(title: str) -> Any:
    card = ui.card().classes("w-full p-3 gap-1").props("flat bordered")
    with card:
        ui.label(title).classes("font-bold leading-tight")
    return card


def _button(text: str, action: Callable[[], None], name: str) -> Any:
    return ui.button(text, on_click=action).props(f'no-caps dense outline data-testid="{name}"').classes("px-4")
