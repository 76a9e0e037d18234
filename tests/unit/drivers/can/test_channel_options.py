"""Interfaces that need more than a channel: `can0,host=...,port=...`, and what is wrong with such options."""

from __future__ import annotations

import gc
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.can.channel import NAME, port_path, split_channel, with_options
from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.tools.configuration.load import load_config, with_bus_overrides
from jointctl.tools.configuration.stop_target import GivenTarget, stop_target
from tests.places import CONFIGS

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
        self._thread.join(10.0)
        self._listener.close()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def test_socketcand_by_its_options(server: Server) -> None:
    bus = open_python_can("socketcand", f"can0,host=127.0.0.1,port={server.port}", 500_000)
    message = bus.recv(10.0)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\x11\x22")
    bus.send(can.Message(arbitration_id=0x601, data=[1, 2], is_extended_id=False))
    bus.shutdown()
    server._thread.join(10.0)
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
    assert with_bus_overrides(config, environ={}).bus.channel == whole
    assert with_bus_overrides(config, channel="can1", environ={}).bus.channel == whole.replace("can0", "can1")
    assert with_bus_overrides(config, channel="can0,port=1", environ={}).bus.channel == "can0,host=10.0.0.5,port=1"
    assert with_bus_overrides(config, interface="virtual", environ={}).bus.channel == "can0"
    assert with_bus_overrides(config, environ={"CAN_CHANNEL": "can2"}).bus.channel == whole.replace("can0", "can2")

    target: Any = stop_target(path, environ={})
    assert target.channel == whole
    target = stop_target(path, GivenTarget(channel="can0,port=1"), environ={})
    assert target.channel == "can0,host=10.0.0.5,port=1"
    assert stop_target(path, GivenTarget(interface="jointctl"), environ={}).channel == "can0"  # type: ignore[union-attr]
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
        with_bus_overrides(load_config(CONFIGS / "virtual.toml"), channel="x,host=a", environ={})


def test_a_serial_adapter_is_the_same_with_and_without_options() -> None:
    assert port_path("/dev/ttyACM0@115200,rtscts=true") == port_path("/dev/ttyACM0,rtscts=true") == "/dev/ttyACM0"
