"""A configuration as one frozen object with its law, the files beside it that it names, and what is wrong with one.

It is read and checked by `load.load_config`.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, PrivateAttr, SerializeAsAny
from pydantic_core import ErrorDetails, PydanticCustomError

from jointctl.drivers.errors import ConfigurationError, one_line
from jointctl.firmware_py.records import NEURONS, RIPPLES
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
    Rule,
    Section,
    Sequence,
    Stream,
    Trajectory,
    Virtual,
    auto_or_number,
    between,
    is_number,
    numbers,
    whole_channel,
)
from jointctl.tools.written_file import refuse_unwritable

# --- Section [control] with [control.learning] and [control.adaptation]: the law and its gains; docs/law.md ---


CENTRES = "15 numbers or 15 pairs [rad, rad/s], each in [-100..100]"


def _centres(value: object) -> Any:
    """15 numbers, taken for both inputs as the paper does, or 15 pairs [rad, rad/s]."""

    def number(x: object) -> bool:
        return is_number(x) and abs(x) <= 100.0

    if isinstance(value, (list, tuple)) and len(value) == NEURONS:
        if all(number(x) for x in value):
            return tuple((float(x), float(x)) for x in value)
        if all(isinstance(x, (list, tuple)) and len(x) == 2 and all(number(y) for y in x) for x in value):
            return tuple((float(x[0]), float(x[1])) for x in value)
    raise PydanticCustomError("centres", "must be {allowed}", {"allowed": CENTRES})


class Learning(Section):
    """Iterative learning on a repeating trajectory, on top of computed_torque_observer or flexible_joint."""

    # share of the remaining error torque taken over in each repetition
    gain: Annotated[float, between(0.0, 1.0, open_low=True)]
    error_gain_ps2: Annotated[float, between(0.0, 1e6)] = 0.0  # weight of the error itself
    lead_cycles: Annotated[int, between(0, 100)]  # delay from command to measured effect
    half_width_cycles: Annotated[int, between(0, 100)]  # of the smoothing
    blend_s: Annotated[float, between(0.001, 100.0)] = 0.5  # over which what has been learned comes in


class Adaptation(Section):
    """Friction feed-forward that adapts to the joint whatever the motion; needs an observer and lugre_desired."""

    # of the share of each kind of bristles, at first: how far the configured friction may be off
    friction_error: Annotated[float, between(0.0, 1.0, open_low=True)] = 0.15
    # by which the whole friction of a direction may leave the configured one
    reach: Annotated[float, between(0.0, 1.0)] = 0.3
    # torque ripple to find: periods a motor turn, two at most
    ripple_per_motor_turn: Annotated[tuple[float, ...], numbers("numbers", 0, 1, RIPPLES, low=0.0, high=1000.0)] = ()
    # expected of it, at the joint; four times at most; "auto": 0.7/60 of limits.torque_max_Nm
    ripple_Nm: Annotated[float | Literal["auto"], auto_or_number(1e-9, 1e4)] = "auto"


class Control(Section):
    # docs/law.md
    kind: Literal["computed_torque", "computed_torque_rbf", "computed_torque_observer", "pid", "flexible_joint"]
    kp: Annotated[float, between(0.0, 1e6, open_low=True)]  # [1/s²] of the position error
    kv: Annotated[float, between(0.0, 1e4, open_low=True)]  # [1/s] of the velocity error
    ki: Annotated[float, between(0.0, 1e8)] = 0.0  # [1/s³] of the error's integral, pid only
    integral_limit_rads: Annotated[float, between(0.0, 1e3)] = 0.0  # pid only, 0 = none
    # bandwidth, computed_torque_observer and flexible_joint only
    observer_radps: Annotated[float, between(0.0, 2000.0)] = 0.0
    observer_delay_cycles: Annotated[int, between(0, 15)] = 1  # from a command to its torque
    # compare what was fed forward with the torque of its own command: for motions without rests, docs/law.md
    observer_paired: bool = False
    # of the Lyapunov equation: Q = q I, or diag(q1, q2)
    lyapunov_q: Annotated[tuple[float, ...], numbers("numbers", 1, 2, low=0.0, high=1e12)]
    learning_rate: Annotated[float, between(0.0, 1e9)]  # of the network's weights
    initial_weight_Nm: Annotated[float, between(-1000.0, 1000.0)]  # of each of the 15 neurons
    widths: Annotated[tuple[float, ...], numbers("widths", 1, NEURONS, low=0.0, high=1e4)]  # of the Gaussians
    # none = the paper's
    centres: Annotated[tuple[tuple[float, float], ...], BeforeValidator(Rule(CENTRES, _centres))] | None = None
    leakage_1ps: Annotated[float, between(0.0, 100.0)] = 0.0  # pulls the weights to zero: bounded under noise
    weight_limit_Nm: Annotated[float, between(0.0, 1e6)] = 0.0  # of each weight; 0 = none
    dead_zone_rad: Annotated[float, between(0.0, 1.0)] = 0.0  # no learning at smaller errors
    # friction compensation by measured or desired velocity
    feed_forward: Literal["none", "measured", "desired", "lugre_desired"]
    zero_rule: Literal["zero", "paper", "linear"]  # friction compensation at exactly zero velocity
    zero_band_radps: Annotated[float, between(0.0, 10.0)] = 0.0  # half width of the linear zero rule
    velocity_cutoff_Hz: Annotated[float, between(0.0, 2000.0)]  # 0 = no filter
    # kalman: position, velocity and disturbance from a model, for coarse encoders; computed_torque_observer only
    velocity_filter: Literal["low_pass", "kalman"] = "low_pass"
    filtered_error_rate: bool  # filter the velocity error as a whole: no bias from the filter's lag
    # with which the link's encoder corrects the expected twist, flexible_joint with both encoders only
    twist_radps: Annotated[float, between(0.0, 1000.0, open_low=True)] = 60.0
    link_cutoff_Hz: Annotated[float, between(0.0, 2000.0)] = 60.0  # of the link's velocity there; 0 = no filter
    # of the feed-forward: the motion desired so much later, as torque is late; auto: loop delay, half a period, lag
    feed_forward_lead_s: Annotated[float | Literal["auto"], auto_or_number(0.0, 0.02)] = 0.0
    adaptation: Adaptation | None = None
    learning: Learning | None = None


# --- The whole file ---


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

    def changed(self, **changes: Any) -> Config:
        """With `section__key=value`, or `section=` keys in a mapping, or another section; no value is checked."""
        update: dict[str, Any] = {}
        for path, value in changes.items():
            section, _, key = path.partition("__")
            keys, own = {key: value} if key else value, update.get(section, getattr(self, section))
            if isinstance(keys, Mapping):
                if unknown := keys.keys() - type(own).model_fields.keys():
                    raise TypeError(f"[{section}] has no {', '.join(sorted(unknown))}")
                value = own.model_copy(update=keys)
            update[section] = value
        return self.model_copy(update=update)

    def anchored(self) -> Config:
        """The same wherever the working directory goes: its file and its log folder by their full paths."""
        found = self.changed(log__folder=str(Path(self.log.folder).absolute()))
        found._path = self._path.absolute()
        return found

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the user should know about the file, one line each."""
        return self._remarks

    @property
    def text(self) -> str:
        """The file as it was read, for the log."""
        return self._text

    @property
    def link_kgm2(self) -> float:
        """Inertia behind the reducer; without one all of it."""
        return self.joint.inertia_kgm2 - (0.0 if self.reducer is None else self.reducer.motor_inertia_kgm2)

    @property
    def table_path(self) -> Path | None:
        return beside(self._path, self.trajectory.file) if self.trajectory.kind == "table" else None


