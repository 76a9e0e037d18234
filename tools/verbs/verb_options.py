"""Options and arguments that several verbs share, and how a verb's signature becomes its command line.

A verb is one function, for Typer and for Python: `run(config, output, assume_yes=True)`.  A parameter may stand for
several options: its type is then a dataclass, whose fields they are, or `Annotated["Type", function]` with the function
that builds it, whose parameters they are.

Every module of this package is loaded for `--help` and before `stop`: what takes its time is imported in functions.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, is_dataclass, replace
from functools import partial, wraps
from importlib import resources
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.core import TyperCommand, TyperGroup

from jointctl.drivers.errors import UsageError
from jointctl.firmware_py.slow_start import slow_start
from jointctl.tools.output import Output, abandon

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.configuration.drive_section import GivenPlace

# headings of `jointctl --help`
BEGIN, MOVE, INSPECT, FRICTION = "Begin", "Move a joint", "Look at a bus and a drive", "Friction"
LOOK, COMPARE = "Look at a run", "Compare and measure"


def shipped_configurations(begun: str) -> list[str]:
    """For the shell's completion: names of shipped configurations."""
    names = (Path(file.name) for file in resources.files("jointctl.configs").iterdir())
    return sorted(name.stem for name in names if name.suffix == ".toml" and name.stem.startswith(begun))


def _files(begun: str, pattern: str) -> list[str]:
    folder, name = os.path.split(begun)
    files = (path.name for path in Path(folder).glob(pattern))
    return sorted(os.path.join(folder, file) for file in files if file.startswith(name))


def configuration_files(begun: str) -> list[str]:
    """For the shell's completion: TOML files; with none the shell goes on with folders."""
    return _files(begun, "*.toml")


def configurations(begun: str) -> list[str]:
    """For the shell's completion: shipped configurations, and files of joints."""
    return [*shipped_configurations(begun), *configuration_files(begun)]


def logs_and_configurations(begun: str) -> list[str]:
    """For the shell's completion: run logs as well."""
    return [*_files(begun, "*.mcap"), *configurations(begun)]


Interface = Annotated[str | None, typer.Option("-i", "--interface", help="python-can interface (env CAN_INTERFACE)")]
Channel = Annotated[
    str | None,
    typer.Option("-c", "--channel", help="bus channel, with options: can0,host=...,port=... (env CAN_CHANNEL)"),
]
Bitrate = Annotated[int | None, typer.Option("-b", "--bitrate", help="bit/s (env CAN_BITRATE)")]
Port = Annotated[str | None, typer.Option("-p", "--port", help="serial port of an elmo_serial drive")]
Target = Annotated[
    int | None, typer.Option("-t", "--target", help="CANopen node instead of drive.node", min=1, max=127)
]
Json = Annotated[bool, typer.Option("--json", help="result as one JSON document on stdout")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress on stderr")]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="FILE.html", help="the result as one self-contained page as well")
]
ConfigPath = Annotated[
    Path,
    typer.Argument(
        metavar="CONFIG", help="configuration file (TOML), or the name of a shipped one", autocompletion=configurations
    ),
]
Yes = Annotated[bool, typer.Option("-y", "--yes", help="move without asking")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="commission, show the motion envelope, move nothing")]
AllowLowMargin = Annotated[
    bool, typer.Option("--allow-low-margin", help="run a stable loop below the wanted phase margin")
]


@dataclass(frozen=True)
class CanOptions:
    """Which CAN bus and node; None = as configured."""

    interface: Interface = None
    channel: Channel = None
    bitrate: Bitrate = None
    target: Target = None


@dataclass(frozen=True)
class BusOptions(CanOptions):
    """Which bus or port, and which node; None = as configured."""

    port: Port = None


AS_CONFIGURED = BusOptions()


def config_path(path: Path) -> Path:
    """The file itself, or a shipped configuration of that name."""
    from jointctl.tools.configuration.load import shipped_config

    shipped = shipped_config(str(path))
    return shipped if not os.path.exists(path) and os.path.exists(shipped) else path


def place(bus: CanOptions) -> GivenPlace:
    """What the command line says of bus, port and node."""
    from jointctl.tools.configuration.drive_section import GivenPlace

    port = bus.port if isinstance(bus, BusOptions) else None
    return GivenPlace(bus.interface, bus.channel, bus.bitrate, port, bus.target)


