"""Sessions and constants of a configuration, for tests that are about something else."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.output import Output
from jointctl.tools.session.control import Control, StopSignals
from jointctl.tools.session.plan import TerminalConsent, resolve
from jointctl.tools.session.session import Session


class Terminal(io.StringIO):
    """A stream that is one."""

    def isatty(self) -> bool:
        return True


def output(stream: type[io.StringIO] = io.StringIO, **how: Any) -> tuple[Output, io.StringIO, io.StringIO]:
    """An output, and what is written to it and beside it."""
    out, err = stream(), stream()
    return Output(stdout=out, stderr=err, **how), out, err


def session_of(
    config: Config,
    log: Path,
    display: Callable[[Any], Any] | None = None,
    *,
    control: Control | None = None,
    allow_low_margin: bool = False,
) -> Session:
    """A run that everyone agrees to, in silence."""
    output = Output(quiet=True, stderr=io.StringIO())
    plan = replace(resolve(config, allow_low_margin=allow_low_margin), log_path=log)
    return Session(plan, TerminalConsent(output, assume_yes=True), output, control or Control(StopSignals()), display)


def constants_of(config: Config, *, start_position_rad: float | None = None) -> Any:
    """`axis_constants` of the configured trajectory."""
    return axis_constants(config, trajectory_table(config), start_position_rad=start_position_rad)
