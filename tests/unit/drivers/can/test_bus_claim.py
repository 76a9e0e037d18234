"""One controller for each bus of this computer: the second is told who the first is, and a dead one leaves nothing."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

from drivers.can.bus_claim import BusClaim, bus_address
from drivers.errors import BusError

CLAIM = """
import sys, time
from drivers.can.bus_claim import BusClaim
claim = BusClaim(*sys.argv[1:])
print("mine", flush=True)
time.sleep(60)
"""


@pytest.fixture
def channel() -> str:
    """A name that no other test has."""
    return f"claimed-{os.getpid()}"


def test_the_second_is_told_who_has_the_bus(channel: str) -> None:
    command = [sys.executable, "-c", CLAIM, "socketcan", channel]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        try:
            said: IO[str] | None = first.stdout
            assert said is not None
            assert said.readline() == "mine\n"
            for _ in range(3):
                with pytest.raises(BusError, match=rf"controls socketcan:{channel} \(.*, pid {first.pid}\)"):
                    BusClaim("socketcan", channel)
            first.send_signal(signal.SIGKILL)
            first.wait()
            BusClaim("socketcan", channel).close()
        finally:
            first.kill()


def test_a_bus_is_free_again_after_its_controller(channel: str) -> None:
    claim = BusClaim("socketcan", channel)
    claim.close()
    claim.close()
    with BusClaim("socketcan", channel), pytest.raises(BusError):
        BusClaim("socketcan", channel)
    BusClaim("socketcan", channel).close()


def test_other_buses_are_others(channel: str) -> None:
    with BusClaim("socketcan", channel), BusClaim("socketcan", f"{channel}2"), BusClaim("pcan", channel):
        pass


def test_links_lead_to_the_same_bus(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "adapter").symlink_to("ttyACM0")
    device, link = str(tmp_path / "ttyACM0"), str(tmp_path / "adapter")
    assert bus_address("slcan", f"{link}@115200") == bus_address("slcan", device)
    assert bus_address("jointctl", link) == bus_address("jointctl", device)
    assert bus_address("seeedstudio", link) == bus_address("seeedstudio", device) != bus_address("slcan", device)


def test_a_bus_of_the_same_name_behind_another_mount_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket_file = tmp_path / "bus.sock"
    first = socket.socket(socket.AF_UNIX)
    first.bind(str(socket_file))
    address = bus_address("jointctl", str(socket_file))
    assert bus_address("jointctl", str(socket_file)) == address
    socket_file.rename(tmp_path / "other.sock")
    with socket.socket(socket.AF_UNIX) as second:
        second.bind(str(socket_file))
        assert bus_address("jointctl", str(socket_file)) != address
    first.close()
    monkeypatch.chdir(tmp_path)
    url = bus_address("slcan", "socket://host:1234")
    monkeypatch.chdir("/")
    assert bus_address("slcan", "socket://host:1234") == url


def test_where_such_sockets_are_forbidden_there_is_no_claim(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "socket", forbidden)
    BusClaim("socketcan", channel).close()


def test_a_bus_inside_a_process_needs_no_claim(channel: str) -> None:
    with BusClaim("virtual", channel), BusClaim("virtual", channel):
        pass


def test_no_process_that_was_started_keeps_the_claim(channel: str) -> None:
    claim = BusClaim("socketcan", channel)
    command = [sys.executable, "-c", "print(flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, close_fds=False) as child:
        assert child.stdout is not None
        assert child.stdout.readline()
        claim.close()
        BusClaim("socketcan", channel).close()
        child.communicate(b"\n")
