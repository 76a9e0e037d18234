"""The commands as functions: each takes the options of its command by name and returns its result.

    margins = jointctl.check("my_joint.toml").margins
    result = jointctl.run("my_joint.toml", yes=True)

Options have the names and units that `help(jointctl.run)` shows; what stands without a name on the command line comes
first.  What a command says on the way goes to stderr, as at the terminal; an exit code that is not 0 is an exception.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

from jointctl.drivers.errors import DECLINED, INTERRUPTED, JointctlError, UsageError

if TYPE_CHECKING:
    from jointctl.tools.analysis.reducer_map import FoundMap
    from jointctl.tools.experiments.controller_study import StudyResult
    from jointctl.tools.experiments.judge import Verdict
    from jointctl.tools.identification.identification import Identification
    from jointctl.tools.identification.motion_fit import MotionFit
    from jointctl.tools.inspection.health import Finding
    from jointctl.tools.recording.run_log_reader import RunLog
    from jointctl.tools.session.result import RunResult
    from jointctl.tools.tuning.frequency_response import FrequencyResponse
    from jointctl.tools.tuning.joint_fit import JointFit
    from jointctl.tools.verbs.check import LoopCheck
    from jointctl.tools.verbs.excite import ExciteResult
    from jointctl.tools.verbs.paper import PaperResult
    from jointctl.tools.verbs.sweep import SweepResult
    from jointctl.tools.verbs.validate import Validation

# What each command returns; None where nothing was done, as by `dry_run=True`.  The functions are made of the commands.
run: Callable[..., RunResult | None]
check: Callable[..., LoopCheck]
sweep: Callable[..., SweepResult | None]
excite: Callable[..., ExciteResult | None]
response: Callable[..., tuple[FrequencyResponse, JointFit] | None]
map: Callable[..., FoundMap | None]
tune: Callable[..., dict[str, Any] | None]
demo: Callable[..., RunResult]
validate: Callable[..., Validation]
report: Callable[..., Path]
study: Callable[..., StudyResult]
paper: Callable[..., PaperResult]
fault_campaign: Callable[..., list[Verdict]]
doctor: Callable[..., list[Finding]]
scan: Callable[..., dict[str, Any]]
info: Callable[..., dict[str, Any]]
stop: Callable[..., str]
clear_fault: Callable[..., str]
zero: Callable[..., dict[str, Any]]
new: Callable[..., None]

VERBS = tuple(__annotations__)
_ANSWERS = {"doctor": JointctlError.exit_code, "fault_campaign": 10}  # exit codes that the result explains
_NAMES = {"assume_yes": "yes"}  # of options that have another name inside


def __getattr__(name: str) -> Callable[..., object]:
    """One of `VERBS`, when it is asked for."""
    if name not in VERBS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = function = _function(name)
    return function


def _function(name: str) -> Callable[..., object]:
    from typer.models import ArgumentInfo

    from jointctl.drivers.stop_note import asked, now_ns
    from jointctl.tools.verbs.start import occupy_standard_streams, require_descriptors
    from jointctl.tools.verbs.verb_options import option_call

    home = import_module(f"jointctl.tools.verbs.{name}")
    verb: Callable[..., int | None] = getattr(home, f"{name}_verb", None) or getattr(home, name)
    found: list[object] = []
    listed, call = option_call(verb, found.append)
    options = {_NAMES.get(option.name, option.name): option for option in listed if option.name != "json"}
    first = [key for key, option in options.items() if isinstance(_given_as(option), ArgumentInfo)]

    def function(*arguments: object, **given: object) -> object:
        if len(arguments) > len(first):
            raise TypeError(f"{name}() takes {len(first)} arguments without a name at most, not {len(arguments)}")
        if twice := given.keys() & set(first[: len(arguments)]):
            raise TypeError(f"{name}() got {twice.pop()!r} twice")
        given |= dict(zip(first, arguments, strict=False))
        unknown = [key for key in given if key not in options]
        if unknown:
            raise TypeError(f"{name}() has no option {unknown[0]!r}; there are {', '.join(sorted(options))}")
        missing = [key for key, option in options.items() if option.default is option.empty and key not in given]
        if missing:
            raise TypeError(f"{name}() needs {missing[0]!r}")
        values = {option.name: option.default for option in options.values()}
        values |= {options[key].name: _checked(name, key, value, options[key]) for key, value in given.items()}
        found.clear()
        occupy_standard_streams()
        if name != "stop":  # which is tried all the same
            require_descriptors()
        asked(now_ns())
        code = call({"json": False, **values}) or 0
        result = found[-1] if found else None
        if code and code != _ANSWERS.get(name):
            _raise(name, code, result)
        return result

    shown = [
        inspect.Parameter(
            key, option.POSITIONAL_OR_KEYWORD if key in first else option.KEYWORD_ONLY,
            default=option.default, annotation=_kind(option),
        )
        for key, option in options.items()
    ]  # fmt: skip
    shown.sort(key=lambda option: (option.kind, option.default is not option.empty))
    result = __annotations__[name].removeprefix("Callable[..., ").removesuffix("]")
    words = {option.name: getattr(_given_as(options[option.name]), "help", None) for option in shown}
    function.__name__ = function.__qualname__ = name
    function.__doc__ = "\n\n".join(
        [inspect.getdoc(verb) or "", "\n".join(f"{key}: {text}" for key, text in words.items() if text)]
    )
    vars(function)["__signature__"] = inspect.Signature(shown, return_annotation=result)
    return function


def _kind(option: inspect.Parameter) -> Any:
    return (get_args(option.annotation) or (option.annotation,))[0]


def _given_as(option: inspect.Parameter) -> Any:
    """What Typer gets with an option; None without anything."""
    return next(iter(get_args(option.annotation)[1:]), None)


def _checked(verb: str, name: str, value: object, option: inspect.Parameter) -> object:
    """The value in the option's type and within its bounds; `UsageError` if that cannot be."""
    from pydantic import Field, TypeAdapter, ValidationError

    if value is None and option.default is None:
        return None
    base, info = _kind(option), _given_as(option)
    several = next((part for part in (base, *get_args(base)) if get_origin(part) is list), None)
    if several is not None and isinstance(value, (str, Path, int)):
        value = [str(value) if get_args(several) == (str,) else value]  # one of several
    low, high = getattr(info, "min", None), getattr(info, "max", None)
    kind: Any = base if low is None and high is None else Annotated[base, Field(ge=low, le=high)]
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        why = error.errors()[0]["msg"]
        raise UsageError(f"{verb}(): {name} (={value!r}): {why[0].lower()}{why[1:]}") from None


