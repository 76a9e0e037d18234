"""An axis whose sequence is stepped by hand, and its state."""

from __future__ import annotations

from typing import Any

import pytest

from jointctl.firmware_py.records import AxisState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis


@pytest.fixture
def axis(axis_constants: Any) -> Any:
    return axis_constants[0]


@pytest.fixture
def state(axis: Any) -> Any:
    state = new(AxisState)[0]
    reset_axis(axis, state)
    return state
