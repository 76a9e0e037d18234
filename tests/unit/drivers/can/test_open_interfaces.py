"""Interfaces of python-can without their maker's library, and such as raise anything: one `BusError`."""

from __future__ import annotations

import ctypes
import gc
import logging
from typing import Any

import can
import pytest

from jointctl.drivers.can import open as open_module
from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.errors import BusError

# these open something on any computer
WORKING = {"virtual", "udp_multicast", "jointctl"}


def test_what_an_interface_logs_is_told_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    log = logging.getLogger("can.somewhere")

    def fail(*_: Any, **__: Any) -> None:
        log.warning("Failed to connect")
        raise can.CanInitializationError("Failed to connect")

    monkeypatch.setattr(open_module.can, "Bus", fail)
    with pytest.raises(BusError, match="Failed to connect"):
        open_python_can("kvaser", "0")
    assert not caplog.records
    log.warning("afterwards")
    assert len(caplog.records) == 1


@pytest.mark.filterwarnings("ignore")  # of the libraries, about themselves
@pytest.mark.parametrize("interface", sorted(set(can.VALID_INTERFACES) - WORKING))
def test_an_interface_that_is_not_there_is_one_line(interface: str) -> None:
    with pytest.raises(BusError, match=r"interface|open|device|kernel") as raised:
        open_python_can(interface, "/dev/null/0" if interface in ("slcan", "serial", "robotell") else "0", 500_000)
    gc.collect()  # what a library has left open
    assert "\n" not in raised.value.message


@pytest.mark.parametrize(
    "odd",
    [
        NameError("name 'canOpen' is not defined"), AttributeError("no attribute"), ctypes.ArgumentError("argument 1"),
        KeyError("x"), AssertionError(), IndexError("list index"), RuntimeError("odd\nsecond line"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "start byte"), RecursionError(), ZeroDivisionError(), Exception(),
    ],
    ids=lambda error: type(error).__name__,
)  # fmt: skip
def test_whatever_an_interface_raises(monkeypatch: pytest.MonkeyPatch, odd: Exception) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise odd

    monkeypatch.setattr(open_module.can, "Bus", fail)
    with pytest.raises(BusError, match="cannot open kvaser:0") as raised:
        open_python_can("kvaser", "0")
    assert raised.value.exit_code == 4


def test_what_ends_the_program_is_no_error_of_a_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(open_module.can, "Bus", interrupted)
    with pytest.raises(KeyboardInterrupt):
        open_python_can("kvaser", "0")
