"""The encoder node's object dictionary and SDO server, laid over its record inside the virtual drive's memory."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jointctl.hil.canopen.dictionary import ObjectDictionary, check_write, field_view, load_entries
from jointctl.hil.canopen.encoder_core import restart_encoder
from jointctl.hil.canopen.records import ENCODER_FIELDS, NmtState
from jointctl.hil.canopen.sdo import SdoServer


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

    def __init__(self, eds_path: Path, node_id: int, memory: Any) -> None:
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

    def __init__(self, settings: EncoderSettings, memory: Any) -> None:
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
