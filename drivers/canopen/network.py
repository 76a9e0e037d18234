"""The driver's end of a CANopen bus: the `canopen` library, quiet, and the listeners that the driver adds to it.

One listener outlives a bus that fails, one notices another controller.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from typing import Any

import can
import canopen

from jointctl.drivers.can.open import receive_only
from jointctl.drivers.canopen.cia import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NMT_ID,
    NODE_MASK,
    RPDO_IDS,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO_IDS,
    NmtCommand,
)
from jointctl.drivers.errors import BusError

NOTIFIER_S = 0.05  # how long the receiving thread waits before it looks whether it is to end
LISTEN_S = 1.0  # a controller whose SYNC is slower than this is not found by listening alone
FAILURE_PAUSE_S = 0.05
_ALL_NODES = 0
_NAMED_FRAMES = 4  # kinds of frames that a message names
_MASKED_NODE = 0x7F
_DOWNLOADS = (1, 6)  # client command specifiers: initiate download, block download
_UPLOAD = 2  # server command specifier of the answer to an upload
_CRITICAL = {0x1016, 0x6007, 0x6040, 0x605A, 0x6060}  # they decide whether the drive has power, and when it loses it
_RPDO_RECORDS = range(0x1400, 0x1600)


class BusFailure(can.Listener):
    """Keeps a bus that fails from ending the receiving thread with a traceback; the next sender gets the error."""

    def __init__(self, sleep: Callable[[float], None]) -> None:
        self._sleep = sleep

    def on_message_received(self, msg: can.Message) -> None:
        """Messages are for the other listeners."""

    def on_error(self, exc: Exception) -> None:
        """The thread receives again at once: a dead bus must not make it spin."""
        self._sleep(FAILURE_PAUSE_S)


def another_controller(found: str) -> BusError:
    """`found`: the frames that show it."""
    return BusError(
        f"another controller is active on this bus: {found}", "end it first; only one controller may use the bus"
    )


class OtherControllers(can.Listener):
    """Notices what only a controller sends: SYNC, NMT, SDO requests, RPDOs and node guarding of `nodes`, our heartbeat.

    It listens from its making on, for LISTEN_S unless the bus is `private`: made a moment ago for this program alone,
    in a process that it has started itself, with simulated drives.  There it names what comes, and waits for nothing.
    Some interfaces hand us the frames that we send ourselves: the first of them that `sent` gets shows it, and from
    then on each counts once.
    """

    def __init__(
        self,
        nodes: Collection[int],
        master_node: int,
        clock: Callable[[], float] = time.monotonic,
        private: bool = False,
    ) -> None:
        self._clock = clock
        self._wanted_s = 0.0 if private else LISTEN_S
        self._started_s = clock()
        self._master_node = master_node
        self.nodes: frozenset[int] = frozenset()  # the drives and encoders of this program
        self._rpdo_ids: dict[int, str] = {}
        self._lock = threading.Lock()
        self._beside_own_loop = False
        self._commands = {NMT_ID}
        self._echoes: bool | None = None  # whether our own frames come back; None = not known yet
        self._own: Counter[tuple[int, bytes]] = Counter()  # that have not come back yet
        self._seen: Counter[str] = Counter()
        self._identifiers: Counter[int] = Counter()
        self._open: Counter[tuple[int, bytes]] = Counter()  # our requests without an answer: node, index and sub-index
        self._answers: dict[tuple[int, bytes], bytes] = {}
        self._doubled: set[int] = set()  # nodes that have answered one request in two ways
        self.heartbeats: set[int] = set()  # nodes that send one, ours and the drive's not among them
        self.add_nodes(nodes)

    def add_nodes(self, nodes: Collection[int]) -> None:
        """More nodes of the same program, before anything is sent to them."""
        with self._lock:
            self.nodes |= frozenset(nodes)
            self._rpdo_ids |= {base + node: f"RPDO to node {node}" for node in nodes for base in RPDO_IDS}
            self._commands |= {SDO_REQUEST_ID + node for node in nodes}
            self.heartbeats -= self.nodes

    def on_message_received(self, msg: can.Message) -> None:
        if msg.is_error_frame or msg.is_extended_id:
            return
        identifier = msg.arbitration_id
        if self._beside_own_loop and identifier not in self._commands:  # most frames of a run: at no cost
            return
        data = bytes(msg.data)
        with self._lock:
            if self._own[identifier, data] > 0:
                self._own[identifier, data] -= 1
                self._echoes = True
                return
            self._identifiers[identifier] += 1
            if identifier - SDO_ANSWER_ID in self.nodes and data and data[0] >> 5 == _UPLOAD:
                self._note_answer((identifier - SDO_ANSWER_ID, data[1:4]), data)
            if words := self._asked(identifier) if msg.is_remote_frame else self._words(identifier, data):
                self._seen[words] += 1
            elif HEARTBEAT_ID < identifier <= HEARTBEAT_ID + _MASKED_NODE and not msg.is_remote_frame:
                if (node := identifier - HEARTBEAT_ID) not in self.nodes:
                    self.heartbeats.add(node)

    def sent(self, identifier: int, data: bytes) -> None:
        """This program is about to send a frame."""
        with self._lock:
            if identifier - SDO_REQUEST_ID in self.nodes:
                place = identifier - SDO_REQUEST_ID, data[1:4]
                self._open[place] = max(self._open[place], 0) + 1
            if self._echoes is None and self._own:  # the first one has not come back
                self._echoes = False
                self._own.clear()
            if self._echoes is not False:
                self._own[identifier, data] += 1

    def _note_answer(self, place: tuple[int, bytes], data: bytes) -> None:
        """A device answers a request once, and the wire may repeat that: another answer is another device's."""
        self._open[place] -= 1
        if self._open[place] < 0 and data != self._answers.get(place, data):
            self._doubled.add(place[0])
        self._answers[place] = data

    def _asked(self, identifier: int) -> str:
        """What a remote frame asks for, if of our nodes: state (node guarding, CiA 301, 7.2.8.2.2.1) or a TPDO."""
        base, node = identifier & FUNCTION_MASK, identifier & NODE_MASK
        if self._beside_own_loop or node not in self.nodes:
            return ""
        if base == HEARTBEAT_ID:
            return f"node guarding of node {node} ({identifier:03X}h)"
        return f"remote request for a TPDO of node {node} ({identifier:03X}h)" if base in TPDO_IDS else ""

    def _words(self, identifier: int, data: bytes) -> str:
        """What a frame is, if only a controller sends it; beside our own loop, what the loop does not send either."""
        if self._beside_own_loop and identifier != NMT_ID:
            index = self._written(identifier, data)
            critical = index is not None and (index in _CRITICAL or index in _RPDO_RECORDS)
            node = identifier - SDO_REQUEST_ID
            return f"SDO request to node {node} that writes object {index:04X}" if critical else ""
        if identifier == SYNC_ID:
            return f"SYNC ({SYNC_ID:03X}h)"
        if identifier == NMT_ID and len(data) >= 2 and (data[1] == _ALL_NODES or data[1] in self.nodes):
            command = NmtCommand(data[0]).name.lower().replace("_", " ") if data[0] in set(NmtCommand) else "unknown"
            return f"NMT {command!r} to {f'node {data[1]}' if data[1] else 'all nodes'}"
        if identifier - SDO_REQUEST_ID in self.nodes:
            return f"SDO request to node {identifier - SDO_REQUEST_ID} ({identifier:03X}h)"
        if identifier == HEARTBEAT_ID + self._master_node:
            return own_heartbeat(identifier)
        if identifier in self._rpdo_ids:
            return f"{self._rpdo_ids[identifier]} ({identifier:03X}h)"
        return ""

    def _written(self, identifier: int, data: bytes) -> int | None:
        """The object that an SDO request writes (CiA 301, 7.2.4.3.3 and 7.2.4.3.9); None where it writes none."""
        if identifier - SDO_REQUEST_ID not in self.nodes or len(data) < 4 or data[0] >> 5 not in _DOWNLOADS:
            return None
        return int.from_bytes(data[1:3], "little")

    def own_loop_begins(self) -> None:
        """SYNC, RPDOs and heartbeats may be our own from here on, and reading an object disturbs no one."""
        with self._lock:
            self._beside_own_loop = True

    @property
    def to_listen_s(self) -> float:
        """How long it has still to listen until silence means something."""
        return max(0.0, self._wanted_s - (self._clock() - self._started_s))

    def add_rpdos(self, identifiers: Iterable[int]) -> None:
        """The RPDOs that the drive has by its own word; what has come of them counts."""
        with self._lock:
            for identifier in identifiers:
                if identifier in self._rpdo_ids:
                    continue
                words = self._rpdo_ids[identifier] = "RPDO of the drive"
                if count := self._identifiers[identifier]:
                    self._seen[f"{words} ({identifier:03X}h)"] += count

    def found(self) -> str:
        """What has come, in words; "" for nothing."""
        with self._lock:
            kinds = [f"{count} x {words}" for words, count in self._seen.most_common(_NAMED_FRAMES)]
            more = len(self._seen) - len(kinds)
        return ", ".join(kinds) + (f" and {more} other kinds" if more else "")

    def refuse(self) -> None:
        """`BusError` where another controller has the drive, they would fight over it, or two devices are one node."""
        if found := self.found():
            raise another_controller(found)
        for node in sorted(self._doubled):  # after that: a request of another one has an answer too
            raise BusError(
                f"two devices answer as node {node}: both would take the commands of one",
                "give each a node number of its own; until then disconnect one",
            )


