"""What stops the drive when this computer dies: said, proven before the first enable, read again in the loop."""

from __future__ import annotations

import dataclasses
import math
import re
import struct
import time
from typing import Any

import pytest

from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.watchdog import (
    BEATS,
    PERIOD_S,
    QuickStop,
    WatchdogGuard,
    arm_reaction,
    arm_rpdo_deadline,
    clear_rpdo_deadlines,
    is_kept,
    prove_watchdog,
    quick_stop_of,
    rpdo_deadline_ms,
    rpdo_identifiers,
    watched_nodes,
)
from jointctl.drivers.errors import BusError, DeviceError
from jointctl.hil.canopen.records import PowerState

# --- A drive that does not say how it stops is refused; its deadline for RPDOs is set, read back and works ---
MS = 1_000_000


@pytest.mark.trips("driver: that the drive says how it stops")
def test_a_drive_without_any_reaction_to_a_lost_connection_is_refused(commission: Any) -> None:
    with pytest.raises(DeviceError, match=r"neither object 6007 .* nor 1029:1 .*nothing says that it stops") as caught:
        commission(without=("6007", "1029"))
    assert caught.value.exit_code == 6
    assert "\n" not in str(caught.value)


@pytest.mark.stays("driver: that the drive says how it stops")
@pytest.mark.parametrize(
    ("missing", "words", "remark"),
    [
        (("6007",), "1029:1 = 2 (stopped), read back", True),
        (("1029",), "6007 = 3 (quick stop), read back", False),
        ((), "6007 = 3 (quick stop), 1029:1 = 2 (stopped), read back", False),
    ],
)
def test_the_twins_that_say_how_they_stop(commission: Any, missing: tuple[str, ...], words: str, remark: bool) -> None:
    report = commission(without=missing)
    assert report.settings["on a lost heartbeat"] == words
    assert report.settings["watchdog detects"] == "EMCY 8130h"
    assert any("no object 6007" in text for text in report.remarks) is remark


@pytest.mark.parametrize(
    ("heartbeat_s", "rate_Hz", "milliseconds"),
    [(0.2, 1000.0, 100), (0.05, 1000.0, 25), (0.1, 50.0, 100), (2.0, 1000.0, 1000), (200.0, 1000.0, 65535)],
)
def test_the_deadline_follows_from_heartbeat_and_rate(
    settings_of_virtual_joint: Any, heartbeat_s: float, rate_Hz: float, milliseconds: int
) -> None:
    settings = dataclasses.replace(settings_of_virtual_joint, heartbeat_s=heartbeat_s, rate_Hz=rate_Hz)
    assert rpdo_deadline_ms(settings) == milliseconds


def test_the_deadline_is_in_the_drive_and_its_pdo_is_enabled_again(commission: Any, joint: Any) -> None:
    assert commission().settings["RPDO deadline"] == "100 ms"
    assert (joint.value(0x1400, 5), joint.value(0x1400, 1)) == (100, 0x201)


@pytest.mark.parametrize("missing", [True, False])
def test_a_drive_without_a_deadline_is_told(commission: Any, joint: Any, missing: bool) -> None:
    if not missing:
        joint.answers[0x1400, 5] = 0  # it takes no notice
    report = commission(without=("1400sub5",) if missing else ())
    assert "RPDO deadline" not in report.settings
    assert any("1400:5" in text and "withholds its heartbeat" in text for text in report.remarks)
    assert joint.value(0x1400, 1) == 0x201


