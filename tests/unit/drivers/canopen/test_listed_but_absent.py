"""An object that the EDS lists and the drive lacks: absent where it may be, else refused by its name."""

from __future__ import annotations

from typing import Any

import pytest

from jointctl.drivers.errors import DeviceError
from tests.unit.drivers.canopen.odd_drive import opened, value

pytestmark = pytest.mark.usefixtures("short_timeout")
NO_OBJECT, NO_SUB_INDEX = "06020000", "06090011"


def take_away(bus: Any, index: int, sub: int | None = None) -> None:
    """The drive's dictionary loses an object, or one of its entries; our EDS still lists it."""
    objects = bus.device.objects
    for key in [key for key in objects.entries if key[0] == index and sub in (None, key[1])]:
        del objects.entries[key]
    if sub is None:
        objects._indices.discard(index)


@pytest.mark.parametrize(
    ("index", "sub", "remark"),
    [
        (0x6502, None, "no object 6502"),
        (0x603F, None, ""),
        (0x1017, None, "no object 1017"),
        (0x6007, None, "no object 6007"),
        (0x1029, None, ""),
        (0x605A, None, ""),
        (0x60B2, None, ""),
        (0x60FF, None, ""),
        (0x1005, None, ""),
        (0x1006, None, ""),
        (0x1019, None, ""),
        (0x1400, 5, "no object 1400:5"),
        (0x1800, 3, ""),
        (0x1800, 5, ""),
        (0x1018, 4, ""),
        (0x1008, None, ""),
    ],
)
def test_what_may_be_absent_is(commission: Any, device_on_bus: Any, index: int, sub: int | None, remark: str) -> None:
    take_away(device_on_bus, index, sub)
    report = commission()
    assert report.mode == "cyclic_sync_torque"
    assert not remark or any(remark in line for line in report.remarks)
    assert value(device_on_bus, 0x1016, 1) != 0


def test_a_torque_that_is_not_measured_is_not_mapped(commission: Any, device_on_bus: Any) -> None:
    take_away(device_on_bus, 0x6077)
    assert not commission().measures_torque
    assert [value(device_on_bus, 0x1A00, k) for k in range(3)] == [2, 0x60410010, 0x60640020]


def test_a_torque_slope_that_is_not_there_is_a_remark(commission: Any, device_on_bus: Any) -> None:
    take_away(device_on_bus, 0x6087)
    take_away(device_on_bus, 0x60C2)
    report = commission(mode="tq")
    assert any("no object 6087" in line for line in report.remarks)
    assert "60C2" not in report.settings


@pytest.mark.parametrize(
    ("index", "sub", "name", "code"),
    [
        (0x6064, None, r"6064 \(position actual value\)", NO_OBJECT),
        (0x6072, None, r"6072 \(max torque\)", NO_OBJECT),
        (0x6071, None, r"6071 \(target torque\)", NO_OBJECT),
        (0x60C2, 1, r"60C2:1 \(interpolation time period\)", NO_SUB_INDEX),
    ],
)
def test_what_must_be_there_is_refused_by_name(
    commission: Any, device_on_bus: Any, index: int, sub: int | None, name: str, code: str
) -> None:
    take_away(device_on_bus, index, sub)
    with pytest.raises(
        DeviceError, match=rf"object {name} was refused: .* does not exist \(SDO abort {code}h\)"
    ) as was:
        commission()
    assert "EDS edited.eds lists it" in was.value.hint


@pytest.mark.parametrize("sub", [None, 1])
def test_without_a_consumer_heartbeat_it_is_never_used(commission: Any, device_on_bus: Any, sub: int | None) -> None:
    take_away(device_on_bus, 0x1016, sub)
    with pytest.raises(
        DeviceError, match=r"node 1, unlike EDS edited\.eds, has no object 1016:1 .* which jointctl needs"
    ):
        commission()


def test_neither_reaction_to_a_lost_connection_is_refused(commission: Any, device_on_bus: Any) -> None:
    take_away(device_on_bus, 0x6007)
    take_away(device_on_bus, 0x1029)
    with pytest.raises(DeviceError, match=r"neither object 6007 .* nor 1029:1"):
        commission()


def test_an_object_is_asked_for_once_and_anew_with_each_commissioning(
    device_on_bus: Any, settings_of_virtual_joint: Any
) -> None:
    with opened(device_on_bus, settings_of_virtual_joint) as drive:
        drive.commission()
        objects = drive._objects
        before = len(device_on_bus.requests)
        assert [objects.has(0x6077) for _ in range(5)] == [True] * 5
        assert len(device_on_bus.requests) == before
        take_away(device_on_bus, 0x6077)
        assert objects.has(0x6077)
        assert not drive.commission().measures_torque


def test_other_refusals_do_not_make_an_object_absent(commission: Any, device_on_bus: Any) -> None:
    """A drive that will not take 6007 now has it all the same: not the same as a drive without."""
    device_on_bus.refused[(0x6007, 0)] = 0x08000022
    with pytest.raises(DeviceError, match=r"6007 .* not in the present device state"):
        commission()


def test_a_drive_without_a_target_velocity_is_switched_off(device_on_bus: Any) -> None:
    for index in (0x60FF, 0x1016):
        take_away(device_on_bus, index)
    assert device_on_bus.stop_drive() == "switch on disabled"
