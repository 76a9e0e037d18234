"""What the verbs at the bench do with a drive, whatever its kind: the last part of a drive's plug-in.

The first is its section (`tools.configuration.drive_section`), the second what a session does with it
(`tools.session.session_drive`).  The modules of a kind are loaded when one of its methods is called: `stop` is not to
wait for what `monitor` needs, nor `--help` for the configuration.
"""

from __future__ import annotations

import contextlib
import os
import re
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from jointctl.drivers.errors import ConfigurationError, JointctlError, UsageError
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.tools.output import Output
from jointctl.tools.scoping.remote_options import NOBODY, ObserveOptions
from jointctl.tools.verbs.verb_options import BusOptions, CanOptions, configurations, loaded, place

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.configuration.drive_section import GivenPlace
    from jointctl.tools.inspection.health import Finding
    from jointctl.tools.inspection.subject import Subject
    from jointctl.tools.verbs.monitor import MonitorOptions

_HEADING = re.compile(r"\s*\[\s*(\w+)\s*\]\s*(#.*)?")
_HINT = "it can be given on the command line: -i, -c, -b and -t, or -p for a serial port"


@dataclass(frozen=True)
class Asked:
    """What a verb is to look at: the drive of a configuration, or what the command line names."""

    config: Config | None
    given: GivenPlace
    eds: Path | None = None


MaybeConfig = Annotated[
    Path | None,
    typer.Argument(
        metavar="[CONFIG]", help="configuration; without it give the bus by -i and -c", autocompletion=configurations
    ),
]
Eds = Annotated[Path | None, typer.Option("--eds", help="EDS or DCF file of the node; default: the configuration's")]


def asked_of(path: Path | None, bus: CanOptions, eds: Path | None = None) -> Asked:
    """The configuration if one is named, else what the command line says."""
    given = place(bus)
    if path is None and given.port is not None:
        raise ConfigurationError("-p needs a configuration: it tells the baud rate", "for example elmo_serial")
    return Asked(None if path is None else loaded(path, bus), given, eds)


def subject_of(path: Path | None, bus: CanOptions, eds: Path | None = None) -> Subject:
    """For a verb that is for CANopen only."""
    from jointctl.tools.verbs.canopen_bench import canopen_subject

    return canopen_subject(asked_of(path, bus, eds))


def _asked(*, config: MaybeConfig = None, bus: BusOptions, eds: Eds = None) -> Asked:
    return asked_of(config, bus, eds)


def _subject(*, config: MaybeConfig = None, bus: CanOptions) -> Subject:
    return subject_of(config, bus)


def _subject_with_eds(*, config: MaybeConfig = None, bus: CanOptions, eds: Eds = None) -> Subject:
    return subject_of(config, bus, eds)


AskedDrive = Annotated["Asked", _asked]
NodeOnBus = Annotated["Subject", _subject]
NodeWithEds = Annotated["Subject", _subject_with_eds]


@dataclass(frozen=True)
class ServeOptions:
    """How the virtual joint is kept up."""

    timing: bool = False
    serial: bool = False
    port: str | None = None
    link: str | None = None
    ready_fd: int | None = None
    live: ObserveOptions = NOBODY


class StopTarget(Protocol):
    """Where to say "stop": as much as can be said of a drive whose configuration need not hold."""

    @property
    def place(self) -> tuple[str, str]:
        """Interface and channel, as the lock of the bus has them."""

    def switch_off(self, output: Output) -> str:
        """The drive's state in words, after it was commanded to stop and to switch off."""


class BenchDrive(ABC):
    """One for each kind of drive; `bench_drive` gives it."""

    def claims(self, keys: ReadableKeys) -> bool:
        """Whether a file whose drive.kind cannot be read, and the command line, mean this kind."""
        return False

    @abstractmethod
    def stop_target(self, keys: ReadableKeys) -> StopTarget:
        """Where to say "stop"; `ConfigurationError`: what is missing."""

    @abstractmethod
    def info(self, asked: Asked, output: Output) -> int:
        """`jointctl info`: what the drive tells about itself.  Reads only."""

    @abstractmethod
    def monitor(self, asked: Asked, output: Output, options: MonitorOptions) -> int:
        """`jointctl monitor`: what goes on, line by line.  Writes nothing."""

    @abstractmethod
    def findings(self, config: Config) -> Iterator[Finding]:
        """Of `jointctl doctor`: what bus or line, and the drive on it, allow."""

    @abstractmethod
    def serve(self, config: Config, output: Output, options: ServeOptions) -> int:
        """`jointctl hil`: keep the virtual joint up until a stop signal."""

    def serve_arm(self, arm: ArmConfig, output: Output, options: ServeOptions) -> int:
        """`serve` for all joints of an arm."""
        raise ConfigurationError(f"{arm.path}: its virtual joints have no drive of this kind")

    def require_rate(self, config: Config) -> None:  # noqa: B027  (most buses need nothing)
        """`ConfigurationError` with advice where bus or line cannot carry the rate that `check` is to judge."""

    def check_rows(self, config: Config) -> tuple[tuple[str, str, str], ...]:
        """Rows of the table of `check`."""
        return ()


def _canopen() -> BenchDrive:
    from jointctl.tools.verbs.canopen_bench import CanopenBench

    return CanopenBench()


