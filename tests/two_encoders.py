"""The virtual joint with a second encoder: its configuration, and the frames of both positions."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import accept_frame, begin_cycle
from jointctl.firmware_py.schema import new
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from tests.configurations import written

NODE = {
    "source": "node", "node": 2, "counts_per_turn": 524288, "direction": 1, "zero_counts": 100_000,
    "disagreement_max_rad": 0.005,
}  # fmt: skip


def config_with(folder: Path, encoder: dict[str, Any] | None = None, **changes: Any) -> Config:
    """configs/virtual.toml changed; with `encoder` as its [joint_encoder], its own one is on the motor."""
    if encoder is not None:
        changes = {"joint_encoder": encoder, "encoder__side": "motor", "encoder__counts_per_turn": 65536, **changes}
    return load_config(written(folder / "joint.toml", **changes))


def short_run(folder: Path, encoder: dict[str, Any], **changes: Any) -> Config:
    """A second of the trajectory, from position zero."""
    short = {"trajectory__duration_s": 1.0, "virtual__initial_position_rad": 0.0}
    return config_with(folder, encoder, **{**short, **changes})


def port_of(folder: Path, encoder: dict[str, Any], **changes: Any) -> Any:
    from jointctl.drivers.canopen.pdo import new_port

    return new_port(canopen_settings(short_run(folder, encoder, **changes)), 0.06, 1000, second_range_counts=1 << 20)


def cycle(port: Any, sample: Any, first: int | None, second: int | None) -> None:
    """One SYNC, and the TPDOs that answer it."""
    begin_cycle(port[0], new(Frame, 4))
    tell(port, sample, first, second)


def tell(port: Any, sample: Any, first: int | None, second: int | None) -> None:
    """The TPDOs of drive and encoder."""
    if first is not None:
        hear(port, sample, 0x181, struct.pack("<HiH", 0x1237, first, 0))
    if second is not None:
        hear(port, sample, 0x182, struct.pack("<I", second))


def hear(port: Any, sample: Any, identifier: int, data: bytes) -> None:
    """One frame of drive or encoder."""
    frame = new(Frame)[0]
    frame.can_id, frame.length = identifier, len(data)
    frame.payload[: len(data)] = np.frombuffer(data, np.uint8)
    accept_frame(port[0], frame, sample, 1)
