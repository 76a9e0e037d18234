"""The scope's page: one viewer, put together from its panels; all viewers look at the same history."""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from nicegui import ui
from nicegui.events import GenericEventArguments

from jointctl.firmware_py.states import AxisPhase
from jointctl.firmware_py.trajectory import quintic_s
from jointctl.tools.recording.run_log import Event
from jointctl.tools.scoping.chart import Chart
from jointctl.tools.scoping.feed import LATE_S, OVER, ScopeOrder
from jointctl.tools.scoping.history import History, percentiles_us
from jointctl.tools.session.display import ViewerRequest, fault_words, phase_name, viewer
from jointctl.tools.session.session_drive import drive_state_name, session_drive

HEADING = "role=heading aria-level=2"
_PREFERS_DARK = "window.matchMedia('(prefers-color-scheme: dark)').matches"

# --- STOP ---

STOP_PATH = "/stop"
ANSWER_s = 2.0
STALE_s = 3.0
NOT_TAKEN = "STOP DID NOT ARRIVE: Ctrl-C in the terminal, jointctl stop, or the emergency stop"
CUT_OFF = "NOT CONNECTED: not sent, now or later; STOP is tried all the same"
STOP_KEYS = "Escape or space, from anywhere"
STALE = "no news: what this page shows is old, and the joint may move"

_PRESSED = """window.jointctlStop = () => {
  const word = document.querySelector('[data-testid="stop-word"]')
  const tell = (text, bad) => { word.textContent = text; word.style.color = bad ? '#c62828' : 'inherit' }
  tell('…', false)
  const late = setTimeout(() => tell('NOT_TAKEN', true), ANSWER_MS)  // an answer that comes yet takes its place
  fetch('STOP_PATH', {method: 'POST'})
    .then(answer => { if (!answer.ok) throw answer.status; return answer.text() })
    .then(text => { tell(text, false); setTimeout(() => word.textContent === text && tell('', false), 8000) })
    .catch(() => tell('NOT_TAKEN', true))
    .finally(() => clearTimeout(late))
}"""

# What is pressed while the page is cut off, its library would send later, when no one expects it: it is refused.  Not
# while a new page comes up: what is pressed there (Start cannot be) is sent with its first connection.
# Escape always; space too while the joint is under control, also from a field or a focused button: nothing there needs
# it then.  A key that is held down is one press.
_WATCH = """<script>
PRESSED
const isSpace = event => event.key === ' ' || event.code === 'Space'
const byName = name => document.querySelector(`[data-testid="${name}"]`)
let wasConnected = false
const refuse = event => {
  wasConnected ||= Boolean(window.socket?.connected)
  if (!wasConnected) return
  const beat = byName('beat'), stale = byName('stale'), word = byName('stop-word')
  if (!beat || !stale || !word || beat.textContent.endsWith('OVER')) return
  if (window.socket?.connected && stale.style.display === 'none') return
  if (event.target.closest?.('[data-testid="stop"]')) return
  // a space that goes down is STOP's, below; a tick takes the one that goes up
  if (event.type !== 'click' && event.key !== 'Enter' && !(event.type === 'keyup' && isSpace(event))) return
  event.preventDefault()
  event.stopImmediatePropagation()
  if (word.textContent === 'NOT_TAKEN') return  // the more important word
  word.textContent = 'CUT_OFF'
  word.style.color = '#c62828'
  setTimeout(() => { if (word.textContent === 'CUT_OFF') word.textContent = '' }, 8000)
}
for (const kind of ['click', 'keydown', 'keyup']) document.addEventListener(kind, refuse, true)
document.addEventListener('keydown', event => {
  const beat = byName('beat')
  const moves = beat && beat.textContent.endsWith('MOVES')
  if (event.key !== 'Escape' && !(moves && isSpace(event))) return
  event.preventDefault()
  event.stopImmediatePropagation()
  if (!event.repeat) window.jointctlStop()
}, true)
document.addEventListener('keyup', event => {
  const beat = byName('beat')
  if (!isSpace(event) || !beat || !beat.textContent.endsWith('MOVES')) return
  event.preventDefault()
  event.stopImmediatePropagation()
}, true);
(() => {
  let seen = '', at = Date.now()
  setInterval(() => {
    const beat = byName('beat'), stale = byName('stale')
    wasConnected ||= Boolean(window.socket?.connected)
    if (!beat || !stale) return
    if (beat.textContent !== seen) { seen = beat.textContent; at = Date.now() }
    const late = Date.now() - at > STALE_MS && !beat.textContent.endsWith('OVER')
    stale.style.display = late ? 'block' : 'none'
  }, 500)
})()
</script>"""

