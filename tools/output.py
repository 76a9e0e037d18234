"""Where output goes: results on stdout, everything else on stderr; colour and progress only on a terminal.

With `json` the result is one JSON document on stdout and nothing else is printed there; NO_COLOR is honoured by rich.
Whatever a text holds, a terminal shows it and obeys none of it (`drivers.errors`); a result is not cut.
"""

from __future__ import annotations

import json as json_format
import math
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import IO, Any, Protocol

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table
from rich.text import Text

from jointctl.drivers.errors import DataError, message_line, printable


class Advance(Protocol):
    """Tells a progress bar how far the work has come, in the unit of its total."""

    def __call__(self, completed: float) -> None: ...


FACT_COLUMN = 11  # where the text of a `fact` begins
_UNIT, _HELD = re.compile(r"(?<=\d) (?=(rad|deg|s|min|ms|us|Nm|A|Hz|mrad|kbit|bit)\b)"), "\N{NO-BREAK SPACE}"
LEAST_COLUMNS = 20  # of the environment's COLUMNS that is believed
PIPE_COLUMNS = 140  # of a table that goes to a file or a pipe, or more if it needs them


def wanted_columns() -> int | None:
    """COLUMNS of the environment, which goes before anything else; None where it is no number of columns."""
    text = os.environ.get("COLUMNS", "")
    return int(text) if text.isdecimal() and int(text) >= LEAST_COLUMNS else None


class _Console(Console):
    """Rich's own ends the program where nobody reads any more, in the middle of a motion as well."""

    def on_broken_pipe(self) -> None:
        raise


def _console(stream: IO[str], width: int | None = None) -> _Console:
    soft_wrap = not stream.isatty()
    return _Console(file=stream, soft_wrap=soft_wrap, width=width, highlight=False, markup=False, emoji=False)


