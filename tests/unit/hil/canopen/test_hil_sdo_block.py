"""SDO block transfer of the virtual drive: against the `canopen` library's client, and frame by frame where that is
not wrong enough."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from typing import Any

import canopen
import pytest

from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.canopen.sdo import TIMEOUT_NS, SdoServer
from jointctl.hil.plant.joint import plant
from tests.places import EDS

NODE = 5
NAME = (0x2100, 0)
TEXT = bytes(range(32, 127)) * 2  # 190 bytes, 28 segments


@pytest.fixture
def device() -> Cia402Device:
    made = Cia402Device(EDS, DeviceSettings(node_id=NODE), *plant())
    made.advance(1_000_000)
    return made


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


class Network(canopen.Network):
    """The device as the only other member; `lose` may swallow frames of either way."""

    def __init__(self, device: Cia402Device, lose: Callable[[int, bytes], bool]) -> None:
        super().__init__()
        self.device, self.lose, self.now_ns = device, lose, 1_000_000

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        if self.lose(can_id, bytes(data)):
            return
        self.now_ns += 100_000
        for frame in self.device.handle(struct.pack("<IB3x8s", can_id, len(data), bytes(data)), self.now_ns):
            identifier, size, payload = struct.unpack("<IB3x8s", frame)
            if not self.lose(identifier, payload):
                self.notify(identifier, bytearray(payload[:size]), self.now_ns * 1e-9)


def client(device: Cia402Device, lose: Callable[[int, bytes], bool] = lambda identifier, data: False) -> Any:
    remote = Network(device, lose).add_node(NODE, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = 0.05
    return remote.sdo


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
        ("segment 0", 0x05040003),
        ("segment 5 of 4", 0x05040003),
        ("crc", 0x05040004),
        ("no crc asked", 0),
        ("no end", 0x05040001),
        ("size", 0x06070010),
        ("size, too long", 0x06070012),
        ("nothing", 0),
    ],
)
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


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x2345, 0, b"\0", 0x06020000),
        (0x1018, 9, b"\0", 0x06090011),
        (0x6041, 0, b"\0\0", 0x06010002),
        (0x6087, 0, b"\0\0\0\0", 0x06090032),
        (0x605A, 0, b"\3\0", 0x06090030),
        (0x6040, 0, b"\0", 0x06070013),
        (0x6040, 0, b"\0\0\0", 0x06070012),
        (0x1800, 3, b"\1\0", 0x08000022),
    ],
)
def test_what_an_object_refuses_it_refuses_in_a_block(
    device: Cia402Device, index: int, sub: int, data: bytes, code: int
) -> None:
    with pytest.raises(canopen.SdoAbortedError, match=f"0x{code:08X}"):  # noqa: SIM117
        with client(device).open(index, sub, "wb", size=len(data), block_transfer=True) as stream:
            stream.write(data)


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
    device.handle(struct.pack("<IB3xBHB4x", 0x605, 8, 0x40, *NAME), 2_000_000)
    assert device.advance(900_000_000) == []
    sent = device.advance(1_100_000_000)
    assert sent == [struct.pack("<IB3xBHBI", 0x585, 8, 0x80, *NAME, 0x05040000)]
    assert device.advance(3_000_000_000) == []
