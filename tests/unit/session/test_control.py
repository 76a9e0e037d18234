"""A program's right to a joint, stop signals, and how `jointctl stop` ends the program that controls a bus."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers import bus_lock, stop_note
from jointctl.drivers.bus_lock import BusLock, StopCall, end_programs, lock_name, wait_for_answers
from jointctl.drivers.errors import BusError, DataError, JointctlError, MotionFault
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.session import control
from jointctl.tools.session.control import (
    AGAIN_S,
    FILES_S,
    STOP_COMMAND,
    STOP_SIGNALS,
    StopSignals,
    control_of,
    in_control,
    in_program,
    stop_signals,
    stop_within_s,
)
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.session.result import RunResult
from jointctl.tools.session.session import NOTED_WITHIN_NS, Session, came_before
from jointctl.tools.verbs.start import Interruption
from tests.configurations import written
from tests.python_process import eventually


def test_what_has_ended_a_run_is_told_where_its_log_takes_nothing_more() -> None:
    watch = Mock()
    watch.take_records.side_effect = DataError("runs: cannot be written: No space left on device")
    assert Session._log_end([watch], BusError("the loop was killed")) is None
    watch.take_records.assert_called_once_with(last=True)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(24, "Too many open files"), "open files: Too many open files"),
        (OSError(12, "Cannot allocate memory"), "the operating system: Cannot allocate memory"),
        (PermissionError(13, "Permission denied", "/dev/shm/x"), "/dev/shm/x: Permission denied"),
    ],
)
def test_what_the_system_refuses_a_run_is_not_blamed_on_its_log(
    monkeypatch: pytest.MonkeyPatch, error: OSError, line: str
) -> None:
    monkeypatch.setattr(Session, "_run", Mock(side_effect=error))
    with pytest.raises(JointctlError) as raised:
        Session.__new__(Session).run()
    assert (raised.type, raised.value.message) == (JointctlError, line)


# --- A program's right to a joint: what its stops ask for, and how long it may take to end ---
@pytest.mark.parametrize(
    ("count", "commanded", "request_"),
    [
        (0, False, StopRequest.NONE), (1, False, StopRequest.RAMP), (2, False, StopRequest.QUICK_STOP),
        (3, False, StopRequest.OFF), (4, False, StopRequest.OFF), (0, True, StopRequest.QUICK_STOP),
        (1, True, StopRequest.QUICK_STOP), (2, True, StopRequest.QUICK_STOP), (3, True, StopRequest.OFF),
    ],
)  # fmt: skip
def test_asking_again_asks_for_more(count: int, commanded: bool, request_: StopRequest) -> None:
    signals = StopSignals()
    assert (signals.count, signals.commanded_ns, signals.raising, signals.by_command) == (0, 0, False, "")
    signals.leave_if_asked()
    for _ in range(count):
        signals.on_signal(signal.SIGINT, None)
    signals.commanded_ns = int(commanded)
    assert signals.request is request_
    assert signals.by_command == (f" by {STOP_COMMAND}" if commanded else "")
    if count or commanded:
        with pytest.raises(KeyboardInterrupt):
            signals.leave_if_asked()


def test_each_signal_reaches_a_loop_that_runs_at_once() -> None:
    """With the supervisor's next look it came 50 ms later on a busy computer, by when a drive was enabled."""
    signals, requests = StopSignals(), list[StopRequest]()
    signals.on_command = requests.append
    for _ in range(3):
        signals.on_signal(signal.SIGINT, None)
    signals.raise_again().cancel()
    signals.on_signal(signal.SIGTERM, None)  # no new one
    assert requests == [StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF]


@pytest.mark.parametrize(("agreed", "stood_s", "refused"), [(True, 31, True), (True, 29, False), (False, 31, False)])
def test_after_a_yes_a_standstill_is_a_reason_to_leave(
    monkeypatch: pytest.MonkeyPatch, agreed: bool, stood_s: int, refused: bool
) -> None:
    signals, times_ns = StopSignals(), iter([20 * 10**9, (20 + stood_s) * 10**9])
    monkeypatch.setattr(control, "now_ns", lambda: next(times_ns))
    signals.looked_ns = 0 if agreed else None
    signals.leave_if_asked()
    with pytest.raises(MotionFault, match="stood still, or was too slow, for 31 s") if refused else nullcontext():
        signals.leave_if_asked()


