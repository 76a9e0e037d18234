"""The [friction] section of a configuration: writing it keeps the comments and everything else of the file.

The numbers are written as (11) prints them: joint deg/s and motor Nm, with the signs of Table 3.  The new text is
checked as a whole configuration before it replaces the file in one step; on any error the file stays as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.friction import DEGREE
from jointctl.firmware_py.input_file import read_input
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.problems import ConfigurationProblems
from jointctl.tools.identification.models import Branch
from jointctl.tools.written_file import replace_file

MARK = "# identified by jointctl: "


def direction_values(found: Branch, *, negative: bool) -> dict[str, float]:
    """One direction under the keys of the configuration: deg/s at the joint, Nm at the motor, signs of (11)."""
    sign = -1.0 if negative else 1.0
    values = {
        "tc_Nm": found.coulomb_Nm,
        "ts_Nm": max(found.static_Nm, found.coulomb_Nm),
        "ws": found.stribeck_radps / DEGREE,
        "tv": found.viscous_Nmspr * DEGREE,
    }
    for power, a in enumerate(found.cubic):
        # mirrored f(u) = -F(-u): the even powers change their sign
        values[f"a{power}"] = (sign if power % 2 == 0 else 1.0) * a * DEGREE**power
    values["knee"] = sign * found.knee_radps / DEGREE
    values["max"] = sign * found.max_radps / DEGREE
    return {key: float(f"{value:.9g}") + 0.0 for key, value in values.items()}


def section_values(positive: Branch, negative: Branch) -> dict[str, Any]:
    return {
        "velocity_unit": "deg/s",
        "velocity_side": "joint",
        "torque_side": "motor",
        "positive": direction_values(positive, negative=False),
        "negative": direction_values(negative, negative=True),
    }


def snippet(values: dict[str, Any], remarks: list[str]) -> str:
    """The section as a text of its own."""
    lines = [MARK + line for line in remarks] + ["[friction]"]
    lines += [f'{key} = "{values[key]}"' for key in ("velocity_unit", "velocity_side", "torque_side")]
    for name in ("positive", "negative"):
        lines += ["", f"[friction.{name}]", *(f"{key} = {value!r}" for key, value in values[name].items())]
    return "\n".join(lines) + "\n"


def with_section(text: str, values: dict[str, Any], remarks: list[str]) -> str:
    """`text` with its [friction] replaced or appended; other keys of it ([friction.lugre]) and all comments stay."""
    kept = "".join(line for line in text.splitlines(keepends=True) if not line.startswith(MARK))
    newline = "\r\n" if "\r\n" in kept else "\n"
    try:
        document = tomlkit.parse(kept)
    except TOMLKitError as error:
        raise ConfigurationError(f"not valid TOML: {error}") from None
    friction = document.get("friction")
    if friction is None:
        gap = "" if not kept or kept.endswith(newline) else newline
        return kept + gap + newline + snippet(values, remarks).replace("\n", newline)
    for key in ("velocity_unit", "velocity_side", "torque_side"):
        friction[key] = values[key]
    for name in ("positive", "negative"):
        if name not in friction:
            friction[name] = tomlkit.table()
        for key, value in values[name].items():
            friction[name][key] = value
    lines = tomlkit.dumps(document).splitlines(keepends=True)
    at = next((k for k, line in enumerate(lines) if line.replace(" ", "").startswith("[friction")), len(lines))
    return "".join(lines[:at] + [MARK + line + newline for line in remarks] + lines[at:])


def write_into(config_path: Path, values: dict[str, Any], remarks: list[str]) -> None:
    """Put the section into a configuration; if the result is not valid, `ConfigurationError`, and the file stays."""
    try:
        text = read_input(config_path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"{config_path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from None
    try:
        changed = with_section(text, values, remarks)
    except ConfigurationError as error:
        raise ConfigurationError(f"{config_path}: {error.message}") from None

    def check(temporary: Path) -> None:
        try:
            load_config(temporary)
        except ConfigurationProblems as error:
            raise ConfigurationProblems(
                [line.replace(str(temporary), str(config_path)) for line in error.problems]
            ) from None
        except ConfigurationError as error:
            raise ConfigurationError(error.message.replace(str(temporary), str(config_path)), error.hint) from None

    replace_file(config_path, changed.encode("utf-8"), check)
