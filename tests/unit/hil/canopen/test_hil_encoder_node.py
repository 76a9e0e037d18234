"""The virtual CiA 406 node, frame by frame and by its EDS."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import canopen
import pytest

from jointctl.drivers.canopen.eds import read_eds
from jointctl.tools.simulation.virtual_joint import new_device
from tests.places import CONFIGS
from tests.two_encoders import NODE, short_run


def frame(identifier: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", identifier, len(data), data)


def words(frames: list[bytes]) -> list[tuple[int, bytes]]:
    return [(struct.unpack_from("<I", f)[0], f[8 : 8 + f[4]]) for f in frames]


@pytest.fixture
def device(tmp_path: Path) -> Any:
    return new_device(short_run(tmp_path, NODE, virtual__initial_position_rad=0.25))


def test_the_eds_is_read_by_the_library_and_is_that_of_an_encoder() -> None:
    dictionary = canopen.import_od(str(CONFIGS / "joint_encoder.eds"), 2)
    assert dictionary[0x1000].default & 0xFFFF == 406
    assert dictionary[0x6004].pdo_mappable
    assert dictionary[0x1800][1].default == 0x40000182


def test_the_eds_needs_no_remark_and_is_not_measured_as_that_of_a_drive() -> None:
    assert read_eds(CONFIGS / "joint_encoder.eds", 2, encoder=True).all_remarks() == []
    assert "[6502]" in "".join(read_eds(CONFIGS / "joint_encoder.eds", 2).all_remarks())


def test_boot_up_heartbeat_and_nmt_of_its_own(device: Any) -> None:
    assert (0x702, b"\0") in words(device.advance(1_000_000))
    sent = device.handle(frame(0x602, struct.pack("<BHBI", 0x2B, 0x1017, 0, 100)), 2_000_000)
    assert (0x702, b"\x7f") in words(sent + device.advance(3_000_000))
    device.handle(frame(0, b"\x01\x02"), 4_000_000)
    assert (0x702, b"\x05") in words(device.advance(110_000_000))
    assert device.device[0].nmt == 127  # the drive was not meant
    device.handle(frame(0, b"\x81\x02"), 111_000_000)
    assert (0x702, b"\0") in words(device.advance(112_000_000))


def test_its_position_at_every_sync(device: Any) -> None:
    device.advance(1_000_000)
    device.handle(frame(0x602, struct.pack("<BHBI", 0x2F, 0x1800, 2, 1)), 2_000_000)
    assert not [f for f in words(device.handle(frame(0x80, b""), 3_000_000)) if f[0] == 0x182]
    device.handle(frame(0, b"\x01\x02"), 4_000_000)
    sent = dict(words(device.handle(frame(0x80, b""), 5_000_000)))
    assert int.from_bytes(sent[0x182], "little") == round(0.25 / math.tau * 524288) + 100_000


def test_an_error_is_an_emergency_and_an_alarm(device: Any) -> None:
    device.advance(1_000_000)
    device.device[0].encoder.error_code = 0x5000
    assert (0x82, b"\x00\x50\x21\0\0\0\0\0") in words(device.advance(2_000_000))
    answer = words(device.handle(frame(0x602, struct.pack("<BHB4x", 0x40, 0x6503, 0)), 3_000_000))[-1]
    assert (answer[0], answer[1][4]) == (0x582, 1)
    device.device[0].encoder.error_code = 0
    assert (0x82, bytes(8)) in words(device.advance(4_000_000))


def test_every_object_of_the_node_can_be_read(device: Any) -> None:
    device.advance(1_000_000)
    for entry in device.encoder.objects:
        request = struct.pack("<BHB4x", 0x40, entry.index, entry.sub)
        answer = words(device.handle(frame(0x602, request), 2_000_000))[-1][1]
        assert answer[0] & 0xE0 == 0x40, f"{entry.index:04X}:{entry.sub}"
