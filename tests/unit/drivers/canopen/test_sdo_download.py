"""Downloads over SDO: the frames of each length, and what is sent after a transfer has failed: nothing."""

from __future__ import annotations

import gc
import struct
from typing import Any

import pytest
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.canopen.sdo import download
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.plant.joint import plant
from tests.places import EDS
from tests.virtual_drive import NODE, Network

NAME = 0x2100  # a text of the virtual drive that can be written
REFUSED = 0x06010002


class Recording(Network):
    """Also keeps the requests; the answer to request number `fail_at` is lost, or an abort with `REFUSED`."""

    def __init__(self, fail_at: int = -1, *, silent: bool = False) -> None:
        super().__init__(Cia402Device(EDS, DeviceSettings(node_id=NODE), *plant()))
        self.requests: list[bytes] = []
        self.fail_at, self.silent = fail_at, silent

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self.requests.append(bytes(data))
        if len(self.requests) - 1 != self.fail_at:
            super().send_message(can_id, data, remote)
        elif not self.silent:
            self.notify(0x580 + NODE, bytearray(struct.pack("<BHBI", 0x80, NAME, 0, REFUSED)), 0.0)


def node_of(network: Network) -> Any:
    remote = network.add_node(NODE, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = 0.05
    network.run(1)
    return remote


@pytest.mark.parametrize("length", [5, 6, 7, 8, 13, 14, 15, 30])
def test_a_text_arrives_in_segments_of_seven_bytes(length: int) -> None:
    network = Recording()
    node, text = node_of(network), bytes(range(65, 65 + length))
    download(node.sdo, NAME, 0, text)
    assert len(network.requests) == 1 + -(-length // 7)
    assert network.requests[0] == struct.pack("<BHBI", 0x21, NAME, 0, length)
    assert [request[0] & 1 for request in network.requests[1:]] == [0] * (len(network.requests) - 2) + [1]
    assert node.sdo.upload(NAME, 0) == text


def test_no_bytes_at_all_are_one_empty_segment() -> None:
    network = Recording()
    node = node_of(network)
    download(node.sdo, NAME, 0, b"elbow")
    network.requests.clear()
    download(node.sdo, NAME, 0, b"")
    assert [request[0] for request in network.requests] == [0x21, 0x0F]
    assert node.sdo.upload(NAME, 0) == b""


@pytest.mark.parametrize(("index", "data"), [(0x6060, b"\x0a"), (0x6007, b"\3\0"), (0x6087, b"\x14\0\0\0")])
def test_up_to_four_bytes_are_one_frame(index: int, data: bytes) -> None:
    network = Recording()
    node = node_of(network)
    download(node.sdo, index, 0, data)
    assert len(network.requests) == 1
    assert node.sdo.upload(index, 0) == data


@pytest.mark.parametrize("fail_at", [0, 1, 2, 3])
def test_after_a_refusal_nothing_is_sent_and_its_own_code_is_told(fail_at: int) -> None:
    network = Recording(fail_at)
    node = node_of(network)
    with pytest.raises(SdoAbortedError) as refusal:
        download(node.sdo, NAME, 0, b"elbow of the left arm")
    assert refusal.value.code == REFUSED
    del refusal
    gc.collect()
    assert len(network.requests) == fail_at + 1


def test_a_refused_empty_segment_is_told_once() -> None:
    network = Recording(1)
    node = node_of(network)
    with pytest.raises(SdoAbortedError):
        download(node.sdo, NAME, 0, b"")
    gc.collect()
    assert len(network.requests) == 2


@pytest.mark.parametrize(
    ("fail_at", "data"), [(0, b"\x0a"), (0, b"elbow joint"), (1, b"elbow joint"), (2, b"elbow joint")]
)
def test_without_an_answer_the_transfer_is_aborted_and_nothing_follows(fail_at: int, data: bytes) -> None:
    network = Recording(fail_at, silent=True)
    node = node_of(network)
    with pytest.raises(SdoCommunicationError, match="No SDO response"):
        download(node.sdo, NAME, 0, data)
    gc.collect()
    assert network.requests[fail_at + 1 :] == [struct.pack("<BHBI", 0x80, 0, 0, 0x05040000)]