@pytest.mark.parametrize(("stood_s", "refused"), [(31, True), (29, False)])
def test_one_yes_for_several_motions_is_out_of_date_after_a_standstill_between_two(
    monkeypatch: pytest.MonkeyPatch, stood_s: int, refused: bool
) -> None:
    """Minutes of computing between two motions are none: a thread looks on."""
    signals, clock = StopSignals(), SimpleNamespace(s=1000)
    monkeypatch.setattr(control, "now_ns", lambda: clock.s * 10**9)
    signals.agreed()
    for _ in range(300):
        clock.s += 1
        signals.note_standstill()
    signals.leave_if_asked()
    clock.s += stood_s
    signals.note_standstill()  # before the next motion asks
    signals.agreed()  # which is the same yes
    with pytest.raises(MotionFault, match="stood still, or was too slow, for 31 s") if refused else nullcontext():
        signals.leave_if_asked()


@pytest.mark.parametrize(("waited_s", "refused"), [(31, True), (29, False)])
def test_a_yes_is_out_of_date_where_a_disk_has_hung_before_the_motion(
    monkeypatch: pytest.MonkeyPatch, waited_s: int, refused: bool
) -> None:
    """The thread that looks on went on: no standstill of the program, and the joint moved when the folder came back."""
    signals, clock = StopSignals(), SimpleNamespace(s=1000)
    monkeypatch.setattr(control, "now_ns", lambda: clock.s * 10**9)
    signals.agreed()
    for _ in range(waited_s):
        clock.s += 1
        signals.note_standstill()
    signals.leave_if_asked()
    with pytest.raises(MotionFault, match="stood still, or was too slow, for 31 s") if refused else nullcontext():
        signals.begin()


def test_a_command_is_looked_on_between_its_motions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(control, "LOOK_S", 1e-3)
    config = load_config(written(tmp_path / "joint.toml", bus__channel="nobodys"))
    with in_control(config, Output(quiet=True)) as held:
        assert held.signals.looked_ns is None
        held.signals.agreed()
        before_ns = held.signals.looked_ns
        eventually(lambda: held.signals.looked_ns != before_ns, 60.0)


def test_the_first_signal_is_the_one_that_is_named() -> None:
    signals = StopSignals()
    signals.on_signal(signal.SIGHUP, None)
    signals.on_signal(signal.SIGINT, None)
    assert (signals.name, signals.count) == ("SIGHUP", 2)


def test_where_something_must_come_to_its_end_a_signal_raises_nothing() -> None:
    with stop_signals(raising=True) as signals:
        with signals.held():
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signals.count == 2
    with stop_signals() as signals, signals.held():
        signal.raise_signal(signal.SIGINT)
    assert not signals.raising


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_the_programs_own_handlers_are_back_afterwards(number: signal.Signals) -> None:
    handler = signal.getsignal(number)
    with stop_signals() as signals:
        signal.raise_signal(number)
        assert signals.name == number.name
    assert signal.getsignal(number) == handler


def test_a_stop_command_reaches_the_loop_and_wakes_the_main_thread() -> None:
    reached: list[StopRequest] = []
    with stop_signals() as signals:
        signals.on_command = reached.append
        signals.on_stop_command()
        # by its own thread, and by the signal that wakes the main one
        assert (reached, signals.count) == ([StopRequest.QUICK_STOP] * 2, 1)
    assert signals.commanded_ns > 1
    assert signals.name == STOP_COMMAND


def test_it_may_take_as_long_as_everything_that_follows_a_stop(virtual_config: Any) -> None:
    sequence = virtual_config.sequence
    assert stop_within_s(virtual_config) == 2.0 * (sequence.stop_timeout_s + sequence.off_timeout_s) + FILES_S


