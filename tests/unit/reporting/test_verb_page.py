"""Tables of the terminal on a page: the same words, without styles."""

from __future__ import annotations

import io
from pathlib import Path

from rich.table import Table
from rich.text import Text

from jointctl.tools.output import Output
from jointctl.tools.reporting.page import Section, from_terminal, remarks, write_verb_page


def test_a_table_of_the_terminal_keeps_its_words() -> None:
    table = Table(title="errors [mrad]", caption="after 5 s")
    table.add_column("name")
    table.add_column("peak [mrad]", justify="right")
    table.add_row(Text.assemble("a ", ("red", "red"), " one"), "1.5", style="red")
    table.add_section()
    table.add_row("[b]", Text("<2>"))
    found = from_terminal(table)
    assert list(found.headings) == ["name", "peak [mrad]"]
    assert [tuple(row) for row in found.rows] == [("a red one", "1.5"), ("[b]", "<2>")]
    assert found.caption == "errors [mrad]. after 5 s"


def test_a_table_without_rows_or_header_is_one_as_well() -> None:
    table = Table(show_header=False)
    table.add_column("hidden")
    assert list(from_terminal(table).headings) == [""]
    assert list(from_terminal(table).rows) == []


def test_a_column_that_says_nothing_is_left_out_and_ranges_stay_in_one_piece() -> None:
    table = Table("name", "range", "weak", "pair")
    table.add_row("a", "1 .. 2", "", "(-0.1, 0.2) 0.3")
    table.add_row("b", "", "", "least, greatest")
    found = from_terminal(table)
    assert list(found.headings) == ["name", "range", "pair"]
    space = "\N{NO-BREAK SPACE}"
    assert found.rows[0] == ("a", f"1{space}..{space}2", f"(-0.1,{space}0.2) 0.3")
    assert found.rows[1] == ("b", "", "least, greatest")


def test_sections_without_content_are_left_out_and_text_is_escaped(tmp_path: Path) -> None:
    err, path = io.StringIO(), tmp_path / "a.html"
    sections = [Section("Full", remarks(["<b>"])), Section("Empty", [])]
    write_verb_page(path, "T", sections, Output(stderr=err), subtitle="what")
    html = path.read_text()
    assert "&lt;b&gt;" in html
    assert "Empty" not in html
    assert err.getvalue() == f"written: {path}\n"
