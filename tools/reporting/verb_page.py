"""The page of a verb whose result is told in the terminal as well: the same tables, the same pictures, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table as TerminalTable
from rich.text import Text

from tools.output import Output
from tools.reporting.page import Block, Figure, Paragraph, Section, Table, page, write_page

_RANGE = "\N{NO-BREAK SPACE}..\N{NO-BREAK SPACE}"


def from_terminal(table: TerminalTable) -> Table:
    """A table of the terminal as one of the page; without markup and styles."""
    headings = [_plain(column.header) if table.show_header else "" for column in table.columns]
    # a range is not broken in its middle
    columns = [[_plain(cell).replace(" .. ", _RANGE) for cell in column.cells] for column in table.columns]
    notes = [_plain(part) for part in (table.title, table.caption) if part]
    return Table(headings, list(zip(*columns, strict=True)), caption=". ".join(notes))


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else Text.from_markup(str(cell)).plain


def picture(png: Path | bytes, alt: str, caption: str = "") -> Figure:
    """A PNG inside the page."""
    return Figure(alt, caption, png=png if isinstance(png, bytes) else png.read_bytes())


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
