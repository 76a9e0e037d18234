"""Ratios of two things measured in turn, and the rows that a benchmark consists of.

On a computer that other programs use as well, two runs one after the other differ more than what is compared.
Each pair is therefore measured close together, its ratio is taken, and the median of the ratios is the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

_T = TypeVar("_T")


@dataclass(frozen=True)
class Row:
    """One comparison; `ratio` is ours over the other's, so that less is faster, nan where there is nothing to compare.

    `low` and `high` are the quartiles of the paired ratios.  `goal` is the largest allowed ratio, or with
    `goal_is_value` the largest allowed value of ours.
    """

    group: str
    what: str
    ours: float
    unit: str
    other: float = math.nan
    other_name: str = ""
    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    pairs: int = 0
    goal: float | None = None
    goal_is_value: bool = False
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the goal is met; None where there is none, or nothing was measured for it."""
        value = self.ours if self.goal_is_value else self.ratio
        if self.goal is None or math.isnan(value):
            return None
        return value <= self.goal


def skipped(group: str, what: str, why: str) -> Row:
    """A comparison that could not be made, and why."""
    return Row(group, what, math.nan, "", note=f"skipped: {why}")


def measured(
    group: str,
    what: str,
    ours: Sequence[float],
    unit: str,
    *,
    goal: float | None = None,
    note: str = "",
) -> Row:
    """The median of values that are compared with nothing but a goal."""
    return Row(group, what, float(np.median(ours)), unit, goal=goal, goal_is_value=True, pairs=len(ours), note=note)


def compared(
    group: str,
    what: str,
    ours: Sequence[float],
    other: Sequence[float],
    unit: str,
    other_name: str,
    *,
    goal: float | None = None,
    note: str = "",
) -> Row:
    """Value k of `ours` and of `other` were measured next to each other."""
    if len(ours) != len(other) or not len(ours):
        raise ValueError(f"pairs (={len(ours)} of ours, {len(other)} of {other_name}) must be equal in number and > 0")
    ratios = np.asarray(ours, float) / np.asarray(other, float)
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    return Row(
        group, what, float(np.median(ours)), unit, float(np.median(other)), other_name,
        float(middle), float(low), float(high), len(ours), goal, note=note,
    )  # fmt: skip


def interleaved(pairs: int, *measure: Callable[[], _T]) -> list[list[_T]]:
    """The values of each function, called in turn `pairs` times; the order turns round each time."""
    values: list[list[_T]] = [[] for _ in measure]
    for pair in range(pairs):
        order = range(len(measure)) if pair % 2 == 0 else reversed(range(len(measure)))
        for index in order:
            values[index].append(measure[index]())
    return values
