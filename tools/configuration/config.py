"""A configuration as one frozen object, the files beside it that it names, and what is wrong with one, in words.

It is read and checked by `load.load_config`.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, PrivateAttr, SerializeAsAny
from pydantic_core import ErrorDetails

from jointctl.drivers.errors import ConfigurationError, one_line
from jointctl.tools.configuration.control_section import Control
from jointctl.tools.configuration.drive_section import DriveSection, checked_drive, section_class
from jointctl.tools.configuration.sections import (
    Bus,
    Encoder,
    Friction,
    Joint,
    JointEncoder,
    Limits,
    Live,
    Log,
    Loop,
    Margin,
    Reducer,
    Ripple,
    Section,
    Sequence,
    Stream,
    Trajectory,
    Virtual,
    whole_channel,
)

SHIPPED_FOLDER = Path(__file__).resolve().parents[2] / "configs"


class Config(Section):
    """One joint, its drive and what it shall do; [virtual] only matters on the virtual bus."""

    bus: Annotated[Bus, AfterValidator(whole_channel)]
    drive: Annotated[SerializeAsAny[DriveSection], BeforeValidator(checked_drive)]
    encoder: Encoder
    joint: Joint
    joint_encoder: JointEncoder | None = None
    reducer: Reducer | None = None
    ripple: Ripple | None = None
    limits: Limits
    sequence: Sequence
    loop: Loop
    control: Control
    trajectory: Trajectory
    friction: Friction | None = None
    virtual: Virtual | None = None
    margin: Margin = Margin()
    live: Live = Live()
    stream: Stream = Stream()
    log: Log = Log()

    _path: Path = PrivateAttr(default=Path())
    _text: str = PrivateAttr(default="")
    _remarks: tuple[str, ...] = PrivateAttr(default=())

    @property
    def path(self) -> Path:
        return self._path

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the user should know about the file, one line each."""
        return self._remarks

    @property
    def text(self) -> str:
        """The file as it was read, for the log."""
        return self._text

    @property
    def table_path(self) -> Path | None:
        return beside(self._path, self.trajectory.file) if self.trajectory.kind == "table" else None


def first_on_bus(joints: Iterable[Config]) -> list[int]:
    """Of each joint of an arm the number of the first joint that is on the same bus."""
    places = [(config.bus.interface, config.bus.channel) for config in joints]
    return [places.index(place) for place in places]


def beside(config_path: Path, name: str) -> Path:
    """A file that a configuration names: beside it, else a shipped one."""
    own = config_path.parent / name
    shipped = SHIPPED_FOLDER / name
    return shipped if not os.path.exists(own) and os.path.exists(shipped) else own


# --- From pydantic's list of errors to one line each: `section.key (=value) must be in [a..b]` ---
# An unknown key names the one that was meant, also when only the unit is wrong or missing (`loop.rate_kHz` ->
# `rate_Hz`).


