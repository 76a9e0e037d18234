"""Friction data: points of speed and torque, from the file of our own sweep or from any table of numbers.

One point for each speed at which friction was measured.  Points are sorted by speed, so the order of the file does not
matter; repeats of a speed are all kept, each a measurement of its own (averaging would hide their spread); a line that
is an exact copy of another one is a mistake of copying and counts once; a point at zero speed says nothing, since
friction is set-valued there; points that never settled are left out.  All of this is reported in `notes`.

The file of a sweep is a CSV (joint speed, motor torque), one plateau a line, in the order measured:

    velocity_radps,current_A,motor_torque_Nm,velocity_std_radps,current_std_A,samples,settled,position_min_rad,
    position_max_rad,time_s,temperature_degC,direction,pass

settled is 1 if the mean's confidence interval was met before the time limit, direction is 1 or -1, pass counts repeats
from 0, temperature_degC may be empty.  Beside it lies a JSON file of the same stem with at least reduction_ratio and
torque_constant_NmpA, and, if known, limits (torque_max_Nm, velocity_max_radps of the joint); both signs are such that
friction opposes motion (torque and velocity have the same sign).

Of any other table the user gives columns, units and sides; nothing is guessed (`tables` says what of its form is
recognised).  Every problem is one `DataError` that names file, line and value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Sequence
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import DataError, TooFewPoints, UsageError
from jointctl.firmware_py.input_file import number_from, parse_json
from jointctl.tools.configuration.conversions import RADPS_PER_UNIT
from jointctl.tools.identification.tables import ForeignFormat, TableFile, read_bytes, read_table

# --- the points, and which of them are used ---

MIN_PER_DIRECTION = 12
LEAST_TORQUE_Nm, LEAST_SHARE = 1e-12, 1e-6  # of a point, absolute and of the greatest, that has a relative error


@dataclass(frozen=True)
class FrictionData:
    """Measured plateaus, sorted by velocity, arrays of shape (N,); `line` is the line in the file."""

    path: Path
    sha256: str
    velocity_radps: np.ndarray  # joint
    motor_torque_Nm: np.ndarray
    line: np.ndarray
    settled: np.ndarray  # bool
    reduction_ratio: float
    torque_constant_NmpA: float | None
    notes: tuple[str, ...] = ()
    recorded_limits: tuple[float, float] | None = None  # torque [Nm], velocity [rad/s] of the joint, from the sidecar

    def direction(self, sign: int) -> np.ndarray:
        """Indices of the usable points of one direction."""
        return np.flatnonzero(self.settled & (sign * self.velocity_radps > 0.0))


def from_table(
    table: TableFile,
    velocity: np.ndarray,
    torque: np.ndarray,
    settled: np.ndarray,
    ratio: float,
    constant: float | None,
) -> FrictionData:
    """Points as the file has them, with their lines: rad/s of the joint, Nm at the motor."""
    return FrictionData(
        table.path, table.sha256, velocity, torque, table.numbered, settled, ratio, constant, table.notes
    )


def tidied(data: FrictionData, *, ordered: bool) -> FrictionData:
    """The points that are used, sorted, with notes on what was done.

    `ordered`: the file is expected to be in order of velocity, so that a note says where it is not.
    """
    notes = list(data.notes)
    cells = np.column_stack([data.velocity_radps, data.motor_torque_Nm])
    _, first = np.unique(cells, axis=0, return_index=True)
    keep = np.zeros(len(cells), bool)
    keep[first] = True
    if not keep.all():
        notes.append(f"{_lines(data.line[~keep])}: exact copy of another line, counted once")
    zero = keep & (data.velocity_radps == 0.0)
    if zero.any():
        notes.append(f"{_lines(data.line[zero])}: zero velocity, where friction is set-valued: not used")
    keep &= ~zero
    never = keep & ~data.settled
    if never.any():
        notes.append(f"{_lines(data.line[never])}: did not settle: not used")
    index = np.flatnonzero(keep)
    if ordered and np.any(np.diff(data.velocity_radps[index]) < 0.0):
        notes.append("the points were not in order of velocity: sorted")
    index = index[np.argsort(data.velocity_radps[index], kind="stable")]
    speeds = data.velocity_radps[index]
    repeats = int(np.count_nonzero(np.diff(speeds) == 0.0))
    if repeats:
        notes.append(f"{repeats} repeated speeds: each kept as a measurement of its own")
    return replace(
        data, velocity_radps=speeds, motor_torque_Nm=data.motor_torque_Nm[index], line=data.line[index],
        settled=data.settled[index], notes=tuple(notes),
    )  # fmt: skip


def relative_errors(errors_Nm: np.ndarray, measured_Nm: np.ndarray) -> np.ndarray:
    """errors / measured, shape (N,); nan where next to nothing was measured, of which no error is a share."""
    least_Nm = max(LEAST_TORQUE_Nm, LEAST_SHARE * float(np.max(np.abs(measured_Nm), initial=0.0)))
    found = np.full(len(errors_Nm), np.nan)
    np.divide(errors_Nm, measured_Nm, out=found, where=np.abs(measured_Nm) >= least_Nm)
    return found


def relative_figures(errors_Nm: np.ndarray, measured_Nm: np.ndarray) -> tuple[float, float, float]:
    """RMS, greatest and mean of the relative errors that there are; nan without any."""
    relative = relative_errors(errors_Nm, measured_Nm)
    relative = relative[np.isfinite(relative)]
    if not len(relative):
        return math.nan, math.nan, math.nan
    return float(np.sqrt(np.mean(relative**2))), float(np.max(np.abs(relative))), float(np.mean(relative))


def _lines(numbers: np.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:8])) + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")
    return f"line{'s' if len(numbers) > 1 else ''} {shown}"


def check_directions(data: FrictionData, both: bool) -> None:
    """`DataError` where too few points are left: in either direction, or in all."""
    counts = {sign: len(data.direction(sign)) for sign in (1, -1)}
    text = f"{counts[1]} usable points at positive and {counts[-1]} at negative velocity"
    if both and min(counts.values()) == 0:
        raise DataError(f"{data.path}: {text}: both directions are needed, each is identified by itself")
    if both and min(counts.values()) < MIN_PER_DIRECTION:
        raise TooFewPoints(f"{data.path}: {text}: at least {MIN_PER_DIRECTION} are needed in each direction")
    if max(counts.values()) == 0:
        raise DataError(f"{data.path}: {text}")


# --- a table with columns of other names ---

SIDES = ("joint", "motor")
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
RAD_PER_UNIT = {"rad": 1.0, "deg": math.pi / 180.0, "turn": math.tau, "count": math.nan}  # count: --counts-per-turn
VELOCITY_UNITS = {**RADPS_PER_UNIT, "turn/s": math.tau, "count/s": math.nan}
Nm_PER_UNIT = {"Nm": 1.0, "Ncm": 1e-2, "mNm": 1e-3}
A_PER_UNIT = {"A": 1.0, "mA": 1e-3}
DEGC_OF_UNIT = {"degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5.0 / 9.0, -160.0 / 9.0)}
_UNIT_NAMES = {  # how else headings write a unit, in lower case
    "°": "deg", "degree": "deg", "degrees": "deg", "grad": "deg", "radian": "rad", "radians": "rad", "°/s": "deg/s",
    "deg/sec": "deg/s", "dps": "deg/s", "rad/sec": "rad/s", "rpm": "r/min", "1/min": "r/min", "u/min": "r/min",
    "min^-1": "r/min", "rev/min": "r/min", "turns": "turn", "rev": "turn", "counts": "count", "sec": "s",
    "seconds": "s", "µs": "us", "n·m": "Nm", "n*m": "Nm", "n m": "Nm", "n.m": "Nm", "nm": "Nm", "mnm": "mNm",
    "ncm": "Ncm", "a": "A", "ma": "mA", "°c": "degC", "c": "degC", "k": "K", "°f": "degF",
}  # fmt: skip
REVERSIBLE = ("position", "velocity", "torque", "load")


def rad_per_unit(given: ForeignFormat, unit: str) -> float:
    """Radians, or rad/s, of the shaft."""
    if unit in ("count", "count/s"):
        assert given.counts_per_turn is not None
        return math.tau / given.counts_per_turn
    return {**RAD_PER_UNIT, **VELOCITY_UNITS}[unit]


def check_given(given: ForeignFormat) -> None:
    """`UsageError` names a flag whose value is not allowed."""
    for flag, value, allowed in (
        ("--velocity-unit", given.velocity_unit, tuple(VELOCITY_UNITS)),
        ("--side", given.side, SIDES),
        ("--torque-side", given.torque_side, SIDES),
        ("--position-side", given.position_side, SIDES),
        ("--position-unit", given.position_unit, tuple(RAD_PER_UNIT)),
        ("--time-unit", given.time_unit, tuple(SECONDS_PER_UNIT)),
        ("--torque-unit", given.torque_unit, tuple(Nm_PER_UNIT)),
        ("--current-unit", given.current_unit, tuple(A_PER_UNIT)),
        ("--temperature-unit", given.temperature_unit, tuple(DEGC_OF_UNIT)),
        *(("--reverse", each, REVERSIBLE) for each in given.reverse or ()),
    ):
        if value is not None and value not in allowed:
            raise UsageError(f"{flag} (={value}) must be one of {', '.join(allowed)}")
    for flag, number, low, high in (
        ("--ratio", given.ratio, 1.0, 1000.0),
        ("--torque-constant", given.torque_constant_NmpA, 1e-6, 100.0),
        ("--counts-per-turn", given.counts_per_turn, 1.0, 2.0**40),
        ("--sample-rate", given.sample_rate_Hz, 1.0, 1e6),
    ):
        if number is not None and not low <= number <= high:
            raise UsageError(f"{flag} (={number:g}) must be in [{low:g}..{high:g}]")
    if given.torque_column and given.current_column:
        raise UsageError("--torque-column and --current-column: give one of them, the friction comes from one")
    if given.time_column and given.sample_rate_Hz:
        raise UsageError("--time-column and --sample-rate: give one of them")
    for unit in (given.position_unit, given.velocity_unit):
        if unit in ("count", "count/s") and given.counts_per_turn is None:
            raise UsageError(f"--counts-per-turn is missing: a unit (={unit}) needs it")


def refuse_unused(given: object, used: Container[str], kind: str) -> None:
    """`UsageError` names an option that was given, by its field, and would not be looked at with data of this kind.

    `given`: a dataclass whose defaults are what was not given, and those in it.
    """
    for name, value in vars(given).items():
        if is_dataclass(value):
            refuse_unused(value, used, kind)
        elif name not in used and value != getattr(type(given)(), name):
            flag = "--" + re.sub(r"_(radps2?|Hz|NmpA|Nm)$", "", name).replace("_", "-")
            raise UsageError(f"{flag} does not apply to {kind}", "leave it away")


OF_SWEEP = "a sweep file, which tells its own columns and units"
_COLUMNS_OF_MOTION = ("position", "load", "temperature")


def refuse_unused_format(given: ForeignFormat, *, timed: bool) -> None:
    """`UsageError` names what was given of a table's columns, and is of a column that is none of them."""
    there = {
        name: getattr(given, f"{name}_column") is not None
        for name in ("velocity", "torque", "current", "position", "load", "temperature", "time")
    }
    used = {"velocity_column", "torque_column", "current_column", "ratio", "delimiter", "where", "side", "torque_side"}
    used |= {f"{name}_unit" for name, given_too in there.items() if given_too}
    if timed:
        used |= {"time_column", "sample_rate_Hz", "motion_column", *(f"{name}_column" for name in _COLUMNS_OF_MOTION)}
        used |= {"position_side"} if there["position"] else set()
    if there["current"] or not timed:
        used.add("torque_constant_NmpA")  # of plateaus it is compared with the configuration's besides
    units = [unit for unit in ("velocity_unit", "position_unit") if unit in used]
    if any(str(getattr(given, unit)).startswith("count") for unit in units):
        used.add("counts_per_turn")
    signed = {*(name for name in ("position", "velocity", "load") if there[name]), "torque"}
    if signed.issuperset(given.reverse or ()):
        used.add("reverse")
    what = "a motion in time" if timed else "plateaus"
    refuse_unused(given, used, f"{what} with the columns that were given")