IS_OVER = """document.querySelector('[data-testid="beat"]')?.textContent.endsWith('OVER') === true"""


class StopButton:
    """The button, what became of the last press, and the mark of a page without news for `STALE_s`.

    A press is a plain HTTP request of its own, so that it works when nothing else on the page does: it needs neither
    the page's web socket nor its state on the server.  That it did not arrive is shown as well.  Escape and, while
    the joint is under control, space press it from anywhere.
    """

    def __init__(self) -> None:
        pressed = _PRESSED.replace("STOP_PATH", STOP_PATH).replace("NOT_TAKEN", NOT_TAKEN)
        pressed = pressed.replace("ANSWER_MS", f"{ANSWER_s * 1e3:.0f}")
        ui.add_body_html(
            _WATCH.replace("CUT_OFF", CUT_OFF)
            .replace("PRESSED", pressed)
            .replace("NOT_TAKEN", NOT_TAKEN)
            .replace("STALE_MS", f"{STALE_s * 1e3:.0f}")
        )
        with ui.column().classes("items-end gap-1 shrink-0"):
            button = ui.button("STOP", color="red-8").on("click", js_handler="() => window.jointctlStop()")
            button.classes("text-3xl font-bold px-14 py-3")
            button.props(f'data-testid="stop" aria-keyshortcuts="Escape Space" title="{STOP_KEYS}"')
            word = ui.label("").classes("text-sm font-bold").props('data-testid="stop-word" role=alert')
            word.style("max-width: 420px; text-align: right")
        self._beat: Any = ui.label("").style("display: none").props('data-testid="beat"')

    def beat(self, number: int, word: str) -> None:
        """A sign of life, at least once a second; `MOVES` while the joint is under control, `OVER`: the last one."""
        self._beat.text = f"{number} {word}"


def stale_mark() -> None:
    """Where the page says that what it shows is old."""
    label = ui.label(STALE).props('data-testid="stale" role=alert')
    label.style("display: none; color: white; background: #c62828; padding: 2px 8px; font-weight: 600")


# --- before the joint moves ---

ENDED = "jointctl has ended"
Ask = Callable[[str, dict[str, Any]], None]
# what the browser knew when it was pressed, not the server when the press came
_SEEN = """() => emit(document.querySelector('[data-testid="told-at"]').textContent)"""


def _number_in(text: object) -> float:
    """Of what a browser sent; without one -inf, long ago."""
    try:
        return float(str(text))
    except ValueError:
        return -math.inf