@pytest.mark.parametrize(("pause_ms", "stops"), [(95, False), (101, True)])
def test_an_enabled_drive_whose_rpdos_stay_away_stops_by_itself(joint: Any, pause_ms: int, stops: bool) -> None:
    """SYNC and heartbeat go on: only the deadline sees it."""
    with joint.commissioned() as drive:
        drive.start_cyclic()
        drive._objects.read(0x1000, what="device type")
    joint.stop()
    device, now_ns = joint.device, joint.now_ns
    emergencies = []

    def say(identifier: int, data: bytes) -> None:
        answers = device.handle(struct.pack("<IB3x8s", identifier, len(data), data), now_ns)
        emergencies.extend(int.from_bytes(frame[8:10], "little") for frame in answers if frame[:2] == b"\x81\x00")

    def cycle(word: int | None) -> None:
        nonlocal now_ns
        now_ns += MS
        say(0x80, b"")
        say(0x77E, b"\x05")
        if word is not None:
            say(0x201, struct.pack("<Hh", word, 0))

    for word in (6, 7, 15, 15):
        cycle(word)
    cycle(15)
    assert device.device[0].state == PowerState.OPERATION_ENABLED
    emergencies.clear()
    for _ in range(pause_ms - 1):
        cycle(None)
    cycle(15)
    assert (0x8250 in emergencies) is stops
    assert (device.device[0].state == PowerState.OPERATION_ENABLED) is not stops


# --- on objects in memory ---
DISABLED = 0x80000000


class Objects:
    """As `ObjectAccess`, of a drive that has these and refuses to take or to tell some; `written` in order."""

    def __init__(self, held: dict[tuple[int, int], int], refused: tuple[tuple[int, int], ...] = ()) -> None:
        self.held, self.refused = held, refused
        self.written: list[tuple[int, int, int]] = []

    def has(self, index: int, sub: int = 0) -> bool:
        return (index, sub) in self.held

    def indices(self, first: int, last: int) -> list[int]:
        return sorted({index for index, _ in self.held if first <= index <= last})

    def read(self, index: int, sub: int = 0, *, what: str) -> int:
        if (index, sub) in self.refused:
            raise DeviceError("refused")
        return self.held[index, sub]

    def read_if_present(self, index: int, sub: int = 0, *, what: str) -> int | None:
        return self.held.get((index, sub))

    def write(self, index: int, sub: int, value: int, *, what: str) -> None:
        self.written.append((index, sub, value))
        if (index, sub) in self.refused:
            raise DeviceError("refused")

    write_verified = write

    def write_if_present(self, index: int, sub: int, value: int, *, what: str) -> bool:
        if self.has(index, sub):
            self.write(index, sub, value, what=what)
        return self.has(index, sub)


def test_reaction_quick_stop_and_error_behaviour_are_set(settings_of_virtual_joint: Any) -> None:
    objects: Any = Objects({(0x6007, 0): 0, (0x605A, 0): 0, (0x1029, 1): 0})
    arm_reaction(objects, settings_of_virtual_joint)
    assert objects.written == [
        (0x6007, 0, 3), (0x605A, 0, settings_of_virtual_joint.quick_stop_option), (0x1029, 1, 2),
    ]  # fmt: skip


TWO_RPDOS = {
    (0x1400, 1): DISABLED | 0x301, (0x1400, 5): 0, (0x1401, 1): 0x301, (0x1401, 5): 40, (0x1402, 1): 0x401,
    (0x1402, 5): 70, (0x1403, 1): 0x501,
}  # fmt: skip


@pytest.mark.parametrize("refused", [False, True])
def test_the_deadline_is_set_while_the_pdo_that_is_enabled_there_is_disabled(
    settings_of_virtual_joint: Any, refused: bool
) -> None:
    objects: Any = Objects(TWO_RPDOS, ((0x1401, 5),) if refused else ())
    words, remarks = arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x301)
    assert objects.written == [(0x1401, 1, DISABLED | 0x301), (0x1401, 5, 100), (0x1401, 1, 0x301)]
    assert words == ("" if refused else "100 ms")
    assert [text.partition(":")[0] for text in remarks] == (["refused"] if refused else [])


def test_without_the_event_timer_nothing_is_written_and_without_the_rpdo_it_is_an_error(
    settings_of_virtual_joint: Any,
) -> None:
    objects: Any = Objects(TWO_RPDOS)
    words, remarks = arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x501)
    assert words == ""
    assert remarks[0].startswith("no object 1403:5 (RPDO event timer): ")
    with pytest.raises(DeviceError, match="no RPDO of the drive is enabled on 201h any more"):
        arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x201)
    assert objects.written == []


