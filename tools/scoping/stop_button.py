"""The page's STOP: a plain HTTP request of its own, so that it works when nothing else on the page does.

It needs neither the page's web socket nor its state on the server.  What became of it is told beside the button, and
that it did not arrive as well.  A page that has had no news for `STALE_s` says that what it shows is old.
"""

from __future__ import annotations

from typing import Any

from nicegui import ui

STOP_PATH = "/stop"
ANSWER_s = 2.0
STALE_s = 3.0
NOT_TAKEN = "STOP DID NOT ARRIVE: Ctrl-C in the terminal, jointctl stop, or the emergency stop"
STALE = "no news: what this page shows is old, and the joint may move"

_PRESSED = """() => {
  const word = document.querySelector('[data-testid="stop-word"]')
  const tell = (text, bad) => { word.textContent = text; word.style.color = bad ? '#c62828' : 'inherit' }
  tell('…', false)
  fetch('STOP_PATH', {method: 'POST', signal: AbortSignal.timeout(ANSWER_MS)})
    .then(answer => { if (!answer.ok) throw answer.status; return answer.text() })
    .then(text => { tell(text, false); setTimeout(() => word.textContent === text && tell('', false), 8000) })
    .catch(() => tell('NOT_TAKEN', true))
}"""

_WATCH = """<script>
(() => {
  let seen = '', at = Date.now()
  setInterval(() => {
    const beat = document.querySelector('[data-testid="beat"]'), stale = document.querySelector('[data-testid="stale"]')
    if (!beat || !stale) return
    if (beat.textContent !== seen) { seen = beat.textContent; at = Date.now() }
    stale.style.display = Date.now() - at > STALE_MS ? 'block' : 'none'
  }, 500)
})()
</script>"""


class StopButton:
    """The button, what became of the last press, and the mark of a page without news."""

    def __init__(self) -> None:
        ui.add_body_html(_WATCH.replace("STALE_MS", f"{STALE_s * 1e3:.0f}"))
        pressed = _PRESSED.replace("STOP_PATH", STOP_PATH).replace("NOT_TAKEN", NOT_TAKEN)
        pressed = pressed.replace("ANSWER_MS", f"{ANSWER_s * 1e3:.0f}")
        with ui.column().classes("items-end gap-1 shrink-0"):
            button = ui.button("STOP", color="red-8").on("click", js_handler=pressed)
            button.classes("text-3xl font-bold px-14 py-3").props('data-testid="stop"')
            _told("stop-word")
        self._beat: Any = ui.label("").style("display: none").props('data-testid="beat"')

    def beat(self, number: int) -> None:
        """A sign of life, at least once a second."""
        self._beat.text = str(number)


def stale_mark() -> None:
    """Where the page says that what it shows is old."""
    label = ui.label(STALE).props('data-testid="stale"')
    label.style("display: none; color: white; background: #c62828; padding: 2px 8px; font-weight: 600")


def _told(name: str) -> None:
    ui.label("").classes("text-sm font-bold").style("max-width: 420px; text-align: right").props(
        f'data-testid="{name}"'
    )
