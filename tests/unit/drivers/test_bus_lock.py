"""One controller for each bus of this computer: the second is told who the first is, and a dead one leaves nothing."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest

from jointctl.drivers.bus_lock import NAMES, BusLock, Holder, lock_name, wait_for_answers
from jointctl.drivers.errors import BusError
from jointctl.tools.running import stop_call
from jointctl.tools.running.stop_call import StopCall

LOCK = """
import sys, time
from jointctl.drivers.bus_lock import BusLock
lock = BusLock(*sys.argv[1:])
print("mine", flush=True)
time.sleep(60)
"""


@pytest.fixture
def channel() -> str:
    """A name that no other test has."""
    return f"locked-{os.getpid()}"


def test_the_second_is_told_who_has_the_bus(channel: str) -> None:
    command = [sys.executable, "-c", LOCK, "socketcan", channel]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        try:
            said: IO[str] | None = first.stdout
            assert said is not None
            assert said.readline() == "mine\n"
            for _ in range(3):
                with pytest.raises(BusError, match=rf"controls socketcan:{channel} \(.*, pid {first.pid}\)"):
                    BusLock("socketcan", channel)
            first.send_signal(signal.SIGKILL)
            first.wait()
            BusLock("socketcan", channel).close()
        finally:
            first.kill()


def test_a_bus_is_free_again_after_its_controller(channel: str) -> None:
    lock = BusLock("socketcan", channel)
    lock.close()
    lock.close()
    with BusLock("socketcan", channel), pytest.raises(BusError):
        BusLock("socketcan", channel)
    BusLock("socketcan", channel).close()


def test_other_buses_are_others(channel: str) -> None:
    with BusLock("socketcan", channel), BusLock("socketcan", f"{channel}2"), BusLock("pcan", channel):
        pass


def test_links_lead_to_the_same_bus(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "adapter").symlink_to("ttyACM0")
    device, link = str(tmp_path / "ttyACM0"), str(tmp_path / "adapter")
    assert lock_name("slcan", f"{link}@115200") == lock_name("slcan", device)
    assert lock_name("jointctl", link) == lock_name("jointctl", device)
    assert lock_name("seeedstudio", link) == lock_name("seeedstudio", device) != lock_name("slcan", device)


def test_a_bus_of_the_same_name_behind_another_mount_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket_file = tmp_path / "bus.sock"
    first = socket.socket(socket.AF_UNIX)
    first.bind(str(socket_file))
    address = lock_name("jointctl", str(socket_file))
    assert lock_name("jointctl", str(socket_file)) == address
    socket_file.rename(tmp_path / "other.sock")
    with socket.socket(socket.AF_UNIX) as second:
        second.bind(str(socket_file))
        assert lock_name("jointctl", str(socket_file)) != address
    first.close()
    monkeypatch.chdir(tmp_path)
    url = lock_name("slcan", "socket://host:1234")
    monkeypatch.chdir("/")
    assert lock_name("slcan", "socket://host:1234") == url


def test_where_such_sockets_are_forbidden_there_is_no_lock(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "socket", forbidden)
    BusLock("socketcan", channel).close()


def test_a_bus_inside_a_process_needs_no_lock(channel: str) -> None:
    with BusLock("virtual", channel), BusLock("virtual", channel):
        pass


def test_no_process_that_was_started_keeps_the_lock(channel: str) -> None:
    lock = BusLock("socketcan", channel)
    command = [sys.executable, "-c", "print(flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, close_fds=False) as child:
        assert child.stdout is not None
        assert child.stdout.readline()
        lock.close()
        BusLock("socketcan", channel).close()
        child.communicate(b"\n")


# --- who is a controller, and how a stop reaches it ------------------------------------------------------------------

HOLD = """
import signal, sys, time
from jointctl.drivers.bus_lock import BusLock
stopped = []
lock = BusLock(*sys.argv[1:], on_stop=lambda: stopped.append(1))
print("mine", flush=True)
while not stopped:
    time.sleep(0.01)
