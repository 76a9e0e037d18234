"""Position counters of 32 bits that run over, as every drive reports them."""

from __future__ import annotations

from typing import Protocol

from jointctl.firmware_py.kernel import kernel

WRAP = 1 << 32
HALF_WRAP = 1 << 31


class PositionCounter(Protocol):
    """What any driver's record has of it."""

    primed: int
    last_counts: int  # as received
    counts: int  # unwrapped


@kernel
def take_counts(port: PositionCounter, counts: int) -> None:
    """Unwrap the 32 bit position: the joint moves less than half the range between two samples."""
    if port.primed == 0:
        port.primed = 1
        port.counts = counts
    else:
        step = counts - port.last_counts
        if step >= HALF_WRAP:
            step -= WRAP
        elif step < -HALF_WRAP:
            step += WRAP
        port.counts += step
    port.last_counts = counts