def require_stated(table: TableFile, given: ForeignFormat, needed: Sequence[tuple[str, object]]) -> None:
    """`UsageError` where what a table does not tell was not given: the torque's column, and each (flag, value)."""
    if not (given.torque_column or given.current_column):
        raise UsageError("--torque-column or --current-column is missing", f"the file has: {', '.join(table.columns)}")
    if given.current_column:
        if given.torque_constant_NmpA is None:
            raise UsageError("--torque-constant is missing: --current-column needs it [Nm/A at the motor]")
        if given.torque_side == "joint":
            raise UsageError("--torque-side (=joint) is for --torque-column: a current gives torque at the motor")
    for flag, value in needed:
        if value is None:
            raise UsageError(f"{flag} is missing: a table of numbers does not tell it", "nothing is guessed")
    if given.torque_column and given.torque_side is None:
        raise UsageError("--torque-side is missing: a table of numbers does not tell it", "motor or joint")


def require_units_of_heading(table: TableFile, given: ForeignFormat) -> None:
    """`DataError` where a unit in brackets behind a column's name is known and another one was given."""
    for flag, column, unit, known in (
        ("--time-unit", given.time_column, given.time_unit, SECONDS_PER_UNIT),
        ("--position-unit", given.position_column, given.position_unit, RAD_PER_UNIT),
        ("--velocity-unit", given.velocity_column, given.velocity_unit, VELOCITY_UNITS),
        ("--torque-unit", given.torque_column, given.torque_unit, Nm_PER_UNIT),
        ("--current-unit", given.current_column, given.current_unit, A_PER_UNIT),
        ("--temperature-unit", given.temperature_column, given.temperature_unit, DEGC_OF_UNIT),
    ):
        stated = table.unit(column) if column else ""
        written = _UNIT_NAMES.get(stated.lower(), stated)
        if written in known and unit is not None and written != unit:
            raise DataError(
                f"{table.path}: {column}: its heading has {stated}, but {flag} (={unit}) says otherwise",
                f"{flag} {written}, or correct the heading",
            )


