"""PDOs as drives have them: on any identifier, fixed, half writable; used, restored or refused with the reason."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import accept_frame, end_cycle
from jointctl.drivers.errors import DeviceError
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest
from tests.unit.drivers.canopen.odd_drive import NO_ACCESS, OUT_OF_RANGE, READ_ONLY, store, value

pytestmark = pytest.mark.usefixtures("short_timeout")


def fixed_map(bus: Any, base: int, cob_id: int, kind: int, *entries: int) -> None:
    """A PDO whose map cannot be changed."""
    store(bus, base, 1, cob_id)
    store(bus, base, 2, kind)
    store(bus, base + 0x200, 0, len(entries))
    for sub, entry in enumerate(entries, start=1):
        store(bus, base + 0x200, sub, entry)


def refuse_maps(bus: Any, first: int) -> None:
    """Abort every change of the mapping of the four PDOs from `first` (1400 or 1800)."""
    for base in range(first, first + 4):
        bus.refused.update({(base + 0x200, sub): NO_ACCESS for sub in range(9)})


# --- PDOs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cob_id", [0x181, 0x1A5, 0x80000181, 0xC00001F0, 0x40000181])
def test_defaults_on_any_identifier_are_replaced(commission: Any, device_on_bus: Any, cob_id: int) -> None:
    store(device_on_bus, 0x1800, 1, cob_id)
    store(device_on_bus, 0x1400, 1, cob_id + 0x80)
    store(device_on_bus, 0x1800, 2, 255)
    store(device_on_bus, 0x1800, 3, 500)
    store(device_on_bus, 0x1800, 5, 100)
    commission()
    assert value(device_on_bus, 0x1800, 1) & ~0x40000000 == 0x181
    assert value(device_on_bus, 0x1400, 1) & ~0x40000000 == 0x201
    assert [value(device_on_bus, 0x1800, sub) for sub in (2, 3, 5)] == [1, 0, 0]
    assert (commission.port[0].tpdo_id, commission.port[0].rpdo_id) == (0x181, 0x201)


def test_a_pdo_that_cannot_be_switched_off_is_told(commission: Any, device_on_bus: Any) -> None:
    store(device_on_bus, 0x1802, 1, 0x381)
    device_on_bus.refused[(0x1802, 1)] = NO_ACCESS
    assert any("1802:1" in r and "it stays enabled on 381h" in r for r in commission().remarks)


def test_a_drive_that_makes_sync_itself_is_told_not_to(commission: Any, device_on_bus: Any) -> None:
    store(device_on_bus, 0x1005, 0, 0x40000080)
    store(device_on_bus, 0x1006, 0, 2000)
    assert "1005 was 40000080h, it is now 00000080h" in commission().remarks
    assert (value(device_on_bus, 0x1005), value(device_on_bus, 0x1006)) == (0x80, 1000)


@pytest.mark.parametrize(("asked", "taken"), [(1, True), (255, False)])
def test_a_drive_that_only_answers_to_sync(commission: Any, device_on_bus: Any, asked: int, taken: bool) -> None:
    """Its PDOs are synchronous and stay so; between two SYNCs it says nothing."""
    for base in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
        store(device_on_bus, base, 2, 1)
        device_on_bus.refused[base, 2] = OUT_OF_RANGE
    if not taken:
        with pytest.raises(DeviceError, match=r"transmission type 1, .*set drive\.rpdo_transmission_type = 1,"):
            commission(rpdo_transmission_type=asked)
        return
    report = commission(rpdo_transmission_type=asked)
    for base in (0x1400, 0x1800):
        told = f"{base:04X}:2 (PDO {base:04X} transmission type) cannot be written; it is 1, as it must be"
        assert told in report.remarks
    device_on_bus.stop()
    device, now_ns = device_on_bus.device, device_on_bus.now_ns

    def tpdos(frames: list[bytes]) -> int:
        return sum(struct.unpack_from("<I", frame)[0] == commission.port[0].tpdo_id for frame in frames)

    device.handle(struct.pack("<IB3x8s", 0, 2, b"\x01\x01"), now_ns)
    sync = struct.pack("<IB3x8s", commission.port[0].sync_id, 0, b"")
    heard = []
    for cycle in range(1, 4):
        at_ns = now_ns + cycle * 20_000_000
        heard.append((tpdos(device.advance(at_ns)), tpdos(device.handle(sync, at_ns))))
    assert heard == [(0, 1)] * 3


@pytest.mark.parametrize("asked", [1, 255])
def test_a_drive_that_refuses_an_asynchronous_command_and_can_be_mapped(
    commission: Any, device_on_bus: Any, asked: int
) -> None:
    """None of its own maps would do: not the map has to be changed, but what is asked for."""
    for base in range(0x1400, 0x1404):
        fixed_map(device_on_bus, base, 0x80000201, 1, CONTROL)
        device_on_bus.refused[base, 2] = OUT_OF_RANGE
    if asked == 1:
        assert commission(rpdo_transmission_type=asked).settings["mode"]
        return
    with pytest.raises(DeviceError, match=r"1400:2 .*was refused: value out of range") as caught:
        commission(rpdo_transmission_type=asked)
    assert caught.value.hint == "set drive.rpdo_transmission_type = 1"


STATUS, POSITION, TORQUE, VELOCITY = 0x60410010, 0x60640020, 0x60770010, 0x606C0020
CONTROL, TARGET, MODE, LIMIT, TARGET_VELOCITY, SPEED_LIMIT = (
    0x60400010, 0x60710010, 0x60600008, 0x60720010, 0x60FF0020, 0x607F0020,
)  # fmt: skip


def test_a_fixed_feedback_map_is_used_by_its_offsets(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1800)
    fixed_map(device_on_bus, 0x1800, 0x181, 1, STATUS, TORQUE)
    fixed_map(device_on_bus, 0x1801, 0x281, 1, STATUS, VELOCITY)
    fixed_map(device_on_bus, 0x1802, 0x3A5, 1, TORQUE, POSITION, STATUS)
    report = commission()
    port = commission.port[0]
    assert (port.tpdo_id, port.tpdo_length) == (0x3A5, 8)
    assert (port.torque_at, port.position_at, port.status_at) == (0, 2, 6)
    assert any("PDO 1802 is used as it is, on 3A5h" in remark for remark in report.remarks)
    assert value(device_on_bus, 0x1800, 1) & 0x80000000
    assert not value(device_on_bus, 0x1802, 1) & 0x80000000
    frame, sample = new(Frame)[0], new(Sample)[0]
    frame.can_id, frame.length = 0x3A5, 8
    for at, byte in enumerate(struct.pack("<hiH", -100, 1234, 0x1637)):
        frame.payload[at] = byte
    assert accept_frame(port, frame, sample, 1)
    assert sample.status_word == 0x1637
    assert sample.torque_Nm == pytest.approx(-6.05)
    assert sample.position_rad == pytest.approx(1234 * report.position_resolution_rad)


def test_a_fixed_feedback_map_without_the_position_is_refused(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1800)
    for base in range(0x1800, 0x1804):
        fixed_map(device_on_bus, base, 0x181 + (base & 3) * 0x100, 1, STATUS, VELOCITY)
    message = r"none of the drive's own TPDOs holds statusword \(6041\), position actual value \(6064\) together"
    with pytest.raises(DeviceError, match=message):
        commission()


def test_a_fixed_feedback_map_that_does_not_answer_every_sync_is_refused(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1800)
    fixed_map(device_on_bus, 0x1800, 0x181, 255, STATUS, POSITION)
    device_on_bus.refused[(0x1800, 2)] = READ_ONLY
    with pytest.raises(DeviceError, match=r"PDO 1800 .*transmission type 255: it does not answer every SYNC"):
        commission()


def test_a_fixed_command_map_is_filled_where_the_loop_writes_nothing(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1400)
    fixed_map(device_on_bus, 0x1400, 0x80000201, 255, CONTROL, MODE)
    fixed_map(device_on_bus, 0x1401, 0x80000301, 255, LIMIT, CONTROL, MODE, TARGET)
    report = commission()
    port = commission.port[0]
    assert (port.rpdo_id, port.rpdo_length, port.control_at, port.target_at) == (0x301, 7, 2, 5)
    assert any("PDO 1401 is used as it is" in remark for remark in report.remarks)
    frames, sample, command = new(Frame, 4), new(Sample)[0], new(Command)[0]
    port.state, command.request, command.torque_Nm = 4, DriveRequest.ENABLE, 6.05
    end_cycle(port, frames, sample, command)
    assert bytes(frames[2].payload)[:7] == struct.pack("<HHbh", 1000, 0x0F, 10, 100)
    assert frames[2].length == 7


def test_a_fixed_command_map_with_an_object_that_zero_could_harm_is_refused(
    commission: Any, device_on_bus: Any
) -> None:
    refuse_maps(device_on_bus, 0x1400)
    for base in range(0x1400, 0x1404):
        fixed_map(device_on_bus, base, 0x201 + (base & 3) * 0x100, 1, CONTROL, TARGET, SPEED_LIMIT)
    with pytest.raises(DeviceError, match="also carries object 607F: jointctl does not know what to send there"):
        commission()


def test_dummies_and_target_velocity_in_a_fixed_command_map_are_zero(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1400)
    fixed_map(device_on_bus, 0x1400, 0x201, 1, 0x00050008, CONTROL, 0x00050008, TARGET)
    commission()
    port = commission.port[0]
    assert (port.rpdo_length, port.control_at, port.target_at) == (6, 1, 4)
    assert bytes(port.rpdo_filler) == bytes(8)


def test_a_fixed_command_map_of_another_transmission_type_is_refused(commission: Any, device_on_bus: Any) -> None:
    refuse_maps(device_on_bus, 0x1400)
    fixed_map(device_on_bus, 0x1400, 0x201, 255, CONTROL, TARGET)
    device_on_bus.refused[(0x1400, 2)] = READ_ONLY
    with pytest.raises(DeviceError, match=r"transmission type 255, .*set drive\.rpdo_transmission_type = 255"):
        commission()
    commission(rpdo_transmission_type=255)


def test_a_map_of_which_only_some_steps_are_refused_is_restored(commission: Any, device_on_bus: Any) -> None:
    fixed_map(device_on_bus, 0x1800, 0x181, 1, POSITION, STATUS)
    device_on_bus.refused[(0x1A00, 1)] = NO_ACCESS
    commission()
    assert [value(device_on_bus, 0x1A00, k) for k in range(3)] == [2, POSITION, STATUS]
    assert (commission.port[0].position_at, commission.port[0].status_at) == (0, 4)