@pytest.mark.parametrize("configured", [True, False])
def test_in_control_the_lock_is_held_and_its_remarks_are_told(
    virtual_config: Any, monkeypatch: pytest.MonkeyPatch, capsys: Any, configured: bool
) -> None:
    times_s: list[float] = []

    class Lock(BusLock):
        def __init__(self, interface: str, channel: str, on_stop: Any, within_s: float) -> None:
            super().__init__("socketcan", f"controlled-{os.getpid()}", on_stop, within_s)
            times_s.append(within_s)
            self.remarks.append("a remark")

    monkeypatch.setattr(control, "BusLock", Lock)
    held = in_control(virtual_config, Output()) if configured else control_of("virtual", "x", Output(), 3.0)
    with held as ours:
        assert len(ours.marker_fds) == 1
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert times_s == [stop_within_s(virtual_config) if configured else 3.0]
    assert "a remark" in capsys.readouterr().err


def test_a_stop_that_an_error_hides_is_not_lost(virtual_config: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm that tries again until its second bus is free: the stop of its first one has told it nothing yet."""
    at = [f"hidden-{os.getpid()}-{k}" for k in range(2)]
    buses = [virtual_config.bus.model_copy(update={"channel": channel}) for channel in at]
    joints = [virtual_config.model_copy(update={"bus": bus}) for bus in buses]
    names = [lock_name("jointctl", x) for x in at]
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))  # the stop is another's
    monkeypatch.setattr(stop_note, "_settled_ns", {})
    stop_note.write_note(names[0])

    def tried() -> bool:
        with in_control(joints[0], Output(), joints[1:]) as ours:
            return not ours.signals.commanded_ns

    with taken(at[1]), pytest.raises(BusError, match="another program controls"):
        tried()
    with pytest.raises(KeyboardInterrupt, match="by jointctl stop; nothing moved"):
        tried()
    assert tried()  # it was told
    for name in names:
        stop_note.write_note(name)
    with pytest.raises(KeyboardInterrupt):
        tried()
    assert tried()


@pytest.mark.parametrize("noted", [True, False])
def test_a_stop_that_ends_a_program_before_it_can_answer_is_named(
    virtual_config: Any, monkeypatch: pytest.MonkeyPatch, noted: bool
) -> None:
    """By signal, since a busy computer had not let it get so far.  The twin is a signal of another program."""
    bus = virtual_config.bus.model_copy(update={"channel": f"ended-{noted}-{os.getpid()}"})
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))  # the stop is another's
    monkeypatch.setattr(stop_note, "_settled_ns", {})

    def take(interface: str, channel: str, *_: object) -> None:
        if noted:
            stop_note.write_note(lock_name(interface, channel))
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("jointctl.tools.session.control.BusLock", take)
    by = " by jointctl stop" if noted else ""
    with (
        pytest.raises(KeyboardInterrupt, match=f"^{by}; nothing moved$"),
        in_control(virtual_config.model_copy(update={"bus": bus}), Output()),
    ):
        pass


@contextmanager
def taken(channel: str) -> Iterator[None]:
    """By another program."""
    hold = (
        "import sys; from jointctl.drivers.bus_lock import BusLock\n"
        "with BusLock('jointctl', sys.argv[1]): print('mine', flush=True); input()\n"
    )
    command = [sys.executable, "-c", hold, channel]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "mine\n"
        yield
        process.stdin.write("\n")
        process.stdin.flush()


@pytest.mark.parametrize(("commanded_ns", "text"), [(1, " by jointctl stop"), (0, "")])
def test_an_interruption_leaves_with_the_name_of_what_has_caused_it(commanded_ns: int, text: str) -> None:
    with (  # noqa: PT012
        pytest.raises(KeyboardInterrupt) as raised,
        control_of("jointctl", f"test-{os.getpid()}", Output()) as held,
    ):
        held.signals.commanded_ns = commanded_ns
        raise KeyboardInterrupt
    assert str(raised.value) == text


def test_an_arm_has_the_locks_of_all_its_buses_and_a_stop_by_any_is_one_stop(virtual_config: Any) -> None:
    def on(channel: str) -> Any:
        bus = virtual_config.bus.model_copy(update={"interface": "socketcan", "channel": f"{channel}-{os.getpid()}"})
        return virtual_config.model_copy(update={"bus": bus})

    joints = [on("a"), on("b"), on("a")]
    with in_program(joints[0], Output(), joints[1:]) as ours:
        assert len(ours.marker_fds) == 2
        for config in joints[:2]:
            with pytest.raises(BusError, match="another program controls"):
                BusLock(config.bus.interface, config.bus.channel)
        first_ns = 0
        for config in joints[1::-1]:
            with StopCall(config.bus.interface, config.bus.channel) as call:
                wait_for_answers(call._holders)
            assert ours.signals.request is StopRequest.QUICK_STOP
            first_ns = first_ns or ours.signals.commanded_ns
        assert ours.signals.commanded_ns == first_ns


def test_a_stop_reaches_a_program_whose_virtual_bus_comes_after_its_lock(virtual_config: Any, tmp_path: Path) -> None:
    place = "jointctl", str(tmp_path / "bus.sock")
    config = virtual_config.model_copy(update={"bus": virtual_config.bus.model_copy(update={"channel": place[1]})})
    with in_program(config, Output()) as ours:
        ours.bus_is_there()  # it has the lock of that name already
        Path(place[1]).touch()
        ours.bus_is_there()
        with pytest.raises(BusError, match="another program controls"):
            BusLock(*place)
        with StopCall(*place) as call:
            wait_for_answers(call._holders)
        assert ours.signals.request is StopRequest.QUICK_STOP
    BusLock(*place).close()


# --- Stop signals that come where an exception does not get through ---
@ctypes.CFUNCTYPE(None)
def stopped_in_a_callback() -> None:
    """As the compiler's, while it runs."""
    signal.raise_signal(signal.SIGINT)


class StoppedAtItsEnd:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


@pytest.fixture
def terminated() -> Iterator[list[int]]:
    """SIGTERM that comes when nobody collects stop signals; it would end the program."""
    came: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    yield came
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("stopped", [stopped_in_a_callback, lambda: StoppedAtItsEnd() and None])
def test_a_stop_that_a_library_swallows_is_raised_again(stopped: Any, capsys: Any) -> None:
    with stop_signals(raising=True) as signals:
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012  (it is raised by the second line)
            stopped()
            time.sleep(5.0)
        assert (signals.count, signals.name) == (1, "SIGINT")
    assert "Traceback" not in capsys.readouterr().err


def test_it_is_raised_neither_while_signals_are_held_nor_afterwards(terminated: list[int]) -> None:
    hook = sys.unraisablehook
    with stop_signals(raising=True) as signals:
        stopped_in_a_callback()
        with signals.held():
            time.sleep(2.0 * AGAIN_S)
        stopped_in_a_callback()
    time.sleep(2.0 * AGAIN_S)
    assert signals.count == 2
    assert terminated == []
    assert sys.unraisablehook is hook


def test_what_else_goes_wrong_there_is_shown_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)

    @ctypes.CFUNCTYPE(None)
    def wrong() -> None:
        raise ValueError

    with stop_signals(raising=True) as signals:
        wrong()
    assert [lost.exc_type for lost in shown] == [ValueError]
    assert signals.count == 0
    shown.clear()


