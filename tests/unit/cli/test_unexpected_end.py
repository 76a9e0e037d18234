"""How a verb ends that does not end well: Ctrl-C, a no, an error of each class, and what no verb has foreseen."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer

from jointctl.drivers import errors
from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED, INTERRUPTED
from jointctl.tools.child_process import interrupts_left_to_the_parent
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs import doctor, run, start, sweep, verb_options
from jointctl.tools.verbs import main as main_module
from jointctl.tools.verbs.main import TRACEBACK
from jointctl.tools.verbs.start import FREE_DESCRIPTORS
from jointctl.tools.verbs.verb_options import Verb, Verbs
from tests.configurations import shipped, written
from tests.places import ROOT
from tests.python_process import Finished
from tests.sessions import Terminal, output

# --- What no verb has foreseen, and a computer that has too little of something: one line and a documented code ---
COMMAND = [sys.executable, "-P", "-m", "jointctl.tools.verbs"]


def ended(*arguments: str, files: int | None = None, **options: Any) -> subprocess.CompletedProcess[str]:
    def limit() -> None:
        if files is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))

    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=120, preexec_fn=limit,
        stdin=subprocess.DEVNULL, **options,
    )  # fmt: skip


@pytest.mark.parametrize("files", [6, 7, 10, FREE_DESCRIPTORS])
@pytest.mark.parametrize("verb", [("run", "virtual", "-y"), ("validate", "virtual", "none.csv"), ("--version",)])
def test_too_few_files_may_be_opened(files: int, verb: tuple[str, ...]) -> None:
    done = ended(*verb, files=files)
    assert done.returncode == 1
    assert done.stderr.startswith("error: open files: ")
    assert len(done.stderr.splitlines()) == 2
    assert done.stdout == ""


def test_its_twin_enough_files() -> None:
    assert ended("--version", files=FREE_DESCRIPTORS + 8).returncode == 0


def test_a_stop_is_tried_all_the_same(tmp_path: Path) -> None:
    config = tmp_path / "joint.toml"
    config.write_text('[bus]\ninterface = "jointctl"\nchannel = "nobody"\n[drive]\nnode = 1\n')
    done = ended("stop", str(config), files=16)
    assert done.returncode == 4
    assert "no virtual bus" in done.stderr


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("odd\x1b[2J\nsecond"), "a fault of jointctl itself: RuntimeError: odd\\u001b[2J\\nsecond"),
        (RecursionError("too deep"), "RecursionError"),
        (MemoryError(), "too little memory"),
        (RuntimeError("can't start new thread"), "error: no more threads may be started"),
        (OSError(24, "Too many open files"), "open files: Too many open files"),
        (OSError(36, "File name too long"), "File name too long"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
    ],
)
@pytest.mark.usefixtures("main_in_test")
def test_an_unexpected_error_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(main_module, "app", fail)
    monkeypatch.delenv(TRACEBACK)
    with pytest.raises(SystemExit) as raised:
        main_module.main()
    assert raised.value.code == 1
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(told) == 1
    assert words in told[0]
    monkeypatch.setenv(TRACEBACK, "1")
    with pytest.raises(type(error)):
        main_module.main()
    stopped = start.Interruption()
    monkeypatch.setattr(signal, "getsignal", lambda _: stopped)
    with pytest.raises(type(error)):
        main_module.main()
    stopped.seen = True  # a library has made this error of the KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        main_module.main()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["check", "{}.toml"], 3), (["stop", "{}.toml"], 3), (["new", "a.toml", "--from", "{}"], 3),
        (["new", "{}.toml", "--no-input"], 8), (["params", "dump", "virtual", "-o", "{}.dcf"], 8),
    ],
)  # fmt: skip
def test_a_name_that_is_too_long_is_no_fault_of_jointctl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jointctl: Callable[..., Finished], words: list[str], code: int
) -> None:
    monkeypatch.chdir(tmp_path)
    done = jointctl(*(word.format("x" * 300) for word in words))
    done.refused(code, "File name too long")
    assert "fault of jointctl" not in done.err


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (["map", "own.toml", "--lockstep", "-y", "--speed", "1e-320"], 2, "--speed (=9.99989e-321) must be in ["),
        (["tune", "own.toml", "--lockstep", "--dry-run", "--folder", "file"], 8, "file: cannot be made: File exists"),
        (["study", "--plants", "1", "--workers", "1025"], 2, "'--workers' (=1025)"),
        (["new", "a.toml", "--from", "", "--no-input"], 3, ".toml: no such file"),  # a script's variable that is empty
    ],
)  # fmt: skip
def test_odd_values_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jointctl: Callable[..., Finished], words: list[str], code: int,
    part: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    written(tmp_path / "own.toml", "precise")
    jointctl(*words).refused(code, part)


def test_a_broken_pipe_in_a_verb_is_no_silent_end() -> None:
    app = typer.Typer(cls=Verbs)

    @app.command(cls=Verb)
    def one() -> None:
        raise BrokenPipeError(32, "Broken pipe")

    app.callback()(lambda: None)
    with pytest.raises(RuntimeError, match="Broken pipe"):
        app(["one"], standalone_mode=False)


def test_a_page_of_help_that_nobody_reads_to_its_end_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """`jointctl run --help | head -40`: its last line is written when `head` has gone."""
    abandoned = Mock()
    monkeypatch.setattr(verb_options, "abandon", abandoned)
    app = typer.Typer(cls=Verbs)

    def shown(_: bool) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    @app.command(cls=Verb)
    def one(page: bool = typer.Option(False, callback=shown)) -> None: ...

    app.callback()(lambda: None)
    assert app(["one", "--page"], standalone_mode=False) == 0
    abandoned.assert_called_once_with(sys.stdout)


def test_what_the_encoding_of_the_terminal_lacks_is_escaped(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    done = ended("check", str(tmp_path / "\u540d\udcff.toml"), env=environment)
    assert done.returncode == 3
    assert "\\u540d" in done.stderr
    assert "\\udcff" in done.stderr
    assert len(done.stderr.splitlines()) == 2


READERS = [
    ("check", "{}"), ("identify", "{}"), ("validate", "virtual", "{}"), ("log", "info", "{}"), ("report", "{}"),
    ("study", "--file", "{}"), ("params", "diff", "{}", "{}"), ("clear-fault", "{}"),
    ("sweep", "sweep_virtual", "--lockstep", "-o", "x.csv", "--grid", "list", "--speeds", "{}"),
    ("info", "-i", "virtual", "-c", "0", "-t", "1", "--eds", "{}.eds"), ("params", "diff", "{}.eds", "{}.eds"),
]  # fmt: skip
# all of them in one process, which a timeout can end
READ = (
    "import json, sys; from typer.testing import CliRunner; from jointctl.tools.verbs.main import app\n"
    "for words in json.loads(sys.argv[1]):\n"
    "    error = CliRunner().invoke(app, words).exception\n"
    "    print(json.dumps([getattr(error, 'exit_code', None) or getattr(error, 'code', None), repr(error), words]))"
)


@pytest.mark.parametrize("name", ["zero", "fifo"])
def test_every_reader_refuses_what_is_no_file(tmp_path: Path, name: str) -> None:
    for path in (tmp_path / name, tmp_path / f"{name}.eds"):
        os.mkfifo(path) if name == "fifo" else path.symlink_to("/dev/zero")
    asked = [[word.format(name) for word in words] for words in READERS]
    command = [sys.executable, "-P", "-c", READ, json.dumps(asked)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [words for _, _, words in told] == asked, done.stderr
    assert [answer for answer in told if answer[0] not in (2, 3, 8)] == []


# --- Ctrl-C before a verb has begun, and in the worker processes of one ---
STUCK = (
    "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL);"  # which `nohup pytest` has ignored
    "import sys, time, types; sys.modules['typer'] = slow = types.ModuleType('typer');"
    "slow.__getattr__ = lambda name: (print('importing', flush=True), *(time.sleep(0.02) for _ in range(6000)));"
    "import jointctl.tools.verbs.start as start; start.main()"
)


def ended_while_importing(number: signal.Signals, *words: str) -> tuple[int, str]:
    """(exit code, what it said) of a verb that got this signal."""
    command = [sys.executable, "-c", STUCK, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as started:
        assert started.stdout.readline() == "importing\n"
        started.send_signal(number)
        try:
            _, said = started.communicate(timeout=100.0)
        finally:
            started.kill()
    return started.returncode, said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_during_the_imports_of_a_verb_that_moves_a_joint_a_stop_ends_it_with_one_line(number: signal.Signals) -> None:
    assert ended_while_importing(number, "run", "-y") == (INTERRUPTED, "interrupted; nothing was begun\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, -signal.SIGTERM)])
def test_its_twin_another_verb_is_ended_by_a_signal_as_any_program(number: signal.Signals, code: int) -> None:
    assert ended_while_importing(number, "check")[0] == code


@pytest.mark.usefixtures("main_in_test")
@pytest.mark.parametrize("by", ["", " by jointctl stop"])
@pytest.mark.parametrize("where", ["output.Output.result", "configuration.arm.load_joint_or_arm"])
def test_an_interruption_that_leaves_a_verb_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], by: str, where: str
) -> None:
    """Typer would make a silent exit code of it, in the verb as well as while its options are built."""

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt(*([by] if by else []))

    monkeypatch.setattr(f"jointctl.tools.{where}", interrupted)
    monkeypatch.setattr(sys, "argv", ["jointctl", "check", "virtual"])
    with pytest.raises(SystemExit) as raised:
        main_module.main()
    assert raised.value.code == INTERRUPTED
    assert capsys.readouterr().err.splitlines()[-1] == f"interrupted{by}"


@pytest.mark.parametrize(
    ("before", "shown", "expected"),
    [
        ("signal.signal(signal.SIGINT, signal.SIG_IGN);", "signal.getsignal(signal.SIGINT).name", "SIG_IGN"),
        ("", "type(signal.getsignal(signal.SIGINT)).__name__", "Interruption"),
    ],
)
def test_where_it_is_ignored_it_stays_so_and_else_a_verb_is_interrupted(before: str, shown: str, expected: str) -> None:
    code = (
        f"import signal; {before} import sys; sys.argv = ['jointctl', '--version'];"
        "import jointctl.tools.verbs.start as start, atexit;"
        f"atexit.register(lambda: print({shown})); start.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0)
    assert done.stdout.splitlines()[-1] == expected, done.stderr


def _held_back() -> bool:
    os.kill(os.getpid(), signal.SIGINT)
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_workers_hold_it_back_and_the_parent_gets_it() -> None:
    context = multiprocessing.get_context("spawn")
    with interrupts_left_to_the_parent():
        pool = context.Pool(1)
    with pool:
        assert pool.apply(_held_back)
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        with interrupts_left_to_the_parent():
            os.kill(os.getpid(), signal.SIGINT)
            held = True
        assert held
        time.sleep(1.0)


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_stop_in_any_call_of_the_start_ends_the_verb_with_one_line(number: str) -> None:
    """In destructors and callbacks, where Python drops what a signal raises, and while the verb says its last words."""
    command = [sys.executable, "-m", "tests.bench.interrupted_start", "40000", number]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.stdout.endswith(" interrupted, 0 not as documented\n"), done.stdout + done.stderr
    assert done.returncode == 0


# --- The exit code of each error class is a promise to scripts ---
@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("UsageError", 2), ("ConfigurationError", 3), ("BusError", 4), ("NoDeviceError", 5), ("DeviceError", 6),
        ("MotionFault", 7), ("DataError", 8), ("MarginError", 9),
    ],
)  # fmt: skip
def test_exit_codes(name: str, code: int) -> None:
    error = getattr(errors, name)("rate_Hz (=0) must be above 0", "set rate_Hz")
    assert isinstance(error, errors.JointctlError)
    assert error.exit_code == code
    assert (error.message, error.hint) == ("rate_Hz (=0) must be above 0", "set rate_Hz")
    assert str(error) == "rate_Hz (=0) must be above 0 (set rate_Hz)"


def test_message_is_one_line_and_hint_may_be_empty() -> None:
    error = errors.BusError("first\n   second")
    assert error.message == "first second"
    assert error.hint == ""
    assert str(error) == "first second"


# --- A question that is answered with no: nothing is done, and that is no success ---
REPORT = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)


class Asking:
    """A session that asks, and does no more."""

    drive_state = "switch on disabled"

    def __init__(self, plan: Any, consent: Any, *_: Any) -> None:
        self._plan, self._consent = plan, consent

    def run(self) -> None:
        placed = self._plan.motion.placed(REPORT)
        self._consent.show(placed.lines)
        assert self._consent.dry_run or not self._consent.agreed(placed.lines)


def ended_with(verb: str, folder: Path, *, dry_run: bool = False) -> int:
    """Its exit code, where it may ask."""
    shown, *_ = output()
    if verb == "run":
        return run.run(shipped(), shown, assume_yes=False, dry_run=dry_run)
    if verb == "sweep":
        return sweep.sweep(
            shipped("sweep_virtual"), shown, folder / "data.csv", SweepOptions(points=24, dry_run=dry_run)
        )
    return doctor.doctor_motion(shipped(), shown, assume_yes=False)


@pytest.mark.parametrize("answer", ["n\n", "\n", "", "no\n", "maybe\n"])
@pytest.mark.parametrize("verb", ["run", "sweep", "doctor --motion"])
def test_no_is_a_code_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, answer: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    monkeypatch.setattr("jointctl.tools.session.session.Session", Asking)
    assert ended_with(verb, tmp_path) == DECLINED == 12
    assert not list(tmp_path.glob("*.csv"))


@pytest.mark.parametrize("verb", ["run", "sweep"])
def test_a_dry_run_is_a_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jointctl.tools.session.session.Session", Asking)
    assert ended_with(verb, tmp_path, dry_run=True) == 0
