"""A stop that comes before the program that it is for has its bus."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers import bus_lock, stop_note
from jointctl.drivers.bus_lock import BusLock, StopCall, end_programs, lock_name
from jointctl.drivers.stop_note import (
    KEPT_S,
    MOST,
    SHARED_S,
    asked,
    asked_anew,
    now_ns,
    remove_old,
    settle,
    stopped,
    write_note,
)

LOCK = "jointctl-bus-tested"
EVERYONES = Path("/dev/shm")
TAKES = (  # the lock, when it is told to; what it found
    "import sys, time; from jointctl.drivers.bus_lock import BusLock; print('begun', flush=True); input()\n"
    "with BusLock('socketcan', sys.argv[1]) as lock: print(lock.stopped)\n"
)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_asked_ns", None), ("_anew_ns", 0), ("_settled_ns", {})):
        monkeypatch.setattr(stop_note, name, value)


@pytest.fixture(autouse=True)
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own, for a process that has not been asked for anything yet."""
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path)
    forget(monkeypatch)
    return tmp_path


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stops of this process are another's."""
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))


def started(monkeypatch: pytest.MonkeyPatch, ago_s: float) -> None:
    began_ns = now_ns() - round(ago_s * 1e9)
    monkeypatch.setattr(stop_note, "_first_ns", began_ns)
    monkeypatch.setattr(stop_note, "_started_ns", lambda _: began_ns)


@pytest.mark.parametrize("before_s", [0.0, 0.3])
def test_who_was_started_before_the_stop_and_has_its_bus_later_is_stopped(
    before_s: float,
) -> None:
    """With processes: the stop comes while it loads, and is over when it takes the lock."""
    channel = f"stop-note-{os.getpid()}"
    command = [sys.executable, "-c", TAKES, channel]
    told: list[str] = []

    def begun() -> subprocess.Popen[str]:
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with begun() as before:
        time.sleep(before_s)
        subprocess.run(
            [
                sys.executable, "-c",
                "import sys; from jointctl.drivers.bus_lock import StopCall, end_programs\n"
                "with StopCall('socketcan', sys.argv[1]) as call: end_programs([call], print)", channel,
            ],
            check=True,
        )  # fmt: skip
        with begun() as after:
            told += [process.communicate("\n", 20.0)[0] for process in (before, after)]
    for path in EVERYONES.glob(f"{lock_name('socketcan', channel)}*"):
        path.unlink()
    assert told == ["begun\nTrue\n", "begun\nFalse\n"]


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize("order", ["nalr", "nlar", "nlra", "lnar", "lnra", "lrna"])
def test_in_whatever_order_they_act_one_sees_the_other(order: str) -> None:
    """Note and ask of the stop, lock and read of the program."""
    held = found = reached = False
    for step in order:
        match step:
            case "n":
                write_note(LOCK)
            case "a":
                reached = held
            case "l":
                held = True
            case "r":
                found = stopped(LOCK)
    assert found or reached


@pytest.mark.usefixtures("others")
def test_a_stop_counts_for_who_runs_when_it_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not stopped(LOCK)
    write_note(LOCK)
    started(monkeypatch, -0.001)
    forget(monkeypatch)
    assert not stopped(LOCK)
    started(monkeypatch, 10_000.0)  # it may have compiled, or waited for another lock
    forget(monkeypatch)
    assert not stopped(LOCK + "2")
    assert stopped(LOCK)


