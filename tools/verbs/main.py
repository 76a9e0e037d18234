"""The command line: the verbs under their headings, and how the program ends."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import signal
import sys
from typing import Annotated, Any, NoReturn

import typer

from jointctl.drivers.errors import INTERRUPTED, DataError, JointctlError, UsageError, one_line, refused_by_system
from jointctl.tools.output import Output, abandon, let_go
from jointctl.tools.scoping.remote_options import with_values
from jointctl.tools.verbs.check import check
from jointctl.tools.verbs.clear_fault import clear_fault
from jointctl.tools.verbs.demo import demo
from jointctl.tools.verbs.doctor import doctor
from jointctl.tools.verbs.excite import excite
from jointctl.tools.verbs.fault_campaign import fault_campaign
from jointctl.tools.verbs.hil import hil
from jointctl.tools.verbs.identify import identify
from jointctl.tools.verbs.info import info
from jointctl.tools.verbs.log import log_app
from jointctl.tools.verbs.map import map_verb
from jointctl.tools.verbs.monitor import monitor
from jointctl.tools.verbs.new import new
from jointctl.tools.verbs.paper import paper
from jointctl.tools.verbs.params import params_app
from jointctl.tools.verbs.report import report
from jointctl.tools.verbs.response import response
from jointctl.tools.verbs.run import run
from jointctl.tools.verbs.scan import scan
from jointctl.tools.verbs.scope import scope
from jointctl.tools.verbs.start import never_refuse_a_character, occupy_standard_streams
from jointctl.tools.verbs.stop import stop
from jointctl.tools.verbs.study import study_verb
from jointctl.tools.verbs.sweep import sweep
from jointctl.tools.verbs.tune import tune
from jointctl.tools.verbs.validate import validate
from jointctl.tools.verbs.verb_options import (
    BEGIN,
    COMPARE,
    FRICTION,
    INSPECT,
    LOOK,
    MOVE,
    Verb,
    Verbs,
    grouped,
    verb_name,
)
from jointctl.tools.verbs.zero import zero

TRACEBACK = "JOINTCTL_TRACEBACK"  # in the environment: show where an unexpected error comes from
EPILOG = (
    "First steps: `jointctl demo` shows all of it on a virtual joint; `jointctl doctor` tells what this computer can "
    "do; `jointctl new my_joint.toml` begins a configuration of your own. CONFIG is a TOML file or the name of a "
    "shipped one: virtual, precise, paper, realistic, csp, sweep_virtual, elmo_gold_can, elmo_serial."
)

app = typer.Typer(name="jointctl", cls=Verbs, no_args_is_help=True, add_completion=True, pretty_exceptions_enable=False)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"jointctl {version('jointctl')}")
        raise typer.Exit()


@app.callback(epilog=EPILOG)
def callback(
    version: Annotated[
        bool, typer.Option("--version", help="print the version and end", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Robot joint controller: CANopen CiA 402 at 1 kHz, with a virtual joint to try it on."""


for _panel, _verbs in (
    (BEGIN, (demo, new, zero, hil, doctor)),
    (MOVE, (run, stop, clear_fault, check, tune)),
    (INSPECT, (scan, info, monitor)),
    (FRICTION, (sweep, excite, identify, validate, map_verb, response)),
    (LOOK, (report, scope)),
    (COMPARE, (paper, study_verb, fault_campaign)),
):
    for _verb in _verbs:
        app.command(verb_name(_verb), cls=Verb, rich_help_panel=_panel)(grouped(_verb))
app.add_typer(params_app, name="params", rich_help_panel=INSPECT)
app.add_typer(log_app, name="log", rich_help_panel=LOOK)


def _start_quickly() -> None:
    """What makes the imports of a verb cost a third less: before numpy, and for the processes that a verb starts.

    One thread for the linear algebra: idle ones spin while they start, and nothing here is large enough to need two.
    And the garbage of an import is not worth looking for.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(100_000, 50, 100)


# typer's own parser or click, as the version has it
_USAGE: type[Exception] = typer.BadParameter.__mro__[1]


def _refuse_usage(error: Any) -> None:
    """One line for what the parser did not understand; without any argument it has shown the help instead."""
    text = one_line(error.format_message())
    if not text:
        return
    if hasattr(error.__cause__, "errors"):  # of pydantic, whose words leave the value out
        from jointctl.tools.configuration.load import decimal_point  # takes its time

        value = one_line(str(error.__cause__.errors()[0]["input"]))[:40]
        text = text.replace(": Input", f" (={value}): input", 1)
        text += decimal_point(value) if "valid number" in text else ""
    command = error.ctx.command_path if error.ctx is not None else "jointctl"
    Output().error(text[0].lower() + text[1:], f"`{command} --help` shows what there is")


def _end_unexpected(error: Exception) -> NoReturn:
    """What a verb did not foresee: one line on stderr and code 1; with `TRACEBACK` set it is raised again.

    By then the verb has been left: a drive that it had under power has been switched off on the way.

    After a stop it is that stop: a library makes something else of a KeyboardInterrupt, pydantic where it calls Python.
    """
    if any(getattr(signal.getsignal(number), "seen", False) for number in (signal.SIGINT, signal.SIGTERM)):
        raise KeyboardInterrupt from error
    if os.environ.get(TRACEBACK):
        raise error
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        refused = refused_by_system(error)
        Output().error(refused.message, refused.hint)
    elif isinstance(error, MemoryError):
        Output().error("there is too little memory for this", "end other programs, or give it less to do")
    elif isinstance(error, RuntimeError) and "start new thread" in str(error):  # the only sign that Python gives of it
        Output().error(
            "no more threads may be started", "end other programs, or raise the limit, such as `ulimit -u 4096`"
        )
    else:
        Output().error(
            one_line(f"a fault of jointctl itself: {type(error).__name__}: {error}"),
            f"{TRACEBACK}=1 in the environment shows where; please report it",
        )
    sys.exit(JointctlError.exit_code)


def main() -> None:
    """Run a verb; every known error is one line and its own exit code."""
    occupy_standard_streams()
    never_refuse_a_character()
    atexit.register(let_go, sys.stderr)
    _start_quickly()
    try:
        sys.exit(app(with_values(sys.argv[1:]), standalone_mode=False))
    except JointctlError as error:
        Output().error(error.message, error.hint)
        sys.exit(error.exit_code)
    except _USAGE as error:
        _refuse_usage(error)
        sys.exit(UsageError.exit_code)
    except OSError as error:
        too_long = error.errno == errno.ENAMETOOLONG and error.filename is not None  # the name of a file to write
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) and not too_long:
            _end_unexpected(error)
        Output().error(f"{error.filename or 'a file or the output'}: cannot be written: {error.strerror}")
        if error.filename is None:
            abandon(sys.stdout)
        sys.exit(DataError.exit_code)
    except (KeyboardInterrupt, typer.Abort) as error:
        Output().note(f"interrupted{error}")
        sys.exit(INTERRUPTED)
    except Exception as error:
        _end_unexpected(error)
