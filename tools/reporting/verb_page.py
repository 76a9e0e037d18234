"""The page of a verb whose result is told in the terminal as well: the same tables, the same pictures, in one file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table as TerminalTable

from jointctl.tools.narrow_table import cell_text
from jointctl.tools.output import Output
from jointctl.tools.reporting.page import Block, Paragraph, Section, Table, page, write_page

_PAIR = re.compile(r"(?<=\d), (?=-?\d)")
_RANGE = "\N{NO-BREAK SPACE}..\N{NO-BREAK SPACE}"


def from_terminal(table: TerminalTable) -> Table:
    """A table of the terminal as one of the page; without styles."""
    named = [(cell_text(column.header) if table.show_header else "", column) for column in table.columns]
    columns = [(heading, [_unbroken(cell_text(cell)) for cell in column.cells]) for heading, column in named]
    # a column that says nothing is left out
    columns = [(heading, cells) for heading, cells in columns if any(cells) or not (heading and cells)]
    notes = [cell_text(part) for part in (table.title, table.caption) if part]
    rows = list(zip(*(cells for _, cells in columns), strict=True))
    return Table([heading for heading, _ in columns], rows, caption=". ".join(notes))


def _unbroken(text: str) -> str:
    """A range or a pair of numbers is not broken in its middle."""
    return _PAIR.sub(",\N{NO-BREAK SPACE}", text.replace(" .. ", _RANGE))


def remarks(lines: Sequence[str], tone: str = "warning") -> list[Block]:
    """Each line a paragraph of its own."""
    return [Paragraph(line, tone) for line in lines]


def write_verb_page(
    path: Path, title: str, sections: Sequence[Section], output: Output, *, subtitle: str = "",
    inputs: Sequence[Path] = (),
) -> None:  # fmt: skip
    """Write the page and say so; sections without content are left out."""
    write_page(path, page(title, [section for section in sections if section.blocks], subtitle=subtitle), inputs)
    output.note(f"written: {path}")
