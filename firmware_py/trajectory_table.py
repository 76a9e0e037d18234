"""A table of the desired motion from points: a CSV file, or places in a program, with a cubic spline through them.

Plain Python, joint side, SI units.  Errors are ValueError with one line that names the file, the row and the value.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np

from jointctl.firmware_py.input_file import LARGEST_TABLE_BYTES, number_from, read_input
from jointctl.firmware_py.trajectory import ENDS_MEET_rad

COLUMNS = ("time_s", "position_rad")


def _read_text(path: Path) -> str:
    try:
        content = read_input(path, LARGEST_TABLE_BYTES)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start} is not UTF-8 text; a CSV file is needed") from None
    if "\0" in text:
        raise ValueError(f"{path}: byte {content.index(0)} is zero: a binary file, but a CSV file is needed")
    if text and not text.endswith("\n"):
        last = text.count("\n") + 1
        raise ValueError(
            f"{path}: row {last} (={text.rsplit(chr(10), 1)[-1][:60]!r}) must end with a line end; cut off?"
        )
    return text


def _number(path: Path, row: int, name: str, text: str) -> float:
    try:
        value = number_from(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}: row {row}: {name} (={text.strip()!r}) must be a finite number")
    return value


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    reader = csv.reader(io.StringIO(_read_text(path)))
    header = [name.strip() for name in next(reader, [])]
    for name in COLUMNS:
        if header.count(name) != 1:
            shown = ",".join(header)[:80]
            raise ValueError(
                f"{path}: row 1 (={shown!r}) must name the column {name} once; needed: {','.join(COLUMNS)}"
            )
    at_time, at_position = (header.index(name) for name in COLUMNS)
    times: list[float] = []
    positions: list[float] = []
    for fields in reader:
        row = reader.line_num
        if not fields:
            continue
        if len(fields) != len(header):
            raise ValueError(
                f"{path}: row {row} (={','.join(fields)[:60]!r}) must have {len(header)} values, like row 1"
            )
        time_s = _number(path, row, "time_s", fields[at_time])
        if times and time_s <= times[-1]:
            raise ValueError(
                f"{path}: row {row}: time_s (={time_s:g}) must be above that of the row before ({times[-1]:g})"
            )
        times.append(time_s)
        positions.append(_number(path, row, "position_rad", fields[at_position]))
    if len(times) < 2:
        raise ValueError(f"{path}: rows of values (={len(times)}) must be at least 2")
    return np.array(times), np.array(positions)


def spline_table(time_s: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
    """The table of `reference_at`, float64 (N, 5), from ascending times and places (N,), N >= 2; the last row ends it.

    A cubic spline at rest at both ends; velocity and acceleration are continuous between.  ValueError, or numbers that
    are not finite, where the steps of time are too short for one.
    """
    from scipy.interpolate import CubicSpline  # here: every start of a run would wait a third of a second for it

    table = np.zeros((len(time_s), 5))
    table[:, 0] = time_s
    table[:-1, 1:] = CubicSpline(time_s, position_rad, bc_type="clamped").c[::-1].T
    table[-1, 1] = position_rad[-1]
    return table


def table_from_csv(path: str | Path) -> np.ndarray:
    """The table of `reference_at` from a CSV file with the columns time_s and position_rad; others are ignored.

    A `spline_table` through the points.  Time is shifted so that the first row is 0.  The last line must end with a
    line end, or a file that was cut off inside its last number would pass unnoticed.  Returns float64 (points, 5).
    """
    path = Path(path)
    time_s, position_rad = _read_points(path)
    time_s = time_s - time_s[0]
    with np.errstate(all="ignore"):
        try:
            table = spline_table(time_s, position_rad)
        except (ValueError, np.linalg.LinAlgError):
            table = np.full((1, 5), np.nan)
    if not np.all(np.isfinite(table)):
        closest = float(np.min(np.diff(time_s)))
        raise ValueError(f"{path}: the smallest time step (={closest:g} s) must be longer, no spline can be computed")
    return table


def ends_meet(table: np.ndarray) -> bool:
    """Whether the table can be repeated: it ends where it starts (both ends are at rest)."""
    return len(table) >= 2 and abs(float(table[-1, 1] - table[0, 1])) <= ENDS_MEET_rad
