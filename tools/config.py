"""Read and check a TOML configuration: `load_config(path)` gives a frozen `Config` or one line for each problem.

A line reads `FILE: section.key (=value) must be in [a..b]`; an unknown key names the one that was meant, also when
only the unit is wrong or missing (`loop.rate_kHz` -> `rate_Hz`).
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import BaseModel, Field, PrivateAttr, ValidationError

from drivers.errors import ConfigurationError
from tools.config_checks import problems_between_sections
from tools.config_elmo import ElmoSerial, with_serial_bus
from tools.config_plant import Virtual, plant_problems
from tools.config_sections import (
    Bus,
    Control,
    Drive,
    Encoder,
    Friction,
    Joint,
    Limits,
    Log,
    Loop,
    Margin,
    Section,
    Sequence,
)
from tools.config_trajectory import Trajectory

SHIPPED_FOLDER = Path(__file__).resolve().parent.parent / "configs"
_UNITS = frozenset(
    "Nm A rad radps radps2 s Hz Nmps Nmpa NmpA kgm2 Nmprad Nmspr bitps permille 1ps degC V "
    "ms us ns kHz MHz deg degps rpm mNm mA kbitps bps min turn turns mm".lower().split()
)


class ConfigurationProblems(ConfigurationError):
    """Every problem found in a configuration: `problems` one by one, `message` one line each."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(problems[0])
        self.problems = tuple(problems)
        self.message = "\n".join(problems)


class Config(Section):
    """One joint, its drive and what it shall do; [virtual] only matters on the virtual bus."""

    bus: Bus
    drive: Annotated[Drive | ElmoSerial, Field(discriminator="kind")]
    encoder: Encoder
    joint: Joint
    limits: Limits
    sequence: Sequence
    loop: Loop
    control: Control
    trajectory: Trajectory
    friction: Friction | None = None
    virtual: Virtual | None = None
    margin: Margin = Margin()
    log: Log = Log()

    _path: Path = PrivateAttr(default=Path())
    _text: str = PrivateAttr(default="")

    @property
    def path(self) -> Path:
        """The file that this was read from."""
        return self._path

    @property
    def text(self) -> str:
        """The file as it was read, for the log."""
        return self._text

    @property
    def canopen(self) -> Drive:
        """[drive] of a CANopen drive; `ConfigurationError` for any other."""
        if not isinstance(self.drive, Drive):
            raise ConfigurationError(f'{self._path}: drive.kind (={self.drive.kind}) must be "canopen" here')
        return self.drive

    @property
    def eds_path(self) -> Path:
        """The EDS file: beside the configuration, else a shipped one."""
        return _beside(self._path, self.canopen.eds)

    @property
    def table_path(self) -> Path | None:
        """The file of a table trajectory."""
        return _beside(self._path, self.trajectory.file) if self.trajectory.kind == "table" else None


def _beside(config_path: Path, name: str) -> Path:
    own = config_path.parent / name
    shipped = SHIPPED_FOLDER / name
    return shipped if not own.exists() and shipped.exists() else own


def shipped_config(name: str) -> Path:
    """Path of a configuration shipped with the package, with or without `.toml`."""
    return SHIPPED_FOLDER / (name if name.endswith(".toml") else f"{name}.toml")


def _read_text(path: Path) -> str:
    known = ", ".join(sorted(p.stem for p in SHIPPED_FOLDER.glob("*.toml")))
    try:
        return path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: no such file", f"shipped configurations: {known}") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: is a folder, not a configuration file") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from None


def load_config(path: str | Path) -> Config:
    """Read, check and freeze a configuration; `ConfigurationError` holds one line per problem."""
    path = Path(path)
    text = _read_text(path)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    config = _validated(data, str(path))
    config._path, config._text = path, text
    _raise_if([f"{path}: {line}" for line in problems_between_sections(config) + plant_problems(config)])
    eds_path = config.eds_path if isinstance(config.drive, Drive) else None
    for key, file in (("drive.eds", eds_path), ("trajectory.file", config.table_path)):
        if file is not None and not file.is_file():
            _raise_if([f"{path}: {key} (={file.name}) must name a file beside the configuration or a shipped one"])
    return config


