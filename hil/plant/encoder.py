"""The virtual encoder: joint angle to the counts that the drive reports.

Nearest count (a half count either way, no bias), multi-turn, signed, at the joint or at the motor.  Noise is white,
normal, in counts, from a xorshift64 generator in the plant's state, so that a run repeats bit by bit.

Not modelled: eccentricity, interpolation error, sampling delay (the drive model has it), loss of counts.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.plant.records import PlantConstants, PlantState
from jointctl.hil.plant.xorshift import next_state, unit_number


@kernel
def _uniform(s: PlantState) -> float:
    """The next number in [0, 1)."""
    x = next_state(s.noise_state)
    s.noise_state = x  # type: ignore[assignment]
    return unit_number(x)


@kernel
def _normal(s: PlantState) -> float:
    """A standard normal number (Box-Muller, one of the pair)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - _uniform(s)))
    return radius * math.cos(2.0 * math.pi * _uniform(s))


@kernel
def shaft_position_rad(c: PlantConstants, s: PlantState) -> float:
    """Joint angle as the encoder sees it, its present faults included."""
    position_rad = s.motor_position_rad if c.encoder_motor_side != 0 else s.joint_position_rad
    if s.encoder_stuck != 0:
        return s.encoder_stuck_rad
    if s.encoder_reversed != 0:
        position_rad = 2.0 * s.encoder_pivot_rad - position_rad
    return position_rad + s.encoder_error_rad


@kernel
def encoder_counts(c: PlantConstants, s: PlantState) -> int:
    """Position as the drive reports it [counts].  With noise on, every call draws anew: call it once a sample."""
    counts = shaft_position_rad(c, s) * c.counts_prad + c.encoder_offset_counts
    if c.encoder_noise_counts > 0.0:
        counts += c.encoder_noise_counts * _normal(s)
    return math.floor(counts + 0.5)
