"""Opening the virtual bus, at its raw end and as python-can's plug-in, and every way in which it is not there."""

from __future__ import annotations

import socket
import tomllib
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

import drivers
from jointctl.drivers.can import virtual_bus
from jointctl.drivers.can.open import open_cyclic_end, open_python_can
from jointctl.drivers.can.virtual_bus import VirtualBus
from jointctl.drivers.errors import BusError
from jointctl.hil.bus.virtual_bus import VirtualBusHub


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("b") / "bus.sock"


@pytest.fixture
def buses(path: Path) -> Iterator[tuple[VirtualBus, VirtualBus]]:
    with VirtualBusHub(path), VirtualBus(str(path)) as a, VirtualBus(str(path)) as b:
        yield a, b


def test_no_bus_listens(path: Path) -> None:
    for attempt in (open_cyclic_end, open_python_can):
        with pytest.raises(BusError, match="no virtual bus at") as caught:
            attempt("jointctl", str(path))
        assert caught.value.hint == "start one with `jointctl hil CONFIG`"
    with pytest.raises(can.CanInitializationError, match="start one with `jointctl hil CONFIG`"):
        VirtualBus(str(path))


def test_a_dead_socket_file_is_no_bus(path: Path) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dead.bind(str(path))
    dead.close()
    with pytest.raises(BusError, match="no virtual bus at"):
        virtual_bus.connect(str(path))


def test_a_socket_of_another_kind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(BusError, match="not a virtual bus"):
            virtual_bus.connect(str(path))


def test_a_folder_that_others_may_write_is_refused(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path.parent))
    with VirtualBusHub(virtual_bus.default_socket_path("vcan")):
        virtual_bus.connect("vcan").close()
        assert VirtualBus._detect_available_configs() == [{"interface": "jointctl", "channel": "vcan"}]
        (path.parent / "jointctl").chmod(0o770)
        with pytest.raises(BusError, match="mode 0700"):
            virtual_bus.connect("vcan")


def test_cyclic_end_of_another_interface() -> None:
    with pytest.raises(BusError, match=r"interface \(='pcan'\) must be one of socketcan, jointctl"):
        open_cyclic_end("pcan", "PCAN_USBBUS1")


def test_can_fd_and_error_frames_are_refused(buses: tuple[VirtualBus, VirtualBus], path: Path) -> None:
    for message in (
        can.Message(is_fd=True, arbitration_id=1),
        can.Message(is_error_frame=True),
        can.Message(arbitration_id=0x800, is_extended_id=False),
    ):
        with pytest.raises(ValueError, match=r"supported|cannot be sent|identifier"):
            buses[0].send(message)
    assert buses[1].recv(0.0) is None
    for settings in ({"fd": True}, {"receive_own_messages": True}):
        with pytest.raises(can.CanInitializationError, match="not supported"):
            VirtualBus(str(path), **settings)


def test_filters(buses: tuple[VirtualBus, VirtualBus]) -> None:
    buses[1].set_filters([{"can_id": 0x180, "can_mask": 0x780, "extended": False}])
    for identifier in (0x17F, 0x180, 0x1FF, 0x200):
        buses[0].send(can.Message(arbitration_id=identifier, is_extended_id=False))
    got = [buses[1].recv(10.0), buses[1].recv(10.0)]
    assert [message.arbitration_id for message in got if message] == [0x180, 0x1FF]
    assert buses[1].recv(0.02) is None


def test_the_notifier_waits_on_the_descriptor(buses: tuple[VirtualBus, VirtualBus]) -> None:
    reader = can.BufferedReader()
    notifier = can.Notifier(buses[1], [reader], timeout=0.05)
    buses[0].send(can.Message(arbitration_id=0x70A, data=[5], is_extended_id=False))
    message = reader.get_message(10.0)
    notifier.stop()
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x70A, b"\x05")


def test_a_full_queue_of_the_plugin(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()
        with VirtualBus(str(path)) as bus:
            message = can.Message(arbitration_id=1)

            def fill() -> None:
                for _ in range(100_000):
                    bus.send(message)

            with pytest.raises(can.CanOperationError, match="transmit queue is full"):
                fill()
            with pytest.raises(can.CanOperationError, match="transmit queue is full"):
                bus.send(message, timeout=0.01)


def test_the_entry_point_names_the_class() -> None:
    project = tomllib.loads((Path(drivers.__file__).parent.parent / "pyproject.toml").read_text())
    assert project["project"]["entry-points"]["can.interface"]["jointctl"] == (
        f"{VirtualBus.__module__}:{VirtualBus.__qualname__}"
    )
