"""Taking the power from a drive: without an EDS, one that is slow, one that does not obey, never another's."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest

from jointctl.drivers import bus_lock
from jointctl.drivers.canopen import switch_off as switch_off_module
from jointctl.drivers.canopen.cia import NmtCommand, State
from jointctl.drivers.canopen.switch_off import (
    OFF_S,
    POLL_S,
    QUICK_STOP_S,
    SDO_TIMEOUT_S,
    SwitchOff,
    brake,
    brake_if_enabled,
)
from jointctl.drivers.drive import (
    UNTOUCHED,
    CommissioningReport,
    Declined,
    DriveIdentity,
    is_safe,
    refuse_unless_at_rest,
)
from jointctl.drivers.errors import BusError, DataError, DeviceError, NoDeviceError
from jointctl.hil.canopen.records import PowerState
from jointctl.tools.output import Output
from jointctl.tools.session import session as session_module
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.result import require_off, words
from jointctl.tools.verbs import canopen_bench
from jointctl.tools.verbs import run as run_module
from jointctl.tools.verbs import stop as stop_module
from tests.configurations import edited_file
from tests.unit.drivers.canopen.wire import STATUSWORDS

ENABLED, SWITCHED_ON = 0x27, 0x23
NMT_STOP = (0x000, b"\x02\x01")


def bus_of(joint: Any) -> can.BusABC:
    return can.Bus(interface="virtual", channel=joint.channel)


def power_up(joint: Any) -> None:
    for control in (0x06, 0x07, 0x0F, 0x0F):
        joint.send(0x601, bytes((0x2B, 0x40, 0x60, 0x00, control, 0, 0, 0)))
    assert powered(joint)


def powered(joint: Any) -> bool:
    return int(joint.device.device[0].state) == PowerState.OPERATION_ENABLED


def test_no_eds_is_needed(joint: Any) -> None:
    power_up(joint)
    assert joint.stop_drive() == "switch on disabled"
    assert not powered(joint)
    controls = joint.downloads(0x6040)
    assert (controls[4], controls[-1]) == (2, 0)  # after the four of power_up: quick stop, then disable voltage
    assert NMT_STOP not in joint.requests


def test_a_drive_that_stays_enabled_is_told_so_and_gets_nmt_stop(joint: Any) -> None:
    joint.answers[0x6041, 0] = ENABLED
    state = joint.stop_drive()
    assert state.startswith("operation enabled,")
    assert "NMT stop was sent" in state
    assert not is_safe(state)
    assert NMT_STOP in joint.requests


def test_a_drive_that_takes_its_time_is_waited_for(joint: Any) -> None:
    joint.sequences[0x6041, 0] = [SWITCHED_ON] * 20
    assert joint.stop_drive() == "switch on disabled"
    assert NMT_STOP not in joint.requests


def test_nobody_answers(empty_bus: Any) -> None:
    state = empty_bus.stop_drive()
    assert state.startswith("unknown: ")
    assert NMT_STOP in empty_bus.requests


@pytest.mark.parametrize(("configured_s", "used_s"), [(None, SDO_TIMEOUT_S), (0.15, 0.15)])
def test_a_stop_brakes_first_waits_for_answers_as_configured_and_closes_its_bus(
    joint: Any, monkeypatch: pytest.MonkeyPatch, configured_s: float | None, used_s: float
) -> None:
    calls: list[tuple[float, bool]] = []

    def make_safe(switch_off: Any, *, brake_first: bool) -> str:
        calls.append((switch_off._objects._node.sdo.RESPONSE_TIMEOUT, brake_first))
        return "switch on disabled"

    monkeypatch.setattr(SwitchOff, "make_safe", make_safe)
    bus: Any = bus_of(joint)
    switch_off_module.stop_node(bus, 1, sdo_timeout_s=configured_s)
    assert (calls, bus._is_shutdown) == ([(used_s, True)], True)


# --- step by step, on a drive in memory ---
ON, BRAKING, SWITCHED, OFF = (
    State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.SWITCHED_ON, State.SWITCH_ON_DISABLED,
)  # fmt: skip
QUICK_STOP, NO_VOLTAGE = (0x6040, 0, 0x02), (0x6040, 0, 0x00)
TO_PRE_OPERATIONAL = [(0x000, b"\x80\x07"), (0x000, b"\x80\x01")]  # the encoder at node 7, the drive at node 1
STOPPED = (0x000, b"\x02\x01")
NO_TARGETS = [(0x6071, 0, 0), (0x60FF, 0, 0)]
SILENCE, DEAD_BUS = NoDeviceError("no answer"), can.CanOperationError("dead")


class DriveInMemory:
    """Bus and objects of a drive that shows one state after the other, the last one for ever; an error is raised.

    `log`: what it was told, and how long it was left alone.
    """

    def __init__(self, *states: State | Exception, deaf_to: bytes = b"", refused: int = 0) -> None:
        self.states = list(states)
        self.deaf_to, self.refused = deaf_to, refused
        self.log: list[Any] = []

    def read(self, index: int, sub: int = 0, *, what: str) -> int:
        if index == 0x6064:
            return 0
        state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
        if isinstance(state, Exception):
            raise state
        return STATUSWORDS[state]

    def write(self, index: int, sub: int, value: int, *, what: str) -> None:
        self.log.append((index, sub, value))
        if index == self.refused:
            raise DeviceError("refused")

    write_if_present = write

    def send_message(self, can_id: int, data: bytes) -> None:
        if data == self.deaf_to:
            raise DEAD_BUS
        self.log.append((can_id, data))

    def wait(self, seconds: float) -> None:
        self.log.append(seconds)

    def made_safe(self, braking_s: float = QUICK_STOP_S, off_s: float = OFF_S, **how: bool) -> str:
        bus: Any = self
        return SwitchOff(bus, 1, bus, 7, self.wait, braking_s, off_s).make_safe(**how)


@pytest.mark.parametrize(
    ("states", "log"),
    [
        ([ON, BRAKING, OFF], [QUICK_STOP, POLL_S, POLL_S]),
        ([ON, ON, OFF], [QUICK_STOP, POLL_S, POLL_S]),  # told once
        ([BRAKING, ON, OFF], [POLL_S, POLL_S]),
        ([ON], [QUICK_STOP, *[POLL_S] * 50]),  # one second
        ([OFF], []),
        ([SWITCHED], []),
    ],
)
def test_the_quick_stop_is_asked_for_once_and_waited_for(states: list[State], log: list[Any]) -> None:
    drive: Any = DriveInMemory(*states)
    brake(drive, drive.wait)
    assert drive.log == log


@pytest.mark.parametrize(
    ("state", "longest_s", "polls"),
    [
        (BRAKING, 3.0, 150), (BRAKING, 0.5, 50), (ON, 3.0, 50), (SWITCHED, 3.0, 0),
        (State.FAULT_REACTION_ACTIVE, 3.0, 150), (State.FAULT, 3.0, 0),
    ],
)  # fmt: skip
def test_a_drive_that_brakes_may_take_longer_than_one_that_does_not_obey(
    state: State, longest_s: float, polls: int
) -> None:
    """The loop ends before the drive's own quick stop where the node has left operational: it is not cut short."""
    drive: Any = DriveInMemory(state)
    brake(drive, drive.wait, longest_s)
    assert [entry for entry in drive.log if entry != QUICK_STOP] == [POLL_S] * polls


