"""A drive that does not say how it stops is refused; its deadline for RPDOs is set, read back and works."""

from __future__ import annotations

import dataclasses
import re
import struct
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.canopen.watchdog import (
    arm_reaction,
    arm_rpdo_deadline,
    clear_rpdo_deadlines,
    rpdo_deadline_ms,
    rpdo_identifiers,
    watched_nodes,
)
from jointctl.drivers.errors import DeviceError
from jointctl.hil.canopen.records import PowerState

MS = 1_000_000


def without(settings: CanopenSettings, folder: Path, *objects: str) -> CanopenSettings:
    """The same drive with an EDS that lacks these sections (`6007`, `1029sub1`, ...)."""
    text = settings.eds_path.read_text()
    for name in objects:
        text = re.sub(rf"(?ims)^\[{name}\].*?(?=^\[)", "", text)
    path = folder / "edited.eds"
    path.write_text(text)
    return dataclasses.replace(settings, eds_path=path)


def commissioned(bus: Any, settings: CanopenSettings) -> Any:
    drive = bus.drive(settings)
    try:
        return drive.commission()
    finally:
        drive.close()


def test_a_drive_without_any_reaction_to_a_lost_connection_is_refused(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    settings = without(settings_of_virtual_joint, tmp_path, "6007", "1029(sub[0-9A-F]+)?")
    with pytest.raises(DeviceError, match=r"neither object 6007 .* nor 1029:1 .*nothing says that it stops") as caught:
        commissioned(device_on_bus, settings)
    assert caught.value.exit_code == 6
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("missing", "words", "remark"),
    [
        ("6007", "1029:1 = 2 (stopped), read back", True),
        ("1029(sub[0-9A-F]+)?", "6007 = 3 (quick stop), read back", False),
        ("none", "6007 = 3 (quick stop), 1029:1 = 2 (stopped), read back", False),
    ],
)
def test_the_twins_that_say_how_they_stop(
    device_on_bus: Any,
    settings_of_virtual_joint: CanopenSettings,
    tmp_path: Path,
    missing: str,
    words: str,
    remark: bool,
) -> None:
    report = commissioned(device_on_bus, without(settings_of_virtual_joint, tmp_path, missing))
    assert report.settings["on a lost heartbeat"] == words
    assert report.settings["watchdog detects"] == "EMCY 8130h"
    assert any("no object 6007" in text for text in report.remarks) is remark


@pytest.mark.parametrize(
    ("heartbeat_s", "rate_Hz", "milliseconds"),
    [(0.2, 1000.0, 100), (0.05, 1000.0, 25), (0.1, 50.0, 100), (2.0, 1000.0, 1000), (200.0, 1000.0, 65535)],
)
def test_the_deadline_follows_from_heartbeat_and_rate(
    settings_of_virtual_joint: CanopenSettings, heartbeat_s: float, rate_Hz: float, milliseconds: int
) -> None:
    settings = dataclasses.replace(settings_of_virtual_joint, heartbeat_s=heartbeat_s, rate_Hz=rate_Hz)
    assert rpdo_deadline_ms(settings) == milliseconds


def test_the_deadline_is_in_the_drive_and_its_pdo_is_enabled_again(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings
) -> None:
    report = commissioned(device_on_bus, settings_of_virtual_joint)
    objects = device_on_bus.device.objects
    assert report.settings["RPDO deadline"] == "100 ms"
    assert (objects.value(0x1400, 5), objects.value(0x1400, 1)) == (100, 0x201)


@pytest.mark.parametrize("sub", ["missing", "ignored"])
def test_a_drive_without_a_deadline_is_told(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path, sub: str
) -> None:
    settings = settings_of_virtual_joint
    if sub == "missing":
        settings = without(settings, tmp_path, "1400sub5")
    else:
        device_on_bus.answers[0x1400, 5] = 0
    report = commissioned(device_on_bus, settings)
    assert "RPDO deadline" not in report.settings
    assert any("1400:5" in text and "withholds its heartbeat" in text for text in report.remarks)
    assert device_on_bus.device.objects.value(0x1400, 1) == 0x201


