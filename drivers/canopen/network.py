"""The `canopen` library on an end of a bus, as everybody here uses it: quiet, and it outlives a bus that fails."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import can
import canopen

from jointctl.drivers.canopen.bus_watchers import BusFailure, OtherControllers
from jointctl.drivers.canopen.identifiers import NMT_ID, NmtCommand

NOTIFIER_S = 0.05  # how long the receiving thread waits before it looks whether it is to end


def new_network(bus: can.BusABC, sleep: Callable[[float], None], *listeners: can.Listener) -> canopen.Network:
    """Not connected yet; `connect` starts the receiving thread, which `listeners` hear as well."""
    # the library warns about every heartbeat state and unknown frame; what matters is told by whoever asks
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    network = canopen.Network(bus)
    network.NOTIFIER_CYCLE = NOTIFIER_S
    added: list[Any] = [BusFailure(sleep), *listeners]  # the library knows only its own kind of listener
    network.listeners.extend(added)
    return network


def send_nmt(network: canopen.Network, command: NmtCommand, node: int) -> None:
    """An NMT command to one node."""
    network.send_message(NMT_ID, bytes([command, node]))


def report_own_frames(network: canopen.Network, others: OtherControllers) -> None:
    """`others` learns what this end sends, so that an interface which hands it back does not make it another's."""
    send: Any = network.send_message

    def send_message(can_id: int, data: Any, remote: bool = False) -> None:
        others.sent(can_id, bytes(data))
        send(can_id, data, remote)

    network.send_message = send_message  # type: ignore[method-assign]