@pytest.mark.parametrize(
    ("states", "deaf_to", "state", "log"),
    [
        ([OFF], b"", "switch on disabled", [NO_VOLTAGE, *NO_TARGETS]),
        ([State.FAULT], b"", "fault", [NO_VOLTAGE, *NO_TARGETS]),
        ([SWITCHED, SWITCHED, OFF], b"", "switch on disabled", [NO_VOLTAGE, POLL_S, NO_VOLTAGE, *NO_TARGETS]),
        ([SWITCHED], b"", "switched on", [*[NO_VOLTAGE, POLL_S] * 50, *NO_TARGETS]),
        (
            [BRAKING], b"", "quick stop active, it did not obey; NMT stop was sent",
            [*[POLL_S] * 50, *[NO_VOLTAGE, POLL_S] * 50, *NO_TARGETS, STOPPED],
        ),
        # silence is tried once more
        ([SILENCE, OFF], b"", "switch on disabled", [*TO_PRE_OPERATIONAL, NO_VOLTAGE, *NO_TARGETS]),
        ([SILENCE], b"", "unknown: no answer; NMT stop was sent", [*TO_PRE_OPERATIONAL, STOPPED]),
        ([SILENCE], STOPPED[1], "unknown: no answer; the bus does not take frames any more", TO_PRE_OPERATIONAL),
        ([SILENCE, DEAD_BUS], b"", "unknown: the bus does not take frames any more (dead)", TO_PRE_OPERATIONAL),
    ],
)  # fmt: skip
def test_out_of_operational_before_the_controlword_is_ours(
    states: list[Any], deaf_to: bytes, state: str, log: list[Any]
) -> None:
    drive = DriveInMemory(*states, deaf_to=deaf_to)
    assert drive.made_safe() == state
    assert drive.log == [*TO_PRE_OPERATIONAL, *log]


