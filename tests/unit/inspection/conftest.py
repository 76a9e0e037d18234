"""A parameter file of the virtual drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from jointctl.tools.verbs.params import dump
from tests.unit.inspection.parameter_verbs import output, subject, writes


@pytest.fixture
def file(device_on_bus: Any, tmp_path: Path) -> Path:
    """A dump of the drive as it is."""
    path = tmp_path / "drive.dcf"
    assert dump(subject(device_on_bus), output()[0], path) == 0
    assert not writes(device_on_bus)
    device_on_bus.requests.clear()
    return path