def test_only_deadlines_that_are_armed_are_cleared_and_one_that_stays_is_an_error() -> None:
    objects: Any = Objects(TWO_RPDOS)
    clear_rpdo_deadlines(objects)
    cleared = [(0x1401, 1, DISABLED | 0x301), (0x1401, 5, 0), (0x1401, 1, 0x301)]
    assert objects.written == [*cleared, (0x1402, 1, DISABLED | 0x401), (0x1402, 5, 0), (0x1402, 1, 0x401)]
    stays: Any = Objects(TWO_RPDOS, ((0x1401, 5),))
    with pytest.raises(DeviceError, match="refused"):
        clear_rpdo_deadlines(stays)


def test_the_identifiers_are_those_of_enabled_rpdos_that_can_be_read() -> None:
    objects: Any = Objects(TWO_RPDOS, ((0x1402, 1),))
    assert rpdo_identifiers(objects) == [0x301, 0x501]


def test_watched_is_who_has_a_time_until_the_drive_has_no_more_entries() -> None:
    times_ms = {1: 500, 2: 0, 3: 1, 4: 0xFFFF, 6: 500}
    objects: Any = Objects({(0x1016, sub): (40 + sub) << 16 | time_ms for sub, time_ms in times_ms.items()})
    assert watched_nodes(objects) == {41, 43, 44}
    every: Any = Objects({(0x1016, sub): sub << 16 | 500 for sub in range(1, 128)} | {(0x1016, 128): 200 << 16 | 500})
    assert watched_nodes(every) == set(range(1, 128))


# --- The drive's watchdog is proven before the first enable: silence must make it react, a heartbeat must not ---
NODE, MASTER, TIMEOUT_s = 1, 126, 0.2


class StubNetwork:
    """A drive's watchdog in simulated time; `reacts` and `trips_after` decide how it behaves."""

    def __init__(self, reaction: tuple[int, bytes] | None, timeout_s: float = TIMEOUT_s) -> None:
        self.now_s, self.heard_s = 0.0, 0.0
        self.reaction, self.timeout_s = reaction, timeout_s
        self.subscribers: dict[int, Any] = {}
        self.beats = 0

    def subscribe(self, can_id: int, callback: Any) -> None:
        self.subscribers[can_id] = callback

    def unsubscribe(self, can_id: int, callback: Any) -> None:
        del self.subscribers[can_id]

    def send_message(self, can_id: int, data: bytes) -> None:
        assert (can_id, data) == (0x700 + MASTER, b"\x05")
        self.beats += 1
        self.heard_s = self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        if self.reaction and self.beats and self.now_s - self.heard_s > self.timeout_s:
            can_id, data = self.reaction
            self.subscribers[can_id](can_id, bytearray(data), self.now_s)


EMERGENCY = (0x80 + NODE, bytes((0x30, 0x81, 0x10, 0, 0, 0, 0, 0)))


def prove(network: StubNetwork) -> str:
    return prove_watchdog(network, NODE, MASTER, TIMEOUT_s, network.sleep)  # type: ignore[arg-type]


@pytest.mark.stays("driver: that watchdog")
def test_a_working_watchdog_is_seen() -> None:
    network = StubNetwork(EMERGENCY)
    assert prove(network) == "EMCY 8130h"
    assert network.beats == BEATS
    assert network.subscribers == {}


@pytest.mark.trips("driver: that watchdog")
def test_a_watchdog_that_does_nothing_is_refused() -> None:
    with pytest.raises(DeviceError, match="did not react"):
        prove(StubNetwork(None))