def abandon(stream: IO[str]) -> None:
    """Let what is still to be written to it vanish; else the interpreter would complain when it ends."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def let_go(stream: IO[str]) -> None:
    """At the end: what a slow reader has not taken is lost; the interpreter would make another exit code of it."""
    try:
        stream.flush()
    except OSError:
        abandon(stream)


@dataclass
class Output:
    """The two streams of a command; `stdout` and `stderr` are replaced in tests.

    Nobody reads stdout any more (`| head`): the result is thrown away, the verb goes on to its end.  It cannot be
    written (disk full): `DataError`.  What stderr does not take is lost: never a reason to end a motion; where its
    reader is only slow, what is said later is not lost with it.
    """

    json: bool = False
    quiet: bool = False
    stdout: IO[str] = field(default_factory=lambda: sys.stdout)
    stderr: IO[str] = field(default_factory=lambda: sys.stderr)
    taken: Callable[[object], None] | None = None  # by a program: results go there instead

    def __post_init__(self) -> None:
        # rich wraps at 80 columns where there is no terminal; a line of a log file or of a pipe is not to be broken
        width = None if self.stdout.isatty() else wanted_columns() or PIPE_COLUMNS
        self._results = _console(self.stdout, width)
        self._messages = _console(self.stderr)

    @property
    def for_people(self) -> bool:
        """Whether results are read as they come; a program gets one, when all is done."""
        return not self.json and self.taken is None

    def result(self, shown: RenderableType, data: object = None, found: object = None) -> None:
        """A result: `shown` for people, `data` (numbers, texts, lists, dicts) with `--json`.

        A program gets `found`, or `data` where there is no type for it.
        """
        if self.taken is not None:
            self.taken(data if found is None else found)
        elif self.json:
            if data is not None:
                self.line(json_format.dumps(_plain(data), allow_nan=False))
        else:
            self._write(lambda: _print_whole(self._results, shown))

    def line(self, text: str) -> bool:
        """One line of a result that comes bit by bit; False if nobody reads it any more."""
        # the escapes are those of JSON, so that it stays what it is
        return self._write(lambda: print(printable(text, keep="\n"), file=self.stdout, flush=True))

    def _write(self, write: Callable[[], None]) -> bool:
        try:
            write()
        except BrokenPipeError:
            abandon(self.stdout)
            self._results.quiet = True
            return False
        except OSError as error:
            abandon(self.stdout)
            raise DataError(f"standard output: cannot be written: {error.strerror or error}") from None
        return True

    def _say(self, text: RenderableType, style: str | None = None) -> None:
        try:
            if isinstance(text, str):
                self._messages.print(text, style=style)
            else:
                _print_whole(self._messages, text)
        except BlockingIOError:
            self._messages = _console(self.stderr)  # the old one would say it again
        except OSError:
            abandon(self.stderr)
            self._messages.quiet = True

    def note(self, text: RenderableType) -> None:
        """Progress in words, or as a table; not with `--quiet`."""
        if not self.quiet:
            self._say(message_line(text) if isinstance(text, str) else text)

    def address(self, text: str) -> None:
        """What the user cannot do without, such as where a page is served: also with `--quiet`."""
        self._say(message_line(text))

    def fact(self, text: str) -> None:
        """A note that begins with a heading of `FACT_COLUMN` characters: what a terminal has to wrap goes below it."""
        text = message_line(text)
        if self.stderr.isatty():
            bound = _UNIT.sub(_HELD, text)  # a number and its unit stay on one line
            text = textwrap.fill(
                bound, self._messages.width, subsequent_indent=" " * FACT_COLUMN, break_long_words=False,
                break_on_hyphens=False,
            ).replace(_HELD, " ")  # fmt: skip
        if not self.quiet:
            self._say(text)

    def warning(self, text: str) -> None:
        self._say(f"warning: {message_line(text)}", "yellow")

    def error(self, text: str, hint: str = "") -> None:
        """One line for each line of `text`, and what to do about it."""
        for line in text.strip("\n").split("\n"):
            self._say(f"error: {message_line(line)}", "red")
        if hint:
            self._say(f"hint: {message_line(hint)}")

    @contextmanager
    def progress(self, title: str, total: float) -> Iterator[Advance]:
        """A bar on stderr, if that is a terminal; else nothing at all."""
        if self.quiet or not self.stderr.isatty():
            yield lambda completed: None
            return
        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
        with Progress(*columns, TimeRemainingColumn(), console=self._messages, transient=True) as bar:
            task = bar.add_task(title, total=total)

            def advance(completed: float) -> None:
                bar.update(task, completed=completed)

            yield advance


def _print_whole(console: Console, shown: RenderableType) -> None:
    """As wide as the terminal; on a pipe as wide as the widest table needs."""
    shown = _printable(shown)
    if not console.file.isatty():
        console.width = wanted_columns() or max(PIPE_COLUMNS, widest(shown))
    console.print(fitted(shown, console.width))


def _printable(shown: RenderableType) -> RenderableType:
    """The same with every text in it escaped; only what is no cell may have several lines."""
    if isinstance(shown, str):
        return printable(shown, keep="\n")
    if isinstance(shown, Text):
        if (text := printable(shown.plain, keep="\n")) != shown.plain:
            shown.plain = text
    elif isinstance(shown, Group):
        return Group(*(_printable(part) for part in shown.renderables))
    elif isinstance(shown, Padding):
        shown.renderable = _printable(shown.renderable)
    elif isinstance(shown, Table):
        shown.title, shown.caption = _cell(shown.title), _cell(shown.caption)
        for column in shown.columns:
            column.header, column.footer = _cell(column.header), _cell(column.footer)
            column._cells = [_cell(cell) for cell in column._cells]
    return shown


def _cell(cell: RenderableType | None) -> Any:
    return printable(cell) if isinstance(cell, str) else cell and _printable(cell)


def _plain(value: object) -> Any:
    """JSON knows neither numpy numbers nor nan: the former become Python's, the latter null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def command_line(*words: object) -> str:
    """A command of jointctl to be copied: quoted where a path has blanks."""
    return shlex.join(["jointctl", *map(str, words)])


# --- tables on a narrow terminal: no number is broken in its middle, and rows become lists ---


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
        texts = [f"{heading} {cell_text(cell)}".strip() for heading, cell in zip(headings[1:], others, strict=True)
                if cell_text(cell)]  # fmt: skip
        parts += [
            Padding(Text(line, style=style), (0, 0, 0, _INDENT), expand=False)
            for line in _lines(texts, width - _INDENT)
        ]
    if table.caption:
        parts.append(Text(cell_text(table.caption), style="table.caption"))
    return Group(*parts)


def _lines(texts: list[str], width: int) -> list[str]:
    """As many as fit on a line; what is longer than a line begins one of its own."""
    lines: list[str] = []
    for text in texts:
        if lines and len(lines[-1]) + 2 + len(text) <= width:
            lines[-1] += f", {text}"
        else:
            lines += textwrap.wrap(text, max(width, 1), break_on_hyphens=False)
    return lines