class StartPanel:
    """What the joint is about to do, the viewer's word that the way is clear, and Start.

    Shown while a run is being prepared from the page (`jointctl scope CONFIG`), and again after its end.
    """

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._number: int | None = None
        with ui.card().classes("w-full p-3 gap-1").props('flat bordered data-testid="start-panel"') as self._card:
            self._title = ui.label("").classes("font-bold").props(HEADING)
            self._lines = ui.label("").style("white-space: pre-wrap; font: 13px/1.5 monospace")
            with ui.row().classes("items-center gap-6"):
                self._clear = ui.checkbox("this range is clear, and I can reach the emergency stop")
                self._clear.props('data-testid="clear"').on_value_change(self._on_tick)
                self._start = ui.button("Start", color="green-9").on("click", self._on_start, js_handler=_SEEN)
                self._start.classes("text-lg px-8").props('no-caps data-testid="start"')
                self._prepare = ui.button("Prepare the next run", on_click=lambda: ask("prepare", {}), color=None)
                self._prepare.props('no-caps outline data-testid="prepare"')
            self._late = ui.label("").style("color: #c62828; font-weight: 600").props('data-testid="late" role=alert')
            self._at: Any = ui.label("").style("display: none").props('data-testid="told-at"')
        self._card.visible = False

    def _on_tick(self) -> None:
        self._start.enabled = bool(self._clear.value)

    def _on_start(self, event: GenericEventArguments) -> None:
        """Only the very envelope that is shown is confirmed: its number goes along, and when the browser had it."""
        if self._clear.value and self._number is not None:
            self._ask("start", {"number": self._number, "clear": True, "told_s": _number_in(event.args)})

    def show(self, settings: Mapping[str, Any]) -> None:
        """Follow the stage."""
        stage = settings.get("stage")
        ready = stage == "ready"
        over = stage == OVER and bool(settings.get("lines"))
        self._card.visible = ready or over or stage in ("ended", "declined")
        number = settings.get("number")
        self._late.text = str(settings.get("late", "")) if ready else ""
        self._at.text = str(settings.get("told_s", ""))
        if ready and number != self._number:
            self._number = number
            self._clear.value = False
            self._start.enabled = False
        self._title.text = "The joint is about to move:" if ready else ENDED if over else "The run is over"
        self._lines.text = "\n".join(settings.get("lines", []))
        self._clear.visible = self._start.visible = ready
        self._prepare.visible = not (ready or over)


# --- what may be changed while it moves: set-point, trajectory, gains; and the recording ---

KINDS = ("configured", "sine", "min_jerk", "trapezoid")
SPEED_SHARE = 0.25  # of limits.velocity_max_radps, at most, of a motion that is offered


def offered(kind: str, settings: Mapping[str, Any]) -> dict[str, float]:
    """Values of a motion by key, small and slow for the joint, about zero or, if that is outside, its middle."""
    if not settings:
        return {}
    low, high = settings["range"]
    size = min(0.1, 0.15 * (high - low))
    middle = 0.0 if low + size <= 0.0 <= high - size else 0.5 * (low + high)
    speed, brake = SPEED_SHARE * settings["velocity_max_radps"], 0.5 * settings["brake_radps2"]
    quickest_radps = min(speed / size, math.sqrt(brake / size))  # of the sine
    move_s = max(2.0, quintic_s(size, speed, brake))
    move = {"start_rad": middle, "target_rad": middle + size}
    values = {
        "sine": {"amplitude_rad": size, "frequency_Hz": min(0.2, quickest_radps / math.tau), "offset_rad": middle},
        "min_jerk": {**move, "move_s": move_s, "dwell_s": 0.5},
        "trapezoid": {
            **move, "speed_radps": min(0.1, speed), "acceleration_radps2": min(0.5, brake), "dwell_s": 0.5,
        },
    }  # fmt: skip
    return {key: float(f"{value:.4g}") for key, value in values.get(kind, {}).items()}


ENDLESS = "a set-point, sine, move or trapezoid goes on until it is stopped; the configured motion ends by itself"
UNITS = {"kp": "kp [1/s2]", "kv": "kv [1/s]", "ki": "ki [1/s3]", "observer_radps": "observer [rad/s]",
         "learning_rate": "learning rate"}  # fmt: skip


class Followed:
    """A field that shows what is in force until a viewer types into it, and again once that is in force.

    It follows nothing while it has the focus: a new value between two keys would undo what is being typed.
    """

    def __init__(self, field: ui.number, digits: str) -> None:
        self.field, self._digits = field, digits
        self._shown: float | None = _number(field)
        self.has_focus = False

    def watch_focus(self) -> Followed:
        """The same; from now on the browser reports when the field gets and loses the focus."""
        self.field.on("focus", lambda: setattr(self, "has_focus", True), [])
        self.field.on("blur", lambda: setattr(self, "has_focus", False), [])
        return self

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
        if self.has_focus:
            return
        if self.typed and not self._same(_number(self.field), now):
            return
        if not self._same(_number(self.field), now):
            self.field.value = now
        self._shown = now


