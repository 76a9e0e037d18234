"""Read a CSV file of numbers from anywhere: delimiter, decimal comma, byte-order mark, comments, quotes.

Every problem is one `DataError` that names file, line and value.
"""

from __future__ import annotations

import csv
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.input_file import LARGEST_TABLE_BYTES, number_from, read_input

DELIMITERS = {"auto": "", "comma": ",", "semicolon": ";", "tab": "\t", "space": " ", ",": ",", ";": ";", "\t": "\t"}


LARGEST_NUMBER = 1e100  # whatever it means, its squares are numbers as well


@dataclass(frozen=True)
class TableFile:
    """The text cells of a file; `rows` holds (line number, cells)."""

    path: Path
    sha256: str
    columns: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    decimal_comma: bool
    ended: bool  # the last line has its line end

    def column(self, name: str) -> int:
        """Index of a column by its name (case ignored) or number from 1."""
        lowered = [c.lower() for c in self.columns]
        if lowered.count(name.lower()) > 1:
            raise DataError(f"{self.path}: column {name!r} occurs {lowered.count(name.lower())} times")
        if name.lower() in lowered:
            return lowered.index(name.lower())
        if name.isdigit() and 1 <= int(name) <= len(self.columns):
            return int(name) - 1
        raise DataError(f"{self.path}: no column {name!r}", f"the file has: {', '.join(self.columns)}")

    def number(self, row: tuple[int, tuple[str, ...]], index: int, *, empty: float | None = None) -> float:
        """A finite number; an empty cell is `empty` if that is given."""
        line, cells = row
        text = cells[index].strip()
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


def read_bytes(path: Path) -> bytes:
    try:
        return read_input(path, LARGEST_TABLE_BYTES)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, not a data file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def _text(path: Path, content: bytes) -> str:
    if b"\0" in content[:65536] and not content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError(f"{path}: is a binary file (byte {content.index(0)} is zero), not a CSV table")
    try:
        return content.decode("utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: byte {error.start} is not UTF-8 text: not a CSV table") from None


def _delimiter(path: Path, header: str, wanted: str) -> str:
    if wanted not in DELIMITERS:
        raise UsageError(f"--delimiter (={wanted}) must be one of auto, comma, semicolon, tab, space")
    if wanted != "auto":
        return DELIMITERS[wanted]
    for candidate in (";", "\t", ","):  # a comma may be a decimal one, so it comes last
        if candidate in header:
            return candidate
    if len(header.split()) > 1:
        return " "
    raise DataError(f"{path}: line 1 (={header[:40]}) must hold at least two columns", "tell --delimiter")


def read_table(path: Path, delimiter: str = "auto") -> TableFile:
    """Header and rows; lines that begin with # and empty lines are skipped."""
    content = read_bytes(path)
    lines = [(n, line) for n, line in enumerate(_text(path, content).splitlines(), 1)
             if line.strip() and not line.lstrip().startswith("#")]  # fmt: skip
    if not lines:
        raise DataError(f"{path}: is empty: a header and one line a point are needed")
    mark = _delimiter(path, lines[0][1], delimiter)

    def split(line: str) -> tuple[str, ...]:
        if mark == " ":
            return tuple(line.split())
        return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=mark)))

    columns = split(lines[0][1])
    if all(_is_number(cell.replace(",", ".")) for cell in columns):
        # no header: the columns have numbers only
        columns = tuple(str(k + 1) for k in range(len(columns)))
    else:
        del lines[0]
    rows = tuple((n, split(line)) for n, line in lines)
    if not rows:
        raise DataError(f"{path}: has a header but no points")
    for n, cells in rows:
        if len(cells) != len(columns):
            last = " (the last line: is the file cut off?)" if n == rows[-1][0] else ""
            raise DataError(f"{path}: line {n} has {len(cells)} columns, the header {len(columns)}{last}")
    return TableFile(
        path, hashlib.sha256(content).hexdigest(), columns, rows, mark == ";" and _comma(rows), content.endswith(b"\n")
    )


def _is_number(text: str) -> bool:
    try:
        number_from(text)
    except ValueError:
        return False
    return True


def _comma(rows: tuple[tuple[int, tuple[str, ...]], ...]) -> bool:
    """Decimal commas: with ; between the columns, some cell has a comma and none has a point."""
    text = "".join("".join(cells) for _, cells in rows)
    return "," in text and "." not in text
