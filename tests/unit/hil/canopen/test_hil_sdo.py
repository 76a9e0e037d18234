"""SDO server of the virtual drive: every abort code that a master may meet, and block transfer."""

from __future__ import annotations

import binascii
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import pytest

from jointctl.firmware_py.schema import new
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.canopen.dictionary import load_entries
from jointctl.hil.canopen.pdo import read_object, write_object
from jointctl.hil.canopen.records import FIELDS, Device
from jointctl.hil.canopen.sdo import TIMEOUT_NS, SdoServer
from jointctl.hil.plant import plant
from tests.places import EDS, ROOT
from tests.virtual_drive import NODE, Network, frame, network_node, virtual_drive

# --- SDO server and write rules of the virtual drive: every abort code that a master may meet ---


@pytest.fixture
def device() -> Cia402Device:
    made = virtual_drive()
    made.advance(1_000_000)
    return made


def ask(device: Cia402Device, data: bytes) -> bytes:
    (answer,) = device.sdo.handle(data)
    assert len(answer) == 8
    return answer


def write(device: Cia402Device, index: int, sub: int, data: bytes) -> int:
    answer = ask(device, struct.pack("<BHB4s", 0x23 | (4 - len(data)) << 2, index, sub, data))
    return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0


def write_block(device: Cia402Device, index: int, sub: int, data: bytes) -> int:
    """The same by block transfer of the library."""
    try:
        with client(device).open(index, sub, "wb", size=len(data), block_transfer=True) as stream:
            stream.write(data)
    except canopen.SdoAbortedError as abort:
        return int(abort.code)
    return 0


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
@pytest.mark.parametrize("block", [False, True])
def test_download(device: Cia402Device, index: int, sub: int, data: str, code: int, block: bool) -> None:
    assert (write_block if block else write)(device, index, sub, bytes.fromhex(data)) == code


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
        made = Cia402Device(path, DeviceSettings(node_id=NODE), *plant())
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


# SDO block transfer of the virtual drive: against the `canopen` library's client, and frame by frame where that is.
# not wrong enough.
NAME = (0x2100, 0)
TEXT = bytes(range(32, 127)) * 2  # 190 bytes, 28 segments


class Server:
    """The SDO server alone, asked frame by frame."""

    def __init__(self, device: Cia402Device, block_size: int = 127) -> None:
        self.device = device
        self.sdo = SdoServer(device.objects, device._write, block_size)

    def ask(self, text: str | bytes, now_ns: int = 0) -> list[bytes]:
        data = bytes.fromhex(text) if isinstance(text, str) else text
        answers = self.sdo.handle(data.ljust(8, b"\0"), now_ns)
        assert all(len(answer) == 8 for answer in answers)
        return answers

    def begin_download(self, size: int | None = None, command: int = 0xC4) -> list[bytes]:
        sized = 0 if size is None else 2
        return self.ask(struct.pack("<BHBI", command | sized, *NAME, size or 0))

    def name(self) -> bytes:
        return self.device.objects.read(*NAME)


def abort_code(answers: list[bytes]) -> int:
    (answer,) = answers
    return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0


def segments(data: bytes) -> list[bytes]:
    parts = [data[i : i + 7] for i in range(0, len(data), 7)]
    return [bytes([n | (0x80 if n == len(parts) else 0)]) + part.ljust(7, b"\0") for n, part in enumerate(parts, 1)]


def end(data: bytes, crc: int | None = None, unused: int | None = None) -> bytes:
    unused = -len(data) % 7 if unused is None else unused
    return struct.pack("<BH5x", 0xC1 | unused << 2, binascii.crc_hqx(data, 0) if crc is None else crc)


def client(device: Cia402Device, lose: Callable[[int, bytes], bool] = lambda identifier, data: False) -> Any:
    return network_node(Network(device, lose), 5e-3).sdo


@pytest.mark.parametrize("size", [1, 6, 7, 8, 190, 256])
@pytest.mark.parametrize("crc", [True, False])
def test_the_library_writes_and_reads_blocks(device: Cia402Device, size: int, crc: bool) -> None:
    sdo = client(device)
    data = (TEXT * 2)[:size]
    with sdo.open(*NAME, "wb", size=size, block_transfer=True, request_crc_support=crc) as stream:
        stream.write(data)
    assert device.objects.read(*NAME) == data
    with sdo.open(*NAME, "rb", block_transfer=True, request_crc_support=crc) as stream:
        assert stream.read() == data


