"""Position counters of 32 bits that run over, as every drive reports them."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.kernel import kernel

WRAP = 1 << 32
HALF_WRAP = 1 << 31


@kernel
def take_counts(port: Any, counts: int) -> None:
    """Unwrap the 32 bit position: the joint moves less than half the range between two samples.

    `port` is any driver's record with the fields primed, last_counts (as received) and counts (unwrapped).
    """
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
