"""Whether gains may be changed to others while the joint moves: the same gate as before enabling, on the whole way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from jointctl.drivers.errors import ConfigurationError, MarginError
from jointctl.tools.analysis.loop_settings import loop_settings
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.analysis.margins import phase_margin_deg
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import Config

STEPS = 8  # of the straight line from the gains in force to the new ones


def with_gains(config: Config, gains: Mapping[str, float]) -> Config:
    """The configuration as if it had these numbers in [control]."""
    return config.model_copy(update={"control": config.control.model_copy(update=dict(gains))})


def require_change(
    config: Config, before: Mapping[str, float], after: Mapping[str, float], delay_s: float, *, allow_low_margin: bool
) -> float:
    """Phase margin [deg] with the new gains; `ConfigurationError` or `MarginError` tells why they are refused.

    The gains change along a straight line, slowly against the loop, so that its points are looked at one by one.
    """
    end = with_gains(config, after)
    problems = problems_between_sections(end)
    if problems:
        raise ConfigurationError(problems[0])
    found = require_margin(end, delay_s, allow_low_margin=allow_low_margin)
    least_deg = 1e-6 if allow_low_margin else config.margin.min_phase_margin_deg
    for step in range(1, STEPS):
        share = step / STEPS
        between = {name: value + share * (after[name] - value) for name, value in before.items()}
        margin_deg = phase_margin_deg(loop_settings(with_gains(config, between), delay_s)[0])
        if not margin_deg >= least_deg:
            raise MarginError(
                f"on the way to these gains the phase margin would be {margin_deg:.1f} deg, below {least_deg:g} deg",
                "change one gain at a time",
            )
    return found.phase_margin_deg


def checked_gains(
    given: Mapping[str, Any], now: Mapping[str, float], low: Mapping[str, float], high: Mapping[str, float]
) -> dict[str, float]:
    """All gains, the given ones replaced; `ConfigurationError` for a name, type or value that is not allowed."""
    after = dict(now)
    for name, value in given.items():
        if name not in after:
            raise ConfigurationError(f"{str(name)[:40]!r} is no gain that can be changed: {', '.join(after)}")
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not number or not low[name] <= value <= high[name]:
            shown = f"{value:g}" if isinstance(value, float) else str(value)[:40]
            raise ConfigurationError(
                f"control.{name} (={shown}) must be in [{low[name]:g}..{high[name]:g}], from live.gain_factor"
            )
        after[name] = float(value)
    return after
