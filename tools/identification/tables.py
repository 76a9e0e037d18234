"""A table of numbers as other programs write it: lines of text, found to be a header and rows.

Delimiter (; tab , space), decimal comma, byte-order mark, comments (#), quotes, lines above the header, a line of units
below it and a delimiter at the end of each line are recognised; what the columns mean is not.  Columns are parsed when
they are asked for, by numpy where they hold nothing but numbers.  Every problem is one `DataError` with file, line and
value.  `--help` loads this: numpy is loaded once there is something to read.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.input_file import LARGEST_SERIES_BYTES, number_from, read_input

if TYPE_CHECKING:
    import numpy as np

DELIMITERS = {"auto": "", "comma": ",", "semicolon": ";", "tab": "\t", "space": " ", ",": ",", ";": ";", "\t": "\t"}
LARGEST_NUMBER = 1e100  # whatever it means, its squares are numbers as well
MISSING = frozenset(("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--"))  # cells without a value, lower case
_SAMPLE = 200  # lines, spread over the file, that decide on its form
_MOST_HEAD = 40  # lines up to the first of values
_TWO_NUMBERS = re.compile(r"[0-9]+[ \t]+[+-]?[0-9]+")  # what a comma leaves of decimal commas between spaces
_UNIT_BEHIND = re.compile(r"\s*(?:\[([^]]*)\]|\(([^)]*)\))$")
_TIMESTAMP = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d{1,2}:\d\d:\d\d([.,]\d+)?\s?(Z|UTC|[+-]\d\d:?\d\d)?")
_WITH_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class ForeignFormat:
    """How to read a table that is not ours, and the options for that; None = not given."""

    velocity_column: Annotated[str | None, typer.Option("--velocity-column", help="name of the velocity column")] = None
    torque_column: Annotated[str | None, typer.Option("--torque-column", help="name of the torque column")] = None
    current_column: Annotated[str | None, typer.Option("--current-column", help="name of the current column")] = None
    velocity_unit: Annotated[
        str | None, typer.Option("--velocity-unit", help="deg/s, rad/s, r/min, turn/s or count/s")
    ] = None
    side: Annotated[str | None, typer.Option("--side", help="of velocity and position: joint or motor")] = None
    torque_side: Annotated[str | None, typer.Option("--torque-side", help="motor or joint")] = None
    torque_unit: Annotated[str, typer.Option("--torque-unit", help="Nm, Ncm or mNm")] = "Nm"
    current_unit: Annotated[str, typer.Option("--current-unit", help="A or mA")] = "A"
    ratio: Annotated[float | None, typer.Option("--ratio", help="reduction ratio")] = None
    torque_constant_NmpA: Annotated[float | None, typer.Option("--torque-constant", help="of the motor (Nm/A)")] = None
    counts_per_turn: Annotated[
        float | None, typer.Option("--counts-per-turn", help="of the shaft that is counted, for the unit count")
    ] = None
    reverse: Annotated[
        list[str] | None,
        typer.Option("--reverse", help="position, velocity, torque or load: the other sign; may be repeated"),
    ] = None
    where: Annotated[
        list[str] | None,
        typer.Option("--where", metavar="COLUMN=VALUE", help="only such lines, as of one joint; may be repeated"),
    ] = None
    delimiter: Annotated[str, typer.Option("--delimiter", help="between columns: auto, or the character")] = "auto"
    time_column: Annotated[
        str | None, typer.Option("--time-column", help="name of the time column: the table is a motion in time")
    ] = None
    time_unit: Annotated[str, typer.Option("--time-unit", help="s, ms, us or ns")] = "s"
    sample_rate_Hz: Annotated[
        float | None, typer.Option("--sample-rate", help="samples a second, in place of a column of time")
    ] = None
    motion_column: Annotated[
        str | None,
        typer.Option("--motion-column", help="column that changes from one motion to the next, or time that goes back"),
    ] = None
    position_column: Annotated[str | None, typer.Option("--position-column", help="name of the position column")] = None
    position_unit: Annotated[str | None, typer.Option("--position-unit", help="rad, deg, turn or count")] = None
    position_side: Annotated[
        str | None, typer.Option("--position-side", help="where it is not that of the velocity: joint or motor")
    ] = None
    load_column: Annotated[
        str | None, typer.Option("--load-column", help="name of the column of the known load's torque (joint, Nm)")
    ] = None
    temperature_column: Annotated[
        str | None, typer.Option("--temperature-column", help="name of the temperature column")
    ] = None
    temperature_unit: Annotated[str, typer.Option("--temperature-unit", help="degC, K or degF")] = "degC"

    @property
    def mapped(self) -> bool:
        return bool(self.velocity_column or self.torque_column or self.current_column)

    def sign(self, name: str) -> float:
        return -1.0 if name in (self.reverse or ()) else 1.0


OURS = ForeignFormat()  # nothing is given


@dataclass(frozen=True)
class TableFile:
    """The lines of a file below its header."""

    path: Path
    sha256: str
    columns: tuple[str, ...]
    lines: tuple[str, ...]
    numbered: np.ndarray  # (N,) number of each line in the file
    mark: str  # between the cells
    decimal_comma: bool
    ended: bool  # the last line has its line end
    notes: tuple[str, ...] = ()

    def column(self, name: str) -> int:
        """Index of a column by its name, if need be without its case or its unit in brackets, or number from 1."""
        wanted = name.strip()
        bare = [_UNIT_BEHIND.sub("", column) for column in self.columns]
        for names, alike in (
            *((list(each), wanted) for each in (self.columns, bare)),
            *(([column.lower() for column in each], wanted.lower()) for each in (self.columns, bare)),
        ):
            if names.count(alike) > 1:
                raise DataError(
                    f"{self.path}: column {name!r} occurs {names.count(alike)} times", "give its number, from 1"
                )
            if alike in names:
                return names.index(alike)
        if name.isdigit() and 1 <= int(name) <= len(self.columns):
            return int(name) - 1
        raise DataError(f"{self.path}: no column {name!r}", f"the file has: {', '.join(self.columns)}")

    @cached_property
    def rows(self) -> tuple[tuple[int, tuple[str, ...]], ...]:
        """(line number, cells) of each line."""
        return tuple((int(n), split(line, self.mark)) for n, line in zip(self.numbered, self.lines, strict=True))

    def texts(self, name: str) -> list[str]:
        """A column as it is written."""
        index = self.column(name)
        return [split(line, self.mark)[index] for line in self.lines]

    def unit(self, name: str) -> str:
        """What stands in brackets behind a column's name; empty where nothing does."""
        found = _UNIT_BEHIND.search(self.columns[self.column(name)])
        return (found[1] or found[2] or "").strip() if found else ""

    def timestamps_s(self, name: str) -> np.ndarray | None:
        """Seconds (N,) since the first of a column of ISO 8601 or of times of day; None where the first is no such.

        A cell without a value is nan.
        """
        import numpy as np

        index = self.column(name)
        cells = [split(line, self.mark)[index] for line in self.lines]
        first = next((cell for cell in cells if cell.lower() not in MISSING), "")
        if not _TIMESTAMP.fullmatch(first):
            return None
        texts: list[str] = []
        zones: dict[str | None, str] = {}
        for line, cell in zip(self.numbered, cells, strict=True):
            if cell.lower() in MISSING:
                texts.append("NaT")
                continue
            found = _TIMESTAMP.fullmatch(cell)
            zone = found[3] if found else None
            zones.setdefault(zone, cell)
            if found is None or len(zones) > 1:
                wanted = f"a time as {first}" + (", in the same zone" if found else "")
                raise DataError(f"{self.path}: line {line}: {self.columns[index]} (={cell[:40]}) must be {wanted}")
            clock = cell.removesuffix(zone or "").strip().replace(",", ".").replace(" ", "T")
            texts.append(clock if found[1] else "1970-01-01T" + clock.zfill(len(clock) + (clock[1] == ":")))
        try:
            stamps = np.array(texts, "datetime64[ns]")
        except ValueError as error:
            raise DataError(f"{self.path}: {self.columns[index]}: not a time: {error}") from None
        return np.asarray((stamps - stamps[~np.isnat(stamps)][0]) / np.timedelta64(1, "s"), float)

    def only(self, chosen: np.ndarray) -> TableFile:
        """The table with some of its lines, (N,) bool."""
        lines = tuple(line for line, keep in zip(self.lines, chosen.tolist(), strict=True) if keep)
        return replace(self, lines=lines, numbered=self.numbered[chosen])

    def number(self, row: tuple[int, tuple[str, ...]], index: int, *, empty: float | None = None) -> float:
        """A finite number; an empty cell is `empty` if that is given."""
        line, cells = row
        return self._value(line, cells[index], index, empty)

    def _value(self, line: int, cell: str, index: int, empty: float | None) -> float:
        text = cell.strip()
        if not text and empty is not None:
            return empty
        try:
            value = number_from(text.replace(",", ".") if self.decimal_comma else text)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST_NUMBER:
            raise DataError(
                f"{self.path}: line {line}: {self.columns[index]} (={text[:40] or 'empty'}) must be a finite number"
                + (f", at most {LARGEST_NUMBER:g}" if math.isfinite(value) else "")
            )
        return value

    def numbers(self, name: str, *, gaps: bool = False) -> np.ndarray:
        """A column (N,) of finite numbers; with `gaps` a cell without a value is nan.

        `DataError` names the line of anything else.
        """
        import numpy as np

        index = self.column(name)
        fast = self._at_once(index)
        if fast is not None and ((np.abs(fast) <= LARGEST_NUMBER) | (np.isnan(fast) & gaps)).all():
            return fast
        found = np.empty(len(self.lines))
        for place, (line, text) in enumerate(zip(self.numbered, self.lines, strict=True)):
            cell = split(text, self.mark)[index]
            missing = gaps and cell.strip().lower() in MISSING
            found[place] = math.nan if missing else self._value(int(line), cell, index, None)
        return found

    def _at_once(self, index: int) -> np.ndarray | None:
        """The column by numpy's own parser; None where that meets anything but numbers."""
        import numpy as np

        lines: Sequence[str] = self.lines
        if self.decimal_comma:
            lines = [line.replace(",", ".") for line in lines]
        try:
            return np.loadtxt(
                lines, delimiter=None if self.mark == " " else self.mark, usecols=(index,), comments=None,
                quotechar='"', ndmin=1,
            )  # fmt: skip
        except ValueError:
            return None


