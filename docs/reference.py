"""docs/configuration.md from the models: `python docs/reference.py [FILE]`.

Key, type, range and default are those that pydantic checks with; the meaning is the comment at the key in the source,
behind it or in lines of their own above it.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import KINDS, DriveSection, section_class
from jointctl.tools.configuration.sections import Rule, Section

UNITS = {
    "Nm": "Nm", "A": "A", "rad": "rad", "radps": "rad/s", "radps2": "rad/s²", "radps3": "rad/s³", "s": "s", "Hz": "Hz",
    "Nmps": "Nm/s", "NmpA": "Nm/A", "kgm2": "kg m²", "Nmprad": "Nm/rad", "Nmspr": "Nm s/rad", "bitps": "bit/s",
    "permille": "‰", "1ps": "1/s", "degC": "°C", "deg": "°", "ps2": "1/s²", "rads": "rad s", "KpA2": "K/A²",
    "counts": "counts", "cycles": "periods", "kelvin": "1/K",
}  # fmt: skip
TYPES = {float: "number", int: "whole number", str: "text", bool: "true, false"}
HEAD = """# Configuration reference

Made from the models by `python docs/reference.py docs/configuration.md`; do not edit.

A configuration is one TOML file. The unit of a quantity is part of its key; a text with another one (`"30 deg"`,
`"20 rpm"`, `"1 kHz"`) is understood where it has one meaning, and echoed. A key without a default must be there; one
with the default *none* may be left out. Ranges are wide: they catch a wrong unit or a slip of the finger, not a bold
choice. What must fit together between sections (trajectory inside the limits, gains against the rate, and so on) is
checked as well, with a line that says what. Begin with one of the files in [configs](../configs/).
"""
NO_DEFAULT = "required"


def comments_of(model: type[BaseModel]) -> dict[str, str]:
    """Key -> comment, of every key that has one; what a class says goes before what its base says."""
    found = {}
    for cls in reversed(model.__mro__):
        if issubclass(cls, Section):
            found.update(_own_comments(cls))
    return found


def _own_comments(model: type[BaseModel]) -> dict[str, str]:
    lines = inspect.getsource(model).splitlines()
    tree = ast.parse("\n".join(lines)).body[0]
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node in tree.body:
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        assert node.end_lineno is not None
        above: list[str] = []
        at = node.lineno - 2
        while lines[at].strip().startswith("#"):
            above.insert(0, lines[at].strip(" #"))
            at -= 1
        span = lines[node.lineno - 1 : node.end_lineno]
        behind = [line.split("  # ", 1)[1] for line in span if "  # " in line]
        text = " ".join([*above, *behind]).strip()
        if text:
            found[node.target.id] = text
    return found


def unit_of(key: str) -> str:
    """The unit that a key ends with; "" for a number without."""
    return UNITS.get(key.rpartition("_")[2], "") if "_" in key else ""


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The sections that a value may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in models_in(part)]


def type_and_range(annotation: Any, metadata: tuple[Any, ...] = ()) -> tuple[str, str]:
    """In words: what kind of value, and which ones."""
    rules = [rule for item in metadata if isinstance(rule := getattr(item, "func", None), Rule)]
    origin = get_origin(annotation)
    if origin is Annotated:
        base, *more = get_args(annotation)
        return type_and_range(base, (*metadata, *more))
    if origin in (Union, UnionType):
        options = [option for option in get_args(annotation) if option is not NoneType]
        if len(options) == 1:
            return type_and_range(options[0], metadata)
        return "number or text", " or ".join(rule.allowed for rule in rules)
    if origin is Literal:
        return "text", ", ".join(f"`{value}`" for value in get_args(annotation))
    allowed = ", ".join(rule.allowed for rule in rules)
    if origin is dict:
        return "table", allowed
    if origin is tuple:
        return "list", allowed
    return TYPES[annotation], allowed


def shown_default(value: object) -> str:
    """As it would stand in the file."""
    if value is None or value == ():
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return f"`{value}`" if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def rows_of(model: type[BaseModel]) -> Iterator[tuple[str, str, str, str, str, str]]:
    """(key, unit, type, range, default, meaning) of every key that is no section of its own."""
    comments = comments_of(model)
    for key, field in model.model_fields.items():
        if models_in(field.annotation):
            continue
        kind, allowed = type_and_range(field.annotation, tuple(field.metadata))
        default = NO_DEFAULT if field.is_required() else shown_default(field.default)
        yield f"`{key}`", unit_of(key), kind, allowed, default, comments.get(key, "")


def section_lines(
    name: str, model: type[BaseModel], optional: bool, seen: dict[type[BaseModel], str], comment: str = ""
) -> Iterator[str]:
    """One section and those inside it; a model that has been shown (`seen`: under which name) is only named."""
    doc = inspect.cleandoc(model.__doc__).replace("\n", " ") if "__doc__" in vars(model) and model.__doc__ else ""
    yield f"\n## {name}{' (may be left out)' if optional else ''}\n"
    text = " ".join(part for part in (doc, comment) if part)
    if text:
        yield f"{text}\n"
    if model in seen:
        yield f"The keys, and the sections inside it, are those of {seen[model]}."
        return
    seen[model] = name
    yield "| key | unit | type | allowed | default | meaning |"
    yield "|---|---|---|---|---|---|"
    for row in rows_of(model):
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
    comments = comments_of(model)
    for key, field in model.model_fields.items():
        for inner in models_in(field.annotation):
            plain = re.sub(r"[\[\]]|, kind = .*", "", name)
            many = get_origin(field.annotation) is tuple
            inner_name = f"[[{plain}.{key}]]" if many else f"[{plain}.{key}]"
            yield from section_lines(inner_name, inner, not field.is_required(), seen, comments.get(key, ""))


def sections_of_drives() -> list[type[BaseModel]]:
    return [section for kind in KINDS if (section := section_class(kind)) is not None]


def reference() -> str:
    lines = [HEAD.rstrip()]
    seen: dict[type[BaseModel], str] = {}
    for key, field in Config.model_fields.items():
        models = sections_of_drives() if field.annotation is DriveSection else models_in(field.annotation)
        for model in models:
            kind = get_args(model.model_fields["kind"].annotation)[0] if len(models) > 1 else None
            name = f"[{key}]" if kind is None else f'[{key}], kind = "{kind}"'
            lines += section_lines(name, model, not field.is_required(), seen)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(reference())
    else:
        sys.stdout.write(reference())