class ChangePanels:
    """The right-hand side of the page; nothing here is more than a wish: the supervisor checks each.

    What it refuses is shown at the field that it is about, until something else is typed there.
    """

    def __init__(self, ask: Ask, who: str) -> None:
        self._pass_on, self._who = ask, who
        self._asked = ""  # the kind of the last request from here
        self._limits: Mapping[str, Any] = {}  # of the joint, among the settings that were shown last
        self._refusals: int | None = None  # seen so far; None: what was before this page was opened is not known
        self._gains: dict[str, Followed] = {}
        self._given: dict[str, Any] = {}
        self._recording = False
        with ui.column().classes("w-64 shrink-0 gap-2") as self._column:
            with _card("Set-point"), ui.row().classes("w-full no-wrap items-end gap-2"):
                self._set_point = ui.number("angle [rad]", value=0.0, step=0.01, format="%.4f")
                self._set_point.classes("grow").props('dense data-testid="set-point"')
                self._angle = Followed(self._set_point, ".4f").watch_focus()
                _button("Go", self._go, "go")
            with _card("Trajectory"):
                kinds = {kind: kind.replace("_", " ") for kind in KINDS}
                self._kind = ui.select(kinds, value="configured", on_change=self._on_kind).classes("w-full")
                self._kind.props('dense options-dense data-testid="kind"')
                self._fields = ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0")
                _button("Apply trajectory", self._follow, "follow")
            ui.label(ENDLESS).classes("text-xs scope-aside")
            with _card("Gains") as self._gains_card:
                self._gain_rows = ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0")
                _button("Apply", self._apply, "apply")
            self._record = _button("Record", self._on_record, "record").classes("w-full")
            self._recorded = ui.label("the run log always records everything").classes("text-xs scope-aside")

    def _ask(self, kind: str, values: dict[str, Any]) -> None:
        self._asked = kind
        self._pass_on(kind, values)

    def _go(self) -> None:
        self._ask("set_point", {"position_rad": _number(self._set_point)})

    def _on_kind(self) -> None:
        self._given = {}
        self._fields.clear()
        with self._fields:
            for key, value in offered(self._kind.value, self._limits).items():
                what, unit = key.replace("dwell", "rest").rsplit("_", 1)
                field = ui.number(f"{what} [{unit.replace('radps', 'rad/s')}]", value=value, format="%.4g")
                self._given[key] = field.props(f'dense data-testid="{key}"')

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
        """What may be changed, as the supervisor tells: no gains where they are the drive's.  What is typed stays."""
        gains: Mapping[str, Any] = settings.get("gains", {})
        self._column.visible = settings.get("stage") == "running" and "range" in settings
        self._gains_card.visible = bool(gains)
        if self._column.visible:
            self._limits = settings
            low, high = settings["range"]
            self._set_point.props(f"step={min(0.01, (high - low) / 50.0):.1g}")
        if not self._column.visible:
            self._forget_refusals()
        if set(gains) != set(self._gains):
            self._gain_rows.clear()
            self._gains = {}
            with self._gain_rows:
                for name, (low, now, high) in gains.items():
                    field = ui.number(UNITS.get(name, name), value=now, min=low, max=high, format="%.5g")
                    field.props(f'dense data-testid="gain-{name}"')
                    self._gains[name] = Followed(field, ".5g").watch_focus()
        for name, (low, now, high) in gains.items():
            self._gains[name].follow(now)
            self._gains[name].field.props(f'hint="now {now:.5g}, {low:.4g} to {high:.4g}"')
        if "reference_rad" in settings:
            self._angle.follow(float(settings["reference_rad"]))
        self._show_refusal(settings.get("refused"))
        self._recording = bool(settings.get("recording"))
        self._record.text = "Stop recording" if self._recording else "Record"
        self._recorded.text = str(settings.get("recording") or "the run log always records everything")

    def _show_refusal(self, refused: Mapping[str, Any] | None) -> None:
        """At the fields that it names, or at all of that request."""
        count = 0 if refused is None else int(refused["count"])
        new, self._refusals = self._refusals is not None and count > self._refusals, count
        if refused is None or not new or refused["who"] != self._who or refused["kind"] != self._asked:
            return
        for field in refused_fields(str(refused["text"]), self._fields_of(self._asked)):
            field.error = str(refused["text"])

    def _forget_refusals(self) -> None:
        """The run that they are about has ended."""
        for kind in ("set_point", "trajectory", "gains"):
            for field in self._fields_of(kind).values():
                field.error = None

    def _fields_of(self, kind: str) -> dict[str, Any]:
        if kind == "set_point":
            return {"position_rad": self._set_point}
        if kind == "trajectory":
            return self._given or {"kind": self._kind}
        typed = {name: gain.field for name, gain in self._gains.items() if gain.typed}
        return typed or {name: gain.field for name, gain in self._gains.items()}