def chosen_lines(table: TableFile, given: ForeignFormat) -> TableFile:
    """The lines for which each COLUMN=VALUE of `--where` holds, as text or as a number."""
    for rule in given.where or ():
        name, equals, wanted = rule.partition("=")
        if not equals:
            raise UsageError(f"--where (={rule}) must be COLUMN=VALUE")
        texts = table.texts(name.strip())
        wanted = wanted.strip()
        chosen = np.array([text == wanted or _same_number(text, wanted) for text in texts])
        if not chosen.any():
            some = ", ".join(list(dict.fromkeys(texts))[:6])
            raise DataError(f"{table.path}: no line has {name.strip()} = {wanted}", f"there are: {some}")
        table = table.only(chosen)
    return table


def _same_number(text: str, wanted: str) -> bool:
    try:
        return number_from(text) == number_from(wanted)
    except ValueError:
        return False


def velocity_radps(table: TableFile, given: ForeignFormat, *, gaps: bool = False) -> np.ndarray:
    """(N,) of the joint."""
    assert given.velocity_column is not None
    assert given.velocity_unit is not None
    assert given.ratio is not None
    scale = rad_per_unit(given, given.velocity_unit) / (given.ratio if given.side == "motor" else 1.0)
    return table.numbers(given.velocity_column, gaps=gaps) * scale * given.sign("velocity")


