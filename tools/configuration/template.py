"""A configuration that is still to be filled in: its marked lines, their values, and what each may be.

A marked line is a key that is commented out, with FILL IN and what to fill in behind it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import section_class
from jointctl.tools.configuration.load import echo, understood, unit_of, unit_text

_SECTION = re.compile(r"\[(\w+)\]")
_KEY = re.compile(
    r"(?P<off># )?(?P<key>\w+)(?P<equals> = )(?P<value>\"[^\"]*\"|[^#\s]+)(?P<space>\s*)(?P<comment>#.*)?"
)
_MARK = re.compile(r"# FILL IN(?P<optional> if[^:]*)?: ?(?P<text>.*)")
_HEXADECIMAL = ("vendor_id", "product_code")
Place = tuple[str, str]


@dataclass(frozen=True)
class Mark:
    """One value to be filled in; `optional`: the key has a default, which holds if nobody gives another value."""

    section: str
    key: str
    text: str
    optional: bool

    @property
    def place(self) -> Place:
        """(section, key)."""
        return self.section, self.key

    @property
    def unit(self) -> str:
        """For a question; "" where there is none."""
        unit = unit_of(self.key)
        return unit_text(unit) if unit else ""


def marks(text: str) -> list[Mark]:
    """The lines that are to be filled in, in their order."""
    found, section = [], ""
    for line in text.splitlines():
        if head := _SECTION.match(line):
            section = head[1]
        key = _KEY.match(line)
        mark = _MARK.match(key["comment"] or "") if key and key["off"] else None
        if key and mark:
            found.append(Mark(section, key["key"], mark["text"], mark["optional"] is not None))
    return found


def filled(text: str, values: Mapping[Place, object]) -> str:
    """The text with these values in the lines of their keys, which are no comments any more; other keys are left."""
    lines, section = [], ""
    for line in text.splitlines(keepends=True):
        if head := _SECTION.match(line):
            section = head[1]
        key = _KEY.match(line)
        if key and (section, key["key"]) in values:
            value = toml_text(values[section, key["key"]], key["key"])
            comment = re.sub(r"FILL IN(?: if[^:]*)?: ", "", key["comment"] or "").rstrip()
            line = f"{key['key']} = {value}"
            line = f"{line:<33} {comment}".rstrip() + "\n" if comment else line + "\n"
        lines.append(line)
    return "".join(lines)


def toml_text(value: object, key: str = "") -> str:
    """A value as TOML has it; identities in hexadecimal, as data sheets have them."""
    if key in _HEXADECIMAL and isinstance(value, int):
        return f"{value:#x}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, float):
        return repr(value) if abs(value) < 1e16 else f"{value:e}"
    return str(value)


def _field(place: Place) -> FieldInfo:
    section, key = place
    model: Any = section_class("canopen") if section == "drive" else Config.model_fields[section].annotation
    fields: dict[str, FieldInfo] = model.model_fields
    return fields[key]


def default_of(place: Place) -> object:
    """What holds where the key is not given."""
    return _field(place).default


def answer_value(text: str) -> Any:
    """What somebody typed: a TOML value, else the text as it is."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def checked(place: Place, text: str) -> tuple[Any, str]:
    """The value that the text means for that key and what was made of it; `ValueError` in words if it may not be."""
    section, key = place
    number = understood(key, text)
    value: Any = answer_value(text) if number is None else number
    field = _field(place)
    if isinstance(value, int) and not isinstance(value, bool) and "float" in str(field.annotation):
        value = float(value)
    try:
        kind: Any = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
        TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False)).validate_python(value)
    except ValidationError as error:
        message = error.errors(include_url=False)[0]["msg"]
        raise ValueError(f"{section}.{key} (={text}) {message[0].lower()}{message[1:]}") from None
    return value, echo(key, text, number) if number is not None else ""
