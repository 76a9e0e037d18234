"""A serial drive in memory: its cyclic exchange and its port."""

from __future__ import annotations

import pytest

from tests.unit.drivers.elmo.virtual_line import MemoryPort, Talk


@pytest.fixture(params=[True, False], ids=["echo", "no echo"])
def talk(request: pytest.FixtureRequest) -> Talk:
    return Talk(request.param)


@pytest.fixture
def port() -> MemoryPort:
    return MemoryPort()