def motor_torque_Nm(table: TableFile, given: ForeignFormat, *, gaps: bool = False) -> np.ndarray:
    """(N,) at the motor, from torque or current."""
    assert given.ratio is not None
    if given.current_column:
        assert given.torque_constant_NmpA is not None
        scale = given.torque_constant_NmpA * A_PER_UNIT[given.current_unit]
        return table.numbers(given.current_column, gaps=gaps) * scale * given.sign("torque")
    assert given.torque_column is not None
    scale = Nm_PER_UNIT[given.torque_unit] / (given.ratio if given.torque_side == "joint" else 1.0)
    return table.numbers(given.torque_column, gaps=gaps) * scale * given.sign("torque")


def read_foreign(table: TableFile, given: ForeignFormat) -> FrictionData:
    """Points in our units; `UsageError` where something that a table does not tell was not given."""
    if not given.velocity_column:
        raise UsageError("--velocity-column is missing", f"the file has: {', '.join(table.columns)}")
    stated = [("--velocity-unit", given.velocity_unit), ("--side", given.side), ("--ratio", given.ratio)]
    require_stated(table, given, stated)
    require_units_of_heading(table, given)
    refuse_unused_format(given, timed=False)
    assert given.ratio is not None
    table = chosen_lines(table, given)
    velocity, torque = velocity_radps(table, given), motor_torque_Nm(table, given)
    settled = np.ones(len(velocity), bool)
    return from_table(table, velocity, torque, settled, given.ratio, given.torque_constant_NmpA)


