"""The virtual encoder node: a CiA 406 absolute encoder on the joint, beside the virtual drive.

Boot-up, NMT, heartbeat, EMCY, one TPDO (6004) at SYNC (types 1 to 240) or by its event timer or 6200 (254, 255).
Its object dictionary and SDO server are laid over its record inside the virtual drive's memory.
Not modelled: preset (6003), speed (6030), cams, work areas, node guarding, the inhibit time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.hil.canopen.cia402_core import COB_ID_INVALID, push_frame
from jointctl.hil.canopen.dictionary import ObjectDictionary, check_write, field_view, load_entries
from jointctl.hil.canopen.records import (
    ENCODER_FIELDS,
    ENCODER_MAPPED,
    EVENT_DRIVEN,
    LAST_SYNCHRONOUS,
    EncoderNode,
    NmtState,
    int64,
)
from jointctl.hil.canopen.sdo import SdoServer
from jointctl.hil.virtual_bus import FrameQueue

_MS = 1_000_000
POSITION_ALARM = 1  # bit of 6503


@kernel
def restart_encoder(node: EncoderNode) -> None:
    """Restore the defaults and boot again."""
    node.objects = node.default_objects
    node.nmt = NmtState.BOOT_UP
    node.boot_pending = 1
    node.heartbeat_due_ns = 0
    node.tpdo_due_ns = 0
    node.syncs = 0


@kernel
def sample_position(node: EncoderNode, reading_rad: float) -> None:
    """6004: the nearest count of the joint angle that the disc shows, modulo the total measuring range."""
    if node.stuck == 0:
        counts = (reading_rad + node.error_rad) * node.counts_prad + node.offset_counts
        node.stuck_counts = math.floor(counts + 0.5)
    range_counts = int64(node.objects.range_counts)
    node.objects.position = int64(node.stuck_counts) % range_counts


@kernel
def _mapped_value(node: EncoderNode, entry: int) -> int:
    key = entry >> 8
    if key == 0x600400:
        return int64(node.objects.position)
    if key == 0x650300:
        return int64(node.objects.alarms)
    if key == 0x650500:
        return int64(node.objects.warnings)
    return 0


@kernel
def _send_tpdo(node: EncoderNode, reading_rad: float, queue: FrameQueue) -> None:
    group = node.objects
    sample_position(node, reading_rad)
    slot = push_frame(queue, int64(group.tpdo_cob_id) & 0x7FF, 0)
    if slot < 0:
        return
    size = 0
    for i in range(min(int64(group.tpdo_count), ENCODER_MAPPED)):
        entry = int64(group.tpdo_mapping[i])
        value = _mapped_value(node, entry)
        for _ in range((entry & 0xFF) // 8):
            queue.frames[slot, 8 + size] = value & 0xFF
            size += 1
            value >>= 8
    queue.frames[slot, 4] = size


@kernel
def _tell_errors(node: EncoderNode, queue: FrameQueue) -> None:
    """EMCY when an error comes or goes; 6503 and 1001 with it."""
    code = int64(node.error_code)
    node.objects.alarms = POSITION_ALARM if code != 0 else 0
    node.objects.error_register = 0x21 if code != 0 else 0
    if code == node.sent_error:
        return
    node.sent_error = code
    cob_id = int64(node.objects.emcy_cob_id)
    if cob_id & COB_ID_INVALID or node.nmt == NmtState.STOPPED:
        return
    slot = push_frame(queue, cob_id & 0x7FF, 8)
    if slot >= 0:
        queue.frames[slot, 8] = code & 0xFF
        queue.frames[slot, 9] = code >> 8 & 0xFF
        queue.frames[slot, 10] = node.objects.error_register


@kernel
def step_encoder(node: EncoderNode, reading_rad: float, now_ns: int, queue: FrameQueue) -> None:
    """Timers: boot-up, heartbeat, errors, the event-driven TPDO.  Does nothing where there is no node."""
    if node.node_id == 0:
        return
    sample_position(node, reading_rad)
    if node.boot_pending != 0:
        node.boot_pending = 0
        node.nmt = NmtState.PRE_OPERATIONAL
        push_frame(queue, 0x700 + node.node_id, 1)
    _tell_errors(node, queue)
    heartbeat_ns = int64(node.objects.heartbeat_ms) * _MS
    if heartbeat_ns != 0 and now_ns >= node.heartbeat_due_ns:
        node.heartbeat_due_ns = now_ns + heartbeat_ns
        slot = push_frame(queue, 0x700 + node.node_id, 1)
        if slot >= 0:
            queue.frames[slot, 8] = node.nmt
    group = node.objects
    timer_ns = (int64(group.tpdo_timer_ms) or int64(group.cyclic_timer_ms)) * _MS
    sends = node.nmt == NmtState.OPERATIONAL and not int64(group.tpdo_cob_id) & COB_ID_INVALID
    if sends and group.tpdo_type >= EVENT_DRIVEN and timer_ns != 0 and now_ns >= node.tpdo_due_ns:
        node.tpdo_due_ns = now_ns + timer_ns
        _send_tpdo(node, reading_rad, queue)


@kernel
def accept_encoder_frame(
    node: EncoderNode, reading_rad: float, identifier: int, frame: np.ndarray, queue: FrameQueue
) -> None:
    """NMT and SYNC; SDO is answered elsewhere, everything else is foreign.  `frame` is a data frame of 11 bits."""
    if node.node_id == 0 or node.nmt == NmtState.BOOT_UP:
        return
    if identifier == 0 and frame[4] == 2 and (frame[9] == 0 or frame[9] == node.node_id):
        command = int64(frame[8])
        if command == 0x01:
            node.nmt = NmtState.OPERATIONAL
            node.syncs = 0
        elif command == 0x02:
            node.nmt = NmtState.STOPPED
        elif command == 0x80:
            node.nmt = NmtState.PRE_OPERATIONAL
        elif command == 0x81 or command == 0x82:
            restart_encoder(node)
    elif node.nmt == NmtState.OPERATIONAL and identifier == int64(node.objects.sync_cob_id) & 0x7FF:
        group = node.objects
        if int64(group.tpdo_cob_id) & COB_ID_INVALID or not 1 <= group.tpdo_type <= LAST_SYNCHRONOUS:
            return
        node.syncs += 1
        if node.syncs >= group.tpdo_type:
            node.syncs = 0
            _send_tpdo(node, reading_rad, queue)


# --- Its object dictionary and SDO server ---


@dataclass(frozen=True)
class EncoderSettings:
    """An encoder on the joint: its reading at joint angle 0 is `zero_counts`."""

    eds_path: Path
    node_id: int
    counts_per_turn: int
    direction: int = 1
    zero_counts: int = 0
    range_counts: int = 1 << 31

    def __post_init__(self) -> None:
        for name, low, high in (
            ("node_id", 1, 127),
            ("counts_per_turn", 4, 0xFFFFFFFF),
            ("range_counts", self.counts_per_turn, 0xFFFFFFFF),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} (={value}) must be in [{low}..{high}]")
        if self.direction not in (-1, 1):
            raise ValueError(f"direction (={self.direction}) must be 1 or -1")


class EncoderDictionary(ObjectDictionary):
    """Values of the encoder node's objects."""

    def __init__(self, eds_path: Path, node_id: int, memory: np.recarray) -> None:
        self._take_entries(load_entries(eds_path, node_id))
        for key, field in ENCODER_FIELDS.items():
            if key not in self.entries:
                raise ValueError(f"{eds_path.name}: object {key[0]:04X}:{key[1]} must be there, the encoder uses it")
            self._live[key] = field_view(memory, ("encoder", "objects"), field)
            self._initial[key] = field_view(memory, ("encoder", "default_objects"), field)
            self.set_default(*key, int(self.entries[key].default))
        self.restore_strings()


class VirtualEncoder:
    """Sets up the node inside `memory` (a `Device` record array) and answers its SDO requests."""

    def __init__(self, settings: EncoderSettings, memory: np.recarray) -> None:
        self.settings = settings
        self.node = memory[0].encoder
        self.node.node_id = settings.node_id
        self.node.counts_prad = settings.direction * settings.counts_per_turn / math.tau
        self.node.offset_counts = settings.zero_counts
        self.objects = EncoderDictionary(settings.eds_path, settings.node_id, memory)
        self.objects.set_default(0x6001, 0, settings.counts_per_turn)
        self.objects.set_default(0x6002, 0, settings.range_counts)
        self.sdo = SdoServer(self.objects, self._write)
        restart_encoder(self.node)

    def _write(self, index: int, sub: int, data: bytes) -> None:
        value = self.objects.check(index, sub, data)
        check_write(self.objects, index, sub, value, 0)
        self.objects.store(index, sub, data)

    @property
    def answers_sdo(self) -> bool:
        """Whether SDO is alive in its NMT state."""
        return self.node.nmt not in (NmtState.BOOT_UP, NmtState.STOPPED)
