"""A CANopen drive behind frames that are written by hand, and commissioning of the virtual one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from jointctl.drivers.drive import CommissioningReport
from tests.device_on_bus import DeviceOnBus
from tests.unit.drivers.canopen.wire import Wire


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def commission(joint: DeviceOnBus, tmp_path: Path) -> Callable[..., CommissioningReport]:
    """Commissions with settings changed and objects (`6007`, `1400sub5`) removed from the EDS, or with another one."""

    def run(*, without: tuple[str, ...] = (), eds: str = "", **changes: object) -> CommissioningReport:
        assert joint.settings is not None
        text = eds or joint.settings.eds_path.read_text()
        for section in without:
            text, count = re.subn(rf"(?ims)^\[{section}(sub[0-9A-F]+)?\].*?(?=^\[|\Z)", "", text)
            assert count
        path = tmp_path / "edited.eds"
        path.write_text(text, encoding="latin-1")
        with joint.opened(**{"eds_path": path, **changes}) as drive:
            report = drive.commission()
            run.port = drive.port()  # type: ignore[attr-defined]
        return report

    return run


@pytest.fixture
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers that do not come are waited for a short time only."""
    monkeypatch.setattr("jointctl.drivers.canopen.drive.SDO_TIMEOUT_S", 0.15)
