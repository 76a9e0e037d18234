"""Random numbers whose state the caller keeps, so that a run repeats bit by bit: xorshift64.

Marsaglia's full-period triple of shifts (Xorshift RNGs, 2003); no product, which would overflow aloud in plain Python.
"""

from __future__ import annotations

import numpy as np

from jointctl.firmware_py.kernel import kernel

_TO_UNIT = 2.0**-53
_SHIFTS = (np.uint64(13), np.uint64(7), np.uint64(17))
_DROP = np.uint64(11)


@kernel
def next_state(state: int) -> np.uint64:
    """The state after this one; never 0 unless `state` is."""
    x = np.uint64(state)
    x = x ^ (x << _SHIFTS[0])
    x = x ^ (x >> _SHIFTS[1])
    return x ^ (x << _SHIFTS[2])


@kernel
def unit_number(state: np.uint64) -> float:
    """The number in [0, 1) of a state."""
    return float(state >> _DROP) * _TO_UNIT