@pytest.mark.usefixtures("others")
def test_it_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that begins one joint after the other: a stop between two of them is one of the next."""
    started(monkeypatch, 100.0)
    for _ in range(2):
        write_note(LOCK)
        asked(now_ns())  # a later stop of its own takes back nothing
        write_note(LOCK)
        assert [stopped(LOCK), stopped(LOCK)] == [True, True]  # it was not told yet
        settle(LOCK)
        assert not stopped(LOCK)


@pytest.mark.usefixtures("others")
def test_one_that_has_reached_the_holder_of_the_lock_is_known_to_it() -> None:
    write_note(LOCK)
    settle(LOCK)
    assert not stopped(LOCK)
    channel, reached = f"stop-note-holder-{os.getpid()}", threading.Event()
    for delivers in (False, True):  # before it does, the program may yet leave with another error
        with BusLock("socketcan", channel, reached.set) as lock:
            assert not lock.stopped
            if delivers:
                lock.deliver()
            with StopCall("socketcan", channel):
                assert reached.wait(60.0)
        with BusLock("socketcan", channel) as lock:
            assert lock.stopped is not delivers
            lock.settle()
        reached.clear()
    with BusLock("socketcan", channel) as lock:
        assert not lock.stopped
        write_note(lock.name)
    with BusLock("socketcan", channel) as lock:
        assert lock.stopped  # it was noted while the lock was held, and never asked for: that came too late


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize(("ago_s", "found"), [(10.0, False), (4.0, True)])
def test_the_note_at_the_end_of_a_stop_is_for_those_that_were_started_since(
    monkeypatch: pytest.MonkeyPatch, ago_s: float, found: bool
) -> None:
    """A program whose run the stop has ended may begin another one: it knows of that stop."""
    started(monkeypatch, ago_s)
    settle(LOCK)
    write_note(LOCK, now_ns() - 5 * 10**9)
    assert stopped(LOCK) is found


@pytest.mark.usefixtures("others")
def test_what_was_before_a_users_new_request_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the page: "Prepare"."""
    started(monkeypatch, 3600.0)
    write_note(LOCK)
    asked_anew(now_ns())
    assert not stopped(LOCK)
    asked_anew(now_ns())
    write_note(LOCK)  # while it is prepared
    assert stopped(LOCK)


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_process_that_does_a_part_of_the_work_began_with_the_program(method: str, notes: Path) -> None:
    """Its joint is one of the program that has started it, before or after the stop."""
    write_note(LOCK)
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        assert pool.submit(stopped_in, notes).result()


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize(("parents_pid", "found"), [(None, False), (10, True), (11, False)])
def test_the_process_that_shares_its_work_is_asked_for_its_date(
    monkeypatch: pytest.MonkeyPatch, parents_pid: int | None, found: bool
) -> None:
    write_note(LOCK)
    parent = None if parents_pid is None else SimpleNamespace(pid=parents_pid)
    monkeypatch.setattr("multiprocessing.process.parent_process", lambda: parent)
    later_ns = now_ns()
    monkeypatch.setattr(stop_note, "_first_ns", later_ns)
    monkeypatch.setattr(stop_note, "_started_ns", lambda pid: {10: later_ns - 10**9, 11: 0}.get(pid, later_ns))
    assert stopped(LOCK) is found
    much_later_ns = later_ns + round(SHARED_S * 1e9)  # a worker for each job, of a parent that lives for weeks
    monkeypatch.setattr(stop_note, "_started_ns", lambda pid: later_ns - 10**9 if pid == 10 else much_later_ns)
    assert not stopped(LOCK)


def stopped_in(notes: Path) -> bool:
    stop_note.FOLDER = notes
    return stopped(LOCK)


@pytest.mark.parametrize("way", ["itself", "child"])
def test_a_stop_of_its_own_ends_nothing_but_what_it_has_begun_before(
    monkeypatch: pytest.MonkeyPatch, way: str, notes: Path
) -> None:
    """A program that makes sure that the drive is off before it begins."""

    def stop() -> None:
        if way == "itself":
            write_note(LOCK)
            return
        write = "import sys; from jointctl.drivers import stop_note; from pathlib import Path\n"
        write += "stop_note.FOLDER = Path(sys.argv[1]); stop_note.write_note(sys.argv[2])"
        shell = ["sh", "-c", '"$@"; true', "sh"]
        subprocess.run([*shell, sys.executable, "-c", write, str(notes), LOCK], check=True)

    started(monkeypatch, 5.0)
    stop()
    assert not stopped(LOCK)
    asked(now_ns())
    assert not stopped(LOCK)
    stop()
    assert stopped(LOCK)


