"""Read and check what a joint's run needs: its TOML configuration, and a motion from a CSV file.

`load_config(path)` gives a frozen `Config` or one line for each problem.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import (
    LARGEST_TABLE_BYTES,
    LARGEST_TEXT_BYTES,
    number_from,
    parse_toml,
    read_input,
    require_input,
)
from jointctl.firmware_py.trajectory import spline_table
from jointctl.tools.configuration.config import (
    SHIPPED_FOLDER,
    Config,
    ConfigurationProblems,
    Control,
    problem_lines,
    raise_if,
)
from jointctl.tools.configuration.drive_section import GivenPlace, completed

SPELT_ALIKE = 0.7  # of difflib's ratio


def shipped_config(name: str) -> Path:
    """Path of a configuration shipped with the package, with or without `.toml`; an arm's has a folder of its own."""
    if os.path.isfile(arm := SHIPPED_FOLDER / name / f"{name}.toml"):  # no error of a name that is too long
        return arm
    return SHIPPED_FOLDER / (name if name.endswith(".toml") else f"{name}.toml")


def shipped_control(name: str) -> Control:
    """[control] of a configuration shipped with the package."""
    return load_config(shipped_config(name)).control


def _meant(path: Path) -> str:
    """The shipped configuration, or the file beside, whose name is spelt alike; "" if there is none."""
    shipped = {each.stem: each.stem for each in SHIPPED_FOLDER.glob("*.toml")} if path.parent == Path() else {}
    beside = {each.name: str(each) for each in path.parent.glob("*.toml") if each.name != path.name}
    near = difflib.get_close_matches(path.name, [*shipped, *beside], n=1, cutoff=SPELT_ALIKE)
    return f"did you mean {({**shipped, **beside})[near[0]]}?" if near else ""


def read_text(path: Path) -> str:
    """Text of a configuration file, without the mark that some editors begin it with.

    `ConfigurationError` if it cannot be read as such.
    """
    known = ", ".join(sorted(p.stem for p in SHIPPED_FOLDER.glob("*.toml")))
    try:
        return read_input(path).decode("utf-8-sig")
    except FileNotFoundError:
        what = f"a link to {path.readlink()}, which is not there" if path.is_symlink() else "no such file"
        raise ConfigurationError(f"{path}: {what}", _meant(path) or f"shipped configurations: {known}") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: is a folder, not a configuration file") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from None


RENAMED = {  # keys of an older version, read until the next one
    "control": {"q": "lyapunov_q", "matched_filter": "filtered_error_rate"},
}


