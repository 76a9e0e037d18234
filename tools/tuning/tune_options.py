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


AS_IT_FITS = ResponseOptions()


@dataclass(frozen=True)
class TuneOptions:
    """What `tune` may do, and what it is after."""

    law: Annotated[str, typer.Option("--law", help="paper, precise, two_encoders, or auto: what the joint allows")] = (
        "auto"
    )
    objective: Annotated[str, typer.Option("--objective", help="tracking, settling or quiet")] = "tracking"
    torque_Nm: Annotated[
        float | None,
        typer.Option("--torque", metavar="NM", help="at the joint at most, in every step (limits.torque_max_Nm)"),
    ] = None
    refine: Annotated[
        bool, typer.Option("--refine", help="then a few runs with other gains of the same margins; the best stays")
    ] = False
    resume: Annotated[bool, typer.Option("--resume", help="go on after the last step that was done")] = False
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False


TUNE_ALL = TuneOptions()
