"""What the user asks of `response` and `tune`: `--help` loads this, and nothing that takes its time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

LEGS = 12


@dataclass(frozen=True)
class ResponseOptions:
    """None = what fits the joint."""

    torque_Nm: Annotated[
        float | None,
        typer.Option("--torque", metavar="NM", help="at the joint at most, friction included (limits.torque_max_Nm)"),
    ] = None
    legs: Annotated[int, typer.Option("--legs", help="of the triangle, each with one period of the multisine")] = LEGS
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False