def loaded(config: Path, bus: CanOptions = AS_CONFIGURED) -> Config:
    """The configuration with what the command line and the environment say about bus, port and node."""
    from jointctl.tools.configuration.load import load_config, moved

    found = load_config(config_path(config))
    for remark in found.remarks:
        Output().warning(f"{found.path}: {remark}")
    return moved(found, place(bus))


def loaded_joint_or_arm(config: ConfigPath, bus: BusOptions = AS_CONFIGURED) -> Config | ArmConfig:
    """As `loaded`; of an arm's file the arm, all joints on the bus that is named."""
    from jointctl.tools.configuration.arm import load_joint_or_arm

    found = load_joint_or_arm(config_path(config))
    for remark in found.remarks:
        Output().warning(f"{found.path}: {remark}")
    return on_bus(found, place(bus))


def on_bus(
    found: Config | ArmConfig, given: GivenPlace, environ: Mapping[str, str] | None = None
) -> Config | ArmConfig:
    """See `moved`; of an arm each of its joints is where the command line says, see `GivenPlace.of_bus`.

    `UsageError` for what is one joint's alone, and for one channel where there are several buses that are not virtual.
    """
    from jointctl.tools.configuration.config import Config, first_on_bus, raise_if
    from jointctl.tools.configuration.load import moved

    if isinstance(found, Config):
        return moved(found, given, environ)
    from jointctl.tools.configuration.arm import bus_problems

    if given.node is not None:
        raise UsageError(
            f"--target (={given.node}) is one joint's, and {found.path} is an arm", "give the joint's file"
        )
    buses = first_on_bus(found.joints)
    numbers = sorted(set(buses))
    joints = tuple(
        moved(joint, given.of_bus(numbers.index(bus)), environ) for joint, bus in zip(found.joints, buses, strict=True)
    )  # fmt: skip
    real = [joint.path for joint in joints if joint.bus.interface != "jointctl"]
    if given.channel is not None and len(numbers) > 1 and real:
        raise UsageError(
            f"--channel (={given.channel}) names one bus, and the joints of {found.path} are on {len(numbers)}",
            "bus.channel in the joints' files names them",
        )
    raise_if([f"{found.path}: {line}" for line in bus_problems(found.arm, joints)])
    return replace(found, joints=joints)


# --- What the command line makes of an option besides ---

_WITH_UNIT = re.compile(r"\s*[-+]?[\d.].*[^\W\d_].*|\s*[-+]?[\d.].*[%‰°]\s*")


def _with_units(parse: Callable[..., Any], args: list[str]) -> Any:
    """What was given by name of option: a quantity in a unit of its kind, "30 deg" for `angle_rad`, as a number."""
    given, *rest = parse(args)
    for name, text in given.items():
        if not (isinstance(text, str) and _WITH_UNIT.fullmatch(text)):
            continue
        from jointctl.tools.configuration.load import echo, understood  # takes its time

        if (number := understood(name, text)) is not None:
            Output().note(echo(name, text, number))
            given[name] = repr(number)
    return given, *rest


@contextmanager
def _unread_is_no_error() -> Iterator[None]:
    """Of a page of help, the version or a shell's completion."""
    try:
        yield
    except BrokenPipeError:
        abandon(sys.stdout)
        raise typer.Exit from None


class _Page:
    """Of help, before Typer's own class: a flag shows no type there."""

    def format_help(self, *args: Any) -> None:
        with suppress(SystemExit):  # of rich, which drops what nobody reads any more, and would end with 1
            super().format_help(*args)  # type: ignore[misc]

    def get_params(self, ctx: Any) -> Any:
        options = super().get_params(ctx)  # type: ignore[misc]
        for option in options:
            if getattr(option, "is_flag", False) and option.metavar is None:
                option.metavar = ""
        return options


class Verb(_Page, TyperCommand):
    """A number whose name has a unit may be given in another one."""

    def make_context(self, *args: Any, **keywords: Any) -> Any:
        """What was given to the verb; the page of help, and its end."""
        with _unread_is_no_error():
            return super().make_context(*args, **keywords)

    def make_parser(self, ctx: Any) -> Any:
        """The parser, and then the units."""
        parser = super().make_parser(ctx)
        vars(parser)["parse_args"] = partial(_with_units, parser.parse_args)
        return parser