# --- How `jointctl stop` ends the program that controls a bus, step by step in simulated time ---
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
    """`holders`: who has the lock at each further look.  `marked`: process -> when it loses its mark."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *holders: list[Program], marked: dict[int, float] | None = None,
        deaf_to: tuple[signal.Signals, ...] = (),
    ) -> None:  # fmt: skip
        self.now_s = 0.0
        self.holders = [*holders]
        self.marks = {lock_name("socketcan", "x"): marked or {}}
        self.deaf_to = deaf_to
        self.signals: list[tuple[list[int], str, float]] = []
        self.notes: list[str] = []
        self.ended_s: list[float] = []  # when the drive is switched off once more
        self.awaited: list[list[Program]] = []
        for program in (program for look in holders for program in look):
            program.computer = self
        monkeypatch.setattr(bus_lock, "time", SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.sleep))
        monkeypatch.setattr(bus_lock, "lock_holders", lambda *_: self.holders.pop(0) if self.holders else [])
        monkeypatch.setattr(bus_lock, "wait_for_answers", lambda asked: self.awaited.append(list(asked)))
        monkeypatch.setattr(bus_lock, "is_marked", self.is_marked)
        monkeypatch.setattr(
            bus_lock, "marked_processes", lambda name: [pid for pid in self.marks[name] if self.is_marked(pid, name)]
        )
        monkeypatch.setattr(bus_lock, "_signalled", self.signalled)

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
        """Whether a controller has ended."""
        with StopCall("socketcan", "x") as call:
            found = end_programs([call], self.notes.append, lambda: self.ended_s.append(self.now_s))
            self.unended = call.unended
        assert found is bool(self.ended_s)
        return found


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
        (FOR_EVER, FOR_EVER, 1000.0, bus_lock.LONGEST_S, True),
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


@pytest.mark.parametrize("said", [{}, {"is_controller": False, "within_s": 8.0}])
def test_no_time_is_given_to_one_that_does_not_acknowledge(
    monkeypatch: pytest.MonkeyPatch, said: dict[str, Any]
) -> None:
    computer = Computer(monkeypatch, [Program(**said)])
    assert computer.stopped() is said.get("is_controller", True)
    assert (computer.now_s, computer.notes) == (0.0, [])


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
    assert computer.awaited[:2] == [first, [later]]


def test_one_that_has_the_lock_only_when_all_is_over_is_ended_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive is switched off once more: it may have enabled it."""
    later = Program(leaves_s=1.5, within_s=8.0)
    computer = Computer(monkeypatch, [], [later])
    assert computer.stopped()
    assert later.log == ["stop", "closed"]
    assert computer.awaited == [[], [later], []]
    assert computer.ended_s == [pytest.approx(1.5, abs=0.03)]