@pytest.mark.parametrize(("pause_ms", "stops"), [(95, False), (101, True)])
def test_an_enabled_drive_whose_rpdos_stay_away_stops_by_itself(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, pause_ms: int, stops: bool
) -> None:
    """SYNC and heartbeat go on: only the deadline sees it."""
    drive = device_on_bus.drive(settings_of_virtual_joint)
    try:
        drive.commission()
        drive.start_cyclic()
        drive._objects.read(0x1000, what="device type")
    finally:
        drive.close()
    device_on_bus.stop()
    device, now_ns = device_on_bus.device, device_on_bus.now_ns
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


# --- on objects in memory --------------------------------------------------------------------------------------------

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


def test_reaction_quick_stop_and_error_behaviour_are_set(settings_of_virtual_joint: CanopenSettings) -> None:
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
    settings_of_virtual_joint: CanopenSettings, refused: bool
) -> None:
    objects: Any = Objects(TWO_RPDOS, ((0x1401, 5),) if refused else ())
    words, remarks = arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x301)
    assert objects.written == [(0x1401, 1, DISABLED | 0x301), (0x1401, 5, 100), (0x1401, 1, 0x301)]
    assert words == ("" if refused else "100 ms")
    assert [text.partition(":")[0] for text in remarks] == (["refused"] if refused else [])


def test_without_the_event_timer_nothing_is_written(settings_of_virtual_joint: CanopenSettings) -> None:
    objects: Any = Objects(TWO_RPDOS)
    words, remarks = arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x501)
    assert (words, objects.written) == ("", [])
    assert remarks[0].startswith("no object 1403:5 (RPDO event timer): ")


def test_an_rpdo_that_is_not_there_any_more_is_an_error(settings_of_virtual_joint: CanopenSettings) -> None:
    objects: Any = Objects(TWO_RPDOS)
    with pytest.raises(DeviceError, match="no RPDO of the drive is enabled on 201h any more"):
        arm_rpdo_deadline(objects, settings_of_virtual_joint, 0x201)


def test_only_deadlines_that_are_armed_are_cleared() -> None:
    objects: Any = Objects(TWO_RPDOS)
    clear_rpdo_deadlines(objects)
    cleared = [(0x1401, 1, DISABLED | 0x301), (0x1401, 5, 0), (0x1401, 1, 0x301)]
    assert objects.written == [*cleared, (0x1402, 1, DISABLED | 0x401), (0x1402, 5, 0), (0x1402, 1, 0x401)]


def test_a_deadline_that_stays_is_an_error() -> None:
    objects: Any = Objects(TWO_RPDOS, ((0x1401, 5),))
    with pytest.raises(DeviceError, match="refused"):
        clear_rpdo_deadlines(objects)


def test_the_identifiers_are_those_of_enabled_rpdos_that_can_be_read() -> None:
    objects: Any = Objects(TWO_RPDOS, ((0x1402, 1),))
    assert rpdo_identifiers(objects) == [0x301, 0x501]


def test_watched_is_who_has_a_time_until_the_drive_has_no_more_entries() -> None:
    times_ms = {1: 500, 2: 0, 3: 1, 4: 0xFFFF, 6: 500}
    objects: Any = Objects({(0x1016, sub): (40 + sub) << 16 | time_ms for sub, time_ms in times_ms.items()})
    assert watched_nodes(objects) == {41, 43, 44}


def test_a_drive_may_watch_every_node() -> None:
    objects: Any = Objects({(0x1016, sub): sub << 16 | 500 for sub in range(1, 128)} | {(0x1016, 128): 200 << 16 | 500})
    assert watched_nodes(objects) == set(range(1, 128))
