"""Tables on a narrow terminal: no number is broken in its middle; where the columns do not fit, rows become lists."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

_KEY_AND_VALUE = 2  # columns: nothing is gained by a list
_INDENT = 2


def cell_text(cell: object) -> str:
    """A cell, heading or title of a table: plain text, or a `Text` without its style."""
    return cell.plain if isinstance(cell, Text) else str(cell)


def width_of(table: Table) -> int:
    """Characters that a table needs at least so that no word of it is broken; borders included."""
    beside = 3 if table.box else 2  # a space on either side of each column, and the line between two
    return sum(_longest(column, table.show_header) + beside for column in table.columns) + (1 if table.box else 0)


def _longest(column: Column, with_header: bool) -> int:
    texts = [cell_text(cell) for cell in (*([column.header] if with_header else []), *column.cells)]
    parts = texts if column.no_wrap else [word for text in texts for word in text.split()]
    return max((len(part) for part in parts), default=0)


def widest(shown: RenderableType) -> int:
    """`width_of` the widest table in what is shown; 0 without one."""
    if isinstance(shown, Group):
        return max((widest(part) for part in shown.renderables), default=0)
    return width_of(shown) if isinstance(shown, Table) else 0


def fitted(shown: RenderableType, width: int) -> RenderableType:
    """The same for `width` characters: nothing is cut off, and a table with no room for its words is listed."""
    if isinstance(shown, Group):
        return Group(*(fitted(part, width) for part in shown.renderables))
    if not isinstance(shown, Table):
        return shown
    for column in shown.columns:
        column.overflow = "fold"
    if width_of(shown) <= width:
        _share(shown, width)
        return shown
    return shown if len(shown.columns) <= _KEY_AND_VALUE or not shown.show_header else _listed(shown, width)


def _share(table: Table, width: int) -> None:
    """If not every cell finds room on one line: no column gets less than its longest word, as rich would have it."""
    longest = [_longest(column, table.show_header) for column in table.columns]
    wanted = [max(len(line) for text in (column.header, *column.cells) for line in (*cell_text(text).split("\n"), ""))
              for column in table.columns]  # fmt: skip
    more = [max(full - least, 0) for full, least in zip(wanted, longest, strict=True)]
    room = width - width_of(table)
    if sum(more) <= room:
        return
    # who wants little is served first, so that a short column is not broken for the sake of a long one
    for left, i in enumerate(sorted(range(len(more)), key=more.__getitem__)):
        given = min(more[i], room // (len(more) - left))
        table.columns[i].width = longest[i] + given
        room -= given


def _listed(table: Table, width: int) -> Group:
    """Title; of each row the first cell, and below it the others after their headings; caption."""
    parts: list[RenderableType] = []
    if table.title:
        parts.append(Text(cell_text(table.title), style="table.title"))
    headings = [cell_text(column.header) for column in table.columns]
    cells = zip(*(column.cells for column in table.columns), strict=True)
    for row, (first, *others) in zip(table.rows, cells, strict=True):
        style = row.style or ""
        parts.append(first if isinstance(first, Text) else Text(str(first), style=style))
        told = [f"{heading} {cell_text(cell)}".strip() for heading, cell in zip(headings[1:], others, strict=True)
                if cell_text(cell)]  # fmt: skip
        parts += [
            Padding(Text(line, style=style), (0, 0, 0, _INDENT), expand=False) for line in _lines(told, width - _INDENT)
        ]
    if table.caption:
        parts.append(Text(cell_text(table.caption), style="table.caption"))
    return Group(*parts)


def _lines(told: list[str], width: int) -> list[str]:
    """As many as fit on a line; what is longer than a line has one of its own."""
    lines: list[str] = []
    for text in told:
        if lines and len(lines[-1]) + 2 + len(text) <= width:
            lines[-1] += f", {text}"
        else:
            lines.append(text)
    return lines
