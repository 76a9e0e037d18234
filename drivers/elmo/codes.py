"""The numbers of an Elmo drive: error codes (EC), motor fault (MF), status register (SR), unit modes (UM) in words.

Source: the command reference of the drive family as far as two public drivers and the project's facts sheet state it.
A code that is not listed is shown as its number: the list is not complete.
"""

from __future__ import annotations

from enum import IntEnum

# the characters of the ASCII interpreter's language, for kernels, which handle bytes
CR, SEMICOLON, QUESTION_MARK = 0x0D, 0x3B, 0x3F
PLUS, MINUS, POINT, EQUALS = 0x2B, 0x2D, 0x2E, 0x3D
ZERO, NINE = 0x30, 0x39

# EC: why the last command was refused
ERROR_CODES: dict[int, str] = {
    2: "bad command",
    3: "bad index",
    12: "not available in this unit mode",
    19: "syntax error",
    21: "operand out of range",
    23: "command cannot be assigned",
    28: "out of limit",
    51: "inhibit or abort input active",
    57: "motor must be off",
    58: "motor must be on",
    60: "bad unit mode",
    66: "amplifier not ready",
    168: "speed too large to start the motor",
}
MOTOR_MUST_BE_ON = 58

# MF: why the motor was switched off; single bits, and one field of four bits for the amplifier
MOTOR_FAULT_BITS: dict[int, str] = {
    0x1: "feedback",
    0x2: "commutation",
    0x4: "Hall sensors",
    0x8: "peak current exceeded",
    0x10: "inhibit input",
    0x80: "speed tracking error (ER[2])",
    0x100: "position tracking error (ER[3])",
    0x800: "heartbeat lost",
    0x20000: "overspeed (HL[2], LL[2])",
    0x200000: "motor stuck",
    0x400000: "position limit (HL[3], LL[3])",
}
AMPLIFIER_FIELD = 0xF000
AMPLIFIER_FAULTS: dict[int, str] = {
    0x3: "undervoltage",
    0x5: "overvoltage",
    0x7: "safe torque off (STO)",
    0xB: "short circuit",
    0xD: "overtemperature",
}

# SR: fields of the status register
AMPLIFIER_MASK = 0xF
SERVO_ON = 1 << 4
FAULT_LATCHED = 1 << 6
UNIT_MODE_SHIFT = 7
UNIT_MODE_MASK = 0x7
CURRENT_LIMITED = 1 << 13


class UnitMode(IntEnum):
    """UM; only to be changed with the motor off."""

    TORQUE = 1
    SPEED = 2
    POSITION = 5


def error_text(code: int) -> str:
    """`EC 21 (operand out of range)`."""
    return f"EC {code} ({ERROR_CODES.get(code, 'not in the list')})"


def motor_fault_names(fault: int) -> list[str]:
    """Every cause in an MF value; empty for 0."""
    names = [name for bit, name in MOTOR_FAULT_BITS.items() if fault & bit]
    field = (fault & AMPLIFIER_FIELD) >> 12
    if field:
        names.append(AMPLIFIER_FAULTS.get(field, f"amplifier code {field:X}h"))
    rest = fault & ~(AMPLIFIER_FIELD | sum(MOTOR_FAULT_BITS))
    if rest:
        names.append(f"unknown bits {rest:X}h")
    return names


def motor_fault_text(fault: int) -> str:
    """`MF 20000h (overspeed (HL[2], LL[2]))`; `no motor fault` for 0."""
    if fault == 0:
        return "no motor fault"
    return f"MF {fault:X}h ({', '.join(motor_fault_names(fault))})"


def status_text(status: int) -> str:
    """SR in words: servo, unit mode, and what is amiss."""
    parts = ["servo on" if status & SERVO_ON else "servo off", f"UM {unit_mode(status)}"]
    amplifier = status & AMPLIFIER_MASK
    if amplifier:
        parts.append(AMPLIFIER_FAULTS.get(amplifier, f"amplifier code {amplifier:X}h"))
    if status & FAULT_LATCHED:
        parts.append("fault latched")
    if status & CURRENT_LIMITED:
        parts.append("current limited")
    return ", ".join(parts)


def unit_mode(status: int) -> int:
    """UM as SR shows it."""
    return status >> UNIT_MODE_SHIFT & UNIT_MODE_MASK


def motor_off_cause(status: int, fault: int) -> str:
    """Why a drive is off that should be on; the amplifier field of SR counts where MF says nothing."""
    amplifier = status & AMPLIFIER_MASK
    if fault == 0 and amplifier:
        return AMPLIFIER_FAULTS.get(amplifier, f"amplifier code {amplifier:X}h")
    return motor_fault_text(fault)
