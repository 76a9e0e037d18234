"""A stop that comes before the program that it is for has its bus."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jointctl.drivers import bus_lock, stop_note
from jointctl.drivers.bus_lock import BusLock, StopCall, lock_name
from jointctl.drivers.stop_note import KEPT_S, asked, now_ns, remove_older, stopped, write_note

LOCK = "jointctl-bus-tested"
EVERYONES = Path("/dev/shm")
TAKES = (  # the lock, when it is told to; what it found
    "import sys, time; from jointctl.drivers.bus_lock import BusLock; print('begun', flush=True); input()\n"
    "with BusLock('socketcan', sys.argv[1]) as lock: print(lock.stopped)\n"
)


@pytest.fixture(autouse=True)
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own, for a process that has not been asked for anything yet."""
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path)
    monkeypatch.setattr(stop_note, "_asked_ns", None)
    monkeypatch.setattr(stop_note, "_by_hand", False)
    monkeypatch.setattr(stop_note, "_served", set())
    return tmp_path


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stops of this process are another's."""
    monkeypatch.setattr(stop_note, "_ancestors", lambda _: iter([1_000_000_001]))


def started(monkeypatch: pytest.MonkeyPatch, ago_s: float) -> int:
    started_ns = now_ns() - round(ago_s * 1e9)
    monkeypatch.setattr(stop_note, "_started_ns", lambda: started_ns)
    return started_ns


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
                "import sys; from jointctl.drivers.bus_lock import StopCall\n"
                "with StopCall('socketcan', sys.argv[1]) as call: call.end(print)", channel,
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
def test_a_verb_is_stopped_by_each_stop_since_its_process_began(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not stopped(LOCK)
    write_note(LOCK)
    started(monkeypatch, -0.001)
    assert not stopped(LOCK)
    started(monkeypatch, 10_000.0)  # it may have compiled, or waited for another lock
    assert stopped(LOCK)
    assert stopped(LOCK)
    assert not stopped(LOCK + "2")


@pytest.mark.usefixtures("others")
def test_a_program_that_was_asked_later_is_its_users_new_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """A notebook of this morning, a page: what was stopped before is another matter."""
    started(monkeypatch, 3600.0)
    write_note(LOCK)
    asked(now_ns())
    assert not stopped(LOCK)
    write_note(LOCK)  # while it loads
    assert stopped(LOCK)


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize(("ago_s", "found"), [(59.0, True), (61.0, False)])
def test_one_that_has_just_been_started_was_started_for_its_joint(
    monkeypatch: pytest.MonkeyPatch, ago_s: float, found: bool
) -> None:
    """It imports what it needs before it comes to the line with its `Joint`, for seconds on a busy computer."""
    started(monkeypatch, ago_s)
    write_note(LOCK)
    asked(now_ns())
    assert stopped(LOCK) is found
    asked(now_ns())  # once more: it knows of that stop by now
    assert not stopped(LOCK)


@pytest.mark.usefixtures("others")
def test_a_press_comes_after_every_stop_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page of a minute ago, whose first run did not get the bus: its user has stopped the program that had it."""
    started(monkeypatch, 59.0)
    write_note(LOCK)
    asked(now_ns(), by_hand=True)
    assert not stopped(LOCK)
    write_note(LOCK)
    assert stopped(LOCK)


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


def test_its_own_process_is_dated_by_the_clock_of_the_notes() -> None:
    before_ns = now_ns()
    date = "from jointctl.drivers.stop_note import _started_ns, now_ns; print(_started_ns(), now_ns())"
    told = subprocess.run([sys.executable, "-c", date], capture_output=True, text=True, check=True).stdout.split()
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    assert before_ns - tick_ns <= int(told[0]) < int(told[1]) < now_ns()


@pytest.mark.parametrize("content", [b"", b"x", b"12 y", b"\0" * 8, b"-", "\u0663".encode(), b"9" * 5000])
def test_garbage_is_no_note(notes: Path, content: bytes) -> None:
    (notes / f"{LOCK}-stop-1").write_bytes(content)
    assert not stopped(LOCK)
    write_note(LOCK)
    remove_older(LOCK)
    assert len(list(notes.iterdir())) == 2


@pytest.mark.usefixtures("others")
@pytest.mark.parametrize("kind", ["link", "fifo", "folder", "another's"])
def test_what_is_not_ours_is_no_note(notes: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    write_note(LOCK)
    (path,) = notes.iterdir()
    assert stopped(LOCK)
    if kind == "another's":
        monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
        expected = path.stat().st_uid == 0  # root's counts for everyone
    else:
        expected = False
        content = path.rename(notes / "elsewhere")
        {"link": lambda: path.symlink_to(content), "fifo": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    assert stopped(LOCK) is expected


@pytest.mark.usefixtures("others")
def test_the_newest_of_each_lock_stays_for_a_day(notes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = now_ns()
    monkeypatch.setattr(stop_note, "now_ns", lambda: now)
    write_note("jointctl-bus-old")
    now += round(KEPT_S * 1e9)
    write_note("jointctl-bus-new")
    for _ in range(3):
        write_note(LOCK)
        now += 1
    remove_older(LOCK)
    left = sorted(path.name.rpartition("-stop-")[0] for path in notes.iterdir())
    assert left == ["jointctl-bus-new", LOCK]
    assert [path.stat().st_mode & 0o777 for path in notes.iterdir()] == [0o644, 0o644]
    started_ns = now - 2
    monkeypatch.setattr(stop_note, "_started_ns", lambda: started_ns)
    assert stopped(LOCK)


def test_a_note_that_cannot_be_written_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path / "none")
    told: list[str] = []
    with StopCall("socketcan", "tested-no-note") as call:
        call.end(told.append)
    assert len(told) == 1
    assert "just starting" in told[0]
    assert "No such file" in told[0]
    assert not stopped(LOCK)


@pytest.mark.usefixtures("others")
def test_the_lock_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    channel = f"stop-note-lock-{os.getpid()}"
    for expected in (False, True):
        with BusLock("socketcan", channel) as lock:
            assert lock.stopped is expected
        with StopCall("socketcan", channel) as call:
            call.end(pytest.fail)
    monkeypatch.setattr(bus_lock.sys, "platform", "darwin")  # no locks, and no notes
    with BusLock("socketcan", channel) as lock, StopCall("socketcan", channel):
        assert not lock.stopped
