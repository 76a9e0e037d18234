"""`jointctl check` on a serial line: the rate that the baud rate allows, and gains for a rate that it does carry."""

from __future__ import annotations

import math
from dataclasses import replace

from jointctl.drivers.elmo.line_budget import LARGEST_SHARE, highest_rate_Hz
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.analysis.linear_loop import LoopSettings
from jointctl.tools.analysis.loop_settings import loop_settings
from jointctl.tools.analysis.margin_gate import meets, remedies
from jointctl.tools.analysis.margins import margins
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo_settings import elmo_section, serial_line_share

HIGHEST_CUTOFF = 0.48  # of the rate; the configuration allows less than half


def line_text(config: Config) -> str:
    """What the line carries, in words."""
    drive = elmo_section(config)
    highest = highest_rate_Hz(drive.baud_rate_bitps, drive.echo)
    return f"{serial_line_share(config):.0%} of the line; up to {highest:.0f} Hz at {drive.baud_rate_bitps} baud"


def refuse_rate(config: Config) -> None:
    """`ConfigurationError` if the line does not carry loop.rate_Hz; its hint names a rate, and gains, that it does."""
    try:
        serial_line_share(config)
    except ConfigurationError as error:
        raise ConfigurationError(error.message, _advice(config)) from None


def _advice(config: Config) -> str:
    """The rate with the reserve that is kept for the measured line, the cut-off that it allows, and gains."""
    drive = elmo_section(config)
    rate_Hz = math.floor(LARGEST_SHARE * highest_rate_Hz(drive.baud_rate_bitps, drive.echo))
    minimum_deg = config.margin.min_phase_margin_deg
    settings, _ = loop_settings(config, 1.0 / rate_Hz)
    cutoff_Hz = min(settings.cutoff_Hz, float(f"{HIGHEST_CUTOFF * rate_Hz:.2g}"))
    settings = replace(settings, period_s=1.0 / rate_Hz, cutoff_Hz=cutoff_Hz)
    changed = f"loop.rate_Hz = {rate_Hz}" if cutoff_Hz == config.control.velocity_cutoff_Hz else (
        f"loop.rate_Hz = {rate_Hz} and control.velocity_cutoff_Hz = {cutoff_Hz:g}"
    )  # fmt: skip
    return f"with {changed} {_gains(settings, minimum_deg)}; or a higher baud rate, or drive.echo = false"


def _gains(settings: LoopSettings, minimum_deg: float) -> str:
    found = margins(settings)
    if meets(found, minimum_deg):
        return f"the gains keep {found.phase_margin_deg:.0f} deg"
    changes = remedies(settings, minimum_deg)
    if not changes:
        return "the gains must be lowered: kp, kv and q together"
    return f"the gains need {changes[-1].text}"
