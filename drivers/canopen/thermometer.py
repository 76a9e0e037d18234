"""The drive's temperature while the loop runs: one SDO upload a second, asked and answered without waiting.

CiA 402 has no object for it; the configuration names the drive's own.  Whatever goes wrong with it (abort, no answer,
nonsense) makes the temperature unknown and nothing else.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from typing import Any

import canopen
from canopen.objectdictionary import ObjectDictionaryError
from canopen.objectdictionary.datatypes import NUMBER_TYPES

from jointctl.drivers.canopen.sdo import SdoReads, object_name
from jointctl.drivers.canopen.settings import TemperatureObject
from jointctl.drivers.drive import Reading
from jointctl.drivers.errors import DeviceError

PERIOD_S = 1.0
_WIDEST_BITS = 32  # of an expedited answer


class Thermometer:
    """Call `poll` often; it sends a request a second and returns what has come of the one before."""

    def __init__(
        self,
        network: canopen.Network,
        node: canopen.RemoteNode,
        wanted: TemperatureObject,
        eds_name: str,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        reads: SdoReads | None = None,
    ) -> None:
        """`reads`: those of the same node, which has one SDO channel.  `DeviceError` if the EDS has no such number."""
        self._wanted = wanted
        self._name = f"object {object_name(wanted.index, wanted.sub)} (temperature)"
        variable: Any = node.object_dictionary.get_variable(wanted.index, wanted.sub)
        if variable is None or variable.data_type not in NUMBER_TYPES or len(variable) > _WIDEST_BITS:
            raise DeviceError(
                f"EDS {eds_name} has no {self._name} that is a number of at most {_WIDEST_BITS} bits",
                "correct drive.temperature_object, or leave it out",
            )
        self._variable = variable
        self._newest: Reading | None = None
        self._reads = reads or SdoReads(network, node, clock_ns)
        self._reads.add(wanted.index, wanted.sub, PERIOD_S, self._on_answer)

    def _on_answer(self, time_ns: int, data: bytes | None, problem: str) -> None:
        value = self._number(data) if data is not None else None
        if value is not None:
            self._newest = Reading(time_ns, self._wanted.unit_degC * value + self._wanted.offset_degC)
            return
        if data is not None:
            problem = f"{len(self._variable)} bits are expected, not {data.hex()}"
        self._newest = Reading(time_ns, None, f"{self._name}: {problem}")

    def poll(self) -> Reading | None:
        """What is new, or None.  Never waits and never raises for what the drive or the bus does."""
        self._reads.poll()
        found, self._newest = self._newest, None
        return found

    def _number(self, data: bytes) -> float | None:
        """None if it is none; a server may answer with more bytes than the object has."""
        try:
            value = self._variable.decode_raw(data[: len(self._variable) // 8])
        except (ObjectDictionaryError, ValueError, OverflowError, struct.error):
            return None
        return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
