"""Opening a serial or third-party adapter: one program at a time, and every failure in one way."""

from __future__ import annotations

import errno
import gc
import os
import re
import tty
from collections.abc import Iterator
from typing import Any

import can
import pytest

from jointctl.drivers.can.open import normalised, open_python_can
from jointctl.drivers.errors import BusError


def test_unknown_interface_of_python_can() -> None:
    with pytest.raises(BusError, match=r"interface \(='nonsense'\) must be one of .*jointctl.*socketcan"):
        open_python_can("nonsense", "x")


def test_a_serial_adapter_that_is_not_there() -> None:
    with pytest.raises(BusError, match="slcan"):
        open_python_can("slcan", "/dev/ttyJC_none", 1_000_000)


@pytest.mark.parametrize(("interface", "cure"), [("slcan", "sudo usermod -aG dialout $USER"), ("pcan", "group")])
def test_a_missing_right_is_told_with_its_cure(interface: str, cure: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**settings: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(BusError, match="no permission to open") as caught:
        open_python_can(interface, "socket://nowhere")
    assert cure in caught.value.hint


def test_errors_of_an_interface_become_bus_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    causes: list[tuple[Exception, str]] = [
        (PermissionError(errno.EACCES, "Permission denied"), "no permission to open pcan:x"),
        (OSError(errno.ENODEV, "No such device"), "no such device: pcan:x"),
        (OSError(errno.EBUSY, "Busy"), "cannot open pcan:x: Busy"),
        (ImportError("No module named 'x'"), "needs a module"),
        (can.CanInterfaceNotImplementedError("no driver"), "cannot be used here"),
        (can.CanInitializationError("wrong bit rate"), "cannot open pcan:x: wrong bit rate"),
        (ValueError("bad"), "cannot open pcan:x: bad"),
    ]
    for cause, text in causes:

        def fail(cause: Exception = cause, **settings: Any) -> None:
            raise cause

        monkeypatch.setattr(can, "Bus", fail)
        with pytest.raises(BusError, match=text):
            open_python_can("pcan", "x")


@pytest.fixture
def serial_line() -> Iterator[str]:
    """The port of a serial adapter that says nothing."""
    near, far = os.openpty()
    tty.setraw(far)
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_a_serial_adapter_serves_one_program_at_a_time(serial_line: str) -> None:
    first = open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0)
    try:
        with pytest.raises(BusError, match=f"the adapter on {serial_line} is in use by another program") as caught:
            open_python_can("slcan", f"{serial_line}@115200", 500_000)
        assert "jointctl stop" in (caught.value.hint or "")
        open_python_can("slcan", serial_line, 500_000, exclusive=False, sleep_after_open=0.0).shutdown()
    finally:
        first.shutdown()
    open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0).shutdown()


def test_a_damaged_line_of_an_adapter_is_a_lost_frame() -> None:
    """Two programs on one adapter cut into each other's lines; ValueError ended whoever made the joint safe."""
    near, far = os.openpty()
    tty.setraw(far)
    bus = open_python_can("slcan", os.ttyname(far), 500_000, sleep_after_open=0.0)
    try:
        for line in (b"t1812AAtBB\r", b"t1\r", b"txyz2AABB\r", b"t18129\xff\r"):
            os.write(near, line)
            assert bus.recv(0.5) is None
        os.write(near, b"t1812AABB\r")
        message = bus.recv(0.5)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\xaa\xbb")
    finally:
        bus.shutdown()
        os.close(near)
        os.close(far)


class Odd:
    """A bus whose driver raises what it likes."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise self.error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "text", "code"),
    [
        (OSError(19, "No such device"), "failed: [Errno 19] No such device", 19),
        (RuntimeError(), "failed: RuntimeError", None),
        (can.CanOperationError("full", 105), "full", 105),
    ],
)
def test_a_third_party_bus_fails_in_one_way(error: Exception, text: str, code: int | None) -> None:
    bus = normalised(Odd(error))  # type: ignore[arg-type]
    for call in (lambda: bus.send(can.Message()), lambda: bus.recv(0.0)):
        with pytest.raises(can.CanOperationError, match=re.escape(text)) as caught:
            call()
        assert caught.value.error_code == code


def test_an_adapter_that_is_refused_leaves_the_port_free(serial_line: str) -> None:
    with pytest.raises(BusError, match="Invalid bitrate"):
        open_python_can("slcan", serial_line, 444_444, sleep_after_open=0.0)
    gc.collect()
    open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0).shutdown()