def renamed(data: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The raw configuration with the present names of its keys, and a remark for each old one."""
    remarks = []
    for section, keys in RENAMED.items():
        values = data.get(section)
        for old, new in keys.items():
            if isinstance(values, dict) and old in values and new not in values:
                values = {new if key == old else key: value for key, value in values.items()}
                data = {**data, section: values}
                remarks.append(f"{section}.{old} is called {section}.{new} now; the next version does not read {old}")
    return data, tuple(remarks)


def load_config(path: str | Path) -> Config:
    """Read, check and freeze a configuration; `ConfigurationError` holds one line per problem.

    What only the virtual joint can judge of [virtual] is judged where it is made (`tools.virtual_joint`).
    """
    text, data = read_document(Path(path))
    if isinstance(arm := data.get("arm"), dict):
        joints = ", ".join(map(str, joints)) if isinstance(joints := arm.get("joints"), list) else "arm.joints"
        raise ConfigurationError(f"{path}: is the file of an arm, not of a joint", f"name one of its joints: {joints}")
    return config_of(Path(path), text, data)


def read_document(path: Path) -> tuple[str, dict[str, Any]]:
    """A TOML file and what it says; `ConfigurationError`."""
    text = read_text(path)
    try:
        return text, parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}{_line_of(text, str(error))}") from None


def _line_of(text: str, problem: str) -> str:
    """`: kp = `, the line that a message of the TOML reader names by its number; "" where it names none."""
    found, lines = re.search(r"at line (\d+)", problem), text.splitlines()
    line = lines[int(found[1]) - 1].strip() if found is not None and int(found[1]) <= len(lines) else ""
    return f": {line}{decimal_point(line.partition('=')[2].partition('#')[0])}" if line else ""


def config_of(path: Path, text: str, data: dict[str, Any]) -> Config:
    """As `load_config`, of a file that was read."""
    data, remarks = renamed(data)
    data, converted = with_units(data)
    config = _validated(data, str(path))
    config._path, config._text, config._remarks = path, text, (*remarks, *converted)
    from jointctl.tools.configuration.checks import problems_between_sections  # `stop` does without its kernels

    raise_if([f"{path}: {line}" for line in problems_between_sections(config)])
    table = (("trajectory.file", config.table_path),) if config.table_path is not None else ()
    for key, file in (*config.drive.files(config), *table):
        if not os.path.isfile(file):
            raise_if([f"{path}: {key} (={file.name}) must name a file beside the configuration or a shipped one"])
        try:
            require_input(file, LARGEST_TABLE_BYTES if key == "trajectory.file" else LARGEST_TEXT_BYTES)
        except OSError as error:
            raise_if([f"{path}: {key} (={file.name}): cannot be read: {error.strerror or error}"])
    return config


def moved(config: Config, given: GivenPlace, environ: Mapping[str, str] | None = None) -> Config:
    """The configuration of a drive that is elsewhere: flag beats environment (CAN_INTERFACE, ...) beats file."""
    return config.drive.moved(config, given, os.environ if environ is None else environ)


def _validated(data: Mapping[str, Any], name: str) -> Config:
    try:
        return Config.model_validate(completed(data))
    except ConfigurationError as error:
        raise ConfigurationProblems([f"{name}: {error.message}"]) from None
    except ValidationError as error:
        raise_if([f"{name}: {line}" for line in problem_lines(error.errors(include_url=False), data)])
        raise


# --- Quantities with a unit, such as "30 deg", as the number that the key means ---


_TURN = math.tau
_ARCMIN = _TURN / 21600.0
_FACTORS: Mapping[str, Mapping[str, float]] = {
    "rad": {
        "rad": 1.0, "mrad": 1e-3, "deg": _TURN / 360.0, "°": _TURN / 360.0, "turn": _TURN, "turns": _TURN,
        "arcmin": _ARCMIN, "arcsec": _ARCMIN / 60.0,
    },
    "radps": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _TURN / 360.0, "°/s": _TURN / 360.0, "rpm": _TURN / 60.0,
        "r/min": _TURN / 60.0, "rev/min": _TURN / 60.0,
    },
    "radps2": {"rad/s2": 1.0, "rad/s^2": 1.0, "rad/s²": 1.0, "deg/s2": _TURN / 360.0, "deg/s^2": _TURN / 360.0},
    "radps3": {"rad/s3": 1.0, "rad/s^3": 1.0, "rad/s³": 1.0, "deg/s3": _TURN / 360.0, "deg/s^3": _TURN / 360.0},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0},
    "Nm": {"Nm": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
    "NmpA": {"Nm/A": 1.0, "mNm/A": 1e-3},
    "Nmps": {"Nm/s": 1.0},
    "Nmprad": {"Nm/rad": 1.0, "kNm/rad": 1e3, "Nm/mrad": 1e3, "Nm/deg": 360.0 / _TURN, "Nm/arcmin": 1.0 / _ARCMIN},
    "Nmspr": {"Nms/rad": 1.0, "Nm s/rad": 1.0},
    "A": {"A": 1.0, "mA": 1e-3},
    "kgm2": {"kgm2": 1.0, "kg m2": 1.0, "kg m^2": 1.0, "kg m²": 1.0, "kgcm2": 1e-4, "kg cm2": 1e-4, "gcm2": 1e-7},
    "bitps": {"bit/s": 1.0, "kbit/s": 1e3, "Mbit/s": 1e6},
    "permille": {"permille": 1.0, "‰": 1.0, "%": 10.0},
}  # fmt: skip
WHOLE = frozenset({"bitps", "permille"})
_QUANTITY = re.compile(r"\s*([-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].*?)\s*")


def unit_of(key: str) -> str | None:
    """The unit in a key's name; None where it has none that could be written differently."""
    unit = key.rpartition("_")[2]
    return unit if unit in _FACTORS else None


def unit_text(unit: str) -> str:
    """As it is written: `radps2` is rad/s2."""
    return next(text for text, factor in _FACTORS[unit].items() if factor == 1.0)


def understood(key: str, text: str) -> float | int | None:
    """The number for `key` of a quantity with a unit; None if it is none, or of something else."""
    unit, match = unit_of(key), _QUANTITY.fullmatch(text)
    if unit is None or match is None or match[2] not in _FACTORS[unit]:
        return None
    value = float(match[1].replace("_", "")) * _FACTORS[unit][match[2]]
    if unit not in WHOLE:
        return value
    return round(value) if math.isfinite(value) and abs(value - round(value)) < 1e-6 else None


def decimal_point(text: str) -> str:
    """What there is to say of a number with a decimal comma; "" of all else."""
    match = re.fullmatch(r"\s*([-+]?)(\d*),(\d+(?:[eE][-+]?\d+)?(?:\s*[^\d\s,].*)?)", text.rstrip())
    return f"; with a decimal point: {match[1]}{match[2] or 0}.{match[3]}" if match else ""


def echo(key: str, text: str, value: float) -> str:
    """What was understood, for the user."""
    unit = unit_of(key)
    return f"{text.strip()} is read as {value:.6g} {unit_text(unit) if unit else ''}".rstrip()


def with_units(data: Mapping[str, Any], place: str = "") -> tuple[dict[str, Any], list[str]]:
    """A raw configuration with texts such as "30 deg" as numbers, and one remark for each."""
    found: dict[str, Any] = {}
    remarks: list[str] = []
    for key, value in data.items():
        name = f"{place}{key}"
        found[key] = value
        if isinstance(value, dict):
            found[key], inner = with_units(value, f"{name}.")
            remarks += inner
        elif isinstance(value, str) and (number := understood(key, value)) is not None:
            found[key] = number
            remarks.append(f"{name}: {echo(key, value, number)}")
    return found, remarks


# --- A motion from a CSV file ---
# Joint side, SI units.  Errors are ValueError with one line that names the file, the row and the value.


def _table_text(path: Path) -> str:
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


def _read_points(path: Path, column: str) -> tuple[np.ndarray, np.ndarray]:
    columns = ("time_s", column)
    reader = csv.reader(io.StringIO(_table_text(path)))
    header = [name.strip() for name in next(reader, [])]
    for name in columns:
        if header.count(name) != 1:
            shown = ",".join(header)[:80]
            raise ValueError(
                f"{path}: row 1 (={shown!r}) must name the column {name} once; needed: {','.join(columns)}"
            )
    at_time, at_position = (header.index(name) for name in columns)
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
        positions.append(_number(path, row, column, fields[at_position]))
    if len(times) < 2:
        raise ValueError(f"{path}: rows of values (={len(times)}) must be at least 2")
    return np.array(times), np.array(positions)


def table_from_csv(path: str | Path, column: str = "position_rad") -> np.ndarray:
    """The table of `reference_at` from a CSV file with the columns time_s and `column`; others are ignored.

    A `spline_table` through the points.  Time is shifted so that the first row is 0.  The last line must end with a
    line end, or a file that was cut off inside its last number would pass unnoticed.  Returns float64 (points, 5).
    """
    path = Path(path)
    time_s, position_rad = _read_points(path, column)
    try:
        return spline_table(time_s - time_s[0], position_rad)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
