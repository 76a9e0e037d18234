"""The process of the loop: its slow start and its end before that, a drive that cannot be opened, no standby."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.errors import BusError
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.slow_start import compiling, slow_start
from jointctl.tools.child_process import IDLE_S, TELL_S, Starting, keep_off, let_run, processor_time_s, processors
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.records import trajectory_table
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.output import Output
from jointctl.tools.session import elmo_drive as module
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.control import in_control
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.session import Session
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.verbs import verb_options
from jointctl.tools.verbs.verb_options import VerbOutput, grouped
from tests.places import CONFIGS, ROOT
from tests.python_process import eventually
from tests.sessions import constants_of


# --- The word about a slow start comes when it is slow because it compiles, and never after its end ---
def compile_something() -> None:
    offset = 1.0  # what has one is kept in no cache

    @kernel
    def never_seen(a: float) -> float:
        return a + offset

    assert never_seen(1.0) == 2.0


def test_a_slow_start_is_told_once() -> None:
    told: list[str] = []
    with slow_start(told.append, "loop", 0.0):
        time.sleep(0.1)
        assert told == []  # nothing compiles
        compile_something()
        compile_something()
    assert told == ["loop: compiling, which only the first start does"]


@pytest.mark.parametrize("fails", [False, True])
def test_what_works_on_after_a_short_compilation_is_not_nor_what_fails(fails: bool) -> None:
    told = threading.Event()
    with contextlib.suppress(ValueError), slow_start(lambda _: told.set(), "loop", 0.2):
        with compiling():
            pass
        if fails:
            raise ValueError
        assert not told.wait(0.4)
    assert not told.wait(0.4)


def one_that_compiles(*, output: VerbOutput) -> None:
    compile_something()


def test_every_verb_says_that_it_compiles(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(verb_options, "slow_start", functools.partial(slow_start, after_s=0.0))
    with pytest.raises(typer.Exit):
        grouped(one_that_compiles)(json=False, quiet=False)
    assert capsys.readouterr().err == "one-that-compiles: compiling, which only the first start does\n"


def own_process(_: int) -> int:
    return os.getpid()


def test_of_many_runs_the_first_compiles_where_it_can_be_said() -> None:
    first, *others = Workers(2).results(own_process, range(3))
    assert first == os.getpid()
    assert first not in others


# --- The processor that is the loop's ---
@pytest.mark.skipif(processors() < 2, reason="this computer has one processor")
def test_every_thread_keeps_off_the_loops_processor_from_its_go_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: SimpleNamespace(poll=lambda: 0))
    allowed, ended = os.sched_getaffinity(0), threading.Event()
    thread = threading.Thread(target=ended.wait, daemon=True)
    thread.start()

    def seen() -> list[set[int]]:
        return [os.sched_getaffinity(each) for each in (0, thread.native_id) if each is not None]

    config = load_config(CONFIGS / "virtual.toml").changed(loop__cpu=max(allowed))
    with LoopHandle(config, trajectory_table(config), CanopenPort) as loop:
        before = seen()
        loop.go(constants_of(config), new(CanopenPort))
        during = seen()
    after = seen()
    ended.set()
    thread.join()
    assert (before, during, after) == ([allowed] * 2, [allowed - {max(allowed)}] * 2, [allowed] * 2)


def test_a_processor_that_is_not_chosen_or_not_there_changes_nothing() -> None:
    allowed = os.sched_getaffinity(0)
    assert keep_off(None) == {}
    keep_off(1 + max(allowed))
    assert os.sched_getaffinity(0) == allowed


@pytest.mark.skipif(processors() < 2, reason="this computer has one processor")
def test_without_proc_it_is_the_threads_that_python_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    def not_mounted(path: str) -> list[str]:
        raise FileNotFoundError(path)

    monkeypatch.setattr(os, "listdir", not_mounted)
    allowed = os.sched_getaffinity(0)
    before = keep_off(max(allowed))
    assert os.sched_getaffinity(0) == allowed - {max(allowed)}
    let_run(before)
    assert os.sched_getaffinity(0) == allowed


@pytest.mark.skipif(processors() < 2, reason="this computer has one processor")
def test_a_thread_that_has_ended_gives_nothing_back_to_who_has_its_number_now() -> None:
    allowed = os.sched_getaffinity(0)
    with subprocess.Popen(["sleep", "60"]) as other:  # another loop, say, which is alone on its processor
        os.sched_setaffinity(other.pid, {min(allowed)})
        let_run({other.pid: allowed})
        found = os.sched_getaffinity(other.pid)
        other.kill()
    assert found == {min(allowed)}


# --- Waiting for a process that compiles: as long as it works, and in words when it ends or hangs ---
class Waiting:
    """A process that sleeps behind a clock and a processor time that the test moves."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.now_s, self.used_s = 0.0, 0.0
        self.told: list[str] = []
        self.starting = Starting(
            "the virtual joint", process, self.told.append, BusError, clock=lambda: self.now_s,
            used=lambda pid: self.used_s,
        )  # fmt: skip

    def go(self, time_s: float, share: float) -> None:
        """Seconds in which the process gets this share of a processor."""
        for _ in range(int(time_s)):
            self.now_s += 1.0
            self.used_s += share
            self.starting.check()


