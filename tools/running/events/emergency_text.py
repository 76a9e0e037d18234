"""Error codes of CANopen drives (EMCY, object 603Fh) in words.

Source: CiA 301 (classes), CiA 402 (codes), and the codes of the Elmo family from the project's facts sheet.  A code
that is not listed is told by its class: the upper byte, else the upper digit.
"""

from __future__ import annotations

_CODES = {
    0x2310: "continuous overcurrent",
    0x2311: "current too high or feedback (maker's meaning differs)",
    0x2320: "short circuit or earth leakage at the output",
    0x2340: "short circuit",
    0x3110: "mains overvoltage",
    0x3120: "undervoltage",
    0x3130: "phase lost",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x3310: "overvoltage",
    0x4210: "device too hot",
    0x4310: "drive too hot",
    0x5441: "inhibit input active",
    0x5442: "abort input active",
    0x6300: "RPDO does not fit its mapping",
    0x7121: "motor blocked",
    0x7300: "feedback sensor",
    0x7305: "incremental sensor 1",
    0x7306: "commutation or incremental sensor 2",
    0x7380: "Hall sensors",
    0x7382: "commutation",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN error passive",
    0x8130: "heartbeat lost",
    0x8140: "recovered from bus-off",
    0x8150: "identifier collision",
    0x8210: "PDO too short",
    0x8220: "PDO too long",
    0x8250: "RPDO timeout",
    0x8311: "peak current exceeded",
    0x8480: "speed tracking error",
    0x8481: "overspeed",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8680: "position limit",
    0x8700: "SYNC lost",
    0xFF10: "cannot start the motor",
    0xFF20: "safe torque off (STO)",
}
_CLASSES = {
    0x1000: "generic error",
    0x2000: "current",
    0x3000: "voltage",
    0x4000: "temperature",
    0x5000: "device hardware",
    0x6000: "device software",
    0x7000: "additional modules",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8200: "protocol",
    0x9000: "external error",
    0xF000: "additional functions",
    0xFF00: "maker's own",
}


def emergency_text(code: int) -> str:
    """`8130h, heartbeat lost`; the class for a code that is not listed."""
    name = _CODES.get(code) or _CLASSES.get(code & 0xFF00) or _CLASSES.get(code & 0xF000) or "not in the list"
    return f"{code:04X}h, {name}"
