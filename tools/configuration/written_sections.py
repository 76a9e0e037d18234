"""A configuration file with other values in it: what was identified, mapped or tuned.

The comments and everything else of the file stay; the new text is checked as a complete configuration before it
replaces the file in one step; on any error the file stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import ConfigurationProblems
from jointctl.tools.configuration.load import load_config, read_text
from jointctl.tools.written_file import replace_file

MARK = "# identified by jointctl: "
_WORDS = ("velocity_unit", "velocity_side", "torque_side")
_BRANCHES = ("positive", "negative")
_OPTIONAL = ("load", "temperature", "angle")  # sections of [friction] that only a motion identifies


def document_of(text: str, mark: str = MARK) -> tuple[tomlkit.TOMLDocument, str]:
    """The document without the lines that begin with `mark`, and how its lines end; `ConfigurationError`."""
    kept = "".join(line for line in text.splitlines(keepends=True) if not line.startswith(mark))
    try:
        return tomlkit.parse(kept), "\r\n" if "\r\n" in kept else "\n"
    except TOMLKitError as error:
        raise ConfigurationError(f"not valid TOML: {error}") from None


def friction_snippet(values: dict[str, Any], remarks: list[str]) -> str:
    """[friction] as a text of its own."""
    lines = [MARK + line for line in remarks] + ["[friction]"]
    lines += [f'{key} = "{values[key]}"' for key in _WORDS]
    for name in [key for key in (*_BRANCHES, *_OPTIONAL) if key in values]:
        lines += ["", f"[friction.{name}]", *(f"{key} = {value!r}" for key, value in values[name].items())]
    return "\n".join(lines) + "\n"


def with_friction_section(text: str, values: dict[str, Any], remarks: list[str]) -> str:
    """`text` with its [friction] replaced or appended; other keys of it ([friction.lugre]) and all comments stay."""
    document, newline = document_of(text)
    friction = document.get("friction")
    if friction is None:
        kept = tomlkit.dumps(document)
        gap = "" if not kept or kept.endswith(newline) else newline
        return kept + gap + newline + friction_snippet(values, remarks).replace("\n", newline)
    for key in _WORDS:
        friction[key] = values[key]
    for name in _OPTIONAL:  # they belong to the curve that they were found with
        friction.pop(name, None)
    for name in [key for key in (*_BRANCHES, *_OPTIONAL) if key in values]:
        _fill(friction, name, values[name])
    lines = tomlkit.dumps(document).splitlines(keepends=True)
    at = next((k for k, line in enumerate(lines) if line.replace(" ", "").startswith("[friction")), len(lines))
    return "".join(lines[:at] + [MARK + line + newline for line in remarks] + lines[at:])


def with_map(text: str, values: dict[str, Any], remark: str) -> str:
    """`text` with [reducer.map] replaced or added, [ripple] where it has no [reducer]; other comments stay."""
    document, _ = document_of(text)
    reducer = document.get("reducer")
    table = _fill(document, "ripple", values) if reducer is None else _fill(reducer, "map", values)
    table.comment(MARK.removeprefix("# ") + remark)
    return tomlkit.dumps(document)


def _fill(parent: Any, name: str, values: dict[str, Any]) -> Any:
    """A table of a document of tomlkit, made if it is not there."""
    if name not in parent:
        parent[name] = tomlkit.table()
    for key, value in values.items():
        parent[name][key] = value
    return parent[name]


def write_changed(config_path: Path, change: Callable[[str], str]) -> None:
    """Put what `change` makes of the text in its place; `ConfigurationError` if it is not valid, and the file stays."""
    text = read_text(config_path)
    try:
        changed = change(text)
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
