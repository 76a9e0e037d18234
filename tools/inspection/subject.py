"""What an inspecting verb looks at: a bus, perhaps a node and its EDS, and how it reads the node's objects over SDO."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.can.open import open_python_can
from jointctl.drivers.can.socketcan import interface_blamed
from jointctl.drivers.canopen.cia import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NODE_MASK,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    state_text,
)
from jointctl.drivers.canopen.network import new_network
from jointctl.drivers.errors import BusError, ConfigurationError, NoDeviceError
from jointctl.tools.configuration.canopen import canopen_section, eds_path
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.inspection.objects import Objects, Place, device_type_text, nmt_state, read_dictionary


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
    """The CANopen drive of a configuration; `ConfigurationError` for any other."""
    bus, drive = config.bus, canopen_section(config)
    return Subject(bus.interface, bus.channel, bus.bitrate_bitps, drive.node, eds or eds_path(config), config)


def subject_of_flags(given: GivenPlace, eds: Path | None, environ: Mapping[str, str] = os.environ) -> Subject:
    """Flag beats environment; interface and channel are needed."""
    interface = given.interface or environ.get("CAN_INTERFACE")
    channel = given.channel or environ.get("CAN_CHANNEL")
    bitrate = given.bitrate
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
    return Subject(interface, channel, bitrate, given.node, eds)


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
            with suppress(Exception):  # what went wrong on the bus has been reported
                network.disconnect()


# --- reading over SDO ---

TIMEOUT_S = 0.3
ATTEMPTS = 2
new_dictionary: Any = canopen.ObjectDictionary
NO_OBJECT = (0x06020000, 0x06090011)  # object, sub-index do not exist


def abort_text(code: int) -> str:
    """`06020000h Object does not exist`."""
    return f"{code:08X}h {SdoAbortedError.CODES.get(code, 'not in the standard')}"


@dataclass(frozen=True)
class Refusal:
    """The node answered with an abort, or not at all (`code` None)."""

    code: int | None

    def __str__(self) -> str:
        return "no answer" if self.code is None else abort_text(self.code)

    @property
    def absent(self) -> bool:
        """The node says that it has no such object."""
        return self.code in NO_OBJECT


class SdoReader:
    """Objects of one node, by the `canopen` library.  Nothing is ever written.

    A node has one SDO channel for every master: reading beside a run works, because the run itself uses it only before
    and after its motion, and for a temperature only when it is quiet.  An answer that got mixed up is requested again.
    """

    def __init__(self, network: canopen.Network, node: int, objects: Objects | None = None) -> None:
        self.objects = Objects() if objects is None else objects
        self.node = node
        dictionary = self.objects.dictionary
        self.remote = network.add_node(node, new_dictionary() if dictionary is None else dictionary)
        self.remote.sdo.RESPONSE_TIMEOUT = TIMEOUT_S

    def upload(self, index: int, sub: int = 0) -> bytes | Refusal:
        for _ in range(ATTEMPTS):
            try:
                return bytes(self.remote.sdo.upload(index, sub))
            except SdoAbortedError as error:
                return Refusal(error.code)
            except SdoCommunicationError:
                continue
        return Refusal(None)

    def value(self, index: int, sub: int = 0) -> Any:
        """The value of an object; None where the node has none to give."""
        data = self.upload(index, sub)
        return None if isinstance(data, Refusal) else self.objects.value(index, sub, data)

    def text(self, index: int, sub: int = 0) -> str | None:
        """The value in words; None where the node has none to give."""
        data = self.upload(index, sub)
        return None if isinstance(data, Refusal) else self.objects.text(index, sub, data)

    def require_answer(self) -> int:
        """The device type; `NoDeviceError` if the node is silent."""
        data = self.upload(0x1000)
        if isinstance(data, Refusal) and data.code is None:
            raise NoDeviceError(
                f"node {self.node} does not answer at {Place(0x1000)} (device type)",
                "`jointctl scan` shows who does; a node in NMT state stopped answers no SDO",
            )
        return 0 if isinstance(data, Refusal) else int.from_bytes(data, "little")


# --- Who is on the bus: listen first, then ask every node for its device type, then the found ones who they are ---
# Listening finds nodes by their heartbeat, boot-up, emergency and SDO answers, and tells whether a controller is
# active.  Asking is an SDO read, paced so that the transmit queue of an adapter (ten frames on SocketCAN) does not
# overflow.  Node guarding is never used to learn the NMT state: its first request would start the life guarding of a
# drive that has it configured, and the drive would stop when no second one came.


PACE_S = 0.002  # between two questions; 127 of them take a quarter of a second
ANSWER_S = 0.3
ROUNDS = 2
_READ_DEVICE_TYPE = struct.pack("<BHB4x", 0x40, 0x1000, 0)


@dataclass
class Heard:
    """What the bus has said by itself."""

    frames: int = 0
    errors: int = 0
    syncs: int = 0
    heartbeats: dict[int, int] = field(default_factory=dict)  # node -> last NMT state
    others: set[int] = field(default_factory=set)  # nodes that sent EMCY, PDO or SDO answers
    answers: dict[int, float] = field(default_factory=dict)  # node -> when it answered an SDO


class Ear(can.Listener):
    """Collects `Heard` in the receiving thread."""

    def __init__(self) -> None:
        self.heard = Heard()
        self.lock = threading.Lock()

    def on_message_received(self, msg: can.Message) -> None:
        """Classify by the predefined connection set."""
        with self.lock:
            self._take(msg)

    def _take(self, msg: can.Message) -> None:
        heard = self.heard
        if msg.is_error_frame:
            heard.errors += 1
            return
        heard.frames += 1
        if msg.is_extended_id or msg.is_remote_frame:
            return
        function, node = msg.arbitration_id & FUNCTION_MASK, msg.arbitration_id & NODE_MASK
        if msg.arbitration_id == SYNC_ID:
            heard.syncs += 1
        elif node and function == HEARTBEAT_ID and len(msg.data) == 1:
            heard.heartbeats[node] = msg.data[0] & 0x7F
        elif node and function == SDO_ANSWER_ID:
            heard.answers[node] = time.monotonic()
        elif node and function == EMERGENCY_ID:
            heard.others.add(node)

    def nodes(self) -> set[int]:
        """Everybody that has been heard so far."""
        with self.lock:
            return set(self.heard.heartbeats) | self.heard.others | set(self.heard.answers)


def ask_everybody(
    network: canopen.Network, ear: Ear, nodes: Iterable[int], sleep: Callable[[float], None] = time.sleep
) -> set[int]:
    """The nodes that answer an SDO read of 1000h; who stays silent is asked once more."""
    silent = set(nodes)
    with ear.lock:
        ear.heard.answers.clear()  # those were answers to somebody else
    for _ in range(ROUNDS):
        for node in sorted(silent):
            network.send_message(SDO_REQUEST_ID + node, _READ_DEVICE_TYPE)
            sleep(PACE_S)
        sleep(ANSWER_S)
        with ear.lock:
            answered = set(ear.heard.answers)
        silent -= answered
    return answered


def describe(network: canopen.Network, node: int, answers: bool, nmt: int | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "node": node, "answers_sdo": answers, "nmt_state": nmt_state(nmt), "device_type": None,
        "vendor_id": None, "product_code": None, "revision": None, "serial_number": None, "name": None,
        "drive_state": None,
    }  # fmt: skip
    if not answers:
        return row
    reader = SdoReader(network, node, Objects())
    device_type = reader.value(0x1000)
    if device_type is not None:
        row["device_type"] = device_type_text(device_type)
    for sub, key in ((1, "vendor_id"), (2, "product_code"), (3, "revision")):
        value = reader.value(0x1018, sub)
        row[key] = None if value is None else f"{value:#010x}"
    row["serial_number"] = reader.value(0x1018, 4)
    row["name"] = reader.value(0x1008)
    word = reader.value(0x6041)
    row["drive_state"] = None if word is None else state_text(word)
    return row
