"""A configuration with values that were found: identified, mapped or tuned; the one in use, and its file.

The comments and everything else of the file stay; the new text is checked as a complete configuration before it
replaces the file in one step; on any error the file stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Table

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config, ConfigurationProblems
from jointctl.tools.configuration.load import RENAMED, load_config, read_text
from jointctl.tools.configuration.sections import Friction, FrictionDirection, Reducer
from jointctl.tools.written_file import replace_file

MARK = "# identified by jointctl: "
_WORDS = ("velocity_unit", "velocity_side", "torque_side")
_BRANCHES = ("positive", "negative")
_OPTIONAL = ("load", "temperature", "angle")  # sections of [friction] that only a motion identifies


def document_of(text: str, written: Container[str], mark: str = MARK) -> tuple[tomlkit.TOMLDocument, str]:
    """The document without the lines that begin with `mark`, and how its lines end; `ConfigurationError`.

    A section that is to be `written` and is an inline table or dotted keys, to which no section can be added, becomes
    one with a heading, without its comments.
    """
    kept = "".join(line for line in text.splitlines(keepends=True) if not line.startswith(mark))
    try:
        document = tomlkit.parse(kept)
    except TOMLKitError as error:
        raise ConfigurationError(f"not valid TOML: {error}") from None
    without = (key.key for key, item in document.body if key is not None and _without_heading(item))
    for name in [name for name in dict.fromkeys(without) if name in written]:
        values = document[name].unwrap()
        document.remove(name)
        document[name] = values
    return document, "\r\n" if "\r\n" in kept else "\n"


def _without_heading(item: Any) -> bool:
    """Whether it is an inline table, or the dotted keys of a table."""
    if not isinstance(item, Table):
        return isinstance(item, InlineTable)
    return item.is_super_table() and any(
        not isinstance(one, (Table, AoT)) or _without_heading(one) for one in item.values()
    )


def friction_snippet(values: dict[str, Any], remarks: list[str]) -> str:
    """[friction] as a text of its own."""
    lines = [MARK + line for line in remarks] + ["[friction]"]
    lines += [f'{key} = "{values[key]}"' for key in _WORDS]
    for name in [key for key in (*_BRANCHES, *_OPTIONAL) if key in values]:
        lines += ["", f"[friction.{name}]", *(f"{key} = {value!r}" for key, value in values[name].items())]
    return "\n".join(lines) + "\n"


def with_friction_section(text: str, values: dict[str, Any], remarks: list[str]) -> str:
    """`text` with its [friction] replaced or appended; other keys of it ([friction.lugre]) and all comments stay."""
    document, newline = document_of(text, ("friction",))
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
    document, _ = document_of(text, ("reducer", "ripple"))
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


# --- What a tune has found: in the configuration in use, and in the file ---
# The virtual joint is described relative to what its configuration believes.  A better belief must not move the joint
# itself, so that [virtual] then says what it is: `inertia_scale` follows, the friction is kept as [virtual.friction].

TUNED_MARK = "# tuned by jointctl: "
DIGITS = 5
STANDS_radps, KNEE_radps = 1e-3, 0.4  # of a friction of which no curve is known: static below, constant beyond


@dataclass(frozen=True)
class Found:
    """One value of the configuration with where it comes from."""

    section: tuple[str, ...]
    key: str
    value: Any
    source: str  # with the interval


def rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def with_values(config: Config, values: list[Found]) -> Config:
    """The configuration in use with these values; the virtual joint stays what it was."""
    sections: dict[str, Any] = {}
    for one in values:
        sections.setdefault(one.section[0], {})[one.key] = one.value
    if config.reducer is None and "reducer" in sections:
        sections["reducer"] = Reducer(**sections["reducer"])
    return _same_plant(config, config.changed(**sections))


def _same_plant(before: Config, after: Config) -> Config:
    virtual = before.virtual
    if virtual is None:
        return after
    scale = virtual.inertia_scale * before.joint.inertia_kgm2 / after.joint.inertia_kgm2
    kept = {"inertia_scale": scale, "friction": virtual.friction or before.friction}
    return after.changed(virtual=kept)


def with_friction(config: Config, section: Mapping[str, Any]) -> Config:
    """The configuration in use with the friction that was identified; what it knew of bristles stays."""
    lugre = config.friction.lugre if config.friction is not None else None
    return _same_plant(config, config.changed(friction=Friction.model_validate({**section, "lugre": lugre})))


def without_friction(config: Config) -> Config:
    """The configuration in use before the friction is known."""
    return _same_plant(config, config.changed(friction=None, control__feed_forward="none", control__adaptation=None))


def with_break_away(config: Config, torque_Nm: float) -> Config:
    """As `without_friction`, but what watches the reading knows the torque at which the joint began to move.

    Nothing of it is fed forward.  A joint that is pushed harder and does not move has an encoder that stands still.
    """
    friction = _straight(torque_Nm, (torque_Nm, torque_Nm), 0.0)
    return without_friction(config).changed(friction=friction)


def with_sliding(
    config: Config, torque_Nm: float, sliding_Nm: tuple[float, float], slope_Nmspr: float, speed_radps: float
) -> Config:
    """As `with_break_away`, and the friction of the response's legs is fed forward: a law that is soft needs it.

    `sliding_Nm` at `speed_radps`, with its sign, `slope_Nmspr` there.  What is more at lower speeds is not known yet,
    and beyond KNEE_radps nothing is added.
    """
    sizes = max(sliding_Nm[0], 0.0), max(-sliding_Nm[1], 0.0)  # a load may be more than the friction
    slope_Nmspr = min(max(slope_Nmspr, 0.0), 0.5 * min(sizes) / speed_radps)
    coulomb = (sizes[0] - speed_radps * slope_Nmspr, sizes[1] - speed_radps * slope_Nmspr)
    friction = _straight(torque_Nm, coulomb, slope_Nmspr)
    before = with_break_away(config, torque_Nm)
    return before.changed(friction=friction, control__feed_forward="desired")


def _straight(static_Nm: float, coulomb_Nm: tuple[float, float], slope_Nmspr: float) -> Friction:
    """Coulomb and viscous friction of either direction, at the joint; the static one counts at standstill alone."""

    def side(sign: float, coulomb: float) -> FrictionDirection:
        return FrictionDirection(
            tc_Nm=coulomb, ts_Nm=max(static_Nm, coulomb), ws=STANDS_radps, tv=slope_Nmspr,
            a0=sign * (coulomb + KNEE_radps * slope_Nmspr), a1=0.0, a2=0.0, a3=0.0, knee=sign * KNEE_radps, max=sign,
        )  # fmt: skip

    positive, negative = side(1.0, coulomb_Nm[0]), side(-1.0, coulomb_Nm[1])
    return Friction(
        velocity_unit="rad/s", velocity_side="joint", torque_side="joint", positive=positive, negative=negative
    )


def with_tuned(text: str, values: list[Found], sources: Mapping[str, list[str]]) -> str:
    """`text` with these values; a comment under the heading of each section says where they come from.

    Sections that are not there are added at the end.  Comments stay, but those of an earlier tune.
    """
    document, newline = document_of(text, {one.section[0] for one in values}, TUNED_MARK)
    inserted = set()  # headings
    for one in values:
        table: Any = document
        for name in one.section:
            if name not in table:
                table[name] = tomlkit.table()
                inserted.add(".".join(one.section))
            table = table[name]
        for old, new in RENAMED.get(".".join(one.section), {}).items():
            if new == one.key:
                table.pop(old, None)  # both are refused
        if one.value is None:
            table.pop(one.key, None)
        elif not (one.key in table and table[one.key] == one.value):
            table[one.key] = list(one.value) if isinstance(one.value, tuple) else one.value
    lines, section = [""], ""
    for line in tomlkit.dumps(document).splitlines(keepends=True):
        lines.append(line if line.endswith("\n") else line + newline)
        heading = line.split("#")[0].strip()
        if heading.startswith("[") and heading.endswith("]"):
            if section in inserted and lines[-2].strip():
                lines.insert(-1, newline)
            section = heading[1:-1].strip()
            lines += [TUNED_MARK + source + newline for source in sources.get(section, ())]
    return "".join(lines)
