"""Opening a bus, SocketCAN, virtual or of an adapter: one program at a time, every failure is one `BusError`."""

from __future__ import annotations

import ctypes
import errno
import gc
import logging
import os
import re
import socket
import threading
import time
import tomllib
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

import drivers
from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.can import open as open_module
from jointctl.drivers.can import socketcan, virtual_bus
from jointctl.drivers.can.open import (
    NAME,
    normalised,
    open_cyclic_end,
    open_python_can,
    port_path,
    split_channel,
    with_options,
)
from jointctl.drivers.can.virtual_bus import VirtualBus
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.hil.virtual_bus import VirtualBusHub
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config, moved
from jointctl.tools.verbs.bench_drive import stop_target
from tests.places import CONFIGS

# --- Interfaces that need more than a channel: `can0,host=...,port=...`, and what is wrong with such options ---
values = st.one_of(
    st.text(st.characters(codec="utf-8")), st.integers(-(10**17), 10**17), st.booleans(),
    st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["0123", "true", "1e5", "a,b=c", "'x'", "%2C"]),
)  # fmt: skip


@given(st.dictionaries(st.from_regex(NAME, fullmatch=True), values), st.sampled_from(["can0", "", "/dev/ttyACM0@9600"]))
def test_what_is_put_behind_a_channel_comes_back(options: dict[str, Any], channel: str) -> None:
    found_channel, found = split_channel(with_options(channel, options))
    assert found_channel == channel
    assert found == options
    assert {name: type(value) for name, value in found.items()} == {n: type(v) for n, v in options.items()}


@pytest.mark.parametrize("channel", ["can0", "0, 1", "0,1", "socket://host:29536?logging=debug", "a=b", "ff11::7079"])
def test_channels_that_hold_commas_but_no_options(channel: str) -> None:
    assert split_channel(channel) == (channel, {})


