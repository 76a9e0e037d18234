"""The drive's temperature while the loop runs: one SDO upload a second, asked and answered without waiting.

CiA 402 has no object for it; the configuration names the drive's own.  On the bus it costs two frames of the lowest
priority but for the heartbeats, which delay a cycle's frames by one frame at most (0.14 ms at 1 Mbit/s).  Whatever goes
wrong with it (abort, no answer, nonsense) makes the temperature unknown and nothing else.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import can
import canopen
from canopen.objectdictionary import ObjectDictionaryError
from canopen.objectdictionary.datatypes import NUMBER_TYPES

from drivers.canopen.object_access import ABORT_TEXT, object_name
from drivers.drive import Reading
from drivers.errors import DeviceError

PERIOD_S = 1.0
QUIET_S = 0.05  # nobody else may have used the SDO channel for so long: it is one for all masters
_UPLOAD, _ABORT = 0x40, 0x80  # command specifiers of CiA 301, 7.2.4.3
_ANSWERS = 16  # that may wait between two looks; others on the bus may use the same SDO channel
_WIDEST_BITS = 32  # of an expedited answer


@dataclass(frozen=True)
class TemperatureObject:
    """Which object tells the temperature: `unit_degC` times its value, and `offset_degC`."""

    index: int
    sub: int = 0
    unit_degC: float = 1.0
    offset_degC: float = 0.0


class Thermometer:
    """Call `poll` often; it sends a request a second and returns what has come of the one before."""

    def __init__(
        self,
        network: canopen.Network,
        node: canopen.RemoteNode,
        wanted: TemperatureObject,
        eds_name: str,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`DeviceError` if the EDS has no such number."""
        self._network, self._wanted, self._clock_ns = network, wanted, clock_ns
        self._name = f"object {object_name(wanted.index, wanted.sub)} (temperature)"
        variable: Any = node.object_dictionary.get_variable(wanted.index, wanted.sub)
        if variable is None or variable.data_type not in NUMBER_TYPES or len(variable) > _WIDEST_BITS:
            raise DeviceError(
                f"EDS {eds_name} has no {self._name} that is a number of at most {_WIDEST_BITS} bits",
                "correct drive.temperature_object, or leave it out",
            )
        self._variable = variable
        self._rx, self._tx = node.sdo.rx_cobid, node.sdo.tx_cobid
        self._answers: deque[tuple[int, bytes]] = deque(maxlen=_ANSWERS)
        self._open = False  # whether a request waits for its answer
        self._next_ns = self._quiet_ns = clock_ns()  # not before both
        network.subscribe(self._tx, self._on_answer)

    def _on_answer(self, _: int, data: bytearray, __: float) -> None:
        """In the receiving thread; judged in `poll`."""
        self._answers.append((self._clock_ns(), bytes(data)))

    def poll(self) -> Reading | None:
        """What is new, or None.  Never waits and never raises for what the drive or the bus does."""
        found = None
        while self._answers:
            came_ns, data = self._answers.popleft()
            if self._open and (reading := self._judged(came_ns, data)) is not None:
                self._open, found = False, reading
            else:
                self._quiet_ns = came_ns + round(QUIET_S * 1e9)
        now_ns = self._clock_ns()
        if now_ns < max(self._next_ns, self._quiet_ns):
            return found
        if self._open:
            found = Reading(now_ns, None, f"{self._name}: no answer within {PERIOD_S:g} s")
        self._next_ns = now_ns + round(PERIOD_S * 1e9)
        self._open = True
        try:
            request = struct.pack("<BHB4x", _UPLOAD, self._wanted.index, self._wanted.sub)
            self._network.send_message(self._rx, request)
        except (can.CanError, OSError):  # the loop sees what is wrong with the bus, and says so
            self._open = False
        return found

    def _judged(self, came_ns: int, data: bytes) -> Reading | None:
        """The reading in an answer of the SDO server; None if it belongs to somebody else's request."""
        if len(data) != 8 or struct.unpack_from("<HB", data, 1) != (self._wanted.index, self._wanted.sub):
            return None
        if data[0] == _ABORT:
            (code,) = struct.unpack_from("<I", data, 4)
            return Reading(came_ns, None, f"{self._name}: {ABORT_TEXT.get(code, 'refused')} (SDO abort {code:08X}h)")
        if data[0] & 0xE0 != _UPLOAD:
            return None
        size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
        value = self._number(data[4 : 4 + size]) if data[0] & 2 else None
        if value is None:
            return Reading(came_ns, None, f"{self._name}: {len(self._variable)} bits are expected, not {data.hex()}")
        return Reading(came_ns, self._wanted.unit_degC * value + self._wanted.offset_degC)

    def _number(self, data: bytes) -> float | None:
        """None if it is none; a server may answer with more bytes than the object has."""
        try:
            value = self._variable.decode_raw(data[: len(self._variable) // 8])
        except (ObjectDictionaryError, ValueError, OverflowError, struct.error):
            return None
        return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
