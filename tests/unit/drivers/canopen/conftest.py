"""A CANopen drive behind frames that are written by hand, and commissioning of the virtual one."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.drive import CommissioningReport
from tests.unit.drivers.canopen.odd_drive import opened
from tests.unit.drivers.canopen.wire import Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def commission(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> Callable[..., CommissioningReport]:
    """Commissions with settings changed and sections removed from the EDS."""

    def run(*, without: tuple[str, ...] = (), **changes: Any) -> CommissioningReport:
        text = settings_of_virtual_joint.eds_path.read_text()
        for section in without:
            text, count = re.subn(rf"(?ims)^\[{section}(sub[0-9A-F]+)?\].*?(?=^\[|\Z)", "", text)
            assert count
        path = tmp_path / "edited.eds"
        path.write_text(text)
        settings = dataclasses.replace(settings_of_virtual_joint, eds_path=path, **changes)
        with opened(device_on_bus, settings) as drive:
            report = drive.commission()
            run.port = drive.port()  # type: ignore[attr-defined]
        return report

    return run


@pytest.fixture
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers that do not come are waited for a short time only."""
    monkeypatch.setattr("jointctl.drivers.canopen.drive.SDO_TIMEOUT_S", 0.15)
