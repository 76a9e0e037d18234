"""CANopen frames in words, by the predefined connection set of CiA 301 and what is known of PDOs and objects."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import can

from jointctl.drivers.can.socketcan import error_frame_text
from jointctl.drivers.canopen.identifiers import (
    EMERGENCY_ID,
    FUNCTION_MASK,
    HEARTBEAT_ID,
    NMT_ID,
    NODE_MASK,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO1_ID,
)
from jointctl.tools.inspection import drive_words
from jointctl.tools.inspection.objects import Objects, Place
from jointctl.tools.inspection.pdo_maps import PdoMaps
from jointctl.tools.inspection.sdo_frames import SdoFrames
from jointctl.tools.session.fault_words import emergency_text

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

    def _pdo(self, pdo: Any, data: bytes) -> Decoded:
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
    command = drive_words.NMT_COMMANDS.get(data[0], f"unknown command {data[0]}")
    node = data[1]
    return Decoded("nmt", node, f"{command}, {f'node {node}' if node else 'all nodes'}", {"command": data[0]})


def _emergency(node: int, data: bytes) -> Decoded:
    if len(data) < 3:
        return Decoded("emcy", node, f"malformed: {data.hex(' ')}", {"malformed": True})
    code, register = struct.unpack_from("<HB", data)
    text = "error reset or no error" if code & 0xFF00 == 0 else emergency_text(code)
    own = data[3:].rstrip(b"\0")
    text += f"; error register {drive_words.error_register_text(register)}"
    text += f"; maker's data {data[3:].hex(' ')}" if own else ""
    return Decoded("emcy", node, text, {"code": code, "error_register": register})


def _heartbeat(node: int, data: bytes) -> Decoded:
    if len(data) != 1:
        return Decoded("heartbeat", node, f"malformed: {data.hex(' ')}", {"malformed": True})
    return Decoded("heartbeat", node, drive_words.nmt_state(data[0]), {"state": data[0] & 0x7F})
