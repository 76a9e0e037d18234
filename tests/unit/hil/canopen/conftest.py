"""The virtual drive, frame by frame."""

from __future__ import annotations

import pytest

from tests.virtual_drive import Rig


@pytest.fixture
def rig() -> Rig:
    return Rig()
