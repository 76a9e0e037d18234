"""Read and check a TOML configuration: `load_config(path)` gives a frozen `Config` or one line for each problem."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import (
    LARGEST_TABLE_BYTES,
    LARGEST_TEXT_BYTES,
    parse_toml,
    read_input,
    require_input,
)
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config, ConfigurationProblems, problem_lines, raise_if
from jointctl.tools.configuration.drive_section import GivenPlace, completed
from jointctl.tools.configuration.units import with_units

SPELT_ALIKE = 0.7  # of difflib's ratio


def shipped_config(name: str) -> Path:
    """Path of a configuration shipped with the package, with or without `.toml`."""
    return SHIPPED_FOLDER / (name if name.endswith(".toml") else f"{name}.toml")


def _meant(path: Path) -> str:
    """The shipped configuration, or the file beside, whose name is spelt alike; "" if there is none."""
    shipped = {each.stem: each.stem for each in SHIPPED_FOLDER.glob("*.toml")} if path.parent == Path() else {}
    beside = {each.name: str(each) for each in path.parent.glob("*.toml")}
    near = difflib.get_close_matches(path.name, [*shipped, *beside], n=1, cutoff=SPELT_ALIKE)
    return f"did you mean {({**shipped, **beside})[near[0]]}?" if near else ""


def read_text(path: Path) -> str:
    """Text of a configuration file, without the mark that some editors begin it with.

    `ConfigurationError` if it cannot be read as such.
    """
    known = ", ".join(sorted(p.stem for p in SHIPPED_FOLDER.glob("*.toml")))
    try:
        return read_input(path).decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: no such file", _meant(path) or f"shipped configurations: {known}") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: is a folder, not a configuration file") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from None


RENAMED = {  # keys of an older version, read until the next one
    "control": {"q": "lyapunov_q", "matched_filter": "filtered_error_rate"},
}


def renamed(data: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The raw configuration with the present names of its keys, and a remark for each old one."""
    remarks = []
    for section, keys in RENAMED.items():
        values = data.get(section)
        for old, new in keys.items():
            if isinstance(values, dict) and old in values and new not in values:
                values = {new if key == old else key: value for key, value in values.items()}
                data = {**data, section: values}
                remarks.append(f"{section}.{old} is called {section}.{new} now; the next version does not read {old}")
    return data, tuple(remarks)


def load_config(path: str | Path) -> Config:
    """Read, check and freeze a configuration; `ConfigurationError` holds one line per problem.

    What only the virtual joint can judge of [virtual] is judged where it is made (`plant_settings`).
    """
    path = Path(path)
    text = read_text(path)
    try:
        data = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    data, remarks = renamed(data)
    data, converted = with_units(data)
    config = _validated(data, str(path))
    config._path, config._text, config._remarks = path, text, (*remarks, *converted)
    raise_if([f"{path}: {line}" for line in problems_between_sections(config)])
    table = (("trajectory.file", config.table_path),) if config.table_path is not None else ()
    for key, file in (*config.drive.files(config), *table):
        if not os.path.isfile(file):
            raise_if([f"{path}: {key} (={file.name}) must name a file beside the configuration or a shipped one"])
        try:
            require_input(file, LARGEST_TABLE_BYTES if key == "trajectory.file" else LARGEST_TEXT_BYTES)
        except OSError as error:
            raise_if([f"{path}: {key} (={file.name}): cannot be read: {error.strerror or error}"])
    return config


def moved(config: Config, given: GivenPlace, environ: Mapping[str, str] | None = None) -> Config:
    """The configuration of a drive that is elsewhere: flag beats environment (CAN_INTERFACE, ...) beats file."""
    return config.drive.moved(config, given, os.environ if environ is None else environ)


def _validated(data: Mapping[str, Any], name: str) -> Config:
    try:
        return Config.model_validate(completed(data))
    except ConfigurationError as error:
        raise ConfigurationProblems([f"{name}: {error.message}"]) from None
    except ValidationError as error:
        raise_if([f"{name}: {line}" for line in problem_lines(error.errors(include_url=False), data)])
        raise