print("stopped", flush=True)
"""


@contextmanager
def controller(channel: str, code: str = HOLD) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", code, "socketcan", channel]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "mine\n"
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("held", [1, NAMES])
def test_a_mere_holder_of_the_name_is_a_remark(channel: str, held: int) -> None:
    name = lock_name("socketcan", channel)
    with ExitStack() as stack:
        for number in range(held):
            squatter = stack.enter_context(socket.socket(socket.AF_UNIX))
            squatter.bind(b"\0" + (name if number == 0 else f"{name}-{number}").encode())
            squatter.listen()
        with BusLock("socketcan", channel) as lock:
            assert len(lock.remarks) == held + (held == NAMES)
            assert "is no controller: it is ignored" in lock.remarks[0]
            if held < NAMES:
                with pytest.raises(BusError, match="another program controls"):
                    BusLock("socketcan", channel)
        called = StopCall("socketcan", channel)
        with called:
            assert called.end(lambda _: None) is False


def test_a_controller_that_is_stopped_still_refuses_the_second(channel: str) -> None:
    with controller(channel) as process:
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(BusError, match=rf"does not answer still controls .*pid {process.pid}"):
            BusLock("socketcan", channel)
        process.send_signal(signal.SIGCONT)
        with pytest.raises(BusError, match=rf"another program controls .*pid {process.pid}"):
            BusLock("socketcan", channel)


def test_a_stop_is_acknowledged_and_waited_for(channel: str) -> None:
    notes: list[str] = []
    with controller(channel) as process:
        with StopCall("socketcan", channel) as call:
            assert call.end(notes.append)
        assert process.stdout is not None
        assert process.stdout.read() == "stopped\n"
        assert process.wait(5.0) == 0
    assert notes == [f"stopping the program that controls the bus (pid {process.pid})"]


@pytest.mark.parametrize("number", [signal.SIGSTOP, None])
def test_one_that_does_not_end_is_ended(channel: str, number: signal.Signals | None) -> None:
    notes: list[str] = []
    deaf = HOLD.replace("while not stopped:", "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nwhile True:")
    with controller(
        channel, deaf.replace("lock = BusLock(*sys.argv[1:],", "lock = BusLock(*sys.argv[1:], within_s=0.2,")
    ) as process:
        if number is not None:
            process.send_signal(number)
        with StopCall("socketcan", channel) as call:
            assert call.end(notes.append)
        assert process.wait(5.0) == -signal.SIGKILL
    assert f"ending process {process.pid}" in notes[-1]


@pytest.mark.parametrize("data", [b"", b"garbage\n", b"[" * 300, b'{"ask": 7}\n', b"x" * 10_000])
def test_garbage_and_silence_keep_no_one_from_stopping(channel: str, data: bytes) -> None:
    stopped: list[int] = []
    with BusLock("socketcan", channel, lambda: stopped.append(1)), ExitStack() as stack:
        for _ in range(100):
            caller = stack.enter_context(socket.socket(socket.AF_UNIX))
            caller.connect(b"\0" + lock_name("socketcan", channel).encode())
            with suppress(OSError):
                caller.sendall(data)
        holder = Holder(lock_name("socketcan", channel), 0)
        holder.send("stop")
        wait_for_answers([holder])
        assert holder.within_s is not None
        assert stopped == [1]
        holder.close()


def test_a_program_that_starts_for_too_long_is_named(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_call, "STARTING_S", 0.6)
    monkeypatch.setattr(stop_call, "TOLD_S", 0.2)
    slow = "import os, time\nmark = os.memfd_create('jointctl-starting')\nprint('mine', flush=True)\ntime.sleep(60.0)\n"
    notes: list[str] = []
    with controller(channel, slow) as process, StopCall("socketcan", channel) as call:
        assert not call.end(notes.append)
        assert process.poll() is None  # it may be another joint's
    named = [note for note in notes if str(process.pid) in note]
    assert [note.split(" for ")[0] for note in named] == ["waiting", "not waiting any longer"]


def test_a_program_that_starts_is_waited_for(channel: str) -> None:
    late = "import os, time\nmark = os.memfd_create('jointctl-starting')\nprint('mine', flush=True)\ntime.sleep(0.7)\n"
    notes: list[str] = []
    with controller(channel, late + HOLD.replace('print("mine", flush=True)', "")) as process:
        with StopCall("socketcan", channel) as call:
            assert call.end(notes.append)
        assert process.wait(5.0) == 0


# --- a stop step by step, in simulated time --------------------------------------------------------------------------

FOR_EVER = 1e9


class Program:
    """As `Holder`: a program that holds a name of the lock, until `leaves_s`."""

    def __init__(self, pid: int = 7, *, leaves_s: float = FOR_EVER, **said: Any) -> None:
        self.pid, self._leaves_s = pid, leaves_s
        self.is_controller: bool = said.get("is_controller", True)
        self.within_s: float | None = said.get("within_s")
        self.refused: str = said.get("refused", "")
        self.log: list[str] = []
        self.computer: Computer | None = None

    def send(self, ask: str) -> None:
        self.log.append(ask)

    def close(self) -> None:
        self.log.append("closed")

    @property
    def left(self) -> bool:
        assert self.computer is not None
        return self.computer.now_s >= self._leaves_s


class Computer:
    """`holders`: who has the lock at each further look.  `starting`, `marked`: process -> when it loses its mark."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *holders: list[Program], marked: dict[int, float] | None = None,
        starting: dict[int, float] | None = None, deaf_to: tuple[signal.Signals, ...] = (),
    ) -> None:  # fmt: skip
        self.now_s = 0.0
        self.holders = [*holders]
        self.marks = {stop_call.STARTING: starting or {}, lock_name("socketcan", "x"): marked or {}}
        self.deaf_to = deaf_to
        self.signals: list[tuple[list[int], str, float]] = []
        self.notes: list[str] = []
        for program in (program for look in holders for program in look):
            program.computer = self
        monkeypatch.setattr(stop_call, "time", SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.sleep))
        monkeypatch.setattr(stop_call, "lock_holders", lambda *_: self.holders.pop(0) if self.holders else [])
        monkeypatch.setattr(stop_call, "wait_for_answers", lambda _: None)
        monkeypatch.setattr(stop_call, "is_marked", self.is_marked)
        monkeypatch.setattr(
            stop_call, "marked_processes", lambda name: [pid for pid in self.marks[name] if self.is_marked(pid, name)]
        )
        monkeypatch.setattr(stop_call, "_signalled", self.signalled)

    def sleep(self, seconds: float) -> None:
        self.now_s = round(self.now_s + seconds, 6)

    def is_marked(self, pid: int, name: str) -> bool:
        return self.now_s < self.marks[name][pid]

    def signalled(self, pids: list[int], name: str, number: signal.Signals, wait_s: float) -> list[int]:
        self.signals.append((pids, number.name, wait_s))
        if number in self.deaf_to:
            return pids
        for pid in pids:
            self.marks[name][pid] = self.now_s
        return []

    def stopped(self) -> bool:
        with StopCall("socketcan", "x") as call:
            return call.end(self.notes.append)


