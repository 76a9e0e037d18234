"""Opening a SocketCAN interface: every failure is a BusError that says what to do."""

from __future__ import annotations

import errno
import os
import socket
from typing import Any

import pytest

from jointctl.drivers.can import socketcan
from jointctl.drivers.can.open import open_cyclic_end
from jointctl.drivers.errors import BusError


class FakeCanSocket:
    """Stands for an AF_CAN socket of a kernel that has them."""

    bind_error: int | None = None
    pending_error = 0

    def __init__(self, *arguments: Any) -> None:
        self.options: dict[tuple[int, int], Any] = {}
        self.closed = False
        FakeCanSocket.last = self

    def setsockopt(self, level: int, name: int, value: Any) -> None:
        self.options[level, name] = value

    def getsockopt(self, level: int, name: int) -> int:
        assert (level, name) == (socket.SOL_SOCKET, socket.SO_ERROR)
        return self.pending_error

    def bind(self, address: tuple[str]) -> None:
        if self.bind_error is not None:
            raise OSError(self.bind_error, os.strerror(self.bind_error))

    def setblocking(self, blocking: bool) -> None:
        self.blocking = blocking

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def kernel_with_can(monkeypatch: pytest.MonkeyPatch) -> type[FakeCanSocket]:
    class Fake(FakeCanSocket):
        pass

    monkeypatch.setattr(socketcan.socket, "socket", Fake)
    return Fake


def test_kernel_without_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socketcan.socket, "socket", refuse)
    with pytest.raises(BusError, match="no SocketCAN") as caught:
        socketcan.open_socket("can0")
    assert caught.value.hint == "sudo modprobe can_raw"


def test_an_interface_that_does_not_exist_on_this_computer() -> None:
    with pytest.raises(BusError) as caught:
        open_cyclic_end("socketcan", "jc_none0")
    assert caught.value.hint


@pytest.mark.parametrize("number", [errno.ENODEV, errno.ENETDOWN])
def test_missing_or_down(kernel_with_can: Any, number: int) -> None:
    kernel_with_can.bind_error = number
    with pytest.raises(BusError, match="can0") as caught:
        socketcan.open_socket("can0")
    assert "sudo ip link set can0 up type can bitrate 1000000" in caught.value.hint
    assert FakeCanSocket.last.closed


def test_down_is_also_told_after_the_bind(kernel_with_can: Any) -> None:
    kernel_with_can.pending_error = errno.ENETDOWN
    with pytest.raises(BusError, match="can0 is down"):
        socketcan.open_socket("can0")


def test_no_permission(kernel_with_can: Any) -> None:
    kernel_with_can.bind_error = errno.EPERM
    with pytest.raises(BusError, match="no permission"):
        socketcan.open_socket("can0")


def test_the_options_of_a_good_socket(kernel_with_can: Any) -> None:
    end: Any = socketcan.open_socket("can0")
    assert not end.closed
    assert end.blocking is False
    assert end.options[101, 2] == b"\xff\xff\xff\x1f"  # CAN_RAW_ERR_FILTER: all errors
    assert end.options[101, 4] == 0  # CAN_RAW_RECV_OWN_MSGS
    assert end.options[socket.SOL_SOCKET, socket.SO_RCVBUF] >= 1 << 20


@pytest.mark.parametrize("channel", ["", "a" * 16, "can/0", "can 0"])
def test_names_that_no_interface_has(channel: str) -> None:
    with pytest.raises(BusError, match="CAN interface"):
        socketcan.open_socket(channel)