class ConfigurationProblems(ConfigurationError):
    """Every problem found in a configuration: `problems` one by one, `message` one line each."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(problems[0])
        self.problems = tuple(one_line(problem) for problem in problems)
        self.message = "\n".join(self.problems)


_UNITS = frozenset(
    "Nm A rad radps radps2 s Hz Nmps Nmpa NmpA kgm2 Nmprad Nmspr bitps permille 1ps degC V "
    "ms us ns kHz MHz deg degps rpm mNm mA kbitps bps min turn turns mm".lower().split()
)


def raise_if(lines: list[str]) -> None:
    if lines:
        raise ConfigurationProblems(lines)


_BY_KIND = ("trajectory", "motion")  # sections whose key `kind` decides which class they have
_TRAJECTORIES = "'sine', 'min_jerk', 'trapezoid', 'table', 'hold'"  # whose key `kind` decides what else is in it


def _model_at(
    location: tuple[str, ...], data: Mapping[str, Any], root: type[BaseModel] | None = None
) -> type[BaseModel] | None:
    """The section class that holds the last element of `location`, in a file of the class `root`."""
    model: type[BaseModel] = root or Config
    for part in location[:-1]:
        field = model.model_fields.get(part)
        if field is None:
            return None
        if field.annotation is DriveSection:
            section = section_class(data.get(part, {}).get("kind"))
            models: list[type[BaseModel]] = [] if section is None else [section]
        else:
            options = [t for t in (field.annotation, *get_args(field.annotation)) if isinstance(t, type)]
            models = [t for t in options if issubclass(t, BaseModel)]
        if part in _BY_KIND:
            kind = data.get(part, {}).get("kind")
            models = [t for t in models if get_args(t.model_fields["kind"].annotation) == (kind,)]
        if not models:
            return None
        model = models[0]
    return model


def _stem(key: str) -> str:
    head, _, tail = key.rpartition("_")
    return (head if head and tail.lower() in _UNITS else key).lower()


def meant(unknown: str, known: list[str]) -> str | None:
    """The key that was probably meant by an unknown one; of the same name but for the unit, or spelt alike."""
    same = [key for key in known if key != unknown and _stem(key) == _stem(unknown)]
    close = difflib.get_close_matches(unknown, known, 1, 0.6) or difflib.get_close_matches(
        _stem(unknown), known, 1, 0.5
    )
    return next(iter(same + close), None)


def suggestion(unknown: str, known: list[str]) -> str:
    """What the user probably meant by an unknown key, as the end of a message."""
    key = meant(unknown, known)
    if key is None:
        return f": known are {', '.join(sorted(known))}"
    if key != unknown and _stem(key) == _stem(unknown):
        return f": use {key} (the unit is part of the key)"
    return f": did you mean {key}?"


def _location(error: ErrorDetails) -> list[str]:
    parts = [str(part) for part in error["loc"]]
    if len(parts) > 1 and parts[0] in _BY_KIND:
        del parts[1]  # the tag of the union, which the user did not write
    return parts


def problem_lines(errors: list[Any], data: Mapping[str, Any], root: type[BaseModel] | None = None) -> list[str]:
    """One line for each problem; a key that is missing because it is written in another way is reported once."""
    named = set()
    for error in errors:
        if error["type"] == "extra_forbidden":
            place = tuple(_location(error))
            model = _model_at(place, data, root)
            key = meant(place[-1], list(model.model_fields)) if model else None
            named.add((*place[:-1], key))
    left = [error for error in errors if error["type"] != "missing" or tuple(_location(error)) not in named]
    return list(dict.fromkeys(problem_line(error, data, (), root) for error in left))


def problem_line(
    error: ErrorDetails, data: Mapping[str, Any], prefix: tuple[str, ...], root: type[BaseModel] | None = None
) -> str:
    """The line of one error of pydantic; `prefix` is where in the file `data` begins."""
    location = (*prefix, *_location(error))
    name = ".".join(location)
    kind, value = error["type"], error["input"]
    model = _model_at(location, data, root)
    if kind == "extra_forbidden":
        known = list(model.model_fields) if model else []
        what = f"[{name}] is not a known section" if len(location) == 1 else f"{name} is not a known key"
        return what + suggestion(location[-1], known)
    if kind == "missing":
        field = model.model_fields[location[-1]] if model else None
        section = len(location) == 1 or (field is not None and isinstance(field.annotation, type)
                                         and issubclass(field.annotation, BaseModel))  # fmt: skip
        return f"[{name}] is missing" if section else f"{name} is missing"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{name} (={_shown(value)}) must be a section: [{name}]"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tags = error["ctx"].get("expected_tags", _TRAJECTORIES)
        given = f" (={_shown(value.get('kind'))})" if kind == "union_tag_invalid" else ""
        return f"{name}.kind{given} must be one of {tags.removeprefix('one of ')}"
    return f"{name} (={_shown(value)}) {_RULES.get(kind) or _rule(error)}"


_RULES = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "string_type": "must be a text in quotes",
    "bool_type": "must be true or false",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
}


def _rule(error: ErrorDetails) -> str:
    if error["type"] == "literal_error":
        return f"must be one of {error['ctx']['expected']}"
    message = str(error["msg"])
    return message[0].lower() + message[1:]


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)
    text = " ".join(text.split()) or '""'
    return text if len(text) <= 60 else text[:57] + "..."
