"""Whether the counts that the configuration gives an encoder are the ones that the drive itself gives it (608F)."""

from __future__ import annotations

from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.findings import NOTE, OK, Finding

TOLERANCE = 0.001
_CURE = "encoder.counts_per_turn, encoder.side, joint.reduction_ratio; or the drive scales 6064 by 6091 and 6092: "
_CURE += "then turn the joint by hand by 90 deg with the power off and compare"


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
