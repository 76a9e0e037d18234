"""Drives as they are met: what is tolerated, with a remark, and what is refused, with the reason (docs/hardware.md)."""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.can.frames import Frame
from drivers.canopen.cyclic import accept_frame, end_cycle
from drivers.canopen.drive import CanopenDrive
from drivers.canopen.settings import CanopenSettings
from drivers.drive import CommissioningReport
from drivers.errors import DeviceError, NoDeviceError
from firmware_py.records import Command, Sample
from firmware_py.schema import new
from firmware_py.states import DriveRequest

NO_ACCESS, READ_ONLY, OUT_OF_RANGE, DEVICE_STATE = 0x06010000, 0x06010002, 0x06090030, 0x08000022


@pytest.fixture(autouse=True)
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.canopen.drive.SDO_TIMEOUT_S", 0.15)


@contextmanager
def opened(bus: Any, settings: CanopenSettings) -> Iterator[CanopenDrive]:
    drive = bus.drive(settings)
    try:
        yield drive
    finally:
        drive.close()


@pytest.fixture
def commission(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> Callable[..., CommissioningReport]:
    """Commissions with settings changed and sections removed from the EDS."""

    def run(*, without: tuple[str, ...] = (), **changes: Any) -> CommissioningReport:
        text = settings_of_virtual_joint.eds_path.read_text()
        for section in without:
            text, count = re.subn(rf"(?ims)^\[{section}(sub[0-9A-F]+)?\].*?(?=^\[|\Z)", "", text)
            assert count
        path = tmp_path / "edited.eds"
        path.write_text(text)
        settings = dataclasses.replace(settings_of_virtual_joint, eds_path=path, **changes)
        with opened(device_on_bus, settings) as drive:
            report = drive.commission()
            run.port = drive.port()  # type: ignore[attr-defined]
        return report

    return run


def value(bus: Any, index: int, sub: int = 0) -> int:
    return int(bus.device.objects.value(index, sub))


def store(bus: Any, index: int, sub: int, number: int) -> None:
    """A default of the drive that is not the virtual one's."""
    bus.device.objects.store(index, sub, struct.pack("<q", number)[: bus.device.objects.entry(index, sub).size])


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


# --- objects that a drive does not have ------------------------------------------------------------------------


def test_without_6502_the_mode_is_tried(commission: Any) -> None:
    report = commission(without=("6502",))
    assert report.mode == "cyclic_sync_torque"
    assert any("no object 6502" in remark for remark in report.remarks)


def test_without_6502_a_mode_that_is_not_taken_is_refused(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x6061, 0)] = 0
    with pytest.raises(DeviceError, match="6061 shows mode 0, mode 10 was selected"):
        commission(without=("6502",))


def test_without_603f_a_fault_has_no_code(commission: Any, device_on_bus: Any) -> None:
    assert commission(without=("603F",)).mode == "cyclic_sync_torque"
    device_on_bus.answers[(0x6041, 0)] = 0x0218
    with pytest.raises(DeviceError, match=r"is in fault \(error code 0000h\)"):
        commission(without=("603F",))


def test_without_1017_the_drive_is_watched_by_its_boot_up_and_its_samples(commission: Any) -> None:
    assert any("no object 1017" in remark for remark in commission(without=("1017",)).remarks)


def test_without_1016_the_drive_is_not_enabled(commission: Any) -> None:
    with pytest.raises(DeviceError, match=r"no object 1016:1 .* which jointctl needs: without it the drive cannot"):
        commission(without=("1016",))


def test_without_6077_the_torque_is_not_measured(commission: Any, device_on_bus: Any) -> None:
    assert not commission(without=("6077",)).measures_torque
    port = commission.port[0]
    assert (port.torque_at, port.tpdo_length) == (-1, 6)
    assert [value(device_on_bus, 0x1A00, k) for k in range(3)] == [2, 0x60410010, 0x60640020]


def test_60c2_is_not_needed_in_a_profile_mode(commission: Any) -> None:
    assert "60C2" not in commission(without=("60C2",), mode="tq").settings