# --- the file of our own sweep, and its sidecar ---

SWEEP_COLUMNS = (
    "velocity_radps", "current_A", "motor_torque_Nm", "velocity_std_radps", "current_std_A", "samples", "settled",
    "position_min_rad", "position_max_rad", "time_s", "temperature_degC", "direction", "pass",
)  # fmt: skip
SIDECAR_FORMAT = "jointctl friction sweep 1"
_SAME_CONSTANT = 0.02  # motor_torque_Nm against current_A times the torque constant, median


def sidecar_contents(reduction_ratio: float, torque_constant_NmpA: float, **more: Any) -> dict[str, Any]:
    """What the sweep writes beside its CSV; `more` is recorded as it is (configuration, drive, versions, time)."""
    return {
        "format": SIDECAR_FORMAT,
        "reduction_ratio": reduction_ratio,
        "torque_constant_NmpA": torque_constant_NmpA,
        "units": {
            "velocity_radps": "joint",
            "motor_torque_Nm": "motor, with the sign of the velocity where it opposes motion",
            "current_A": "of the drive, times torque_constant_NmpA gives motor_torque_Nm",
        },
        **more,
    }


def read_sidecar(path: Path) -> dict[str, Any]:
    beside = path.with_suffix(".json")
    if not beside.exists():
        raise DataError(f"{beside}: missing: the sidecar of the sweep holds the ratio", "or give --ratio")
    try:
        content = parse_json(read_bytes(beside).decode("utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{beside}: not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise DataError(f"{beside}: must be a JSON object with reduction_ratio and torque_constant_NmpA")
    for key, low, high in (("reduction_ratio", 1.0, 1000.0), ("torque_constant_NmpA", 1e-6, 100.0)):
        value = content.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise DataError(f"{beside}: {key} (={value}) must be a number in [{low:g}..{high:g}]")
    return content


def _recorded_limits(beside: Path, sidecar: dict[str, Any]) -> tuple[float, float] | None:
    """Greatest torque and speed of the joint that the sweep was allowed; sidecars of others need not have them."""
    limits = sidecar.get("limits")
    if limits is None:
        return None
    found = []
    for key in ("torque_max_Nm", "velocity_max_radps"):
        value = limits.get(key) if isinstance(limits, dict) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < 1e6:
            raise DataError(f"{beside}: limits.{key} (={value}) must be a number in (0..1e+06)")
        found.append(float(value))
    return found[0], found[1]


def read_sweep(table: TableFile, given: ForeignFormat) -> FrictionData:
    """Points of a sweep and the constants of its sidecar (or `--ratio`); `DataError` where they contradict."""
    refuse_unused(given, ("ratio", "delimiter"), OF_SWEEP)
    if not table.ended:
        # the sweep ends every line, so this one may have lost digits
        raise DataError(f"{table.path}: the last line has no end: the file is cut off", "remove the last line")
    ratio, constant, limits = given.ratio or math.nan, math.nan, None
    if given.ratio is None or table.path.with_suffix(".json").exists():
        sidecar = read_sidecar(table.path)
        ratio, constant = float(sidecar["reduction_ratio"]), float(sidecar["torque_constant_NmpA"])
        limits = _recorded_limits(table.path.with_suffix(".json"), sidecar)
        if given.ratio is not None and abs(given.ratio / ratio - 1.0) > 1e-6:
            raise DataError(
                f"--ratio (={given.ratio:g}) differs from reduction_ratio (={ratio:g}) in the sidecar of {table.path}"
            )
    velocity = table.numbers("velocity_radps")
    torque = table.numbers("motor_torque_Nm")
    settled = np.ones(len(velocity), bool)
    if "settled" in table.columns:
        values = table.numbers("settled")
        for line, value in zip(table.numbered, values, strict=True):
            if value not in (0.0, 1.0):
                raise DataError(f"{table.path}: line {line}: settled (={value:g}) must be 0 or 1")
        settled = values == 1.0
    if "current_A" in table.columns and math.isfinite(constant):
        current = table.numbers("current_A")
        moving = np.abs(current) > 0.2 * np.max(np.abs(current), initial=0.0)
        if np.any(moving):
            found = float(np.median(torque[moving] / current[moving]))
            if not abs(found / constant - 1.0) <= _SAME_CONSTANT:
                raise DataError(
                    f"{table.path}: motor_torque_Nm is {found:.4g} times current_A, but torque_constant_NmpA "
                    f"(={constant:g}) in the sidecar: one of them is wrong"
                )
    data = from_table(table, velocity, torque, settled, ratio, constant if math.isfinite(constant) else None)
    return replace(data, recorded_limits=limits)


def read_friction_data(path: str | Path, given: ForeignFormat | None = None, *, both: bool = True) -> FrictionData:
    """Read and check; `both` asks for enough points in both directions, else one is enough to go on with."""
    path, given = Path(path), given or ForeignFormat()
    check_given(given)
    for flag, of_time in (("--time-column", given.time_column), ("--sample-rate", given.sample_rate_Hz)):
        if of_time is not None:
            raise UsageError(f"{flag} (={of_time}) is for time series, which only `identify` reads")
    if path.suffix.lower() == ".mcap":
        raise UsageError(f"{path}: is a run log, and plateaus of constant speed are needed", "`sweep` measures them")
    table = read_table(path, given.delimiter)
    ours = not given.mapped and "velocity_radps" in table.columns and "motor_torque_Nm" in table.columns
    if ours:
        data = read_sweep(table, given)
    elif given.mapped:
        data = read_foreign(table, given)
    else:
        raise DataError(
            f"{path}: not a sweep of ours: columns velocity_radps and motor_torque_Nm are missing; "
            f"it has {', '.join(table.columns)}",
            "tell --velocity-column and --torque-column or --current-column",
        )
    data = tidied(data, ordered=not ours)
    check_directions(data, both)
    return data
