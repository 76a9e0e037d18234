"""Zeros and minima by narrowing, against places that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jointctl.tools.analysis.margins import least_between, zero_between


@pytest.mark.parametrize(("low", "high"), [(0.0, 2.0), (1.4, 1.5)])
def test_a_zero(low: float, high: float) -> None:
    assert zero_between(lambda x: x * x - 2.0, low, high) == pytest.approx(math.sqrt(2.0), abs=1e-12)


def test_a_zero_at_an_end_and_one_between_numbers_that_do_not_get_closer() -> None:
    assert zero_between(lambda x: x - 1.0, 1.0, 3.0) == pytest.approx(1.0, abs=1e-12)
    assert zero_between(lambda x: x - 1e9, 0.0, 3e9) == pytest.approx(1e9, abs=1e-6)


def test_no_zero_is_told() -> None:
    with pytest.raises(ValueError, match=r"no change of sign between 2\.0 and 3\.0"):
        zero_between(lambda x: x * x - 2.0, 2.0, 3.0)


@pytest.mark.parametrize(("low", "high", "place"), [(0.0, 3.0, 1.0), (1.5, 3.0, 1.5), (-1.0, 0.5, 0.5)])
def test_a_minimum_inside_and_at_either_end(low: float, high: float, place: float) -> None:
    found, value = least_between(lambda x: np.abs(x - 1.0) + 0.25, low, high)
    assert found == pytest.approx(place, abs=1e-8)
    assert value == pytest.approx(abs(place - 1.0) + 0.25, abs=1e-8)
