"""The file of our own sweep: a CSV and, beside it, a JSON sidecar with the joint's constants.

Columns of the CSV (joint speed, motor torque), one plateau a line, in the order measured:

    velocity_radps,current_A,motor_torque_Nm,velocity_std_radps,current_std_A,samples,settled,position_min_rad,
    position_max_rad,time_s,temperature_degC,direction,pass

settled is 1 if the mean's confidence interval was met before the time limit, direction is 1 or -1, pass counts repeats
from 0, temperature_degC may be empty.  Beside it lies a JSON file of the same stem with at least reduction_ratio and
torque_constant_NmpA, and, if known, limits (torque_max_Nm, velocity_max_radps of the joint); both signs are such that
friction opposes motion (torque and velocity have the same sign).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.input_file import parse_json
from jointctl.tools.identification.foreign_table import ForeignFormat
from jointctl.tools.identification.friction_data import FrictionData, from_table, numbers
from jointctl.tools.identification.table_file import TableFile, read_bytes

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


def _sidecar(path: Path) -> dict[str, Any]:
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


def read_sweep(table: TableFile, told: ForeignFormat) -> FrictionData:
    """Points of a sweep and the constants of its sidecar (or `--ratio`); `DataError` where they contradict."""
    for flag, value in (("--velocity-unit", told.velocity_unit), ("--side", told.side), ("--torque-side",
                        told.torque_side), ("--torque-constant", told.torque_constant_NmpA)):  # fmt: skip
        if value is not None:
            raise UsageError(f"{flag} (={value}) is for tables with mapped columns: a sweep file tells its own units")
    if not table.ended:
        # the sweep ends every line, so this one may have lost digits
        raise DataError(f"{table.path}: the last line has no end: the file is cut off", "remove the last line")
    ratio, constant, limits = told.ratio or math.nan, math.nan, None
    if told.ratio is None or table.path.with_suffix(".json").exists():
        sidecar = _sidecar(table.path)
        ratio, constant = float(sidecar["reduction_ratio"]), float(sidecar["torque_constant_NmpA"])
        limits = _recorded_limits(table.path.with_suffix(".json"), sidecar)
        if told.ratio is not None and abs(told.ratio / ratio - 1.0) > 1e-6:
            raise DataError(
                f"--ratio (={told.ratio:g}) differs from reduction_ratio (={ratio:g}) in the sidecar of {table.path}"
            )
    velocity = numbers(table, "velocity_radps")
    torque = numbers(table, "motor_torque_Nm")
    settled = np.ones(len(velocity), bool)
    if "settled" in table.columns:
        values = numbers(table, "settled")
        for (line, _), value in zip(table.rows, values, strict=True):
            if value not in (0.0, 1.0):
                raise DataError(f"{table.path}: line {line}: settled (={value:g}) must be 0 or 1")
        settled = values == 1.0
    if "current_A" in table.columns and math.isfinite(constant):
        current = numbers(table, "current_A")
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