def test_a_process_is_dated_by_the_clock_of_the_notes() -> None:
    before_ns = now_ns()
    with subprocess.Popen(["sleep", "60"]) as process:
        started_ns = stop_note._started_ns(process.pid)
        process.kill()
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    assert before_ns - tick_ns <= started_ns < now_ns()


def test_where_no_one_knows_when_it_began_each_stop_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))
    monkeypatch.setattr(stop_note, "_status", lambda _: [])
    write_note(LOCK)
    assert stopped(LOCK)


def test_a_stop_comes_from_its_process_and_all_above() -> None:
    from_here = list(stop_note._ancestors())
    assert from_here[:2] == [os.getpid(), os.getppid()]
    assert from_here[-1] == 1  # which is a container's program itself


def test_another_process_of_the_same_number_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a container numbers are small, and come again."""
    date, status = "1", stop_note._status
    monkeypatch.setattr(stop_note, "_status", lambda pid: [*status(pid)[:19], date, *status(pid)[20:]])
    write_note(LOCK)
    date = "2"
    monkeypatch.setattr(stop_note, "_began_ns", lambda: 0)
    assert stopped(LOCK)


@pytest.mark.parametrize("content", [b"", b"x", b"\0" * 8, b"-", "\u0663".encode(), b"9" * 5000, b"9" * 40])
def test_garbage_is_no_note(notes: Path, content: bytes) -> None:
    garbage = notes / f"{LOCK}-stop-1"
    garbage.write_bytes(content)
    assert not stopped(LOCK)
    write_note(LOCK)
    remove_old(LOCK)
    assert [path for path in notes.iterdir() if path != garbage]


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize("kind", ["link", "fifo", "folder", "another's", "root's", "open", "linked", "of another lock"])
def test_what_is_neither_ours_nor_roots_is_no_note(notes: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    write_note(LOCK)
    (path,) = notes.iterdir()
    assert stopped(LOCK)
    if kind in ("another's", "root's"):
        owner, mode = {"another's": 4711, "root's": 0}[kind], path.stat().st_mode
        others = {"geteuid": lambda: 4712, "fstat": lambda _: SimpleNamespace(st_mode=mode, st_uid=owner, st_nlink=1)}
        monkeypatch.setattr(stop_note, "os", SimpleNamespace(**{**vars(os), **others}))
    else:
        content = path.rename(notes / "elsewhere")
        made: dict[str, Callable[[], object]] = {
            "link": lambda: path.symlink_to(content), "fifo": lambda: os.mkfifo(path), "folder": path.mkdir,
            "linked": lambda: path.hardlink_to(content),
            "of another lock": lambda: path.write_text(f"{LOCK}2 {now_ns()} 0"),
            "open": lambda: (shutil.copy(content, path), path.chmod(0o666)),
        }  # fmt: skip
        made[kind]()
    files = len(os.listdir("/proc/self/fd"))
    stop_note._settled_ns.clear()
    assert stopped(LOCK) is (kind in ("root's", "linked"))
    remove_old(LOCK)
    assert len(os.listdir("/proc/self/fd")) == files


@pytest.mark.usefixtures("others")
def test_they_stay_for_a_day(notes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, umask = now_ns(), os.umask(0o077)
    monkeypatch.setattr(stop_note, "now_ns", lambda: now)
    monkeypatch.setattr(stop_note, "_began_ns", lambda: 0)
    write_note("jointctl-bus-old")
    now += round(KEPT_S * 1e9)
    write_note("jointctl-bus-new")
    for _ in range(MOST + 3):
        write_note(LOCK)
        now += 1
    os.umask(umask)
    assert stopped("jointctl-bus-new")
    assert not stopped("jointctl-bus-old")
    remove_old(LOCK)
    left = [path.name.rpartition("-stop-") for path in notes.iterdir()]
    assert sorted(lock for lock, *_ in left) == ["jointctl-bus-new", *[LOCK] * MOST]
    assert {path.stat().st_mode & 0o777 for path in notes.iterdir()} == {0o644}
    assert max(int(name.split("-")[0]) for *_, name in left) == now - 1


def test_a_note_that_cannot_be_written_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path / "none")
    told: list[str] = []
    with StopCall("socketcan", "tested-no-note") as call:
        end_programs([call], told.append)
    assert len(told) == 1
    assert "just starting" in told[0]
    assert "No such file" in told[0]
    assert not stopped(LOCK)
    files = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path)
    write_note(LOCK)
    full = SimpleNamespace(**{**vars(os), "write": lambda *_: (_ for _ in ()).throw(OSError(28, "No space left"))})
    monkeypatch.setattr(stop_note, "os", full)
    with pytest.raises(OSError, match="No space left"):
        write_note(LOCK)
    assert len(list(tmp_path.iterdir())) == 1
    assert len(os.listdir("/proc/self/fd")) == files


@pytest.mark.usefixtures("others")
def test_the_lock_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    channel = f"stop-note-lock-{os.getpid()}"
    for expected in (False, True):
        with BusLock("socketcan", channel) as lock:
            assert lock.stopped is expected
        with StopCall("socketcan", channel) as call:
            end_programs([call], pytest.fail)
    monkeypatch.setattr(bus_lock.sys, "platform", "darwin")  # no locks, and no notes
    with BusLock("socketcan", channel) as lock, StopCall("socketcan", channel):
        assert not lock.stopped


@pytest.mark.usefixtures("others")
def test_a_stop_notes_when_it_begins_and_when_it_ends_and_clears_away(
    notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = now_ns()
    monkeypatch.setattr(stop_note, "now_ns", lambda: now)
    write_note("jointctl-bus-old")
    now += round(KEPT_S * 1e9) + 1
    with StopCall("socketcan", "tested-two-notes") as call:
        written = {now}
        assert [int(path.read_bytes().split()[1]) for path in notes.glob(f"{call._name}*")] == [now]
        now += 1000  # a program has been started since
        end_programs([call], pytest.fail)
    assert {int(path.read_bytes().split()[1]) for path in notes.iterdir()} == {*written, now}
    with StopCall("virtual", "x") as call:  # python-can's own: no one else can be on it
        end_programs([call], pytest.fail)
    assert len(list(notes.iterdir())) == 2


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOENT, errno.EACCES])
def test_a_note_that_may_be_there_is_not_overlooked(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def fail(*_: Any) -> int:
        raise OSError(number, "cannot be opened")

    write_note(LOCK)
    monkeypatch.setattr(stop_note, "os", SimpleNamespace(**{**vars(os), "open": fail}))
    hides = number in (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
    with pytest.raises(OSError, match="cannot be opened") if hides else nullcontext():
        assert not stopped(LOCK)


@pytest.mark.usefixtures("others")
def test_where_no_lock_can_be_had_the_notes_count_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_socket(*_: Any) -> None:
        raise PermissionError

    monkeypatch.setattr(bus_lock, "listener", no_socket)
    for expected in (False, True):
        with BusLock("socketcan", "tested-no-socket") as lock:
            assert lock.stopped is expected
        write_note(lock_name("socketcan", "tested-no-socket"))
    lock.settle()
    with BusLock("socketcan", "tested-no-socket") as lock:
        assert not lock.stopped  # it was told: once


@pytest.mark.usefixtures("others")
def test_a_stop_looks_at_all_its_buses_until_no_one_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """While one bus's program brakes, another one may take the bus that was free."""
    found = {"a": [True, False, False], "b": [False, True, False]}
    looks: list[str] = []

    class Call(StopCall):
        def __init__(self, name: str) -> None:
            super().__init__("socketcan", f"tested-looks-{name}")
            self.name = name

        def end(self, note: Any, ended: Any) -> bool:
            looks.append(self.name)
            return found[self.name].pop(0)

    with Call("a") as a, Call("b") as b:
        end_programs([a, b], pytest.fail)
    assert looks == ["a", "b"] * 3