def test_a_controller_that_was_asked_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    computer = Computer(monkeypatch, [Program(within_s=8.0, leaves_s=0.1)], marked={7: 0.1})
    computer.stopped()
    assert computer.notes == ["stopping the program that controls the bus (pid 7)"]


@pytest.mark.parametrize("deaf_to", [(), (signal.SIGTERM,), (signal.SIGTERM, signal.SIGKILL)])
def test_what_is_left_is_ended_by_force(monkeypatch: pytest.MonkeyPatch, deaf_to: tuple[signal.Signals, ...]) -> None:
    computer = Computer(monkeypatch, [], [], marked={7: FOR_EVER, 9: FOR_EVER}, deaf_to=deaf_to)
    computer.stopped()
    left = [7, 9] if deaf_to else []
    assert computer.signals[:2] == [([7, 9], "SIGTERM", bus_lock.TERM_S), (left, "SIGKILL", bus_lock.KILL_S)]
    assert computer.notes[0] == f"it does not end by itself: ending process 7, 9; {bus_lock.ARMED}"
    assert computer.unended == ("process 7, 9 cannot be ended" if signal.SIGKILL in deaf_to else "")


@pytest.mark.parametrize("marked", [True, False])
def test_only_what_acts_for_the_controller_gets_the_signal(monkeypatch: pytest.MonkeyPatch, marked: bool) -> None:
    monkeypatch.setattr(bus_lock, "is_marked", lambda pid, name: marked and name == "its name")
    monkeypatch.setattr(bus_lock, "time", SimpleNamespace(monotonic=lambda: 0.0))
    open_before = len(os.listdir("/proc/self/fd"))
    with subprocess.Popen(["sleep", "60"]) as process, subprocess.Popen(["true"]) as gone:
        gone.wait()
        assert bus_lock._signalled([gone.pid, process.pid], "its name", signal.SIGTERM, 0.5) == []
        if not marked:
            process.kill()
        assert process.wait() == (-signal.SIGTERM if marked else -signal.SIGKILL)
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_those_that_live_on_after_a_signal_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_lock, "is_marked", lambda *_: True)
    with subprocess.Popen(["sleep", "60"]) as process:
        assert bus_lock._signalled([process.pid], "its name", signal.SIGCONT, 0.01) == [process.pid]
        process.kill()


@pytest.mark.parametrize(
    ("early_ns", "came_first"), [(0, False), (NOTED_WITHIN_NS - 1, False), (NOTED_WITHIN_NS, True)]
)
def test_a_fault_just_before_the_stop_was_noted_is_the_stops_own_work(early_ns: int, came_first: bool) -> None:
    """`stop` sends its request, then stops the drive: a busy program sees the drive first."""
    records = np.zeros(3, dtype_of(LogRecord)).view(np.recarray)
    records.time_ns = 10_000_000_000 + np.arange(3) * 1_000_000
    records.fault[1:] = Fault.DRIVE_NOT_ENABLED
    assert came_before(Fault.DRIVE_NOT_ENABLED, records, 10_001_000_000 + early_ns) is came_first
    assert not came_before(Fault.NONE, records, 20_000_000_000)


