"""Where to say "stop", from a configuration that need not hold.

A file that is being edited while the joint moves must not cost the stop: only bus and node, or port and baud rate, are
looked at, each key by itself where the file is no TOML any more.  What the command line gives need not be in it.
"""

from __future__ import annotations

import contextlib
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic_core import PydanticCustomError

from jointctl.drivers.can.channel import split_channel, with_options
from jointctl.drivers.can.open import CYCLIC_INTERFACES, SHARED_INTERFACES
from jointctl.drivers.canopen.identifiers import HIGHEST_NODE
from jointctl.drivers.elmo.settings import SERIAL
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import parse_toml, read_input
from jointctl.tools.configuration.bus_options import checked_options
from jointctl.tools.configuration.elmo import BAUD_RATES_TEXT, KIND, BAUD_RATES_bitps

REPLY_TIMEOUT_S = 0.2
_HEADING = re.compile(r"\s*\[\s*(\w+)\s*\]\s*(#.*)?")
_HINT = "it can be given on the command line: -i, -c, -b and -t, or -p for a serial port"


@dataclass(frozen=True)
class CanTarget:
    """A CANopen drive; `bitrate_bitps` None where it does not matter."""

    interface: str
    channel: str
    bitrate_bitps: int | None
    node: int
    encoder_node: int | None = None
    sdo_timeout_s: float | None = None

    @property
    def place(self) -> tuple[str, str]:
        """Interface and channel, as the lock of the bus has them."""
        return self.interface, self.channel


@dataclass(frozen=True)
class SerialTarget:
    """A drive on a serial line."""

    port: str
    baud_rate_bitps: int
    reply_timeout_s: float = REPLY_TIMEOUT_S

    @property
    def place(self) -> tuple[str, str]:
        """See `CanTarget.place`."""
        return SERIAL, self.port


@dataclass(frozen=True)
class GivenTarget:
    """What the command line says."""

    interface: str | None = None
    channel: str | None = None
    bitrate: int | None = None
    port: str | None = None
    node: int | None = None


def readable_keys(text: str) -> dict[str, dict[str, Any]]:
    """Sections and keys of a TOML file; where it is none as a whole, every line that is a key of its own."""
    try:
        data = parse_toml(text)
    except tomllib.TOMLDecodeError:
        data = {}
        section: dict[str, Any] = {}
        for line in text.splitlines():
            heading = _HEADING.fullmatch(line)
            if heading:
                section = data.setdefault(heading[1], {})
                continue
            with contextlib.suppress(tomllib.TOMLDecodeError):
                section.update(parse_toml(line))
    return {name: found for name, found in data.items() if isinstance(found, dict)}


def _text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _seconds(section: Mapping[str, Any], key: str) -> float | None:
    """A timeout; none rather than one that cannot be right."""
    value = section.get(key)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and 0.01 <= value <= 10.0
    return float(value) if good and value is not None else None


def _required(name: str, values: list[Any], good: Callable[[Any], bool], rule: str) -> Any:
    """The first value that is given; `ConfigurationError` unless it is good."""
    value = next((value for value in values if value is not None), None)
    if value is None:
        raise ConfigurationError(f"{name} is missing", _HINT)
    if not good(value):
        raise ConfigurationError(f"{name} (={value}) must be {rule}", _HINT)
    return value


def stop_target(
    path: Path, given: GivenTarget | None = None, environ: Mapping[str, str] | None = None
) -> CanTarget | SerialTarget:
    """Flag beats environment (CAN_INTERFACE, _CHANNEL, _BITRATE) beats file; `ConfigurationError`: what is missing."""
    given, environ = given or GivenTarget(), os.environ if environ is None else environ
    try:
        sections = readable_keys(read_input(path).decode("utf-8-sig", "replace"))
    except OSError as error:
        sections = {}
        unread = f"{path}: cannot be read: {error.strerror or error}; "
    else:
        unread = f"{path}: "
    drive, bus = sections.get("drive", {}), sections.get("bus", {})
    on_can = given.interface is not None or given.channel is not None or given.bitrate is not None
    serial = (
        drive.get("kind") == KIND if "kind" in drive else not on_can and (given.port is not None or "port" in drive)
    )
    if serial:
        if on_can:
            raise ConfigurationError(
                "command line: -i, -c and -b name a CAN bus, the drive is on a serial port: use -p"
            )
        port = _required(f"{unread}drive.port", [given.port, drive.get("port")], _text, "a text in quotes")
        rates = [drive.get("baud_rate_bitps")]
        rate = _required(f"{unread}drive.baud_rate_bitps", rates, BAUD_RATES_bitps.__contains__, BAUD_RATES_TEXT)
        return SerialTarget(port, rate, _seconds(drive, "reply_timeout_s") or REPLY_TIMEOUT_S)
    if given.port is not None:
        raise ConfigurationError(f'{path}: drive.kind (={drive.get("kind")}) must be "{KIND}" for a serial port')
    interfaces = [given.interface, environ.get("CAN_INTERFACE") or None, bus.get("interface")]
    interface = _required(f"{unread}bus.interface", interfaces, _text, "a text in quotes")
    channels = [given.channel, environ.get("CAN_CHANNEL") or None, bus.get("channel")]
    channel = _required(f"{unread}bus.channel", channels, _text, "a text in quotes")
    if interface == bus.get("interface") and interface not in CYCLIC_INTERFACES:
        channel, inline = split_channel(channel)
        with contextlib.suppress(PydanticCustomError):  # without them rather than not at all
            channel = with_options(channel, {**(checked_options(bus.get("options")) or {}), **inline})
    node = _required(
        f"{unread}drive.node", [given.node, drive.get("node")], lambda n: _whole(n, 1, HIGHEST_NODE), "in [1..127]"
    )
    bitrates = [given.bitrate, _number(environ.get("CAN_BITRATE")), bus.get("bitrate_bitps")]
    bitrate: int | None = None
    if interface not in SHARED_INTERFACES or any(_whole(value, 1, 10**7) for value in bitrates[:1]):
        rule = "in [10000..1000000]"
        bitrate = _required(f"{unread}bus.bitrate_bitps", bitrates, lambda b: _whole(b, 10_000, 1_000_000), rule)
    encoder = sections.get("joint_encoder", {})
    encoder_node = encoder.get("node") if encoder.get("source") == "node" else None
    return CanTarget(
        interface, channel, bitrate, node,
        encoder_node if _whole(encoder_node, 1, HIGHEST_NODE) else None, _seconds(drive, "sdo_timeout_s"),
    )  # fmt: skip


def _number(text: str | None) -> int | None:
    """Of the environment; one that is no number is left out."""
    return int(text) if text and text.isdecimal() else None
