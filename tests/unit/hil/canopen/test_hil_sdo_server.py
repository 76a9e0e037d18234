"""SDO server and write rules of the virtual drive: every abort code that a master may meet."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from jointctl.firmware_py.schema import new
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.canopen.dictionary import load_entries
from jointctl.hil.canopen.pdo import read_object, write_object
from jointctl.hil.canopen.records import FIELDS, Device
from jointctl.hil.plant.joint import plant
from tests.places import ROOT

EDS = ROOT / "configs" / "virtual_joint.eds"


@pytest.fixture
def device() -> Cia402Device:
    made = Cia402Device(EDS, DeviceSettings(node_id=5), *plant())
    made.advance(1_000_000)
    return made


def ask(device: Cia402Device, data: bytes) -> bytes:
    (answer,) = device.sdo.handle(data)
    assert len(answer) == 8
    return answer


def write(device: Cia402Device, index: int, sub: int, data: bytes) -> int:
    answer = ask(device, struct.pack("<BHB4s", 0x23 | (4 - len(data)) << 2, index, sub, data))
    return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x2345, 0, "00", 0x06020000),
        (0x1018, 9, "00", 0x06090011),
        (0x6041, 0, "0000", 0x06010002),
        (0x6040, 0, "00000000", 0x06070012),
        (0x6040, 0, "00", 0x06070013),
        (0x6007, 0, "0400", 0x06090031),
        (0x6007, 0, "ffff", 0x06090032),
        (0x6007, 0, "0300", 0),
        (0x605A, 0, "0300", 0x06090030),
        (0x605A, 0, "0600", 0),
        (0x6060, 0, "02", 0x06090030),
        (0x6060, 0, "0a", 0),
        (0x1400, 2, "f1", 0x06090030),
        (0x1400, 2, "f0", 0),
        (0x1800, 3, "0100", 0x08000022),  # inhibit time of a valid PDO
        (0x1801, 3, "0100", 0),
        (0x1400, 1, "06020000", 0x08000022),  # another identifier of a valid PDO
        (0x1401, 1, "05060080", 0),  # any identifier while it stays invalid
        (0x1401, 1, "05060000", 0x06090030),  # restricted
        (0x1600, 0, "00", 0x06010000),  # remap of a valid PDO
        (0x1A00, 1, "10007760", 0x06010000),
        (0x1601, 1, "10004060", 0x06010000),  # sub 0 is not 0
        (0x1600, 0, "09", 0x06040042),  # more than there is room for, whatever else
        (0x1601, 0, "09", 0x06040042),
        (0x1A01, 0, "ff", 0x06040042),
        (0x1601, 0, "08", 0x06020000),  # entry 4 names object 0000
        (0x1003, 0, "01", 0x06090030),
        (0x1003, 0, "00", 0),
        (0x1016, 1, "32007f00", 0),
        (0x1016, 1, "32000000", 0),  # unused: node 0
        (0x1016, 2, "32008000", 0),  # unused: no such node
        (0x1016, 2, "ffffffff", 0),
        (0x605D, 0, "0200", 0),
        (0x605D, 0, "0000", 0x06090032),
        (0x605D, 0, "0300", 0x06090031),
        (0x6086, 0, "0100", 0x06090030),
        (0x6088, 0, "0100", 0x06090030),
        (0x6079, 0, "00000000", 0x06010002),
        (0x606B, 0, "00000000", 0x06010002),
    ],
)
def test_download(device: Cia402Device, index: int, sub: int, data: str, code: int) -> None:
    assert write(device, index, sub, bytes.fromhex(data)) == code


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (0x60410010, 0x06040041),  # read only: not into an RPDO
        (0x60730010, 0x06040041),
        (0x60400020, 0x06040041),  # wrong length
        (0x23450010, 0x06020000),
        (0x607D0910, 0x06020000),  # by CiA 301, 7.5.2.36: what is to be mapped does not exist
        (0x60FF0020, 0),
    ],
)
def test_mapping_entry(device: Cia402Device, entry: int, code: int) -> None:
    assert write(device, 0x1601, 0, b"\x00") == 0
    assert write(device, 0x1601, 1, struct.pack("<I", entry)) == code


@pytest.mark.parametrize(("count", "code"), [(2, 0), (3, 0x06040042)])
def test_mapped_length_is_64_bits_at_most(device: Cia402Device, count: int, code: int) -> None:
    write(device, 0x1601, 0, b"\x00")
    for sub, entry in enumerate((0x60FF0020, 0x607A0020, 0x60600008), 1):
        assert write(device, 0x1601, sub, struct.pack("<I", entry)) == 0
    assert write(device, 0x1601, 0, bytes([count])) == code


def test_one_producer_is_watched_once(device: Cia402Device) -> None:
    assert write(device, 0x1016, 1, struct.pack("<I", 7 << 16 | 100)) == 0
    assert write(device, 0x1016, 2, struct.pack("<I", 7 << 16 | 50)) == 0x06040043
    assert write(device, 0x1016, 2, struct.pack("<I", 8 << 16 | 50)) == 0


@pytest.mark.parametrize("node", [0, 128, 255])
def test_an_entry_for_no_node_is_unused_and_so_no_second_one(device: Cia402Device, node: int) -> None:
    for sub in (1, 2):
        assert write(device, 0x1016, sub, struct.pack("<I", node << 16 | 50)) == 0


def test_the_page_lists_every_abort_code_and_each_has_a_test() -> None:
    used = {
        f"{int(code, 16):08X}"
        for file in (ROOT / "hil").rglob("*.py")
        for code in re.findall(r"^[A-Z_]+ = (0x0[568][0-9a-fA-F]{6})$", file.read_text(), re.MULTILINE)
    }
    page = (ROOT / "docs" / "virtual-joint.md").read_text()
    listed = re.findall(r"\b([0-9A-F]{4}) ([0-9A-F]{4})\b", page.split("Abort codes:")[1].split("(`tests")[0])
    assert {high + low for high, low in listed} == used
    tests = "".join(file.read_text() for file in (ROOT / "tests" / "unit" / "hil").rglob("test_hil_*.py")).upper()
    assert {code for code in used if f"0X{code}" not in tests} == set()


def test_an_object_that_is_write_only_in_another_eds(tmp_path: Path) -> None:
    text = EDS.read_text()
    at = text.index("AccessType=rw", text.index("[6087]"))
    eds = tmp_path / "other.eds"
    eds.write_text(text[:at] + "AccessType=wo" + text[at + len("AccessType=rw") :])
    for path, code in ((eds, 0x06010001), (EDS, 0)):
        made = Cia402Device(path, DeviceSettings(node_id=5), *plant())
        made.advance(1_000_000)
        answer = ask(made, bytes.fromhex("4087600000000000"))
        assert (answer[0] == 0x80, struct.unpack_from("<I", answer, 4)[0]) == ((True, code) if code else (False, 1000))
        assert write(made, 0x6087, 0, struct.pack("<I", 500)) == 0


def test_toggle_unknown_command_and_stray_segment(device: Cia402Device) -> None:
    assert ask(device, bytes.fromhex("4008100000000000"))[0] == 0x41
    assert ask(device, bytes.fromhex("7000000000000000"))[4:] == struct.pack("<I", 0x05030000)
    assert ask(device, bytes.fromhex("6000000000000000"))[4:] == struct.pack("<I", 0x05040001)
    assert ask(device, bytes.fromhex("e008100000000000"))[4:] == struct.pack("<I", 0x05040001)
    assert device.sdo.handle(bytes.fromhex("8008100000000000")) == []
    assert device.sdo.handle(b"\x40") == []


def test_segmented_download_of_the_wrong_length(device: Cia402Device) -> None:
    ask(device, struct.pack("<BHBI", 0x21, 0x2100, 0, 5))
    answer = ask(device, b"\x01" + b"elbow_7")
    assert struct.unpack_from("<I", answer, 4)[0] == 0x06070010


def test_mappable_in_the_eds_is_what_the_core_can_map() -> None:
    for entry in load_entries(EDS, 5).values():
        if not entry.size:
            continue
        mapping = entry.index << 16 | entry.sub << 8 | 8 * entry.size
        drive = new(Device)[0].drive
        write_object(drive, mapping, 3)
        assert (drive.tobytes() != bytes(len(drive.tobytes()))) is (entry.mappable and entry.writable), hex(mapping)
        if entry.mappable:
            drive = new(Device)[0].drive
            drive[FIELDS[entry.index, entry.sub]] = 7
            assert read_object(drive, mapping) == 7, hex(mapping)


def test_negative_values_keep_their_sign() -> None:
    drive = new(Device)[0].drive
    write_object(drive, 0x60710010, 0xFFFF)
    write_object(drive, 0x60FF0020, 0x80000000)
    assert (drive.target_torque, drive.target_velocity) == (-1, -(2**31))