@pytest.fixture
def process() -> subprocess.Popen[bytes]:
    return subprocess.Popen(["/bin/sleep", "600"])


@pytest.fixture
def waiting(process: subprocess.Popen[bytes]) -> Iterator[Waiting]:
    yield Waiting(process)
    process.kill()
    process.wait()


def test_it_is_waited_for_as_long_as_it_works_and_told_meanwhile(waiting: Waiting) -> None:
    waiting.go(1000.0, 0.01)  # a hundredth of a processor: a computer that is very busy
    assert len(waiting.told) == int(1000.0 / TELL_S)
    assert waiting.told[1] == "the virtual joint is starting: 30 s so far, 0 s of processor time"


def test_one_that_does_not_work_any_more_hangs_and_its_twin_does_not(waiting: Waiting) -> None:
    waiting.go(100.0, 0.5)
    waiting.go(IDLE_S, 0.0)
    waiting.go(1.0, 0.5)
    waiting.go(IDLE_S, 0.0)
    with pytest.raises(BusError, match=r"after 222 s it has not worked for 60 s \(50 s of processor time before\)"):
        waiting.go(1.0, 0.0)


@pytest.mark.parametrize(
    ("end", "words"),
    [
        ("import os; os.kill(os.getpid(), 9)", r"was killed by signal 9 \(SIGKILL\); it was starting, for 7 s"),
        ("raise SystemExit(4)", "ended with exit code 4, see its message above; it was"),
        ("", "ended without a message"),
    ],
)
def test_its_end_is_told(end: str, words: str) -> None:
    process = subprocess.Popen([sys.executable, "-c", end])
    waiting = Waiting(process)
    process.wait()
    waiting.now_s = 7.0
    with pytest.raises(BusError, match=words):
        waiting.starting.check()


@pytest.mark.parametrize("mounted", [True, False])
def test_the_processor_time_of_a_process_grows_with_its_work(monkeypatch: pytest.MonkeyPatch, mounted: bool) -> None:
    """With or without /proc: one that compiles for longer than IDLE_S must not seem to hang."""

    def not_there(path: Path, *_: Any) -> str:
        raise FileNotFoundError(path)

    if not mounted:
        monkeypatch.setattr(Path, "read_text", not_there)
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    eventually(lambda: processor_time_s(process.pid) >= 0.1, 60.0)
    process.kill()
    process.wait()
    assert processor_time_s(process.pid) == 0.0


# --- The lock against standby during a run on a serial line, with a stand-in for systemd-inhibit ---
GRANTS = """#!/bin/sh
echo "asked $*" >>"$0.log"
while [ "${1#--}" != "$1" ]; do shift; done
"$@"
echo released >>"$0.log"
"""
REFUSES = "#!/bin/sh\necho 'Failed to inhibit: Access denied' >&2\nexit 1\n"
HANGS = "#!/bin/sh\nexec sleep 60\n"


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "systemd-inhibit"
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return path