def _raise(verb: str, code: int, result: object) -> None:
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code == DECLINED:
        raise JointctlError(f"{verb}() was declined: nothing moved")
    if faulty := getattr(result, "faulty", None):
        raise faulty[0].motion_fault()
    raise JointctlError(f"{verb}() ended with exit code {code}")


def identify(
    data: str | Path, *, config: str | Path | None = None, table: dict[str, Any] | None = None, **options: Any
) -> Identification:
    """Friction model of measured plateaus, as `jointctl identify`, but nothing is written.

    `table` says how to read a table that is not ours (fields of `ForeignFormat`), `options` are fields of `Options`;
    with `config` torque and speed are checked for plausibility.
    """
    from jointctl.tools.identification.friction_data import read_friction_data
    from jointctl.tools.identification.identification import Options, identify_friction
    from jointctl.tools.identification.tables import ForeignFormat
    from jointctl.tools.verbs.identify import joint_limits
    from jointctl.tools.verbs.verb_options import config_path

    limits = None if config is None else joint_limits(config_path(Path(config)))
    how = _made(Options, "identify", options)
    return identify_friction(read_friction_data(Path(data), _made(ForeignFormat, "table", table)), how, limits=limits)


def identify_motion(data: str | Path, *, table: dict[str, Any] | None = None, **settings: Any) -> MotionFit:
    """Inertia, gravity and friction from a run log or a table in time, as `jointctl identify`; nothing is written.

    `table` says how to read a table (fields of `ForeignFormat`), `settings` are fields of `MotionSettings`.
    """
    from jointctl.tools.identification import motion_fit
    from jointctl.tools.identification.motion_data import MotionSettings
    from jointctl.tools.identification.tables import ForeignFormat
    from jointctl.tools.verbs.identify import motion_from

    chosen = _made(MotionSettings, "identify_motion", settings)
    return motion_fit.identify_motion(motion_from(Path(data), _made(ForeignFormat, "table", table), chosen), chosen)


def _made(kind: Any, what: str, given: dict[str, Any] | None) -> Any:
    """A dataclass of these fields; `TypeError` as of the other functions for one that it does not have."""
    known = [each.name for each in fields(kind)]
    if unknown := [name for name in given or {} if name not in known]:
        raise TypeError(f"{what} has no option {unknown[0]!r}; there are {', '.join(sorted(known))}")
    return kind(**(given or {}))


def read_log(path: str | Path) -> RunLog:
    """A run log: records (structured array), events, metadata with the configuration."""
    from jointctl.tools.recording.run_log_reader import read_run_log

    return read_run_log(path)
