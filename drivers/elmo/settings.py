"""What the driver has to know about one serial joint, in the units of the configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

SERIAL = "serial"  # stands for such a line where a CAN bus has the name of its python-can interface


@dataclass(frozen=True)
class ElmoSettings:
    """See the sections [drive], [encoder], [joint] and [limits] of the configuration."""

    port: str
    baud_rate_bitps: int
    echo: bool
    reply_timeout_s: float
    rate_Hz: float
    torque_max_Nm: float  # at the joint
    torque_constant_NmpA: float  # motor torque per ampere as the drive counts amperes
    torque_direction: int
    reduction_ratio: float
    counts_per_turn: int
    encoder_on_motor: bool
    encoder_direction: int
    zero_counts: int
    continuous_current_A: float  # CL[1]
    peak_current_A: float  # PL[1]
    peak_time_s: float  # PL[2]
    velocity_max_radps: float
    position_min_rad: float
    position_max_rad: float
    limit_margin: float  # the drive's own limits lie outside those of the loop by this share
    speed_error_radps: float  # ER[2]
    position_error_rad: float  # ER[3]
    dead_man_s: float
    ramp_radps2: float  # AC, DC, SD of speed mode, at the joint
    mode: Literal["torque", "speed", "auto"] = "torque"  # auto: speed where the drive has it
    product: str | None = None  # VR must contain it
    counts_parameter: str | None = None  # such as "CA[18]": compared with counts_per_turn

    @property
    def torque_NmpA(self) -> float:
        """Joint torque per ampere of TC and IQ, direction included."""
        return self.torque_constant_NmpA * self.reduction_ratio * self.torque_direction

    @property
    def rad_per_count(self) -> float:
        """Joint angle of one count of PX, direction included."""
        turns = self.counts_per_turn * (self.reduction_ratio if self.encoder_on_motor else 1.0)
        return self.encoder_direction * 2.0 * math.pi / turns

    @property
    def max_current_A(self) -> float:
        """The current of `torque_max_Nm`: no TC is greater."""
        return self.torque_max_Nm / abs(self.torque_NmpA)

    @property
    def max_velocity_cps(self) -> int:
        """JV of `velocity_max_radps`: none is greater, and HL[2] and LL[2] lie outside of it."""
        return round(self.velocity_max_radps / abs(self.rad_per_count))

    @property
    def velocity_digits(self) -> int:
        """Digits of the greatest JV."""
        return len(str(self.max_velocity_cps))

    def counts_at(self, position_rad: float) -> int:
        """PX at a joint angle."""
        return round(position_rad / self.rad_per_count) + self.zero_counts