@pytest.mark.parametrize(
    ("states", "log"),
    [
        ([ON, BRAKING, BRAKING, OFF], [QUICK_STOP, POLL_S, POLL_S, POLL_S]),  # once more: its controller is to see it
        ([ON, *[BRAKING] * 50, OFF], [QUICK_STOP, *[POLL_S] * 50]),
        ([ON, BRAKING, SWITCHED, OFF], [QUICK_STOP, POLL_S]),  # its controller does not leave it alone
        ([BRAKING, BRAKING, OFF], [POLL_S, POLL_S]),  # its controller has asked for it, and sees how it ends
        ([BRAKING, ON, OFF], []),  # enabled again: not obeyed
        ([OFF], []),  # the loop of its controller may be about to enable it
        ([SWITCHED, OFF], []),
        ([SILENCE, OFF], []),
        ([DEAD_BUS, OFF], []),
    ],
)
def test_anothers_drive_brakes_before_it_leaves_operational(states: list[Any], log: list[Any]) -> None:
    drive = DriveInMemory(*states)
    assert drive.made_safe(brake_first=True) == "switch on disabled"
    assert drive.log == [*log, *TO_PRE_OPERATIONAL, NO_VOLTAGE, *NO_TARGETS]


@pytest.mark.parametrize("braking_s", [1.0, 3.0])
def test_anothers_drive_that_brakes_for_long_keeps_its_power_until_it_stands(braking_s: float) -> None:
    """`jointctl stop` took it after two seconds, whatever `sequence.stop_timeout_s` was: a load fell while it braked.

    The twin gives it no more time.
    """
    drive = DriveInMemory(ON, *[BRAKING] * 149, OFF)  # 3 s
    assert drive.made_safe(braking_s, brake_first=True) == "switch on disabled"
    at_rest = 150 if braking_s == 3.0 else 100
    assert drive.log[: drive.log.index(NO_VOLTAGE)].count(POLL_S) == at_rest


@pytest.mark.parametrize(
    ("off_s", "state"), [(3.0, "switch on disabled"), (0.5, "quick stop active, it did not obey; NMT stop was sent")]
)
def test_a_drive_may_take_as_long_to_be_off_as_its_configuration_says(off_s: float, state: str) -> None:
    """As one that waits for its brake; the twin is called disobedient after a second, as ever."""
    drive = DriveInMemory(*[BRAKING] * 190, OFF)  # 1 s for its quick stop, then 2.8 s
    assert drive.made_safe(off_s=off_s) == state


@pytest.mark.parametrize("refused", [0x6071, 0x60FF])
def test_a_drive_without_a_target_is_switched_off_all_the_same(refused: int) -> None:
    drive = DriveInMemory(OFF, refused=refused)
    assert drive.made_safe() == "switch on disabled"
    assert drive.log == [*TO_PRE_OPERATIONAL, NO_VOLTAGE, *NO_TARGETS]


