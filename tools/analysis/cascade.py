"""Margins of the loops that a drive closes itself (CSP, CSV), where the configuration gives its gains.

    velocity loop   Lv = (Kv + Ki/s) / (J s) e^(-s Tv) / (1 + s Tl)   PI, Tv = 1.5 periods of the drive, Tl current lag
    position loop   Lp = Kp/s  Lv / (1 + Lv)  e^(-s Tp)               P; CSP: Tp = 0, the drive computes both at once
                                                                      CSV: it is closed on the PC, Tp is our delay

At the joint, rigid, without friction (which only adds damping) and without the offsets (which are outside the loops).
Not modelled: the drive's filters and its estimation of the velocity, a reducer that is not rigid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jointctl.drivers.errors import MarginError
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.configuration.canopen import Cascade, canopen_section
from jointctl.tools.configuration.config import Config

_LOWEST_radps, _POINTS = 1e-2, 20_000
SAMPLES_LATE = 1.5  # of a sampled loop: one to compute, half for holding


@dataclass(frozen=True)
class LoopMargin:
    """Of one loop of the cascade, closed around the inner ones."""

    name: str
    phase_margin_deg: float
    crossover_Hz: float
    gain_margin_up: float  # inf: no gain makes it unstable

    @property
    def stable(self) -> bool:
        return self.phase_margin_deg > 0.0 and self.gain_margin_up > 1.0


def _margin(name: str, omega: np.ndarray, response: np.ndarray) -> LoopMargin:
    """The worst crossover, and the gain at the first crossing of -180 deg beyond the last one."""
    size, phase_deg = np.abs(response), np.degrees(np.unwrap(np.angle(response)))
    phase_deg -= 360.0 * np.round((phase_deg[0] + 135.0) / 360.0)  # it begins between -90 and -180 deg
    crossings = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    if not len(crossings):
        return LoopMargin(name, math.nan, math.nan, math.nan)
    worst = crossings[np.argmin(phase_deg[crossings])]
    beyond = crossings[-1] + np.flatnonzero(phase_deg[crossings[-1] :] <= -180.0)
    gain = 1.0 / float(size[beyond[0]]) if len(beyond) else math.inf
    return LoopMargin(name, 180.0 + float(phase_deg[worst]), float(omega[worst]) / math.tau, gain)


def cascade_of(config: Config) -> Cascade:
    """[drive.cascade] of a configuration whose drive closes its own loop."""
    cascade = canopen_section(config).cascade
    assert cascade is not None
    return cascade


def cascade_margins(config: Config, delay_s: float) -> list[LoopMargin]:
    """Of the loops whose gains are known, inner one first; `delay_s` is that of the loop on the PC."""
    cascade, kind = cascade_of(config), config.drive.own_loop()
    omega = np.geomspace(_LOWEST_radps, math.pi * cascade.loop_rate_Hz, _POINTS)
    s = 1j * omega
    drive_s = SAMPLES_LATE / cascade.loop_rate_Hz
    late_s = 0.0 if kind is CommandKind.POSITION else delay_s + 0.5 / config.loop.rate_Hz
    found, closed = [], np.ones_like(s)
    if cascade.velocity_gain_Nmspr is not None and cascade.velocity_integral_Nmprad is not None:
        gain = cascade.velocity_gain_Nmspr + cascade.velocity_integral_Nmprad / s
        lag = np.exp(-s * drive_s) / (1.0 + s * config.margin.current_lag_s)
        velocity = gain / (config.joint.inertia_kgm2 * s) * lag
        found.append(_margin("velocity loop", omega, velocity))
        closed = velocity / (1.0 + velocity)
    elif kind is CommandKind.POSITION:
        return []  # nothing is known of what the position loop is closed around
    if cascade.position_gain_ps is not None:
        position = cascade.position_gain_ps / s * closed * np.exp(-s * late_s)
        found.append(_margin("position loop", omega, position))
    return found


def cascade_unknowns(config: Config) -> list[str]:
    """What the figures leave out, in words."""
    cascade, found = cascade_of(config), []
    if cascade.velocity_gain_Nmspr is None:
        found.append("the drive's velocity loop: drive.cascade.velocity_gain_Nmspr and velocity_integral_Nmprad")
    if cascade.position_gain_ps is None:
        found.append("the drive's position loop: drive.cascade.position_gain_ps")
    return [*found, "the drive's filters, its estimation of the velocity, and a reducer that is not rigid"]


def require_cascade(config: Config, delay_s: float, *, allow_low_margin: bool = False) -> list[LoopMargin]:
    """`cascade_margins`; `MarginError` where one is below the minimum.  Gains that are not given are not judged."""
    found, minimum_deg = cascade_margins(config, delay_s), config.margin.min_phase_margin_deg
    for loop in found:
        enough = loop.stable and loop.phase_margin_deg >= minimum_deg
        if not enough and not (loop.stable and allow_low_margin):
            raise MarginError(
                f"drive.mode (={canopen_section(config).mode}): the phase margin of the {loop.name} "
                f"(={loop.phase_margin_deg:.1f} deg{'' if loop.stable else ', unstable'}) must be at least "
                f"{minimum_deg:g} deg",
                "correct the gains in [drive.cascade], and those of the drive with its maker's software",
            )
    return found


def cascade_text(config: Config, delay_s: float, *, allow_low_margin: bool = False) -> str:
    """For a run, before enabling; as `require_cascade`."""
    found = require_cascade(config, delay_s, allow_low_margin=allow_low_margin)
    if not found:
        return "the drive closes its own loops, whose gains are not given"
    return ", ".join(f"{loop.name} with {loop.phase_margin_deg:.0f} deg phase margin" for loop in found)