def test_where_no_one_has_the_bus_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    computer = Computer(monkeypatch)
    assert not computer.stopped()
    assert (computer.now_s, computer.notes, computer.signals) == (0.0, [], [])


@pytest.mark.parametrize(
    ("leaves_s", "unmarked_s", "within_s", "waited_s", "forced"),
    [
        (1.0, 0.5, 8.0, 1.0, False),
        (0.5, 2.0, 8.0, 2.0, False),  # one of its processes takes longer
        (FOR_EVER, 0.0, 3.0, 3.0, False),
        (FOR_EVER, FOR_EVER, 3.0, 3.0, True),
        (FOR_EVER, FOR_EVER, 0.0, 0.0, True),
        (FOR_EVER, FOR_EVER, 1000.0, stop_call.LONGEST_S, True),
    ],
)
def test_one_that_acknowledges_has_its_own_time(
    monkeypatch: pytest.MonkeyPatch, leaves_s: float, unmarked_s: float, within_s: float, waited_s: float, forced: bool
) -> None:
    program = Program(leaves_s=leaves_s, within_s=within_s)
    computer = Computer(monkeypatch, [program], marked={7: unmarked_s})
    assert computer.stopped()
    assert computer.now_s == waited_s
    assert computer.notes[0] == "stopping the program that controls the bus (pid 7)"
    assert (len(computer.notes), bool(computer.signals)) == (1 + forced, forced)
    assert program.log == ["stop", "closed"]