@pytest.mark.parametrize(("timeout_s", "early"), [(TIMEOUT_s / 3.0 - 0.01, True), (TIMEOUT_s / 3.0 + 0.01, False)])
def test_a_watchdog_that_trips_while_the_heartbeat_comes_is_refused(timeout_s: float, early: bool) -> None:
    network = StubNetwork(EMERGENCY, timeout_s)
    if early:
        with pytest.raises(DeviceError, match="although the heartbeat"):
            prove(network)
    else:
        assert prove(network) == "EMCY 8130h"


def test_a_computer_that_stands_still_does_not_lay_it_to_another_program() -> None:
    network = StubNetwork(EMERGENCY)

    def sleep(seconds: float) -> None:
        lost_s = TIMEOUT_s if network.beats == 2 else 0.0
        time.sleep(lost_s)
        network.sleep(seconds + lost_s)

    with pytest.raises(DeviceError, match=r"and rightly: this computer stood still, .* came 0\.\d\d s apart"):
        prove_watchdog(network, NODE, MASTER, TIMEOUT_s, sleep)  # type: ignore[arg-type]


class Telling(StubNetwork):
    """Says `frames` one after the other as soon as the heartbeat is stopped, and notes every wait."""

    def __init__(self, *frames: tuple[int, bytes]) -> None:
        super().__init__(None)
        self.frames = frames
        self.waits_s: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.waits_s.append(seconds)
        if len(self.waits_s) == BEATS + 1:
            for can_id, data in self.frames:
                self.subscribers[can_id](can_id, bytearray(data), 0.0)


def heartbeats(*data: bytes) -> list[tuple[int, bytes]]:
    return [(0x700 + NODE, part) for part in data]


@pytest.mark.parametrize(
    ("frames", "seen"),
    [
        ([(0x80 + NODE, b"\x30\x81")], "EMCY 8130h"),
        ([(0x80 + NODE, b"\x30")], ""),
        ([(0x80 + NODE, b"\x10\x43\x10\0\0\0\0\0")], ""),  # another emergency is no proof
        (heartbeats(b"\x05", b"\x04"), "NMT state 4"),
        (heartbeats(b"\x05", b"\x04", b"\x7f"), "NMT state 4"),
        (heartbeats(b"\x05"), ""),
        (heartbeats(b"\x05", b"\x85"), ""),  # the highest bit is not part of the state
        (heartbeats(b"\x00", b""), ""),
        ([EMERGENCY, *heartbeats(b"\x05", b"\x04")], "EMCY 8130h"),
        ([*heartbeats(b"\x05", b"\x04"), EMERGENCY], "EMCY 8130h"),
    ],
)
def test_what_is_a_reaction_and_what_is_not(frames: list[tuple[int, bytes]], seen: str) -> None:
    network = Telling(*frames)
    if seen:
        assert prove(network) == seen
    else:
        with pytest.raises(DeviceError, match=r"was stopped for 0.8 s and the drive did not react"):
            prove(network)
    assert network.subscribers == {}


def test_a_third_of_the_timeout_between_beats_and_four_timeouts_of_silence() -> None:
    network = Telling()
    with pytest.raises(DeviceError):
        prove(network)
    assert network.waits_s == pytest.approx([TIMEOUT_s / 3.0] * 6 + [TIMEOUT_s / 20.0] * 80)


# --- What stops the drive when this computer dies is read again while the loop runs ---
WATCHED = {0x1016: 4, 0x1400: 2, 0x6007: 2, 0x6061: 1}  # and the bytes of each
SECOND = 1_000_000_000


class Run:
    """A commissioned drive with its guard, whose clock the test moves."""

    def __init__(self, bus: Any, drive: CanopenDrive) -> None:
        self.bus, self.now_s = bus, 100.0
        drive._clock = lambda: self.now_s
        drive.commission()
        drive.start_cyclic()
        guard = drive.settings_guard()
        assert guard is not None
        self.guard = guard

    def polled(self, count: int = 1, each_s: float = 0.06) -> list[str]:
        warnings = []
        for _ in range(count):
            warnings += self.guard.poll()
            self.bus.settle()
            self.now_s += each_s
        return warnings + self.guard.poll()