def _elmo_serial() -> BenchDrive:
    from jointctl.tools.verbs.elmo_bench import ElmoBench

    return ElmoBench()


_DRIVES: dict[str, Callable[[], BenchDrive]] = {"canopen": _canopen, "elmo_serial": _elmo_serial}


def bench_drive(kind: str) -> BenchDrive:
    """For drive.kind; only that drive's modules are loaded."""
    return _DRIVES[kind]()


def bench_of(config: Config | None) -> BenchDrive:
    """Of a configuration; without one a CANopen node is meant."""
    from jointctl.tools.configuration.drive_section import DEFAULT_KIND

    return bench_drive(DEFAULT_KIND if config is None else config.drive.kind)


# --- Where to say "stop", from a configuration that need not hold ---
# A file that is being edited while the joint moves must not cost the stop: only bus and node, or port and baud rate,
# are looked at, each key by itself where the file is no TOML any more.  What the command line gives need not be in it.


@dataclass(frozen=True)
class ReadableKeys:
    """The sections of a file as far as they can be read, and what else is said about the place."""

    path: Path
    sections: Mapping[str, Mapping[str, Any]]
    given: GivenPlace
    environ: Mapping[str, str]
    unread: str = ""  # why the file cannot be read

    def section(self, name: str) -> Mapping[str, Any]:
        """Empty where there is none."""
        return self.sections.get(name, {})

    def required(self, key: str, values: list[Any], good: Callable[[Any], bool], rule: str) -> Any:
        """The first value that is given; `ConfigurationError` unless it is good."""
        name = f"{self.path}: {self.unread}{key}"
        value = next((value for value in values if value is not None), None)
        if value is None:
            raise ConfigurationError(f"{name} is missing", _HINT)
        if not good(value):
            raise ConfigurationError(f"{name} (={value}) must be {rule}", _HINT)
        return value

    def seconds(self, section: str, key: str, most: float = 10.0) -> float | None:
        """A time-out; none rather than one that cannot be right."""
        value = self.section(section).get(key)
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and 0.01 <= value <= most
        return float(value) if good and value is not None else None


def is_text(value: object) -> bool:
    """Whether it names something."""
    return isinstance(value, str) and bool(value)


def readable_keys(
    path: Path, given: GivenPlace | None = None, environ: Mapping[str, str] | None = None
) -> ReadableKeys:
    """Of a file; where it is no TOML as a whole, every line that is a key of its own."""
    from jointctl.tools.configuration.drive_section import GivenPlace

    given, environ = given or GivenPlace(), os.environ if environ is None else environ
    try:
        text = read_input(path).decode("utf-8-sig", "replace")
    except OSError as error:
        return ReadableKeys(path, {}, given, environ, f"cannot be read: {error.strerror or error}; ")
    try:
        data = parse_toml(text)
    except tomllib.TOMLDecodeError:
        data = {}
        section: dict[str, Any] = {}
        for line in text.splitlines():
            heading = _HEADING.fullmatch(line)
            if heading:
                section = data.setdefault(heading[1], {})
                continue
            with contextlib.suppress(tomllib.TOMLDecodeError):
                section.update(parse_toml(line))
    return ReadableKeys(path, {name: found for name, found in data.items() if isinstance(found, dict)}, given, environ)


def stop_targets(path: Path, given: GivenPlace | None = None) -> tuple[dict[str, StopTarget], list[JointctlError]]:
    """`stop_target` of a joint's file, or of each joint that an arm's file names, by name; beside them what is wrong.

    A joint of an arm that cannot be read must not cost the stop of the others, nor must a node, which is one joint's.
    """
    joints = readable_keys(path).section("arm").get("joints")
    if not isinstance(joints, list) or not joints:
        return {path.name: stop_target(path, given)}, []
    targets: dict[str, StopTarget] = {}
    problems: list[JointctlError] = []
    of_one = None if given is None else given.node
    given = None if given is None else replace(given, node=None)
    buses: dict[tuple[str, str], int] = {}
    for name in joints:
        file, its_given = path.parent / str(name), given
        if given is not None and given.channel is not None:
            section = readable_keys(file).section("bus")
            place = str(section.get("interface")), str(section.get("channel"))
            its_given = given.of_bus(buses.setdefault(place, len(buses)))
        try:
            targets[str(name)] = stop_target(file, its_given)
        except ConfigurationError as error:
            problems.append(error)
    if not targets:
        raise problems[0]
    if of_one is not None:
        what = f"--target (={of_one}) is one joint's, and {path} is an arm, stopped at the nodes of its files"
        problems.append(UsageError(what, "give the joint's file"))
    return targets, problems


def stop_target(path: Path, given: GivenPlace | None = None, environ: Mapping[str, str] | None = None) -> StopTarget:
    """Flag beats environment (CAN_INTERFACE, _CHANNEL, _BITRATE) beats file; `ConfigurationError`: what is missing."""
    from jointctl.tools.configuration.drive_section import DEFAULT_KIND, KINDS

    keys = readable_keys(path, given, environ)
    kind = keys.section("drive").get("kind", "")
    if "kind" not in keys.section("drive"):
        kind = next((name for name in KINDS if bench_drive(name).claims(keys)), DEFAULT_KIND)
    return bench_drive(kind if kind in KINDS else DEFAULT_KIND).stop_target(keys)
