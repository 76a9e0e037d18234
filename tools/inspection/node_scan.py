"""Who is on the bus: listen first, then ask every node number for its device type, then the found ones who they are.

Listening finds nodes by their heartbeat, boot-up, emergency and SDO answers, and tells whether a controller is active.
Asking is an SDO read, paced so that the transmit queue of an adapter (ten frames on SocketCAN) does not overflow.  Node
guarding is never used to learn the NMT state: its first request would start the life guarding of a drive that has it
configured, and the drive would stop when no second one came.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import can
import canopen

from jointctl.drivers.canopen.cia402 import state_text
from jointctl.drivers.canopen.identifiers import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NODE_MASK,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
)
from jointctl.tools.inspection.objects import Objects, device_type_text, nmt_state
from jointctl.tools.inspection.subject import SdoReader

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
    """One row of the result."""
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
