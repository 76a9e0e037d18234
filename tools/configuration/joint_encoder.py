"""[joint_encoder]: a second encoder of the joint, on the drive or as a node of its own.

The comment behind a key is its meaning, as in `sections`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from jointctl.tools.configuration.object_place import ObjectPlace
from jointctl.tools.configuration.sections import Direction, Node, Section, between


class JointEncoder(Section):
    """A second encoder of the joint; [encoder] is the drive's own (6064)."""

    source: Literal["drive", "node"]  # another object of the drive, or an encoder node (CiA 406) on the bus
    object: ObjectPlace = "60E4:1"  # of the drive
    node: Node | None = None  # of the encoder node
    eds: Annotated[str, Field(min_length=1)] = "joint_encoder.eds"  # of the encoder node
    counts_per_turn: Annotated[int, between(4, 2**31 - 1)]  # of the joint
    direction: Direction  # of its counts against the joint angle
    zero_counts: Annotated[int, between(-(2**31), 2**32 - 1)]  # its reading at joint angle 0
    kind: Literal["absolute", "incremental"] = "absolute"  # incremental: it takes the angle of [encoder] at the start
    law: Literal["encoder", "joint_encoder"] = "joint_encoder"  # which of the two feeds the law
    limits: Literal["encoder", "joint_encoder", "both"] = "both"  # which one the position limits are checked with
    disagreement_max_rad: Annotated[float, between(0.0, 1.0, open_low=True)]  # between the two, at the joint
    stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)] | None = (
        None  # of the reducer between them: torque / stiffness is allowed in addition
    )
