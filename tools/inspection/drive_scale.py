"""Whether the counts that the configuration gives an encoder are the ones that the drive itself gives it (608F)."""

from __future__ import annotations

from drivers.errors import JointctlError
from tools.configuration.config import Config
from tools.inspection.findings import NOTE, OK, Finding
from tools.inspection.sdo_reading import Refusal, SdoReader
from tools.inspection.subject import canopen_network, subject_of_config

TOLERANCE = 0.001
_CURE = "encoder.counts_per_turn, encoder.side, joint.reduction_ratio; or the drive scales 6064 by 6091 and 6092: "
_CURE += "then turn the joint by hand by 90 deg with the power off and compare"


def scale_finding(config: Config) -> Finding | None:
    """None where the drive does not tell; CiA 402-2: 608F:1 increments in 608F:2 motor revolutions.  Reads only."""
    if config.is_serial:
        return None
    try:
        with canopen_network(subject_of_config(config)) as network:
            reader = SdoReader(network, config.canopen.node)
            values = [reader.upload(0x608F, sub) for sub in (1, 2)]
    except JointctlError:
        return None  # commissioning says it better
    increments, turns = (0 if isinstance(value, Refusal) else int.from_bytes(value, "little") for value in values)
    if not increments or not turns:
        return None
    return judged(config, increments / turns)


def judged(config: Config, counts_per_motor_turn: float) -> Finding:
    """The drive's counts of one motor turn against the configuration's."""
    own, ratio = config.encoder.counts_per_turn, config.joint.reduction_ratio
    expected = [counts_per_motor_turn]
    if config.encoder.side == "joint":
        expected.append(counts_per_motor_turn * ratio)
    factors = [own / counts for counts in expected]
    numbers = {"counts_per_motor_turn": counts_per_motor_turn}
    text = f"encoder.counts_per_turn is {own}, 608F of the drive says {counts_per_motor_turn:.6g} a motor turn"
    if any(abs(factor - 1.0) < TOLERANCE for factor in factors):
        return Finding("counts", OK, text, "", numbers)
    shown = " or ".join(f"{factor:.4g}" for factor in factors)
    return Finding("counts", NOTE, f"{text}: {shown} times as many", _CURE, numbers)