def install(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def log_of(stand_in: Path) -> list[str]:
    path = Path(f"{stand_in}.log")
    return path.read_text().splitlines() if path.exists() else []


def kept_awake(config: Config, output: Output) -> contextlib.AbstractContextManager[bool]:
    return session_drive(config.drive.kind).kept_awake(output)


def serial() -> Config:
    return load_config(shipped_config("elmo_serial"))


def test_the_lock_is_held_for_the_run_and_told(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    err = io.StringIO()
    with kept_awake(serial(), Output(stderr=err)) as held:
        assert held
        assert len(log_of(stand_in)) == 1
        assert "--what=sleep:handle-lid-switch" in log_of(stand_in)[0]
        assert "--mode=block" in log_of(stand_in)[0]
    assert log_of(stand_in)[1:] == ["released"]
    assert "kept from falling asleep until the end of the run" in err.getvalue()


def test_its_twin_a_drive_with_a_watchdog_needs_none(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    err = io.StringIO()
    with kept_awake(load_config(shipped_config("virtual")), Output(stderr=err)) as held:
        assert not held
    assert (log_of(stand_in), err.getvalue()) == ([], "")


@pytest.mark.parametrize("text", [REFUSES, HANGS, None], ids=["refused", "no answer", "not there"])
def test_without_the_lock_the_run_goes_on_and_the_user_is_told(
    stand_in: Path, text: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is None:
        monkeypatch.setenv("PATH", str(stand_in.parent))
    else:
        install(stand_in, text)
    monkeypatch.setattr(module, "HELD_TIMEOUT_S", 0.3)
    monkeypatch.setattr(module, "ENDED_S", 0.1)
    err = io.StringIO()
    with kept_awake(serial(), Output(stderr=err)) as held:
        assert not held
    assert "not kept from falling asleep" in " ".join(err.getvalue().split())


def test_a_run_that_is_killed_releases_it(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    code = (
        "import sys, time\nfrom tests.unit.session.test_loops import Output, kept_awake, serial\n"
        "with kept_awake(serial(), Output()):\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as run:
        assert run.stdout.readline() == b"held\n"
        assert "released" not in log_of(stand_in)
        run.send_signal(signal.SIGKILL)
        run.wait()
    eventually(lambda: "released" in log_of(stand_in), 60.0)


# --- Opening the drive of a configuration: what fails leaves the bus to the next one that tries ---
def test_a_bus_that_cannot_be_opened_can_be_tried_again(tmp_path: Path) -> None:
    text = (CONFIGS / "virtual.toml").read_text().replace('"virtual0"', f'"{tmp_path}/none.sock"')
    (tmp_path / "joint.toml").write_text(text)
    config = load_config(tmp_path / "joint.toml")
    for _ in range(2):
        with in_control(config, Output()), pytest.raises(BusError, match="no virtual bus at"):
            CanopenSession().open(config)


# --- The loop compiles while the virtual bus starts; it opens the bus when that is there ---
@pytest.mark.parametrize("stopped", [False, True])
def test_the_loop_gets_its_own_bus_when_that_is_there_and_a_stop_ends_the_waiting(stopped: bool) -> None:
    done: list[str] = []

    def leave_if_asked() -> None:
        if stopped:
            raise KeyboardInterrupt

    class Own:
        def until_bus(self, alive: Callable[[], None]) -> None:
            assert done == []
            alive()
            done.append("there")

    control = SimpleNamespace(bus_is_there=lambda: done.append("locked"))
    session: Any = SimpleNamespace(own=Own(), signals=SimpleNamespace(leave_if_asked=leave_if_asked), _control=control)
    loop: Any = SimpleNamespace(bus_is_there=lambda: done.append("opened"))
    with pytest.raises(KeyboardInterrupt) if stopped else contextlib.nullcontext(), Session._bus_there(session, loop):
        done.append("run")
    assert done == ([] if stopped else ["there", "locked", "opened", "run"])


def test_a_bus_of_others_is_there_from_the_beginning() -> None:
    done: list[str] = []
    session: Any = SimpleNamespace(own=None)
    loop: Any = SimpleNamespace(bus_is_there=lambda: done.append("opened"))
    with Session._bus_there(session, loop):
        assert done == ["opened"]