@pytest.mark.parametrize(("early_ns", "came_first"), [(-1, False), (0, True), (NOTED_WITHIN_NS - 1, True)])
def test_a_fault_of_the_joint_before_the_stop_is_not_laid_to_it(early_ns: int, came_first: bool) -> None:
    records = np.zeros(3, dtype_of(LogRecord)).view(np.recarray)
    records.time_ns = 10_000_000_000 + np.arange(3) * 1_000_000
    records.fault[1:] = Fault.POSITION_LIMIT
    assert came_before(Fault.POSITION_LIMIT, records, 10_001_000_000 + early_ns) is came_first


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_that_python_has_dropped_is_not_lost(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal that arrives in a destructor raises into nothing, and the program would go on to move the joint."""

    class Dropping:
        def __del__(self) -> None:
            signal.raise_signal(number)

    dropped: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)
    before = signal.signal(number, Interruption())
    try:
        with stop_signals():
            pass  # its twin: none has come
        Dropping()
        assert len(dropped) == 1
        with pytest.raises(KeyboardInterrupt), stop_signals():
            raise AssertionError("the run began")
    finally:
        signal.signal(number, before)


class Kept(list[Any]):
    """Records of a run."""

    def records(self) -> Any:
        return self[0]


def result_of(fault: Fault, commanded_ns: int, state_after: str, own_state: str) -> RunResult:
    """Of a run that ended with that fault."""
    records = np.zeros(100, dtype_of(LogRecord)).view(np.recarray)
    records.fault, records.phase = fault, AxisPhase.DISABLING
    records.time_ns = 10**10 + np.arange(len(records)) * 1_000_000
    state = SimpleNamespace(fault_drive_error=0, fault_encoder_error=0, fault_slot_ns=0, fault_value=0.0)
    block = SimpleNamespace(state=[state], histograms=np.zeros((4, 9), int), port=[SimpleNamespace(last_errno=0)])
    loop = SimpleNamespace(block=block, verdict=lambda: (fault, 0.0), stop_requested=True, lost_records=0)
    words = FaultText("it is off", "its enable input", "check it")
    watch: Any = SimpleNamespace(
        loop=loop,
        config=load_config(shipped_config("virtual")),
        kept=Kept([records]),
        stopped_by="jointctl stop",
        log=SimpleNamespace(is_in_place=lambda: True),
        temperature=SimpleNamespace(values_degC=[]),
        mode_explained=lambda fault, text: text,
        joint=SimpleNamespace(log_path=Path("x.mcap"), name=""),
        around=SimpleNamespace(
            signals=SimpleNamespace(commanded_ns=commanded_ns),
            bus_watch=SimpleNamespace(explained=lambda fault, text, errno: text),
        ),
    )
    session = Session.__new__(Session)
    session._kind = SimpleNamespace(fault_text=lambda *_: words, load_row=lambda share: ("bus load", ""))
    return session._result(watch, Mock(), state_after, 0.1, own_state)


@pytest.mark.parametrize(("commanded_ns", "fault"), [(0, "DRIVE_NOT_ENABLED"), (10**10, "NONE")])
def test_what_a_stop_did_to_the_drive_is_no_fault_in_the_table_either(commanded_ns: int, fault: str) -> None:
    """It stood there in red, beside the words that the run was stopped."""
    result = result_of(Fault.DRIVE_NOT_ENABLED, commanded_ns, "switch on disabled", "switch on disabled")
    assert (result.summary.fault, result.fault.name) == (fault, fault)


@pytest.mark.parametrize("own_state", ["switch on disabled", "unknown: no answer"])
def test_a_drive_of_an_arm_that_reads_off_is_no_emergency(own_state: str) -> None:
    """One that is lost costs the others their heartbeat: their watchdogs stop them, which the loop does not see."""
    text = result_of(Fault.OFF_TIMEOUT, 0, "wrist: unknown: no answer", own_state).fault_text
    assert text is not None
    is_off = own_state == "switch on disabled"
    assert ("it reads switch on disabled now" in text.happened) is is_off
    assert (text.next_step == "check it") is not is_off
