"""Before the joint moves: what it is about to do, the viewer's word that the way is clear, and Start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui

Ask = Callable[[str, dict[str, Any]], None]


class StartPanel:
    """Shown while a run is being prepared from the page (`jointctl scope CONFIG`), and again after its end."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._number: int | None = None
        with ui.card().classes("w-full p-3 gap-1").props('flat bordered data-testid="start-panel"') as self._card:
            self._title = ui.label("").classes("font-bold")
            self._lines = ui.label("").style("white-space: pre-wrap; font: 13px/1.5 monospace")
            with ui.row().classes("items-center gap-6"):
                self._clear = ui.checkbox("this range is clear, and I can reach the emergency stop")
                self._clear.props('data-testid="clear"').on_value_change(self._on_tick)
                self._start = ui.button("Start", on_click=self._on_start, color="green-8")
                self._start.classes("text-lg px-8").props('no-caps data-testid="start"')
                self._prepare = ui.button("Prepare the next run", on_click=lambda: ask("prepare", {}))
                self._prepare.props('no-caps outline data-testid="prepare"')
        self._card.visible = False

    def _on_tick(self) -> None:
        self._start.enabled = bool(self._clear.value)

    def _on_start(self) -> None:
        """Only the very envelope that is shown is confirmed: its number goes along."""
        if self._clear.value and self._number is not None:
            self._ask("start", {"number": self._number, "clear": True})

    def show(self, settings: Mapping[str, Any]) -> None:
        """Follow the stage."""
        stage = settings.get("stage")
        ready = stage == "ready"
        self._card.visible = ready or stage in ("ended", "declined")
        number = settings.get("number")
        if ready and number != self._number:
            self._number = number
            self._clear.value = False
            self._start.enabled = False
        self._title.text = "The joint is about to move:" if ready else "The run is over"
        self._lines.text = "\n".join(settings.get("lines", []))
        self._clear.visible = self._start.visible = ready
        self._prepare.visible = not ready