def split(line: str, mark: str) -> tuple[str, ...]:
    """The cells of a line, without the spaces around them."""
    if mark == " ":
        return tuple(line.split())
    if '"' in line:
        return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=mark, skipinitialspace=True)))
    return tuple(map(str.strip, line.split(mark)))


def read_bytes(path: Path) -> bytes:
    try:
        return read_input(path, LARGEST_SERIES_BYTES)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, not a data file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def _text(path: Path, content: bytes) -> tuple[str, int | None]:
    """(text, first byte that is not UTF-8): such a file is read as Latin-1, which is right for all that is ASCII."""
    encoding = "utf-8-sig"
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif b"\0" in content[:65536]:
        head = content[:1024]
        halves = {"utf-16-le": head[1::2], "utf-16-be": head[::2]}  # of ASCII every second byte is zero
        found = [name for name, half in halves.items() if 10 * half.count(0) > 9 * len(half)]
        if not found or 5 * head.count(0) > 3 * len(head):
            raise DataError(f"{path}: is a binary file (byte {content.index(0)} is zero), not a CSV table")
        encoding = found[0]
    try:
        return content.decode(encoding), None
    except UnicodeDecodeError as error:
        return content.decode("latin-1"), error.start


def _delimiter(path: Path, lines: Sequence[tuple[int, str]], wanted: str) -> str:
    if wanted not in DELIMITERS:
        raise UsageError(f"--delimiter (={wanted}) must be one of auto, comma, semicolon, tab, space")
    if wanted != "auto":
        return DELIMITERS[wanted]
    sample = [line for _, line in lines[:: max(1, len(lines) // _SAMPLE)]]
    for candidate in (";", "\t", ",", " "):
        usual = _usual_count(sample, candidate)
        alike = [line for line in sample if len(split(line, candidate)) == usual]
        numeric = sum(_is_row(split(line, candidate), candidate) for line in alike)
        if usual > 1 and 2 * len(alike) > len(sample) and 2 * numeric > len(alike):
            return candidate
    header = lines[0][1]
    for candidate in (";", "\t", ","):  # a comma may be a decimal one, so it comes last
        if candidate in header:
            return candidate
    if len(header.split()) > 1:
        return " "
    raise DataError(f"{path}: line 1 (={header[:40]}) must hold at least two columns", "tell --delimiter")


def _usual_count(lines: Sequence[str], mark: str) -> int:
    return Counter(len(split(line, mark)) for line in lines).most_common(1)[0][0]


def _is_row(cells: Sequence[str], mark: str) -> bool:
    """Whether a line looks like values: at least half of its cells are numbers or have no value, one is a number."""
    if any(map(_TWO_NUMBERS.fullmatch, cells)):
        return False
    numbers = sum(_is_number(cell.replace(",", ".") if mark != "," else cell) for cell in cells)
    empty = sum(cell.lower() in MISSING for cell in cells)
    return numbers > 0 and 2 * (numbers + empty) >= len(cells)


def _is_number(text: str) -> bool:
    try:
        number_from(text)
    except ValueError:
        return False
    return True


def read_table(path: Path, delimiter: str = "auto") -> TableFile:
    """Header and lines; comments and empty lines are skipped, and what stands above the header."""
    import numpy as np

    content = read_bytes(path)
    text, wrong_byte = _text(path, content)
    lines = [
        (n, line) for n, line in enumerate(text.splitlines(), 1)
        if line and not line.isspace() and not line.lstrip().startswith("#")
    ]  # fmt: skip
    if not lines:
        raise DataError(f"{path}: is empty: a header and one line a point are needed")
    mark = _delimiter(path, lines, delimiter)
    sample = [line for _, line in lines[:: max(1, len(lines) // _SAMPLE)]]
    if _ends_with_mark(lines, mark, _usual_count(sample, mark)):
        lines = [(n, line.rstrip().removesuffix(mark)) for n, line in lines]
        sample = [line.rstrip().removesuffix(mark) for line in sample]
    columns, begin, notes = _heading(lines, mark, _usual_count(sample, mark))
    body = lines[begin:]
    if not body:
        raise DataError(f"{path}: has a header but no points")
    rows = tuple(line for _, line in body)
    if wrong_byte is not None and not all(map(str.isascii, rows)):
        raise DataError(f"{path}: byte {wrong_byte} is not UTF-8 text: not a CSV table")
    _check_counts(path, body, mark, len(columns))
    return TableFile(
        path, hashlib.sha256(content).hexdigest(), columns, rows, np.array([n for n, _ in body]), mark,
        mark != "," and _comma([split(line, mark) for line in sample]), text.endswith(("\n", "\r")), tuple(notes),
    )  # fmt: skip


def _ends_with_mark(lines: Sequence[tuple[int, str]], mark: str, usual: int) -> bool:
    """Whether each line of values ends with a delimiter that begins no column: none is named there."""
    if mark == " " or not all(line.rstrip().endswith(mark) for _, line in lines[_MOST_HEAD:] or lines[-1:]):
        return False
    head = [split(line, mark) for _, line in lines[:_MOST_HEAD]]
    return not any(len(cells) == usual and cells[-1] and not _is_row(cells, mark) for cells in head)


def _heading(lines: Sequence[tuple[int, str]], mark: str, usual: int) -> tuple[tuple[str, ...], int, list[str]]:
    """(names of the columns, index of the first line of values, notes)."""
    cells = split(lines[0][1], mark)
    if len(lines) == 1:
        return (cells, 1, []) if not _is_row(cells, mark) else (_counted(len(cells)), 0, [])
    header, above = None, _padded(lines, mark, usual)
    for index, (_, line) in enumerate(lines[above:], above):
        cells = split(line, mark)
        if len(cells) != usual:
            continue
        if _is_row(cells, mark):
            break
        if header is None:
            header = index
    else:
        header, index = 0, 1
    if header is None:
        notes = [_skipped(lines[:index], "no header: not read")] if index else []
        return _counted(usual), index, notes
    notes = [_skipped(lines[:header], "above the header: not read")] if header else []
    begin = header + 1
    while begin < index and len(split(lines[begin][1], mark)) == usual:
        notes.append(f"line {lines[begin][0]} (={lines[begin][1][:60]}): no numbers, such as units: not read")
        begin += 1
    return split(lines[header][1], mark), begin, notes


def _padded(lines: Sequence[tuple[int, str]], mark: str, usual: int) -> int:
    """How many lines above the header are filled up with empty cells, as a spreadsheet does; 0 where none is.

    The header is the first line without an empty cell at its end then, if that is none of values.
    """
    for index, (_, line) in enumerate(lines[:_MOST_HEAD]):
        cells = split(line, mark)
        if len(cells) == usual and cells[-1]:
            return 0 if _is_row(cells, mark) else index
    return 0


def _counted(count: int) -> tuple[str, ...]:
    return tuple(str(k + 1) for k in range(count))


def _skipped(lines: Sequence[tuple[int, str]], why: str) -> str:
    first, last = lines[0][0], lines[-1][0]
    return f"line{f's {first} to {last}' if last > first else f' {first}'}: {why}"


def _check_counts(path: Path, body: Sequence[tuple[int, str]], mark: str, count: int) -> None:
    """`DataError` names the first line with another number of cells than the header."""
    for n, line in body:
        if mark != " " and '"' not in line:
            cells = line.count(mark) + 1
        else:
            cells = len(split(line, mark))
        if cells != count:
            last = " (the last line: is the file cut off?)" if n == body[-1][0] else ""
            raise DataError(f"{path}: line {n} has {cells} columns, the header {count}{last}")


def _comma(rows: Sequence[tuple[str, ...]]) -> bool:
    """Decimal commas: some cell is a number with a comma, and none is one with a point."""
    cells = [cell for row in rows for cell in row]
    return any(map(_WITH_COMMA.fullmatch, cells)) and not any("." in cell and _is_number(cell) for cell in cells)