@pytest.fixture
def run(joint: Any) -> Any:
    with joint.opened() as drive:
        yield Run(joint, drive)


def test_nothing_is_confirmed_before_all_was_read(run: Run) -> None:
    assert not run.guard.confirmed
    run.polled(3)
    assert not run.guard.confirmed
    run.polled(8)
    assert run.guard.confirmed
    assert run.polled(100) == []  # the twin of the tests below: nothing changes


@pytest.mark.parametrize("confirmed", [False, True])
@pytest.mark.parametrize("index", list(WATCHED))
def test_a_change_is_named(run: Run, index: int, confirmed: bool) -> None:
    if confirmed:
        run.polled(12)
        assert run.guard.confirmed
    sub = {0x1016: 1, 0x1400: 5}.get(index, 0)
    run.bus.answers[index, sub] = 2
    with pytest.raises(DeviceError, match=rf"object {index:04X}(:{sub})? .* was changed to 2 .* by another program"):
        run.polled(40)


@pytest.mark.parametrize(
    ("answer", "silent", "words"),
    [
        (2, False, "node 1: 6061 (modes of operation display) is 2 after the run, 10 was set"),
        (10, False, ""),
        (2, True, ""),
    ],
)
def test_after_the_run_the_mode_is_read_once(run: Run, answer: int, silent: bool, words: str) -> None:
    run.bus.answers[0x6061, 0] = answer
    run.bus.mute += [(0x6061, 0)] * 10 * silent
    assert run.guard.mode_left() == words


def test_a_command_of_another_controller_is_seen_at_once(run: Run) -> None:
    run.bus.send(0x000, bytes([128, 1]))
    with pytest.raises(BusError, match="NMT 'enter pre operational' to node 1"):
        run.polled(1)


@pytest.mark.parametrize("later", [False, True])
def test_what_cannot_be_read_keeps_the_loop_from_enabling_and_later_is_a_warning(run: Run, later: bool) -> None:
    run.polled(12 * later)
    run.bus.mute += [(0x6007, 0)] * 10
    if later:
        (warning,) = run.polled(60, 0.2)
        assert "object 6007" in warning
        return
    with pytest.raises(DeviceError, match=r"object 6007 .* cannot be read any more: no answer within 1 s"):
        run.polled(60, 0.2)


@pytest.mark.parametrize(("every_s", "raises"), [(0.04, True), (0.07, False)])
def test_reads_of_another_program_that_leave_no_room_keep_the_loop_from_enabling(
    run: Run, every_s: float, raises: bool
) -> None:
    """The loop waited without a word, and enabled the joint when they ended, however long after its user's yes."""

    def poll_beside_them() -> None:
        for _ in range(200):
            run.bus.send(0x581, bytes.fromhex("4b416000 50020000"))
            run.polled(1, every_s)

    if not raises:
        poll_beside_them()
        assert run.guard.confirmed
        return
    with pytest.raises(DeviceError, match=r"cannot be read any more: SDO transfers of another program leave no time"):
        poll_beside_them()
    assert run.now_s < 105.2


def test_it_costs_four_uploads_a_second(run: Run) -> None:
    run.polled(12)
    run.bus.requests.clear()
    run.polled(100, 0.05)
    uploads = [struct.unpack_from("<H", data, 1)[0] for cob, data in run.bus.requests if cob == 0x601]
    assert {index: uploads.count(index) for index in WATCHED} == dict.fromkeys(WATCHED, 5)


def test_while_the_delay_is_measured_it_reads_nothing_and_listens(run: Run) -> None:
    for _ in range(20):
        assert run.guard.poll(may_ask=False) == []
        run.bus.settle()
        run.now_s += 0.06
    assert not run.guard.confirmed
    run.bus.send(0x601, struct.pack("<BHBI", 0x2B, 0x6007, 0, 0))
    with pytest.raises(BusError, match="writes object 6007"):
        run.guard.poll(may_ask=False)


