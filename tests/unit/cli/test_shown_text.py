"""Nothing that comes from a file, a name or a device is obeyed by a terminal, a page or a reader of JSON."""

from __future__ import annotations

import io
import json
import tomllib
from typing import Any

import pytest
from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import INFO, Event
from jointctl.tools.reporting.page import Details, Paragraph, Section, draw, page
from jointctl.tools.reporting.page import Table as PageTable
from jointctl.tools.scoping.history import History
from jointctl.tools.session.live_panel import LivePanel

EVIL = "a\x1b]0;owned\x07\x1b[2J\x9b31m\u202eb\rc\x7f[red]x[/]<script>alert(1)</script>"
OBEYED = "\x1b\x07\x9b\u202e\r\x7f"


def said(*, json_wanted: bool = False, terminal: bool = False) -> tuple[Output, io.StringIO, io.StringIO]:
    class Stream(io.StringIO):
        def isatty(self) -> bool:
            return terminal

    out, err = Stream(), Stream()
    return Output(json=json_wanted, stdout=out, stderr=err), out, err


def assert_shown(text: str, times: int) -> None:
    assert not any(c in text for c in OBEYED), ascii(text)
    assert text.count("[red]x[/]") == times
    assert text.count("\\u001b[2J") == times


def test_every_kind_of_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    output, _, err = said()
    output.note(EVIL)
    output.fact(EVIL)
    output.warning(EVIL)
    output.error(EVIL, EVIL)
    output.error(f"{EVIL}\n{EVIL}")
    output.address(EVIL)
    assert_shown(err.getvalue(), 8)
    assert len(err.getvalue().splitlines()) == 8


def test_a_name_makes_no_second_line() -> None:
    output, _, err = said()
    output.note("evil\nerror: all is well")
    assert err.getvalue() == "evil\\nerror: all is well\n"


def test_every_kind_of_result() -> None:
    def table() -> Table:
        made = Table(EVIL, "name", title=EVIL, caption=EVIL)
        made.add_row(EVIL, Text(EVIL, "red"))
        return made

    for shown, times in (
        (EVIL, 1), (Text(EVIL), 1), (table(), 5), (Group(table(), EVIL, Text(EVIL), Padding(EVIL, 1)), 8),
    ):  # fmt: skip
        output, out, _ = said()
        output.result(shown)
        assert_shown(out.getvalue(), times)
    output, out, _ = said()
    output.line(f"{EVIL}\n{EVIL}")
    assert_shown(out.getvalue(), 2)


def test_a_table_that_a_narrow_terminal_shows_as_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")
    made = Table("first", "second", "third")
    made.add_row("\x1b[2Jlong" * 6, "a\nb", "\x9bc")
    output, out, _ = said(terminal=True)
    output.result(made)
    assert "\x1b[2J" not in out.getvalue()
    assert "\x9b" not in out.getvalue()


def test_json_stays_json_and_toml_stays_toml() -> None:
    output, out, _ = said(json_wanted=True)
    output.result("", {EVIL: [EVIL, 1.0]})
    assert not any(c in out.getvalue() for c in OBEYED)
    assert json.loads(out.getvalue()) == {EVIL: [EVIL, 1.0]}
    output, out, _ = said()
    output.line('key = "a\u202e\x7fb"')
    assert tomllib.loads(out.getvalue()) == {"key": "a\u202e\x7fb"}


def test_a_report_page() -> None:
    def paint(figure: Any) -> None:
        axes = figure.add_subplot()
        axes.set_title(EVIL)

    blocks = [
        Paragraph(EVIL),
        PageTable([EVIL], [[EVIL]], EVIL),
        Details(EVIL, "first\n\tsecond"),
        draw(1.0, paint, ""),
    ]
    text = page(EVIL, [Section(EVIL, blocks)], subtitle=EVIL)
    assert_shown(text, text.count("[red]x[/]"))
    assert text.count("[red]x[/]") >= 8
    assert "<script>alert" not in text
    assert "first\n\tsecond" in text


def test_a_name_with_dollar_signs_is_drawn() -> None:
    draw(1.0, lambda figure: figure.suptitle(r"$\frac{ and a$b"), "")


def test_the_scope_and_the_live_panel() -> None:
    history = History()
    history.take_event(Event(0, INFO, EVIL, EVIL))
    history.take_settings({"lines": [EVIL], "motion": EVIL, "gains": {EVIL: [0.0, 1.0, 2.0]}, "number": 3})
    event = history.events[0]
    shown = (event.source, event.text, history.settings["lines"][0], *history.settings["gains"])
    assert_shown(" ".join((*shown, history.settings["motion"])), 5)
    assert history.settings["number"] == 3

    panel = LivePanel(2, "[/nothing]\x1b[2J")
    panel.note(EVIL)
    panel._console.file = drawn = io.StringIO()
    panel._console.print(panel._panel())
    assert "[/nothing]\\u001b[2J" in drawn.getvalue()
    assert not any(c in drawn.getvalue() for c in "\x07\x9b\u202e\r")