def test_an_object_that_cannot_be_written_but_holds_the_value(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.refused[(0x60C2, 1)] = device_on_bus.refused[(0x60C2, 2)] = READ_ONLY
    report = commission()
    assert "60C2:1 (interpolation time period) cannot be written; it is 1, as it must be" in report.remarks
    with pytest.raises(DeviceError, match=r"60C2:1 .* was refused: object is read only"):
        commission(rate_Hz=500.0)


# --- torque mode with a slope ----------------------------------------------------------------------------------


def test_a_torque_slope_that_the_drive_limits_is_used_where_the_loop_is_slower(
    commission: Any, device_on_bus: Any
) -> None:
    device_on_bus.refused[(0x6087, 0)] = OUT_OF_RANGE
    store(device_on_bus, 0x6087, 0, 20_000)  # 0.0605 Nm per permille: 1210 Nm/s
    report = commission(mode="tq", torque_rate_max_Nmps=1209.0)
    assert any("6087 = 20000 permille/s" in remark for remark in report.remarks)


def test_a_torque_slope_below_the_rate_of_the_loop_is_refused(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.refused[(0x6087, 0)] = OUT_OF_RANGE
    store(device_on_bus, 0x6087, 0, 20_000)
    with pytest.raises(DeviceError, match=r"at most 1210 Nm/s .*set limits\.torque_rate_max_Nmps to 1210 or less"):
        commission(mode="tq", torque_rate_max_Nmps=1211.0)


def test_without_6087_torque_mode_is_warned_about(commission: Any) -> None:
    assert any("no object 6087" in remark for remark in commission(without=("6087",), mode="tq").remarks)


# --- torque in per mille of what -------------------------------------------------------------------------------


@pytest.mark.parametrize(("reference", "resolution_Nm"), [("rated_torque", 0.0605), ("rated_current", 0.0484)])
def test_permille_of_rated_torque_or_of_rated_current(commission: Any, reference: str, resolution_Nm: float) -> None:
    report = commission(torque_reference=reference, torque_constant_NmpA=0.08, max_torque_permille=None)
    assert report.torque_resolution_Nm == pytest.approx(resolution_Nm)
    assert report.settings["max torque"].endswith("= 60.0 Nm")


# --- time ------------------------------------------------------------------------------------------------------


def test_a_drive_that_boots_for_seconds(commission: Any, device_on_bus: Any) -> None:
    # each attempt: a request and an abort of the library
    device_on_bus.deaf_frames = 10
    commission(boot_timeout_s=1.5)
    assert device_on_bus.deaf_frames == 0


def test_a_drive_that_boots_for_longer_than_allowed(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.deaf_frames = 1000
    with pytest.raises(NoDeviceError, match="node 1 does not answer"):
        commission(boot_timeout_s=0.5)


def test_not_ready_to_switch_on_for_a_while(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.sequences[(0x6041, 0)] = [0x0200] * 20
    commission(boot_timeout_s=2.0)


def test_not_ready_to_switch_on_for_too_long(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x6041, 0)] = 0x0200
    message = r"node 1 is not ready to switch on \(statusword 0200h\) after 0\.3 s \(motor supply, .*boot_timeout_s\)"
    with pytest.raises(DeviceError, match=message):
        commission(boot_timeout_s=0.3)


def test_no_statusword_until_the_first_controlword_that_is_not_zero(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.sequences[(0x6041, 0)] = [0, 0, 0]
    commission(boot_timeout_s=1.0)
    words = [data[4] for cob, data in device_on_bus.requests if cob == 0x601 and data[:3] == b"\x2b\x40\x60"]
    assert words[:2] == [0x00, 0x06]
    assert 0x07 not in words
    assert 0x0F not in words
    assert value(device_on_bus, 0x6041) & 0x6F == 0x40


def test_answers_that_stay_away_now_and_then(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.mute += [(0x1018, 2), (0x6060, 0), (0x1A00, 3), (0x1A00, 3), (0x1016, 1)]
    commission()
    assert device_on_bus.mute == []


# --- identity --------------------------------------------------------------------------------------------------


def test_an_eds_that_does_not_name_its_maker(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x1018, 1)] = 0x9A  # the shipped EDS says vendor 0
    assert not any("vendor" in remark for remark in commission().remarks)


@pytest.mark.parametrize(("named", "accepted"), [(None, False), (0x9A, True), (0x9B, False)])
def test_an_eds_of_another_maker(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path, named: int | None, accepted: bool
) -> None:
    device_on_bus.answers[(0x1018, 1)] = 0x9A
    path = tmp_path / "other.eds"
    text = settings_of_virtual_joint.eds_path.read_text()
    path.write_text(text.replace("VendorNumber=0", "VendorNumber=0x2E1"))
    settings = dataclasses.replace(settings_of_virtual_joint, eds_path=path, vendor_id=named)
    with opened(device_on_bus, settings) as drive:
        if accepted:
            assert "EDS other.eds is of vendor 0x2e1, node 1 is of vendor 0x9a" in drive.commission().remarks
            return
        words = "other.eds is of vendor 0x2e1" if named is None else "drive.vendor_id is 0x9a, the configuration says"
        with pytest.raises(DeviceError, match=words):
            drive.commission()


def test_an_eds_of_another_product_is_told(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x1018, 2)] = 0x77
    assert "EDS edited.eds is of product 0x1, node 1 is product 0x77" in commission().remarks


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


# --- EDS files that are wrong where it matters, and elsewhere ---------------------------------------------------


def commissioned_with(bus: Any, settings: CanopenSettings, path: Path, text: str) -> CommissioningReport:
    path.write_text(text, encoding="latin-1")
    with opened(bus, dataclasses.replace(settings, eds_path=path)) as drive:
        return drive.commission()


def test_a_sloppy_eds_is_used_and_its_defects_are_told(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = text.replace("[6041]\n", "[6041]\nDescription=gerätespezifisch\n").replace("[1000]", "junk\n[1000]")
    text = re.sub(r"(?s)(\[6064\].*?)DataType=0x0004\n", r"\1", text, count=1)
    report = commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "sloppy.eds", text)
    told = [remark for remark in report.remarks if remark.startswith("EDS sloppy.eds: ")]
    assert len(told) == 3
    assert "[6064] has no DataType: INTEGER32 of the standard is used" in told[2]


def test_an_eds_that_is_wrong_about_a_cyclic_object_is_refused(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = re.sub(r"(?s)(\[6071\].*?)DataType=0x0003\n", r"\1DataType=0x0004\n", text, count=1)
    message = r"object 6071 \(target torque\) DataType \(=INTEGER32\) must be INTEGER16, and jointctl needs it"
    with pytest.raises(DeviceError, match=message):
        commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "wrong.eds", text)


def test_a_value_that_does_not_fit_the_type_of_the_eds_is_one_line(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = re.sub(r"(?s)(\[6072\].*?)DataType=0x0006\n", r"\1DataType=0x0005\n", text, count=1)
    with pytest.raises(DeviceError, match=r"6072 \(max torque\) has 8 bits, which do not hold 1000"):
        commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "short.eds", text)


@pytest.mark.parametrize(("torque_Nm", "refused"), [(48.4, False), (49.0, True)])
def test_a_torque_limit_that_6072_would_cut_unseen_is_refused(commission: Any, torque_Nm: float, refused: bool) -> None:
    """1000 permille of 5 A and 0.08 Nm/A at 121:1 are 48.4 Nm; the configuration alone cannot know it."""
    how = {"torque_reference": "rated_current", "torque_constant_NmpA": 0.08, "max_torque_permille": 1000}
    if refused:
        with pytest.raises(DeviceError, match=r"limits.torque_max_Nm \(=49\) must be in \(0..48.4\], what drive.max"):
            commission(torque_max_Nm=torque_Nm, **how)
    else:
        assert commission(torque_max_Nm=torque_Nm, **how).settings["max torque"] == "1000 permille = 48.4 Nm"