def first_on_bus(joints: Iterable[Config]) -> list[int]:
    """Of each joint of an arm the number of the first joint that is on the same bus."""
    places = [(config.bus.interface, config.bus.channel) for config in joints]
    return [places.index(place) for place in places]


def refuse_shipped(config: Config) -> None:
    """Of a file that is to be written: `ConfigurationError` if it came with jointctl, `DataError` if it cannot be."""
    if config.path.resolve().is_relative_to(SHIPPED_FOLDER):
        raise ConfigurationError(
            f"{config.path.name} is a shipped configuration and is not changed",
            f"`jointctl new mine.toml --from {config.path.stem}` makes it yours",
        )
    refuse_unwritable(config.path)


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
        tags = error["ctx"].get("expected_tags") or _kinds(model, location[-1])
        given = f" (={_shown(value.get('kind'))})" if kind == "union_tag_invalid" else ""
        return f"{name}.kind{given} must be one of {tags}"
    shown = repr(value) if kind == "int_type" and isinstance(value, float) else _shown(value)  # 1e5 is no whole number
    given = "is empty:" if value is None else f"(={shown})"  # as a page's field; no file can say so
    return f"{name} {given} {_RULES.get(kind) or _rule(error)}"


def _kinds(model: type[BaseModel] | None, section: str) -> str:
    """What `kind` may be in that section."""
    sections = get_args(model.model_fields[section].annotation) if model is not None else ()
    return ", ".join(repr(*get_args(one.model_fields["kind"].annotation)) for one in sections)


_RULES = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "string_type": "must be a text in quotes",
    "bool_type": "must be true or false",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
    "list_type": "must be a list",
}


def _rule(error: ErrorDetails) -> str:
    if error["type"] == "literal_error":
        return f"must be one of {error['ctx']['expected']}"
    if error["type"] in ("too_short", "too_long"):  # a list
        few, limits = error["type"] == "too_short", error["ctx"]
        return f"must be a list of {'at least' if few else 'at most'} {limits['min_length' if few else 'max_length']}"
    message = str(error["msg"])
    return message[0].lower() + message[1:]


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)
    text = text.lower() if isinstance(value, bool) else text  # as TOML has it
    text = " ".join(text.split()) or '""'
    return text if len(text) <= 60 else text[:57] + "..."