def test_on_a_dead_bus_the_state_is_unknown() -> None:
    drive = DriveInMemory(OFF, deaf_to=TO_PRE_OPERATIONAL[0][1])
    assert drive.made_safe() == "unknown: the bus does not take frames any more (dead)"


# --- the verb ---
@pytest.fixture
def stopped_file(tmp_path: Path) -> Path:
    """A configuration with a channel that no other test runs a program on: a stop ends all of them."""
    return edited_file(tmp_path, ('channel = "virtual0"', f'channel = "stopped{os.getpid()}"'))


@pytest.mark.parametrize("spoilt", [True, False])
def test_stop_is_sent_whatever_the_file_says_elsewhere(
    joint: Any, stopped_file: Path, monkeypatch: pytest.MonkeyPatch, spoilt: bool, capsys: Any
) -> None:
    if spoilt:
        stopped_file.write_text(stopped_file.read_text().replace("[control]", "[control]\nkp = -3", 1))
    monkeypatch.setattr(canopen_bench, "open_python_can", lambda *_, **__: bus_of(joint))
    power_up(joint)
    assert stop_module.stop(stopped_file, Output()) == 0
    assert not powered(joint)
    told = capsys.readouterr()
    assert "the drive is switch on disabled" in told.out
    assert ("warning: the stop was sent, but the configuration does not hold" in told.err) is spoilt


def test_a_stop_that_is_not_confirmed_is_an_error(
    joint: Any, stopped_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(canopen_bench, "open_python_can", lambda *_, **__: bus_of(joint))
    joint.answers[0x6041, 0] = ENABLED
    with pytest.raises(DeviceError, match="use the emergency stop"):
        stop_module.stop(stopped_file, Output())
    assert "operation enabled" in capsys.readouterr().out


@pytest.mark.parametrize("again", [True, False])
def test_whatever_goes_wrong_with_the_drive_its_program_is_ended(
    stopped_file: Path, monkeypatch: pytest.MonkeyPatch, again: bool
) -> None:
    """No thread could be started, say, as long as that program had them all."""
    tries, calls = [RuntimeError("can't start new thread")], []

    def switch_off(*_: Any) -> str:
        if tries:
            raise tries[0]
        return "switch on disabled"

    def end_programs(of: Any, note: Any, ended: Callable[[], None]) -> None:
        calls.extend(of)
        if again:
            tries.clear()
        ended()

    monkeypatch.setattr(canopen_bench.CanTarget, "switch_off", switch_off)
    monkeypatch.setattr(bus_lock, "end_programs", end_programs)
    with nullcontext() if again else pytest.raises(RuntimeError, match="new thread"):
        assert stop_module.stop(stopped_file, Output(quiet=True)) == 0
    assert len(calls) == 1


@pytest.mark.parametrize("found", [True, False])
def test_who_controls_another_bus_is_named_where_no_one_was_stopped(
    stopped_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], found: bool
) -> None:
    """The joint that moves may be that of another file: its user would read that the drive is off."""
    monkeypatch.setattr(canopen_bench.CanTarget, "switch_off", lambda *_: "switch on disabled")
    monkeypatch.setattr(bus_lock, "end_programs", lambda *_: found)
    monkeypatch.setattr(bus_lock, "marked_processes", lambda name: [8, 9, 7] if name == "jointctl-bus-" else [9])
    assert stop_module.stop(stopped_file, Output(quiet=True)) == 0
    assert ("; those that control another bus go on, with the processes 7, 8:" in capsys.readouterr().err) is not found


@pytest.mark.parametrize(("state", "error"), [("operation enabled", DeviceError), ("switch on disabled", DataError)])
def test_a_full_disk_behind_its_output_does_not_hide_it(
    stopped_file: Path, monkeypatch: pytest.MonkeyPatch, state: str, error: type[Exception]
) -> None:
    monkeypatch.setattr(canopen_bench.CanTarget, "switch_off", lambda *_: state)
    with Path("/dev/full").open("w") as full, pytest.raises(error):
        stop_module.stop(stopped_file, Output(stdout=full))


