"""What an inspecting verb looks at: a bus, perhaps a node and its EDS, from a configuration or from flags."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import can
import canopen

from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.can.socketcan import interface_blamed
from jointctl.drivers.canopen.network import new_network
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.objects import Objects, read_dictionary


@dataclass(frozen=True)
class Subject:
    """`config` is None where only flags were given, `node` and `eds` where nobody named them."""

    interface: str
    channel: str
    bitrate_bitps: int | None
    node: int | None = None
    eds: Path | None = None
    config: Config | None = None

    @property
    def place(self) -> str:
        """`socketcan:can0`."""
        return f"{self.interface}:{self.channel}"

    def required_node(self) -> int:
        """The node, or `ConfigurationError`."""
        if self.node is None:
            raise ConfigurationError("which node?", "give a configuration, or -t NODE; `jointctl scan` finds nodes")
        return self.node

    def objects(self) -> Objects:
        """Names and types of the node's objects."""
        if self.eds is None or self.node is None:
            return Objects()
        return Objects(read_dictionary(self.eds, self.node))

    def open_bus(self) -> can.BusABC:
        """An end of the bus of its own."""
        return open_python_can(self.interface, self.channel, self.bitrate_bitps)


def subject_of_config(config: Config, eds: Path | None = None) -> Subject:
    """The CANopen drive of a configuration; `ConfigurationError` for a serial one."""
    bus, drive = config.bus, config.canopen
    return Subject(bus.interface, bus.channel, bus.bitrate_bitps, drive.node, eds or config.eds_path, config)


def subject_of_flags(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    node: int | None,
    eds: Path | None,
    environ: Mapping[str, str] = os.environ,
) -> Subject:
    """Flag beats environment; interface and channel are needed."""
    interface = interface or environ.get("CAN_INTERFACE")
    channel = channel or environ.get("CAN_CHANNEL")
    if not interface or not channel:
        missing = "interface (-i)" if not interface else "channel (-c)"
        raise ConfigurationError(
            f"which bus? the {missing} is not given", "name a configuration, or a bus: -i socketcan -c can0"
        )
    if bitrate is None and environ.get("CAN_BITRATE"):
        text = environ["CAN_BITRATE"]
        if not text.isdecimal():
            raise ConfigurationError(f"environment: CAN_BITRATE (={text}) must be a whole number of bit/s")
        bitrate = int(text)
    if eds is not None and not eds.is_file():
        raise ConfigurationError(f"--eds (={eds}) must name a file")
    return Subject(interface, channel, bitrate, node, eds)


@contextmanager
def canopen_network(subject: Subject, *listeners: can.Listener) -> Iterator[canopen.Network]:
    """The `canopen` library on an end of the bus of its own; it sends nothing by itself."""
    network = new_network(subject.open_bus(), time.sleep, *listeners)
    with interface_blamed(subject.interface, subject.channel, subject.bitrate_bitps):
        try:
            network.connect()
            yield network
        except can.CanError as error:
            raise BusError(f"{subject.place} failed: {error}", "wiring, bit rate, and whether it is up") from None
        finally:
            with suppress(Exception):  # what went wrong on the bus has been told
                network.disconnect()
