"""Codes and bits of CiA 301 and CiA 402 in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from jointctl.drivers.canopen.cia402 import SUPPORTED_MODE_BIT, Mode, state_text
from jointctl.drivers.canopen.identifiers import LAST_SYNCHRONOUS, NmtCommand, NmtState

# CiA 402-2, 6041: bits that say more than the state
_STATUS_BITS = {
    4: "voltage enabled", 7: "warning", 9: "remote", 10: "target reached", 11: "internal limit active",
    12: "mode bit 12", 13: "mode bit 13",
}  # fmt: skip
# CiA 301, 7.5.2.2
_ERROR_BITS = (
    "generic", "current", "voltage", "temperature", "communication", "device profile", "reserved", "manufacturer",
)  # fmt: skip
NMT_STATES: Mapping[int, str] = {
    NmtState.BOOT_UP: "boot-up", NmtState.STOPPED: "stopped", NmtState.OPERATIONAL: "operational",
    NmtState.PRE_OPERATIONAL: "pre-operational",
}  # fmt: skip
NMT_COMMANDS: Mapping[int, str] = {
    NmtCommand.START: "start (operational)", NmtCommand.STOP: "stop",
    NmtCommand.ENTER_PRE_OPERATIONAL: "enter pre-operational", NmtCommand.RESET_NODE: "reset node",
    NmtCommand.RESET_COMMUNICATION: "reset communication",
}  # fmt: skip
MODES = {
    -1: "manufacturer specific", 0: "no mode", 1: "profile position (PP)", 2: "velocity (VL)",
    3: "profile velocity (PV)", 4: "torque (TQ)", 6: "homing (HM)", 7: "interpolated position (IP)",
    8: "cyclic synchronous position (CSP)", 9: "cyclic synchronous velocity (CSV)",
    10: "cyclic synchronous torque (CST)", 11: "cyclic synchronous torque with angle (CSTCA)",
}  # fmt: skip
QUICK_STOP_OPTIONS = {
    0: "disable at once", 1: "slow down on the ramp", 2: "quick stop ramp, then disable", 3: "current limit",
    4: "voltage limit", 5: "slow down, stay in quick stop", 6: "quick stop ramp, stay in quick stop",
    7: "current limit, stay in quick stop", 8: "voltage limit, stay in quick stop",
}  # fmt: skip
ABORT_OPTIONS = {0: "no action", 1: "fault", 2: "disable voltage", 3: "quick stop"}
DEVICE_PROFILES = {
    0: "no standard profile", 401: "I/O modules", 402: "drives", 404: "measuring devices", 406: "encoders",
    408: "fluid power", 410: "inclinometers", 418: "batteries", 419: "battery chargers",
}  # fmt: skip


def status_bits(status_word: int) -> list[str]:
    """The bits of a statusword that are set beside the state."""
    return [name for bit, name in _STATUS_BITS.items() if status_word >> bit & 1]


def status_text(status_word: int) -> str:
    """`0237h operation enabled`."""
    return f"{status_word & 0xFFFF:04X}h {state_text(status_word)}"


def control_text(word: int) -> str:
    """The command of a controlword (CiA 402-2, table of commands), with halt where it is set."""
    if word & 0x80:
        command = "fault reset"
    elif not word & 0x02:
        command = "disable voltage"
    elif not word & 0x04:
        command = "quick stop"
    elif not word & 0x01:
        command = "shutdown"
    else:
        command = "enable operation" if word & 0x08 else "switch on"
    return f"{word & 0xFFFF:04X}h {command}" + (", halt" if word & 0x100 else "")


def mode_text(mode: int) -> str:
    """`10 cyclic synchronous torque (CST)`."""
    return f"{mode} {MODES.get(mode, 'manufacturer specific' if mode < 0 else 'reserved')}"


def supported_modes(bits: int) -> list[str]:
    """Names of the modes in 6502."""
    known = {bit: MODES[int(mode)] for mode, bit in SUPPORTED_MODE_BIT.items()}
    known |= {1: MODES[2], 6: MODES[7], 10: MODES[11]}
    names = [name for bit, name in sorted(known.items()) if bits >> bit & 1]
    return names + (["manufacturer's own"] if bits >> 16 else [])


def error_register_text(value: int) -> str:
    """`81h generic, manufacturer`; `00h none`."""
    names = [name for bit, name in enumerate(_ERROR_BITS) if value >> bit & 1]
    return f"{value & 0xFF:02X}h {', '.join(names) or 'none'}"


def no_error_or(code: int, text: Callable[[int], str]) -> str:
    """`0000h, no error`, or what `text` says."""
    return text(code) if code else "0000h, no error"


def nmt_state(byte: int | None) -> str:
    """Of a heartbeat byte; the toggle bit of node guarding is not looked at."""
    if byte is None:
        return "no heartbeat heard"
    return NMT_STATES.get(byte & 0x7F, f"unknown state {byte & 0x7F}")


def transmission_text(kind: int) -> str:
    """Of a PDO (CiA 301, 7.5.2.35)."""
    if kind == 0:
        return "synchronous, on an event"
    if kind <= LAST_SYNCHRONOUS:
        return "every SYNC" if kind == 1 else f"every {kind} SYNC"
    return {252: "on request, sampled at SYNC", 253: "on request", 254: "event (manufacturer)", 255: "event"}.get(
        kind, f"reserved ({kind})"
    )


def device_type_text(device_type: int) -> str:
    """Profile of 1000h in words."""
    profile = device_type & 0xFFFF
    return f"{device_type:08X}h, CiA {profile} ({DEVICE_PROFILES.get(profile, 'another profile')})"


assert {int(mode) for mode in Mode} <= set(MODES)
