"""Prove that the drive's watchdog works, before anything is enabled: stop the heartbeat once and see the drive react.

An armed object 1016 proves nothing: a drive may accept the value and ignore it.  The proof also has its twin: while
the heartbeat comes, the drive must stay quiet.  What is proven is detection, not that the power goes off: for that see
`connection_loss`.
"""

from __future__ import annotations

from collections.abc import Callable

import canopen

from jointctl.drivers.canopen.identifiers import EMERGENCY_ID, HEARTBEAT_ID, NmtState
from jointctl.drivers.errors import DeviceError

HEARTBEAT_LOST = 0x8130  # EMCY error code of CiA 301
BEATS = 6
BEATS_PER_TIMEOUT = 3
POLLS_PER_TIMEOUT = 20
LONGEST_TIMEOUTS = 4


class _Witness:
    """What the drive says about a lost heartbeat: EMCY 8130, or a heartbeat with another NMT state."""

    def __init__(self) -> None:
        self.seen = ""
        self._nmt_state: int | None = None

    def on_emergency(self, _: int, data: bytearray, __: float) -> None:
        """EMCY object of the drive."""
        if len(data) >= 2 and int.from_bytes(data[:2], "little") == HEARTBEAT_LOST:
            self.seen = f"EMCY {HEARTBEAT_LOST:04X}h"

    def on_heartbeat(self, _: int, data: bytearray, __: float) -> None:
        """Heartbeat of the drive."""
        state = data[0] & 0x7F if data else NmtState.BOOT_UP
        if self._nmt_state is not None and state != self._nmt_state:
            self.seen = self.seen or f"NMT state {state}"
        self._nmt_state = state


def prove_watchdog(
    network: canopen.Network, node: int, master_node: int, heartbeat_s: float, sleep: Callable[[float], None]
) -> str:
    """Send our heartbeat for a while, stop it, and return what the drive said; `DeviceError` if it said nothing.

    Takes about three times `heartbeat_s`.  The drive must be disabled; it may end in another NMT state.
    """
    witness = _Witness()
    network.subscribe(EMERGENCY_ID + node, witness.on_emergency)
    network.subscribe(HEARTBEAT_ID + node, witness.on_heartbeat)
    try:
        for _ in range(BEATS):
            network.send_message(HEARTBEAT_ID + master_node, bytes([NmtState.OPERATIONAL]))
            sleep(heartbeat_s / BEATS_PER_TIMEOUT)
        if witness.seen:
            raise DeviceError(
                f"node {node}: the watchdog tripped ({witness.seen}) although the heartbeat of node {master_node} came",
                "another program may own that node number; see drive.master_node",
            )
        for _ in range(LONGEST_TIMEOUTS * POLLS_PER_TIMEOUT):
            sleep(heartbeat_s / POLLS_PER_TIMEOUT)
            if witness.seen:
                return witness.seen
    finally:
        network.unsubscribe(EMERGENCY_ID + node, witness.on_emergency)
        network.unsubscribe(HEARTBEAT_ID + node, witness.on_heartbeat)
    raise DeviceError(
        f"node {node}: the heartbeat was stopped for {LONGEST_TIMEOUTS * heartbeat_s:g} s and the drive did not react",
        "its watchdog (object 1016) would not stop the joint if this computer died; jointctl does not enable it",
    )
