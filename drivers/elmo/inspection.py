"""What a drive says about itself, read only: nothing is written, nothing is switched, no counter is reset."""

from __future__ import annotations

from dataclasses import dataclass

from jointctl.drivers.elmo.codes import UnitMode, error_text, motor_fault_text, status_text
from jointctl.drivers.elmo.dialogue import Dialogue, RefusedError
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import DeviceError

UNIT_MODES = {int(mode): mode.name.lower() for mode in UnitMode}
# name, index, what it is, what one count or ampere of it means
_QUESTIONS: tuple[tuple[str, int | None, str, str], ...] = (
    ("EC", None, "last refused command", "code"),  # first: a question that is refused changes it
    ("SN", 4, "serial number", ""),
    ("MO", None, "motor", "switch"),
    ("UM", None, "unit mode", "mode"),
    ("SR", None, "status register", "status"),
    ("MF", None, "motor fault", "fault"),
    ("EO", None, "echo", "switch"),
    ("RM", None, "analog reference", "switch"),
    ("PX", None, "position", "position"),
    ("VX", None, "velocity", "velocity"),
    ("TC", None, "torque command", "current"),
    ("IQ", None, "active current", "current"),
    ("MC", None, "largest current", "limit current"),
    ("CL", 1, "continuous current limit", "limit current"),
    ("PL", 1, "peak current limit", "limit current"),
    ("PL", 2, "peak time", "time"),
    ("HL", 2, "speed limit, high", "velocity"),
    ("LL", 2, "speed limit, low", "velocity"),
    ("HL", 3, "position limit, high", "position"),
    ("LL", 3, "position limit, low", "position"),
    ("ER", 2, "speed error limit", "speed size"),
    ("ER", 3, "position error limit", "angle size"),
)


@dataclass(frozen=True)
class Fact:
    """One answer: `value` as the drive wrote it, `meaning` in words or in the units of the joint."""

    name: str
    label: str
    value: str
    meaning: str
    number: float | None = None  # in the unit of `unit`
    unit: str = ""


def read_facts(line: Dialogue, settings: ElmoSettings) -> list[Fact]:
    """Everything a drive of this family tells; what it does not know is said so, because firmwares differ."""
    facts = []
    questions = list(_QUESTIONS)
    parameter = settings.counts_parameter
    if parameter is not None:
        questions.append((parameter[:2], int(parameter[3:-1]), "encoder counts a turn", "counts"))
    for name, index, label, kind in questions:
        shown = name if index is None else f"{name}[{index}]"
        try:
            text = line.query(name, index)
        except RefusedError as refusal:
            facts.append(Fact(shown, label, "", f"not told: {error_text(refusal.code)}"))
            continue
        facts.append(_fact(shown, label, text, kind, settings))
    return facts


def _fact(shown: str, label: str, text: str, kind: str, settings: ElmoSettings) -> Fact:
    if not kind:
        return Fact(shown, label, text, "")
    try:
        number = float(text)
    except ValueError:
        raise DeviceError(f"{shown} (={text!r}) of the drive is not a number") from None
    whole = round(number)
    words = _words(kind, whole)
    if words:
        return Fact(shown, label, text, words, whole)
    value, unit = _joint_value(number, kind, settings)
    return Fact(shown, label, text, f"{value:.6g} {unit}" if unit else "", value, unit)


def _words(kind: str, whole: int) -> str:
    """What a number stands for; empty for a quantity."""
    if kind == "switch":
        return "on" if whole else "off"
    if kind == "mode":
        return UNIT_MODES.get(whole, "not in the list")
    if kind == "status":
        return f"{whole:X}h: {status_text(whole)}"
    if kind == "fault":
        return motor_fault_text(whole)
    if kind == "code":
        return error_text(whole) if whole else "none"
    return ""


def _joint_value(number: float, kind: str, settings: ElmoSettings) -> tuple[float, str]:
    """(value, unit) at the joint; sizes and limits of currents without the sign of the direction."""
    if kind == "position":
        return (number - settings.zero_counts) * settings.rad_per_count, "rad"
    if kind == "velocity":
        return number * settings.rad_per_count, "rad/s"
    if kind == "current":
        return number * settings.torque_NmpA, "Nm"
    if kind == "limit current":
        return number * abs(settings.torque_NmpA), "Nm"
    if kind == "speed size":
        return number * abs(settings.rad_per_count), "rad/s"
    if kind == "angle size":
        return number * abs(settings.rad_per_count), "rad"
    return number, "s" if kind == "time" else ""