class Server:
    """socketcand, as far as one client needs it; `said` is what it was told."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.said = b""
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        peer, _ = self._listener.accept()
        with peer:
            peer.sendall(b"< hi >")
            for expected, answer in ((b"open", b"< ok >"), (b"rawmode", b"< ok >")):
                while expected not in self.said:
                    self.said += peer.recv(100)
                peer.sendall(answer)
            time.sleep(0.2)  # python-can takes the last answer and nothing behind it
            peer.sendall(b"< frame 181 1.5 1122 >")
            while piece := peer.recv(100):
                self.said += piece

    def close(self) -> None:
        self._thread.join(60.0)
        self._listener.close()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def test_socketcand_by_its_options(server: Server) -> None:
    bus = open_python_can("socketcand", f"can0,host=127.0.0.1,port={server.port}", 500_000)
    message = bus.recv(60.0)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\x11\x22")
    bus.send(can.Message(arbitration_id=0x601, data=[1, 2], is_extended_id=False))
    bus.shutdown()
    server._thread.join(60.0)
    assert b"< open can0 >" in server.said
    assert b"send 601 2" in server.said


@pytest.mark.parametrize(
    ("interface", "channel", "words"),
    [
        ("socketcand", "can0", "interface socketcand needs the options host, port"),
        ("socketcand", "can0,host=127.0.0.1", "interface socketcand needs the option port"),
        ("socketcand", "can0,hots=127.0.0.1,port=1", "option hots of the bus: interface socketcand takes host, port"),
        ("socketcand", "can0,host=a,port=1,channel=b", "option channel of the bus: is no option"),
        ("jointctl", "joint,host=a", "option host of the bus: interface jointctl takes none"),
        ("socketcan", "can0,fd=true", "option fd of the bus: interface socketcan takes none"),
        ("nonsense", "can0,host=a", "interface (='nonsense') must be one of"),
        ("virtual", "x,preserve_timestamps=true,odd=1", "option odd of the bus: interface virtual takes"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # python-can leaves a socket open where it fails
def test_options_that_do_not_fit(interface: str, channel: str, words: str) -> None:
    with pytest.raises(BusError, match=r".") as raised:
        open_python_can(interface, channel)
    gc.collect()
    assert words in raised.value.message


def configured(folder: Path, options: str, interface: str = "socketcand") -> Path:
    text = (CONFIGS / "virtual.toml").read_text()
    head = f'[bus]\ninterface = "{interface}"\nchannel = "can0"\nbitrate_bitps = 1_000_000\n{options}\n\n'
    path = folder / "joint.toml"
    path.write_text(head + text[text.index("[drive]") :])
    return path


def test_the_configuration_names_the_bus_completely(tmp_path: Path) -> None:
    path = configured(tmp_path, 'options = { port = 29536, host = "10.0.0.5" }')
    config = load_config(path)
    whole = "can0,host=10.0.0.5,port=29536"
    assert config.bus.channel == whole
    assert moved(config, GivenPlace(), {}).bus.channel == whole
    assert moved(config, GivenPlace(channel="can1"), {}).bus.channel == whole.replace("can0", "can1")
    assert moved(config, GivenPlace(channel="can0,port=1"), {}).bus.channel == "can0,host=10.0.0.5,port=1"
    assert moved(config, GivenPlace(interface="virtual"), {}).bus.channel == "can0"
    assert moved(config, GivenPlace(), {"CAN_CHANNEL": "can2"}).bus.channel == whole.replace("can0", "can2")

    target: Any = stop_target(path, environ={})
    assert target.channel == whole
    target = stop_target(path, GivenPlace(channel="can0,port=1"), environ={})
    assert target.channel == "can0,host=10.0.0.5,port=1"
    assert stop_target(path, GivenPlace(interface="jointctl"), environ={}).channel == "can0"  # type: ignore[union-attr]
    # two servers with a can0 each are two buses
    other = load_config(configured(tmp_path, 'options = { port = 29536, host = "10.0.0.6" }'))
    assert lock_name("socketcand", config.bus.channel) != lock_name("socketcand", other.bus.channel)


@pytest.mark.parametrize(
    ("options", "interface", "words"),
    [
        ("options = 3", "socketcand", "bus.options (=3) must be a table"),
        ("options = { host = [1] }", "socketcand", "host must be a text, a number, true or false"),
        ("options = { host = inf }", "socketcand", "host must be a text, a number, true or false"),
        ('options = { "a b" = 1 }', "socketcand", "a b is no option of an interface"),
        ('options = { channel = "x" }', "socketcand", "channel is no option of an interface"),
        ('options = { host = "x" }', "jointctl", "options must be absent for the interface jointctl"),
        ('options = { host = "x" }', "socketcan", "options must be absent for the interface socketcan"),
    ],
)
def test_options_that_are_wrong_in_the_file(tmp_path: Path, options: str, interface: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match="bus") as raised:
        load_config(configured(tmp_path, options, interface))
    assert words in raised.value.message
    assert len(raised.value.message.splitlines()) == 1


def test_options_on_the_command_line_for_an_interface_without_any() -> None:
    with pytest.raises(
        ConfigurationError, match=r"command line: bus.options must be absent for the interface jointctl"
    ):
        moved(load_config(CONFIGS / "virtual.toml"), GivenPlace(channel="x,host=a"), {})


def test_a_serial_adapter_is_the_same_with_and_without_options() -> None:
    assert port_path("/dev/ttyACM0@115200,rtscts=true") == port_path("/dev/ttyACM0,rtscts=true") == "/dev/ttyACM0"


# --- Opening a SocketCAN interface: every failure is a BusError that says what to do ---
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


@pytest.mark.parametrize(
    ("step", "number", "words"),
    [
        ("bind_error", errno.ENODEV, "can0"), ("bind_error", errno.ENETDOWN, "can0"),
        ("pending_error", errno.ENETDOWN, "can0 is down"), ("bind_error", errno.EPERM, "no permission"),
    ],
)  # fmt: skip
def test_missing_or_down_also_after_the_bind_or_without_the_right(
    kernel_with_can: Any, step: str, number: int, words: str
) -> None:
    setattr(kernel_with_can, step, number)
    with pytest.raises(BusError, match=words) as caught:
        socketcan.open_socket("can0")
    up = "sudo ip link set can0 up type can bitrate 1000000" in caught.value.hint
    assert up is (number != errno.EPERM)
    assert FakeCanSocket.last.closed


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


# --- Opening the virtual bus, at its raw end and as python-can's plug-in, and every way in which it is not there ---
@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("b") / "bus.sock"


@pytest.fixture
def buses(path: Path) -> Iterator[tuple[VirtualBus, VirtualBus]]:
    with VirtualBusHub(path), VirtualBus(str(path)) as a, VirtualBus(str(path)) as b:
        yield a, b


@pytest.mark.parametrize("dead", [False, True])
def test_no_bus_listens_or_one_has_left_its_socket_file(path: Path, dead: bool) -> None:
    if dead:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
            left.bind(str(path))
    for attempt in (open_cyclic_end, open_python_can):
        with pytest.raises(BusError, match="no virtual bus at") as caught:
            attempt("jointctl", str(path))
        assert caught.value.hint == "start one with `jointctl hil CONFIG`"
    with pytest.raises(can.CanInitializationError, match="start one with `jointctl hil CONFIG`"):
        VirtualBus(str(path))


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


def test_can_fd_and_error_frames_are_refused(buses: tuple[VirtualBus, VirtualBus], path: Path) -> None:
    for kind in ({"is_fd": True}, {"is_error_frame": True}, {"arbitration_id": 0x800, "is_extended_id": False}):
        with pytest.raises(ValueError, match=r"supported|cannot be sent|identifier"):
            buses[0].send(can.Message(**{"arbitration_id": 1, **kind}))
    assert buses[1].recv(0.0) is None
    for settings in ({"fd": True}, {"receive_own_messages": True}):
        with pytest.raises(can.CanInitializationError, match="not supported"):
            VirtualBus(str(path), **settings)


FILTERS = st.fixed_dictionaries(
    {"can_id": st.sampled_from([0, 0x80, 0x81, 0x180, 2**29 - 1]), "can_mask": st.sampled_from([0, 0x780, 2**32 - 1])},
    optional={"extended": st.booleans()},
)
LAST = {"can_id": 0x1ABCDEF, "can_mask": 2**29 - 1, "extended": True}


@given(filters=st.lists(FILTERS, max_size=4))
def test_the_system_drops_what_python_can_would(buses: tuple[VirtualBus, VirtualBus], filters: list[Any]) -> None:
    """A program whose frames are dropped there is not woken up."""
    sender, bus = buses
    bus.set_filters([*filters, LAST])
    frames = [
        can.Message(arbitration_id=identifier, is_extended_id=extended, is_remote_frame=remote)
        for identifier in (0, 0x80, 0x81, 0x1FF, 0x7FF)
        for extended in (False, True)
        for remote in (False, True)
    ]
    frames.append(can.Message(arbitration_id=LAST["can_id"]))
    wanted = [frame for frame in frames if bus._matches_filters(frame)]
    bus._filters = None  # from here on only the system's own
    for frame in frames:
        sender.send(frame)
    for frame in wanted:
        message = bus.recv(60.0)
        assert message is not None
        assert message.equals(frame, timestamp_delta=None, check_channel=False, check_direction=False)


def test_more_filters_than_the_system_takes_are_python_cans(buses: tuple[VirtualBus, VirtualBus]) -> None:
    buses[1].set_filters([LAST])
    buses[1].set_filters([{"can_id": 0x180, "can_mask": 0x7FF, "extended": False}] * 2000)
    for identifier in (0x17F, 0x180):
        buses[0].send(can.Message(arbitration_id=identifier, is_extended_id=False))
    message = buses[1].recv(60.0)
    assert message is not None
    assert message.arbitration_id == 0x180


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


# --- Opening a serial or third-party adapter: one program at a time, and every failure in one way ---
@pytest.mark.parametrize(
    ("opened", "interface", "channel", "words"),
    [
        (open_cyclic_end, "pcan", "PCAN_USBBUS1", r"interface \(='pcan'\) must be one of socketcan, jointctl"),
        (open_python_can, "nonsense", "x", r"interface \(='nonsense'\) must be one of .*jointctl.*socketcan"),
        (open_python_can, "slcan", "/dev/ttyJC_none", "slcan"),
    ],
)
def test_an_interface_that_is_unknown_or_not_there(opened: Any, interface: str, channel: str, words: str) -> None:
    with pytest.raises(BusError, match=words):
        opened(interface, channel, 1_000_000) if interface == "slcan" else opened(interface, channel)


Opening = Callable[[BaseException], None]


@pytest.fixture
def opening_raises(monkeypatch: pytest.MonkeyPatch) -> Opening:
    """Each interface of python-can raises this when it is opened, and logs it before."""

    def install(error: BaseException) -> None:
        def fail(*_: Any, **__: Any) -> None:
            logging.getLogger("can.somewhere").warning(str(error))
            raise error

        monkeypatch.setattr(open_module.can, "Bus", fail)

    return install


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "no permission to open pcan:x"),
        (OSError(errno.ENODEV, "No such device"), "no such device: pcan:x"),
        (OSError(errno.EBUSY, "Busy"), "cannot open pcan:x: Busy"),
        (ImportError("No module named 'x'"), "needs a module"),
        (can.CanInterfaceNotImplementedError("no driver"), "cannot be used here"),
        (can.CanInitializationError("wrong bit rate"), "cannot open pcan:x: wrong bit rate"),
        (ValueError("bad"), "cannot open pcan:x: bad"),
        (NameError("name 'canOpen' is not defined", name="canOpen"), "library .*installed.*: canOpen is missing"),
        (AttributeError("no attribute"), "cannot open pcan:x: the library of the adapter's maker .*: no attribute"),
        *((odd, "cannot open pcan:x") for odd in (
            KeyError("x"),
            ctypes.ArgumentError("argument 1"), AssertionError(), IndexError("list index"),
            RuntimeError("odd\nsecond line"), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "start byte"),
            RecursionError(), ZeroDivisionError(), Exception(),
        )),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)  # fmt: skip
def test_whatever_an_interface_raises_is_one_bus_error(
    opening_raises: Opening, caplog: pytest.LogCaptureFixture, error: Exception, words: str
) -> None:
    opening_raises(error)
    with pytest.raises(BusError, match=words) as caught:
        open_python_can("pcan", "x")
    assert (caught.value.exit_code, caplog.records) == (4, [])  # what it logs is told once
    assert "NameError" not in caught.value.message
    logging.getLogger("can.somewhere").warning("afterwards")
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    "error",
    [can.CanInterfaceNotImplementedError("no library"), ImportError("No module named 'usb'"),
     can.CanInitializationError("pcanbasic library not found."), NameError("name 'canOpen' is not defined")],
    ids=lambda error: type(error).__name__,
)  # fmt: skip
@pytest.mark.parametrize(
    ("interface", "platform", "socketcan"),
    [("kvaser", "linux", True), ("pcan", "linux", True), ("pcan", "win32", False), ("ixxat", "linux", False)],
)
def test_without_its_maker_s_library_an_adapter_that_linux_knows_is_socketcan(
    opening_raises: Opening, monkeypatch: pytest.MonkeyPatch, error: Exception, interface: str, platform: str,
    socketcan: bool,
) -> None:  # fmt: skip
    monkeypatch.setattr(open_module.sys, "platform", platform)
    opening_raises(error)
    with pytest.raises(BusError) as caught:
        open_python_can(interface, "x")
    assert ("-i socketcan -c can0" in caught.value.hint) is socketcan


@pytest.mark.parametrize(("interface", "remedy"), [("slcan", "sudo usermod -aG dialout $USER"), ("pcan", "group")])
def test_a_missing_right_is_told_with_its_cure(interface: str, remedy: str, opening_raises: Opening) -> None:
    opening_raises(PermissionError(errno.EACCES, "Permission denied"))
    with pytest.raises(BusError, match="no permission to open") as caught:
        open_python_can(interface, "socket://nowhere")
    assert remedy in caught.value.hint


def test_what_ends_the_program_is_no_error_of_a_bus(opening_raises: Opening) -> None:
    opening_raises(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        open_python_can("kvaser", "0")


@pytest.fixture
def serial_ends() -> Iterator[tuple[int, str]]:
    """The descriptor of a serial adapter that says nothing by itself, and the port that leads to it."""
    near, far = os.openpty()
    tty.setraw(far)
    yield near, os.ttyname(far)
    os.close(near)
    os.close(far)


@pytest.fixture
def serial_line(serial_ends: tuple[int, str]) -> str:
    return serial_ends[1]


def test_a_serial_adapter_serves_one_program_at_a_time(serial_line: str) -> None:
    with open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0):
        with pytest.raises(BusError, match=f"the adapter on {serial_line} is in use by another program") as caught:
            open_python_can("slcan", f"{serial_line}@115200", 500_000)
        assert "jointctl stop" in (caught.value.hint or "")
        open_python_can("slcan", serial_line, 500_000, exclusive=False, sleep_after_open=0.0).shutdown()
    open_python_can("slcan", serial_line, 500_000, sleep_after_open=0.0).shutdown()


def test_a_damaged_line_of_an_adapter_is_a_lost_frame(serial_ends: tuple[int, str]) -> None:
    """Two programs on one adapter cut into each other's lines; ValueError ended whoever made the joint safe."""
    near, port = serial_ends
    with open_python_can("slcan", port, 500_000, sleep_after_open=0.0) as bus:
        for line in (b"t1812AAtBB\r", b"t1\r", b"txyz2AABB\r", b"t18129\xff\r"):
            os.write(near, line)
            assert bus.recv(0.5) is None
        os.write(near, b"t1812AABB\r")
        message = bus.recv(0.5)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\xaa\xbb")


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


# --- Interfaces of python-can without their maker's library, and such as raise anything: one `BusError` ---
# these open something on any computer
WORKING = {"virtual", "udp_multicast", "jointctl"}


@pytest.mark.filterwarnings("ignore")  # of the libraries, about themselves
@pytest.mark.parametrize("interface", sorted(set(can.VALID_INTERFACES) - WORKING))
def test_an_interface_that_is_not_there_is_one_line(interface: str) -> None:
    with pytest.raises(BusError, match=r"interface|open|device|kernel") as raised:
        open_python_can(interface, "/dev/null/0" if interface in ("slcan", "serial", "robotell") else "0", 500_000)
    gc.collect()  # what a library has left open
    assert "\n" not in raised.value.message


def test_a_calendar_that_is_set_back_does_not_lengthen_a_time_out() -> None:
    receive = can.BusABC.recv
    assert "time" in receive.__code__.co_names
    assert receive.__globals__["time"] is time.monotonic