# --- the watchdog ---
def test_stop_leaves_the_watchdog_as_it_is(joint: Any) -> None:
    with joint.commissioned() as drive:
        armed, deadline = joint.value(0x1016, 1), joint.value(0x1400, 5)
        assert (armed & 0xFFFF, deadline) > (0, 0)
        assert joint.stop_drive() == "switch on disabled"
        assert (joint.value(0x1016, 1), joint.value(0x1400, 5)) == (armed, deadline)
        drive.make_safe(asked=True)
        assert joint.value(0x1016, 1) == 0  # the one that armed it takes it away


def test_only_its_own_watchdog_is_taken_away(joint: Any) -> None:
    with joint.commissioned() as drive:
        other = 42 << 16 | 500
        drive._objects.write(0x1016, 1, other, what="another program's consumer heartbeat time")
        assert drive.make_safe() == "switch on disabled"
        assert joint.value(0x1016, 1) == other


# --- another controller, after ours has commissioned ---
@contextmanager
def another_controller(joint: Any) -> Iterator[None]:
    ended = threading.Event()

    def send() -> None:
        with bus_of(joint) as bus:
            while not ended.wait(0.002):
                bus.send(can.Message(arbitration_id=0x80, data=b"", is_extended_id=False))

    thread = threading.Thread(target=send)
    thread.start()
    while (0x080, b"") not in joint.requests:
        time.sleep(0.001)
    joint.settle()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture
def waiting(joint: Any) -> Iterator[Any]:
    """Commissioned; the user is being asked."""
    with joint.commissioned() as drive:
        joint.requests.clear()
        yield drive


def commands(joint: Any) -> list[tuple[int, bytes]]:
    """NMT commands and SDO downloads to the drive."""
    return [(cob, data) for cob, data in joint.requests if cob == 0 or (cob == 0x601 and data[0] != 0x40)]


def test_a_yes_that_comes_after_another_controller_is_refused(joint: Any, waiting: Any) -> None:
    with another_controller(joint):
        with pytest.raises(BusError, match="another controller is active"):
            waiting.start_cyclic()
        assert waiting.make_safe() == UNTOUCHED  # its motion is not ours to end
        assert commands(joint) == []
        assert joint.stop_drive() == "switch on disabled"  # the user's own word is another matter


def test_its_twin_starts_and_is_made_safe_beside_its_own_loop(joint: Any, waiting: Any) -> None:
    waiting.start_cyclic()
    with another_controller(joint):  # now it may be our own loop that still sends
        assert waiting.make_safe() == "switch on disabled"
    assert (0x000, b"\x01\x01") in joint.requests


def test_a_no_leaves_the_drive_to_the_other_controller(joint: Any, waiting: Any) -> None:
    with another_controller(joint):
        waiting._pause(0.1)
    assert waiting.make_safe() == UNTOUCHED
    assert commands(joint) == []


def test_its_twins_where_no_one_came_or_the_user_has_asked_for_a_stop(joint: Any, waiting: Any) -> None:
    assert waiting.make_safe() == "switch on disabled"
    with another_controller(joint):
        waiting._pause(0.1)
    assert waiting.make_safe(asked=True) == "switch on disabled"  # the frames may have been those of that stop


# --- clear-fault ---
def test_clear_fault_takes_every_rpdo_timer_away(joint: Any) -> None:
    with joint.opened() as drive:
        objects = drive._objects
        before = {}
        for base, milliseconds in ((0x1400, 100), (0x1402, 70)):
            before[base] = objects.read(base, 1, what="COB-ID")
            objects.write(base, 5, milliseconds, what="event timer")
        joint.requests.clear()
        drive.clear_fault()
        for base, cob_id in before.items():
            assert objects.read(base, 5, what="event timer") == 0
            assert objects.read(base, 1, what="COB-ID") == cob_id
        written = {data[1] | data[2] << 8 for cob, data in commands(joint) if cob == 0x601}
        assert {0x1400, 0x1402} <= written
        assert 0x1401 not in written  # it had none


