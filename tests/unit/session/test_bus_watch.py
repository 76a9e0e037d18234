"""What a sick SocketCAN interface adds to a run: its complaints as they come, its state as the cause of a fault."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from jointctl.drivers.can.socketcan import BUS_OFF, CONTROLLER, LinkState
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.session import bus_watch as module
from jointctl.tools.session.bus_watch import BusWatch, bus_watch
from jointctl.tools.session.fault_words import fault_text

TEXT = fault_text(Fault.STALE_SAMPLE, 5.0, 0)


@pytest.fixture
def config() -> Config:
    config = load_config(shipped_config("virtual"))
    bus = config.bus.model_copy(update={"interface": "socketcan", "channel": "can0"})
    return config.model_copy(update={"bus": bus})


@pytest.fixture
def ends() -> Iterator[Any]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    near.setblocking(False)
    yield near, far
    near.close()
    far.close()


def error_frame(identifier: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", identifier | 0x20000000, 8, data)


def test_each_trouble_is_told_once(config: Config, ends: Any) -> None:
    near, far = ends
    watch = BusWatch(config, near)
    assert watch.news() == []
    for _ in range(3):
        far.send(error_frame(CONTROLLER, b"\0\x20\0\0\0\0\x80\0"))
    far.send(error_frame(CONTROLLER, b"\0\x08"))  # a warning is no trouble
    (news,) = watch.news()
    assert "can0: error passive (transmit); transmit errors 128" in news
    assert "power of the drive" in news
    far.send(error_frame(BUS_OFF, b""))
    assert "bus-off" in watch.news()[0]
    far.close()
    assert watch.news() == []


def link(**changes: Any) -> LinkState:
    values = {
        "name": "can0", "kind": "can", "up": True, "state": "ERROR-ACTIVE", "transmit_errors": 0, "receive_errors": 0,
        "bitrate_bitps": 1_000_000, "queue_frames": 10, "counts": {},
    }  # fmt: skip
    return LinkState(**{**values, **changes})


@pytest.mark.parametrize(
    ("state", "code", "cause"),
    [
        (link(up=False), 0, "can0 is down"),
        (link(state="BUS-OFF"), 0, "bus-off"),
        (link(), errno.ENOBUFS, "queue of can0 is full"),
        (link(), 0, TEXT.cause),
        (None, errno.ENODEV, "has gone"),
        (None, 0, TEXT.cause),
    ],
)
def test_the_cause_of_a_fault(
    config: Config, ends: Any, state: LinkState | None, code: int, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "link_state", lambda channel: state)
    found = BusWatch(config, ends[0]).explained(Fault.STALE_SAMPLE, TEXT, code)
    assert found is not None
    assert cause in found.cause
    assert found.happened == TEXT.happened


def test_other_faults_keep_their_own_cause_beside_it_and_other_buses_their_text(
    config: Config, ends: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "link_state", lambda channel: link(up=False))
    text = fault_text(Fault.POSITION_LIMIT, 1.0, 0)
    found = BusWatch(config, ends[0]).explained(Fault.POSITION_LIMIT, text, 0)
    assert found is not None
    assert "can0 is down" in found.cause
    assert text.cause in found.cause
    monkeypatch.setattr(module, "link_state", lambda channel: link())
    assert BusWatch(config, ends[0]).explained(Fault.POSITION_LIMIT, text, 0) == text
    assert BusWatch(config, None).explained(Fault.STALE_SAMPLE, TEXT, errno.ENOBUFS) is TEXT
    assert BusWatch(config, ends[0]).explained(Fault.NONE, None, 0) is None


def test_an_interface_that_does_not_exist_is_told_by_the_drive(config: Config) -> None:
    with bus_watch(config) as watch:
        assert watch.news() == []