def test_numbers_go_by_block_as_well(device: Cia402Device) -> None:
    sdo = client(device)
    with sdo.open(0x6081, 0, "wb", size=4, block_transfer=True) as stream:
        stream.write(struct.pack("<I", 123_456))
    assert sdo[0x6081].raw == 123_456
    with sdo.open(0x6081, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == struct.pack("<I", 123_456)


def test_a_lost_segment_of_an_upload_is_repeated(device: Cia402Device) -> None:
    device._write(*NAME, TEXT)
    lost = [0]

    def lose(identifier: int, data: bytes) -> bool:
        if identifier == 0x580 + NODE and data[0] == 5 and not lost[0]:
            lost[0] = 1
            return True
        return False

    with client(device, lose).open(*NAME, "rb", block_transfer=True) as stream:
        assert stream.read() == TEXT
    assert lost == [1]


@pytest.mark.parametrize("gone", [1, 3, 28])
def test_a_lost_segment_of_a_download_is_asked_for_again(device: Cia402Device, gone: int) -> None:
    server = Server(device)
    server.begin_download(len(TEXT))
    parts = segments(TEXT)
    got: list[bytes] = []
    for number, part in enumerate(parts, 1):
        if number != gone:
            got += server.ask(part)
    if gone == len(parts):  # nobody knows that it ends: the client's own time-out repeats it
        assert got == []
        got = server.ask(parts[-1])
        assert got[0][:2] == bytes([0xA2, gone])
    else:
        assert got[0][:2] == bytes([0xA2, gone - 1])
        rest = TEXT[7 * (gone - 1) :]
        answers = [server.ask(part) for part in segments(rest)]
        assert answers[-1][0][:2] == bytes([0xA2, len(answers)])
    assert server.ask(end(TEXT)) == [bytes([0xA1]).ljust(8, b"\0")]
    assert server.name() == TEXT


def test_blocks_are_as_long_as_the_server_says(device: Cia402Device) -> None:
    server = Server(device, block_size=4)
    assert server.begin_download(len(TEXT)) == [struct.pack("<BHBB3x", 0xA4, *NAME, 4)]
    parts = [TEXT[i : i + 7] for i in range(0, len(TEXT), 7)]
    for i, part in enumerate(parts):
        last = i + 1 == len(parts)
        answers = server.ask(bytes([(i % 4 + 1) | (0x80 if last else 0)]) + part)
        assert answers == ([bytes([0xA2, 4, 4]).ljust(8, b"\0")] if i % 4 == 3 else [])
    server.ask(end(TEXT))
    assert server.name() == TEXT


def test_an_upload_respects_the_clients_block_size_and_what_it_confirms(device: Cia402Device) -> None:
    device._write(*NAME, TEXT)
    server = Server(device)
    assert server.ask(struct.pack("<BHBB", 0xA4, *NAME, 10)) == [struct.pack("<BHBI", 0xC6, *NAME, len(TEXT))]
    assert [s[0] for s in server.ask("a3")] == list(range(1, 11))
    second = server.ask("a20814")  # 8 of 10 arrived; 20 from now on
    assert [s[0] for s in second] == [*range(1, 20), 20 | 0x80]
    assert second[0][1:] == TEXT[56:63]
    (answer,) = server.ask("a21414")
    assert answer == struct.pack("<BH5x", 0xC1 | 6 << 2, binascii.crc_hqx(TEXT, 0))
    assert server.ask("a1") == []
    assert not server.sdo.busy


def test_short_data_leave_the_block_protocol_below_the_clients_threshold(device: Cia402Device) -> None:
    server = Server(device)
    assert server.ask(struct.pack("<BHBBB", 0xA4, 0x6076, 0, 127, 4))[0][0] == 0x43
    assert server.ask(struct.pack("<BHBBB", 0xA4, 0x6076, 0, 127, 3))[0][0] == 0xC6


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ("segment 0", 0x05040003), ("segment 5 of 4", 0x05040003), ("crc", 0x05040004), ("no crc asked", 0),
        ("no end", 0x05040001), ("size", 0x06070010), ("size, too long", 0x06070012), ("nothing", 0),
    ],
)  # fmt: skip
def test_downloads_that_must_fail(device: Cia402Device, wrong: str, code: int) -> None:
    server = Server(device, block_size=4)
    sizes = {"size": 20, "size, too long": 257}
    answers = server.begin_download(sizes.get(wrong, 14), 0xC0 if wrong == "no crc asked" else 0xC4)
    if wrong == "segment 0":
        answers = server.ask(b"\0elbow_7")
    elif wrong == "segment 5 of 4":
        answers = server.ask(b"\x05elbow_7")
    elif wrong != "size, too long":
        for segment in segments(b"elbow_7elbow_8"):
            server.ask(segment)
        crc = 0x1234 if wrong in ("crc", "no crc asked") else None
        answers = server.ask("a1" if wrong == "no end" else end(b"elbow_7elbow_8", crc))
    assert abort_code(answers) == code
    assert server.name() == (b"joint" if code else b"elbow_7elbow_8")
    assert not server.sdo.busy


