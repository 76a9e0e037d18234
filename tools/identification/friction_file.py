"""Reading a file of friction data: our own sweep, or a table of somebody else's."""

from __future__ import annotations

from pathlib import Path

from jointctl.drivers.errors import DataError
from jointctl.tools.identification.foreign_table import ForeignFormat, check_told, read_foreign
from jointctl.tools.identification.friction_data import FrictionData, check_directions, tidied
from jointctl.tools.identification.sweep_file import read_sweep
from jointctl.tools.identification.table_file import read_table


def read_friction_data(path: str | Path, told: ForeignFormat | None = None, *, both: bool = True) -> FrictionData:
    """Read and check; `both` asks for enough points in both directions, else one is enough to go on with."""
    path, told = Path(path), told or ForeignFormat()
    check_told(told)
    table = read_table(path, told.delimiter)
    ours = not told.mapped and "velocity_radps" in table.columns and "motor_torque_Nm" in table.columns
    if ours:
        data = read_sweep(table, told)
    elif told.mapped:
        data = read_foreign(table, told)
    else:
        raise DataError(
            f"{path}: not a sweep of ours: columns velocity_radps and motor_torque_Nm are missing; "
            f"it has {', '.join(table.columns)}",
            "tell --velocity-column and --torque-column or --current-column",
        )
    data = tidied(data, ordered=not ours)
    check_directions(data, both)
    return data
