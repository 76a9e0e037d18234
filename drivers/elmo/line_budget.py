"""How many characters a cycle has on a serial line, and what rate a line carries.

8N1: ten bits a character.  The characters of both directions are added up although a line is full duplex: a drive
answers after it has heard, and the second command of a cycle waits for the answer to the first.  That is cautious by
about a third; what the drive itself needs to answer is unknown before it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

BITS_PER_CHARACTER = 10
_TC = 11  # TC=-ddd.ddd, its CR included
_COMMANDS = (3, _TC, 3)  # PX, TC, SR; each with its CR
_REPLIES = (12, 1, 10)  # -dddddddddd; and ; and up to nine digits of SR
_BG, _BG_REPLY = 3, 1
LARGEST_SHARE = 0.9  # of a period that the measured exchange may take


def _jog_characters(velocity_digits: int) -> int:
    """JV=-d..d and its CR."""
    return 5 + velocity_digits


def cycle_characters(echo: bool, velocity_digits: int = 0) -> int:
    """Characters of one cycle at worst, both directions; echo counts every character of a command twice.

    `velocity_digits`: of the greatest JV, for speed mode (JV and BG instead of TC); 0 = torque mode.
    """
    commands, replies = sum(_COMMANDS), sum(_REPLIES)
    if velocity_digits:
        commands += _jog_characters(velocity_digits) + _BG - _TC
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