# --- what it makes of answers, without a drive ---
class Answers:
    """A guard of 6007, which was set to 3, and of mode 10; the test says what the drive answers."""

    def __init__(self) -> None:
        self.polls = 0
        self.places: list[tuple[int, int, float]] = []
        self._hear: dict[int, Any] = {}
        stub: Any = self
        self.guard = WatchdogGuard(stub, stub, 1, 10, lambda: None)

    def verified(self) -> dict[tuple[int, int], tuple[int, str]]:
        return {(0x6007, 0): (3, "abort connection option"), (0x6072, 0): (500, "max torque")}

    def encoded(self, index: int, sub: int, value: int, *, what: str) -> bytes:
        return value.to_bytes(WATCHED[index], "little")

    def add(self, index: int, sub: int, period_s: float, on_answer: Any) -> None:
        self.places.append((index, sub, period_s))
        self._hear[index] = on_answer

    def poll(self, *, may_ask: bool = True) -> None:
        self.polls += may_ask

    def says(self, index: int, data: bytes | None) -> list[str]:
        self._hear[index](0, data, "" if data is not None else "silence")
        return self.guard.poll()

    def confirm(self) -> None:
        self.says(0x6007, b"\x03\0")
        assert not self.guard.confirmed
        self.says(0x6061, b"\x0a")
        assert self.guard.confirmed


def test_it_reads_what_was_set_to_stop_the_drive_and_the_mode() -> None:
    answers = Answers()
    assert answers.places == [(0x6007, 0, PERIOD_S), (0x6061, 0, PERIOD_S)]
    answers.guard.poll(may_ask=False)
    assert answers.polls == 0
    answers.guard.poll()
    assert answers.polls == 1


@pytest.mark.parametrize(
    ("index", "sub", "kept"),
    [
        (0x1016, 1, True), (0x1016, 2, False), (0x1017, 1, False), (0x6007, 0, True), (0x6007, 1, False),
        (0x6008, 0, False), (0x1400, 5, True), (0x1400, 4, False), (0x13FF, 5, False), (0x15FF, 5, True),
        (0x1600, 5, False),
    ],
)  # fmt: skip
def test_what_is_kept_is_who_is_watched_the_reaction_and_every_deadline(index: int, sub: int, kept: bool) -> None:
    assert is_kept(index, sub) is kept


def test_bytes_behind_the_value_are_not_part_of_it() -> None:
    answers = Answers()
    assert answers.says(0x6007, b"\x03\0\xff\xff") == []


def test_the_first_change_is_told_with_both_values() -> None:
    answers = Answers()
    text = "6007 (abort connection option) was changed to 18 (12h) by another program or the drive itself, 3 was set"
    for data in (b"\x12\0\xff\xff", b"\x05\0"):
        with pytest.raises(DeviceError, match=re.escape(text)) as raised:
            answers.says(0x6007, data)
        assert "off" not in raised.value.hint  # that is known when the drive has been read


@pytest.mark.parametrize("confirmed", [False, True])
def test_three_reads_in_a_row_without_an_answer_are_told_and_two_are_not(confirmed: bool) -> None:
    answers = Answers()
    if confirmed:
        answers.confirm()
    for said in (None, None, b"\x03\0", None, None):
        assert answers.says(0x6007, said) == []
    text = "node 1: object 6007 (abort connection option) cannot be read any more: silence"
    if confirmed:
        assert answers.says(0x6007, None) == [text]
        assert answers.says(0x6007, None) == []  # once
    else:
        with pytest.raises(DeviceError, match=re.escape(text)):
            answers.says(0x6007, None)


def test_every_object_that_cannot_be_read_is_told() -> None:
    answers = Answers()
    answers.confirm()
    told = [answers.says(index, None) for index in (0x6007, 0x6061) for _ in range(3)]
    assert [len(warnings) for warnings in told] == [0, 0, 1, 0, 0, 1]