def refused_fields(text: str, fields: Mapping[str, Any]) -> list[Any]:
    """Those whose key the refusal names; where it names none, all."""
    return [field for name, field in fields.items() if re.search(rf"\b{name}\b", text)] or list(fields.values())


def _number(field: ui.number) -> float | None:
    return None if field.value is None else float(field.value)


def _card(title: str) -> Any:
    card = ui.card().classes("w-full p-3 gap-1").props("flat bordered")
    with card:
        ui.label(title).classes("font-bold leading-tight").props(HEADING)
    return card


def _button(text: str, action: Callable[[], None], name: str) -> Any:
    return (
        ui.button(text, on_click=action, color=None)
        .props(f'no-caps dense outline data-testid="{name}"')
        .classes("px-4")
    )


# --- the page ---

REFRESH_s = 0.1
IDLE_SHARE = 3.0  # drawing leaves at least so many times its own duration to everything else, STOP above all
SLOW = 5  # every so many refreshes the texts are renewed
STATISTICS_s = 10.0
SHOWN_EVENTS = 8
SILENT_s = {
    "running": 2.0,  # something is told 50 times a second
    "ready": LATE_S,  # once a second
}
CSS = (
    ".q-field__label{font-size:13px} body{font-size:14px} .nicegui-content{padding:0 14px 10px; gap:8px}"
    " .scope-head{position:sticky; top:0; z-index:10; background:#fff; padding:10px 0 4px}"
    " .body--dark .scope-head{background:#121212} .scope-aside{color:#5f5f5f} .body--dark .scope-aside{color:#b0b0b0}"
    # what is refused takes as many lines as it needs, below its field
    " .q-field--with-bottom{padding-bottom:0} .q-field__bottom--animated{position:static; transform:none}"
    " .body--dark .q-field--error{--q-negative:#ff8a80}"
    " .scope-bad{color:#c62828; font-weight:600} .body--dark .scope-bad{color:#ff8a80}"
    " :focus-visible{outline:3px solid #1f5fa8; outline-offset:2px} .body--dark :focus-visible{outline-color:#6fa8e8}"
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
        self._ticks, self._told_end = 0, False
        self._draw_again_s = 0.0
        client: Any = ui.context.client
        self._who = viewer(getattr(client, "ip", None))
        self._dark, self._dark_chosen = ui.dark_mode(False), False
        client.on_connect(self._on_connect)
        ui.colors(primary="#1f5fa8")
        ui.add_css(CSS)
        self._build()
        self._tell()
        ui.timer(REFRESH_s, self._refresh)

    def _build(self) -> None:
        self._stop: StopButton | None = None
        with ui.row().classes("w-full items-start no-wrap gap-4 scope-head"):
            with ui.column().classes("gap-0 grow min-w-0"):
                ui.label(self._order.title).classes("text-xl font-bold leading-tight").props(
                    "role=heading aria-level=1"
                )
                self._state = ui.label("waiting for the run").classes("text-base")
                self._state.props('data-testid="state" role=status')
                stale_mark()
            if self._link is not None:
                self._stop = StopButton()
        self._start = StartPanel(self._ask) if self._link is not None else None
        with ui.row().classes("w-full no-wrap items-start gap-4 scope-body").props("role=main"):
            with ui.column().classes("grow min-w-0 gap-2"):
                self._chart = Chart(self._history, live=self._link is not None)
                with ui.row().classes("w-full no-wrap gap-10 items-start scope-body"):
                    self._deadlines = _text_block(f"Deadlines, last {STATISTICS_s:g} s", "deadlines")
                    self._events = _text_block("Events", "events")
            if self._link is not None and len(self._history.joints) == 1:  # an arm's gains and motion are not changed
                self._changes: ChangePanels | None = ChangePanels(self._ask, self._who)
            else:
                self._changes = None
        self._dark_switch = ui.switch("dark", on_change=self._on_dark).props('dense data-testid="dark"')

    async def _on_connect(self) -> None:
        """Or was cut off for a moment.  Dark where the viewer's system is, until the switch is used."""
        self._chart.resend_choice()
        with contextlib.suppress(TimeoutError):
            prefers_dark = bool(await ui.run_javascript(_PREFERS_DARK))
            if not self._dark_chosen:
                self._dark_switch.value = prefers_dark

    def _on_dark(self) -> None:
        self._dark_chosen = True
        self._dark.value = bool(self._dark_switch.value)
        self._chart.dark(self._dark.value)

    def _ask(self, kind: str, values: dict[str, Any]) -> None:
        if self._link is not None and not self._link.ask(ViewerRequest(kind, self._who, values)):
            ui.notify("not taken: jointctl does not listen", type="negative", position="top")

    def _refresh(self) -> None:
        self._ticks += 1
        ended = self._history.ended and not self._told_end  # soon nobody can show it any more
        if ended or self._ticks % SLOW == 1:
            self._told_end = self._history.ended
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
            stage = self._history.settings.get("stage")
            moves = stage == "running" and not self._history.ended
            self._stop.beat(self._ticks, "MOVES" if moves else "OVER" if stage == OVER else "")
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
        if stage == OVER:
            words.append(ENDED)
        silent_s = time.monotonic() - self._history.heard_s
        silent = silent_s > SILENT_s.get(stage, math.inf)
        if silent and not self._history.ended:
            words.append(f"NO NEWS FROM jointctl for {silent_s:.0f} s")
        self._state.text = " · ".join(words) or "waiting for the run"
        bad = silent or (fault and stage not in STAGES)
        self._state.classes(add="scope-bad" if bad else "", remove="" if bad else "scope-bad")
        if len(rows):
            lines = [f"{name:13}{text}" for name, text in percentiles_us(rows).items()]
            lines.append(f"{'skipped':13}{self._history.skipped} cycles since the start")
            self._deadlines.text = "\n".join([f"{'':13}p50 / p99 / max", *lines])

    def _line(self, event: Event) -> str:
        return f"{max(0.0, self._history.second(event.time_ns)):7.1f} s  {event.source}: {event.text}"

    def _words(self, rows: np.ndarray, stage: str) -> list[str]:
        last = rows[-1]
        drive = drive_state_name(session_drive(self._order.drive), int(last["status_word"]), int(last["drive_state"]))
        ended = self._history.ended or stage in ("ended", OVER)
        # where the last records have not come, they would show an enabled drive
        known = not ended or int(last["phase"]) == AxisPhase.FINISHED or self._link is None
        words = [phase_name(int(last["phase"])), f"drive: {drive}"] if known else []
        temperature_degC = self._history.settings.get("temperature_degC")
        if temperature_degC is not None and not ended:
            words.append(f"{temperature_degC:.1f} °C")
        fault = int(last["fault"])
        if fault:
            words.append(f"FAULT: {fault_words(fault)}")
        if ended:
            words.append("the run has ended")
        elif motion := self._history.settings.get("motion"):
            words.append(str(motion))
        return words


def _text_block(title: str, name: str) -> Any:
    with ui.column().classes("gap-0 min-w-0" if name == "events" else "gap-0 shrink-0"):
        ui.label(title).classes("font-bold").props(HEADING)
        label = ui.label("-").style("white-space: pre-wrap; font: 12px/1.45 monospace")
        label.style("" if name == "events" else "white-space: pre")
        return label.props(f'data-testid="{name}"' + (" role=log" if name == "events" else ""))


def build_page(order: ScopeOrder, history: History, link: Link | None) -> None:
    """The page of one viewer."""
    ScopePage(order, history, link)
