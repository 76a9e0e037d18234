"""The process bench of tests/hil, and one commissioned lockstep joint for all tests of a module."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.faults.kinds import FaultKind, no_faults
from tools.configuration.load import load_config
from tools.simulation.lockstep import LockstepJoint

TESTS = Path(__file__).resolve().parents[1]


def _module_of_hil(name: str) -> Any:
    """A module of tests/hil; with importlib mode, folders of tests do not see each other."""
    known = f"tests_hil_{name}"
    if known not in sys.modules:
        spec = importlib.util.spec_from_file_location(known, TESTS / "hil" / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[known] = module
        spec.loader.exec_module(module)
    return sys.modules[known]


bench = _module_of_hil("conftest").bench


@pytest.fixture(scope="session")
def processes() -> Any:
    """The module tests/hil/test_processes: `Moving`, `Witness`, `gone`."""
    return _module_of_hil("test_processes")


@pytest.fixture(scope="module")
def joint() -> LockstepJoint:
    """The joint of configs/virtual.toml, commissioned once."""
    return LockstepJoint(load_config(TESTS.parent / "configs" / "virtual.toml"))


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
