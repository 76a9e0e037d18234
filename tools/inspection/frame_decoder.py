"""CANopen frames in words: by the predefined connection set of CiA 301 and what is known of PDOs and objects.

What a PDO maps comes from wherever it is to be had, later beating earlier: what `jointctl run` sets up for the
configured node, the defaults of the EDS, what the drive reports when it is read, and SDO traffic on the bus.

Of SDO there is one transfer per node and time, as CiA 301 has it.  The bytes of a segmented transfer are gathered, so
that its value is shown with its last segment.  Of a block transfer only beginning and end are shown.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import can
import canopen

from jointctl.drivers.can.socketcan import error_frame_text
from jointctl.drivers.canopen.cia import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NMT_ID,
    NODE_MASK,
    RPDO1_ID,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO1_ID,
)
from jointctl.drivers.canopen.pdo import (
    CONTROL,
    DISABLED,
    POSITION,
    STATUS,
    TARGET_POSITION,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    TORQUE,
    TORQUE_OFFSET,
    VELOCITY_OFFSET,
    MappedObject,
)
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.tools.inspection.objects import NMT_COMMANDS, SIGNED, Objects, Place, error_register_text, nmt_state
from jointctl.tools.inspection.subject import abort_text
from jointctl.tools.session.fault_words import emergency_text

# --- PDO ---

PREDEFINED = 4  # PDOs of each direction in the predefined connection set
_SPAN = 0x200
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_BASES = {True: (_TPDO, _TPDO_MAP, TPDO1_ID), False: (_RPDO, _RPDO_MAP, RPDO1_ID)}
_PDO_STEP = 0x100  # between the identifiers of a node's PDOs
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
            cob_id = _BASES[transmit][2] + _PDO_STEP * (number - 1) + node if number <= PREDEFINED else None
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

    def learn_loop(self, node: int, sent: tuple[tuple[MappedObject, ...], ...] = ((CONTROL, TARGET_TORQUE),)) -> None:
        """What `jointctl run` and `sweep` set up: statusword, position, torque; the RPDOs that are `sent`."""
        for transmit, pdos in ((True, ((STATUS, POSITION, TORQUE),)), (False, sent)):
            for number in range(1, PREDEFINED + 1):
                pdo = self.of(node, transmit, number)
                pdo.enabled = number <= len(pdos)
                if not pdo.enabled:
                    continue
                mapped = pdos[number - 1]
                pdo.cob_id, pdo.count = _BASES[transmit][2] + _PDO_STEP * (number - 1) + node, len(mapped)
                pdo.slots = {slot: item.entry() for slot, item in enumerate(mapped, start=1)}
        self._index()


def sent_by_loop(settings: CanopenSettings) -> tuple[tuple[MappedObject, ...], ...]:
    """The objects in each RPDO of a run."""
    targets = {"csp": TARGET_POSITION, "csv": TARGET_VELOCITY, "pv": TARGET_VELOCITY}
    first: tuple[MappedObject, ...] = (CONTROL, targets.get(settings.mode, TARGET_TORQUE))
    if settings.torque_offset:
        first = (*first, TORQUE_OFFSET)
    return (first, (VELOCITY_OFFSET,)) if settings.velocity_offset else (first,)


# --- SDO ---

_LONGEST = 1 << 16  # of a transfer that is gathered
Learn = Callable[[int, int, int, int], None]  # node, index, sub-index, value


@dataclass
class _Transfer:
    place: Place | None = None
    data: bytearray = field(default_factory=bytearray)
    upload: bool = True
    pending: bytes = b""  # of an expedited download, reported once it is confirmed


class SdoFrames:
    """`request` and `response` take the 8 bytes of a frame; `learn` gets every integer that was transferred."""

    def __init__(self, objects: Callable[[int], Objects], learn: Learn | None = None) -> None:
        self._objects = objects
        self._learn = learn
        self._transfers: dict[int, _Transfer] = {}

    def _transfer(self, node: int) -> _Transfer:
        return self._transfers.setdefault(node, _Transfer())

    def _named(self, node: int, place: Place | None) -> str:
        if place is None:
            return "an unknown object"
        name = self._objects(node).name(place.index, place.sub)
        return f"{place} {name}".rstrip()

    def _value(self, node: int, place: Place, data: bytes) -> tuple[str, dict[str, Any]]:
        objects = self._objects(node)
        value = objects.value(place.index, place.sub, data)
        if self._learn is not None and isinstance(value, int):
            self._learn(node, place.index, place.sub, value)
        shown = value.hex() if isinstance(value, bytes) else value
        return objects.text(place.index, place.sub, data), {"value": shown}

    def request(self, node: int, data: bytes) -> tuple[str, dict[str, Any]]:
        """Text and fields of a frame to the node."""
        return self._frame(node, data, True)

    def response(self, node: int, data: bytes) -> tuple[str, dict[str, Any]]:
        """Text and fields of a frame from the node."""
        return self._frame(node, data, False)

    def _frame(self, node: int, data: bytes, to_node: bool) -> tuple[str, dict[str, Any]]:
        if len(data) != 8:
            return f"malformed: {len(data)} bytes instead of 8", {"malformed": True}
        command, (index, sub) = data[0] >> 5, struct.unpack_from("<HB", data, 1)
        place = Place(index, sub)
        if data[0] == 0x80:
            return self._abort(node, place, struct.unpack_from("<I", data, 4)[0])
        if command in (5, 6):
            return self._block(node, command, data, place)
        handler = (_REQUESTS if to_node else _RESPONSES).get(command)
        if handler is None:
            return f"unknown command {data[0]:02X}h", {"malformed": True}
        return handler(self, node, data, place)

    def _abort(self, node: int, place: Place, code: int) -> tuple[str, dict[str, Any]]:
        transfer = self._transfers.pop(node, _Transfer())
        if place == Place(0) and transfer.place is not None:
            place = transfer.place  # the canopen library does not name it
        return f"abort {self._named(node, place)}: {abort_text(code)}", _fields(place, abort_code=code)

    def _block(self, node: int, command: int, data: bytes, place: Place) -> tuple[str, dict[str, Any]]:
        initiate = (command == 6 and not data[0] & 1) or (command == 5 and data[0] & 3 == 0)
        text = f"block transfer of {self._named(node, place)}" if initiate else "block transfer goes on"
        return text, _fields(place) if initiate else {}

    # --- to the node ---

    def _start_upload(self, node: int, _: bytes, place: Place) -> tuple[str, dict[str, Any]]:
        self._transfers[node] = _Transfer(place)
        return f"read {self._named(node, place)}", _fields(place)

    def _start_download(self, node: int, data: bytes, place: Place) -> tuple[str, dict[str, Any]]:
        transfer = self._transfers[node] = _Transfer(place, upload=False)
        if data[0] & 2:
            transfer.pending = _expedited(data, self._objects(node), place)
            objects = self._objects(node)
            value = objects.value(place.index, place.sub, transfer.pending)
            text = f"write {self._named(node, place)} = {objects.text(place.index, place.sub, transfer.pending)}"
            return text, _fields(place, value=value.hex() if isinstance(value, bytes) else value)
        size = struct.unpack_from("<I", data, 4)[0] if data[0] & 1 else None
        return f"write {self._named(node, place)}, {_bytes(size)} in segments", _fields(place, size=size)

    def _ask_segment(self, node: int, _: bytes, __: Place) -> tuple[str, dict[str, Any]]:
        return "read next segment", _fields(self._transfer(node).place)

    def _put_segment(self, node: int, data: bytes, _: Place) -> tuple[str, dict[str, Any]]:
        transfer = self._transfer(node)
        part = data[1 : 8 - (data[0] >> 1 & 7)]
        if len(transfer.data) < _LONGEST:
            transfer.data += part
        if data[0] & 1 and transfer.place is not None:
            text, fields = self._value(node, transfer.place, bytes(transfer.data))
            return f"last segment: {self._named(node, transfer.place)} = {text}", _fields(transfer.place, **fields)
        return f"segment of {len(part)} bytes", _fields(transfer.place)

    # --- from the node ---

    def _uploaded(self, node: int, data: bytes, place: Place) -> tuple[str, dict[str, Any]]:
        if data[0] & 2:
            text, fields = self._value(node, place, _expedited(data, self._objects(node), place))
            return f"{self._named(node, place)} = {text}", _fields(place, **fields)
        self._transfers[node] = _Transfer(place)
        size = struct.unpack_from("<I", data, 4)[0] if data[0] & 1 else None
        return f"{self._named(node, place)}: {_bytes(size)} in segments", _fields(place, size=size)

    def _written(self, node: int, _: bytes, place: Place) -> tuple[str, dict[str, Any]]:
        transfer = self._transfer(node)
        if transfer.place == place and transfer.pending:
            self._value(node, place, transfer.pending)
            transfer.pending = b""
        return f"written {self._named(node, place)}", _fields(place)

    def _segment_written(self, node: int, _: bytes, __: Place) -> tuple[str, dict[str, Any]]:
        return "segment taken", _fields(self._transfer(node).place)


def _fields(place: Place | None, **more: Any) -> dict[str, Any]:
    return {} if place is None else {"object": str(place), **more}


def _bytes(size: int | None) -> str:
    return "a number of bytes that is not given," if size is None else f"{size} bytes"


def _expedited(data: bytes, objects: Objects, place: Place) -> bytes:
    """The data of an expedited transfer; without a size, as long as the object's type."""
    if data[0] & 1:
        return data[4 : 8 - (data[0] >> 2 & 3)]
    variable = objects.variable(place.index, place.sub)
    return data[4 : 4 + (len(variable) // 8 if variable is not None and variable.fixed_size else 4)]


# the command specifier, three upper bits, means another thing in each direction (CiA 301, 7.2.4.3)
_REQUESTS = {
    0: SdoFrames._put_segment, 1: SdoFrames._start_download, 2: SdoFrames._start_upload, 3: SdoFrames._ask_segment,
}  # fmt: skip
_RESPONSES = {
    0: SdoFrames._put_segment, 1: SdoFrames._segment_written, 2: SdoFrames._uploaded, 3: SdoFrames._written,
}  # fmt: skip


# --- all frames ---

KINDS = ("nmt", "sync", "time", "emcy", "pdo", "sdo", "heartbeat", "lss", "error", "other")


@dataclass(frozen=True)
class Decoded:
    """`node` is 0 for what concerns all or none; `fields` are for --json."""

    kind: str
    node: int
    text: str
    fields: dict[str, Any] = field(default_factory=dict)


class FrameDecoder:
    """`objects` of the nodes whose EDS is at hand; all others are decoded by the standard's table."""

    def __init__(self, objects: Mapping[int, Objects], maps: PdoMaps) -> None:
        self._objects = dict(objects)
        self._standard = Objects()
        self.maps = maps
        self._sdo = SdoFrames(self._of, maps.learn)

    def _of(self, node: int) -> Objects:
        return self._objects.get(node, self._standard)

    def decode(self, message: can.Message) -> Decoded:
        """Any frame; one that is not of CANopen is `other`."""
        if message.is_error_frame:
            text = error_frame_text(message.arbitration_id, bytes(message.data))
            return Decoded("error", 0, text, {"class": message.arbitration_id & 0x1FFFFFFF})
        cob_id, data = message.arbitration_id, bytes(message.data)
        if message.is_extended_id or message.is_fd:
            return Decoded("other", 0, "extended identifier" if message.is_extended_id else "CAN FD")
        if message.is_remote_frame:
            guard = cob_id & FUNCTION_MASK == HEARTBEAT_ID
            return Decoded(
                "heartbeat" if guard else "other", cob_id & NODE_MASK, "node guarding request" if guard else "RTR"
            )
        if cob_id == NMT_ID:
            return _nmt(data)
        if cob_id == SYNC_ID:
            return Decoded("sync", 0, f"SYNC {data[0]}" if data else "SYNC")
        if cob_id == 0x100:
            return Decoded("time", 0, "TIME")
        if cob_id in (0x7E4, 0x7E5):
            return Decoded("lss", 0, f"LSS {'answer' if cob_id == 0x7E4 else 'request'} {data[0] if data else 0:02X}h")
        function, node = cob_id & FUNCTION_MASK, cob_id & NODE_MASK
        pdo = self.maps.at(cob_id)
        if pdo is not None and (pdo.enabled or TPDO1_ID <= cob_id < SDO_ANSWER_ID):
            return self._pdo(pdo, data)
        if function == EMERGENCY_ID:
            return _emergency(node, data)
        if function == SDO_ANSWER_ID:
            text, fields = self._sdo.response(node, data)
            return Decoded("sdo", node, f"< {text}", fields)
        if function == SDO_REQUEST_ID:
            text, fields = self._sdo.request(node, data)
            return Decoded("sdo", node, f"> {text}", fields)
        if function == HEARTBEAT_ID:
            return _heartbeat(node, data)
        return Decoded("other", 0, "")

    def _pdo(self, pdo: PdoMap, data: bytes) -> Decoded:
        objects = self._of(pdo.node)
        values = list(pdo.values(data, objects))
        fields: dict[str, Any] = {"pdo": pdo.name, "values": {str(Place(i, s)): value for i, s, _, value in values}}
        if not values:
            return Decoded("pdo", pdo.node, f"{pdo.name} {data.hex(' ')}", fields)
        texts = [
            f"{objects.name(i, s) or Place(i, s)} {objects.value_text(i, s, value, bits)}"
            for i, s, bits, value in values
        ]
        needed = (sum(bits for _, _, bits in pdo.entries) + 7) // 8
        if len(data) < needed:
            texts.append(f"too short: {len(data)} of {needed} bytes")
            fields["malformed"] = True
        return Decoded("pdo", pdo.node, f"{pdo.name} {', '.join(texts)}", fields)


def _nmt(data: bytes) -> Decoded:
    if len(data) < 2:
        return Decoded("nmt", 0, "malformed", {"malformed": True})
    command = NMT_COMMANDS.get(data[0], f"unknown command {data[0]}")
    node = data[1]
    return Decoded("nmt", node, f"{command}, {f'node {node}' if node else 'all nodes'}", {"command": data[0]})


def _emergency(node: int, data: bytes) -> Decoded:
    if len(data) < 3:
        return Decoded("emcy", node, f"malformed: {data.hex(' ')}", {"malformed": True})
    code, register = struct.unpack_from("<HB", data)
    text = "error reset or no error" if code & 0xFF00 == 0 else emergency_text(code)
    own = data[3:].rstrip(b"\0")
    text += f"; error register {error_register_text(register)}"
    text += f"; maker's data {data[3:].hex(' ')}" if own else ""
    return Decoded("emcy", node, text, {"code": code, "error_register": register})


def _heartbeat(node: int, data: bytes) -> Decoded:
    if len(data) != 1:
        return Decoded("heartbeat", node, f"malformed: {data.hex(' ')}", {"malformed": True})
    return Decoded("heartbeat", node, nmt_state(data[0]), {"state": data[0] & 0x7F})