def test_of_two_controllers_the_slower_one_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    computer = Computer(monkeypatch, [Program(7, within_s=2.0, leaves_s=1.0), Program(8, within_s=5.0)])
    assert computer.stopped()
    assert computer.now_s == 5.0


@pytest.mark.parametrize("said", [{}, {"refused": "it is another's"}, {"is_controller": False, "within_s": 8.0}])
def test_no_time_is_given_to_one_that_does_not_acknowledge(
    monkeypatch: pytest.MonkeyPatch, said: dict[str, Any]
) -> None:
    computer = Computer(monkeypatch, [Program(**said)])
    assert computer.stopped() is said.get("is_controller", True)
    refused = "the program that controls the bus (pid 7) cannot be ended: it is another's"
    assert computer.notes == ([refused] if "refused" in said else [])
    assert computer.now_s == 0.0


@pytest.mark.parametrize("first", [[], [Program(6, is_controller=False)]])
def test_a_controller_that_came_after_the_request_gets_one_of_its_own(
    monkeypatch: pytest.MonkeyPatch, first: list[Program]
) -> None:
    later = Program(leaves_s=0.1, within_s=8.0)
    computer = Computer(monkeypatch, first, [later], marked={7: 0.1})
    assert computer.stopped()
    assert later.log == ["stop", "closed"]
    assert all(program.log == ["stop", "closed"] for program in first)
    assert computer.signals == []


def test_a_controller_that_was_asked_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    computer = Computer(monkeypatch, [Program(within_s=8.0, leaves_s=0.1)], marked={7: 0.1})
    computer.stopped()
    assert computer.notes == ["stopping the program that controls the bus (pid 7)"]


@pytest.mark.parametrize(("started_s", "waited_s"), [(0.0, 0.0), (3.0, 3.0), (FOR_EVER, stop_call.STARTING_S)])
def test_one_that_starts_is_waited_for_and_ended_as_well(
    monkeypatch: pytest.MonkeyPatch, started_s: float, waited_s: float
) -> None:
    later = Program(leaves_s=0.0, within_s=8.0)
    computer = Computer(monkeypatch, [], [later], starting={7: started_s, 8: 0.0})
    assert computer.stopped()
    assert computer.now_s == waited_s
    assert later.log == ["stop", "closed"]


@pytest.mark.parametrize("deaf_to", [(), (signal.SIGTERM,), (signal.SIGTERM, signal.SIGKILL)])
def test_what_is_left_is_ended_by_force(monkeypatch: pytest.MonkeyPatch, deaf_to: tuple[signal.Signals, ...]) -> None:
    computer = Computer(monkeypatch, [], [], marked={7: FOR_EVER, 9: FOR_EVER}, deaf_to=deaf_to)
    computer.stopped()
    left = [7, 9] if deaf_to else []
    assert computer.signals[:2] == [([7, 9], "SIGTERM", stop_call.TERM_S), (left, "SIGKILL", stop_call.KILL_S)]
    assert computer.notes[0] == f"it does not end by itself: ending process 7, 9; {stop_call.ARMED}"
    cannot = "process 7, 9 cannot be ended; the drive may be enabled again"
    assert (cannot in computer.notes) is (signal.SIGKILL in deaf_to)


@pytest.mark.parametrize("marked", [True, False])
def test_only_what_acts_for_the_controller_gets_the_signal(monkeypatch: pytest.MonkeyPatch, marked: bool) -> None:
    monkeypatch.setattr(stop_call, "is_marked", lambda pid, name: marked and name == "its name")
    monkeypatch.setattr(stop_call, "time", SimpleNamespace(monotonic=lambda: 0.0))
    open_before = len(os.listdir("/proc/self/fd"))
    with subprocess.Popen(["sleep", "60"]) as process, subprocess.Popen(["true"]) as gone:
        gone.wait()
        assert stop_call._signalled([gone.pid, process.pid], "its name", signal.SIGTERM, 0.5) == []
        if not marked:
            process.kill()
        assert process.wait() == (-signal.SIGTERM if marked else -signal.SIGKILL)
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_those_that_live_on_after_a_signal_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_call, "is_marked", lambda *_: True)
    with subprocess.Popen(["sleep", "60"]) as process:
        assert stop_call._signalled([process.pid], "its name", signal.SIGCONT, 0.01) == [process.pid]
        process.kill()
