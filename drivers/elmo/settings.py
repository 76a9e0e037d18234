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
        return len(str(self.max_velocity_cps))

    def counts_at(self, position_rad: float) -> int:
        """PX at a joint angle."""
        return round(position_rad / self.rad_per_count) + self.zero_counts


# --- How many characters a cycle has on the line, and what rate the line carries ---
# 8N1: ten bits a character.  The characters of both directions are added up although a line is full duplex: a drive
# answers after it has heard, and the second command of a cycle waits for the answer to the first.  That is cautious by
# about a third; what the drive itself needs to answer is unknown before it is measured.


BITS_PER_CHARACTER = 10
_TC = 11  # TC=-ddd.ddd, its CR included
_COMMANDS = (3, _TC, 3)  # PX, TC, SR; each with its CR
_REPLIES = (12, 1, 10)  # -dddddddddd; and ; and up to nine digits of SR
_BG, _BG_REPLY = 3, 1
LARGEST_SHARE = 0.9  # of a period that the measured exchange may take


def cycle_characters(echo: bool, velocity_digits: int = 0) -> int:
    """Characters of one cycle at worst, both directions; echo counts every character of a command twice.

    `velocity_digits`: of the greatest JV, for speed mode (JV and BG instead of TC); 0 = torque mode.
    """
    commands, replies = sum(_COMMANDS), sum(_REPLIES)
    if velocity_digits:
        commands += 5 + velocity_digits + _BG - _TC  # JV=-d..d and its CR, and BG, in the place of TC
        replies += _BG_REPLY
    return commands * (2 if echo else 1) + replies


def highest_rate_Hz(baud_rate_bitps: int, echo: bool, velocity_digits: int = 0) -> float:
    """The rate at which the characters of a cycle take all of its time."""
    return baud_rate_bitps / BITS_PER_CHARACTER / cycle_characters(echo, velocity_digits)


def command_time_s(baud_rate_bitps: int) -> float:
    """Time of a torque command on the line."""
    return _TC * BITS_PER_CHARACTER / baud_rate_bitps


@dataclass(frozen=True)
class MeasuredExchange:
    """What `measure` found with the motor off."""

    cycle_s: float  # of a whole exchange, lower quartile: what line and drive need; a busy PC only adds to it
    worst_cycle_s: float
    loop_delay_s: float  # position asked for to torque command taken; ninth decile

    @property
    def highest_rate_Hz(self) -> float:
        """What this line carries with the reserve of `LARGEST_SHARE`."""
        return LARGEST_SHARE / self.cycle_s


def measured_exchange(
    position_s: list[float], rest_s: list[float], baud_rate_bitps: int, echo: bool, velocity_digits: int = 0
) -> MeasuredExchange:
    """From the times of the exchanges PX and (TC or JV, SR) without values, one of each a cycle.

    TC and JV were asked without a value, because a drive that is off refuses TC: the missing characters are added,
    and those of BG, which is not said while nothing may move and goes out in one write with JV.
    """
    asked = sum(_COMMANDS) - _TC + 3
    missing = cycle_characters(echo, velocity_digits) - asked * (2 if echo else 1) - sum(_REPLIES)
    value_s = missing * BITS_PER_CHARACTER / baud_rate_bitps
    cycles = sorted(p + r + value_s for p, r in zip(position_s, rest_s, strict=True))
    late = sorted(position_s)[min(len(position_s) - 1, (9 * len(position_s)) // 10)]
    command_s = (missing // (2 if echo else 1) + 3) * BITS_PER_CHARACTER / baud_rate_bitps
    return MeasuredExchange(cycles[len(cycles) // 4], cycles[-1], late + command_s)