# --- how fast the drive's own quick stop brakes ---
A_TURN = 524288.0 / math.tau  # counts of a rad, with the encoder on the joint
FAST = {(0x605A, 0): 2, (0x6085, 0): 1_000_000, (0x6084, 0): 400_000}  # 12.0 and 4.8 rad/s2


def judged(settings: Any, held: dict[tuple[int, int], int], **changes: Any) -> tuple[QuickStop, str]:
    settings = dataclasses.replace(settings, **changes)
    found = quick_stop_of(lambda index, sub: held.get((index, sub)), settings)
    return found, found.problem(settings)


@pytest.mark.parametrize(
    ("option", "value", "radps2"),
    [(1, 0x6084, 400_000), (2, 0x6085, 1_000_000)],
)
@pytest.mark.parametrize(("mode", "hedged"), [("cst", True), ("auto", True), ("csv", False), ("csp", False)])
def test_the_ramp_is_that_which_605a_names(
    settings_of_virtual_joint: Any, option: int, value: int, radps2: float, mode: str, hedged: bool
) -> None:
    found, problem = judged(settings_of_virtual_joint, FAST, quick_stop_option=option, mode=mode)
    assert (found.index, found.radps2, problem) == (value, pytest.approx(radps2 / A_TURN), "")
    assert (
        f"605A = {option}) brakes with {radps2 / A_TURN:.3g} rad/s2 at the joint ({value:04X} = {radps2}" in found.words
    )
    assert ("unless its torque mode has a ramp of its own" in found.words) == (hedged and value == 0x6084)


def test_the_encoder_on_the_motor_makes_it_slower_at_the_joint(settings_of_virtual_joint: Any) -> None:
    """The 6085 of a soft joint was 0.8 rad/s2, and no one said so."""
    found, problem = judged(settings_of_virtual_joint, FAST, encoder_on_motor=True, counts_per_turn=65536)
    assert found.radps2 == pytest.approx(0.7924, rel=1e-3)
    assert problem == (
        "the drive's own quick stop (605A = 2) brakes with 0.792 rad/s2 at the joint (6085 = 1000000), 1.3 s and "
        "0.63 rad from limits.velocity_max_radps (=1): slower than sequence.brake_radps2 (=2); 6085 should be "
        "2524152 or more"
    )
    _, problem = judged(
        settings_of_virtual_joint, FAST | {(0x6085, 0): 2_524_152}, encoder_on_motor=True, counts_per_turn=65536
    )
    assert problem == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"brake_radps2": 11.9}, ""),
        ({"brake_radps2": 12.1}, "slower than sequence.brake_radps2 (=12.1); 6085 should be 1009661 or more"),
        ({"velocity_max_radps": 3.0, "stop_timeout_s": 0.26}, ""),
        (
            {"velocity_max_radps": 3.0, "stop_timeout_s": 0.24},
            "longer than sequence.stop_timeout_s (=0.24); 6085 should be 1043038 or more",
        ),
        ({"velocity_max_radps": 5.78}, ""),
        (
            {"velocity_max_radps": 5.81},
            "farther than between the position limits (1.4 rad); 6085 should be 1005969 or more",
        ),
        ({"velocity_max_radps": None, "brake_radps2": 20.0}, ""),
    ],
)
def test_it_is_compared_with_the_loops_stop_and_the_limits(
    settings_of_virtual_joint: Any, changes: dict[str, Any], words: str
) -> None:
    _, problem = judged(settings_of_virtual_joint, FAST, **changes)
    assert problem.endswith(words) if words else not problem