def test_clear_fault_ends_what_would_keep_the_fault_alive(joint: Any) -> None:
    with joint.opened() as drive:
        drive._objects.write(0x1016, 1, 126 << 16 | 200, what="consumer heartbeat time")
        drive._node.nmt.send_command(NmtCommand.START)
        joint.settle()
        joint.requests.clear()
        drive.clear_fault()
        assert joint.downloads(0x1016, 1) == [0]
        assert next(data for cob, data in joint.requests if cob == 0) == bytes([NmtCommand.ENTER_PRE_OPERATIONAL, 1])
        assert joint.device.device[0].nmt == 127


# --- what a run says at its end ---
class NoLoop:
    def __init__(self, *_: Any) -> None: ...
    def __enter__(self) -> NoLoop:
        return self

    def __exit__(self, *_: object) -> None: ...
    def bus_is_there(self) -> None: ...


def left_by_a_dry_run(monkeypatch: pytest.MonkeyPatch, config: Any, state: str) -> int:
    report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)
    drive = SimpleNamespace(commission=lambda _: report, make_safe=lambda *, asked: state, close=lambda: None)
    monkeypatch.setattr(session_module, "LoopHandle", NoLoop)
    monkeypatch.setattr(CanopenSession, "open", lambda *_: drive)
    return run_module.run(config, Output(), assume_yes=True, dry_run=True)


@pytest.mark.parametrize("state", ["operation enabled, it did not obey", "quick stop active", "unknown: no answer"])
def test_a_drive_that_is_not_off_is_never_called_disabled(
    monkeypatch: pytest.MonkeyPatch, virtual_config: Any, capsys: Any, state: str
) -> None:
    with pytest.raises(DeviceError, match=f"={state}.*use the emergency stop"):
        left_by_a_dry_run(monkeypatch, virtual_config, state)
    told = capsys.readouterr().err
    assert f"did not confirm that it is off: {state}; use the emergency stop" in told
    assert "disabled" not in told


def test_its_twin_is_off(monkeypatch: pytest.MonkeyPatch, virtual_config: Any, capsys: Any) -> None:
    assert left_by_a_dry_run(monkeypatch, virtual_config, "switch on disabled") == 0
    told = capsys.readouterr().err
    assert "dry run: nothing moved; the drive was commissioned; the drive is disabled" in told
    assert "warning" not in told


@pytest.mark.parametrize(
    ("state", "said"),
    [("off", "disabled"), ("fault", "disabled"), (UNTOUCHED, "left alone: another controller"), ("", "no drive")],
)
def test_the_words_for_a_run_that_was_not_begun(state: str, said: str) -> None:
    require_off(state)
    assert said in words(state)
    assert words(state, interrupted=True) == ("the drive was left as it is" if state == UNTOUCHED else words(state))


# --- a drive that somebody else has enabled, without SYNC ---


def test_a_drive_that_is_found_enabled_brakes_before_its_power_goes_off(joint: Any) -> None:
    power_up(joint)
    joint.requests.clear()
    with joint.opened() as drive:
        report = drive.commission(lambda _: True)
    assert joint.downloads(0x6040)[:2] == [2, 0]  # quick stop, then disable voltage
    first_nmt = next(at for at, (cob, _) in enumerate(joint.requests) if cob == 0)
    quick_stop = next(at for at, (cob, data) in enumerate(joint.requests) if data[:5] == b"\x2b\x40\x60\x00\x02")
    assert quick_stop < first_nmt
    assert any("the drive was enabled" in remark for remark in report.remarks)


@pytest.mark.parametrize("approve", [None, lambda _: False])
def test_without_the_users_word_it_is_left_as_it_is(joint: Any, approve: Any) -> None:
    power_up(joint)
    joint.requests.clear()
    with joint.opened() as drive:
        with pytest.raises(DeviceError if approve is None else Declined):
            drive.commission(approve)
        assert drive.make_safe() == UNTOUCHED
    assert powered(joint)
    assert commands(joint) == []


