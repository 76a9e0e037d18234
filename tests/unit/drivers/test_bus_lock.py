"""One controller for each bus of this computer: the second is told who the first is, and a dead one leaves nothing."""

from __future__ import annotations

import errno
import os
import resource
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers import bus_lock
from jointctl.drivers.bus_lock import (
    NAMES,
    STOP_WITHIN_S,
    BusLock,
    Holder,
    StopCall,
    end_programs,
    is_marked,
    lock_holders,
    lock_name,
    marked_processes,
    send_line,
    wait_for_answers,
)  # fmt: skip
from jointctl.drivers.can.virtual_bus import socket_path
from jointctl.drivers.errors import BusError
from jointctl.drivers.port_users import keep_from_forks
from jointctl.drivers.stop_note import LOCKS
from tests.python_process import forked


@pytest.fixture
def channel() -> str:
    """A name that no other test has."""
    return f"locked-{os.getpid()}"


@pytest.fixture
def name(channel: str) -> str:
    """That of its lock."""
    return lock_name("socketcan", channel)


@contextmanager
def squatter(name: str) -> Iterator[socket.socket]:
    """Someone who holds the name of a lock and is no controller."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(b"\0" + name.encode())
        listener.listen()
        yield listener


@contextmanager
def first_holder(channel: str) -> Iterator[Holder]:
    """The one that a stop would ask."""
    (holder,) = lock_holders("socketcan", channel)
    yield holder
    holder.close()


def test_the_second_is_told_who_has_the_bus_and_a_dead_one_leaves_nothing(channel: str) -> None:
    with controller(channel) as first:
        for _ in range(3):
            with pytest.raises(BusError, match=rf"controls socketcan:{channel} \(.*, pid {first.pid}\)"):
                BusLock("socketcan", channel)
        first.kill()
        first.wait()
        BusLock("socketcan", channel).close()


def test_a_bus_is_free_again_after_its_controller_and_others_are_others(channel: str) -> None:
    lock = BusLock("socketcan", channel)
    lock.close()
    lock.close()
    with BusLock("socketcan", channel), BusLock("socketcan", f"{channel}2"), BusLock("pcan", channel):
        with pytest.raises(BusError):
            BusLock("socketcan", channel)
        with BusLock("virtual", channel), BusLock("virtual", channel):  # inside a process: no lock is needed
            pass
    BusLock("socketcan", channel).close()


def test_links_lead_to_the_same_bus(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "adapter").symlink_to("ttyACM0")
    device, link = str(tmp_path / "ttyACM0"), str(tmp_path / "adapter")
    assert lock_name("slcan", f"{link}@115200") == lock_name("slcan", device)
    assert lock_name("jointctl", link) == lock_name("jointctl", device)
    assert lock_name("jointctl", "no-such-bus") == lock_name("jointctl", str(socket_path("no-such-bus")))
    assert lock_name("seeedstudio", link) == lock_name("seeedstudio", device) != lock_name("slcan", device)


def test_an_altname_of_an_interface_is_the_same_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    """`jointctl stop -c` with the other name would not have found the program that controls it."""
    name = lock_name("socketcan", "can0")
    monkeypatch.setattr(socket, "if_nametoindex", {"can0": 4, "left-arm": 4, "can1": 5}.__getitem__)
    monkeypatch.setattr(socket, "if_indextoname", {4: "can0", 5: "can1"}.__getitem__)
    assert (
        lock_name("socketcan", "left-arm") == lock_name("socketcan", "can0") == name != lock_name("socketcan", "can1")
    )


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


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM])
@pytest.mark.parametrize("what", ["socket", "socketpair"])
def test_for_want_of_descriptors_no_one_goes_on_without_a_lock(
    channel: str, monkeypatch: pytest.MonkeyPatch, what: str, number: int
) -> None:
    """`jointctl stop` would not reach it, and a second controller not be kept off."""

    def exhausted(*_: object) -> None:
        raise OSError(number, "Too many open files")

    with monkeypatch.context() as scarce:
        scarce.setattr(socket, what, exhausted)
        with pytest.raises(OSError, match="Too many open files"):
            BusLock("socketcan", channel)
    assert not lock_holders("socketcan", channel)
    BusLock("socketcan", channel).close()


def test_no_process_that_was_started_keeps_the_lock(channel: str) -> None:
    lock = BusLock("socketcan", channel)
    command = [sys.executable, "-c", "print(flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, close_fds=False) as child:
        assert child.stdout.readline()
        lock.close()
        BusLock("socketcan", channel).close()
        child.communicate(b"\n")


# --- who is a controller, and how a stop reaches it ---
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
            assert process.stdout.readline() == "mine\n"
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("held", [1, NAMES])
def test_a_mere_holder_of_the_name_is_a_remark(channel: str, name: str, held: int) -> None:
    with ExitStack() as stack:
        for number in range(held):
            stack.enter_context(squatter(name if number == 0 else f"{name}-{number}"))
        with BusLock("socketcan", channel) as lock:
            assert len(lock.remarks) == held + (held == NAMES)
            assert "is no controller: it is ignored" in lock.remarks[0]
            if held < NAMES:
                with pytest.raises(BusError, match="another program controls"):
                    BusLock("socketcan", channel)
        with StopCall("socketcan", channel) as called:
            called.end(lambda _: None, lambda: pytest.fail("no controller was there"))


def test_a_controller_that_is_stopped_still_refuses_the_second(channel: str) -> None:
    with controller(channel) as process:
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)  # on another core it may go on for a moment
        with pytest.raises(BusError, match=rf"does not answer still controls .*pid {process.pid}"):
            BusLock("socketcan", channel)
        process.send_signal(signal.SIGCONT)
        with pytest.raises(BusError, match=rf"another program controls .*pid {process.pid}"):
            BusLock("socketcan", channel)


def test_a_stop_is_acknowledged_and_waited_for(channel: str) -> None:
    notes: list[str] = []
    ended: list[bool] = []
    with controller(channel) as process:
        with StopCall("socketcan", channel) as call:
            end_programs([call], notes.append, lambda: ended.append(True))
        assert ended
        assert process.stdout.read() == "stopped\n"
        assert process.wait(60.0) == 0
    assert notes == [f"stopping the program that controls the bus (pid {process.pid})"]


def test_the_one_program_of_several_buses_is_named_once(channel: str) -> None:
    notes: list[str] = []
    with controller(channel) as process:
        with StopCall("socketcan", channel) as call, StopCall("socketcan", channel) as of_another_bus:
            end_programs([call, of_another_bus], notes.append)
        assert process.wait(60.0) == 0
    assert notes == [f"stopping the program that controls the bus (pid {process.pid})"]


@pytest.mark.parametrize("number", [signal.SIGSTOP, None])
def test_one_that_does_not_end_is_ended(channel: str, number: signal.Signals | None) -> None:
    notes: list[str] = []
    ended: list[bool] = []
    deaf = HOLD.replace("while not stopped:", "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nwhile True:")
    with controller(
        channel, deaf.replace("lock = BusLock(*sys.argv[1:],", "lock = BusLock(*sys.argv[1:], within_s=0.2,")
    ) as process:
        if number is not None:
            process.send_signal(number)
        with StopCall("socketcan", channel) as call:
            end_programs([call], notes.append, lambda: ended.append(True))
        assert ended
        assert process.wait(60.0) == -signal.SIGKILL
    assert f"ending process {process.pid}" in notes[-1]


@pytest.mark.parametrize("data", [b"", b"garbage\n", b"[" * 300, b'{"ask": 7}\n', b"x" * 10_000])
def test_garbage_and_silence_keep_no_one_from_stopping(channel: str, name: str, data: bytes) -> None:
    stopped: list[int] = []
    with BusLock("socketcan", channel, lambda: stopped.append(1)), ExitStack() as stack:
        for _ in range(100):
            caller = stack.enter_context(caller_of(channel))
            with suppress(OSError):
                caller.sendall(data)
        holder = Holder(name, 0)
        holder.send("stop")
        wait_for_answers([holder])
        assert holder.within_s is not None
        assert stopped == [1]
        holder.close()


# --- the protocol and the marks, one by one ---
def caller_of(channel: str) -> socket.socket:
    caller = socket.socket(socket.AF_UNIX)
    caller.settimeout(60.0)
    caller.connect(b"\0" + lock_name("socketcan", channel).encode())
    return caller


@contextmanager
def asked(channel: str, ask: str) -> Iterator[Holder]:
    """The one that holds the lock, after its answer."""
    with first_holder(channel) as holder:
        holder.send(ask)
        wait_for_answers([holder])
        yield holder


def test_a_stop_counts_once_and_its_signals_are_blocked_where_it_is_called(channel: str) -> None:
    masks: list[set[signal.Signals]] = []

    def on_stop() -> None:
        masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))  # type: ignore[arg-type]

    with ExitStack() as stack:
        with BusLock("socketcan", channel, on_stop, 3.5):
            who = stack.enter_context(asked(channel, "who"))
            assert (who.is_controller, who.within_s, who.refused, masks) == (True, None, "", [])
            stops = [stack.enter_context(asked(channel, "stop")) for _ in range(2)]
            assert [stop.within_s for stop in stops] == [3.5, 3.5]
            assert not stops[0].left
        assert len(masks) == 1
        assert {signal.SIGINT, signal.SIGTERM, signal.SIGHUP} <= masks[0]
        assert all(holder.left for holder in (who, *stops))


@pytest.mark.parametrize("allowed", [False, True])
def test_a_stop_of_another_user_is_refused(channel: str, monkeypatch: pytest.MonkeyPatch, allowed: bool) -> None:
    stopped: list[int] = []
    monkeypatch.setattr(bus_lock, "may_ask", lambda _: allowed)
    with BusLock("socketcan", channel, lambda: stopped.append(1)), asked(channel, "stop") as holder:
        refused = "" if allowed else "this program belongs to another user"
        assert (holder.refused, holder.within_s) == (refused, STOP_WITHIN_S if allowed else None)
    assert stopped == [1] * allowed


@pytest.mark.parametrize("leaves", [False, True])
def test_a_program_of_another_user_that_goes_on_is_no_stop(
    channel: str, monkeypatch: pytest.MonkeyPatch, leaves: bool
) -> None:
    """It was a remark beside "the drive is switch on disabled", and nothing with -q; the twin ends by itself."""
    monkeypatch.setattr(bus_lock, "may_ask", lambda _: False)
    monkeypatch.setattr(bus_lock, "REFUSED_S", 60.0 if leaves else 0.05)
    monkeypatch.setattr(bus_lock, "marked_processes", lambda _: [])  # it would be this process
    with BusLock("socketcan", channel) as lock, StopCall("socketcan", channel) as call:
        closing = threading.Timer(0.2, lock.close)
        if leaves:
            closing.start()
        assert end_programs([call], pytest.fail)
        assert call.unended == (
            "" if leaves else f"the program that controls the bus (pid {os.getpid()}) cannot be ended: "
            "this program belongs to another user"
        )  # fmt: skip


def test_a_program_that_cannot_stop_acknowledges_all_the_same(channel: str) -> None:
    with BusLock("socketcan", channel), asked(channel, "stop") as holder:
        assert holder.within_s == STOP_WITHIN_S


def test_a_request_may_come_in_parts_and_again(channel: str) -> None:
    with BusLock("socketcan", channel), caller_of(channel) as caller:
        for part in (b'{"ask"', b': "who"}', b"\n"):
            caller.sendall(part)
            time.sleep(0)
        first = caller.recv(1000)
        caller.sendall(b'{"ask": "who"}\n')
        assert caller.recv(1000) == first != b""


@pytest.mark.parametrize("data", [b"garbage\n", b"[1]\n"])
def test_what_is_no_request_ends_the_connection(channel: str, data: bytes) -> None:
    with BusLock("socketcan", channel), caller_of(channel) as caller:
        caller.sendall(data)
        assert caller.recv(1000) == b""


@pytest.mark.parametrize(("length", "answered"), [(256, True), (257, False)])
def test_a_request_has_256_bytes_at_most(channel: str, length: int, answered: bool) -> None:
    with BusLock("socketcan", channel), caller_of(channel) as caller:
        caller.sendall(b'{"ask": "who"}'.ljust(length - 1) + b"\n")
        assert bool(caller.recv(1000)) is answered


def test_a_caller_that_never_reads_its_answers_holds_no_one_up(channel: str) -> None:
    with BusLock("socketcan", channel), caller_of(channel) as deaf, caller_of(channel) as other:
        for _ in range(1000):  # more answers than its end keeps
            deaf.sendall(b'{"ask": "who"}\n')
            for _ in range(2):  # when the second is answered, that of the deaf one has been taken
                other.sendall(b'{"ask": "who"}\n')
                assert other.recv(1000)


def test_the_65th_caller_takes_the_place_of_the_oldest(channel: str) -> None:
    with BusLock("socketcan", channel), ExitStack() as stack:
        callers = []
        for _ in range(64):
            callers.append(stack.enter_context(caller_of(channel)))
            callers[-1].sendall(b'{"ask": "who"}\n')
            assert callers[-1].recv(1000)
        callers[0].sendall(b'{"ask": "who"}\n')
        assert callers[0].recv(1000)
        stack.enter_context(caller_of(channel))
        assert callers[0].recv(1000) == b""
        callers[1].sendall(b'{"ask": "who"}\n')
        assert callers[1].recv(1000)


def test_of_programs_that_see_each_other_start_the_first_stays(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    look, all_have_names, ended = BusLock._refuse_others, threading.Barrier(3), threading.Barrier(3)
    refused, kept = [], []

    def start() -> None:
        try:
            lock = BusLock("socketcan", channel)
        except BusError as error:
            refused.append(str(error))
        else:
            kept.append(lock)
        ended.wait(60.0)

    def when_all_have_names(self: BusLock) -> None:
        all_have_names.wait(60.0)
        look(self)

    monkeypatch.setattr(BusLock, "_refuse_others", when_all_have_names)
    threads = [threading.Thread(target=start) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (lock,) = kept
    assert len(refused) == 2
    assert all("another program controls" in text for text in refused)
    with first_holder(channel) as holder:
        assert holder.number == 0
    assert not lock.remarks
    lock.close()


@pytest.mark.parametrize("then", ["it has the bus", "silence"])
def test_one_that_starts_and_does_not_leave_keeps_another_off(
    channel: str, name: str, monkeypatch: pytest.MonkeyPatch, then: str
) -> None:
    monkeypatch.setattr("jointctl.drivers.bus_lock.ANSWER_S", 0.3)
    who = {"controls": name, "pid": os.getpid()}
    with squatter(f"{name}-1") as listener:

        def answer() -> None:
            end, _ = listener.accept()
            with end:
                for message in ({**who, "starts": True}, who):
                    end.recv(100)
                    send_line(end, message)
                    if then == "silence":
                        break
                while end.recv(100):
                    pass

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(BusError, match="another program controls"):
            BusLock("socketcan", channel)
        thread.join()


@pytest.mark.parametrize(
    ("answer", "is_controller", "within_s"),
    [
        ({"controls": "NAME", "pid": 0, "within_s": 2}, True, 2.0),
        ({"controls": "NAME", "pid": 0, "within_s": "2"}, True, None),
        ({"controls": "NAME", "pid": 0}, True, None),
        ({"controls": "another", "pid": 0, "within_s": 2}, False, None),
        ({"controls": "NAME", "pid": 1, "within_s": 2}, False, None),
        ({"refused": "never"}, False, None),
    ],
)
def test_a_controller_answers_for_this_lock_and_for_itself(
    name: str, answer: dict[str, Any], is_controller: bool, within_s: float | None
) -> None:
    said = {**answer, "pid": answer.get("pid", 0) + os.getpid(), "controls": answer.get("controls", "-")}
    said["controls"] = said["controls"].replace("NAME", name)
    with squatter(name) as listener:
        holder = Holder(name, 0)
        assert not holder.poll()
        with listener.accept()[0] as end:
            send_line(end, said)
            assert holder.poll()
            assert (holder.is_controller, holder.within_s, holder.refused) == (is_controller, within_s, "")
            send_line(end, {"controls": "nothing any more"})
            assert holder.poll()
            assert holder.is_controller is is_controller  # the first answer counts
            assert not holder.left
        assert holder.left
        holder.close()


def test_one_that_dies_before_it_has_read_has_left(channel: str, name: str) -> None:
    with squatter(name) as listener, first_holder(channel) as holder:
        holder.send("who")
        listener.accept()[0].close()
        assert holder.left


def test_nothing_more_comes_from_one_that_dies_before_it_has_read(channel: str, name: str) -> None:
    with squatter(name) as listener, first_holder(channel) as holder:
        holder.send("who")
        listener.accept()[0].close()
        assert holder.poll()
        assert not holder.is_controller


@pytest.mark.parametrize(("own", "other", "may"), [(1000, 1000, True), (1000, 0, True), (1000, 1, False)])
def test_the_same_user_and_root_may_ask(
    own: int, other: int, may: bool, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: own)
    monkeypatch.setattr(bus_lock, "process_behind", lambda _: (1, other))
    with socket.socket(socket.AF_UNIX) as caller:
        assert bus_lock.may_ask(caller) is may


def test_a_program_that_forgets_its_lock_can_end_all_the_same(channel: str) -> None:
    with controller(channel, HOLD.replace("while not stopped:", "while False:")) as forgetful:
        assert forgetful.wait(60.0) == 0


def test_an_answer_that_does_not_come_is_waited_for_as_long_as_said(
    channel: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([10.0, 10.0, 11.0, 12.0])
    waits_s: list[float] = []
    with squatter(name), first_holder(channel) as holder:
        monkeypatch.setattr(bus_lock, "time", SimpleNamespace(monotonic=lambda: next(clock)))
        monkeypatch.setattr(selectors.DefaultSelector, "select", lambda _, wait_s: waits_s.append(wait_s) or [])
        wait_for_answers([holder], 2.0)
    assert waits_s == [2.0, 1.0]


def test_once_all_have_answered_no_one_waits(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 10.0])  # a third look at it would be an error
    with BusLock("socketcan", channel), first_holder(channel) as holder:
        holder.send("who")
        monkeypatch.setattr(bus_lock, "time", SimpleNamespace(monotonic=lambda: next(clock)))
        wait_for_answers([holder])
        assert holder.is_controller


def marked_proc(folder: Path, marks: dict[int | str, list[str]]) -> Path:
    """A /proc with these processes and the links of their descriptors."""
    for pid, links in marks.items():
        (folder / str(pid) / "fd").mkdir(parents=True)
        for number, link in enumerate(links):
            (folder / str(pid) / "fd" / str(number)).symlink_to(link)
    return folder


def test_the_processes_of_a_controller_are_found_by_their_mark(tmp_path: Path) -> None:
    mark = "/memfd:its-name (deleted)"
    others = {11: ["/dev/null", "/memfd:its-name-1 (deleted)"], "self": [mark], os.getpid(): [mark], 12: []}
    proc = marked_proc(tmp_path, {7: ["/dev/null", mark], 8: [mark], **others})
    (tmp_path / "8" / "fd" / "a file").touch()  # no link: it has gone while it was looked at
    (tmp_path / "13").mkdir()
    assert sorted(marked_processes("its-name", proc)) == [7, 8]
    assert [pid for pid in (7, 8, 11, 12, 13, 14) if is_marked(pid, "its-name", proc)] == [7, 8]


def test_those_of_any_lock_are_found(tmp_path: Path) -> None:
    links = {7: [f"/memfd:{lock_name('socketcan', 'can0')} (deleted)"], 8: ["/memfd:jointctl-loop (deleted)"]}
    assert marked_processes(LOCKS, marked_proc(tmp_path, links)) == [7]


@pytest.mark.parametrize(("still", "refused"), [([[42], []], False), ([[42], [42]], True), ([[], []], False)])
def test_a_process_that_was_just_started_gets_a_moment_to_let_the_lock_go(
    channel: str, monkeypatch: pytest.MonkeyPatch, still: list[list[int]], refused: bool
) -> None:
    pauses_s: list[float] = []
    looks = iter(still)
    monkeypatch.setattr(bus_lock, "marked_processes", lambda _: next(looks))
    monkeypatch.setattr(bus_lock, "time", SimpleNamespace(sleep=pauses_s.append, monotonic=time.monotonic))
    monkeypatch.setattr(bus_lock, "program_name", lambda pid: f"program {pid}")
    with pytest.raises(BusError, match=r"does not answer .*\(program 42, pid 42\)") if refused else nullcontext():
        BusLock("socketcan", channel).close()
    assert len(pauses_s) == bool(still[0])


def test_the_mark_follows_the_lock(channel: str) -> None:
    lock = BusLock("socketcan", channel)
    marker_fd = lock.marker_fd
    assert marker_fd is not None
    assert os.readlink(f"/proc/self/fd/{marker_fd}") == f"/memfd:{lock_name('socketcan', channel)} (deleted)"
    lock.close()
    assert lock.marker_fd is None


def test_a_forked_process_leaves_the_lock_to_its_program(channel: str) -> None:
    """It unwinds the program's `with` block where it ends by an exception, as after `os.fork` and `sys.exit`."""
    stops: list[bool] = []
    with BusLock("socketcan", channel, lambda: stops.append(True)) as lock:
        child = os.fork()
        if child == 0:
            lock.close()
            os._exit(0)
        os.waitpid(child, 0)
        with asked(channel, "stop") as holder:
            assert holder.is_controller
    assert stops


