"""Quantities as people write them ("30 deg", "20 rpm", "1 kHz") in the unit that a key asks for.

A key's unit is the last part of its name.  Only what has one meaning is understood: no bare "m" or "k", and case counts
(mNm, MHz).  What was understood is always echoed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

_TURN = math.tau
_FACTORS: Mapping[str, Mapping[str, float]] = {
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": _TURN / 360.0, "°": _TURN / 360.0, "turn": _TURN, "turns": _TURN},
    "radps": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _TURN / 360.0, "°/s": _TURN / 360.0, "rpm": _TURN / 60.0,
        "r/min": _TURN / 60.0, "rev/min": _TURN / 60.0,
    },
    "radps2": {"rad/s2": 1.0, "rad/s^2": 1.0, "rad/s²": 1.0, "deg/s2": _TURN / 360.0, "deg/s^2": _TURN / 360.0},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0},
    "Nm": {"Nm": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
    "NmpA": {"Nm/A": 1.0, "mNm/A": 1e-3},
    "Nmps": {"Nm/s": 1.0},
    "A": {"A": 1.0, "mA": 1e-3},
    "kgm2": {"kgm2": 1.0, "kg m2": 1.0, "kg m^2": 1.0, "kg m²": 1.0, "kgcm2": 1e-4, "kg cm2": 1e-4, "gcm2": 1e-7},
    "bitps": {"bit/s": 1.0, "kbit/s": 1e3, "Mbit/s": 1e6},
    "permille": {"permille": 1.0, "‰": 1.0, "%": 10.0},
}  # fmt: skip
WHOLE = frozenset({"bitps", "permille"})
_QUANTITY = re.compile(r"\s*([-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].*?)\s*")


def unit_of(key: str) -> str | None:
    """The unit in a key's name; None where it has none that could be written differently."""
    unit = key.rpartition("_")[2]
    return unit if unit in _FACTORS else None


def unit_text(unit: str) -> str:
    """As it is written: `radps2` is rad/s2."""
    return next(text for text, factor in _FACTORS[unit].items() if factor == 1.0)


def understood(key: str, text: str) -> float | int | None:
    """The number for `key` of a quantity with a unit; None if it is none, or of something else."""
    unit, match = unit_of(key), _QUANTITY.fullmatch(text)
    if unit is None or match is None or match[2] not in _FACTORS[unit]:
        return None
    value = float(match[1].replace("_", "")) * _FACTORS[unit][match[2]]
    if unit not in WHOLE:
        return value
    return round(value) if abs(value - round(value)) < 1e-6 else None


def echo(key: str, text: str, value: float) -> str:
    """What was understood, for the user."""
    unit = unit_of(key)
    return f"{text.strip()} is read as {value:.6g} {unit_text(unit) if unit else ''}".rstrip()


def with_units(data: Mapping[str, Any], place: str = "") -> tuple[dict[str, Any], list[str]]:
    """A raw configuration with texts such as "30 deg" as numbers, and one remark for each."""
    found: dict[str, Any] = {}
    remarks: list[str] = []
    for key, value in data.items():
        name = f"{place}{key}"
        found[key] = value
        if isinstance(value, dict):
            found[key], inner = with_units(value, f"{name}.")
            remarks += inner
        elif isinstance(value, str) and (number := understood(key, value)) is not None:
            found[key] = number
            remarks.append(f"{name}: {echo(key, value, number)}")
    return found, remarks