@pytest.mark.parametrize(("step", "turns"), [(0, False), (2, False), (40, True), (-40, True)])
def test_an_enabled_drive_that_turns_is_left_alone(joint: Any, step: int, turns: bool) -> None:
    power_up(joint)
    joint.requests.clear()
    joint.sequences[0x6064, 0] = [1000 + step * (at % 2 if step == 2 else at) for at in range(40)]
    asked: list[str] = []
    with joint.opened() as drive:
        with pytest.raises(DeviceError, match="turns") if turns else contextlib.nullcontext():
            drive.commission(lambda question: asked.append(question) is None)
        assert (drive.make_safe() == UNTOUCHED) is turns
    assert (powered(joint), len(asked)) == ((True, 0) if turns else (False, 1))


@pytest.mark.parametrize(
    ("rad_per_count", "counts", "turns"),
    [(1.0, 2, False), (1.0, 3, True), (1.25e-5, 8, False), (1.25e-5, 9, True), (-1.25e-5, 8, False)],
)
def test_at_rest_a_joint_may_move_two_counts_or_a_ten_thousandth(
    rad_per_count: float, counts: int, turns: bool
) -> None:
    readings = iter([1000, *[1000 + counts] * 50])
    asked: list[str] = []
    with (
        pytest.raises(DeviceError, match=rf"turns \({counts} counts in 0.5 s\)") if turns else contextlib.nullcontext()
    ):
        refuse_unless_at_rest(
            "it", lambda: next(readings), rad_per_count, lambda question: asked.append(question) is None, "?",
            lambda _: None,
        )  # fmt: skip
    assert asked == ([] if turns else ["?"])


def test_it_is_watched_for_half_a_second_before_the_question_and_again_after_the_answer() -> None:
    log: list[Any] = []
    refuse_unless_at_rest(
        "it", lambda: log.append("look") or 0, 1.0, lambda question: log.append(question) is None, "may I?",
        log.append, lambda: log.append("others"),
    )  # fmt: skip
    watch = ["look", *[0.05, "look"] * 10, "others"]
    assert log == [*watch, "may I?", *watch]


@pytest.mark.parametrize("answered", [False, True])
def test_whatever_begins_to_turn_it_until_the_last_look_leaves_it_alone(answered: bool) -> None:
    readings = iter([*[0] * (21 if answered else 10), *[50] * 50])
    asked: list[str] = []
    with pytest.raises(DeviceError, match="turns"):
        refuse_unless_at_rest(
            "it", lambda: next(readings), 1.0, lambda question: asked.append(question) is None, "?", lambda _: None
        )
    assert bool(asked) is answered


@pytest.mark.parametrize(("afterwards", "anothers"), [(ON, True), (BRAKING, False), (OFF, False)])
def test_one_that_is_enabled_again_after_its_quick_stop_is_anothers(afterwards: State, anothers: bool) -> None:
    drive: Any = DriveInMemory(ON, ON, OFF, afterwards)
    with pytest.raises(BusError, match="enabled again after its quick stop") if anothers else contextlib.nullcontext():
        remark = brake_if_enabled(drive, 1, 1.0, lambda _: True, lambda _: None, lambda: None)
        assert "the drive was enabled, at rest" in remark
    assert drive.log == [QUICK_STOP]


def test_its_twin_that_is_off_is_not_braked(joint: Any) -> None:
    with joint.opened() as drive:
        report = drive.commission()
    assert 2 not in joint.downloads(0x6040)
    assert not any("the drive was enabled" in remark for remark in report.remarks)


def test_clear_fault_leaves_an_enabled_drive_alone(joint: Any) -> None:
    power_up(joint)
    joint.requests.clear()
    with joint.opened() as drive:
        with pytest.raises(DeviceError, match="operation enabled: there is no fault, and it was left as it is"):
            drive.clear_fault()
        assert powered(joint)
        assert commands(joint) == []
        assert joint.stop_drive() == "switch on disabled"
        with pytest.raises(BusError, match="another controller"):  # it has received the frames of that stop
            drive.clear_fault()
    with joint.opened() as later:
        assert later.clear_fault() == "no fault: the drive is switch on disabled"  # the twin
