"""Which objects travel in which PDO, of every node on the bus, and how the bytes of a PDO are taken apart.

The knowledge comes from wherever it is to be had, later beating earlier: what `jointctl run` sets up for the
configured node, the defaults of the EDS, what the drive answers when it is asked, and SDO traffic that was overheard.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import canopen

from jointctl.drivers.canopen.identifiers import NODE_MASK, RPDO1_ID, SDO_ANSWER_ID, TPDO1_ID
from jointctl.drivers.canopen.pdo import (
    CONTROL,
    DISABLED,
    POSITION,
    STATUS,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    TORQUE,
)
from jointctl.tools.inspection.objects import SIGNED, Objects

PREDEFINED = 4  # PDOs of each direction in the predefined connection set
_SPAN = 0x200
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_BASES = {True: (_TPDO, _TPDO_MAP, TPDO1_ID), False: (_RPDO, _RPDO_MAP, RPDO1_ID)}
_FIRST_REAL_OBJECT = 0x20  # below are the data types, mapped to leave a gap
COB_MASK = 0x1FFFFFFF


@dataclass
class PdoMap:
    """One PDO of a node; `entries` are (index, sub-index, bits) in their order, None = not known."""

    node: int
    transmit: bool  # seen from the drive
    number: int  # from 1
    cob_id: int | None = None
    enabled: bool = True
    transmission: int | None = None
    count: int | None = None  # sub-index 0 of the mapping; None = all that is known
    slots: dict[int, int] = field(default_factory=dict)  # sub-index -> mapping entry

    @property
    def name(self) -> str:
        """TPDO1."""
        return f"{'T' if self.transmit else 'R'}PDO{self.number}"

    @property
    def entries(self) -> list[tuple[int, int, int]]:
        """What is mapped."""
        highest = max(self.slots, default=0) if self.count is None else self.count
        raw = [self.slots[sub] for sub in range(1, highest + 1) if sub in self.slots]
        return [(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in raw]

    def values(self, data: bytes, objects: Objects) -> Iterator[tuple[int, int, int, Any]]:
        """(index, sub, bits, value) of each mapped object; objects beyond the end of the frame are left out."""
        number, at = int.from_bytes(data, "little"), 0
        for index, sub, bits in self.entries:
            if at + bits > 8 * len(data):
                return
            value = number >> at & ((1 << bits) - 1)
            variable = objects.variable(index, sub)
            if variable is not None and variable.data_type in SIGNED and bits and value >> (bits - 1):
                value -= 1 << bits
            at += bits
            if index >= _FIRST_REAL_OBJECT:
                yield index, sub, bits, value


class PdoMaps:
    """All known PDOs; `at(cob_id)` finds the one that a frame belongs to."""

    def __init__(self) -> None:
        self._maps: dict[tuple[int, bool, int], PdoMap] = {}
        self._by_cob: dict[int, PdoMap] = {}

    def of(self, node: int, transmit: bool, number: int) -> PdoMap:
        """The PDO, made if it is new, with the identifier of the predefined connection set."""
        key = node, transmit, number
        if key not in self._maps:
            cob_id = _BASES[transmit][2] + 0x100 * (number - 1) + node if number <= PREDEFINED else None
            self._maps[key] = PdoMap(node, transmit, number, cob_id)
            self._index()
        return self._maps[key]

    def of_node(self, node: int) -> list[PdoMap]:
        """Known PDOs of a node, transmit PDOs first."""
        return [pdo for _, pdo in sorted(self._maps.items(), key=lambda item: (not item[0][1], item[0][2]))
                if pdo.node == node]  # fmt: skip

    def _index(self) -> None:
        """A disabled PDO keeps its identifier until another one claims it."""
        known = sorted(self._maps.values(), key=lambda pdo: pdo.enabled)
        self._by_cob = {pdo.cob_id: pdo for pdo in known if pdo.cob_id is not None}

    def at(self, cob_id: int) -> PdoMap | None:
        """Whose frame this is; by the predefined connection set where nothing better is known."""
        found = self._by_cob.get(cob_id)
        if found is not None or not TPDO1_ID <= cob_id < SDO_ANSWER_ID or not cob_id & NODE_MASK:
            return found
        transmit = bool(cob_id & 0x80)
        number = (cob_id - (TPDO1_ID if transmit else RPDO1_ID)) // 0x100 + 1
        return self.of(cob_id & NODE_MASK, transmit, number)

    def learn(self, node: int, index: int, sub: int, value: int) -> None:
        """Take the value of a PDO parameter of the drive; anything else is none of our business."""
        for transmit, (communication, mapping, _) in _BASES.items():
            if communication <= index < communication + _SPAN:
                pdo = self.of(node, transmit, index - communication + 1)
                if sub == 1:
                    pdo.cob_id, pdo.enabled = value & COB_MASK, not value & DISABLED
                    self._index()
                elif sub == 2:
                    pdo.transmission = value
            elif mapping <= index < mapping + _SPAN:
                pdo = self.of(node, transmit, index - mapping + 1)
                if sub == 0:
                    pdo.count = value
                else:
                    pdo.slots[sub] = value

    def learn_from_eds(self, dictionary: canopen.ObjectDictionary, node: int) -> None:
        """Default values (of a DCF: the configured ones) of the PDO parameters."""
        for index in dictionary:
            if not any(base <= index < base + _SPAN for base in (_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP)):
                continue
            entry = dictionary[index]
            subs = entry.subindices.items() if hasattr(entry, "subindices") else [(0, entry)]
            for sub, variable in subs:
                value = variable.value if variable.value is not None else variable.default
                if isinstance(value, int):
                    self.learn(node, index, sub, value)

    def learn_loop(self, node: int, velocity: bool = False) -> None:
        """What `jointctl run` and `sweep` set up: statusword, position, torque; controlword, target."""
        for transmit, mapped in (
            (True, (STATUS, POSITION, TORQUE)),
            (False, (CONTROL, TARGET_VELOCITY if velocity else TARGET_TORQUE)),
        ):
            pdo = self.of(node, transmit, 1)
            pdo.cob_id, pdo.enabled, pdo.count = _BASES[transmit][2] + node, True, len(mapped)
            pdo.slots = {number: item.entry() for number, item in enumerate(mapped, start=1)}
            for number in range(2, PREDEFINED + 1):
                self.of(node, transmit, number).enabled = False
        self._index()
