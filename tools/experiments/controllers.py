"""The controllers that are compared: a table of named settings, and what configuration files add to it.

Every entry is a complete [control] section: that of configs/paper.toml with some keys replaced.  What the controller
believes about the friction is the base configuration's [friction], or that of the file it comes from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.analysis.gains import gains_of_file
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import Config, Control
from jointctl.tools.configuration.drive_section import require_simulated
from jointctl.tools.configuration.load import load_config, shipped_config, shipped_control
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.configuration.sections import Friction

_MODEL_BASED: dict[str, Any] = {"zero_rule": "zero", "filtered_error_rate": True}
_STIFF: dict[str, Any] = {**_MODEL_BASED, "kp": 2500.0, "kv": 130.0, "feed_forward": "lugre_desired"}
_OBSERVER: dict[str, Any] = {**_MODEL_BASED, "kind": "computed_torque_observer", "feed_forward": "lugre_desired"}

# name -> keys of [control] that differ from configs/paper.toml
TABLE: dict[str, dict[str, Any]] = {
    "computed_torque": {**_MODEL_BASED, "kind": "computed_torque", "feed_forward": "none"},
    "pid": {**_MODEL_BASED, "kind": "pid", "feed_forward": "none", "kp": 6075.0, "kv": 135.0, "ki": 91125.0},
    "paper_without_friction_model": {"feed_forward": "none"},
    "paper": {},
    "paper_desired": {"feed_forward": "desired"},
    "paper_lugre": {"feed_forward": "lugre_desired"},
    "network_stiff": {**_STIFF, "lyapunov_q": (2.756e6, 4630.0)},
    "observer": {**_OBSERVER, "observer_radps": 60.0},
    "observer_stiff": {**_OBSERVER, "observer_radps": 60.0, "kp": 2500.0, "kv": 100.0},
}
# of a base whose drive closes its own loops: keys of [drive.cascade] that differ from it; the law is computed torque
OF_DRIVES: dict[str, dict[str, Any]] = {
    "drive_alone": {"torque_offset": False, "velocity_offset": False, "lead_s": 0.0},
    "drive_without_torque": {"torque_offset": False},
}
PRECISE = "precise"  # configs/precise.toml
DEFAULT = (*TABLE, PRECISE)


@dataclass(frozen=True)
class Controller:
    """A law under test; `friction` None is the belief of the base configuration."""

    name: str
    control: Control
    friction: Friction | None = None
    cascade: Mapping[str, Any] = field(default_factory=dict)  # keys of [drive.cascade] that differ from the base's


def changed(control: Control, changes: Mapping[str, Any], name: str) -> Control:
    """`control` with some keys replaced, checked like a file; `name` is what the message calls it."""
    values = control.model_dump()
    # a section inside is given as a table of keys and replaces the whole section
    values.update(changes)
    try:
        return Control.model_validate(values)
    except ValidationError as error:
        raise ConfigurationError(one_line(error, name)) from None


def one_line(error: ValidationError, origin: str) -> str:
    """Its first problem: where, which key, its value, what is wrong."""
    first = error.errors(include_url=False)[0]
    key, message = ".".join(str(part) for part in first["loc"]), str(first["msg"])
    return f"{origin}: {key} (={first['input']}): {message[0].lower()}{message[1:]}"


def named(names: tuple[str, ...] = DEFAULT) -> list[Controller]:
    """Entries of the table; the name of a shipped or of any other configuration file takes that file's law."""
    paper = shipped_control("paper")
    found = []
    for name in names:
        if name in TABLE:
            found.append(Controller(name, changed(paper, TABLE[name], name)))
        elif name in OF_DRIVES:
            found.append(Controller(name, changed(paper, TABLE["computed_torque"], name), cascade=OF_DRIVES[name]))
        else:
            found.append(from_file(name))
    doubled = sorted({c.name for c in found if sum(c.name == other.name for other in found) > 1})
    if doubled:
        raise ConfigurationError(f"controller (={doubled[0]}) must be named once")
    return found


def from_file(name: str) -> Controller:
    """The law of a configuration file, with what that file believes about the friction, and its drive's own loops."""
    path = Path(name)
    if not path.exists() and shipped_config(name).exists():
        path = shipped_config(name)
    if not path.exists():
        known = ", ".join((*TABLE, *OF_DRIVES))
        raise ConfigurationError(f"controller (={name}) must be a configuration file or one of {known}")
    config = load_config(path)
    require_simulated(config, "study")
    cascade = canopen_section(config).cascade
    return Controller(path.stem, config.control, config.friction, {} if cascade is None else cascade.model_dump())


def controller_config(base: Config, controller: Controller) -> Config:
    """The base configuration under this law; contradictions between its sections are refused."""
    update: dict[str, Any] = {"control": controller.control}
    if controller.friction is not None:
        update["friction"] = controller.friction
    drive = base.drive
    if controller.cascade:
        if drive.own_loop() is CommandKind.TORQUE:
            raise ConfigurationError(
                f"controller {controller.name} needs a --base with drive.mode csp or csv",
                "such as that controller's own file",
            )
        cascade = canopen_section(base).cascade
        assert cascade is not None
        update["drive__cascade"] = cascade.model_copy(update=dict(controller.cascade))
    config = base.changed(**update)
    problems = problems_between_sections(config)
    if problems:
        raise ConfigurationError(f"controller {controller.name}: {problems[0]}")
    return config


def with_chosen_gains(base: Config, controller: Controller) -> Controller:
    """The law with gains for what is believed of the base joint, and learning that converges on it."""
    config = controller_config(base, controller)
    control = gains_of_file(config, loop_settings(config)[0]).control
    return replace(controller, control=control)


def controller_constants(base: Config, controller: Controller, start_position_rad: float) -> Any:
    """`AxisConstants` of this law on the base joint, unsupervised: simulated time has no wall clock."""
    constants = axis_constants(
        controller_config(base, controller), trajectory_table(base), start_position_rad=start_position_rad
    )
    constants[0].sequence.supervisor_max_cycles = 0
    return constants
