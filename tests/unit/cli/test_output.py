"""What reaches a terminal, however narrow."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from jointctl.tools.narrow_table import width_of
from jointctl.tools.output import Output
from jointctl.tools.verbs.info import info_table

NUMBERS = ["0.0949 .. 0.358", "0.00788 .. 0.0162", "0.00762 .. 0.00944"]
PATH = "runs/a_joint_with_a_long_name-20260101-120000.mcap"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown_at(columns: int, table: RenderableType, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The lines in a terminal of that width, which none of them exceeds; without colours."""
    monkeypatch.setenv("COLUMNS", str(columns))
    out = Terminal()
    Output(stdout=out, stderr=io.StringIO()).result(table)
    lines = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).splitlines()
    assert max(len(line) for line in lines) <= columns
    return [line.rstrip() for line in lines]


def wide() -> Table:
    table = Table("file", "peak", "RMSE [mrad]", "true RMSE", title="T", caption="C")
    table.add_row(PATH, *NUMBERS)
    table.add_row("[bold]two[/]", "1", "", Text("[2]", "red"))
    return table


def test_a_wide_terminal_shows_the_table_and_a_narrow_one_a_list_of_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = width_of(wide())
    assert needed == len(PATH) + len("0.0949") + len("0.00788") + len("0.00762") + 4 * 3 + 1
    assert any(line.startswith("│") for line in shown_at(needed, wide(), monkeypatch))
    assert shown_at(needed - 1, wide(), monkeypatch) == [
        "T", PATH, f"  peak {NUMBERS[0]}, RMSE [mrad] {NUMBERS[1]}", f"  true RMSE {NUMBERS[2]}",
        "[bold]two[/]", "  peak 1, true RMSE [2]", "C",
    ]  # fmt: skip


def test_a_long_word_is_whole_as_long_as_there_is_room_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table("quantity", "value", "note")
    table.add_row("phase margin", "24.2 deg at so many hertz and more", "at least 15 (margin.min_phase_margin_deg)")
    table.add_row("P", "12680.357  1.147959  16.091928", "P11 P12 P22")
    shown = "\n".join(shown_at(60, table, monkeypatch))
    for word in ("(margin.min_phase_margin_deg)", "12680.357", "quantity"):
        assert word in shown


def test_a_table_of_names_and_values_and_one_in_a_group_lose_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table("name", "value")
    table.add_row("log", PATH)
    lines = shown_at(40, Group(table, "after"), monkeypatch)
    cells = [line.split("│")[2] for line in lines if line.startswith("│")]
    assert "".join(cell.strip() for cell in cells) == PATH
    assert lines[-1] == "after"


def test_a_pipe_is_as_wide_as_the_table_needs() -> None:
    table = Table(*"abcdefgh")
    table.add_row(*["0.123456789012345678901"] * 8)
    out = io.StringIO()
    Output(stdout=out).result(Group(table))
    assert out.getvalue().count("0.123456789012345678901") == 8


def test_what_a_terminal_wraps_of_a_fact_goes_below_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    text = "motion     -0.477 .. +0.650 rad, back and forth, about 7 min"
    terminal, pipe = Terminal(), io.StringIO()
    Output(stdout=io.StringIO(), stderr=terminal).fact(text)
    Output(stdout=io.StringIO(), stderr=pipe).fact(text)
    assert terminal.getvalue().splitlines() == [
        "motion     -0.477 .. +0.650 rad, back", "           and forth, about 7 min",
    ]  # fmt: skip
    terminal.truncate(terminal.seek(0))
    Output(stdout=io.StringIO(), stderr=terminal).fact("trajectory sine, 0.2200 rad/s, about 11 s long")
    assert terminal.getvalue().splitlines() == ["trajectory sine, 0.2200 rad/s, about", "           11 s long"]
    assert pipe.getvalue() == text + "\n"  # a line of a file is not broken


def test_a_long_name_of_an_object_does_not_squeeze_what_info_tells_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    words = "profile position, profile velocity"
    found = {
        "limits": {"607D:1 Software position limit, Min position limit": -5},
        "state": {"supported": words},
        "pdos": {"TPDO1": "6041 Statusword (16 bit); 6064 Position actual value (32 bit); 6077 Torque actual value"},
    }
    lines = shown_at(80, info_table(found), monkeypatch)
    assert any(words in line for line in lines)
    assert len(lines) <= 9


@pytest.mark.parametrize("path", ["runs/[old]/a.mcap", "runs/[/old]/a.mcap", "runs/:warning:.mcap"])
def test_what_rich_would_take_for_markup_is_shown_as_it_is(path: str) -> None:
    table = Table("log", title=path)
    table.add_row(path)
    out, err = io.StringIO(), io.StringIO()
    output = Output(stdout=out, stderr=err)
    output.result(path)
    output.result(table)
    output.note(table)
    output.note(path)
    assert out.getvalue().startswith(path)
    assert out.getvalue().count(path) == 3
    assert err.getvalue().count(path) == 3
