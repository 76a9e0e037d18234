"""Other people's tables of friction: columns, units and sides as the user tells them; nothing is guessed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jointctl.drivers.errors import UsageError
from jointctl.tools.configuration.conversions import RADPS_PER_UNIT
from jointctl.tools.identification.friction_data import FrictionData, from_table, numbers
from jointctl.tools.identification.table_file import TableFile

SIDES = ("joint", "motor")


@dataclass(frozen=True)
class ForeignFormat:
    """How to read a table that is not ours; None = not told."""

    velocity_column: str | None = None
    torque_column: str | None = None
    current_column: str | None = None
    velocity_unit: str | None = None
    side: str | None = None  # of the velocity
    torque_side: str | None = None
    ratio: float | None = None
    torque_constant_NmpA: float | None = None
    delimiter: str = "auto"

    @property
    def mapped(self) -> bool:
        return bool(self.velocity_column or self.torque_column or self.current_column)


def check_told(told: ForeignFormat) -> None:
    """`UsageError` names a flag whose value is not allowed."""
    for flag, value, allowed in (
        ("--velocity-unit", told.velocity_unit, tuple(RADPS_PER_UNIT)),
        ("--side", told.side, SIDES),
        ("--torque-side", told.torque_side, SIDES),
    ):
        if value is not None and value not in allowed:
            raise UsageError(f"{flag} (={value}) must be one of {', '.join(allowed)}")
    for flag, number, low, high in (
        ("--ratio", told.ratio, 1.0, 1000.0),
        ("--torque-constant", told.torque_constant_NmpA, 1e-6, 100.0),
    ):
        if number is not None and not low <= number <= high:
            raise UsageError(f"{flag} (={number:g}) must be in [{low:g}..{high:g}]")
    if told.torque_column and told.current_column:
        raise UsageError("--torque-column and --current-column: give one of them, the friction comes from one")


def read_foreign(table: TableFile, told: ForeignFormat) -> FrictionData:
    """Points in our units; `UsageError` where something that a table does not tell was not told."""
    if not told.velocity_column:
        raise UsageError("--velocity-column is missing", f"the file has: {', '.join(table.columns)}")
    if not (told.torque_column or told.current_column):
        raise UsageError("--torque-column or --current-column is missing", f"the file has: {', '.join(table.columns)}")
    for flag, value in (("--velocity-unit", told.velocity_unit), ("--side", told.side), ("--ratio", told.ratio)):
        if value is None:
            raise UsageError(f"{flag} is missing: a table of numbers does not tell it", "nothing is guessed")
    assert told.velocity_unit is not None
    assert told.ratio is not None
    scale = RADPS_PER_UNIT[told.velocity_unit] / (told.ratio if told.side == "motor" else 1.0)
    velocity = numbers(table, told.velocity_column) * scale
    if told.current_column:
        if told.torque_constant_NmpA is None:
            raise UsageError("--torque-constant is missing: --current-column needs it [Nm/A at the motor]")
        if told.torque_side == "joint":
            raise UsageError("--torque-side (=joint) is for --torque-column: a current gives torque at the motor")
        torque = numbers(table, told.current_column) * told.torque_constant_NmpA
    else:
        assert told.torque_column is not None
        if told.torque_side is None:
            raise UsageError("--torque-side is missing: a table of numbers does not tell it", "motor or joint")
        torque = numbers(table, told.torque_column) / (told.ratio if told.torque_side == "joint" else 1.0)
    settled = np.ones(len(velocity), bool)
    return from_table(table, velocity, torque, settled, told.ratio, told.torque_constant_NmpA)
