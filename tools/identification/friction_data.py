"""Friction data: one point for each speed at which friction was measured, and which of them are used.

Points are sorted by speed, so the order of the file does not matter; repeats of a speed are all kept, each a
measurement of its own (averaging would hide their spread); a line that is an exact copy of another one is a mistake of
copying and counts once; a point at zero speed says nothing, since friction is set-valued there; points that never
settled are left out.  All of this is told in `notes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.tools.identification.table_file import TableFile

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


def numbers(table: TableFile, column: str) -> np.ndarray:
    """A column (N,) of finite numbers; `DataError` names the line of anything else."""
    index = table.column(column)
    return np.array([table.number(row, index) for row in table.rows])


def from_table(
    table: TableFile,
    velocity: np.ndarray,
    torque: np.ndarray,
    settled: np.ndarray,
    ratio: float,
    constant: float | None,
) -> FrictionData:
    """Points as the file has them, with their lines: rad/s of the joint, Nm at the motor."""
    line = np.array([n for n, _ in table.rows])
    return FrictionData(table.path, table.sha256, velocity, torque, line, settled, ratio, constant)


def tidied(data: FrictionData, *, ordered: bool) -> FrictionData:
    """The points that are used, sorted, with notes on what was done.

    `ordered`: the file is expected to be in order of velocity, so that it is told where it is not.
    """
    notes = []
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
        notes.append(f"{_lines(data.line[never])}: never settled: not used")
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
        raise DataError(f"{data.path}: {text}: at least {MIN_PER_DIRECTION} are needed in each direction")
    if max(counts.values()) == 0:
        raise DataError(f"{data.path}: {text}")