def test_a_forked_process_does_not_keep_the_bus_nor_is_it_ended_by_a_stop(channel: str) -> None:
    with BusLock("socketcan", channel), forked() as child:
        assert not is_marked(child, lock_name("socketcan", channel))
    with ExitStack() as stack:
        with BusLock("socketcan", channel):
            stack.enter_context(forked())
        assert BusLock("socketcan", channel).close() is None


def test_what_cannot_be_let_go_and_a_full_table_keep_a_forked_process_from_no_lock(channel: str) -> None:
    """A closed adapter says so by an error of its library; with no descriptor left the null device cannot be opened."""

    class Closed:
        def fileno(self) -> int:
            raise RuntimeError("closed")

    closed = [keep_from_forks(Closed()) for _ in range(20)]  # in any order with the lock's own
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with BusLock("socketcan", channel), ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        reading, writing = os.pipe()  # of `forked`
        for number in (reading, writing):
            os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, (writing + 1, hard))
        assert not is_marked(stack.enter_context(forked()), lock_name("socketcan", channel))
    assert len(closed) == 20


def test_no_descriptor_is_left_behind(channel: str) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        with BusLock("socketcan", channel), pytest.raises(BusError):
            BusLock("socketcan", channel)
    with pytest.raises(OSError, match="refused"):
        Holder(lock_name("socketcan", channel), 0)
    assert len(os.listdir("/proc/self/fd")) == before


def test_who_has_just_gone_has_no_name(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(_: int) -> str:
        raise OSError

    monkeypatch.setattr(bus_lock, "program_name", gone)
    with BusLock("socketcan", channel), pytest.raises(BusError, match=rf"\(pid {os.getpid()}\)"):
        BusLock("socketcan", channel)


def test_another_error_than_a_name_in_use_means_no_lock(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[bytes] = []

    def forbidden(address: bytes) -> None:
        tried.append(address)
        raise OSError(errno.EACCES, "not here")

    monkeypatch.setattr(bus_lock, "listener", forbidden)
    with BusLock("socketcan", channel) as lock:
        assert (lock.marker_fd, lock.remarks, len(tried)) == (None, [], 1)


def test_there_is_no_lock_on_other_systems(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with BusLock("socketcan", channel) as lock:
        assert lock.marker_fd is None
    monkeypatch.setattr(bus_lock, "_holders", lambda *_: ["one"])
    assert lock_holders("socketcan", channel) == []
    monkeypatch.setattr(sys, "platform", "linux")
    assert lock_holders("virtual", channel) == []
    assert lock_holders("socketcan", channel) == ["one"]
