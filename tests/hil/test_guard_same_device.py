"""A guard that tries on after a run: the port's name may belong to another adapter by then."""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports

from jointctl.drivers.elmo.dialogue import usb_serial_number
from jointctl.tools.session.elmo_guard import LineGuard
from tests.hil.serial_bench import guard_order


@dataclass
class Told:
    """What the system tells of one port."""

    device: str
    serial_number: str | None


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> list[Told]:
    found: list[Told] = []
    monkeypatch.setattr(list_ports, "comports", lambda: list(found))
    return found


def test_the_serial_number_is_that_of_the_port_behind_a_link(ports: list[Told], tmp_path: Path) -> None:
    (tmp_path / "ttyUSB7").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB7")
    ports += [Told("/dev/ttyS0", None), Told(str(tmp_path / "ttyUSB7"), "A1")]
    assert usb_serial_number(str(tmp_path / "by-id")) == "A1"
    assert usb_serial_number("/dev/ttyS0") is None
    assert usb_serial_number("/dev/pts/99") is None
    ports[1].serial_number = ""
    assert usb_serial_number(str(tmp_path / "by-id")) is None


@pytest.mark.parametrize(
    ("known", "found", "told"), [("A1", "A1", True), ("A1", "B2", False), ("A1", None, True), (None, "B2", True)]
)
def test_only_another_adapter_is_left_alone(
    serial_bench: Any, ports: list[Told], known: str | None, found: str | None, told: bool
) -> None:
    device = serial_bench.device
    ports.append(Told(device.path, found))
    device.interpreter.execute(b"MO=1")
    alive = os.pidfd_open(os.getpid())
    ours, theirs = socket.socketpair()
    with ours, tempfile.TemporaryFile() as block:
        block.truncate(8 * 8)
        order = guard_order(device.path, theirs.detach(), block.fileno(), alive, usb_serial_number=known)
        guard = LineGuard(order)
        guard._close_tty()
        guard._tty = os.open(os.devnull, os.O_RDWR)  # what it says on the old one reaches nobody
        ours.sendall(json.dumps({"state": "unknown: gone"}).encode() + b"\n")
        watch = threading.Thread(target=guard.run, daemon=True)
        watch.start()
        if not told:
            watch.join(1.5)
            assert watch.is_alive()
            assert device.interpreter.m.motor_on
            ports[0].serial_number = known  # the right one again
        watch.join(20.0)
        assert not watch.is_alive()
        assert not device.interpreter.m.motor_on
        for end in (guard._control, guard._server):  # a process of its own leaves them to the system
            if end is not None:
                end.close()
    os.close(alive)