@pytest.mark.parametrize(("size", "code"), [(0, 0x05040002), (1, 0), (127, 0), (128, 0x05040002)])
def test_block_size_of_an_upload(device: Cia402Device, size: int, code: int) -> None:
    server = Server(device)
    assert abort_code(server.ask(struct.pack("<BHBB", 0xA4, *NAME, size))) == code
    server.ask(struct.pack("<BHBB", 0xA4, *NAME, 1))
    server.ask("a3")
    assert abort_code(server.ask(bytes([0xA2, 0, size]))[:1]) == code


@pytest.mark.parametrize(("confirmed", "code"), [(1, 0), (2, 0x05040003)])
def test_more_segments_confirmed_than_sent(device: Cia402Device, confirmed: int, code: int) -> None:
    server = Server(device)
    server.ask(struct.pack("<BHBB", 0xA4, *NAME, 127))  # "joint": one segment
    server.ask("a3")
    assert abort_code(server.ask(bytes([0xA2, confirmed, 127]))) == code


@pytest.mark.parametrize("command", ["a3", "a1", "a2", "c1"])
def test_block_commands_outside_a_block(device: Cia402Device, command: str) -> None:
    server = Server(device)
    assert abort_code(server.ask(command)) in (0x05040001, 0x06020000)
    server.ask(struct.pack("<BHBB", 0xA4, *NAME, 127))
    server.ask("a3")
    if command != "a2":
        assert abort_code(server.ask(command)) == 0x05040001


def test_an_abort_by_the_client_ends_a_block_without_a_word(device: Cia402Device) -> None:
    server = Server(device)
    server.begin_download(14)
    assert server.sdo.busy
    assert server.ask(struct.pack("<BHBI", 0x80, *NAME, 0x08000000)) == []
    assert not server.sdo.busy


@pytest.mark.parametrize("begin", ["c4", "a4", "21", "40"])
@pytest.mark.parametrize(("silence_ns", "code"), [(TIMEOUT_NS - 1, 0), (TIMEOUT_NS, 0x05040000)])
def test_a_client_that_falls_silent(device: Cia402Device, begin: str, silence_ns: int, code: int) -> None:
    server = Server(device)
    server.ask(bytes.fromhex(begin) + struct.pack("<HBB", *NAME, 7), now_ns=5)
    answers = server.sdo.expire(5 + silence_ns)
    assert (abort_code(answers) if answers else 0) == code
    if code:
        assert struct.unpack_from("<HB", answers[0], 1) == NAME
    assert server.sdo.busy is (code == 0)
    assert server.sdo.expire(10 * TIMEOUT_NS) == [] or code == 0


def test_the_device_sends_the_abort_of_a_silent_client(device: Cia402Device) -> None:
    device.handle(frame(0x605, struct.pack("<BHB4x", 0x40, *NAME)), 2_000_000)
    assert device.advance(900_000_000) == []
    sent = device.advance(1_100_000_000)
    assert sent == [frame(0x585, struct.pack("<BHBI", 0x80, *NAME, 0x05040000))]
    assert device.advance(3_000_000_000) == []