@pytest.mark.parametrize(
    ("held", "changes", "words"),
    [
        ({(0x6085, 0): 1}, {}, "no object 605A: how the drive's own quick stop brakes is not known"),
        ({(0x605A, 0): 2}, {}, "no 6085 that can be read, how fast it brakes is not known"),
        (FAST | {(0x6085, 0): 0}, {}, "6085 is 0, how fast it brakes is not known"),
        (FAST, {"quick_stop_option": 0}, "takes its power at once: the joint coasts"),
        (FAST, {"quick_stop_option": 3}, "brakes at its current limit: how fast is not known"),
        (FAST, {"quick_stop_option": 4}, "brakes at its voltage limit: how fast is not known"),
        (FAST, {"quick_stop_option": 1, "mode": "pv"}, "which a run makes steeper than its motions where it needs it"),
        (FAST, {"velocity_unit": "r/min"}, "in a unit that is not known: drive.velocity_unit is r/min"),
        (FAST, {"vendor_id": 0xFB}, "in a unit that is not known: maxon has a unit of its own"),
        (FAST | {(0x1018, 1): 0xAB}, {}, "in a unit that is not known: Copley has a unit of its own"),
        (FAST | {(0x60A9, 0): 0xB44700}, {}, "in a unit that is not known: 60A9 is B44700h"),
        (FAST | {(0x60AA, 0): 0xB54700}, {}, "in a unit that is not known: 60AA is B54700h"),
        (FAST | {(0x6097, 1): 10, (0x6097, 2): 1}, {}, "in a unit that is not known: 6097 is 10:1"),
        (FAST | {(0x6096, 1): 1, (0x6096, 2): 60}, {}, "in a unit that is not known: 6096 is 1:60"),
        (FAST | {(0x6091, 1): 121, (0x6091, 2): 1}, {}, "in a unit that is not known: 6091 is 121:1"),
        (
            FAST | {(0x6092, 1): 3600, (0x6092, 2): 1, (0x608F, 1): 65536, (0x608F, 2): 1}, {},
            "in a unit that is not known: 6092 is 3600:1",
        ),
    ],
)  # fmt: skip
def test_what_is_not_known_is_said_and_not_judged(
    settings_of_virtual_joint: Any, held: dict[tuple[int, int], int], changes: dict[str, Any], words: str
) -> None:
    found, problem = judged(settings_of_virtual_joint, held, brake_radps2=1e6, **changes)
    assert found.words.endswith(words)
    assert (found.radps2, problem) == (None, "")


@pytest.mark.parametrize(
    "plain",
    [
        {(0x60AA, 0): 0xB55700, (0x60A9, 0): 0xB50300, (0x60A8, 0): 0, (0x608D, 0): 0},
        {(0x6091, 1): 1, (0x6091, 2): 1, (0x6097, 1): 3, (0x6097, 2): 3, (0x6096, 1): 7},
        {(0x6092, 1): 65536, (0x6092, 2): 1, (0x608F, 1): 65536, (0x608F, 2): 1},
        {(0x1018, 1): 0x9A},
    ],
)
def test_objects_that_scale_nothing_leave_it_known(
    settings_of_virtual_joint: Any, plain: dict[tuple[int, int], int]
) -> None:
    found, _ = judged(settings_of_virtual_joint, FAST | plain)
    assert found.radps2 == pytest.approx(1_000_000 / A_TURN)


@pytest.mark.parametrize(("value", "slow"), [(150_000, True), (170_000, False)])
def test_commissioning_says_how_fast_the_quick_stop_brakes(commission: Any, joint: Any, value: int, slow: bool) -> None:
    joint.device.objects.store(0x6085, 0, struct.pack("<I", value))
    report = commission()
    assert report.settings["quick stop"].startswith("the drive's own quick stop (605A = 2) brakes with ")
    assert [text for text in report.remarks if "slower than sequence.brake_radps2 (=2)" in text and "6085" in text] == [
        text for text in report.remarks if "quick stop" in text
    ]
    assert any("quick stop" in text for text in report.remarks) is slow
    assert joint.downloads(0x6085) == []


def test_a_ramp_that_the_drive_does_not_give_is_not_known(commission: Any, joint: Any) -> None:
    joint.unread[0x6085, 0] = 0x06010001  # write-only
    report = commission()
    assert report.settings["quick stop"].endswith("no 6085 that can be read, how fast it brakes is not known")
