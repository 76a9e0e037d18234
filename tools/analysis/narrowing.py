"""Zeros and minima of functions that are cheap on a whole grid: the interval shrinks round by round.

scipy.optimize needs fewer evaluations, but every start of a motion would wait a third of a second for its import.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_POINTS = 33  # of a round; an odd number keeps a symmetric extremum on the grid

Function = Callable[[np.ndarray], np.ndarray]


def zero_between(function: Function, low: float, high: float, tolerance: float = 1e-12) -> float:
    """Where `function` changes its sign between `low` and `high` > `low`; the first such place on the grid.

    `function` maps an array of places, shape (N,), to real values of the same shape.  Raises ValueError without a
    change of sign.
    """
    while True:
        places = np.linspace(low, high, _POINTS)
        positive = function(places) > 0.0
        changes = np.flatnonzero(positive[:-1] != positive[1:])
        if not len(changes):
            raise ValueError(f"no change of sign between {low} and {high}")
        last_width = high - low
        low, high = float(places[changes[0]]), float(places[changes[0] + 1])
        if high - low <= tolerance or high - low >= last_width:
            return 0.5 * (low + high)


def least_between(function: Function, low: float, high: float, tolerance: float = 1e-9) -> tuple[float, float]:
    """(place, value) of the least value that `function`, as above, has on the grids from `low` to `high` > `low`."""
    while True:
        places = np.linspace(low, high, _POINTS)
        values = function(places)
        least = int(np.argmin(values))
        last_width = high - low
        low, high = float(places[max(least - 1, 0)]), float(places[min(least + 1, _POINTS - 1)])
        if high - low <= tolerance or high - low >= last_width:
            return float(places[least]), float(values[least])
