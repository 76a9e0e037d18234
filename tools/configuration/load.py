"""Read and check a TOML configuration: `load_config(path)` gives a frozen `Config` or one line for each problem."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from jointctl.drivers.can.channel import split_channel
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import (
    LARGEST_TABLE_BYTES,
    LARGEST_TEXT_BYTES,
    parse_toml,
    read_input,
    require_input,
)
from jointctl.tools.configuration.bus_options import whole_channel
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config
from jointctl.tools.configuration.elmo import with_serial_bus
from jointctl.tools.configuration.problems import ConfigurationProblems, problem_line, problem_lines, raise_if
from jointctl.tools.configuration.sections import Bus, Drive


def shipped_config(name: str) -> Path:
    """Path of a configuration shipped with the package, with or without `.toml`."""
    return SHIPPED_FOLDER / (name if name.endswith(".toml") else f"{name}.toml")


def read_text(path: Path) -> str:
    """Text of a configuration file, without the mark that some editors begin it with.

    `ConfigurationError` if it cannot be read as such.
    """
    known = ", ".join(sorted(p.stem for p in SHIPPED_FOLDER.glob("*.toml")))
    try:
        return read_input(path).decode("utf-8-sig")
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
    text = read_text(path)
    try:
        data = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    config = _validated(data, str(path))
    config._path, config._text = path, text
    raise_if([f"{path}: {line}" for line in problems_between_sections(config) + _plant_problems(config)])
    eds_path = config.eds_path if isinstance(config.drive, Drive) else None
    for key, file in (
        ("drive.eds", eds_path),
        ("joint_encoder.eds", config.encoder_eds_path),
        ("trajectory.file", config.table_path),
    ):
        if file is None:
            continue
        if not os.path.isfile(file):
            raise_if([f"{path}: {key} (={file.name}) must name a file beside the configuration or a shipped one"])
        try:
            require_input(file, LARGEST_TABLE_BYTES if key == "trajectory.file" else LARGEST_TEXT_BYTES)
        except OSError as error:
            raise_if([f"{path}: {key} (={file.name}): cannot be read: {error.strerror or error}"])
    return config


def _plant_problems(config: Config) -> list[str]:
    """What the virtual joint refuses about [virtual]; a configuration without one loads nothing of it."""
    if config.virtual is None:
        return []
    from jointctl.tools.configuration.plant_settings import plant_problems

    return plant_problems(config)


def with_bus_overrides(
    config: Config,
    interface: str | None = None,
    channel: str | None = None,
    bitrate: int | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """The configuration on another bus: flag beats environment (CAN_INTERFACE, _CHANNEL, _BITRATE) beats file."""
    if config.is_serial:
        given = next((value for value in (interface, channel, bitrate) if value is not None), None)
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
    own = bus["interface"]
    bus["interface"] = interface or environ.get("CAN_INTERFACE") or own
    if bus["interface"] != own:  # what the file says besides is for the interface of the file
        bus["channel"], bus["options"] = split_channel(bus["channel"])[0], None
    bus["channel"] = channel or environ.get("CAN_CHANNEL") or bus["channel"]
    bus["bitrate_bitps"] = bus["bitrate_bitps"] if bitrate is None else bitrate
    try:
        return config.model_copy(update={"bus": whole_channel(Bus.model_validate(bus))})
    except PydanticCustomError as error:
        raise ConfigurationProblems([f"{origin}: bus.{error.message()}"]) from None
    except ValidationError as error:
        lines = [problem_line(e, bus, ("bus",)) for e in error.errors(include_url=False)]
        raise ConfigurationProblems([f"{origin}: {line}" for line in lines]) from None


def _validated(data: Mapping[str, Any], name: str) -> Config:
    try:
        return Config.model_validate(with_serial_bus(data))
    except ConfigurationError as error:
        raise ConfigurationProblems([f"{name}: {error.message}"]) from None
    except ValidationError as error:
        raise_if([f"{name}: {line}" for line in problem_lines(error.errors(include_url=False), data)])
        raise
