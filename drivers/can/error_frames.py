"""Error frames of SocketCAN in words.

Source: Linux include/uapi/linux/can/error.h.  They are messages of the local controller, not frames on the wire; the
error classes are bits of the identifier, details are in the data.
"""

from __future__ import annotations

TX_TIMEOUT, LOST_ARBITRATION, CONTROLLER, PROTOCOL, TRANSCEIVER, NO_ACK, BUS_OFF, BUS_ERROR, RESTARTED, COUNTERS = (
    1 << bit for bit in range(10)
)
_CLASSES = {
    TX_TIMEOUT: "transmit time-out",
    LOST_ARBITRATION: "arbitration lost",
    TRANSCEIVER: "transceiver",
    NO_ACK: "no acknowledge",
    BUS_OFF: "bus-off",
    BUS_ERROR: "bus error",
    RESTARTED: "restarted after bus-off",
}
_CONTROLLER = (
    "receive buffer overflow", "transmit buffer overflow", "error warning (receive)", "error warning (transmit)",
    "error passive (receive)", "error passive (transmit)", "error active again",
)  # fmt: skip
_PROTOCOL = (
    "single bit", "frame format", "bit stuffing", "dominant bit not sent", "recessive bit not sent", "bus overload",
    "active error announced", "on transmission",
)  # fmt: skip
_OVERFLOWS, _WARNINGS, _PASSIVES, _ACTIVE = 0x03, 0x0C, 0x30, 0x40


def _bits(names: tuple[str, ...], value: int) -> str:
    return ", ".join(name for bit, name in enumerate(names) if value >> bit & 1) or "unspecified"


def error_frame_text(identifier: int, data: bytes) -> str:
    """`error passive (transmit); transmit errors 128, receive errors 0`; `identifier` without or with its flags."""
    data = data.ljust(8, b"\0")
    texts = [name for bit, name in _CLASSES.items() if identifier & bit]
    if identifier & CONTROLLER:
        texts.append(_bits(_CONTROLLER, data[1]))
    if identifier & PROTOCOL:
        texts.append(f"protocol violation ({_bits(_PROTOCOL, data[2])})")
    if identifier & COUNTERS or data[6] or data[7]:
        texts.append(f"transmit errors {data[6]}, receive errors {data[7]}")
    return "; ".join(texts) or "unspecified error"


def trouble(identifier: int, data: bytes) -> str:
    """The worst state that an error frame tells: "bus-off", "error passive", "no acknowledge" and so on; "" if none.

    An error warning, a lost arbitration and a return to error active are no trouble.
    """
    details = data.ljust(8, b"\0")[1]
    if identifier & BUS_OFF:
        return "bus-off"
    if identifier & CONTROLLER and details & _PASSIVES:
        return "error passive"
    if identifier & NO_ACK:
        return "no acknowledge"
    if identifier & TX_TIMEOUT:
        return "transmit time-out"
    if identifier & CONTROLLER and details & _OVERFLOWS:
        return "buffer overflow"
    if identifier & (PROTOCOL | BUS_ERROR):
        return "bus error"
    return ""
