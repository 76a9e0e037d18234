"""The process bench of tests/hil, and one commissioned lockstep joint for all tests of a module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from jointctl.hil.fault_kinds import FaultKind, no_faults
from jointctl.tools.configuration.load import load_config
from jointctl.tools.lockstep import LockstepJoint
from tests.hil.conftest import bench as bench
from tests.places import CONFIGS


@pytest.fixture(scope="module")
def lockstep() -> LockstepJoint:
    """The joint of configs/virtual.toml, commissioned once."""
    return LockstepJoint(load_config(CONFIGS / "virtual.toml"))


@pytest.fixture(scope="session")
def one_fault() -> Callable[..., Any]:
    """`one_fault(kind, at_s, duration_s, magnitude, seed)`: FaultConstants, a record array of one."""

    def make(kind: FaultKind, at_s: float = 0.0, duration_s: float = 1e6, magnitude: float = 1.0, seed: int = 1) -> Any:
        import numpy as np

        faults = np.zeros(1, no_faults().dtype).view(np.recarray)
        faults[0].kind, faults[0].start_s, faults[0].duration_s = kind, at_s, duration_s
        faults[0].magnitude, faults[0].seed = magnitude, seed
        return faults

    return make
