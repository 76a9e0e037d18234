"""What commissioning has to know about a second encoder of the joint: see the section [joint_encoder]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

DRIVE_RANGE_COUNTS = 1 << 32  # of an object of the drive: a signed 32 bit number that runs over


@dataclass(frozen=True)
class JointEncoderSettings:
    """An encoder node of its own (`node`), else the object of the drive that holds its position."""

    counts_per_turn: int  # of the joint
    direction: int
    zero_counts: int
    incremental: bool  # it takes the angle of the other encoder when a run begins
    feeds_law: bool
    node: int | None = None
    eds_path: Path | None = None  # of the node
    index: int = 0x60E4
    sub: int = 1

    @property
    def rad_per_count(self) -> float:
        """Joint angle of one count, direction included."""
        return self.direction * math.tau / self.counts_per_turn
