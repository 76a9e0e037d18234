"""What stops the drive when this computer dies is read again while the loop runs."""

from __future__ import annotations

import re
import struct
from typing import Any

import pytest

from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.watchdog import PERIOD_S, WatchdogGuard, is_kept
from jointctl.drivers.errors import BusError, DeviceError
from tests.unit.drivers.canopen.odd_drive import opened

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
def run(device_on_bus: Any, settings_of_virtual_joint: Any) -> Any:
    with opened(device_on_bus, settings_of_virtual_joint) as drive:
        yield Run(device_on_bus, drive)


def test_nothing_is_confirmed_before_all_was_read(run: Run) -> None:
    assert not run.guard.confirmed
    run.polled(3)
    assert not run.guard.confirmed
    run.polled(8)
    assert run.guard.confirmed


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


def test_its_twin_where_nothing_changes_goes_on(run: Run) -> None:
    assert run.polled(100) == []


def test_a_command_of_another_controller_is_seen_at_once(run: Run) -> None:
    run.bus.send(0x000, bytes([128, 1]))
    with pytest.raises(BusError, match="NMT 'enter pre operational' to node 1"):
        run.polled(1)


def test_what_cannot_be_read_keeps_the_loop_from_enabling(run: Run) -> None:
    run.bus.mute += [(0x6007, 0)] * 10
    with pytest.raises(DeviceError, match=r"object 6007 .* cannot be read any more: no answer within 1 s"):
        run.polled(200)


def test_later_it_is_a_warning(run: Run) -> None:
    run.polled(12)
    run.bus.mute += [(0x6007, 0)] * 10
    warnings = run.polled(200)
    assert len(warnings) == 1
    assert "object 6007" in warnings[0]


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


# --- what it makes of answers, without a drive -----------------------------------------------------------------------


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
    text = "node 1: object 6007 (abort connection option) was changed to 18 (12h) by another program, 3 was set"
    for data in (b"\x12\0\xff\xff", b"\x05\0"):
        with pytest.raises(DeviceError, match=re.escape(text)):
            answers.says(0x6007, data)


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
