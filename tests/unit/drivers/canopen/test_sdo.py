"""SDO: the frames of each length, what follows a time-out, and whatever a drive may answer."""

from __future__ import annotations

import gc
import queue
import struct
from collections.abc import Callable
from typing import Any

import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.sdo import ATTEMPTS, ObjectAccess, download
from jointctl.drivers.errors import DeviceError, NoDeviceError
from tests.virtual_drive import NODE, Network, network_node, virtual_drive

# --- Downloads over SDO: the frames of each length, and what is sent after a transfer has failed: nothing ---
NAME = 0x2100  # a text of the virtual drive that can be written
REFUSED = 0x06010002


class Recording(Network):
    """Also keeps the requests; the answer to request number `fail_at` is lost, or an abort with `REFUSED`."""

    def __init__(self, fail_at: int = -1, *, silent: bool = False) -> None:
        super().__init__(virtual_drive())
        self.requests: list[bytes] = []
        self.fail_at, self.silent = fail_at, silent

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self.requests.append(bytes(data))
        if len(self.requests) - 1 != self.fail_at:
            super().send_message(can_id, data, remote)
        elif not self.silent:
            self.notify(0x580 + NODE, bytearray(struct.pack("<BHBI", 0x80, NAME, 0, REFUSED)), 0.0)


@pytest.mark.parametrize("length", [0, 5, 6, 7, 8, 13, 14, 15, 30])
def test_a_text_arrives_in_segments_of_seven_bytes(length: int) -> None:
    network = Recording()
    node, text = network_node(network, 1e-3), bytes(range(65, 65 + length))
    download(node.sdo, NAME, 0, text)
    segments = max(-(-length // 7), 1)
    assert network.requests[0] == struct.pack("<BHBI", 0x21, NAME, 0, length)
    assert [request[0] & 1 for request in network.requests[1:]] == [0] * (segments - 1) + [1]
    assert node.sdo.upload(NAME, 0) == text


@pytest.mark.parametrize(("index", "data"), [(0x6060, b"\x0a"), (0x6007, b"\3\0"), (0x6087, b"\x14\0\0\0")])
def test_up_to_four_bytes_are_one_frame(index: int, data: bytes) -> None:
    network = Recording()
    node = network_node(network, 1e-3)
    download(node.sdo, index, 0, data)
    assert len(network.requests) == 1
    assert node.sdo.upload(index, 0) == data


@pytest.mark.parametrize(
    ("fail_at", "data"),
    [(0, b"\x0a"), *((k, b"elbow of the left arm") for k in range(4)), (1, b"")],
)
@pytest.mark.parametrize("silent", [False, True])
def test_nothing_is_sent_after_a_refusal_and_only_an_abort_without_an_answer(
    fail_at: int, data: bytes, silent: bool
) -> None:
    network = Recording(fail_at, silent=silent)
    node = network_node(network, 1e-3)
    with pytest.raises(SdoCommunicationError if silent else SdoAbortedError) as failure:
        download(node.sdo, NAME, 0, data)
    if silent:
        assert "No SDO response" in str(failure.value)
    else:
        assert failure.value.code == REFUSED
    del failure
    gc.collect()
    assert network.requests[fail_at + 1 :] == [struct.pack("<BHBI", 0x80, 0, 0, 0x05040000)] * silent


# Whatever a drive answers to an SDO request: a number of the object's type, or one error of the driver's own kind.
quick = settings(max_examples=300)
OBJECTS = ((0x6041, 0), (0x6064, 0), (0x1000, 0), (0x1018, 1), (0x6060, 0), (0x6077, 0))


def multiplexed(command: int, place: tuple[int, int], data: bytes) -> bytes:
    return bytes([command]) + place[0].to_bytes(2, "little") + bytes([place[1]]) + data


# what belongs to the request, what nearly does, and noise of any length
replies = st.one_of(
    st.builds(
        multiplexed,
        st.sampled_from([0x40, 0x41, 0x42, 0x43, 0x47, 0x4B, 0x4F, 0x60, 0x80, 0xC2]),
        st.sampled_from(OBJECTS),
        st.binary(min_size=4, max_size=4),
    ),
    st.builds(
        lambda command, data: bytes([command]) + data,
        st.sampled_from([0x00, 0x01, 0x0D, 0x10, 0x1D, 0x20, 0x30]),
        st.binary(min_size=7, max_size=7),
    ),
    st.binary(min_size=0, max_size=8),
)


class Wire:
    """In the place of the network: each request gets the next replies; then there is silence."""

    def __init__(self, answers: list[list[bytes]]) -> None:
        self.answers, self.sdo = list(answers), None

    def send_message(self, _identifier: int, _data: bytes, _remote: bool = False) -> None:
        sdo: Any = self.sdo
        for reply in self.answers.pop(0) if self.answers else []:
            sdo.on_response(0x581, bytearray(reply), 0.0)


@pytest.fixture
def access(
    settings_of_virtual_joint: Any, monkeypatch: pytest.MonkeyPatch
) -> Callable[[list[list[bytes]]], ObjectAccess]:
    monkeypatch.setattr("jointctl.drivers.canopen.sdo.COLLISION_PAUSE_S", 0.0)
    eds = read_eds(settings_of_virtual_joint.eds_path, 1)
    node = canopen.RemoteNode(1, eds.dictionary)

    def build(answers: list[list[bytes]]) -> ObjectAccess:
        wire: Any = Wire(answers)
        wire.sdo = node.sdo
        node.sdo.network, node.sdo.RESPONSE_TIMEOUT, node.sdo.responses = wire, 1e-4, queue.Queue()
        return ObjectAccess(node, eds.name)

    return build


def attempt(call: Callable[[], int]) -> tuple[str, int]:
    """(message of the driver's error in one line, or empty; value)."""
    try:
        return "", call()
    except (DeviceError, NoDeviceError) as error:
        message = error.message
    assert message
    assert "\n" not in message
    return message, 0


@quick
@given(answers=st.lists(st.lists(replies, max_size=2), max_size=8), place=st.sampled_from(OBJECTS))
def test_any_sdo_replies_to_a_read(
    access: Callable[[list[list[bytes]]], ObjectAccess], answers: list[list[bytes]], place: tuple[int, int]
) -> None:
    objects = access(answers)
    bits = len(objects._variable(*place))
    message, value = attempt(lambda: objects.read(*place, what="fuzzed"))
    if message:
        assert f"{place[0]:04X}" in message
    else:
        assert -(1 << (bits - 1)) <= value < 1 << bits


@quick
@given(answers=st.lists(st.lists(replies, max_size=2), max_size=8), value=st.integers(-128, 127))
def test_any_sdo_replies_to_a_verified_write(
    access: Callable[[list[list[bytes]]], ObjectAccess], answers: list[list[bytes]], value: int
) -> None:
    objects = access(answers)
    message, found = attempt(lambda: objects.write_verified(0x6060, 0, value, what="fuzzed"))
    assert "6060" in message if message else found == value


def test_its_twin_the_right_reply_is_taken(access: Callable[[list[list[bytes]]], ObjectAccess]) -> None:
    right = multiplexed(0x4B, (0x6041, 0), b"\x37\x12\0\0")
    assert access([[right]]).read(0x6041, what="statusword") == 0x1237
    silent: list[list[bytes]] = [[]] * (2 * (ATTEMPTS - 1))  # each attempt that fails also sends an abort
    assert access([*silent, [right]]).read(0x6041, what="statusword") == 0x1237
    with pytest.raises(NoDeviceError, match="no answer in 3 attempts"):
        access([*silent, [], [], [right]]).read(0x6041, what="statusword")