def with_bus_overrides(
    config: Config,
    interface: str | None = None,
    channel: str | None = None,
    bitrate: int | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """The configuration on another bus: flag beats environment (CAN_INTERFACE, _CHANNEL, _BITRATE) beats file."""
    if isinstance(config.drive, ElmoSerial):
        given = interface or channel or bitrate
        if given is not None:
            raise ConfigurationError(f"command line: {given} names a CAN bus, the drive is on a serial port: use -p")
        return config  # the environment speaks of CAN only
    environ = os.environ if environ is None else environ
    bus: dict[str, Any] = config.bus.model_dump()
    origin = "command line"
    if bitrate is None and environ.get("CAN_BITRATE"):
        origin = "environment"
        try:
            bitrate = int(environ["CAN_BITRATE"])
        except ValueError:
            value = environ["CAN_BITRATE"]
            raise ConfigurationError(f"environment: CAN_BITRATE (={value}) must be a whole number of bit/s") from None
    bus["interface"] = interface or environ.get("CAN_INTERFACE") or bus["interface"]
    bus["channel"] = channel or environ.get("CAN_CHANNEL") or bus["channel"]
    bus["bitrate_bitps"] = bus["bitrate_bitps"] if bitrate is None else bitrate
    try:
        return config.model_copy(update={"bus": Bus.model_validate(bus)})
    except ValidationError as error:
        lines = [_line(e, bus, ("bus",)) for e in error.errors(include_url=False)]
        raise ConfigurationProblems([f"{origin}: {line}" for line in lines]) from None


def _validated(data: Mapping[str, Any], name: str) -> Config:
    try:
        return Config.model_validate(with_serial_bus(data))
    except ConfigurationError as error:
        raise ConfigurationProblems([f"{name}: {error.message}"]) from None
    except ValidationError as error:
        lines = [_line(e, data, ()) for e in error.errors(include_url=False)]
        _raise_if([f"{name}: {line}" for line in dict.fromkeys(lines)])
        raise


def _raise_if(lines: list[str]) -> None:
    if lines:
        raise ConfigurationProblems(lines)


# --- from pydantic's error list to our one line ---

# sections whose key `kind` decides what else is in them
_UNIONS = {
    "drive": "'canopen', 'elmo_serial'",
    "trajectory": "'sine', 'min_jerk', 'trapezoid', 'table', 'hold'",
}


def _model_at(location: tuple[str, ...], data: Mapping[str, Any]) -> type[BaseModel] | None:
    """The section class that holds the last element of `location`."""
    model: type[BaseModel] = Config
    for part in location[:-1]:
        field = model.model_fields.get(part)
        if field is None:
            return None
        options = [t for t in (field.annotation, *get_args(field.annotation)) if isinstance(t, type)]
        models = [t for t in options if issubclass(t, BaseModel)]
        if part in _UNIONS:
            kind = data.get(part, {}).get("kind")
            models = [t for t in models if get_args(t.model_fields["kind"].annotation) == (kind,)]
        if not models:
            return None
        model = models[0]
    return model


def _stem(key: str) -> str:
    head, _, tail = key.rpartition("_")
    return (head if head and tail.lower() in _UNITS else key).lower()


def suggestion(unknown: str, known: list[str]) -> str:
    """What the user probably meant by an unknown key, as the end of a message."""
    for key in known:
        if key != unknown and _stem(key) == _stem(unknown):
            return f": use {key} (the unit is part of the key)"
    close = difflib.get_close_matches(unknown, known, 1, 0.6) or difflib.get_close_matches(
        _stem(unknown), known, 1, 0.5
    )
    return f": did you mean {close[0]}?" if close else f": known are {', '.join(sorted(known))}"


def _line(error: Any, data: Mapping[str, Any], prefix: tuple[str, ...]) -> str:
    parts = [str(part) for part in error["loc"]]
    if len(parts) > 1 and parts[0] in _UNIONS:
        del parts[1]  # the tag of the union, which the user did not write
    location = (*prefix, *parts)
    name = ".".join(location)
    kind, value = error["type"], error["input"]
    model = _model_at(location, data)
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
        tags = error["ctx"].get("expected_tags", _UNIONS[location[0]])
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


def _rule(error: Any) -> str:
    if error["type"] == "literal_error":
        return f"must be one of {error['ctx']['expected']}"
    message = str(error["msg"])
    return message[0].lower() + message[1:]


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)
    text = " ".join(text.split()) or '""'
    return text if len(text) <= 60 else text[:57] + "..."
