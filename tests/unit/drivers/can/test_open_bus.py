"""Opening a bus: every failure is a BusError that says what to do; and the python-can plug-in."""

from __future__ import annotations

import errno
import gc
import os
import re
import socket
import tomllib
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

import drivers
from drivers.can import socketcan, virtual_bus
from drivers.can.foreign_bus import tamed
from drivers.can.open import open_cyclic_end, open_python_can
from drivers.can.virtual_bus import VirtualBus
from drivers.errors import BusError
from hil.bus.virtual_bus import VirtualBusHub


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("b") / "bus.sock"


@pytest.fixture
def buses(path: Path) -> Iterator[tuple[VirtualBus, VirtualBus]]:
    with VirtualBusHub(path), VirtualBus(str(path)) as a, VirtualBus(str(path)) as b:
        yield a, b


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
    bus = tamed(Odd(error))  # type: ignore[arg-type]
    for call in (lambda: bus.send(can.Message()), lambda: bus.recv(0.0)):
        with pytest.raises(can.CanOperationError, match=re.escape(text)) as caught:
            call()
        assert caught.value.error_code == code


def test_an_adapter_that_is_refused_leaves_the_port_free(serial_line: str) -> None:
    with pytest.raises(BusError, match="Invalid bitrate"):
        open_python_can("slcan", serial_line, 444_444, sleep_after_open=0.0)
    gc.collect()
    open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0).shutdown()
