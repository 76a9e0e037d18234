"""What stops the drive when this computer dies is read again while the loop runs."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from jointctl.drivers.canopen.drive import CanopenDrive
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
