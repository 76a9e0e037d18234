"""What a study compares: how many plants of which kind, under which controllers; from flags and from a TOML file.

plants = 40
seed = 1
scenario = "sine"                 # sine, frequency, amplitude, load
controllers = ["paper", "precise", "my_joint.toml"]

[plant]                           # any of the ranges of `EnsembleSettings`
encoder_bits = [14, 16]

[variants.more_damping]           # keys of [control] changed, on top of a named controller
of = "precise"
kv = 180.0
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.tools.configuration.problems import suggestion
from jointctl.tools.configuration.sections import Section, between
from jointctl.tools.experiments.controllers import DEFAULT, Controller, changed, named, one_line
from jointctl.tools.experiments.ensemble import EnsembleSettings
from jointctl.tools.experiments.scenarios import Scenario


def _names(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


class StudySettings(Section):
    """One study; a flag of the command line replaces the value of the file."""

    plants: Annotated[int, between(1, 100_000)] = 40
    seed: Annotated[int, between(0, 2**31)] = 1
    after_s: Annotated[float, between(0.0, 1e5)] = 75.0  # errors count from here on
    scenario: Scenario = "sine"
    base: str = "precise"  # configuration of everything but law and plant
    controllers: Annotated[tuple[str, ...], BeforeValidator(_names)] = DEFAULT
    plant: EnsembleSettings = EnsembleSettings()
    variants: dict[str, dict[str, Any]] = Field(default_factory=dict)


def load_study(path: Path) -> StudySettings:
    """Read and check a study file; names of files in it are relative to the working folder."""
    try:
        data = parse_toml(read_input(path).decode("utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{path}: cannot be read as TOML: {reason}") from None
    return checked(data, str(path))


def checked(data: dict[str, Any], origin: str) -> StudySettings:
    """`StudySettings` of these keys; the first problem as one line that begins with `origin`."""
    try:
        return StudySettings.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "extra_forbidden":
            model = EnsembleSettings if first["loc"][0] == "plant" else StudySettings
            known = list(model.model_fields)
            hint = suggestion(str(first["loc"][-1]), known)
            key = ".".join(str(part) for part in first["loc"])
            raise ConfigurationError(f"{origin}: {key} is not a known key{hint}") from None
        raise ConfigurationError(one_line(error, origin)) from None


def study_controllers(settings: StudySettings) -> list[Controller]:
    """The named ones, then the variants."""
    found = named(settings.controllers)
    for name, keys in settings.variants.items():
        if "of" not in keys:
            raise ConfigurationError(f"variants.{name}.of is missing: the controller that it changes")
        if any(controller.name == name for controller in found):
            raise ConfigurationError(f"variants.{name} must not have the name of another controller")
        parent = named((str(keys["of"]),))[0]
        changes = {key: value for key, value in keys.items() if key != "of"}
        found.append(Controller(name, changed(parent.control, changes, f"variants.{name}"), parent.friction))
    return found
