"""What the virtual Elmo drive knows of its language: error codes, the shape of a command, where a setting is kept."""

from __future__ import annotations

import re
from dataclasses import dataclass

from jointctl.hil.elmo.motor import UM_POSITION

BAD_COMMAND, BAD_INDEX, NOT_IN_THIS_MODE, SYNTAX, OUT_OF_RANGE = 2, 3, 12, 19, 21
NOT_ASSIGNABLE, OUT_OF_LIMIT, MOTOR_MUST_BE_OFF, MOTOR_MUST_BE_ON, BAD_UNIT_MODE = 23, 28, 57, 58, 60
AMPLIFIER_NOT_READY = 66
COMMAND = re.compile(r"([A-Z]{2})(?:\[(\d{1,4})\])?(?:=(.*))?", re.ASCII)
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
MOTOR_FIELDS = {
    ("CL", 1): "continuous_A", ("PL", 1): "peak_A", ("PL", 2): "peak_s",
    ("HL", 2): "speed_high_cps", ("LL", 2): "speed_low_cps",
    ("HL", 3): "position_high_counts", ("LL", 3): "position_low_counts",
    ("ER", 2): "speed_error_cps", ("ER", 3): "position_error_counts",
    ("SP", 0): "profile_cps", ("AC", 0): "acceleration_cps2", ("DC", 0): "deceleration_cps2",
    ("SD", 0): "stop_deceleration_cps2",
}  # fmt: skip
WHOLE = frozenset(("HL", "LL", "ER", "SP", "AC", "DC", "SD"))
INDEXED = frozenset(("CL", "PL", "HL", "LL", "ER", "VL", "VH", "CA"))


class RefusedCommandError(Exception):
    """Carries the error code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True, kw_only=True)
class ElmoDeviceSettings:
    """The virtual drive itself; what the joint is like is in the plant."""

    version: str = "Whistle 1.01.06.22 31Oct2006"
    maximum_current_A: float = 20.0  # MC
    counts_per_turn: int = 524288  # CA[18]
    current_sign: int = 1  # -1: positive current drives the counts down
    power_on_unit_mode: int = UM_POSITION
