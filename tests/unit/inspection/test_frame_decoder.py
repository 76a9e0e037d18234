"""CANopen frames in words: every kind, PDOs by their mapping, SDO transfers, malformed frames."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path
from typing import Any

import can
import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.inspection.frame_decoder import Decoded, FrameDecoder, PdoMaps, sent_by_loop
from jointctl.tools.inspection.objects import Objects, control_text, read_dictionary

EDS = shipped_config("virtual").with_name("virtual_joint.eds")


def frame(cob_id: int, data: bytes = b"", **options: Any) -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False, **options)


@pytest.fixture
def decoder() -> FrameDecoder:
    """Without any EDS."""
    return FrameDecoder({}, PdoMaps())


@pytest.mark.parametrize(
    ("cob_id", "data", "kind", "node", "text"),
    [
        (0x000, b"\x01\x05", "nmt", 5, "start (operational), node 5"),
        (0x000, b"\x80\x00", "nmt", 0, "enter pre-operational, all nodes"), (0x000, b"\x01", "nmt", 0, "malformed"),
        (0x080, b"", "sync", 0, "SYNC"), (0x080, b"\x07", "sync", 0, "SYNC 7"), (0x100, bytes(6), "time", 0, "TIME"),
        (0x705, b"\x00", "heartbeat", 5, "boot-up"), (0x705, b"\x05", "heartbeat", 5, "operational"),
        (0x705, b"\x7f", "heartbeat", 5, "pre-operational"), (0x705, b"", "heartbeat", 5, "malformed: "),
        (0x7E5, b"\x04\x01" + bytes(6), "lss", 0, "LSS request 04h"), (0x7FF, b"", "other", 0, ""),
        (0x680, b"", "other", 0, ""),
    ],
)  # fmt: skip
def test_services(decoder: FrameDecoder, cob_id: int, data: bytes, kind: str, node: int, text: str) -> None:
    found = decoder.decode(frame(cob_id, data))
    assert (found.kind, found.node, found.text) == (kind, node, text)


def test_an_emergency_is_told_by_name(decoder: FrameDecoder) -> None:
    found = decoder.decode(frame(0x085, b"\x30\x81\x11\xaa\0\0\0\0"))
    assert (found.kind, found.node) == ("emcy", 5)
    assert found.text == (
        "8130h, heartbeat lost; error register 11h generic, communication; maker's data aa 00 00 00 00"
    )
    assert found.fields == {"code": 0x8130, "error_register": 0x11}
    assert "error reset" in decoder.decode(frame(0x085, bytes(8))).text
    assert decoder.decode(frame(0x085, b"\x30")).fields == {"malformed": True}


def test_other_frames(decoder: FrameDecoder) -> None:
    extended = can.Message(arbitration_id=0x181, is_extended_id=True, data=bytes(8))
    assert decoder.decode(extended) == Decoded("other", 0, "extended identifier")
    assert decoder.decode(frame(0x705, is_remote_frame=True)).text == "node guarding request"
    error = decoder.decode(can.Message(is_error_frame=True, arbitration_id=0x04, data=b"\0\x20\0\0\0\0\x80\0"))
    assert (error.kind, error.text) == ("error", "error passive (transmit); transmit errors 128, receive errors 0")


def status(word: int, position: int = -2, torque: int = -300) -> bytes:
    return struct.pack("<Hih", word, position, torque)


def test_a_pdo_of_unknown_mapping_is_told_raw(decoder: FrameDecoder) -> None:
    found = decoder.decode(frame(0x385, b"\x01\x02"))
    assert (found.kind, found.node, found.text) == ("pdo", 5, "TPDO3 01 02")
    assert decoder.decode(frame(0x205, b"\x0f\x00")).text == "RPDO1 0f 00"


def test_the_mapping_of_the_configuration() -> None:
    maps = PdoMaps()
    maps.learn_loop(5)
    decoder = FrameDecoder({}, maps)
    found = decoder.decode(frame(0x185, status(0x0237)))
    assert found.text == (
        "TPDO1 Statusword 0237h operation enabled, Position actual value -2, Torque actual value -300"
    )
    assert found.fields["values"] == {"6041": 0x0237, "6064": -2, "6077": -300}
    assert decoder.decode(frame(0x205, struct.pack("<Hh", 0x0F, -7))).text == (
        "RPDO1 Controlword 000Fh enable operation, Target torque -7"
    )
    settings = canopen_settings(load_config(shipped_config("csp")))
    maps.learn_loop(5, sent_by_loop(settings))
    assert decoder.decode(frame(0x205, struct.pack("<Hih", 0x0F, -7, 9))).text.endswith(
        "Target position -7, Torque offset 9"
    )
    assert decoder.decode(frame(0x305, struct.pack("<i", -8))).text == "RPDO2 Velocity offset -8"
    maps.learn_loop(5, sent_by_loop(dataclasses.replace(settings, mode="csv", velocity_offset=False)))
    assert "Target velocity -7" in decoder.decode(frame(0x205, struct.pack("<Hih", 0x0F, -7, 9))).text


@pytest.mark.parametrize(("length", "malformed"), [(8, False), (7, True), (2, True)])
def test_a_short_pdo_is_told(length: int, malformed: bool) -> None:
    maps = PdoMaps()
    maps.learn_loop(5)
    found = FrameDecoder({}, maps).decode(frame(0x185, status(0x0237)[:length]))
    assert ("too short" in found.text) == malformed == found.fields.get("malformed", False)


def test_the_mapping_of_the_eds() -> None:
    maps = PdoMaps()
    dictionary = read_dictionary(EDS, 3)
    maps.learn_from_eds(dictionary, 3)
    decoder = FrameDecoder({3: Objects(dictionary)}, maps)
    assert decoder.decode(frame(0x183, b"\x50\x02")).text == "TPDO1 Statusword 0250h switch on disabled"
    assert maps.of(3, True, 2).enabled is False
    assert [entry[0] for entry in maps.of(3, True, 2).entries] == [0x6041, 0x6064, 0x6077]


def sdo_write(index: int, sub: int, value: int, size: int) -> bytes:
    return struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value)


def test_a_mapping_that_is_overheard(decoder: FrameDecoder) -> None:
    """What another master writes over SDO decides how later PDOs are read, once the node has confirmed it."""
    for index, sub, value, size in (
        (0x1801, 1, 0x80000000 | 0x1A5, 4), (0x1801, 2, 1, 1), (0x1A01, 0, 0, 1),
        (0x1A01, 1, 0x606C0020, 4), (0x1A01, 0, 1, 1), (0x1801, 1, 0x1A5, 4),
    ):  # fmt: skip
        decoder.decode(frame(0x605, sdo_write(index, sub, value, size)))
        decoder.decode(frame(0x585, struct.pack("<BHB4x", 0x60, index, sub)))
    assert decoder.decode(frame(0x1A5, struct.pack("<i", -9))).text == "TPDO2 Velocity actual value -9"
    decoder.decode(frame(0x605, sdo_write(0x1A01, 1, 0x60640020, 4)))
    decoder.decode(frame(0x585, struct.pack("<BHBI", 0x80, 0x1A01, 1, 0x08000022)))  # refused: nothing changes
    assert "Velocity" in decoder.decode(frame(0x1A5, struct.pack("<i", -9))).text


class TestSdo:
    def text(self, decoder: FrameDecoder, cob_id: int, data: bytes) -> str:
        found = decoder.decode(frame(cob_id, data))
        assert (found.kind, found.node) == ("sdo", 5)
        return found.text

    def test_expedited(self, decoder: FrameDecoder) -> None:
        assert self.text(decoder, 0x605, b"\x40\x41\x60\0\0\0\0\0") == "> read 6041 Statusword"
        answer = struct.pack("<BHBI", 0x4B, 0x6041, 0, 0x0250)
        assert self.text(decoder, 0x585, answer) == "< 6041 Statusword = 0250h switch on disabled"
        assert self.text(decoder, 0x605, sdo_write(0x6060, 0, 10, 1)) == (
            "> write 6060 Modes of operation = 10 cyclic synchronous torque (CST)"
        )
        assert self.text(decoder, 0x585, b"\x60\x60\x60\0\0\0\0\0") == "< written 6060 Modes of operation"

    def test_aborts_in_words(self, decoder: FrameDecoder) -> None:
        abort = struct.pack("<BHBI", 0x80, 0x2345, 1, 0x06020000)
        found = decoder.decode(frame(0x585, abort))
        assert found.text == "< abort 2345:1: 06020000h Object does not exist"
        assert found.fields == {"object": "2345:1", "abort_code": 0x06020000}
        unknown = struct.pack("<BHBI", 0x80, 0x2345, 1, 0x12345678)
        assert "not in the standard" in self.text(decoder, 0x585, unknown)

    def test_segments(self, decoder: FrameDecoder) -> None:
        assert self.text(decoder, 0x605, b"\x40\x08\x10\0\0\0\0\0").startswith("> read 1008")
        assert "9 bytes in segments" in self.text(decoder, 0x585, b"\x41\x08\x10\0\x09\0\0\0")
        assert self.text(decoder, 0x605, b"\x60" + bytes(7)) == "> read next segment"
        assert self.text(decoder, 0x585, b"\x00a drive") == "< segment of 7 bytes"
        assert self.text(decoder, 0x605, b"\x70" + bytes(7)) == "> read next segment"
        assert self.text(decoder, 0x585, b"\x1b 2\0\0\0\0\0").endswith('Manufacturer device name = "a drive 2"')

    def test_malformed(self, decoder: FrameDecoder) -> None:
        assert "malformed" in self.text(decoder, 0x605, b"\x40")
        assert "unknown command" in self.text(decoder, 0x605, b"\xe0" + bytes(7))
        assert self.text(decoder, 0x585, b"\x00" + bytes(7)) == "< segment of 7 bytes"  # of a transfer not seen

    def test_names_come_from_the_eds(self) -> None:
        decoder = FrameDecoder({5: Objects(read_dictionary(EDS, 5))}, PdoMaps())
        assert self.text(decoder, 0x605, b"\x40\x02\x21\0\0\0\0\0").removeprefix("> read 2102 ")


@pytest.mark.parametrize(
    ("word", "text"),
    [(0x0000, "disable voltage"), (0x0006, "shutdown"), (0x0007, "switch on"), (0x000F, "enable operation"),
     (0x0002, "quick stop"), (0x0080, "fault reset"), (0x010F, "enable operation, halt")],
)  # fmt: skip
def test_controlwords(word: int, text: str) -> None:
    assert control_text(word) == f"{word:04X}h {text}"


def test_any_bytes_are_decoded_without_an_exception(decoder: FrameDecoder) -> None:
    for cob_id in range(0x800):
        for length in range(9):
            for value in (0x00, 0x23, 0x41, 0x80, 0xC0, 0xFF):
                assert decoder.decode(frame(cob_id, bytes([value] * length))).kind


def test_an_unreadable_eds(tmp_path: Path) -> None:
    (tmp_path / "bad.eds").write_text("[FileInfo]\n")
    with pytest.raises(ConfigurationError, match=r"bad\.eds.* is not a readable EDS"):
        read_dictionary(tmp_path / "bad.eds", 1)