def own_heartbeat(identifier: int) -> str:
    """What another program sends as `identifier`, in words."""
    return f"heartbeat of node {identifier - HEARTBEAT_ID}, which is our own (drive.master_node)"


def new_network(bus: can.BusABC, sleep: Callable[[float], None], *listeners: can.Listener) -> canopen.Network:
    """Not connected yet; `connect` starts the receiving thread, from which `listeners` get every frame as well."""
    # the library warns about every heartbeat state and unknown frame; what matters is reported by the caller
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    network = canopen.Network(bus)
    network.NOTIFIER_CYCLE = NOTIFIER_S
    added: list[Any] = [BusFailure(sleep), *listeners]  # the library knows only its own kind of listener
    network.listeners.extend(added)
    return network


def receive_beside_loop(network: canopen.Network, nodes: Iterable[int]) -> None:
    """No SYNC and no PDO any more: thousands a second, which say nothing to this end while a loop runs."""
    assert network.bus is not None
    wanted = [(NMT_ID, FUNCTION_MASK | NODE_MASK)]
    wanted += [(base, FUNCTION_MASK) for base in (SDO_ANSWER_ID, SDO_REQUEST_ID, HEARTBEAT_ID)]
    wanted += [(EMERGENCY_ID + node, FUNCTION_MASK | NODE_MASK) for node in nodes]
    receive_only(network.bus, wanted)


def send_nmt(network: canopen.Network, command: NmtCommand, node: int) -> None:
    network.send_message(NMT_ID, bytes([command, node]))


def report_own_frames(network: canopen.Network, others: OtherControllers) -> None:
    """`others` learns what this end sends, so that an interface which hands it back does not make it another's."""
    send: Any = network.send_message

    def send_message(can_id: int, data: bytes, remote: bool = False) -> None:
        others.sent(can_id, bytes(data))
        send(can_id, data, remote)

    network.send_message = send_message  # type: ignore[method-assign]
