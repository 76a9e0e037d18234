"""The commands as functions: each takes the options of its command by name and returns its result.

    report = jointctl.check("my_joint.toml")
    figures = jointctl.run("my_joint.toml", yes=True)

A result is what `--json` prints, as numbers, texts, lists and dicts; `identify` and `read_log` have types of their own.
What a command says on the way goes to stderr, as at the terminal; an exit code that is not 0 is an exception.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from jointctl.drivers.errors import DECLINED, INTERRUPTED, JointctlError, MotionFault

if TYPE_CHECKING:
    from jointctl.tools.identification.identification import Identification
    from jointctl.tools.recording.run_log_reader import RunLog


def _called(verb: Callable[..., int | None], given: dict[str, Any]) -> Any:
    """The document that the verb prints with --json; `given` are its options by name."""
    from jointctl.tools.verbs.verb_options import option_call

    options, call = option_call(verb)
    names = {option.name: option for option in options}
    unknown = [name for name in given if name not in names]
    if unknown:
        raise TypeError(f"{verb.__name__}() has no option {unknown[0]!r}; there are {', '.join(sorted(names))}")
    values = {name: given.get(name, option.default) for name, option in names.items()}
    missing = [name for name, value in values.items() if value is inspect.Parameter.empty]
    if missing:
        raise TypeError(f"{verb.__name__}() needs {missing[0]!r}")
    for name, option in names.items():
        base = get_args(option.annotation)[0] if get_args(option.annotation) else option.annotation
        if isinstance(values[name], str) and (base is Path or Path in get_args(base)):
            values[name] = Path(values[name])
    if "json" in names:
        values["json"] = True
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = call(values) or 0
    text = printed.getvalue().strip()
    result = json.loads(text.splitlines()[-1]) if text else None
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        what = "was declined" if code == DECLINED else f"ended with exit code {code}"
        fault = result.get("fault") if isinstance(result, dict) else None
        kind = MotionFault if code == MotionFault.exit_code else JointctlError
        raise kind(f"{verb.__name__} {what}{f': {fault}' if fault else ''}")
    return result


def run(config: str | Path, *, yes: bool = False, **options: Any) -> dict[str, Any]:
    """Track the configured trajectory, as `jointctl run`; figures of the run.  In the main thread only."""
    from jointctl.tools.verbs.run import run as verb

    found: dict[str, Any] = _called(verb, {"config": config, "assume_yes": yes, **options})
    return found


def check(config: str | Path, **options: Any) -> dict[str, Any]:
    """Stability margins with the modelled delay, as `jointctl check`; `MarginError` where they are too small."""
    from jointctl.tools.verbs.check import check as verb

    found: dict[str, Any] = _called(verb, {"config": config, **options})
    return found


def identify(
    data: str | Path, *, config: str | Path | None = None, table: dict[str, Any] | None = None, **options: Any
) -> Identification:
    """Friction model of measured plateaus, as `jointctl identify`, but nothing is written.

    `table` says how to read a table that is not ours (fields of `ForeignFormat`), `options` are fields of `Options`;
    with `config` torque and speed are checked for plausibility.
    """
    from jointctl.tools.identification.friction_data import ForeignFormat, read_friction_data
    from jointctl.tools.identification.identification import Options, identify_friction
    from jointctl.tools.verbs.identify import joint_limits
    from jointctl.tools.verbs.verb_options import config_path

    limits = None if config is None else joint_limits(config_path(Path(config)))
    return identify_friction(
        read_friction_data(Path(data), ForeignFormat(**(table or {}))), Options(**options), limits=limits
    )


def read_log(path: str | Path) -> RunLog:
    """A run log: records (structured array), events, metadata with the configuration."""
    from jointctl.tools.recording.run_log_reader import read_run_log

    return read_run_log(path)
