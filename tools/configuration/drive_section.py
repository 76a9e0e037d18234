"""[drive]: what the section of every drive offers to the rest, and which class belongs to which `kind`.

A drive is a plug-in of four parts, each behind a table of its kinds: its section here, what a session does with it
(`tools.session.session_drive`), its loop (`tools.session.loops`), and what the verbs at the bench do with it
(`tools.verbs.bench_drive`).  A new kind is one entry in each table; nothing else asks which drive it is.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic_core import PydanticCustomError

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.configuration.sections import Ampere, Direction, Section

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config


@dataclass(frozen=True)
class GivenPlace:
    """What the command line says of where the drive is; None = as configured."""

    interface: str | None = None
    channel: str | None = None
    bitrate: int | None = None
    port: str | None = None
    node: int | None = None

    @property
    def bus(self) -> str | int | None:
        """What names a CAN bus; None if nothing does."""
        return next((value for value in (self.interface, self.channel, self.bitrate) if value is not None), None)

    def of_bus(self, number: int) -> GivenPlace:
        """For the drives on one of an arm's buses, which are counted from 0: on the second virtual bus NAME.2."""
        if number == 0 or self.channel is None:
            return self
        return replace(self, channel=f"{self.channel}.{number + 1}")


@dataclass(frozen=True)
class SentWithTarget:
    """What a drive that closes its own loop gets beside the desired motion."""

    lead_s: float  # by which the motion is sent ahead of its time
    position_gain_ps: float  # of the position loop here, where the drive closes the velocity loop alone
    torque_offset: bool


class DriveSection(Section, ABC):
    """The section of any drive."""

    kind: str
    ampere: Ampere = "sine_amplitude"  # of the drive's amperes
    torque_direction: Direction = 1  # -1: positive motor torque drives the joint to negative angles

    simulated: ClassVar[bool] = False  # its joint can be simulated faster than real time
    sends_frames: ClassVar[bool] = False  # on a CAN bus that others can listen to
    begins_within_s: ClassVar[float] = math.inf  # it leaves "off" once it is asked to enable, or will not at all
    when_the_loop_ends: ClassVar[str]  # by accident: what becomes of the joint
    torque_source: ClassVar[str]  # for a sweep's data: which reading the torque comes from

    @classmethod
    def completed(cls, data: dict[str, Any]) -> dict[str, Any]:
        """The raw configuration with the sections that this one stands for."""
        return data

    @abstractmethod
    def problems(self, config: Config) -> list[str]:
        """What does not fit together, one line each, without the file name."""

    def files(self, config: Config) -> tuple[tuple[str, Path], ...]:
        """(key, path) of the files that the section names."""
        return ()

    @abstractmethod
    def moved(self, config: Config, given: GivenPlace, environ: Mapping[str, str]) -> Config:
        """The configuration of a drive that is elsewhere."""

    def silence_s(self) -> float | None:
        """Period of the heartbeat that the drive itself sends; None: it sends none."""
        return None

    def motor_current(self) -> tuple[str, float] | None:
        """The current that the drive is set up for [A], with its key; None where the configuration does not have it."""
        return None

    def own_loop(self) -> CommandKind:
        """What the loop commands: torque, or what the drive closes the loop for."""
        return CommandKind.TORQUE

    def sent_with_target(self, rate_Hz: float) -> SentWithTarget | None:
        """For a drive that closes its own loop in a run; None: torque is commanded."""
        return None

    @abstractmethod
    def assumed_delay(self, config: Config) -> tuple[float, str]:
        """The loop delay [s] where none is measured or configured, and why."""

    @abstractmethod
    def in_sweep_mode(self, mode: str) -> Self:
        """For `sweep --mode`: auto, csv, pv, speed, or torque (as the section says)."""

    def free_of_torque_limit(self) -> Self:
        """Without a torque limit of its own: it follows from `limits.torque_max_Nm`."""
        return self

    def constants_factor(self, config: Config) -> tuple[float, str] | None:
        """By how much the constants that scale the torque contradict each other, in words too; None: unknown."""
        return None

    def coarse_numbers(self, config: Config) -> list[str]:
        """One line for each number that the drive sends or takes in steps which are coarse for the joint's limits."""
        return []

    def measuring_constants(self) -> dict[str, float]:
        """What scales the readings of a sweep, besides the constants that all drives have."""
        return {}


def _canopen() -> type[DriveSection]:
    from jointctl.tools.configuration.canopen import CanopenSection

    return CanopenSection


def _elmo_serial() -> type[DriveSection]:
    from jointctl.tools.configuration.elmo import ElmoSection

    return ElmoSection


_SECTIONS: dict[str, Callable[[], type[DriveSection]]] = {"canopen": _canopen, "elmo_serial": _elmo_serial}
DEFAULT_KIND = "canopen"  # of a file that does not say
KINDS = tuple(_SECTIONS)
KINDS_TEXT = ", ".join(f"'{kind}'" for kind in KINDS)


def section_class(kind: object) -> type[DriveSection] | None:
    """The class of [drive] for drive.kind; None for what is no kind.  Only that drive's modules are loaded."""
    load = _SECTIONS.get(kind) if isinstance(kind, str) else None
    return load() if load is not None else None


def checked_drive(value: object) -> Any:
    """For pydantic: the section of its kind."""
    if not isinstance(value, dict):
        return value
    section = section_class(value.get("kind"))
    if section is None:
        problem = "union_tag_invalid" if "kind" in value else "union_tag_not_found"
        raise PydanticCustomError(problem, "kind must be one of {expected_tags}", {"expected_tags": KINDS_TEXT})
    return section.model_validate(value)


def completed(data: Any) -> Any:
    """`DriveSection.completed` of the raw configuration's own kind; what is no configuration is returned as it is."""
    drive = data.get("drive") if isinstance(data, dict) else None
    section = section_class(drive.get("kind")) if isinstance(drive, dict) else None
    return data if section is None else section.completed(data)


FOR_A_PORT, FOR_A_NODE = '"elmo_serial" for a serial port', '"canopen" here'


def wrong_kind(path: Path, kind: object, wanted: str, hint: str = "") -> ConfigurationError:
    """That the drive of the file is of another kind than the `wanted` one, as `FOR_A_PORT` says it."""
    return ConfigurationError(f"{path}: drive.kind (={kind}) must be {wanted}", hint)


def require_simulated(config: Config, what: str) -> None:
    """`ConfigurationError` where the joint can be simulated in real time only."""
    if not config.drive.simulated:
        hint = "the serial joint runs in real time only: `jointctl hil --serial`, then `jointctl run CONFIG -p PORT`"
        raise wrong_kind(config.path, config.drive.kind, f'"canopen" for {what}', hint)


def require_torque(config: Config, what: str) -> None:
    """`ConfigurationError` where the drive closes its own loop: `what` moves the joint by torque."""
    if config.drive.own_loop() is not CommandKind.TORQUE:
        raise ConfigurationError(
            f"{config.path}: drive.mode must be cst, tq or auto for {what}: it moves the joint by torque",
            "take a copy of the file with that mode and without [drive.cascade]",
        )