@contextmanager
def _interruption_kept() -> Iterator[None]:
    """Typer makes an exit code of a KeyboardInterrupt, and no word; it leaves this one to the program."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise typer.Abort(*error.args) from None


class Verbs(_Page, TyperGroup):
    """An interruption is one for the program, and so is a broken pipe."""

    def make_context(self, *args: Any, **keywords: Any) -> Any:
        """What was given on the command line, which may be a configuration."""
        with _interruption_kept(), _unread_is_no_error():
            return super().make_context(*args, **keywords)

    def invoke(self, ctx: Any) -> Any:
        """The verb."""
        with _interruption_kept():
            try:
                return super().invoke(ctx)
            except BrokenPipeError as error:  # no stream of `Output`; Typer would end with 1, and no word
                raise RuntimeError(str(error)) from error


# --- Parameters that several options build ---


def _loaded(*, config: ConfigPath, bus: BusOptions) -> Config:
    return loaded(config, bus)


def _loaded_file_or_arm(config: ConfigPath) -> Config | ArmConfig:
    return loaded_joint_or_arm(config)


def _loaded_or_virtual(*, config: ConfigPath = Path("virtual"), bus: BusOptions) -> Config:
    return loaded(config, bus)


def _json_output(json: Json = False) -> Output:
    return Output(json=json)


def _quiet_output(quiet: Quiet = False) -> Output:
    return Output(quiet=quiet)


def _output(json: Json = False, quiet: Quiet = False) -> Output:
    return Output(json=json, quiet=quiet)


JointOnBus = Annotated["Config", _loaded]
JointOrArmOnBus = Annotated["Config | ArmConfig", loaded_joint_or_arm]
JointOrArm = Annotated["Config | ArmConfig", _loaded_file_or_arm]
JointOrVirtual = Annotated["Config", _loaded_or_virtual]
ResultOutput = Annotated[Output, _json_output]  # of a verb that is done at once
ProgressOutput = Annotated[Output, _quiet_output]  # of a verb without a result
VerbOutput = Annotated[Output, _output]


def grouped(verb: Callable[..., int | None]) -> Callable[..., None]:
    """The verb for Typer, which ends the program with the verb's exit code; the options of its output come last."""
    options, call = option_call(verb)

    @wraps(verb)
    def command(**given: Any) -> None:
        raise typer.Exit(call(given) or 0)

    del vars(command)["__wrapped__"]  # Typer would look through it
    vars(command)["__signature__"] = inspect.Signature(options)
    command.__annotations__ = {option.name: option.annotation for option in options}
    return command


Taker = Callable[[object], None]


def option_call(
    verb: Callable[..., int | None], taken: Taker | None = None
) -> tuple[list[inspect.Parameter], Callable[[dict[str, Any]], Any]]:
    """The verb's options, those of its output last, and what calls it with the values of all of them by name.

    With `taken` its results go there, for a program, instead of to stdout.
    """
    options: list[inspect.Parameter] = []
    last: list[inspect.Parameter] = []
    call = _collect(verb, options, last, taken)
    return [*options, *last], call


def _taking(made: Callable[[dict[str, Any]], Output], taken: Taker | None) -> Callable[[dict[str, Any]], Output]:
    return made if taken is None else lambda given: replace(made(given), taken=taken)


def _collect(
    function: Callable[..., Any], options: list[inspect.Parameter], last: list[inspect.Parameter], taken: Taker | None
) -> Callable[[dict[str, Any]], Any]:
    """Appends the options for which the function's parameters stand; what calls it with the values of all options."""
    values: dict[str, Callable[[dict[str, Any]], Any]] = {}
    names = vars(sys.modules[function.__module__])
    for parameter in inspect.signature(function).parameters.values():
        annotation = eval(parameter.annotation, names)  # not that of the return, which may not be loaded
        parts = get_args(annotation) or (annotation,)
        several = inspect.isfunction(parts[-1]) or is_dataclass(parts[-1])
        if several:
            made = _collect(parts[-1], last if parts[0] is Output else options, last, taken)
            values[parameter.name] = _taking(made, taken) if parts[0] is Output else made
        else:
            options.append(parameter.replace(annotation=annotation, kind=inspect.Parameter.KEYWORD_ONLY))
            values[parameter.name] = itemgetter(parameter.name)

    def call(given: dict[str, Any]) -> Any:
        found = {name: value(given) for name, value in values.items()}
        with ExitStack() as stack:
            for output in found.values():
                if isinstance(output, Output):
                    stack.enter_context(slow_start(output.note, verb_name(function)))
            return function(**found)

    return call


def verb_name(verb: Callable[..., Any]) -> str:
    """As on the command line."""
    return verb.__name__.removesuffix("_verb").replace("_", "-")
