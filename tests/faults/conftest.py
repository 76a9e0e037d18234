"""The process bench of tests/hil, and one commissioned lockstep joint for all tests of a module."""

from __future__ import annotations

import pytest

from jointctl.tools.configuration.load import load_config
from jointctl.tools.lockstep import LockstepJoint
from tests.hil.conftest import bench as bench
from tests.places import CONFIGS


@pytest.fixture(scope="module")
def lockstep() -> LockstepJoint:
    """The joint of configs/virtual.toml, commissioned once."""
    return LockstepJoint(load_config(CONFIGS / "virtual.toml"))
