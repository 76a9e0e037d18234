"""SDO traffic in words: what is read or written, the value, segments, and abort codes.

One transfer per node and time, as CiA 301 has it.  The bytes of a segmented transfer are gathered, so that its value
is told with its last segment.  Of a block transfer only beginning and end are told.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from jointctl.tools.inspection.objects import Objects, Place
from jointctl.tools.inspection.sdo_reading import abort_text

_LONGEST = 1 << 16  # of a transfer that is gathered
Learn = Callable[[int, int, int, int], None]  # node, index, sub-index, value


@dataclass
class _Transfer:
    place: Place | None = None
    data: bytearray = field(default_factory=bytearray)
    upload: bool = True
    pending: bytes = b""  # of an expedited download, told once it is confirmed


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
    return "a number of bytes that is not told," if size is None else f"{size} bytes"


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
